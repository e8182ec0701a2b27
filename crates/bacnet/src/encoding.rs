//! Tags and primitive values (clause 20.2).

mod reader;
mod writer;

pub use reader::{Read, Reader, Tag, text_of, u32_of};
pub use writer::Writer;

/// Application tag numbers.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::{Data, ObjectId, ObjectType};

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
