//! MBAP framing: transaction id, protocol id 0, length, unit id, PDU.

use drivegate_proto::modbus::MAX_PDU;
use drivegate_proto::{ascii, rtu};

/// Bytes before the PDU: transaction id, protocol id, length, unit id.
pub(crate) const HEADER: usize = 7;
/// Maximum length of a frame.
pub(crate) const MAX_FRAME: usize = HEADER + MAX_PDU;
/// Offset of the length field, which counts unit id and PDU.
const LENGTH: usize = 4;

/// Transaction id and unit id of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Header {
    /// Transaction id; repeated in the reply.
    pub(crate) transaction: u16,
    /// Unit id.
    pub(crate) unit: u8,
}

/// A request frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Frame<'b> {
    pub(crate) header: Header,
    /// Function code.
    pub(crate) function: u8,
    /// Function code and data.
    pub(crate) pdu: &'b [u8],
    /// Length of the frame in the buffer.
    pub(crate) used: usize,
}

/// Bytes that are not Modbus TCP. The beginning of the next frame cannot be found, so the connection is closed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum NotModbus {
    #[error("protocol id {0} instead of 0")]
    Protocol(u16),
    #[error("length {0} instead of 2 to 254")]
    Length(u16),
    /// The client sends frames of a serial line, as a device server would pass them on.
    #[error(
        "the client speaks Modbus {0} over TCP; set it to Modbus TCP (MBAP), or let it use a tool slot of the bus \
         ([[bus.slot]]), which accepts serial frames"
    )]
    Serial(&'static str),
}

/// `NotModbus::Serial` if the first bytes of a connection that never sent a Modbus TCP frame are a complete serial
/// request.
pub(crate) fn of_serial_line(bytes: &[u8]) -> Option<NotModbus> {
    if bytes.first() == Some(&b':') {
        let whole = bytes.get(..ascii::request_len(bytes)?)?;
        return ascii::decode_request(whole).map(|_| NotModbus::Serial("ASCII"));
    }
    // A read from address 0 has the protocol id of Modbus TCP, and its number of registers passes for the length: of a frame that
    // is not complete yet, or of the shortest possible one. A complete longer one is not RTU, even if its check code fits.
    let whole = bytes.get(..rtu::request_len(bytes)?)?;
    let is_rtu = bytes.get(1).is_some_and(|function| rtu::is_known(*function)) && rtu::decode_request(whole).is_some();
    (is_rtu && !matches!(decode(bytes), Ok(Some(frame)) if frame.used > SHORTEST)).then_some(NotModbus::Serial("RTU"))
}

/// Length of a frame with only a function code: an RTU request for two registers from 0 looks like one.
const SHORTEST: usize = HEADER + 1;

/// The frame at the start of `bytes`; `None` while it is incomplete.
///
/// # Errors
/// If the header is invalid; reported as soon as that is recognised.
pub(crate) fn decode(bytes: &[u8]) -> Result<Option<Frame<'_>>, NotModbus> {
    if let [_, _, high, low, ..] = bytes
        && (*high, *low) != (0, 0)
    {
        return Err(NotModbus::Protocol(u16::from_be_bytes([*high, *low])));
    }
    let [
        transaction_high,
        transaction_low,
        _,
        _,
        length_high,
        length_low,
        rest @ ..,
    ] = bytes
    else {
        return Ok(None);
    };
    let length = u16::from_be_bytes([*length_high, *length_low]);
    if !(2..=MAX_PDU + 1).contains(&usize::from(length)) {
        return Err(NotModbus::Length(length));
    }
    let Some([unit, pdu @ ..]) = rest.get(..usize::from(length)) else {
        return Ok(None);
    };
    let header = Header {
        transaction: u16::from_be_bytes([*transaction_high, *transaction_low]),
        unit: *unit,
    };
    Ok(pdu.first().map(|function| Frame {
        header,
        function: *function,
        pdu,
        used: HEADER - 1 + usize::from(length),
    }))
}

/// Appends a frame; `pdu` writes its PDU.
pub(crate) fn encode(header: Header, out: &mut Vec<u8>, pdu: impl FnOnce(&mut Vec<u8>)) {
    let begin = out.len();
    out.extend_from_slice(&header.transaction.to_be_bytes());
    out.extend_from_slice(&[0, 0, 0, 0, header.unit]);
    pdu(out);
    let length = (out.len() - begin - (HEADER - 1)) as u16;
    if let Some(field) = out.get_mut(begin + LENGTH..begin + LENGTH + 2) {
        field.copy_from_slice(&length.to_be_bytes());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_frame_and_its_beginning() {
        // Transaction 0x1234, protocol 0, length 6, unit 17, read 3 holding registers from 107.
        let bytes = [0x12, 0x34, 0, 0, 0, 6, 17, 3, 0, 107, 0, 3, 0x99];
        for end in 0..12 {
            assert_eq!(decode(&bytes[..end]), Ok(None), "{end} bytes");
        }
        let frame = decode(&bytes).unwrap().unwrap();
        assert_eq!(
            frame.header,
            Header {
                transaction: 0x1234,
                unit: 17
            }
        );
        assert_eq!((frame.function, frame.pdu, frame.used), (3, &bytes[7..12], 12));
    }

    #[test]
    fn invalid_headers_are_recognised_early() {
        assert_eq!(decode(&[0, 1, 0, 7]), Err(NotModbus::Protocol(7)));
        assert_eq!(decode(b"GET / HTTP/1.1"), Err(NotModbus::Protocol(0x5420)));
        for length in [0, 1, 255, 65_535] {
            let [high, low] = u16::to_be_bytes(length);
            assert_eq!(decode(&[0, 1, 0, 0, high, low]), Err(NotModbus::Length(length)));
        }
        assert_eq!(decode(&[0, 1, 0, 0, 0, 254]), Ok(None));
    }

    #[test]
    fn requests_of_serial_lines() {
        let rtu = |address: u8, pdu: &[u8]| {
            let mut frame = Vec::new();
            rtu::encode_frame(address, pdu, &mut frame);
            frame
        };
        for frame in [
            // Requests from address 0 begin like Modbus TCP frames: 10 registers, 2 registers, 1 register.
            rtu(1, &[3, 0, 0, 0, 10]),
            rtu(1, &[3, 0, 0, 0, 2]),
            rtu(1, &[3, 0, 0, 0, 1]),
            rtu(17, &[4, 0x08, 0x34, 0, 11]),
            rtu(5, &[16, 0, 0, 0, 1, 2, 0, 1]),
            rtu(5, &[6, 0x07, 0xD0, 0, 1]),
        ] {
            for end in 0..frame.len() {
                assert_eq!(of_serial_line(&frame[..end]), None, "{end} bytes of {frame:02X?}");
            }
            assert_eq!(of_serial_line(&frame), Some(NotModbus::Serial("RTU")), "{frame:02X?}");
            let twice = [frame.clone(), frame].concat();
            assert_eq!(
                of_serial_line(&twice[..twice.len() - 1]),
                Some(NotModbus::Serial("RTU"))
            );
        }
        let mut line = Vec::new();
        ascii::encode_frame(1, &[3, 0, 0, 0, 2], &mut line);
        assert_eq!(of_serial_line(&line), Some(NotModbus::Serial("ASCII")));
        assert_eq!(of_serial_line(&line[..line.len() - 1]), None);
        assert_eq!(of_serial_line(b":\r\n"), None);
        assert_eq!(of_serial_line(b"GET / HTTP/1.1\r\n"), None);
    }

    #[test]
    fn no_request_of_modbus_tcp_is_taken_for_one_of_a_serial_line() {
        for transaction in 0..=u16::MAX {
            for unit in [0, 1, 17, 247, 255] {
                for pdu in [
                    &[3, 0, 0, 0, 1][..],
                    &[4, 0x80, 0, 0, 125],
                    &[6, 0, 1, 0, 1],
                    &[1, 0, 0, 0, 16],
                ] {
                    let mut frame = Vec::new();
                    encode(Header { transaction, unit }, &mut frame, |out| {
                        out.extend_from_slice(pdu)
                    });
                    assert_eq!(of_serial_line(&frame), None, "{frame:02X?}");
                }
            }
        }
    }

    proptest! {
        #[test]
        fn any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            let _ = of_serial_line(&bytes);
            if let Ok(Some(frame)) = decode(&bytes) {
                prop_assert!(frame.used <= bytes.len().min(MAX_FRAME));
            }
        }

        #[test]
        fn replies_are_frames(transaction: u16, unit: u8, pdu in prop::collection::vec(any::<u8>(), 1..=MAX_PDU)) {
            let mut out = vec![0xAA];
            encode(Header { transaction, unit }, &mut out, |out| out.extend_from_slice(&pdu));
            let frame = decode(&out[1..]).unwrap().unwrap();
            prop_assert_eq!(frame.header, Header { transaction, unit });
            prop_assert_eq!(frame.pdu, &pdu[..]);
        }
    }
}
