//! Modbus ASCII in both directions: answers that a drive may send to a request, frames that a slave may receive,
//! and a whole transaction.
//!
//! Input: a byte of choices; length and bytes of a request PDU; then the bytes from the line. One choice makes the
//! line consist of valid frames, one from each 16 bytes, because the fuzzer would otherwise hardly get past the
//! digits and the check code. The exchange gets the line in pieces of 1 to 16 characters.

use std::time::{Duration, Instant};

use drivegate_bus::transaction::{Ended, Step, Transaction};
use drivegate_proto::ascii::{
    LONGEST, decode_reply, decode_request, encode_frame, encode_request, noise, open_frame, request_len,
};
use drivegate_proto::{Decoded, Protocol, Request, RequestPdu, describe};

const SOUND: u8 = 1;
const OWN_ADDRESS: u8 = 2;
const ECHO: u8 = 4;
const LOWER: u8 = 8;

pub(crate) fn run(data: &[u8]) {
    let [choices, length, rest @ ..] = data else { return };
    let (pdu, line) = rest.split_at(usize::from(*length).min(rest.len()));
    let mut made = Vec::new();
    let line = if choices & SOUND != 0 {
        for (place, part) in line.chunks(16).enumerate() {
            match part.split_first() {
                Some((address, pdu)) if address % 8 != 7 => {
                    let address = if choices & OWN_ADDRESS != 0 { 1 } else { *address };
                    encode_frame(address, pdu, &mut made);
                }
                _ if place % 2 == 0 => made.extend_from_slice(part),
                _ => drop(made.pop()),
            }
        }
        if choices & LOWER != 0 {
            made.make_ascii_lowercase();
        }
        made.as_slice()
    } else {
        line
    };
    slave(line);
    if let Ok(pdu) = RequestPdu::decode(pdu) {
        let request = Request::new(1, pdu);
        master(&request, line);
        exchange(&request, line, usize::from(choices >> 4) + 1, choices & ECHO != 0);
    }
}

fn slave(line: &[u8]) {
    assert!(noise(line) <= line.len());
    let whole = request_len(line).map_or(line, |length| &line[..length]);
    let Some((address, decoded)) = decode_request(whole) else { return };
    assert!(open_frame(whole).is_some() && whole.ends_with(b"\r\n"));
    if let Ok(pdu) = decoded {
        let mut again = Vec::new();
        encode_request(&Request::new(address, pdu.clone()), &mut again);
        assert_eq!(decode_request(&again), Some((address, Ok(pdu))));
    }
}

fn master(request: &Request, line: &[u8]) {
    match decode_reply(request, line) {
        Decoded::Reply { used, .. } => {
            assert!(line[..used].ends_with(b"\r\n"));
            assert_eq!(open_frame(&line[..used]).map(|(address, _)| address), Some(1));
            // A frame is decoded alike whatever follows it, in upper and lower case.
            assert_eq!(decode_reply(request, &line[..used]), decode_reply(request, line));
            assert_eq!(decode_reply(request, &line[..used].to_ascii_lowercase()), decode_reply(request, line));
        }
        Decoded::Foreign { used } => assert!((1..=line.len()).contains(&used) && open_frame(&line[..used]).is_some()),
        Decoded::Incomplete => assert!(line.len() - noise(line) < LONGEST, "a frame ends"),
        Decoded::Corrupt(why) => assert!(!why.is_empty()),
    }
}

fn exchange(request: &Request, line: &[u8], chunk: usize, echo: bool) {
    let protocol = Protocol::ModbusAscii;
    let mut frame = Vec::new();
    protocol.encode(request, &mut frame);
    let begun = Instant::now();
    let (timeout, reply) = (Duration::from_millis(100), Duration::from_millis(20));
    let deadline = begun + timeout + reply;
    let mut transaction = Transaction::new(protocol, request.clone(), frame.clone(), begun, timeout, reply, echo);
    let mut now = begun;
    let mut step = transaction.on_time(now);
    for piece in line.chunks(chunk) {
        now += Duration::from_micros(300);
        let Step::Wait(until) = step else { break };
        assert!(until <= deadline);
        step = if now >= until { transaction.on_time(until) } else { transaction.on_bytes(now, piece) };
    }
    if let Step::Wait(until) = step {
        assert!(until <= deadline);
        step = transaction.on_time(until);
    }
    let Step::Done(ended) = step else { panic!("it waits beyond what it said") };
    let answered = matches!(ended, Ended::Reply(_));
    let mut at = 0;
    for part in describe::parts(protocol, request, &frame, line, answered) {
        assert!(part.range.start == at && part.range.end > at);
        at = part.range.end;
        let bytes = &line[part.range];
        assert!(!describe::reply(protocol, request, bytes).is_empty() && !describe::text(bytes).is_empty());
    }
    assert_eq!(at, line.len());
}
