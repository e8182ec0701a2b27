//! The payload of Sparkplug B as Protobuf messages, by the field numbers of the specification (version 3.0, section
//! 6.4). The derive of `prost` creates encoder and decoder from them, so neither `protoc` nor a build script is
//! needed.
//!
//! Fields that the gateway neither sends nor reads (metadata, data sets, templates) are absent: a decoder skips
//! unknown fields.

use prost::Message as _;

#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct Payload {
    /// When the message was sent, ms since 1970.
    #[prost(uint64, optional, tag = "1")]
    pub(super) timestamp: Option<u64>,
    #[prost(message, repeated, tag = "2")]
    pub(super) metrics: Vec<Metric>,
    /// 0 to 255; absent in deaths of nodes and in commands.
    #[prost(uint64, optional, tag = "3")]
    pub(super) seq: Option<u64>,
}

/// A metric, with its name, its alias or both, and with its value.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct Metric {
    #[prost(string, optional, tag = "1")]
    pub(super) name: Option<String>,
    #[prost(uint64, optional, tag = "2")]
    pub(super) alias: Option<u64>,
    /// When the value was read, ms since 1970.
    #[prost(uint64, optional, tag = "3")]
    pub(super) timestamp: Option<u64>,
    #[prost(uint32, optional, tag = "4")]
    pub(super) datatype: Option<u32>,
    #[prost(bool, optional, tag = "5")]
    pub(super) is_historical: Option<bool>,
    #[prost(bool, optional, tag = "7")]
    pub(super) is_null: Option<bool>,
    #[prost(message, optional, tag = "9")]
    pub(super) properties: Option<PropertySet>,
    #[prost(oneof = "MetricValue", tags = "10, 11, 12, 13, 14, 15")]
    pub(super) value: Option<MetricValue>,
}

/// The value of a metric. Signed integers are the two's complement.
#[derive(Clone, PartialEq, prost::Oneof)]
pub(super) enum MetricValue {
    #[prost(uint32, tag = "10")]
    Int(u32),
    #[prost(uint64, tag = "11")]
    Long(u64),
    #[prost(float, tag = "12")]
    Float(f32),
    #[prost(double, tag = "13")]
    Double(f64),
    #[prost(bool, tag = "14")]
    Boolean(bool),
    #[prost(string, tag = "15")]
    String(String),
}

/// Properties of a metric; there are as many keys as values.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct PropertySet {
    #[prost(string, repeated, tag = "1")]
    pub(super) keys: Vec<String>,
    #[prost(message, repeated, tag = "2")]
    pub(super) values: Vec<PropertyValue>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct PropertyValue {
    #[prost(uint32, optional, tag = "1")]
    pub(super) datatype: Option<u32>,
    #[prost(oneof = "PropertyContent", tags = "3, 6, 8")]
    pub(super) value: Option<PropertyContent>,
}

/// Content of a property, as far as the gateway uses it.
#[derive(Clone, PartialEq, prost::Oneof)]
pub(super) enum PropertyContent {
    #[prost(uint32, tag = "3")]
    Int(u32),
    #[prost(double, tag = "6")]
    Double(f64),
    #[prost(string, tag = "8")]
    String(String),
}

impl PropertySet {
    pub(super) fn push(&mut self, key: &str, datatype: DataType, value: PropertyContent) {
        self.keys.push(key.to_string());
        self.values.push(PropertyValue {
            datatype: Some(datatype.code()),
            value: Some(value),
        });
    }
}

impl Payload {
    pub(super) fn encoded(&self) -> Vec<u8> {
        self.encode_to_vec()
    }

    /// # Errors
    /// If the bytes are not a valid payload; contains the reason.
    pub(super) fn decoded(bytes: &[u8]) -> Result<Payload, String> {
        Payload::decode(bytes).map_err(|error| error.to_string())
    }
}

/// The data types of Sparkplug that are used or understood.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum DataType {
    Int32 = 3,
    Int64 = 4,
    UInt64 = 8,
    Double = 10,
    Boolean = 11,
    String = 12,
}

impl DataType {
    /// The code of the data type in metrics and properties.
    pub(super) fn code(self) -> u32 {
        self as u32
    }
}

/// Whether a data type is an unsigned integer: UInt8 to UInt64, DateTime.
pub(super) fn is_unsigned(datatype: u32) -> bool {
    matches!(datatype, 5..=8 | 13)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The test writes the bytes itself, from the field numbers of the specification.
    #[test]
    fn fields_have_the_published_numbers() {
        let mut properties = PropertySet::default();
        properties.push("Quality", DataType::Int32, PropertyContent::Int(500));
        let metric = Metric {
            name: Some("a".to_string()),
            alias: Some(7),
            timestamp: Some(1),
            datatype: Some(DataType::Boolean.code()),
            is_historical: Some(true),
            is_null: Some(true),
            properties: Some(properties),
            value: Some(MetricValue::Boolean(true)),
        };
        let payload = Payload {
            timestamp: Some(2),
            metrics: vec![metric],
            seq: Some(255),
        };
        let property = [0x08, 3, 0x18, 0xF4, 0x03];
        let mut set = vec![0x0A, 7];
        set.extend(*b"Quality");
        set.extend([0x12, property.len() as u8]);
        set.extend(property);
        let mut inner = vec![0x0A, 1, b'a', 0x10, 7, 0x18, 1, 0x20, 11, 0x28, 1, 0x38, 1];
        inner.extend([0x4A, set.len() as u8]);
        inner.extend(&set);
        inner.extend([0x70, 1]);
        let mut expected = vec![0x08, 2, 0x12, inner.len() as u8];
        expected.extend(&inner);
        expected.extend([0x18, 0xFF, 0x01]);
        assert_eq!(payload.encoded(), expected);
        assert_eq!(Payload::decoded(&expected), Ok(payload));
    }

    #[test]
    fn unknown_fields_are_skipped_and_garbage_is_an_error() {
        // A template (18) in a metric, and a uuid (4) in the payload.
        let bytes = [0x12, 5, 0x92, 0x01, 2, 0x08, 1, 0x22, 1, b'x', 0x18, 9];
        let payload = Payload::decoded(&bytes).unwrap();
        assert_eq!((payload.seq, payload.metrics.len()), (Some(9), 1));
        assert!(Payload::decoded(&[0x12, 200]).is_err());
    }
}
