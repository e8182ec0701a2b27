//! Exchanges in Modbus ASCII.

use super::*;

/// A read of two registers in Modbus ASCII with its frame and its reply.
pub(super) fn in_ascii() -> (Request, Vec<u8>, &'static [u8]) {
    let pdu = RequestPdu::read(Table::Holding, 0x20, 2);
    let request = Request::new(1, pdu);
    let mut frame = Vec::new();
    Protocol::ModbusAscii.encode(&request, &mut frame);
    (request, frame, b":01030400050000F3\r\n")
}

pub(super) fn start_ascii(request: &Request, frame: &[u8], now: Instant, echo: bool) -> Transaction {
    let ms = Duration::from_millis;
    let (request, frame) = (request.clone(), frame.to_vec());
    Transaction::new(Protocol::ModbusAscii, request, frame, now, ms(100), ms(19), echo)
}

#[test]
fn an_ascii_reply_is_found_behind_noise_foreign_frames_and_broken_ones() {
    let (request, frame, reply) = in_ascii();
    let now = Instant::now();
    let truth = Step::Done(Ended::Reply(Reply::Registers(vec![5, 0])));
    for before in [
        b"".as_slice(),
        b"\xFF\x00\x7F",
        b":0103",
        b":\xFF:!",
        b"\n\r\n",
        b":0203040005000BE7\r\n",
        b":01030400050000F4\r\n",
        b":01030400050000F\r\n",
        b":0103040005\xB0\r\n",
    ] {
        for chunk in [1, 3, 100] {
            let mut transaction = start_ascii(&request, &frame, now, false);
            let bytes = [before, reply, b":"].concat();
            let mut step = Step::Wait(now);
            let mut pieces = bytes.chunks(chunk);
            while let (Step::Wait(_), Some(piece)) = (&step, pieces.next()) {
                step = transaction.on_bytes(now, piece);
            }
            assert_eq!(step, truth, "{:?} by {chunk}", String::from_utf8_lossy(before));
        }
    }
    // An exception after a broken frame is not accepted, because it is short.
    let mut transaction = start_ascii(&request, &frame, now, false);
    let bytes = b":01030400050000F4\r\n:0183027A\r\n";
    assert!(matches!(transaction.on_bytes(now, bytes), Step::Wait(_)));
}

#[test]
fn a_broken_ascii_reply_says_why_and_does_not_wait_for_the_deadline() {
    let (request, frame, reply) = in_ascii();
    let now = Instant::now();
    let deadline = now + Duration::from_millis(119);
    for (bytes, why) in [
        (b":01030400050000F4\r\n".as_slice(), "check code (LRC) is wrong"),
        (b":0103040005000F4\r\n", "an odd number of hexadecimal digits"),
        (
            b":01030400050000F3\n",
            "a line feed without a carriage return before it",
        ),
        (
            b":0103\xB40005",
            "a character has bit 7 set: noise, or the data bits and parity are not the drive's",
        ),
    ] {
        let mut transaction = start_ascii(&request, &frame, now, false);
        let Step::Wait(until) = transaction.on_bytes(now, bytes) else {
            panic!("it ends at once")
        };
        assert!(until < deadline, "{why}");
        assert_eq!(transaction.on_time(until), Step::Done(Ended::Corrupt(why)));
        assert!(transaction.is_mangled_reply(), "it begins as the reply does");
    }
    // A frame that starts again has its full time, whatever arrived before it.
    let mut transaction = start_ascii(&request, &frame, now, false);
    assert!(matches!(transaction.on_bytes(now, b":!"), Step::Wait(until) if until < deadline));
    assert_eq!(transaction.on_bytes(now, b":01"), Step::Wait(deadline));
    for unfinished in [&reply[..reply.len() - 1], b"\xFF\xFE", b"0103"] {
        let mut transaction = start_ascii(&request, &frame, now, false);
        assert_eq!(transaction.on_bytes(now, unfinished), Step::Wait(deadline));
        let ended = Step::Done(Ended::Corrupt("the reply is incomplete"));
        assert_eq!(transaction.on_time(deadline), ended);
    }
}

#[test]
fn an_ascii_echo_is_dropped_behind_noise_too() {
    let (request, frame, reply) = in_ascii();
    let now = Instant::now();
    for noise in [b"".as_slice(), b"\x80", b":01"] {
        let mut transaction = start_ascii(&request, &frame, now, false);
        let bytes = [noise, &frame, reply].concat();
        let answered = Ended::Reply(Reply::Registers(vec![5, 0]));
        assert_eq!(transaction.on_bytes(now, &bytes), Step::Done(answered.clone()));
        assert_eq!((transaction.echoes(&answered), transaction.foreign()), (Some(true), 0));
    }
    let write = Request::new(1, RequestPdu::write_register(1, 1));
    let mut frame = Vec::new();
    Protocol::ModbusAscii.encode(&write, &mut frame);
    let mut transaction = start_ascii(&write, &frame, now, true);
    let written = Step::Done(Ended::Reply(Reply::Written));
    let bytes = [b"\x80".as_slice(), &frame].concat();
    assert!(matches!(transaction.on_bytes(now, &bytes), Step::Wait(_)));
    assert_eq!(transaction.on_bytes(now, &frame), written);
}
