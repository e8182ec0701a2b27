//! Transactions in Modbus RTU; tests of Modbus ASCII, and random ones of both, are in separate files.

use super::*;
use drivegate_proto::{Table, rtu};

mod ascii;
mod chance;
mod n2;

fn request() -> (Request, Vec<u8>) {
    let pdu = RequestPdu::read(Table::Holding, 732, 1);
    let request = Request::new(1, pdu);
    let mut frame = Vec::new();
    rtu::encode_request(&request, &mut frame);
    (request, frame)
}

fn reply(value: u16) -> Vec<u8> {
    let [high, low] = value.to_be_bytes();
    let mut frame = Vec::new();
    rtu::encode_frame(1, &[3, 2, high, low], &mut frame);
    frame
}

fn start(request: &Request, frame: &[u8], now: Instant) -> Transaction {
    let ms = Duration::from_millis;
    let (request, frame) = (request.clone(), frame.to_vec());
    Transaction::new(Protocol::ModbusRtu, request, frame, now, ms(100), ms(5), false)
}

fn done(value: u16) -> Step {
    Step::Done(Ended::Reply(Reply::Registers(vec![value])))
}

#[test]
fn single_bytes_make_a_reply() {
    let (request, frame) = request();
    let now = Instant::now();
    let mut transaction = start(&request, &frame, now);
    let bytes = reply(2);
    for byte in &bytes[..bytes.len() - 1] {
        assert!(matches!(transaction.on_bytes(now, &[*byte]), Step::Wait(_)));
    }
    assert_eq!(transaction.on_bytes(now, &bytes[bytes.len() - 1..]), done(2));
    assert!(transaction.rest().is_empty());
}

#[test]
fn the_deadline_is_set_once() {
    let (request, frame) = request();
    let now = Instant::now();
    let deadline = now + Duration::from_millis(105);
    let mut transaction = start(&request, &frame, now);
    let mut foreign = Vec::new();
    rtu::encode_frame(9, &[3, 2, 0, 1], &mut foreign);
    assert_eq!(
        transaction.on_bytes(now + Duration::from_millis(90), &foreign),
        Step::Wait(deadline)
    );
    assert_eq!(transaction.foreign(), 1);
    assert_eq!(transaction.on_time(deadline), Step::Done(Ended::Silent));
    let mut transaction = start(&request, &frame, now);
    transaction.on_bytes(now, &[1, 3]);
    assert_eq!(
        transaction.on_time(deadline),
        Step::Done(Ended::Corrupt("the reply is incomplete"))
    );
}

#[test]
fn foreign_frame_and_reply_in_one_piece() {
    let (request, frame) = request();
    let mut bytes = Vec::new();
    rtu::encode_frame(9, &[3, 2, 0, 1], &mut bytes);
    bytes.extend(reply(7));
    bytes.push(0xFF);
    let mut transaction = start(&request, &frame, Instant::now());
    assert_eq!(transaction.on_bytes(Instant::now(), &bytes), done(7));
    assert_eq!(transaction.rest(), [0xFF]);
}

#[test]
fn echo_is_dropped_even_where_it_looks_like_a_reply() {
    // 01 03 02 DC …: read as a reply it would be one register 0xDC00.
    let (request, frame) = request();
    let now = Instant::now();
    let mut transaction = start(&request, &frame, now);
    for byte in &frame {
        assert!(matches!(transaction.on_bytes(now, &[*byte]), Step::Wait(_)));
    }
    assert_eq!(transaction.on_bytes(now, &reply(2)), done(2));
    let answered = Ended::Reply(Reply::Registers(vec![2]));
    assert_eq!(transaction.echoes(&answered), Some(true));
    let mut transaction = start(&request, &frame, now);
    assert_eq!(transaction.echoes(&Ended::Silent), None);
    assert_eq!(transaction.on_bytes(now, &reply(2)), done(2));
    assert_eq!(
        transaction.echoes(&answered),
        Some(false),
        "an echo that is gone is forgotten"
    );
}

#[test]
fn a_known_echo_does_not_acknowledge_a_write() {
    let request = Request::new(1, RequestPdu::write_register(2000, 1));
    let mut frame = Vec::new();
    rtu::encode_request(&request, &mut frame);
    let now = Instant::now();
    let ms = Duration::from_millis;
    let begin = |echo| {
        let (request, frame) = (request.clone(), frame.clone());
        Transaction::new(Protocol::ModbusRtu, request, frame, now, ms(100), ms(5), echo)
    };
    assert_eq!(
        begin(false).on_bytes(now, &frame),
        Step::Done(Ended::Reply(Reply::Written))
    );
    let mut transaction = begin(true);
    assert!(matches!(transaction.on_bytes(now, &frame), Step::Wait(_)));
    assert_eq!(
        transaction.on_bytes(now, &frame),
        Step::Done(Ended::Reply(Reply::Written))
    );
}

#[test]
fn garbage_ends_the_exchange_once_no_more_of_it_can_come() {
    let (request, frame) = request();
    let now = Instant::now();
    let mut bytes = reply(2);
    bytes[3] ^= 0x10;
    let corrupt = |why| Step::Done(Ended::Corrupt(why));
    let char_time = Duration::from_millis(5) / 7;
    let mut transaction = start(&request, &frame, now);
    let Step::Wait(until) = transaction.on_bytes(now, &bytes) else {
        panic!("it ends at once")
    };
    assert!(until - now < char_time * 5, "a whole reply came: {:?}", until - now);
    assert_eq!(transaction.on_time(until), corrupt("check code is wrong"));
    // The function is impossible, and the rest of the reply is still on the line.
    let mut transaction = start(&request, &frame, now);
    let Step::Wait(until) = transaction.on_bytes(now, &[1, 0x83, 0x99, 0x99, 0x99]) else {
        panic!("it ends at once")
    };
    assert!(until - now > char_time * 5, "{:?}", until - now);
    assert!(until - now < char_time * 7, "{:?}", until - now);
    // The wait must never exceed the deadline.
    let deadline = now + Duration::from_millis(105);
    assert_eq!(
        transaction.on_bytes(deadline - char_time, &[0x99]),
        Step::Wait(deadline)
    );
    assert_eq!(transaction.on_time(deadline), corrupt("check code is wrong"));
}

/// A byte count that no valid frame has does not occupy the line until the deadline: the valid reply that follows
/// is still found.
#[test]
fn a_reply_of_impossible_length_ends_the_exchange_before_its_deadline() {
    let (request, frame) = request();
    let now = Instant::now();
    let mut transaction = start(&request, &frame, now);
    let Step::Wait(until) = transaction.on_bytes(now, &[1, 3, 0xFF]) else {
        panic!("the rest may still be on the line")
    };
    assert!(
        until <= now + Duration::from_millis(6),
        "a reply's time: {:?}",
        until - now
    );
    let why = "the reply announces more than 256 characters";
    assert_eq!(transaction.on_time(until), Step::Done(Ended::Corrupt(why)));
    let mut transaction = start(&request, &frame, now);
    transaction.on_bytes(now, &[1, 3, 0xFF]);
    assert_eq!(transaction.on_bytes(now, &reply(9)), done(9));
}

#[test]
fn a_reply_behind_noise_is_found_but_no_exception_and_no_echo() {
    let (request, frame) = request();
    let now = Instant::now();
    for noise in [&[0x37][..], &[0x01, 0x83, 0x02], &[0x01, 0x03, 0xFE], &[1, 3, 2, 0, 1]] {
        let mut transaction = start(&request, &frame, now);
        assert!(
            matches!(transaction.on_bytes(now, noise), Step::Wait(_)),
            "{noise:02X?}"
        );
        assert_eq!(transaction.on_bytes(now, &reply(9)), done(9), "{noise:02X?}");
        assert_eq!(transaction.foreign(), 1);
    }
    let mut exception = vec![0x37];
    rtu::encode_frame(1, &[0x83, 2], &mut exception);
    let mut transaction = start(&request, &frame, now);
    assert!(matches!(transaction.on_bytes(now, &exception), Step::Wait(_)));
    let pdu = RequestPdu::write_register(2000, 1);
    let write = Request::new(1, pdu);
    let mut bytes = vec![0x37];
    rtu::encode_request(&write, &mut bytes);
    let (ms, protocol) = (Duration::from_millis, Protocol::ModbusRtu);
    let begin = |echo| {
        let frame = bytes[1..].to_vec();
        Transaction::new(protocol, write.clone(), frame, now, ms(100), ms(5), echo)
    };
    assert_eq!(
        begin(false).on_bytes(now, &bytes),
        Step::Done(Ended::Reply(Reply::Written))
    );
    assert!(matches!(begin(true).on_bytes(now, &bytes), Step::Wait(_)));
}

#[test]
fn the_last_reply_once_more_and_a_stray_echo_are_told_by_their_time() {
    let (request, frame) = request();
    let now = Instant::now();
    let ms = Duration::from_millis;
    let mut transaction = start(&request, &frame, now);
    transaction.doubt_before(now + ms(5));
    assert!(matches!(transaction.on_bytes(now + ms(1), &reply(1)), Step::Wait(_)));
    assert!(transaction.doubted());
    assert_eq!(transaction.on_bytes(now + ms(6), &reply(2)), done(2));
    let mut transaction = start(&request, &frame, now);
    transaction.doubt_before(now + ms(5));
    let mut exception = Vec::new();
    rtu::encode_frame(1, &[0x83, 2], &mut exception);
    assert!(matches!(
        transaction.on_bytes(now + ms(4), &exception),
        Step::Done(Ended::Reply(Reply::Exception(_)))
    ));
}

#[test]
fn babble_is_bounded() {
    let (request, frame) = request();
    let now = Instant::now();
    let mut transaction = start(&request, &frame, now);
    let mut step = Step::Wait(now);
    for _ in 0..40 {
        step = transaction.on_bytes(now, &[0x55; 512]);
    }
    assert!(matches!(step, Step::Done(Ended::Corrupt(_))));
    assert!(transaction.seen().len() <= MOST_BYTES);
}

#[test]
fn frames_to_all_and_of_nobody_are_foreign_and_so_is_exception_0() {
    let (request, frame) = request();
    let now = Instant::now();
    for (address, pdu) in [
        (0, &[3, 2, 0, 1][..]),
        (1, &[4, 2, 0, 1]),
        (2, &[3, 2, 0, 1]),
        (1, &[0x83, 0]),
    ] {
        let mut bytes = Vec::new();
        rtu::encode_frame(address, pdu, &mut bytes);
        let mut transaction = start(&request, &frame, now);
        assert!(matches!(transaction.on_bytes(now, &bytes), Step::Wait(_)));
        assert_eq!(transaction.foreign(), 1, "{address} {pdu:?}");
    }
}
