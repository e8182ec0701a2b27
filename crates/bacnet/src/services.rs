//! The parameters of requests (clauses 13 to 16).

use crate::encoding::{Read, Reader, Tag, text_of, u32_of};
use crate::types::{Data, ObjectId, PropertyId, Reject};

/// Numbers of the confirmed services.
#[allow(missing_docs)]
pub mod confirmed {
    pub const COV_NOTIFICATION: u8 = 1;
    pub const SUBSCRIBE_COV: u8 = 5;
    pub const READ_PROPERTY: u8 = 12;
    pub const READ_PROPERTY_MULTIPLE: u8 = 14;
    pub const WRITE_PROPERTY: u8 = 15;
    pub const WRITE_PROPERTY_MULTIPLE: u8 = 16;
    pub const DEVICE_COMMUNICATION_CONTROL: u8 = 17;
    pub const REINITIALIZE_DEVICE: u8 = 20;
    pub const SUBSCRIBE_COV_PROPERTY: u8 = 28;
}

/// Numbers of the unconfirmed services.
#[allow(missing_docs)]
pub mod unconfirmed {
    pub const I_AM: u8 = 0;
    pub const I_HAVE: u8 = 1;
    pub const COV_NOTIFICATION: u8 = 2;
    pub const TIME_SYNCHRONIZATION: u8 = 6;
    pub const WHO_HAS: u8 = 7;
    pub const WHO_IS: u8 = 8;
    pub const UTC_TIME_SYNCHRONIZATION: u8 = 9;
}

/// Services that are executed, as bits of Protocol_Services_Supported.
///
/// Unconfirmed services that the server only sends are not listed.
pub const SUPPORTED: [usize; 11] = [5, 12, 14, 15, 16, 17, 32, 33, 34, 36, 38];

/// A property, or one element of an array property.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PropertyRef {
    /// The property that is meant.
    pub property: PropertyId,
    /// The element of an array; 0 is the number of elements.
    pub index: Option<u32>,
}

/// Device instances to which a request is addressed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Range(pub Option<(u32, u32)>);

impl Range {
    fn read(reader: &mut Reader<'_>) -> Read<Range> {
        let Some(low) = reader.optional_u32(0)? else {
            return Ok(Range(None));
        };
        let high = reader.context_u32(1)?;
        if low <= high && high <= crate::types::WILDCARD {
            Ok(Range(Some((low, high))))
        } else {
            Err(Reject::ParameterOutOfRange)
        }
    }
}

/// Parses a Who-Is request.
///
/// # Errors
/// If the encoding is not valid.
pub fn who_is(data: &[u8]) -> Read<Range> {
    let mut reader = Reader::new(data);
    let range = Range::read(&mut reader)?;
    reader.end()?;
    Ok(range)
}

/// The object that a Who-Has message searches for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Sought {
    /// An object with this identifier.
    Object(ObjectId),
    /// An object with this name.
    Name(String),
}

/// Parses a Who-Has request.
///
/// # Errors
/// If the encoding is not valid.
pub fn who_has(data: &[u8]) -> Read<(Range, Sought)> {
    let mut reader = Reader::new(data);
    let range = Range::read(&mut reader)?;
    let sought = if reader.is_context(2) {
        Sought::Object(reader.context_object(2)?)
    } else {
        Sought::Name(text_of(reader.context(3)?)?)
    };
    reader.end()?;
    Ok((range, sought))
}

/// Parses a ReadProperty request.
///
/// # Errors
/// If the encoding is not valid.
pub fn read_property(data: &[u8]) -> Read<(ObjectId, PropertyRef)> {
    let mut reader = Reader::new(data);
    let object = reader.context_object(0)?;
    let property = property_ref(&mut reader, 1, 2)?;
    reader.end()?;
    Ok((object, property))
}

fn property_ref(reader: &mut Reader<'_>, property: u8, index: u8) -> Read<PropertyRef> {
    Ok(PropertyRef {
        property: reader.context_property(property)?,
        index: reader.optional_u32(index)?,
    })
}

/// Parses a ReadPropertyMultiple request.
///
/// # Errors
/// If the encoding is not valid.
pub fn read_property_multiple(data: &[u8]) -> Read<Vec<(ObjectId, Vec<PropertyRef>)>> {
    let mut reader = Reader::new(data);
    let mut all = Vec::new();
    while !reader.is_empty() {
        let object = reader.context_object(0)?;
        let mut properties = Vec::new();
        reader.open(1)?;
        while !reader.is_close(1) {
            properties.push(property_ref(&mut reader, 0, 1)?);
        }
        reader.close(1)?;
        if properties.is_empty() {
            return Err(Reject::MissingRequiredParameter);
        }
        all.push((object, properties));
    }
    if all.is_empty() {
        Err(Reject::MissingRequiredParameter)
    } else {
        Ok(all)
    }
}

/// One of the writes in a request.
#[derive(Debug, Clone, PartialEq)]
pub struct WriteItem {
    /// The object to write.
    pub object: ObjectId,
    /// The property to write.
    pub property: PropertyRef,
    /// The value; `None` if it is not a single primitive value.
    pub value: Option<Data>,
    /// The priority in the request.
    pub priority: Option<u32>,
}

/// Parses a WriteProperty request.
///
/// # Errors
/// If the encoding is not valid.
pub fn write_property(data: &[u8]) -> Read<WriteItem> {
    let mut reader = Reader::new(data);
    let object = reader.context_object(0)?;
    let property = property_ref(&mut reader, 1, 2)?;
    let value = value(&mut reader, 3)?;
    let priority = reader.optional_u32(4)?;
    reader.end()?;
    Ok(WriteItem {
        object,
        property,
        value,
        priority,
    })
}

/// Parses a WritePropertyMultiple request.
///
/// # Errors
/// If the encoding is not valid.
pub fn write_property_multiple(data: &[u8]) -> Read<Vec<WriteItem>> {
    let mut reader = Reader::new(data);
    let mut all = Vec::new();
    while !reader.is_empty() {
        let object = reader.context_object(0)?;
        reader.open(1)?;
        while !reader.is_close(1) {
            let property = property_ref(&mut reader, 0, 1)?;
            let value = value(&mut reader, 2)?;
            let priority = reader.optional_u32(3)?;
            all.push(WriteItem {
                object,
                property,
                value,
                priority,
            });
        }
        reader.close(1)?;
    }
    if all.is_empty() {
        Err(Reject::MissingRequiredParameter)
    } else {
        Ok(all)
    }
}

/// The content between the tags of this context, if it is one primitive value.
fn value(reader: &mut Reader<'_>, number: u8) -> Read<Option<Data>> {
    reader.open(number)?;
    let mut values = Vec::new();
    let mut constructed = false;
    let mut depth = 0_usize;
    loop {
        match reader.peek()? {
            Tag::Close(close) if depth == 0 && close == number => break,
            Tag::Close(_) => {
                depth = depth.checked_sub(1).ok_or(Reject::InvalidTag)?;
                reader.tag()?;
            }
            Tag::Open(_) => {
                (depth, constructed) = (depth + 1, true);
                reader.tag()?;
            }
            _ => match reader.data()? {
                Some(data) if values.is_empty() => values.push(data),
                _ => constructed = true,
            },
        }
    }
    reader.close(number)?;
    Ok(values.pop().filter(|_| !constructed))
}

/// A subscription, or the end of one.
#[derive(Debug, Clone, PartialEq)]
pub struct Subscribe {
    /// The number that the client gives the subscription.
    pub process: u32,
    /// The object that is subscribed to.
    pub object: ObjectId,
    /// Whether notifications are confirmed, and the lifetime in seconds, 0 without end; `None` ends the subscription.
    pub terms: Option<(bool, u32)>,
    /// Property and increment, for SubscribeCOVProperty.
    pub property: Option<(PropertyRef, Option<f32>)>,
}

fn terms(confirmed: Option<bool>, lifetime: Option<u32>) -> Read<Option<(bool, u32)>> {
    match (confirmed, lifetime) {
        (None, None) => Ok(None),
        (Some(confirmed), lifetime) => Ok(Some((confirmed, lifetime.unwrap_or(0)))),
        (None, Some(_)) => Err(Reject::MissingRequiredParameter),
    }
}

/// Parses a SubscribeCOV request.
///
/// # Errors
/// If the encoding is not valid.
pub fn subscribe_cov(data: &[u8]) -> Read<Subscribe> {
    let mut reader = Reader::new(data);
    let (process, object) = (reader.context_u32(0)?, reader.context_object(1)?);
    let terms = terms(reader.optional_bool(2)?, reader.optional_u32(3)?)?;
    reader.end()?;
    Ok(Subscribe {
        process,
        object,
        terms,
        property: None,
    })
}

/// Parses a SubscribeCOVProperty request.
///
/// # Errors
/// If the encoding is not valid, or the increment is negative or not finite.
pub fn subscribe_cov_property(data: &[u8]) -> Read<Subscribe> {
    let mut reader = Reader::new(data);
    let (process, object) = (reader.context_u32(0)?, reader.context_object(1)?);
    let terms = terms(reader.optional_bool(2)?, reader.optional_u32(3)?)?;
    reader.open(4)?;
    let property = property_ref(&mut reader, 0, 1)?;
    reader.close(4)?;
    let increment = reader.optional_real(5)?;
    reader.end()?;
    if increment.is_some_and(|increment| !increment.is_finite() || increment < 0.0) {
        return Err(Reject::ParameterOutOfRange);
    }
    Ok(Subscribe {
        process,
        object,
        terms,
        property: Some((property, increment)),
    })
}

/// The request of DeviceCommunicationControl.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Control {
    /// Duration in minutes; `None` means without end.
    pub minutes: Option<u32>,
    /// 0 enable, 1 disable, 2 disable initiation.
    pub wanted: u32,
    /// The password in the request.
    pub password: Option<String>,
}

/// Parses a DeviceCommunicationControl request.
///
/// # Errors
/// If the encoding is not valid.
pub fn device_communication_control(data: &[u8]) -> Read<Control> {
    let mut reader = Reader::new(data);
    let minutes = reader.optional_u32(0)?;
    let wanted = u32_of(reader.context(1)?)?;
    let password = reader.optional(2)?.map(text_of).transpose()?;
    reader.end()?;
    match wanted {
        0..=2 => Ok(Control {
            minutes,
            wanted,
            password,
        }),
        _ => Err(Reject::UndefinedEnumeration),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::encoding::Writer;
    use crate::types::ObjectType;

    /// Example requests from annex F of the standard.
    #[test]
    fn requests_of_the_standard() {
        assert_eq!(who_is(&[0x09, 3, 0x19, 3]), Ok(Range(Some((3, 3)))));
        assert_eq!(who_is(&[]), Ok(Range(None)));
        let name = [0x3D, 7, 0, b'O', b'A', b'T', b'e', b'm', b'p'];
        assert_eq!(who_has(&name), Ok((Range(None), Sought::Name("OATemp".to_string()))));
        let read = read_property(&[0x0C, 0, 0, 0, 5, 0x19, 0x55]).unwrap();
        let property = PropertyRef {
            property: PropertyId::PRESENT_VALUE,
            index: None,
        };
        assert_eq!(read, (ObjectId::new(ObjectType::ANALOG_INPUT, 5), property));
        let write = [
            0x0C, 0, 0x80, 0, 1, 0x19, 0x55, 0x3E, 0x44, 0x43, 0x34, 0, 0, 0x3F, 0x49, 8,
        ];
        let item = write_property(&write).unwrap();
        assert_eq!((item.value, item.priority), (Some(Data::Real(180.0)), Some(8)));
        let cov = subscribe_cov(&[0x09, 18, 0x1C, 0, 0, 0, 10, 0x29, 1, 0x39, 0]).unwrap();
        assert_eq!((cov.process, cov.terms), (18, Some((true, 0))));
        let dcc = [0x09, 5, 0x19, 1, 0x2D, 8, 0, b'#', b'e', b'g', b'b', b'd', b'f', b'!'];
        let control = device_communication_control(&dcc).unwrap();
        assert_eq!(
            (control.minutes, control.wanted, control.password.as_deref()),
            (Some(5), 1, Some("#egbdf!"))
        );
    }

    #[test]
    fn a_value_that_is_not_one_primitive_is_told() {
        let request = |write: &dyn Fn(&mut Writer)| {
            let mut writer = Writer::default();
            writer
                .context_object(0, ObjectId::new(ObjectType::ANALOG_VALUE, 1))
                .context_unsigned(1, 85);
            writer.open(3);
            write(&mut writer);
            writer.close(3);
            write_property(writer.bytes()).map(|item| item.value)
        };
        assert_eq!(
            request(&|w| {
                w.real(1.0);
            }),
            Ok(Some(Data::Real(1.0)))
        );
        assert_eq!(
            request(&|w| {
                w.real(1.0).real(2.0);
            }),
            Ok(None)
        );
        assert_eq!(
            request(&|w| {
                w.open(3).real(2.0).close(3);
            }),
            Ok(None)
        );
        assert_eq!(request(&|_| ()), Ok(None));
        assert_eq!(
            request(&|w| {
                w.close(2);
            }),
            Err(Reject::InvalidTag)
        );
        assert_eq!(
            write_property(&[0x0C, 0, 0x80, 0, 1, 0x19, 0x55, 0x3E]),
            Err(Reject::MissingRequiredParameter)
        );
    }
}
