//! Modbus RTU frames: address, PDU, CRC-16 low byte first (reference/drives.md 1.2, worked frames section 7).

use super::checksum::crc16;
use super::modbus::{MAX_PDU, Reply, RequestPdu};
use super::{Decoded, Request};

/// Characters that a frame adds to its PDU: one of address and two of CRC.
pub const OVERHEAD: usize = 3;
/// Characters of the longest frame (MODBUS over Serial Line 1.02, 2.5.1).
pub const LONGEST: usize = MAX_PDU + OVERHEAD;

/// Appends `address`, `pdu` and CRC to `out` as one frame.
pub fn encode_frame(address: u8, pdu: &[u8], out: &mut Vec<u8>) {
    let start = out.len();
    out.push(address);
    out.extend_from_slice(pdu);
    end_frame(start, out);
}

/// Appends the CRC of the bytes in `out` from `start` on.
fn end_frame(start: usize, out: &mut Vec<u8>) {
    let crc = crc16(out.get(start..).unwrap_or_default());
    out.extend_from_slice(&crc.to_le_bytes());
}

/// Appends the request's frame to `out`.
pub fn encode_request(request: &Request, out: &mut Vec<u8>) {
    let start = out.len();
    out.push(request.address);
    request.pdu.encode(out);
    end_frame(start, out);
}

/// The address and PDU of a whole frame whose CRC is right.
pub fn open_frame(frame: &[u8]) -> Option<(u8, &[u8])> {
    let (body, crc) = frame.split_last_chunk::<2>()?;
    if body.len() < 2 || crc16(body) != u16::from_le_bytes(*crc) {
        return None;
    }
    let (&address, pdu) = body.split_first()?;
    Some((address, pdu))
}

/// Decodes `bytes` as the answer to `request`.
///
/// Decodes the reply to a request. Its own first bytes show where the reply ends, so no silence is needed: the
/// regular reply has a fixed length, an exception five characters, 43/14 counts its objects. A frame of another
/// drive or another function is measured in this way too, and dropped if its CRC is right. An impossible length is
/// refused as soon as it is announced. For a function that is not decoded the length is unknown: all bytes together
/// are its reply as soon as the CRC is right, and silence shows whether they were all.
pub fn decode_reply(request: &Request, bytes: &[u8]) -> Decoded {
    let begins_it = || bytes.starts_with(&[request.address, request.pdu.function()]);
    if matches!(request.pdu, RequestPdu::Other(_)) && begins_it() {
        return match open_frame(bytes) {
            Some((_, pdu)) => Decoded::Reply {
                used: bytes.len(),
                reply: Reply::Other(pdu.to_vec()),
            },
            None if bytes.len() < LONGEST => Decoded::Incomplete,
            None => Decoded::Corrupt("no end of a frame in the characters of the longest one"),
        };
    }
    let Some(len) = frame_len(request, bytes) else {
        return Decoded::Incomplete;
    };
    if len > LONGEST {
        return foreign_or(bytes, "the reply announces more than 256 characters");
    }
    let Some(frame) = bytes.get(..len) else {
        return Decoded::Incomplete;
    };
    let Some((address, pdu)) = open_frame(frame) else {
        return foreign_or(bytes, "check code is wrong");
    };
    if address != request.address {
        return Decoded::Foreign { used: len };
    }
    match Reply::decode(&request.pdu, pdu) {
        Ok(reply) => Decoded::Reply { used: len, reply },
        Err(_) => Decoded::Foreign { used: len },
    }
}

/// A frame whose length does not fit its function is valid, but not a reply.
fn foreign_or(bytes: &[u8], why: &'static str) -> Decoded {
    match open_frame(bytes) {
        Some(_) => Decoded::Foreign { used: bytes.len() },
        None => Decoded::Corrupt(why),
    }
}

/// Length of the frame at the start of `bytes`, once its first bytes show it; more than [`LONGEST`] if it cannot be
/// a frame.
fn frame_len(request: &Request, bytes: &[u8]) -> Option<usize> {
    let function = *bytes.get(1)?;
    let own = function == request.pdu.function();
    let pdu = match function {
        _ if function & 0x80 != 0 => 2,
        1..=4 | 23 => 2 + usize::from(*bytes.get(2)?),
        5 | 6 | 8 | 15 | 16 => 5,
        22 => 7,
        43 => return device_identification_len(bytes),
        _ if own => request.pdu.reply_len(),
        // The length of a function that was not requested is unknown, so the shortest frame is taken.
        _ => 2,
    };
    Some(pdu + OVERHEAD)
}

/// Length of a 43/14 reply. The reply has a header of seven bytes and then objects, each with id, length and text.
fn device_identification_len(bytes: &[u8]) -> Option<usize> {
    let objects = usize::from(*bytes.get(7)?);
    let mut at = 8;
    for missing in (1..=objects).rev() {
        // Each missing object needs at least two bytes.
        let least = at + 2 * missing + 2;
        if least > LONGEST {
            return Some(least);
        }
        at += 2 + usize::from(*bytes.get(at + 1)?);
    }
    Some(at + 2)
}

/// Whether requests of this function are decoded here, so that their length is known.
pub fn is_known(function: u8) -> bool {
    matches!(function, 1..=6 | 8 | 15 | 16 | 22 | 23 | 43)
}

/// Length of the first frame of a master in the bytes that a slave or a listener received.
///
/// Returns `None` while the frame is incomplete; the function code determines the length.
pub fn request_len(bytes: &[u8]) -> Option<usize> {
    let function = *bytes.get(1)?;
    let pdu = match function {
        15 | 16 => 6 + usize::from(*bytes.get(6)?),
        22 => 7,
        23 => 10 + usize::from(*bytes.get(10)?),
        43 => 4,
        _ => 5,
    };
    Some(pdu + OVERHEAD)
}

/// The request that a slave received, or its function and the exception that answers it.
pub type ReceivedPdu = Result<RequestPdu, (u8, super::Exception)>;

/// Decodes the request in a whole frame, as a slave does.
///
/// # Errors
/// `None` if the CRC is wrong: a slave does not answer. The exception and the function if the
/// PDU is refused.
pub fn decode_request(frame: &[u8]) -> Option<(u8, ReceivedPdu)> {
    let (address, pdu) = open_frame(frame)?;
    let function = *pdu.first()?;
    Some((address, RequestPdu::decode(pdu).map_err(|code| (function, code))))
}

#[cfg(test)]
mod tests {
    use super::super::modbus::{Exception, Table};
    use super::*;
    use proptest::prelude::*;

    fn hex(text: &str) -> Vec<u8> {
        text.split_whitespace()
            .map(|b| u8::from_str_radix(b, 16).unwrap())
            .collect()
    }

    fn read(table: Table, start: u16, count: u16) -> Request {
        Request {
            address: 1,
            pdu: RequestPdu::read(table, start, count),
            n2: Default::default(),
        }
    }

    fn write(start: u16, values: &[u16]) -> Request {
        Request {
            address: 1,
            pdu: RequestPdu::write_registers(start, values),
            n2: Default::default(),
        }
    }

    fn set(address: u16, value: u16) -> Request {
        Request {
            address: 1,
            pdu: RequestPdu::write_register(address, value),
            n2: Default::default(),
        }
    }

    fn encoded(request: &Request) -> Vec<u8> {
        let mut out = Vec::new();
        encode_request(request, &mut out);
        out
    }

    /// Checks the example requests of reference/drives.md, section 7 (without its misprints) and 7.4.
    #[test]
    fn requests_of_the_reference() {
        let coil = |address, on| Request {
            address: 1,
            pdu: RequestPdu::WriteCoil { address, on },
            n2: Default::default(),
        };
        let diag = |subfunction, data| Request {
            address: 1,
            pdu: RequestPdu::Diagnostics { subfunction, data },
            n2: Default::default(),
        };
        let cases = [
            (read(Table::Holding, 2000, 3), "01 03 07 D0 00 03 05 46"),
            (read(Table::Input, 2000, 1), "01 04 07 D0 00 01 31 47"),
            (set(2000, 1), "01 06 07 D0 00 01 48 87"),
            (write(2000, &[1, 16]), "01 10 07 D0 00 02 04 00 01 00 10 88 CF"),
            (read(Table::Input, 6000, 5), "01 04 17 70 00 05 34 66"),
            (
                write(2000, &[1, 0, 5000]),
                "01 10 07 D0 00 03 06 00 01 00 00 13 88 C8 CB",
            ),
            (read(Table::Input, 2102, 2), "01 04 08 36 00 02 93 A5"),
            (coil(0, true), "01 05 00 00 FF 00 8C 3A"),
            (read(Table::DiscreteInput, 2, 1), "01 02 00 02 00 01 18 0A"),
            (set(0, 1000), "01 06 00 00 03 E8 89 74"),
            (coil(0, false), "01 05 00 00 00 00 CD CA"),
            (read(Table::Coil, 0x042E, 1), "01 01 04 2E 00 01 9C F3"),
            (read(Table::Input, 2, 1), "01 04 00 02 00 01 90 0A"),
            (read(Table::Input, 100, 1), "01 04 00 64 00 01 70 15"),
            (set(301, 25), "01 06 01 2D 00 19 D9 F5"),
            (read(Table::Holding, 101, 1), "01 03 00 65 00 01 94 15"),
            (set(2000, 0), "01 06 07 D0 00 00 89 47"),
            (set(2000, 3), "01 06 07 D0 00 03 C9 46"),
            (set(2000, 4), "01 06 07 D0 00 04 88 84"),
            (set(2002, 5000), "01 06 07 D2 13 88 25 D1"),
            (set(2002, (-5000i16) as u16), "01 06 07 D2 EC 78 64 65"),
            (
                Request {
                    address: 0,
                    ..set(2000, 0)
                },
                "00 06 07 D0 00 00 88 96",
            ),
            (read(Table::Holding, 2100, 11), "01 03 08 34 00 0B 47 A3"),
            (read(Table::Holding, 2100, 1), "01 03 08 34 00 01 C7 A4"),
            (read(Table::Holding, 98, 1), "01 03 00 62 00 01 25 D4"),
            (read(Table::Holding, 732, 1), "01 03 02 DC 00 01 44 48"),
            (set(732, 2), "01 06 02 DC 00 02 C8 49"),
            (coil(1, true), "01 05 00 01 FF 00 DD FA"),
            (coil(2, true), "01 05 00 02 FF 00 2D FA"),
            (read(Table::DiscreteInput, 0, 5), "01 02 00 00 00 05 B8 09"),
            (diag(0, 0xA537), "01 08 00 00 A5 37 DA 8D"),
            (diag(4, 0), "01 08 00 04 00 00 A1 CA"),
            (diag(0x0B, 0), "01 08 00 0B 00 00 91 C9"),
        ];
        for (request, frame) in cases {
            assert_eq!(encoded(&request), hex(frame), "{request:?}");
            let frame = hex(frame);
            assert_eq!(request_len(&frame), Some(frame.len()), "{request:?}");
            assert_eq!(decode_request(&frame), Some((request.address, Ok(request.pdu))));
        }
    }

    /// Worked replies of reference/drives.md, section 7.
    #[test]
    fn replies_of_the_reference() {
        let status = vec![0x0023, 0x2000, 5000, 2500, 750, 12, 105, 53, 2000, 560, 0];
        let cases = [
            (
                read(Table::Input, 6000, 5),
                "01 84 02 C2 C1",
                Reply::Exception(Exception::ADDRESS),
            ),
            (write(2000, &[1, 0, 5000]), "01 10 07 D0 00 03 80 85", Reply::Written),
            (
                read(Table::Input, 2102, 2),
                "01 04 04 13 88 09 C4 78 E9",
                Reply::Registers(vec![5000, 2500]),
            ),
            (
                read(Table::Coil, 0x042E, 1),
                "01 81 02 C1 91",
                Reply::Exception(Exception::ADDRESS),
            ),
            (
                read(Table::DiscreteInput, 2, 1),
                "01 02 01 01 60 48",
                Reply::Bits(vec![true]),
            ),
            (
                read(Table::Input, 2, 1),
                "01 04 02 00 9C B9 59",
                Reply::Registers(vec![156]),
            ),
            (
                read(Table::Input, 100, 1),
                "01 04 02 00 01 78 F0",
                Reply::Registers(vec![1]),
            ),
            (
                read(Table::Holding, 101, 1),
                "01 03 02 00 32 39 91",
                Reply::Registers(vec![50]),
            ),
            (
                read(Table::Holding, 2100, 11),
                "01 03 16 00 23 20 00 13 88 09 C4 02 EE 00 0C 00 69 00 35 07 D0 02 30 00 00 11 05",
                Reply::Registers(status),
            ),
            (
                read(Table::Holding, 2100, 1),
                "01 03 02 00 03 F8 45",
                Reply::Registers(vec![3]),
            ),
            (
                read(Table::Holding, 98, 1),
                "01 03 02 00 35 78 53",
                Reply::Registers(vec![53]),
            ),
            (write(2000, &[1, 16]), "01 10 07 D0 00 02 41 45", Reply::Written),
            (set(2000, 7), "01 86 03 02 61", Reply::Exception(Exception::VALUE)),
            (write(2000, &[1]), "01 90 06 CC 02", Reply::Exception(Exception::BUSY)),
            (
                set(2000, 1),
                "01 86 04 43 A3",
                Reply::Exception(Exception::DEVICE_FAILURE),
            ),
            (
                read(Table::DiscreteInput, 0, 5),
                "01 02 01 07 E0 4A",
                Reply::Bits(vec![true, true, true, false, false]),
            ),
        ];
        for (request, frame, reply) in cases {
            let frame = hex(frame);
            for cut in 0..frame.len() {
                assert_eq!(
                    decode_reply(&request, &frame[..cut]),
                    Decoded::Incomplete,
                    "{request:?} cut at {cut}"
                );
            }
            assert_eq!(
                decode_reply(&request, &frame),
                Decoded::Reply {
                    used: frame.len(),
                    reply: reply.clone()
                }
            );
            let mut pdu = Vec::new();
            reply.encode(&request.pdu, &mut pdu);
            let mut out = Vec::new();
            encode_frame(1, &pdu, &mut out);
            assert_eq!(out, frame, "the slave's side of {request:?}");
        }
    }

    /// The misprinted frames whose CRC is valid must be rejected (reference/drives.md, section 7, 8).
    #[test]
    fn misprints_are_not_believed() {
        let cases = [
            (read(Table::Input, 6000, 5), "01 14 02 AE C1"),
            (read(Table::Input, 2102, 2), "01 04 02 13 88 09 C4 F0 E9"),
            (write(2000, &[1, 0, 5000]), "01 10 07 D0 00 F1 01"),
            (write(2000, &[1, 0, 5000]), "01 10 07 D0 00 03 F1 01"),
        ];
        for (request, frame) in cases {
            let decoded = decode_reply(&request, &hex(frame));
            assert!(!matches!(decoded, Decoded::Reply { .. }), "{request:?} {decoded:?}");
        }
    }

    #[test]
    fn foreign_frames_are_dropped_not_believed() {
        let request = read(Table::Holding, 2100, 1);
        let mut other_address = Vec::new();
        encode_frame(2, &[3, 2, 0, 3], &mut other_address);
        assert_eq!(decode_reply(&request, &other_address), Decoded::Foreign { used: 7 });
        let mut other_length = Vec::new();
        encode_frame(1, &[3, 4, 0, 3, 0, 4], &mut other_length);
        assert_eq!(decode_reply(&request, &other_length), Decoded::Foreign { used: 9 });
        let echo = encoded(&set(2000, 1));
        assert_eq!(decode_reply(&set(2000, 2), &echo), Decoded::Foreign { used: 8 });
    }

    #[test]
    fn a_length_that_no_frame_has_is_refused_at_once() {
        let too_long = Decoded::Corrupt("the reply announces more than 256 characters");
        let request = read(Table::Holding, 2100, 1);
        for function in [1, 2, 3, 4, 23] {
            assert_eq!(decode_reply(&request, &[1, function]), Decoded::Incomplete);
            // 251 bytes of data make a frame of 256 characters; no drive sends an odd count, as registers have two
            // bytes.
            assert_eq!(decode_reply(&request, &[1, function, 251]), Decoded::Incomplete);
            for count in [252, 255] {
                assert_eq!(decode_reply(&request, &[1, function, count]), too_long, "{function}");
                let mut bytes = vec![1, function, count, 7];
                assert_eq!(decode_reply(&request, &bytes), too_long);
                bytes.resize(LONGEST + 4, 0);
                assert_eq!(decode_reply(&request, &bytes), too_long);
                // A short frame whose third byte counts something else is someone's.
                let mut other = Vec::new();
                encode_frame(2, &[function, count, 7], &mut other);
                assert_eq!(decode_reply(&request, &other), Decoded::Foreign { used: 6 });
            }
        }
        let identify = Request::new(1, RequestPdu::DeviceIdentification { code: 1, object: 0 });
        let header = |objects| [1, 43, 14, 1, 1, 0, 0, objects];
        assert_eq!(decode_reply(&identify, &header(123)), Decoded::Incomplete);
        assert_eq!(decode_reply(&identify, &header(124)), too_long);
        // A single object may have 244 characters, which makes 256 with header, id, length and CRC.
        for (length, decoded) in [(244, Decoded::Incomplete), (245, too_long.clone())] {
            let bytes = [&header(1)[..], &[0, length]].concat();
            assert_eq!(decode_reply(&identify, &bytes), decoded, "{length}");
        }
        let text = [b'x'; 200];
        let bytes = [&header(2)[..], &[0, 200], &text, &[1, 43]].concat();
        assert_eq!(decode_reply(&identify, &bytes), too_long);
        let bytes = [&header(2)[..], &[0, 200], &text, &[1, 42]].concat();
        assert_eq!(decode_reply(&identify, &bytes), Decoded::Incomplete);
    }

    proptest! {
        #[test]
        fn no_bytes_panic_and_only_sound_frames_are_believed(
            bytes in prop::collection::vec(any::<u8>(), 0..300),
            start in any::<u16>(),
            count in 1u16..=125,
        ) {
            let request = read(Table::Holding, start, count);
            match decode_reply(&request, &bytes) {
                Decoded::Reply { used, .. } => prop_assert!(open_frame(&bytes[..used]).is_some()),
                Decoded::Incomplete => prop_assert!(bytes.len() < LONGEST),
                _ => {}
            }
            let _ = request_len(&bytes);
            let _ = decode_request(&bytes);
        }
    }
}
