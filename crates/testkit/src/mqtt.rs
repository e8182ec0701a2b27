//! Packets of MQTT 5, byte by byte, for brokers that behave as no broker does.

use std::io::Read;

/// The next MQTT packet: its first byte and its body. `None` when the connection ends.
pub fn read_packet(stream: &mut impl Read) -> Option<(u8, Vec<u8>)> {
    let mut byte = || {
        let mut byte = [0];
        stream.read_exact(&mut byte).ok()?;
        Some(byte[0])
    };
    let (kind, mut length, mut shift) = (byte()?, 0, 0);
    loop {
        let next = byte()?;
        length |= usize::from(next & 0x7F) << shift;
        shift += 7;
        if next & 0x80 == 0 {
            break;
        }
    }
    let mut body = vec![0; length];
    stream.read_exact(&mut body).ok()?;
    Some((kind, body))
}

/// The filters of a SUBSCRIBE without properties.
pub fn filters(subscribe: &[u8]) -> Vec<String> {
    // Packet id, length of the properties, then filters with a byte of options each.
    let (mut rest, mut filters) = (&subscribe[3..], Vec::new());
    while let [high, low, after @ ..] = rest {
        let (filter, next) = after.split_at(usize::from(u16::from_be_bytes([*high, *low])));
        filters.push(String::from_utf8(filter.to_vec()).unwrap());
        rest = &next[1..];
    }
    filters
}

/// The body of the SUBACK to a SUBSCRIBE, with a code for each filter.
pub fn subscribed(subscribe: &[u8], codes: &[u8]) -> Vec<u8> {
    [&subscribe[..2], &[0], codes].concat()
}
