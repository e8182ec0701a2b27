//! Captures for Wireshark: the classic pcap format, link type `RTAC_SERIAL`.
//!
//! Each packet is an event of a serial line with its direction, which the Modbus frame alone does not show; its
//! payload is decoded as Modbus RTU by `rtacser.data,mbrtu`. The alternative, a `USER` link type, has no direction
//! and shows nothing until it is configured.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use drivegate_core::process_image::Direction;

/// Link type LINKTYPE_RTAC_SERIAL of pcap files.
const LINK_TYPE: u32 = 250;
/// Largest packet that the file may hold.
const SNAP_LENGTH: u32 = 65_535;
/// Event types in the serial packet header.
const SENT: u8 = 1;
const RECEIVED: u8 = 2;
const LOST: u8 = 5;

/// A capture file that is being written.
#[derive(Debug)]
pub(super) struct Capture<W: Write> {
    out: BufWriter<W>,
    packets: u64,
}

impl Capture<File> {
    /// Creates the file; an existing file is emptied.
    ///
    /// # Errors
    /// If the file cannot be created or written.
    pub(super) fn create(path: &Path) -> io::Result<Capture<File>> {
        Capture::new(File::create(path)?)
    }
}

impl<W: Write> Capture<W> {
    fn new(out: W) -> io::Result<Capture<W>> {
        let mut out = BufWriter::with_capacity(16_384, out);
        let mut header = Vec::with_capacity(24);
        header.extend(0xA1B2_C3D4_u32.to_le_bytes()); // times in microseconds
        header.extend(2_u16.to_le_bytes()); // format 2.4
        header.extend(4_u16.to_le_bytes());
        header.extend([0; 8]); // time zone and accuracy: always 0
        header.extend(SNAP_LENGTH.to_le_bytes());
        header.extend(LINK_TYPE.to_le_bytes());
        out.write_all(&header)?;
        out.flush()?;
        Ok(Capture { out, packets: 0 })
    }

    /// Adds a frame to the capture.
    ///
    /// # Errors
    /// If the frame cannot be written to the file.
    pub(super) fn frame(&mut self, time: SystemTime, direction: Direction, bytes: &[u8]) -> io::Result<()> {
        let event = match direction {
            Direction::Request => SENT,
            Direction::Reply => RECEIVED,
        };
        self.packets += 1;
        self.packet(time, event, bytes)
    }

    /// Notes in the capture that frames are missing at this place.
    ///
    /// # Errors
    /// If the note cannot be written to the file.
    pub(super) fn lost(&mut self, time: SystemTime) -> io::Result<()> {
        self.packet(time, LOST, &[])
    }

    fn packet(&mut self, time: SystemTime, event: u8, bytes: &[u8]) -> io::Result<()> {
        let since = time.duration_since(UNIX_EPOCH).unwrap_or(Duration::ZERO);
        // The format ends in 2106.
        let seconds = u32::try_from(since.as_secs()).unwrap_or(u32::MAX);
        let micros = since.subsec_micros();
        let bytes = bytes.get(..SNAP_LENGTH as usize - 12).unwrap_or(bytes);
        let length = 12 + bytes.len() as u32;
        let mut packet = Vec::with_capacity(28 + bytes.len());
        for word in [seconds, micros, length, length] {
            packet.extend(word.to_le_bytes());
        }
        packet.extend(seconds.to_be_bytes());
        packet.extend(micros.to_be_bytes());
        packet.extend([event, 0, 0, 0]); // event, control lines, footer
        packet.extend_from_slice(bytes);
        // Written in one piece: the buffer is flushed only between packets, so the file can be read at any time.
        self.out.write_all(&packet)
    }

    /// Writes the added data to the file.
    ///
    /// # Errors
    /// If the buffered packets cannot be written to the file.
    pub(super) fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }

    /// Number of frames in the file.
    pub(super) fn packets(&self) -> u64 {
        self.packets
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_of_the_file() {
        let mut file = Vec::new();
        let mut capture = Capture::new(&mut file).unwrap();
        let at = UNIX_EPOCH + Duration::from_micros(0x6553_F100_u64 * 1_000_000 + 0x0001_0203);
        capture.frame(at, Direction::Request, &[0x01, 0x03, 0xAB]).unwrap();
        capture.frame(at, Direction::Reply, &[0x01]).unwrap();
        capture.lost(at).unwrap();
        assert_eq!(capture.packets(), 2);
        capture.flush().unwrap();
        drop(capture);
        let header = [
            &[0xD4, 0xC3, 0xB2, 0xA1][..], // magic: little-endian, microseconds
            &[2, 0, 4, 0],                 // version
            &[0; 8],                       // time zone, accuracy
            &[0xFF, 0xFF, 0, 0],           // snap length
            &[250, 0, 0, 0],               // link type
        ]
        .concat();
        let times = [0x00, 0xF1, 0x53, 0x65, 0x03, 0x02, 0x01, 0x00];
        let serial = [0x65, 0x53, 0xF1, 0x00, 0x00, 0x01, 0x02, 0x03];
        let packet = |event: u8, bytes: &[u8]| {
            let length = [12 + bytes.len() as u8, 0, 0, 0];
            [&times[..], &length, &length, &serial, &[event, 0, 0, 0], bytes].concat()
        };
        let expected = [
            header,
            packet(1, &[0x01, 0x03, 0xAB]),
            packet(2, &[0x01]),
            packet(5, &[]),
        ]
        .concat();
        assert_eq!(file, expected);
    }

    #[test]
    fn a_file_ends_at_a_packet_whenever_it_is_looked_at() {
        struct Pieces(Vec<usize>);
        impl Write for Pieces {
            fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
                self.0.push(bytes.len());
                Ok(bytes.len())
            }
            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let mut pieces = Pieces(Vec::new());
        let mut capture = Capture::new(&mut pieces).unwrap();
        for _ in 0..1000 {
            capture.frame(UNIX_EPOCH, Direction::Reply, &[0; 72]).unwrap();
        }
        drop(capture);
        assert_eq!(pieces.0[0], 24);
        assert!(pieces.0.len() > 3);
        assert!(pieces.0[1..].iter().all(|piece| piece % 100 == 0), "{:?}", pieces.0);
    }
}
