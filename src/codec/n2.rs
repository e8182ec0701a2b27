//! Metasys N2 (n2.md): the objects of a drive, mapped onto the tables of Modbus.
//!
//! | object | table | addresses | function |
//! |---|---|---|---|
//! | BI n | discrete input | n - 1 | read of attribute 2, the state is a bit of the status byte |
//! | BO n | coil | n - 1 | the same; written by override |
//! | AI n | input register | 2 (n - 1) and the next, float, high word first | read of attribute 3 |
//! | AO n | holding register | 2 (n - 1) and the next, float, high word first | read of attribute 3; written by override |
//! | ADI n | input register | 0x4000 + n - 1 | read of attribute 2 |

use std::time::Duration;

use super::modbus::RequestPdu;
use super::{Decoded, Request};

/// Least pause between two requests to the same drive (n2.md 4).
pub const GAP: Duration = Duration::from_millis(5);

/// Appends the request's frame to `out`.
pub fn encode_request(_request: &Request, _out: &mut Vec<u8>) {}

/// What `bytes` are as the answer to `request`.
pub fn decode_reply(_request: &Request, _bytes: &[u8]) -> Decoded {
    Decoded::Incomplete
}

/// Characters of the request's frame.
pub fn request_chars(_request: &RequestPdu) -> usize {
    12
}

/// Characters of the regular reply's frame.
pub fn reply_chars(_request: &RequestPdu) -> usize {
    14
}
