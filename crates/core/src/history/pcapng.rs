//! The frames of a recording as a pcapng capture: link type `RTAC_SERIAL`, as `drivegate trace --pcap` writes it, each
//! frame with a comment. Pure.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use super::decoded::Decoder;
use super::export::moment;
use super::recording::{Frame, Recording};
use crate::process_image::Verdict;

/// Link type LINKTYPE_RTAC_SERIAL of pcap files.
const LINK_TYPE: u16 = 250;
/// Event types of the packet header.
const SENT: u8 = 1;
const RECEIVED: u8 = 2;
/// Block types of pcapng files.
const SECTION: u32 = 0x0A0D_0D0A;
const INTERFACE: u32 = 1;
const PACKET: u32 = 6;
/// Options: comment, name of the interface, software.
const COMMENT: u16 = 1;
const INTERFACE_NAME: u16 = 2;
const SOFTWARE: u16 = 4;

/// The recording as a pcapng capture. A timeout has no bytes, so it becomes the comment of an empty packet.
pub fn pcapng(recording: &Recording) -> Vec<u8> {
    let header = &recording.header;
    let mut out = Vec::new();
    let mut section = Vec::new();
    section.extend(0x1A2B_3C4D_u32.to_le_bytes());
    section.extend([1, 0, 0, 0]); // version 1.0
    section.extend(u64::MAX.to_le_bytes()); // section length: not specified
    option(&mut section, SOFTWARE, "drivegate");
    option(&mut section, COMMENT, &format!("{}: {}", header.id, header.summary));
    section.extend([0; 4]);
    block(&mut out, SECTION, &section);
    let mut interface = Vec::new();
    interface.extend(LINK_TYPE.to_le_bytes());
    interface.extend([0; 6]); // reserved, no limit of length
    option(&mut interface, INTERFACE_NAME, &header.bus.name);
    interface.extend([0; 4]);
    block(&mut out, INTERFACE, &interface);
    let start = humantime::parse_rfc3339(&header.time).ok();
    let mut decoder = Decoder::new(&header.bus.protocol);
    for frame in &recording.frames {
        let at = moment(start, frame.t).unwrap_or(UNIX_EPOCH);
        let comment = comment(recording, frame, &decoder.next(frame));
        block(&mut out, PACKET, &packet(at, frame.verdict, &frame.bytes, &comment));
    }
    out
}

fn packet(at: SystemTime, verdict: Verdict, bytes: &[u8], comment: &str) -> Vec<u8> {
    let since = at.duration_since(UNIX_EPOCH).unwrap_or(Duration::ZERO);
    let micros = u64::try_from(since.as_micros()).unwrap_or(u64::MAX);
    let event = if verdict == Verdict::Sent { SENT } else { RECEIVED };
    let seconds = u32::try_from(since.as_secs()).unwrap_or(u32::MAX);
    let length = u32::try_from(12 + bytes.len()).unwrap_or(u32::MAX);
    let mut packet = vec![0; 4]; // the only interface
    packet.extend(((micros >> 32) as u32).to_le_bytes());
    packet.extend((micros as u32).to_le_bytes());
    packet.extend(length.to_le_bytes());
    packet.extend(length.to_le_bytes());
    packet.extend(seconds.to_be_bytes());
    packet.extend(since.subsec_micros().to_be_bytes());
    packet.extend([event, 0, 0, 0]);
    packet.extend(bytes);
    pad(&mut packet);
    option(&mut packet, COMMENT, comment);
    packet.extend([0; 4]);
    packet
}

/// `+0.004 s, pump-1, request: read holding 2100..2110`.
fn comment(recording: &Recording, frame: &Frame, meaning: &str) -> String {
    let drives = &recording.header.bus.drives;
    let drive = frame.drive.and_then(|place| drives.get(place));
    let drive = drive.map_or("between two transactions", String::as_str);
    let verdict = match frame.verdict {
        Verdict::Sent => "request",
        Verdict::Ok => "ok",
        Verdict::Exception => "exception",
        Verdict::Timeout => "timeout",
        Verdict::Corrupt => "corrupt",
        Verdict::Foreign => "foreign",
    };
    let text = format!("{:+.6} s, {drive}, {verdict}: {meaning}", frame.t);
    text.trim_end_matches([' ', ':']).to_string()
}

fn block(out: &mut Vec<u8>, kind: u32, body: &[u8]) {
    let length = u32::try_from(body.len() + 12).unwrap_or(u32::MAX).to_le_bytes();
    out.extend(kind.to_le_bytes());
    out.extend(length);
    out.extend(body);
    out.extend(length);
}

fn option(out: &mut Vec<u8>, code: u16, text: &str) {
    let length = text.len().min(usize::from(u16::MAX));
    out.extend(code.to_le_bytes());
    out.extend((length as u16).to_le_bytes());
    out.extend(text.as_bytes().get(..length).unwrap_or_default());
    pad(out);
}

fn pad(out: &mut Vec<u8>) {
    while !out.len().is_multiple_of(4) {
        out.push(0);
    }
}
