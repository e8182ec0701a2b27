//! The application layer's header (clause 20.1).

use crate::encoding::Writer;
use crate::types::{Abort, Error, Reject};

/// Longest message that fits into a datagram of BACnet/IP.
pub const MAX_APDU: usize = 1476;

/// The kinds and sizes of responses that a client accepts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Accepts {
    /// Maximum number of segments; `None` without segmentation.
    pub segments: Option<usize>,
    /// Longest message in octets.
    pub size: usize,
}

/// A message of the application layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Apdu<'a> {
    /// A request that must be answered.
    Confirmed {
        /// Whether the request comes in segments.
        segmented: bool,
        /// The longest reply and the segments that the client accepts.
        accepts: Accepts,
        /// The invoke id, by which the client finds the reply to its request.
        invoke: u8,
        /// Number of the requested service.
        service: u8,
        /// Parameters of the service, still encoded.
        data: &'a [u8],
    },
    /// A message that is not answered.
    Unconfirmed(u8, &'a [u8]),
    /// A request of ours was carried out.
    SimpleAck(u8),
    /// The answer to a request of the server.
    ComplexAck(u8),
    /// Acknowledgement of received segments.
    SegmentAck {
        /// Whether the sender acts as the server of the transaction.
        server: bool,
        /// The invoke id of the transaction whose segments are acknowledged.
        invoke: u8,
        /// Sequence number of the last received segment.
        sequence: u8,
        /// Number of segments that may follow before the next acknowledgement.
        window: u8,
    },
    /// Error answer to a request of the server.
    Error(u8),
    /// A request of ours was not understood.
    Reject(u8),
    /// A transaction was aborted.
    Abort {
        /// Whether the sender acts as the server of the transaction.
        server: bool,
        /// The invoke id of the transaction that ended.
        invoke: u8,
    },
}

impl Accepts {
    fn decode(segmented: bool, octet: u8) -> Accepts {
        let segments = match octet >> 4 & 7 {
            0 | 7 => usize::MAX,
            power => 1 << power,
        };
        let size = match octet & 0x0F {
            0 => 50,
            1 => 128,
            2 => 206,
            3 => 480,
            4 => 1024,
            _ => MAX_APDU,
        };
        Accepts {
            segments: segmented.then_some(segments),
            size,
        }
    }
}

/// Decodes a message; `None` if the bytes are not a valid message.
pub fn decode(bytes: &[u8]) -> Option<Apdu<'_>> {
    let (first, rest) = bytes.split_first()?;
    let flag = |bit: u8| first >> bit & 1 == 1;
    Some(match (first >> 4, rest) {
        (0, [accepts, invoke, rest @ ..]) => {
            let segmented = flag(3);
            let (service, data) = match (segmented, rest) {
                (true, [_, _, service, data @ ..]) | (false, [service, data @ ..]) => (*service, data),
                _ => return None,
            };
            Apdu::Confirmed {
                segmented,
                accepts: Accepts::decode(flag(1), *accepts),
                invoke: *invoke,
                service,
                data,
            }
        }
        (1, [service, data @ ..]) => Apdu::Unconfirmed(*service, data),
        (2, [invoke, _]) => Apdu::SimpleAck(*invoke),
        (3, [invoke, _, ..]) => Apdu::ComplexAck(*invoke),
        (4, [invoke, sequence, window]) => Apdu::SegmentAck {
            server: flag(0),
            invoke: *invoke,
            sequence: *sequence,
            window: *window,
        },
        (5, [invoke, _, ..]) => Apdu::Error(*invoke),
        (6, [invoke, _]) => Apdu::Reject(*invoke),
        (7, [invoke, _]) => Apdu::Abort {
            server: flag(0),
            invoke: *invoke,
        },
        _ => return None,
    })
}

/// A request of ours, which takes no segments as an answer.
pub fn confirmed(invoke: u8, service: u8, content: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0x00, 0x05, invoke, service];
    bytes.extend(content);
    bytes
}

/// A message that is not answered.
pub fn unconfirmed(service: u8, content: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0x10, service];
    bytes.extend(content);
    bytes
}

/// Acknowledgement that the request was carried out.
pub fn simple_ack(invoke: u8, service: u8) -> Vec<u8> {
    vec![0x20, invoke, service]
}

/// The answer to a request.
pub fn complex_ack(invoke: u8, service: u8, content: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0x30, invoke, service];
    bytes.extend(content);
    bytes
}

/// A segment of a segmented answer.
pub fn segment(invoke: u8, service: u8, (sequence, window): (u8, u8), more: bool, content: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0x38 | u8::from(more) << 2, invoke, sequence, window, service];
    bytes.extend(content);
    bytes
}

/// Octets of a segment before its content.
pub const SEGMENT_HEADER: usize = 5;

/// Answer to a request that failed.
pub fn error(invoke: u8, service: u8, error: Error) -> Vec<u8> {
    let mut writer = Writer::default();
    writer.raw(&[0x50, invoke, service]);
    writer.enumerated(error.class as u32).enumerated(error.code.into());
    writer.into_bytes()
}

/// Answer to a request that cannot be parsed.
pub fn reject(invoke: u8, reason: Reject) -> Vec<u8> {
    vec![0x60, invoke, reason as u8]
}

/// Message that ends a transaction.
pub fn abort(invoke: u8, reason: Abort) -> Vec<u8> {
    vec![0x71, invoke, reason as u8]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Example frames from annex F of the standard.
    #[test]
    fn frames_of_the_standard() {
        let read = [0x00, 0x00, 0x01, 0x0C, 0x0C, 0, 0, 0, 5, 0x19, 0x55];
        let accepts = Accepts {
            segments: None,
            size: 50,
        };
        let (segmented, invoke, service, data) = (false, 1, 12, &read[4..]);
        let wanted = Apdu::Confirmed {
            segmented,
            accepts,
            invoke,
            service,
            data,
        };
        assert_eq!(decode(&read), Some(wanted));
        assert_eq!(decode(&[0x10, 8]), Some(Apdu::Unconfirmed(8, &[])));
        assert_eq!(error(1, 12, Error::UNKNOWN_OBJECT), [0x50, 1, 12, 0x91, 1, 0x91, 31]);
        assert_eq!(simple_ack(3, 15), [0x20, 3, 15]);
        assert_eq!(segment(1, 14, (2, 4), true, &[9]), [0x3C, 1, 2, 4, 14, 9]);
        let accepts = Accepts {
            segments: Some(4),
            size: MAX_APDU,
        };
        assert_eq!(Accepts::decode(true, 0x25), accepts);
    }

    #[test]
    fn what_is_wrong_is_nothing() {
        for bytes in [
            &[][..],
            &[0x00, 5, 1],
            &[0x08, 5, 1, 0, 4],
            &[0x20, 1],
            &[0x40, 1, 1],
            &[0x80, 0, 0],
        ] {
            assert_eq!(decode(bytes), None, "{bytes:?}");
        }
    }
}
