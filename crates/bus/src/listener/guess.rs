//! Which protocol and character format a line has, from the bytes that a port set to 8 data bits or more receives. Pure: time is
//! an argument.
//!
//! A frame with a right check code does not come about by chance, so a few requests decide. Modbus ASCII with 7 data bits is seen
//! through a port set to 8N1, which has as many bits a character: bit 7 then holds the parity, or is the first of two stop bits.

use std::collections::BTreeMap;
use std::time::Instant;

use super::decoder::{Decoder, Exchange, Traffic};
use drivegate_proto::{LineFormat, Parity, Protocol};

/// Number of requests that decide the guess.
const ENOUGH: u64 = 3;

/// A protocol that is being tried.
#[derive(Debug)]
struct Try {
    protocol: Protocol,
    decoder: Decoder,
    requests: u64,
}

/// Listens with one setting of the port.
#[derive(Debug)]
pub struct Guess {
    format: LineFormat,
    tries: Vec<Try>,
    bytes: u64,
    /// Characters by parity of their 8 bits and whether bit 7 is set.
    even: u64,
    high: u64,
    heard: Vec<Traffic>,
}

impl Guess {
    /// A guess for a port that is set to `format`; all protocols of `protocols` are tried at the same time.
    pub fn new(format: LineFormat, protocols: &[Protocol]) -> Guess {
        let allowed = protocols.iter().filter(|protocol| protocol.allows(&format));
        let one = |protocol: &Protocol| Try {
            protocol: *protocol,
            decoder: Decoder::new(*protocol, format, BTreeMap::new()),
            requests: 0,
        };
        Guess {
            format,
            tries: allowed.map(one).collect(),
            bytes: 0,
            even: 0,
            high: 0,
            heard: Vec::new(),
        }
    }

    /// Processes bytes received at `now`.
    pub fn on_bytes(&mut self, bytes: &[u8], now: Instant) {
        self.bytes += bytes.len() as u64;
        self.even += bytes.iter().filter(|byte| byte.count_ones().is_multiple_of(2)).count() as u64;
        self.high += bytes.iter().filter(|byte| **byte >= 0x80).count() as u64;
        let masked: Vec<u8> = bytes.iter().map(|byte| byte & 0x7F).collect();
        for one in &mut self.tries {
            let bytes = if one.protocol == Protocol::ModbusAscii {
                &masked
            } else {
                bytes
            };
            one.decoder.on_bytes(bytes, now, &mut self.heard);
            let requests = self.heard.drain(..).filter(is_request).count();
            one.requests += requests as u64;
        }
    }

    /// Number of bytes received so far.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Protocol and format, once enough requests were received.
    pub fn found(&self) -> Option<(Protocol, LineFormat)> {
        let best = self.tries.iter().max_by_key(|one| one.requests)?;
        if best.requests < ENOUGH {
            return None;
        }
        let mut format = self.format;
        if best.protocol == Protocol::ModbusAscii && format.to_string().ends_with("8N1") && self.high > 0 {
            (format.data_bits, format.parity, format.stop_bits) = match () {
                () if self.high == self.bytes => (7, Parity::None, 2),
                () if self.even * 2 > self.bytes => (7, Parity::Even, 1),
                () => (7, Parity::Odd, 1),
            };
        }
        Some((best.protocol, format))
    }
}

fn is_request(heard: &Traffic) -> bool {
    matches!(heard, Traffic::Exchange(exchange) if is_sound(exchange))
}

fn is_sound(exchange: &Exchange) -> bool {
    exchange.request.is_some()
}
