#![doc = include_str!("../README.md")]
#![warn(missing_docs)]

pub mod ascii;
pub mod checksum;
pub mod describe;
pub mod duration;
pub mod frames;
pub mod modbus;
pub mod n2;
pub mod rtu;
pub mod wire;

pub use checksum::{crc16, lrc};
pub use modbus::{Exception, Reply, RequestPdu, Table};
pub use n2::N2Options;
pub use wire::{LineFormat, Parity, Silence};

use std::time::Duration;

use serde::{Deserialize, Serialize};

/// One request to one drive: address and PDU.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Request {
    /// Address of the drive on its bus, 1..=247, on N2 up to 255 (0 is a broadcast, which gets no reply).
    pub address: u8,
    /// The request PDU.
    pub pdu: RequestPdu,
    /// The drive's N2 options; ignored by other protocols.
    pub n2: N2Options,
}

impl Request {
    /// A request to the drive at `address`, with default options.
    pub fn new(address: u8, pdu: RequestPdu) -> Request {
        Request {
            address,
            pdu,
            n2: N2Options::DEFAULT,
        }
    }
}

/// The bytes received so far, decoded against the outstanding request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Decoded {
    /// The frame is incomplete; more bytes are read until the deadline.
    Incomplete,
    /// The reply to the request; `used` bytes belong to its frame.
    Reply {
        /// Bytes of the buffer that the frame takes.
        used: usize,
        /// The reply that was decoded.
        reply: Reply,
    },
    /// A valid frame of another device or to another request (other address, function or length): drop `used` bytes
    /// and continue to read; the deadline is unchanged.
    Foreign {
        /// Bytes of the buffer to drop.
        used: usize,
    },
    /// The bytes cannot become the reply any more (check code, impossible length): the transaction has failed, and
    /// the schedule retries it once the line is silent.
    Corrupt(&'static str),
}

/// The protocols that a bus can use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Protocol {
    /// Modbus RTU: binary frames, CRC-16, silence between frames.
    ModbusRtu,
    /// Modbus ASCII: a colon, hexadecimal digits, LRC, CR LF.
    ModbusAscii,
    /// Metasys N2: ASCII text, sums of characters, CR; objects are mapped onto the tables of Modbus, see [`n2`].
    N2,
}

impl Protocol {
    /// All protocols, in the order of the documentation.
    pub const ALL: [Protocol; 3] = [Protocol::ModbusRtu, Protocol::ModbusAscii, Protocol::N2];

    /// The name in configuration and output.
    pub const fn name(self) -> &'static str {
        match self {
            Protocol::ModbusRtu => "modbus-rtu",
            Protocol::ModbusAscii => "modbus-ascii",
            Protocol::N2 => "n2",
        }
    }

    /// The protocol with this name.
    pub fn from_name(name: &str) -> Option<Protocol> {
        Protocol::ALL.into_iter().find(|p| p.name() == name)
    }

    /// Whether the protocol can be used with this character format: bytes of 8 bits for RTU, 9600 8N1 for N2.
    pub fn allows(self, format: &LineFormat) -> bool {
        match self {
            Protocol::ModbusRtu => format.data_bits == 8,
            Protocol::ModbusAscii => true,
            Protocol::N2 => format.to_string() == "9600 8N1",
        }
    }

    /// Time for the first byte of a reply where nothing else is configured.
    pub fn usual_timeout(self) -> Duration {
        match self {
            Protocol::ModbusRtu | Protocol::ModbusAscii => Duration::from_millis(100),
            Protocol::N2 => n2::RESPONSE_TIMEOUT,
        }
    }

    /// Appends the frame of `request` to `out`; nothing if the protocol has no such request.
    pub fn encode(self, request: &Request, out: &mut Vec<u8>) {
        match self {
            Protocol::ModbusRtu | Protocol::ModbusAscii if matches!(request.pdu, RequestPdu::N2(_)) => {}
            Protocol::ModbusRtu => rtu::encode_request(request, out),
            Protocol::ModbusAscii => ascii::encode_request(request, out),
            Protocol::N2 => n2::encode_request(request, out),
        }
    }

    /// Appends a frame with this PDU to `out`; nothing on N2, whose frames contain no PDU.
    pub fn encode_frame(self, address: u8, pdu: &[u8], out: &mut Vec<u8>) {
        match self {
            Protocol::ModbusRtu => rtu::encode_frame(address, pdu, out),
            Protocol::ModbusAscii => ascii::encode_frame(address, pdu, out),
            Protocol::N2 => {}
        }
    }

    /// Decodes `bytes` as an answer to `request`.
    pub fn decode(self, request: &Request, bytes: &[u8]) -> Decoded {
        match self {
            Protocol::ModbusRtu => rtu::decode_reply(request, bytes),
            Protocol::ModbusAscii => ascii::decode_reply(request, bytes),
            Protocol::N2 => n2::decode_reply(request, bytes),
        }
    }

    /// Number of characters at the start of `bytes` that cannot be part of a frame. With Modbus RTU and N2 that
    /// cannot be determined.
    pub fn noise(self, bytes: &[u8]) -> usize {
        match self {
            Protocol::ModbusAscii => ascii::noise(bytes),
            Protocol::ModbusRtu | Protocol::N2 => 0,
        }
    }

    /// Whether a reply from `address` that begins with this character may be accepted after garbage. Never on N2,
    /// whose replies have no address and a check code of only 8 bits.
    pub fn may_begin_behind_garbage(self, address: u8, character: u8) -> bool {
        match self {
            Protocol::ModbusRtu => character == address,
            Protocol::ModbusAscii => character == b':',
            Protocol::N2 => false,
        }
    }

    /// Whether invalid bytes begin like the reply to `request`, so that they are a damaged reply and not noise
    /// before it. An N2 reply shows nothing of its request, so there only the length counts.
    pub fn begins_reply(self, request: &Request, bytes: &[u8]) -> bool {
        let head = [request.address, request.pdu.function()];
        match self {
            Protocol::ModbusRtu => bytes.len() > 3 && bytes.starts_with(&head),
            Protocol::ModbusAscii => {
                let text: String = head.iter().map(|byte| format!("{byte:02X}")).collect();
                let begun = bytes
                    .iter()
                    .position(|byte| *byte == b':')
                    .and_then(|at| bytes.get(at + 1..));
                begun.is_some_and(|rest| rest.len() > 6 && rest.to_ascii_uppercase().starts_with(text.as_bytes()))
            }
            Protocol::N2 => bytes.len() >= n2::least_reply_chars(&request.pdu).max(5) - 1,
        }
    }

    /// The address and PDU of any valid Modbus frame; `None` on N2, whose frames have no PDU.
    pub fn open_frame(self, frame: &[u8]) -> Option<(u8, Vec<u8>)> {
        match self {
            Protocol::ModbusRtu => rtu::open_frame(frame).map(|(address, pdu)| (address, pdu.to_vec())),
            Protocol::ModbusAscii => ascii::open_frame(frame),
            Protocol::N2 => None,
        }
    }

    /// Whether the protocol's frames are text that people can read.
    pub fn is_text(self) -> bool {
        match self {
            Protocol::ModbusRtu => false,
            Protocol::ModbusAscii | Protocol::N2 => true,
        }
    }

    /// Characters on the wire of the request's frame.
    pub fn request_chars(self, request: &RequestPdu) -> usize {
        match self {
            Protocol::ModbusRtu => rtu::OVERHEAD + request.encoded_len(),
            Protocol::ModbusAscii => ascii::chars(request.encoded_len()),
            Protocol::N2 => n2::request_chars(request),
        }
    }

    /// Silence after which a drive considers a request complete and starts its turnaround.
    pub fn recognition(self, format: &LineFormat) -> Duration {
        match self {
            Protocol::ModbusRtu => format.silence_chars(),
            // ASCII and N2 frames end with a special character, so no silence is needed.
            Protocol::ModbusAscii | Protocol::N2 => Duration::ZERO,
        }
    }

    /// Silence before a request on a line with no other time settings than `silence`.
    pub fn silence(self, silence: Silence, format: &LineFormat) -> Duration {
        match (self, silence) {
            (Protocol::N2, Silence::Spec) => n2::GAP.max(format.silence_chars()),
            _ => silence.on(format),
        }
    }

    /// Characters on the wire of the shortest regular reply's frame, where replies of several lengths are regular.
    pub fn least_reply_chars(self, request: &RequestPdu) -> usize {
        match self {
            Protocol::ModbusRtu | Protocol::ModbusAscii => self.reply_chars(request),
            Protocol::N2 => n2::least_reply_chars(request),
        }
    }

    /// Characters on the wire of the (longest) regular reply's frame, not of an exception's.
    pub fn reply_chars(self, request: &RequestPdu) -> usize {
        match self {
            Protocol::ModbusRtu => rtu::OVERHEAD + request.reply_len(),
            Protocol::ModbusAscii => ascii::chars(request.reply_len()),
            Protocol::N2 => n2::reply_chars(request),
        }
    }
}
