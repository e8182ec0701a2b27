//! Writes values with BACnet tags.

use super::tag;
use crate::types::{DateTime, ObjectId, PropertyId};

/// Writes values with BACnet tags.
#[derive(Debug, Default, Clone)]
pub struct Writer {
    bytes: Vec<u8>,
}

/// The octets of a number without leading zeros.
fn minimal(bytes: &[u8]) -> &[u8] {
    let zeros = bytes.iter().take_while(|byte| **byte == 0).count().min(bytes.len() - 1);
    bytes.get(zeros..).unwrap_or_default()
}

impl Writer {
    /// The bytes written so far.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// The bytes that were written.
    pub fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }

    /// Appends octets unchanged.
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

    /// Writes the opening tag of a constructed value.
    pub fn open(&mut self, number: u8) -> &mut Writer {
        self.bytes.push(number << 4 | 0x0E);
        self
    }

    /// Appends the closing tag with this number.
    pub fn close(&mut self, number: u8) -> &mut Writer {
        self.bytes.push(number << 4 | 0x0F);
        self
    }

    /// NULL.
    pub fn null(&mut self) -> &mut Writer {
        self.app(tag::NULL, &[])
    }

    /// Writes a BOOLEAN. The tag itself contains its value.
    pub fn bool(&mut self, value: bool) -> &mut Writer {
        self.bytes.push(tag::BOOLEAN << 4 | u8::from(value));
        self
    }

    /// Writes an Unsigned.
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

    /// Writes a Date.
    pub fn date(&mut self, value: [u8; 4]) -> &mut Writer {
        self.app(tag::DATE, &value)
    }

    /// Writes a Time.
    pub fn time(&mut self, value: [u8; 4]) -> &mut Writer {
        self.app(tag::TIME, &value)
    }

    /// Writes a BACnetDateTime.
    pub fn date_time(&mut self, value: DateTime) -> &mut Writer {
        self.date(value.date).time(value.time)
    }

    /// Writes a BACnetObjectIdentifier.
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

    /// Writes a BACnetObjectIdentifier with a context tag.
    pub fn context_object(&mut self, number: u8, value: ObjectId) -> &mut Writer {
        self.context(number, &value.bits().to_be_bytes())
    }

    /// Writes a property identifier with a context tag.
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
