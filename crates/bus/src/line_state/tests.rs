use super::*;
use crate::n2_late_replies::LateRequest;
use drivegate_proto::{RequestPdu, Table, rtu};

/// A line at 9600 baud on which every reply may be a duplicate of the previous one.
struct DoublingLine {
    line: LineState,
    protocol: Protocol,
    now: Instant,
    /// Whether replies are timed from the start of the request, as if the request took no time.
    at_once: bool,
    /// Whether the reply to an earlier request may still arrive.
    late: bool,
}

impl DoublingLine {
    fn new() -> DoublingLine {
        DoublingLine::of(Protocol::ModbusRtu)
    }

    fn of(protocol: Protocol) -> DoublingLine {
        let now = Instant::now();
        let format = LineFormat::new(9600, "8N1").unwrap();
        let silence = Duration::from_millis(4);
        DoublingLine {
            line: LineState::new(protocol, format, silence, now),
            protocol,
            now,
            at_once: false,
            late: false,
        }
    }

    /// Whether a reply is accepted that is complete this long after its request.
    fn believes(&mut self, after: Duration) -> bool {
        let reply = match self.protocol {
            Protocol::N2 => b"A1061\r".to_vec(),
            Protocol::ModbusRtu | Protocol::ModbusAscii => reply(),
        };
        self.answers(&[(after, &reply)])
    }

    /// Whether a reply is accepted if these bytes arrive at these times after the request.
    fn answers(&mut self, what: &[(Duration, &[u8])]) -> bool {
        let table = match self.protocol {
            Protocol::N2 => Table::DiscreteInput,
            Protocol::ModbusRtu | Protocol::ModbusAscii => Table::Holding,
        };
        let pdu = RequestPdu::read(table, 0, 1);
        let request = Request::new(1, pdu);
        let mut frame = Vec::new();
        self.protocol.encode(&request, &mut frame);
        let sending = Sending {
            silence: self.line.silence(),
            response_timeout: Duration::from_millis(100),
            could_be_doubled: true,
            late_may_come: self.late,
        };
        self.now += Duration::from_secs(1);
        self.line.send(request, frame, sending, self.now);
        let sent = if self.at_once {
            self.now
        } else {
            self.line.quiet_since()
        };
        let exchanged = what
            .iter()
            .find_map(|(after, bytes)| self.line.received(bytes, &mut N2LateReplies::default(), sent + *after));
        let over = exchanged.or_else(|| self.line.on_time(sent + Duration::from_secs(1)).ok());
        let over = over.expect("it is over");
        let free = self.line.quiet_since() + Duration::from_millis(4);
        assert!(self.now + over.took >= free, "the line was taken until {free:?}");
        matches!(over.ended, Ended::Reply(_))
    }
}

fn reply() -> Vec<u8> {
    let mut reply = Vec::new();
    rtu::encode_frame(1, &[3, 2, 0, 7], &mut reply);
    reply
}

const EARLY: Duration = Duration::from_millis(1);
const REGULAR: Duration = Duration::from_millis(10);

#[test]
fn a_reply_that_comes_twice_now_and_then_is_never_believed() {
    let mut rig = DoublingLine::new();
    for _ in 0..100 {
        assert!(!rig.believes(EARLY), "it came once more");
        for _ in 0..40 {
            assert!(rig.believes(REGULAR), "which takes the weight back");
        }
    }
}

#[test]
fn replies_that_come_twice_before_others_that_are_mangled_are_never_believed() {
    let mut rig = DoublingLine::new();
    let (reply, foreign) = (reply(), reply().iter().map(|byte| byte ^ 4).collect::<Vec<_>>());
    for _ in 0..100 {
        assert!(
            !rig.answers(&[(EARLY, &reply), (REGULAR, &foreign)]),
            "it came once more"
        );
    }
}

#[test]
fn the_reply_behind_an_early_one_shows_a_wire() {
    let mut rig = DoublingLine::new();
    let reply = reply();
    for _ in 0..100 {
        assert!(!rig.believes(EARLY), "the next one was lost");
        assert!(rig.answers(&[(EARLY, &reply), (REGULAR, &reply)]));
    }
}

/// A drive is a little slower than the time limit twice in a row: the first reply arrives early in the next transaction,
/// and the second one after it.
#[test]
fn late_replies_of_a_slow_drive_are_never_believed() {
    let mut rig = DoublingLine::new();
    for _ in 0..100 {
        rig.late = true;
        assert!(!rig.believes(EARLY), "it answers the request before");
        rig.late = false;
        for _ in 0..8 {
            assert!(rig.believes(REGULAR));
        }
    }
    // Without a regular reply in between they show a line without wire time all the same.
    rig.late = true;
    let doubted = (0..100).take_while(|_| !rig.believes(EARLY)).count();
    assert_eq!(doubted, 8);
}

#[test]
fn early_replies_again_and_again_show_a_line_without_wire_time() {
    let mut rig = DoublingLine::new();
    for _ in 0..2 {
        assert!(!rig.believes(EARLY));
    }
    for _ in 0..100 {
        assert!(rig.believes(EARLY), "no wire");
    }
    for _ in 0..MOST_WEIGHT {
        assert!(rig.believes(REGULAR));
    }
    assert!(!rig.believes(EARLY), "a wire all the same");
}

/// A simulated drive on a busy machine: some of its replies are early, others are not.
#[test]
fn a_line_on_which_some_replies_are_early_loses_few_of_them() {
    for early_in_ten in 2..10u32 {
        let mut rig = DoublingLine::new();
        let believed = |n: &u32| rig.believes(if n * 7 % 10 < early_in_ten { EARLY } else { REGULAR });
        let lost = 1_000 - (0..1_000).filter(believed).count();
        assert!(lost <= 4, "{early_in_ten} in ten are early: {lost} lost");
    }
}

#[test]
fn a_request_waits_for_silence_but_not_for_ever() {
    let mut rig = DoublingLine::new();
    let since = rig.now;
    let mut now = since;
    assert_eq!(
        rig.line.clear_at(since, rig.line.silence()),
        since + Duration::from_millis(4)
    );
    while !rig.line.babbles(since) {
        now += Duration::from_millis(2);
        assert!(rig.line.received(&[0x55], &mut N2LateReplies::default(), now).is_none());
        assert!(rig.line.clear_at(since, rig.line.silence()) > now || rig.line.babbles(since));
    }
    assert!(rig.line.clear_at(since, rig.line.silence()) <= now + Duration::from_millis(4));
    assert!(now <= since + MAX_WAIT_FOR_SILENCE + Duration::from_millis(4));
}

#[test]
fn a_drive_has_its_own_silence_before_its_request_and_after_its_reply() {
    let (usual, own) = (Duration::from_millis(4), Duration::from_millis(100));
    for (silence, of_next, expected) in [
        (usual, usual, usual),
        (usual, own, own),
        (own, usual, own),
        (own, own, own),
    ] {
        let mut rig = DoublingLine::new();
        let request = Request::new(1, RequestPdu::read(Table::Holding, 0, 1));
        let mut frame = Vec::new();
        rig.protocol.encode(&request, &mut frame);
        let sending = Sending {
            silence,
            response_timeout: Duration::from_millis(100),
            could_be_doubled: false,
            late_may_come: false,
        };
        rig.line.send(request, frame, sending, rig.now);
        let over = rig
            .line
            .received(
                &reply(),
                &mut N2LateReplies::default(),
                rig.line.quiet_since() + REGULAR,
            )
            .unwrap();
        assert_eq!(
            rig.line.clear_at(over.at, of_next),
            over.at + expected,
            "{silence:?}, then {of_next:?}"
        );
        assert_eq!(over.took, over.at - over.began + silence);
    }
}

/// Every tenth reply is doubled and the next one is lost, so that the duplicate is alone in its transaction.
#[test]
fn an_n2_line_that_doubles_replies_and_loses_others_keeps_its_protection() {
    let mut rig = DoublingLine::of(Protocol::N2);
    for _ in 0..100 {
        assert!(!rig.believes(EARLY), "it came once more");
        for _ in 0..9 {
            assert!(rig.believes(REGULAR));
        }
    }
}

/// With a shorter minimum time, prioritised requests within their share would take the whole line.
#[test]
fn a_line_without_wire_time_is_taken_as_long_as_the_gateway_leaves_it_alone() {
    for protocol in [Protocol::ModbusRtu, Protocol::N2] {
        let mut rig = DoublingLine::of(protocol);
        for _ in 0..200 {
            rig.believes(EARLY);
        }
        rig.at_once = true;
        assert!(rig.believes(EARLY), "{protocol:?}");
    }
}

#[test]
fn an_n2_line_without_wire_time_is_believed_after_three_replies() {
    let mut rig = DoublingLine::of(Protocol::N2);
    for _ in 0..3 {
        assert!(!rig.believes(EARLY));
    }
    for _ in 0..100 {
        assert!(rig.believes(EARLY), "no wire");
    }
}

/// The process did not run between the reply and its reading.
#[test]
fn a_reply_is_dated_no_later_than_it_can_have_left_the_drive() {
    for late in [Duration::ZERO, Duration::from_secs(10)] {
        let mut bench = DoublingLine::new();
        let request = Request::new(1, RequestPdu::read(Table::Holding, 0, 1));
        let mut frame = Vec::new();
        bench.protocol.encode(&request, &mut frame);
        let sending = Sending {
            silence: bench.line.silence(),
            response_timeout: Duration::from_millis(100),
            could_be_doubled: false,
            late_may_come: false,
        };
        let now = bench.now;
        bench.line.send(request, frame, sending, now);
        let (sent, deadline) = (bench.line.quiet_since(), bench.line.deadline().unwrap());
        let read = sent + REGULAR + late;
        let over = bench
            .line
            .received(&reply(), &mut N2LateReplies::default(), read)
            .unwrap();
        assert!(matches!(over.ended, Ended::Reply(_)));
        assert_eq!(over.at, read.min(deadline));
        assert!(deadline <= sent + Duration::from_millis(100 + 10), "timeout and reply");
        assert!(over.heard_at <= deadline && over.took <= deadline - now + Duration::from_millis(4));
    }
}

const WINDOW: Duration = Duration::from_millis(750);

/// A request of N2 that had no reply.
fn asked(address: u8, pdu: &RequestPdu, at: Instant) -> LateRequest<'_> {
    LateRequest {
        address,
        pdu,
        device: 0x10,
        at,
    }
}

#[test]
fn a_late_reply_of_n2_that_comes_between_two_requests_is_noted() {
    let mut rig = DoublingLine::of(Protocol::N2);
    let (now, state) = (rig.now, RequestPdu::read(Table::DiscreteInput, 2, 1));
    let mut late = N2LateReplies::default();
    late.given_up(asked(1, &state, now), WINDOW, now);
    late.given_up(asked(1, &state, now), WINDOW, now);
    let came = now + WINDOW * 9 / 10;
    for piece in [b"A40".as_slice(), b"64\r"] {
        assert!(rig.line.received(piece, &mut late, came).is_none());
    }
    assert_eq!(
        late.until(),
        Some(came + WINDOW),
        "the other one may take as long again"
    );
    assert!(rig.line.received(b"A4064\r", &mut late, came).is_none());
    assert!(late.may_come(came), "it may be the first once more");
    assert!(rig.line.received(b"A0060\r", &mut late, came).is_none());
    assert!(!late.may_come(came), "both came");
}

#[test]
fn a_reply_of_n2_that_comes_once_more_between_two_requests_is_no_late_one() {
    let mut rig = DoublingLine::of(Protocol::N2);
    assert!(rig.answers(&[(REGULAR, b"A1061\r")]));
    let (now, state) = (rig.now, RequestPdu::read(Table::DiscreteInput, 2, 1));
    let mut late = N2LateReplies::default();
    late.given_up(asked(2, &state, now), WINDOW, now);
    let came = now + WINDOW * 9 / 10;
    assert!(rig.line.received(b"A1061\r", &mut late, came).is_none());
    assert_eq!(late.until(), Some(came + WINDOW), "the late one may still come");
    assert!(rig.line.received(b"A0060\r", &mut late, came).is_none());
    assert!(!late.may_come(came), "it came");
}
