//! A capture of a line, as `drivegate replay` gets it.
//!
//! Input: the capture file.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use drivegate_bus::listener::Decoder;
use drivegate_proto::{LineFormat, Protocol};
use drivegate_core::history::capture;

pub(crate) fn run(data: &[u8]) {
    let packets = match capture::read(data) {
        Ok(capture) => capture.packets,
        Err(error) => {
            assert!(error.offset <= data.len(), "{error}");
            return;
        }
    };
    let bytes: usize = packets.iter().map(|packet| packet.bytes.len()).sum();
    assert!(bytes <= data.len() && packets.iter().all(|packet| !packet.bytes.is_empty()));
    // Cutting off the end must not affect the packets before it.
    if let Ok(cut) = capture::read(&data[..data.len() - 1]) {
        assert!(packets.starts_with(&cut.packets));
    }
    // Passes the packets to the listener.
    let began = Instant::now();
    let format = LineFormat::new(9600, "8N1").unwrap();
    for protocol in Protocol::ALL {
        let mut decoder = Decoder::new(protocol, format, BTreeMap::new());
        let (mut heard, mut last) = (Vec::new(), Duration::ZERO);
        for packet in &packets {
            last += Duration::from_millis(packet.at.subsec_millis().into());
            decoder.on_bytes(&packet.bytes, began + last, &mut heard);
        }
        decoder.on_time(began + last + Duration::from_secs(60), &mut heard);
    }
}
