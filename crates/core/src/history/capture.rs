//! Reads captures of serial lines: pcap and pcapng with link type `RTAC_SERIAL`, as `drivegate trace --pcap` and
//! `drivegate recordings export --pcap` write them, or with a `USER` link type, whose packets are bare bytes. Pure.

use std::time::Duration;

/// Link type LINKTYPE_RTAC_SERIAL of pcap files.
const RTAC_SERIAL: u32 = 250;
/// LINKTYPE_USER0 to USER15.
const USER: std::ops::RangeInclusive<u32> = 147..=162;
/// Header of RTAC_SERIAL in front of the bytes: time, event, control lines, footer.
const RTAC_HEADER: usize = 12;
/// Block types of pcapng files.
const SECTION: u32 = 0x0A0D_0D0A;
const INTERFACE: u32 = 1;
const SIMPLE: u32 = 3;
const PACKET: u32 = 6;
/// Option of an interface: resolution of its times.
const RESOLUTION: u16 = 9;
/// Longest plausible block or packet.
const LONGEST: usize = 1 << 20;

/// Bytes of a line that arrived together.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Packet {
    /// Time of the packet since 1970.
    pub at: Duration,
    /// Whether the bytes were sent; `at` is then the time when the port accepted them, otherwise the time of the
    /// last received byte.
    pub sent: bool,
    pub bytes: Vec<u8>,
}

/// Reason why a file is not a readable capture, and the offset of the fault.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{what}, at byte {offset}")]
pub struct CaptureError {
    /// Place of the error, counted from the beginning of the file.
    pub offset: usize,
    pub what: String,
}

fn error(offset: usize, what: impl Into<String>) -> CaptureError {
    CaptureError {
        offset,
        what: what.into(),
    }
}

/// The content of a capture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LineCapture {
    /// The packets with bytes, in the order of the file.
    pub packets: Vec<Packet>,
    /// Where the file is truncated or broken; everything before this place was read.
    pub broken: Option<CaptureError>,
}

/// Reads a capture up to its end or its first defect. Packets of interfaces other than serial lines are left out.
///
/// # Errors
/// If the file is not a capture of a serial line, or is broken before its first packet with bytes.
pub fn read(file: &[u8]) -> Result<LineCapture, CaptureError> {
    let mut packets = Vec::new();
    let read = match file.first_chunk::<4>() {
        None => Err(error(0, "the file is too short for a capture")),
        Some([0x0A, 0x0D, 0x0D, 0x0A]) => read_pcapng(file, &mut packets),
        Some(magic) => read_pcap(file, *magic, &mut packets),
    };
    let broken = read.err();
    match broken {
        Some(error) if packets.is_empty() => Err(error),
        broken => Ok(LineCapture { packets, broken }),
    }
}

/// A reader of numbers in the byte order of the file.
#[derive(Clone, Copy)]
struct Bytes<'f> {
    file: &'f [u8],
    big: bool,
}

impl Bytes<'_> {
    /// The bytes at that offset, the lowest first.
    fn number<const N: usize>(self, at: usize) -> Result<[u8; N], CaptureError> {
        let bytes = self.file.get(at..).and_then(|rest| rest.first_chunk());
        let mut bytes = *bytes.ok_or_else(|| error(at.min(self.file.len()), "the file ends in the middle"))?;
        if self.big {
            bytes.reverse();
        }
        Ok(bytes)
    }

    fn u32(self, at: usize) -> Result<u32, CaptureError> {
        self.number(at).map(u32::from_le_bytes)
    }

    fn u16(self, at: usize) -> Result<u16, CaptureError> {
        self.number(at).map(u16::from_le_bytes)
    }

    /// Checks that a length is plausible.
    fn length(self, at: usize) -> Result<usize, CaptureError> {
        let length = self.u32(at)? as usize;
        if length > LONGEST {
            return Err(error(at, format!("a length of {length} bytes is not plausible")));
        }
        Ok(length)
    }
}

fn read_pcap(file: &[u8], magic: [u8; 4], packets: &mut Vec<Packet>) -> Result<(), CaptureError> {
    let (big, nanos) = match magic {
        [0xA1, 0xB2, 0xC3, 0xD4] => (true, false),
        [0xD4, 0xC3, 0xB2, 0xA1] => (false, false),
        [0xA1, 0xB2, 0x3C, 0x4D] => (true, true),
        [0x4D, 0x3C, 0xB2, 0xA1] => (false, true),
        _ => return Err(error(0, "the file is neither pcap nor pcapng")),
    };
    let bytes = Bytes { file, big };
    let link = bytes.u32(20)? & 0xFFFF;
    check_link(link, 20)?;
    let mut at = 24;
    while at < file.len() {
        let (seconds, part) = (bytes.u32(at)?, bytes.u32(at + 4)?);
        let part = if nanos {
            Duration::from_nanos(part.into())
        } else {
            Duration::from_micros(part.into())
        };
        let length = bytes.length(at + 8)?;
        let data = part_of(file, at + 16, length)?;
        packets.extend(packet(link, Duration::from_secs(seconds.into()) + part, data, at + 16)?);
        at += 16 + length;
    }
    Ok(())
}

fn part_of(file: &[u8], from: usize, length: usize) -> Result<&[u8], CaptureError> {
    file.get(from..from + length)
        .ok_or_else(|| error(from.min(file.len()), "the file ends in the middle of a packet"))
}

fn check_link(link: u32, offset: usize) -> Result<(), CaptureError> {
    if link == RTAC_SERIAL || USER.contains(&link) {
        return Ok(());
    }
    Err(error(
        offset,
        format!("link type {link} is not a serial line; RTAC Serial is {RTAC_SERIAL}, bare bytes are 147 to 162"),
    ))
}

/// The content of a packet; `None` if the packet has no bytes.
fn packet(link: u32, at: Duration, data: &[u8], offset: usize) -> Result<Option<Packet>, CaptureError> {
    let (sent, bytes) = if link == RTAC_SERIAL {
        let event = data
            .get(8)
            .ok_or_else(|| error(offset, "a packet is shorter than its header"))?;
        let bytes = data.get(RTAC_HEADER..);
        let bytes = bytes.ok_or_else(|| error(offset, "a packet is shorter than its header"))?;
        // The events 1 to 4 are beginning and end of sending, and beginning and end of receiving; others are states of
        // the port.
        match event {
            1 | 3 => (true, bytes),
            2 | 4 => (false, bytes),
            _ => return Ok(None),
        }
    } else {
        (false, data)
    };
    Ok((!bytes.is_empty()).then(|| Packet {
        at,
        sent,
        bytes: bytes.to_vec(),
    }))
}

/// An interface of a capture section: its link type, and the number of ticks per second of its clock.
#[derive(Debug, Clone, Copy)]
struct Interface {
    link: u32,
    ticks: u64,
}

fn read_pcapng(file: &[u8], packets: &mut Vec<Packet>) -> Result<(), CaptureError> {
    let mut bytes = Bytes { file, big: false };
    let mut interfaces: Vec<Interface> = Vec::new();
    let mut not_serial = None;
    let mut at = 0;
    while at < file.len() {
        let begins_section = file.get(at..at + 4) == Some(&[0x0A, 0x0D, 0x0D, 0x0A]);
        if begins_section {
            bytes.big = match file.get(at + 8..at + 12) {
                Some([0x1A, 0x2B, 0x3C, 0x4D]) => true,
                Some([0x4D, 0x3C, 0x2B, 0x1A]) => false,
                Some(_) => return Err(error(at + 8, "the section has no byte order")),
                None => return Err(error(at, "the file ends in the middle of a block")),
            };
            interfaces.clear();
        }
        let (kind, length) = (bytes.u32(at)?, bytes.length(at + 4)?);
        if length < 12 || !length.is_multiple_of(4) {
            return Err(error(at + 4, format!("a block cannot have {length} bytes")));
        }
        let block = file
            .get(at..at + length)
            .ok_or_else(|| error(at, "the file ends in the middle of a block"))?;
        if bytes.u32(at + length - 4)? as usize != length {
            return Err(error(at + length - 4, "the two lengths of a block differ"));
        }
        match kind {
            SECTION => {}
            INTERFACE => interfaces.push(interface(bytes, at, length)?),
            PACKET => {
                let of = interfaces.get(bytes.u32(at + 8)? as usize).copied();
                let of = of.ok_or_else(|| error(at + 8, "a packet of an unknown interface"))?;
                if let Err(error) = check_link(of.link, at) {
                    not_serial.get_or_insert(error);
                    at += length;
                    continue;
                }
                let ticks = u64::from(bytes.u32(at + 12)?) << 32 | u64::from(bytes.u32(at + 16)?);
                let data = data_of(block, bytes.length(at + 20)?, 28, at)?;
                packets.extend(packet(of.link, time(ticks, of.ticks), data, at + 28)?);
            }
            SIMPLE => return Err(error(at, "a packet without a time; write the capture with times")),
            // Statistics, names, and what later versions have.
            _ => {}
        }
        at += length;
    }
    // Packets of other interfaces are an error only if the capture has no packet of a serial line.
    not_serial.filter(|_| packets.is_empty()).map_or(Ok(()), Err)
}

/// The data of a packet block, from offset `from` in the block.
fn data_of(block: &[u8], length: usize, from: usize, at: usize) -> Result<&[u8], CaptureError> {
    let room = block.len().saturating_sub(from + 4);
    if length > room {
        return Err(error(
            at + from - 8,
            format!("a packet of {length} bytes in a block with room for {room}"),
        ));
    }
    Ok(block.get(from..from + length).unwrap_or_default())
}

fn time(ticks: u64, in_a_second: u64) -> Duration {
    let in_a_second = in_a_second.max(1);
    let rest = u128::from(ticks % in_a_second) * 1_000_000_000 / u128::from(in_a_second);
    Duration::from_secs(ticks / in_a_second) + Duration::from_nanos(u64::try_from(rest).unwrap_or(0))
}

fn interface(bytes: Bytes<'_>, at: usize, length: usize) -> Result<Interface, CaptureError> {
    let link = u32::from(bytes.u16(at + 8)?);
    let mut ticks = 1_000_000;
    let (mut option, end) = (at + 16, at + length - 4);
    while option + 4 <= end {
        let (code, size) = (bytes.u16(option)?, usize::from(bytes.u16(option + 2)?));
        if code == RESOLUTION
            && let Some(resolution) = bytes.file.get(option + 4)
        {
            let exponent = u32::from(resolution & 0x7F);
            let base: u64 = if resolution & 0x80 == 0 { 10 } else { 2 };
            let too_fine = || error(option + 4, "the resolution of its times is too fine");
            ticks = base.checked_pow(exponent).ok_or_else(too_fine)?;
        }
        if code == 0 {
            break;
        }
        option += 4 + size.next_multiple_of(4);
    }
    Ok(Interface { link, ticks })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn pcap(link: u32, packets: &[(u32, u32, &[u8])]) -> Vec<u8> {
        let mut file = Vec::new();
        file.extend(0xA1B2_C3D4_u32.to_le_bytes());
        file.extend([2, 0, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xFF, 0xFF, 0, 0]);
        file.extend(link.to_le_bytes());
        for (seconds, micros, data) in packets {
            let length = data.len() as u32;
            for word in [*seconds, *micros, length, length] {
                file.extend(word.to_le_bytes());
            }
            file.extend(*data);
        }
        file
    }

    fn block(kind: u32, body: &[u8]) -> Vec<u8> {
        let length = (12 + body.len() as u32).to_le_bytes();
        [&kind.to_le_bytes()[..], &length, body, &length].concat()
    }

    #[test]
    fn packets_of_pcap() {
        let sent = [0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1, 3];
        let state = [0, 0, 0, 0, 0, 0, 0, 0, 5, 0, 0, 0];
        let file = pcap(250, &[(7, 5, &sent), (8, 0, &state)]);
        let packet = Packet {
            at: Duration::new(7, 5000),
            sent: true,
            bytes: vec![1, 3],
        };
        assert_eq!(read(&file).unwrap().packets, [packet]);
        let bare = read(&pcap(147, &[(1, 0, &[9])])).unwrap().packets;
        assert_eq!((bare[0].sent, bare[0].bytes.as_slice()), (false, &[9][..]));
    }

    #[test]
    fn packets_of_pcapng() {
        let section = block(
            SECTION,
            &[
                0x4D, 0x3C, 0x2B, 0x1A, 1, 0, 0, 0, 255, 255, 255, 255, 255, 255, 255, 255,
            ],
        );
        // Option 9 with value 9 means nanoseconds.
        let interface = block(
            INTERFACE,
            &[250, 0, 0, 0, 0, 0, 0, 0, 9, 0, 1, 0, 9, 0, 0, 0, 0, 0, 0, 0],
        );
        let ticks = 3_000_000_007_u64;
        let mut body = vec![0; 4];
        body.extend(((ticks >> 32) as u32).to_le_bytes());
        body.extend((ticks as u32).to_le_bytes());
        body.extend([13, 0, 0, 0, 13, 0, 0, 0]);
        body.extend([0, 0, 0, 0, 0, 0, 0, 0, 2, 0, 0, 0, 0xAB, 0, 0, 0]);
        let file = [section, interface, block(11, &[1, 2, 3, 4]), block(PACKET, &body)].concat();
        let packet = Packet {
            at: Duration::new(3, 7),
            sent: false,
            bytes: vec![0xAB],
        };
        assert_eq!(read(&file).unwrap().packets, [packet]);
        for end in 1..file.len() {
            if let Err(error) = read(&file[..end]) {
                assert!(error.offset <= end, "{error}");
            }
        }
        let cut = read(&file[..file.len() - 3]).unwrap_err();
        assert_eq!(cut.what, "the file ends in the middle of a block");
    }

    #[test]
    fn a_capture_that_was_cut_off_is_read_up_to_there() {
        let sent = [0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1, 3];
        let file = pcap(250, &[(7, 0, &sent), (8, 0, &sent)]);
        let read = read(&file[..file.len() - 1]).unwrap();
        assert_eq!(read.packets.len(), 1);
        assert_eq!(read.broken.unwrap().what, "the file ends in the middle of a packet");
    }

    #[test]
    fn another_interface_beside_the_line_is_left_out() {
        let magic = [
            0x4D, 0x3C, 0x2B, 0x1A, 1, 0, 0, 0, 255, 255, 255, 255, 255, 255, 255, 255,
        ];
        let interface = |link: u8| block(INTERFACE, &[link, 0, 0, 0, 0, 0, 0, 0]);
        let packet = |interface: u8| {
            let data = [0, 0, 0, 0, 0, 0, 0, 0, 2, 0, 0, 0, 0xAB, 0, 0, 0];
            block(
                PACKET,
                &[
                    &[interface, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 13, 0, 0, 0, 13, 0, 0, 0][..],
                    &data,
                ]
                .concat(),
            )
        };
        let section = block(SECTION, &magic);
        let both = [
            section.clone(),
            interface(1),
            interface(250),
            packet(0),
            packet(1),
            packet(0),
        ]
        .concat();
        let found = read(&both).unwrap();
        assert_eq!((found.packets.len(), found.broken), (1, None));
        assert_eq!(found.packets[0].bytes, [0xAB]);
        let none = [section, interface(1), packet(0)].concat();
        assert!(
            read(&none)
                .unwrap_err()
                .what
                .starts_with("link type 1 is not a serial line")
        );
    }

    #[test]
    fn what_is_no_capture_of_a_line_is_told_with_its_place() {
        let told = |file: &[u8]| read(file).unwrap_err().to_string();
        assert_eq!(told(b"PK"), "the file is too short for a capture, at byte 0");
        assert_eq!(told(b"time,drive"), "the file is neither pcap nor pcapng, at byte 0");
        assert!(told(&pcap(1, &[])).starts_with("link type 1 is not a serial line"));
        let mut long = pcap(250, &[(0, 0, &[0; 12])]);
        long[32..36].copy_from_slice(&[255, 255, 255, 0]);
        assert_eq!(told(&long), "a length of 16777215 bytes is not plausible, at byte 32");
        let short = pcap(250, &[(0, 0, &[0; 5])]);
        assert_eq!(told(&short), "a packet is shorter than its header, at byte 40");
    }

    proptest! {
        #[test]
        fn no_bytes_panic(mut file in prop::collection::vec(any::<u8>(), 0..200), head in 0usize..4) {
            let heads: [&[u8]; 4] = [
                &[0x0A, 0x0D, 0x0D, 0x0A, 28, 0, 0, 0, 0x4D, 0x3C, 0x2B, 0x1A],
                &[0xD4, 0xC3, 0xB2, 0xA1],
                &[0xA1, 0xB2, 0x3C, 0x4D],
                &[],
            ];
            file.splice(0..0, heads[head].iter().copied());
            let _ = read(&file);
        }
    }
}
