//! Reads values with BACnet tags.

use super::tag;
use crate::types::{Data, ObjectId, PropertyId, Reject};

/// A BACnet tag as read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Tag {
    /// A primitive value with its application tag and its length; for BOOLEAN the second number is the value itself.
    App(u8, usize),
    /// A primitive value with its context tag and its length.
    Context(u8, usize),
    /// Opening tag with this number.
    Open(u8),
    /// Closing tag with this number.
    Close(u8),
}

/// The result of reading a tagged value.
pub type Read<T> = Result<T, Reject>;

/// Reads tagged values; anything unexpected is an error that states how the request is rejected.
#[derive(Debug, Clone)]
pub struct Reader<'a> {
    bytes: &'a [u8],
}

impl<'a> Reader<'a> {
    /// A reader at the beginning of `bytes`.
    pub fn new(bytes: &'a [u8]) -> Reader<'a> {
        Reader { bytes }
    }

    /// Whether no bytes are left.
    pub fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    /// An error unless nothing is left.
    ///
    /// # Errors
    /// If bytes are left over.
    pub fn end(&self) -> Read<()> {
        if self.is_empty() {
            Ok(())
        } else {
            Err(Reject::TooManyArguments)
        }
    }

    /// Takes the next `len` octets.
    ///
    /// # Errors
    /// If fewer octets are left.
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

    /// The next tag, without consuming it.
    ///
    /// # Errors
    /// If there is no further tag.
    pub fn peek(&self) -> Read<Tag> {
        self.clone().tag()
    }

    /// Reads the next tag; the value of the tag follows.
    ///
    /// # Errors
    /// If there is no further tag, or the next one is invalid.
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
        Ok(if context {
            Tag::Context(number, len)
        } else {
            Tag::App(number, len)
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

    /// Reads the opening tag of a constructed value.
    ///
    /// # Errors
    /// If the next tag is another one.
    pub fn open(&mut self, number: u8) -> Read<()> {
        self.exactly(Tag::Open(number))
    }

    /// Reads the closing tag with this number.
    ///
    /// # Errors
    /// If the next tag is another one.
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
    /// If the next tag is another one.
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

    /// Reads a value as [`Reader::context`] does, if this context tag is the next one; otherwise returns `None`.
    ///
    /// # Errors
    /// If the encoding is not valid.
    pub fn optional(&mut self, number: u8) -> Read<Option<&'a [u8]>> {
        if self.is_context(number) {
            self.context(number).map(Some)
        } else {
            Ok(None)
        }
    }

    /// Unsigned of at most 32 bits in a context.
    ///
    /// # Errors
    /// If the next tag or value is another one.
    pub fn context_u32(&mut self, number: u8) -> Read<u32> {
        u32_of(self.context(number)?)
    }

    /// The unsigned value with this context tag, if it is the next one.
    ///
    /// # Errors
    /// If the encoding is not valid, or the number exceeds 32 bits.
    pub fn optional_u32(&mut self, number: u8) -> Read<Option<u32>> {
        self.optional(number)?.map(u32_of).transpose()
    }

    /// Reads a BOOLEAN with this context tag, if the tag is the next one; otherwise returns `None`.
    ///
    /// # Errors
    /// If the encoding is not valid.
    pub fn optional_bool(&mut self, number: u8) -> Read<Option<bool>> {
        match self.optional(number)? {
            None => Ok(None),
            Some([0]) => Ok(Some(false)),
            Some([1]) => Ok(Some(true)),
            Some(_) => Err(Reject::InvalidParameterDataType),
        }
    }

    /// Reads a BACnetObjectIdentifier with a context tag.
    ///
    /// # Errors
    /// If the next tag or length is another one.
    pub fn context_object(&mut self, number: u8) -> Read<ObjectId> {
        let bytes: [u8; 4] = self
            .context(number)?
            .try_into()
            .map_err(|_| Reject::InvalidParameterDataType)?;
        Ok(ObjectId::from_bits(u32::from_be_bytes(bytes)))
    }

    /// Reads a property identifier with a context tag.
    ///
    /// # Errors
    /// If the next tag or value is another one.
    pub fn context_property(&mut self, number: u8) -> Read<PropertyId> {
        self.context_u32(number).map(PropertyId)
    }

    /// Reads a REAL with this context tag, if the tag is the next one; otherwise returns `None`.
    ///
    /// # Errors
    /// If the encoding is not valid.
    pub fn optional_real(&mut self, number: u8) -> Read<Option<f32>> {
        let Some(bytes) = self.optional(number)? else {
            return Ok(None);
        };
        let bytes: [u8; 4] = bytes.try_into().map_err(|_| Reject::InvalidParameterDataType)?;
        Ok(Some(f32::from_be_bytes(bytes)))
    }

    /// A primitive value with its application tag; `None` if a constructed one, or one with a context tag, follows.
    ///
    /// # Errors
    /// If the encoding is not valid.
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
/// If the encoding is not valid, or the character set is not supported.
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
/// If the number is empty or longer than 32 bits.
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
