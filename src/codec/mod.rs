//! Bytes on the wire to and from requests and replies: pure, without I/O and without a clock.
//!
//! On a half-duplex line a reply means something only against the outstanding request, so
//! [`Protocol::decode`] takes that request. Nothing can go stale between two exchanges.

mod checksum;
pub mod describe;
pub mod modbus;
pub mod rtu;
pub mod wire;

pub use checksum::crc16;
pub use modbus::{Exception, Reply, RequestPdu, Table};
pub use wire::{LineFormat, Parity};

use serde::{Deserialize, Serialize};

/// One request to one drive: who is asked, and what.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Request {
    /// Address of the drive on its bus, 1..=247 (0 is broadcast: no reply follows).
    pub address: u8,
    /// What is asked.
    pub pdu: RequestPdu,
}

/// What the bytes received so far are, seen against the outstanding request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Decoded {
    /// Not yet a whole frame; read on until the deadline.
    Incomplete,
    /// The reply to the request; `used` bytes belong to it.
    Reply {
        /// Bytes of the buffer that the frame takes.
        used: usize,
        /// What the drive said.
        reply: Reply,
    },
    /// A sound frame of somebody else (other address, function or length): drop `used` bytes and
    /// read on, the deadline stays.
    Foreign {
        /// Bytes of the buffer to drop.
        used: usize,
    },
    /// The bytes cannot become the reply any more (check code, impossible length): the exchange
    /// has failed, the schedule retries it once the line is silent.
    Corrupt(&'static str),
}

/// The protocols a bus can speak.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Protocol {
    /// Modbus RTU: binary frames, CRC-16, silence between frames.
    ModbusRtu,
}

impl Protocol {
    /// All protocols, in the order of the documentation.
    pub const ALL: [Protocol; 1] = [Protocol::ModbusRtu];

    /// The name in configuration and output.
    pub fn name(self) -> &'static str {
        match self {
            Protocol::ModbusRtu => "modbus-rtu",
        }
    }

    /// The protocol of that name.
    pub fn from_name(name: &str) -> Option<Protocol> {
        Protocol::ALL.into_iter().find(|p| p.name() == name)
    }

    /// The frame of `request`, appended to `out`.
    pub fn encode(self, request: &Request, out: &mut Vec<u8>) {
        match self {
            Protocol::ModbusRtu => rtu::encode_request(request, out),
        }
    }

    /// What `bytes` are as an answer to `request`.
    pub fn decode(self, request: &Request, bytes: &[u8]) -> Decoded {
        match self {
            Protocol::ModbusRtu => rtu::decode_reply(request, bytes),
        }
    }

    /// Characters on the wire of the request's frame.
    pub fn request_chars(self, request: &RequestPdu) -> usize {
        match self {
            Protocol::ModbusRtu => rtu::OVERHEAD + request.encoded_len(),
        }
    }

    /// Silence by which a drive knows that a request is over, before its turnaround begins.
    pub fn recognition(self, format: &LineFormat) -> std::time::Duration {
        match self {
            Protocol::ModbusRtu => format.silence_chars(),
        }
    }

    /// Characters on the wire of the regular (not exception) reply's frame.
    pub fn reply_chars(self, request: &RequestPdu) -> usize {
        match self {
            Protocol::ModbusRtu => rtu::OVERHEAD + request.reply_len(),
        }
    }
}
