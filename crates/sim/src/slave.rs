//! The drives of one line: whole frames in, replies out.
//!
//! A frame with a wrong check code gets no reply, unless a drive answers such frames; nor does a frame for another address
//! or a broadcast, which acts on all drives (reference/drives.md 3.10). When a frame begins and ends is the wire's
//! business, see [`half_duplex`](super::half_duplex).

use super::SimTime;
use super::framing;
use super::n2::{Board, BoardOptions, code_of, maps};
use super::simulated_drive::{DriveOptions, SimulatedDrive};
use drivegate_proto::modbus::encode_exception;
use drivegate_proto::n2::{Answer, Command};
use drivegate_proto::{Exception, Protocol, RequestPdu};
use std::collections::BTreeMap;

/// Address of a broadcast.
const BROADCAST: u8 = 0;

/// Meaning of a frame to the drives of a line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum FrameMeaning {
    /// The check code is wrong, or the bytes are not a frame.
    BadFrame,
    /// No drive with this address is on the line, or it is switched off.
    Nobody(u8),
    /// A broadcast, which the drives carried out.
    Broadcast,
    /// A request to one drive.
    Request(ReceivedRequest),
    /// The check code is wrong, and the drive whose address was received answers that by this exception.
    Damaged(ReceivedRequest, Exception),
}

/// A request that a drive of the line has to answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReceivedRequest {
    /// Protocol of the line.
    pub protocol: Protocol,
    /// The drive's address.
    pub address: u8,
    /// The function code in the frame.
    pub function: u8,
    /// The request, or the exception that a plain slave answers to the PDU.
    pub request: Result<RequestPdu, Exception>,
    /// The command on an N2 line, or the error code that refuses it.
    pub command: Option<Result<Command, u8>>,
    /// The PDU of the frame if it is not a valid request.
    pub malformed: Vec<u8>,
}

/// The drives of one line by address.
#[derive(Debug, Clone, Default)]
pub struct Slaves {
    drives: BTreeMap<u8, SimulatedDrive>,
    /// N2 boards of the drives, on an N2 line.
    boards: BTreeMap<u8, Board>,
    /// The drive that [`Slaves::advance_next`] last served.
    served: u8,
}

impl Slaves {
    /// Drives that are switched on at `now`. A later drive with an address already taken replaces the earlier one.
    pub fn new(drives: impl IntoIterator<Item = DriveOptions>, now: SimTime) -> Slaves {
        let mut slaves = Slaves::default();
        for options in drives {
            let (address, map) = (options.address, maps::of(&options.model));
            slaves.boards.insert(address, Board::new(map, now));
            slaves.drives.insert(address, SimulatedDrive::new(options, now));
        }
        slaves
    }

    /// Sets these options for all N2 boards.
    pub(crate) fn set_boards(&mut self, options: BoardOptions) {
        for board in self.boards.values_mut() {
            board.options = options;
        }
    }

    /// The N2 board of a drive.
    pub fn board(&mut self, address: u8) -> Option<&mut Board> {
        self.boards.get_mut(&address)
    }

    /// A drive of the line.
    pub fn drive(&mut self, address: u8) -> Option<&mut SimulatedDrive> {
        self.drives.get_mut(&address)
    }

    /// Whether any drive runs.
    pub(crate) fn any_runs(&self) -> bool {
        self.drives.values().any(|drive| drive.state().running)
    }

    /// Addresses on the line, ascending.
    pub fn addresses(&self) -> impl Iterator<Item = u8> {
        self.drives.keys().copied()
    }

    /// Advances all drives to `now`.
    pub fn advance(&mut self, now: SimTime) {
        self.drives.values_mut().for_each(|drive| drive.advance(now));
    }

    /// Advances one drive to `now`, and the next drive at the next call: a drive that is not polled is then nearly
    /// up to date when a request arrives.
    pub(crate) fn advance_next(&mut self, now: SimTime) {
        let next = self
            .drives
            .range(self.served.saturating_add(1)..)
            .next()
            .map(|(address, _)| *address);
        self.served = next.unwrap_or(0);
        if let Some(drive) = self.drives.get_mut(&self.served) {
            drive.advance(now);
        }
    }

    /// Reads a whole frame; a broadcast takes effect at once.
    pub fn hear(&mut self, protocol: Protocol, frame: &[u8], now: SimTime) -> FrameMeaning {
        if protocol == Protocol::N2 {
            return self.hear_n2(frame);
        }
        let Some((address, decoded)) = framing::open(protocol, frame) else {
            self.drives.values_mut().for_each(SimulatedDrive::bus_error);
            return self.hear_damaged(protocol, frame).unwrap_or(FrameMeaning::BadFrame);
        };
        self.drives.values_mut().for_each(SimulatedDrive::bus_message);
        if address == BROADCAST {
            self.broadcast(decoded.ok(), now);
            return FrameMeaning::Broadcast;
        }
        if !self.drives.get(&address).is_some_and(SimulatedDrive::answers) {
            return FrameMeaning::Nobody(address);
        }
        let function = match &decoded {
            Ok(request) => request.function(),
            Err((function, _)) => *function,
        };
        FrameMeaning::Request(ReceivedRequest {
            protocol,
            address,
            function,
            malformed: match decoded {
                Ok(_) => Vec::new(),
                Err(_) => framing::pdu(protocol, frame).unwrap_or_default(),
            },
            request: decoded.map_err(|(_, exception)| exception),
            command: None,
        })
    }

    /// The answer to a damaged frame by drives that report check errors. No manual specifies the address of such an
    /// answer: it carries the received address and function, and a broadcast gets none.
    fn hear_damaged(&self, protocol: Protocol, frame: &[u8]) -> Option<FrameMeaning> {
        let (address, function) = framing::damaged(protocol, frame)?;
        let drive = self.drives.get(&address).filter(|drive| drive.answers())?;
        let exception = drive.check_error()?;
        let asked = ReceivedRequest {
            protocol,
            address,
            function,
            malformed: Vec::new(),
            request: Err(exception),
            command: None,
        };
        Some(FrameMeaning::Damaged(asked, exception))
    }

    fn hear_n2(&self, frame: &[u8]) -> FrameMeaning {
        let Some((address, command)) = Command::decode(frame) else {
            return FrameMeaning::BadFrame;
        };
        if !self.drives.get(&address).is_some_and(SimulatedDrive::answers) {
            return FrameMeaning::Nobody(address);
        }
        FrameMeaning::Request(ReceivedRequest {
            protocol: Protocol::N2,
            address,
            function: 0,
            request: Err(Exception::FUNCTION),
            malformed: Vec::new(),
            command: Some(command),
        })
    }

    /// Lets the drive carry out the request and appends the frame of its reply to `out`. Nothing is appended if the
    /// drive stays silent.
    pub fn answer(&mut self, asked: &ReceivedRequest, now: SimTime, out: &mut Vec<u8>) {
        let Some(drive) = self.drives.get_mut(&asked.address) else {
            return;
        };
        if let (Some(command), Some(board)) = (&asked.command, self.boards.get_mut(&asked.address)) {
            drive.message_received(now);
            board.fed(drive.power_cycles(), now);
            board.answer(command, now, &mut |request| drive.answer(request, now), out);
            return;
        }
        match &asked.request {
            Ok(request) => {
                let mut pdu = Vec::with_capacity(request.reply_len());
                let Some(reply) = drive.answer(request, now) else {
                    return;
                };
                reply.encode(request, &mut pdu);
                framing::close(asked.protocol, asked.address, &pdu, out);
            }
            Err(exception) => {
                if let Some(exception) = drive.malformed(&asked.malformed, *exception, now) {
                    refuse(asked, exception, out);
                }
            }
        }
    }

    fn broadcast(&mut self, request: Option<RequestPdu>, now: SimTime) {
        for drive in self.drives.values_mut().filter(|drive| drive.answers()) {
            drive.message_received(now);
            if let Some(request) = &request {
                drive.broadcast_received(request, now);
            }
        }
    }
}

/// Appends the frame of an exception to `out`; the request does not reach the drive.
pub fn refuse(asked: &ReceivedRequest, exception: Exception, out: &mut Vec<u8>) {
    if asked.command.is_some() {
        Answer::Nak(code_of(exception)).encode(out);
        return;
    }
    let mut pdu = Vec::with_capacity(2);
    encode_exception(asked.function, exception, &mut pdu);
    framing::close(asked.protocol, asked.address, &pdu, out);
}

#[cfg(test)]
mod tests {
    use super::super::nx::{NxOptions, StatusBits};
    use super::super::simulated_drive::ModelOptions;
    use super::super::teco::TecoOptions;
    use super::*;
    use drivegate_proto::{ascii, rtu};
    use std::time::Duration;

    const RTU: Protocol = Protocol::ModbusRtu;

    fn hex(text: &str) -> Vec<u8> {
        text.split_whitespace()
            .map(|b| u8::from_str_radix(b, 16).unwrap())
            .collect()
    }

    /// A drive 1 with the status bits that the worked frames print.
    fn line() -> Slaves {
        let nx = NxOptions {
            status: StatusBits::Common,
            ..NxOptions::default()
        };
        Slaves::new(
            [DriveOptions {
                address: 1,
                model: ModelOptions::Nx(nx),
                autopilot: None,
            }],
            SimTime::ZERO,
        )
    }

    fn exchange(line: &mut Slaves, request: &str, seconds: u64) -> String {
        let now = Duration::from_secs(seconds);
        let mut out = Vec::new();
        if let FrameMeaning::Request(asked) = line.hear(RTU, &hex(request), now) {
            line.answer(&asked, now, &mut out);
        }
        out.iter().map(|b| format!("{b:02X}")).collect::<Vec<_>>().join(" ")
    }

    /// Worked frames of reference/drives.md 7.1 and 7.4, in an order in which the drive reaches their states.
    #[test]
    fn worked_frames() {
        let mut line = line();
        let script = [
            (1, "01 04 17 70 00 05 34 66", "01 84 02 C2 C1"),
            (
                1,
                "01 10 07 D0 00 03 06 00 01 00 00 13 88 C8 CB",
                "01 10 07 D0 00 03 80 85",
            ),
            (9, "01 04 08 36 00 02 93 A5", "01 04 04 13 88 09 C4 78 E9"),
            (
                9,
                "01 03 08 34 00 0B 47 A3",
                "01 03 16 00 23 20 00 13 88 09 C4 02 EE 00 0C 00 69 00 35 07 D0 02 30 00 00 11 05",
            ),
            (9, "01 03 07 D0 00 03 05 46", "01 03 06 00 01 00 00 13 88 11 E3"),
            (9, "01 06 07 D0 00 01 48 87", "01 06 07 D0 00 01 48 87"),
            (9, "01 10 07 D0 00 02 04 00 01 00 10 88 CF", "01 10 07 D0 00 02 41 45"),
            (9, "01 06 07 D2 EC 78 64 65", "01 06 07 D2 EC 78 64 65"),
            (9, "01 03 02 DC 00 01 44 48", "01 03 02 00 00 B8 44"),
            (9, "01 06 02 DC 00 02 C8 49", "01 06 02 DC 00 02 C8 49"),
            (9, "00 06 07 D0 00 00 88 96", ""),
            (20, "01 03 07 D0 00 01 84 87", "01 03 02 00 00 B8 44"),
            (20, "01 06 07 D0 00 01 48 87", "01 06 07 D0 00 01 48 87"),
            (21, "01 03 08 34 00 01 C7 A4", "01 03 02 00 07 F9 86"),
            // Silence for longer than 20 s and P2.7.22 = 2: stopped by ramp with fault 53.
            (50, "01 03 00 62 00 01 25 D4", "01 03 02 00 35 78 53"),
            (50, "01 05 00 00 FF 00 8C 3A", "01 85 01 83 50"),
            (50, "01 06 07 D2 27 11 F3 7B", "01 86 03 02 61"),
        ];
        for (seconds, request, reply) in script {
            assert_eq!(exchange(&mut line, request, seconds), reply, "{request} at {seconds} s");
        }
        line.drive(1)
            .unwrap()
            .as_nx()
            .unwrap()
            .set_busy(Duration::from_secs(99));
        assert_eq!(
            exchange(&mut line, "01 10 07 D0 00 02 04 00 01 00 10 88 CF", 51),
            "01 90 06 CC 02"
        );
    }

    #[test]
    fn silence_for_others_and_for_bad_frames() {
        let mut line = line();
        let good = hex("01 03 08 34 00 0B 47 A3");
        assert!(matches!(line.hear(RTU, &good, SimTime::ZERO), FrameMeaning::Request(_)));
        for bit in 0..good.len() * 8 {
            let mut bad = good.clone();
            bad[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(line.hear(RTU, &bad, SimTime::ZERO), FrameMeaning::BadFrame);
        }
        assert_eq!(line.hear(RTU, &good[..5], SimTime::ZERO), FrameMeaning::BadFrame);
        let mut other = Vec::new();
        rtu::encode_frame(2, &[3, 8, 0x34, 0, 11], &mut other);
        assert_eq!(line.hear(RTU, &other, SimTime::ZERO), FrameMeaning::Nobody(2));
        line.drive(1).unwrap().set_alive(false);
        assert_eq!(line.hear(RTU, &good, SimTime::ZERO), FrameMeaning::Nobody(1));
    }

    fn cx_and_teco() -> Slaves {
        let drive = |address, name| DriveOptions::new(address, ModelOptions::by_name(name).unwrap());
        Slaves::new([drive(1, "cx"), drive(2, "cx"), drive(3, "teco")], SimTime::ZERO)
    }

    fn framed(protocol: Protocol, address: u8, pdu: &[u8]) -> Vec<u8> {
        let mut frame = Vec::new();
        framing::close(protocol, address, pdu, &mut frame);
        frame
    }

    /// Sends a PDU to a drive in the framing of `protocol` and returns the PDU of its answer.
    fn ask(line: &mut Slaves, protocol: Protocol, address: u8, pdu: &[u8]) -> Vec<u8> {
        let mut out = Vec::new();
        if let FrameMeaning::Request(asked) = line.hear(protocol, &framed(protocol, address, pdu), SimTime::ZERO) {
            line.answer(&asked, SimTime::ZERO, &mut out);
        }
        framing::pdu(protocol, &out).unwrap_or_default()
    }

    /// reference/drives.md 4.6: the counters of a CX know of frames for others and of bad ones.
    #[test]
    fn every_drive_hears_the_line() {
        let mut line = cx_and_teco();
        let mut bad = framed(RTU, 1, &[2, 0, 0, 0, 1]);
        bad[2] ^= 1;
        assert_eq!(line.hear(RTU, &bad, SimTime::ZERO), FrameMeaning::BadFrame);
        ask(&mut line, RTU, 9, &[2, 0, 0, 0, 1]);
        ask(&mut line, RTU, 2, &[2, 0, 9, 0, 1]);
        ask(&mut line, RTU, 0, &[5, 0, 0, 0xFF, 0]);
        ask(&mut line, RTU, 1, &[0x55]);
        let mut counters = |address| line.drive(address).unwrap().as_cx().unwrap().counters();
        let (first, second) = (counters(1), counters(2));
        assert_eq!((first.bus_messages, first.bus_errors), (4, 1));
        assert_eq!((first.slave_messages, first.no_responses, first.exceptions), (2, 1, 1));
        assert_eq!(
            (second.slave_messages, second.no_responses, second.exceptions),
            (2, 1, 1)
        );
    }

    /// reference/drives.md 9.8: silence, or error 00H with the option.
    #[test]
    fn a_wrong_check_code_is_answered_by_none_but_a_teco_made_so() {
        let teco = |address, answer_check_error| {
            let options = TecoOptions {
                answer_check_error,
                ..TecoOptions::default()
            };
            DriveOptions::new(address, ModelOptions::Teco(options))
        };
        let cx = DriveOptions::new(3, ModelOptions::by_name("cx").unwrap());
        let mut line = Slaves::new([teco(1, true), teco(2, false), cx], SimTime::ZERO);
        let damaged = |protocol, address, pdu: &[u8]| {
            let mut frame = framed(protocol, address, pdu);
            let check = if protocol == RTU {
                frame.len() - 1
            } else {
                frame.len() - 3
            };
            frame[check] = if frame[check] == b'0' { b'1' } else { b'0' };
            frame
        };
        let ascii = Protocol::ModbusAscii;
        let read = [0x03, 0, 0x20, 0, 1];
        let FrameMeaning::Damaged(asked, exception) = line.hear(ascii, &damaged(ascii, 1, &read), SimTime::ZERO) else {
            panic!("silence")
        };
        let mut out = Vec::new();
        refuse(&asked, exception, &mut out);
        assert_eq!(ascii::open_frame(&out), Some((1, vec![0x83, 0x00])));
        // Valid frames are answered as usual.
        assert_eq!(ask(&mut line, ascii, 1, &[0x03, 0, 0x40, 0, 1]), [3, 2, 0, 10]);
        for (protocol, address) in [(ascii, 2), (ascii, 3), (ascii, 4), (ascii, 0), (RTU, 1)] {
            let heard = line.hear(protocol, &damaged(protocol, address, &read), SimTime::ZERO);
            assert_eq!(heard, FrameMeaning::BadFrame, "{protocol:?} {address}");
        }
        // The check code is verified first (reference/drives.md 5.6), so a message that lacks a byte fails there.
        // Bytes that are not a frame get no reply.
        let whole = damaged(ascii, 1, &read);
        let [short, odd] = [4, 5].map(|less| [&whole[..whole.len() - less], b"\r\n"].concat());
        assert!(matches!(
            line.hear(ascii, &short, SimTime::ZERO),
            FrameMeaning::Damaged(..)
        ));
        for broken in [&odd[..], &whole[..whole.len() - 1], &whole[1..], b":01\r\n", b":\r\n"] {
            assert_eq!(
                line.hear(ascii, broken, SimTime::ZERO),
                FrameMeaning::BadFrame,
                "{broken:?}"
            );
        }
        line.drive(1).unwrap().set_alive(false);
        assert_eq!(line.hear(ascii, &whole, SimTime::ZERO), FrameMeaning::BadFrame);
    }

    #[test]
    fn drives_that_stay_silent() {
        let mut line = cx_and_teco();
        assert!(ask(&mut line, RTU, 1, &[8, 0, 4, 0, 0]).is_empty(), "Listen Only Mode");
        assert!(ask(&mut line, RTU, 1, &[2, 0, 0, 0, 1]).is_empty());
        assert!(ask(&mut line, RTU, 1, &[0x55]).is_empty());
        let ascii = Protocol::ModbusAscii;
        assert!(
            ask(&mut line, ascii, 3, &[0x10, 0, 1, 0, 1, 2, 0]).is_empty(),
            "byte count"
        );
        assert_eq!(ask(&mut line, ascii, 3, &[0x10, 0, 1, 0, 2, 2, 0, 0]), [0x90, 3]);
        assert_eq!(ask(&mut line, ascii, 3, &[0x04, 0, 0x20, 0, 1]), [0x84, 1]);
        assert_eq!(ask(&mut line, ascii, 3, &[0x03, 0, 0x40, 0, 1]), [3, 2, 0, 10]);
    }
}
