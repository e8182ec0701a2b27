//! Tags and primitive values (clause 20.2).

use crate::types::{Data, DateTime, ObjectId, PropertyId, Reject};

/// Writes tagged values.
#[derive(Debug, Default, Clone)]
pub struct Writer {
    bytes: Vec<u8>,
}

/// Application tags.
mod tag {
    pub(super) const NULL: u8 = 0;
    pub(super) const BOOLEAN: u8 = 1;
    pub(super) const UNSIGNED: u8 = 2;
    pub(super) const SIGNED: u8 = 3;
    pub(super) const REAL: u8 = 4;
    pub(super) const DOUBLE: u8 = 5;
    pub(super) const OCTETS: u8 = 6;
    pub(super) const TEXT: u8 = 7;
    pub(super) const BITS: u8 = 8;
    pub(super) const ENUMERATED: u8 = 9;
    pub(super) const DATE: u8 = 10;
    pub(super) const TIME: u8 = 11;
    pub(super) const OBJECT: u8 = 12;
}

/// The octets of a number without leading zeros.
fn minimal(bytes: &[u8]) -> &[u8] {
    let zeros = bytes.iter().take_while(|byte| **byte == 0).count().min(bytes.len() - 1);
    bytes.get(zeros..).unwrap_or_default()
}

impl Writer {
    /// What was written.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// What was written.
    pub fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }

    /// Octets as they are.
    pub fn raw(&mut self, bytes: &[u8]) -> &mut Writer {
        self.bytes.extend_from_slice(bytes);
        self
    }

    fn head(&mut self, number: u8, context: bool, len: usize) {
        let class = u8::from(context) << 3;
        let short = if len < 5 { u8::try_from(len).unwrap_or(5) } else { 5 };
        if number < 15 {
            self.bytes.push(number << 4 | class | short);
        } else {
            self.bytes.extend([0xF0 | class | short, number]);
        }
        if short == 5 {
            match (u8::try_from(len), u16::try_from(len)) {
                (Ok(len), _) if len < 254 => self.bytes.push(len),
                (_, Ok(len)) => {
                    self.bytes.push(254);
                    self.bytes.extend(len.to_be_bytes());
                }
                _ => {
                    self.bytes.push(255);
                    self.bytes.extend(u32::try_from(len).unwrap_or(u32::MAX).to_be_bytes());
                }
            }
        }
    }

    fn app(&mut self, number: u8, bytes: &[u8]) -> &mut Writer {
        self.head(number, false, bytes.len());
        self.raw(bytes)
    }

    fn context(&mut self, number: u8, bytes: &[u8]) -> &mut Writer {
        self.head(number, true, bytes.len());
        self.raw(bytes)
    }

    /// Opens a constructed value.
    pub fn open(&mut self, number: u8) -> &mut Writer {
        self.bytes.push(number << 4 | 0x0E);
        self
    }

    /// Closes it.
    pub fn close(&mut self, number: u8) -> &mut Writer {
        self.bytes.push(number << 4 | 0x0F);
        self
    }

    /// NULL.
    pub fn null(&mut self) -> &mut Writer {
        self.app(tag::NULL, &[])
    }

    /// BOOLEAN, whose value stands in the tag.
    pub fn bool(&mut self, value: bool) -> &mut Writer {
        self.bytes.push(tag::BOOLEAN << 4 | u8::from(value));
        self
    }

    /// Unsigned.
    pub fn unsigned(&mut self, value: u64) -> &mut Writer {
        self.app(tag::UNSIGNED, minimal(&value.to_be_bytes()))
    }

    /// INTEGER.
    pub fn signed(&mut self, value: i64) -> &mut Writer {
        let bytes = value.to_be_bytes();
        let spare = |pair: &[u8]| {
            matches!(pair, [0, next] if next & 0x80 == 0) || matches!(pair, [0xFF, next] if next & 0x80 != 0)
        };
        let skip = bytes.windows(2).take_while(|pair| spare(pair)).count();
        self.app(tag::SIGNED, bytes.get(skip..).unwrap_or_default())
    }

    /// REAL.
    pub fn real(&mut self, value: f32) -> &mut Writer {
        self.app(tag::REAL, &value.to_be_bytes())
    }

    /// OCTET STRING.
    pub fn octets(&mut self, value: &[u8]) -> &mut Writer {
        self.app(tag::OCTETS, value)
    }

    /// CharacterString in UTF-8.
    pub fn text(&mut self, value: &str) -> &mut Writer {
        self.head(tag::TEXT, false, value.len() + 1);
        self.bytes.push(0);
        self.raw(value.as_bytes())
    }

    /// BIT STRING, the first bit first.
    pub fn bits(&mut self, bits: &[bool]) -> &mut Writer {
        let value = bit_string(bits);
        self.app(tag::BITS, &value)
    }

    /// ENUMERATED.
    pub fn enumerated(&mut self, value: u32) -> &mut Writer {
        self.app(tag::ENUMERATED, minimal(&value.to_be_bytes()))
    }

    /// Date.
    pub fn date(&mut self, value: [u8; 4]) -> &mut Writer {
        self.app(tag::DATE, &value)
    }

    /// Time.
    pub fn time(&mut self, value: [u8; 4]) -> &mut Writer {
        self.app(tag::TIME, &value)
    }

    /// BACnetDateTime.
    pub fn date_time(&mut self, value: DateTime) -> &mut Writer {
        self.date(value.date).time(value.time)
    }

    /// BACnetObjectIdentifier.
    pub fn object(&mut self, value: ObjectId) -> &mut Writer {
        self.app(tag::OBJECT, &value.bits().to_be_bytes())
    }

    /// Unsigned or ENUMERATED in a context.
    pub fn context_unsigned(&mut self, number: u8, value: u64) -> &mut Writer {
        self.context(number, minimal(&value.to_be_bytes()))
    }

    /// BOOLEAN in a context.
    pub fn context_bool(&mut self, number: u8, value: bool) -> &mut Writer {
        self.context(number, &[u8::from(value)])
    }

    /// REAL in a context.
    pub fn context_real(&mut self, number: u8, value: f32) -> &mut Writer {
        self.context(number, &value.to_be_bytes())
    }

    /// NULL in a context.
    pub fn context_null(&mut self, number: u8) -> &mut Writer {
        self.context(number, &[])
    }

    /// OCTET STRING in a context.
    pub fn context_octets(&mut self, number: u8, value: &[u8]) -> &mut Writer {
        self.context(number, value)
    }

    /// BACnetObjectIdentifier in a context.
    pub fn context_object(&mut self, number: u8, value: ObjectId) -> &mut Writer {
        self.context(number, &value.bits().to_be_bytes())
    }

    /// Property identifier in a context.
    pub fn context_property(&mut self, number: u8, value: PropertyId) -> &mut Writer {
        self.context_unsigned(number, value.0.into())
    }
}

fn bit_string(bits: &[bool]) -> Vec<u8> {
    let unused = (8 - bits.len() % 8) % 8;
    let mut value = vec![u8::try_from(unused).unwrap_or_default()];
    let octet = |chunk: &[bool]| {
        (0u8..)
            .zip(chunk)
            .fold(0, |octet, (place, bit)| octet | u8::from(*bit) << (7 - place))
    };
    value.extend(bits.chunks(8).map(octet));
    value
}

/// A tag as read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Tag {
    /// Of a primitive value by its type; for BOOLEAN the second is the value.
    App(u8, usize),
    /// Of a primitive value in a context.
    Context(u8, usize),
    /// Begins a constructed value.
    Open(u8),
    /// Ends it.
    Close(u8),
}

/// What reading gives.
pub type Read<T> = Result<T, Reject>;

/// Reads tagged values; everything out of place is an error that says how the request is rejected.
#[derive(Debug, Clone)]
pub struct Reader<'a> {
    bytes: &'a [u8],
}

impl<'a> Reader<'a> {
    /// At the beginning of `bytes`.
    pub fn new(bytes: &'a [u8]) -> Reader<'a> {
        Reader { bytes }
    }

    /// Whether nothing is left.
    pub fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    /// An error unless nothing is left.
    ///
    /// # Errors
    /// Something is left.
    pub fn end(&self) -> Read<()> {
        match self.is_empty() {
            true => Ok(()),
            false => Err(Reject::TooManyArguments),
        }
    }

    /// So many octets.
    ///
    /// # Errors
    /// There are fewer.
    pub fn take(&mut self, len: usize) -> Read<&'a [u8]> {
        let (head, rest) = self
            .bytes
            .split_at_checked(len)
            .ok_or(Reject::MissingRequiredParameter)?;
        self.bytes = rest;
        Ok(head)
    }

    fn octet(&mut self) -> Read<u8> {
        let (first, rest) = self.bytes.split_first().ok_or(Reject::MissingRequiredParameter)?;
        self.bytes = rest;
        Ok(*first)
    }

    /// The next tag, which stays.
    ///
    /// # Errors
    /// There is none.
    pub fn peek(&self) -> Read<Tag> {
        self.clone().tag()
    }

    /// The next tag; its value comes next.
    ///
    /// # Errors
    /// There is none, or none that is valid.
    pub fn tag(&mut self) -> Read<Tag> {
        let first = self.octet()?;
        let number = match first >> 4 {
            15 => self.octet()?,
            number => number,
        };
        let context = first & 8 != 0;
        let len = match first & 7 {
            6 if context => return Ok(Tag::Open(number)),
            7 if context => return Ok(Tag::Close(number)),
            6 | 7 => return Err(Reject::InvalidTag),
            5 => match self.octet()? {
                254 => usize::from(u16::from_be_bytes(self.array()?)),
                255 => usize::try_from(u32::from_be_bytes(self.array()?)).map_err(|_| Reject::BufferOverflow)?,
                len => usize::from(len),
            },
            len => usize::from(len),
        };
        Ok(match context {
            true => Tag::Context(number, len),
            false => Tag::App(number, len),
        })
    }

    fn array<const N: usize>(&mut self) -> Read<[u8; N]> {
        self.take(N)?.try_into().map_err(|_| Reject::MissingRequiredParameter)
    }

    /// Whether the next tag is that context, primitive.
    pub fn is_context(&self, number: u8) -> bool {
        matches!(self.peek(), Ok(Tag::Context(next, _)) if next == number)
    }

    /// Whether the next tag opens that context.
    pub fn is_open(&self, number: u8) -> bool {
        self.peek() == Ok(Tag::Open(number))
    }

    /// Whether the next tag closes that context.
    pub fn is_close(&self, number: u8) -> bool {
        self.peek() == Ok(Tag::Close(number))
    }

    /// Opens a constructed value.
    ///
    /// # Errors
    /// Another tag comes.
    pub fn open(&mut self, number: u8) -> Read<()> {
        self.exactly(Tag::Open(number))
    }

    /// Closes it.
    ///
    /// # Errors
    /// Another tag comes.
    pub fn close(&mut self, number: u8) -> Read<()> {
        self.exactly(Tag::Close(number))
    }

    fn exactly(&mut self, wanted: Tag) -> Read<()> {
        match self.tag()? {
            tag if tag == wanted => Ok(()),
            _ => Err(Reject::InvalidTag),
        }
    }

    /// The octets of a primitive value in that context.
    ///
    /// # Errors
    /// Another tag comes.
    pub fn context(&mut self, number: u8) -> Read<&'a [u8]> {
        if self.is_empty() {
            return Err(Reject::MissingRequiredParameter);
        }
        match self.tag()? {
            Tag::Context(next, len) if next == number => self.take(len),
            Tag::Context(..) | Tag::Open(_) | Tag::Close(_) => Err(Reject::MissingRequiredParameter),
            Tag::App(..) => Err(Reject::InvalidTag),
        }
    }

    /// As [`Reader::context`], where that context comes next.
    ///
    /// # Errors
    /// It is not valid.
    pub fn optional(&mut self, number: u8) -> Read<Option<&'a [u8]>> {
        match self.is_context(number) {
            true => self.context(number).map(Some),
            false => Ok(None),
        }
    }

    /// Unsigned of at most 32 bits in a context.
    ///
    /// # Errors
    /// Another tag or value comes.
    pub fn context_u32(&mut self, number: u8) -> Read<u32> {
        u32_of(self.context(number)?)
    }

    /// The same where it comes next.
    ///
    /// # Errors
    /// It is not valid.
    pub fn optional_u32(&mut self, number: u8) -> Read<Option<u32>> {
        self.optional(number)?.map(u32_of).transpose()
    }

    /// BOOLEAN in a context, where it comes next.
    ///
    /// # Errors
    /// It is not valid.
    pub fn optional_bool(&mut self, number: u8) -> Read<Option<bool>> {
        match self.optional(number)? {
            None => Ok(None),
            Some([0]) => Ok(Some(false)),
            Some([1]) => Ok(Some(true)),
            Some(_) => Err(Reject::InvalidParameterDataType),
        }
    }

    /// BACnetObjectIdentifier in a context.
    ///
    /// # Errors
    /// Another tag or length comes.
    pub fn context_object(&mut self, number: u8) -> Read<ObjectId> {
        let bytes: [u8; 4] = self
            .context(number)?
            .try_into()
            .map_err(|_| Reject::InvalidParameterDataType)?;
        Ok(ObjectId::from_bits(u32::from_be_bytes(bytes)))
    }

    /// Property identifier in a context.
    ///
    /// # Errors
    /// Another tag or value comes.
    pub fn context_property(&mut self, number: u8) -> Read<PropertyId> {
        self.context_u32(number).map(PropertyId)
    }

    /// REAL in a context, where it comes next.
    ///
    /// # Errors
    /// It is not valid.
    pub fn optional_real(&mut self, number: u8) -> Read<Option<f32>> {
        let Some(bytes) = self.optional(number)? else {
            return Ok(None);
        };
        let bytes: [u8; 4] = bytes.try_into().map_err(|_| Reject::InvalidParameterDataType)?;
        Ok(Some(f32::from_be_bytes(bytes)))
    }

    /// A primitive value with its application tag; `None` where a constructed one, or one of a context, comes.
    ///
    /// # Errors
    /// It is not valid.
    pub fn data(&mut self) -> Read<Option<Data>> {
        let (number, len) = match self.tag()? {
            Tag::App(number, len) => (number, len),
            Tag::Context(_, len) => {
                self.take(len)?;
                return Ok(None);
            }
            Tag::Open(_) | Tag::Close(_) => return Ok(None),
        };
        if number == tag::BOOLEAN {
            return match len {
                0 | 1 => Ok(Some(Data::Bool(len == 1))),
                _ => Err(Reject::InvalidTag),
            };
        }
        let bytes = self.take(len)?;
        primitive(number, bytes).map(Some)
    }
}

fn primitive(number: u8, bytes: &[u8]) -> Read<Data> {
    let wrong = Reject::InvalidParameterDataType;
    Ok(match number {
        tag::NULL if bytes.is_empty() => Data::Null,
        tag::UNSIGNED => Data::Unsigned(u64_of(bytes)?),
        tag::SIGNED => Data::Signed(i64_of(bytes)?),
        tag::REAL => Data::Real(f32::from_be_bytes(bytes.try_into().map_err(|_| wrong)?)),
        tag::DOUBLE => Data::Double(f64::from_be_bytes(bytes.try_into().map_err(|_| wrong)?)),
        tag::TEXT => Data::Text(text_of(bytes)?),
        tag::ENUMERATED => Data::Enumerated(u32_of(bytes)?),
        tag::OBJECT => {
            let bytes: [u8; 4] = bytes.try_into().map_err(|_| wrong)?;
            Data::Object(ObjectId::from_bits(u32::from_be_bytes(bytes)))
        }
        tag::OCTETS | tag::BITS => Data::Other,
        tag::DATE | tag::TIME if bytes.len() == 4 => Data::Other,
        _ => return Err(wrong),
    })
}

/// A CharacterString in one of the usual character sets.
///
/// # Errors
/// It is not valid, or of another set.
pub fn text_of(bytes: &[u8]) -> Read<String> {
    let wrong = Reject::InvalidParameterDataType;
    let (set, text) = bytes.split_first().ok_or(wrong)?;
    match set {
        0 => String::from_utf8(text.to_vec()).map_err(|_| wrong),
        4 if text.len() % 2 == 0 => {
            let units: Vec<u16> = text
                .chunks(2)
                .map(|pair| pair.iter().fold(0, |unit, byte| unit << 8 | u16::from(*byte)))
                .collect();
            String::from_utf16(&units).map_err(|_| wrong)
        }
        5 => Ok(text.iter().map(|byte| char::from(*byte)).collect()),
        _ => Err(wrong),
    }
}

fn u64_of(bytes: &[u8]) -> Read<u64> {
    match bytes.len() {
        1..=8 => Ok(bytes.iter().fold(0, |value, byte| value << 8 | u64::from(*byte))),
        _ => Err(Reject::InvalidParameterDataType),
    }
}

/// An Unsigned of at most 32 bits.
///
/// # Errors
/// It is longer, or empty.
pub fn u32_of(bytes: &[u8]) -> Read<u32> {
    u32::try_from(u64_of(bytes)?).map_err(|_| Reject::ParameterOutOfRange)
}

fn i64_of(bytes: &[u8]) -> Read<i64> {
    let first = *bytes
        .first()
        .filter(|_| bytes.len() <= 8)
        .ok_or(Reject::InvalidParameterDataType)?;
    let start = if first & 0x80 == 0 { 0 } else { -1 };
    Ok(bytes.iter().fold(start, |value, byte| value << 8 | i64::from(*byte)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::ObjectType;

    fn written(write: impl FnOnce(&mut Writer)) -> Vec<u8> {
        let mut writer = Writer::default();
        write(&mut writer);
        writer.into_bytes()
    }

    /// The examples of clause 20.2 and annex F.
    #[test]
    fn values_as_the_standard_writes_them() {
        let cases: [(Vec<u8>, &[u8]); 12] = [
            (
                written(|w| {
                    w.null().bool(false).bool(true);
                }),
                &[0x00, 0x10, 0x11],
            ),
            (
                written(|w| {
                    w.unsigned(72);
                }),
                &[0x21, 0x48],
            ),
            (
                written(|w| {
                    w.unsigned(0).unsigned(0x1_0000);
                }),
                &[0x21, 0, 0x23, 1, 0, 0],
            ),
            (
                written(|w| {
                    w.signed(72).signed(-1).signed(-128).signed(128);
                }),
                &[0x31, 0x48, 0x31, 0xFF, 0x31, 0x80, 0x32, 0, 0x80],
            ),
            (
                written(|w| {
                    w.real(72.0);
                }),
                &[0x44, 0x42, 0x90, 0, 0],
            ),
            (
                written(|w| {
                    w.text("This is a BACnet string!");
                }),
                b"\x75\x19\x00This is a BACnet string!",
            ),
            (
                written(|w| {
                    w.bits(&[true, false, true, false, true]);
                }),
                &[0x82, 0x03, 0xA8],
            ),
            (
                written(|w| {
                    w.enumerated(0);
                }),
                &[0x91, 0],
            ),
            (
                written(|w| {
                    w.date([91, 1, 24, 4]).time([17, 35, 45, 17]);
                }),
                &[0xA4, 0x5B, 1, 0x18, 4, 0xB4, 0x11, 0x23, 0x2D, 0x11],
            ),
            (
                written(|w| {
                    w.object(ObjectId::new(ObjectType::BINARY_INPUT, 15));
                }),
                &[0xC4, 0, 0xC0, 0, 0x0F],
            ),
            (
                written(|w| {
                    w.context_unsigned(2, 256).context_unsigned(27, 1);
                }),
                &[0x2A, 1, 0, 0xF9, 27, 1],
            ),
            (
                written(|w| {
                    w.open(3).context_bool(0, true).close(3);
                }),
                &[0x3E, 0x09, 1, 0x3F],
            ),
        ];
        for (is, wanted) in cases {
            assert_eq!(is, wanted);
        }
        assert_eq!(
            written(|w| {
                w.octets(&[7; 300]);
            })[..4],
            [0x65, 254, 1, 44]
        );
    }

    #[test]
    fn what_is_written_is_read() {
        let mut writer = Writer::default();
        writer
            .null()
            .bool(true)
            .unsigned(u64::MAX)
            .signed(i64::MIN)
            .real(-0.5)
            .text("°C")
            .enumerated(7);
        writer
            .object(ObjectId::new(ObjectType::DEVICE, 5))
            .octets(&[1, 2])
            .context_null(1);
        let mut reader = Reader::new(writer.bytes());
        let wanted = [
            Some(Data::Null),
            Some(Data::Bool(true)),
            Some(Data::Unsigned(u64::MAX)),
            Some(Data::Signed(i64::MIN)),
            Some(Data::Real(-0.5)),
            Some(Data::Text("°C".to_string())),
            Some(Data::Enumerated(7)),
            Some(Data::Object(ObjectId::new(ObjectType::DEVICE, 5))),
            Some(Data::Other),
            None,
        ];
        for data in wanted {
            assert_eq!(reader.data(), Ok(data));
        }
        assert_eq!(reader.end(), Ok(()));
        assert_eq!(text_of(&[4, 0, b'a', 0x20, 0xAC]), Ok("a€".to_string()));
        assert_eq!(text_of(&[5, 0xB0]), Ok("°".to_string()));
    }

    #[test]
    fn what_is_wrong_is_an_error() {
        for bytes in [
            &[0x25][..],
            &[0x22, 1],
            &[0x0E, 0xFF],
            &[0x45, 3, 0, 0, 0],
            &[0x75, 255, 255, 255, 255, 255],
            &[0xF9],
        ] {
            let mut reader = Reader::new(bytes);
            let all = std::iter::from_fn(|| (!reader.is_empty()).then(|| reader.data())).take(9);
            assert!(all.last().unwrap().is_err() || bytes[0] == 0x0E, "{bytes:?}");
        }
    }
}
