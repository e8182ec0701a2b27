//! The bytes of a tool cut into its requests. Pure: time is an argument.
//!
//! A serial program writes a frame in pieces, and a network delivers it in lumps, so pauses within a frame mean
//! nothing: the end of a request is found by function, length and check code, in Modbus ASCII and N2 by the end
//! character. Silence only discards an incomplete frame. A frame of a function that is not decoded here is complete
//! when its check code is right and nothing follows.

use std::time::{Duration, Instant};

use super::request::ToolRequest;
use crate::arrivals::Arrivals;
use drivegate_core::order::Arrival;
use drivegate_proto::frames::{Frames, HIGHEST_ADDRESS};
use drivegate_proto::{LineFormat, Protocol};

/// Silence after an incomplete frame after which its rest is no longer expected: longer than the pauses of serial
/// programs and the delayed acknowledgements of TCP, shorter than the time after which tools repeat a request.
const HALF_FRAME: Duration = Duration::from_millis(250);

/// A message of a tool.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum ToolFrame {
    /// A valid request.
    Request(ToolRequest),
    /// Bytes that are not answered: a wrong check code, half a frame, no frame at all.
    Broken,
}

/// The bytes that are not cut yet.
#[derive(Debug)]
pub(super) struct Framing {
    protocol: Protocol,
    frames: Frames,
    arrivals: Arrivals,
    highest: u8,
    /// How the last message arrived, dated from its first byte.
    arrival: Option<Arrival>,
}

impl Framing {
    pub(super) fn new(protocol: Protocol, format: LineFormat) -> Framing {
        Framing {
            protocol,
            frames: Frames::new(protocol, format, HALF_FRAME),
            arrivals: Arrivals::default(),
            highest: HIGHEST_ADDRESS,
            arrival: None,
        }
    }

    /// Sets the highest address on the line.
    pub(super) fn set_highest_address(&mut self, highest: u8) {
        self.highest = highest;
        self.frames.set_highest_address(highest);
    }

    /// Adds bytes with this arrival that are read at `now`.
    pub(super) fn add(&mut self, bytes: &[u8], arrival: Arrival, now: Instant) {
        self.frames.add(bytes, now);
        self.arrivals.add(bytes.len(), arrival);
    }

    /// The next complete message of the tool at `now`.
    pub(super) fn next(&mut self, now: Instant) -> Option<ToolFrame> {
        loop {
            let piece = self.frames.next(None, now)?;
            self.arrival = self.arrivals.take(piece.bytes.len());
            if !self.is_blank(&piece.bytes) {
                return Some(match ToolRequest::of(self.protocol, &piece.bytes, self.highest) {
                    Some(request) => ToolFrame::Request(request),
                    None => ToolFrame::Broken,
                });
            }
        }
    }

    /// How the tool's last message arrived, dated from its first byte.
    pub(super) fn arrival(&self) -> Option<Arrival> {
        self.arrival.clone()
    }

    /// Whether the bytes are blanks and line feeds, which may occur between two lines.
    fn is_blank(&self, bytes: &[u8]) -> bool {
        self.protocol.is_text() && bytes.iter().all(u8::is_ascii_whitespace)
    }

    /// Time at which incomplete bytes are given up.
    pub(super) fn patience(&self) -> Option<Instant> {
        self.frames.patience()
    }

    /// Whether a request has started.
    pub(super) fn has_begun(&self) -> bool {
        let rest = self.frames.rest();
        !rest.is_empty() && !self.is_blank(rest)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::request::{Meaning, Refused};
    use super::*;
    use drivegate_proto::{Exception, RequestPdu, Table, ascii, rtu};

    fn add(framing: &mut Framing, bytes: &[u8], now: Instant) {
        framing.add(bytes, Arrival::now(now), now);
    }

    fn framing(protocol: Protocol) -> Framing {
        Framing::new(protocol, LineFormat::new(9600, "8N1").unwrap())
    }

    fn all(framing: &mut Framing, now: Instant) -> Vec<ToolFrame> {
        std::iter::from_fn(|| framing.next(now)).collect()
    }

    fn read(start: u16, count: u16) -> RequestPdu {
        let table = Table::Holding;
        RequestPdu::read(table, start, count)
    }

    fn asks(address: u8, start: u16, count: u16) -> ToolFrame {
        ToolFrame::Request(ToolRequest {
            address,
            function: 3,
            meaning: Meaning::Read(read(start, count)),
        })
    }

    fn framed(address: u8, pdu: &[u8]) -> Vec<u8> {
        let mut frame = Vec::new();
        rtu::encode_frame(address, pdu, &mut frame);
        frame
    }

    #[test]
    fn pauses_within_a_frame_decide_nothing() {
        let now = Instant::now();
        let mut framing = framing(Protocol::ModbusRtu);
        let frame = framed(1, &[3, 8, 52, 0, 11]);
        let mut at = now;
        for byte in &frame {
            assert_eq!(framing.next(at), None);
            add(&mut framing, &[*byte], at);
            at += Duration::from_millis(100);
        }
        assert_eq!(all(&mut framing, at), [asks(1, 2100, 11)]);
        assert!(!framing.has_begun());
    }

    #[test]
    fn half_and_broken_frames_are_given_up_and_the_next_request_is_found() {
        let now = Instant::now();
        let mut framing = framing(Protocol::ModbusRtu);
        let frame = framed(1, &[3, 8, 52, 0, 11]);
        add(&mut framing, &frame[..5], now);
        assert_eq!(framing.next(now), None);
        assert!(framing.has_begun());
        let until = framing.patience().unwrap();
        assert!(until >= now + HALF_FRAME && until < now + 2 * HALF_FRAME);
        assert_eq!(all(&mut framing, until), [ToolFrame::Broken]);
        let mut broken = frame.clone();
        broken[7] ^= 1;
        // The request follows a broken frame and half a frame without a pause.
        add(
            &mut framing,
            &[broken.as_slice(), &frame, &frame[..4], &frame].concat(),
            until,
        );
        let said = all(&mut framing, until);
        assert_eq!(
            said,
            [
                ToolFrame::Broken,
                asks(1, 2100, 11),
                ToolFrame::Broken,
                asks(1, 2100, 11)
            ]
        );
    }

    #[test]
    fn the_reserved_address_is_one_only_on_a_line_that_has_it() {
        let now = Instant::now();
        let pdu = [3, 8, 52, 0, 11];
        for protocol in [Protocol::ModbusRtu, Protocol::ModbusAscii] {
            for (highest, said) in [(HIGHEST_ADDRESS, ToolFrame::Broken), (248, asks(248, 2100, 11))] {
                let mut framing = framing(protocol);
                framing.set_highest_address(highest);
                let mut frame = Vec::new();
                protocol.encode_frame(248, &pdu, &mut frame);
                // A request that follows without a pause is found.
                protocol.encode_frame(1, &pdu, &mut frame);
                add(&mut framing, &frame, now);
                assert_eq!(
                    all(&mut framing, now),
                    [said, asks(1, 2100, 11)],
                    "{protocol:?} {highest}"
                );
            }
        }
    }

    #[test]
    fn a_function_that_is_not_decoded_is_whole_by_silence() {
        let now = Instant::now();
        let mut framing = framing(Protocol::ModbusRtu);
        add(&mut framing, &framed(1, &[0x41, 1, 2, 3]), now);
        assert_eq!(framing.next(now), None);
        let until = framing.patience().unwrap();
        assert!(until < now + Duration::from_millis(40), "sooner than half a frame");
        let Some(ToolFrame::Request(request)) = framing.next(until) else {
            panic!("no request")
        };
        assert_eq!(
            (request.address, request.meaning),
            (1, Meaning::Unchecked(RequestPdu::Other(vec![0x41, 1, 2, 3])))
        );
    }

    #[test]
    fn lines_of_ascii_and_n2() {
        let now = Instant::now();
        let mut framing = framing(Protocol::ModbusAscii);
        let mut line = Vec::new();
        ascii::encode_frame(3, &[3, 0, 32, 0, 4], &mut line);
        add(&mut framing, &[b"\r\n".as_slice(), &line[..7]].concat(), now);
        assert!(all(&mut framing, now).is_empty());
        add(&mut framing, &line[7..], now);
        add(&mut framing, &line, now);
        let mut broken = line.clone();
        broken[5] = b'7';
        add(&mut framing, &broken, now);
        assert_eq!(
            all(&mut framing, now),
            [asks(3, 32, 4), asks(3, 32, 4), ToolFrame::Broken]
        );
        // Lower case, and a function that is not decoded.
        add(&mut framing, &line.to_ascii_lowercase(), now);
        let mut unknown = Vec::new();
        ascii::encode_frame(3, &[0x41, 7], &mut unknown);
        add(&mut framing, &unknown, now);
        let said = all(&mut framing, now);
        assert_eq!(said[0], asks(3, 32, 4));
        assert!(
            matches!(&said[1], ToolFrame::Request(request) if request.function == 0x41),
            "{said:?}"
        );

        let mut framing = self::framing(Protocol::N2);
        add(&mut framing, b">0111020388\r\n", now);
        let input = RequestPdu::read(Table::Input, 2, 2);
        let said = all(&mut framing, now);
        assert!(
            matches!(&said[..], [ToolFrame::Request(ToolRequest { address: 1, meaning: Meaning::Read(pdu), .. })] if *pdu == input),
            "{said:?}"
        );
        assert!(!framing.has_begun(), "a line feed begins no request");
        add(&mut framing, b">0111020389\r", now);
        assert_eq!(
            all(&mut framing, now),
            [ToolFrame::Broken],
            "nobody answers a wrong checksum"
        );
    }

    #[test]
    fn what_a_drive_could_not_do_is_refused_as_a_drive_refuses_it() {
        for (pdu, code) in [
            (&[3, 0, 0, 0, 126][..], Exception::VALUE),
            (&[3, 255, 255, 0, 2], Exception::ADDRESS),
            (&[22, 0, 4, 0, 242, 0, 37], Exception::FUNCTION),
            (&[5, 0, 0, 1, 0], Exception::VALUE),
        ] {
            let request = ToolRequest::of(Protocol::ModbusRtu, &framed(7, pdu), HIGHEST_ADDRESS).unwrap();
            assert_eq!(request.meaning, Meaning::Faulty(Refused::Exception(code)), "{pdu:?}");
            let refusal = request.refusal(Protocol::ModbusRtu, Refused::Exception(code));
            assert_eq!(refusal, framed(7, &[pdu[0] | 0x80, code.code()]));
        }
        for (pdu, reads) in [
            (&[8, 0, 0, 1, 2][..], true),
            (&[8, 0, 11, 0, 0], true),
            (&[8, 0, 1, 0, 0], false),
            (&[8, 0, 4, 0, 0], false),
            (&[43, 14, 1, 0], true),
            (&[43, 13, 1, 0], false),
            (&[17], false),
        ] {
            let request = ToolRequest::of(Protocol::ModbusRtu, &framed(7, pdu), HIGHEST_ADDRESS).unwrap();
            assert_eq!(matches!(request.meaning, Meaning::Read(_)), reads, "{pdu:?}");
            assert_eq!(matches!(request.meaning, Meaning::Unchecked(_)), !reads, "{pdu:?}");
        }
        let exception = ToolRequest::of(Protocol::ModbusRtu, &framed(7, &[0x83, 2]), HIGHEST_ADDRESS);
        assert_eq!(exception, None, "a reply is no request");
    }

    proptest! {
        /// Property for any bytes in any pieces: memory is bounded, and a valid request after them is found.
        #[test]
        fn any_bytes_are_borne(
            bytes in prop::collection::vec(any::<u8>(), 0..600),
            size in 1..40usize,
            protocol in 0..3usize,
        ) {
            let protocol = Protocol::ALL[protocol];
            let mut framing = framing(protocol);
            let mut now = Instant::now();
            for piece in bytes.chunks(size) {
                add(&mut framing, piece, now);
                all(&mut framing, now);
                prop_assert!(framing.frames.rest().len() <= 1100);
                now += Duration::from_millis(3);
            }
            now += 2 * HALF_FRAME;
            all(&mut framing, now);
            prop_assert!(!framing.has_begun());
            let mut frame = Vec::new();
            match protocol {
                Protocol::N2 => frame.extend(*b">0111020388\r"),
                _ => protocol.encode_frame(9, &[3, 0, 1, 0, 2], &mut frame),
            }
            add(&mut framing, &frame, now);
            let said = all(&mut framing, now);
            prop_assert!(matches!(&said[..], [ToolFrame::Request(_)]), "{:?}", said);
        }
    }
}
