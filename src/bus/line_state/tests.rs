use super::*;
use crate::codec::{RequestPdu, Table, rtu};

/// A line at 9600 baud on which every reply could be the last one once more.
struct Bench {
    line: LineState,
    now: Instant,
}

impl Bench {
    fn new() -> Bench {
        let now = Instant::now();
        let format = LineFormat::new(9600, "8N1").unwrap();
        let silence = Duration::from_millis(4);
        Bench {
            line: LineState::new(Protocol::ModbusRtu, format, silence, now),
            now,
        }
    }

    /// Whether a reply is believed that is whole so long after its request.
    fn believes(&mut self, after: Duration) -> bool {
        let pdu = RequestPdu::Read {
            table: Table::Holding,
            start: 0,
            count: 1,
        };
        let request = Request::new(1, pdu);
        let (mut frame, mut reply) = (Vec::new(), Vec::new());
        rtu::encode_request(&request, &mut frame);
        rtu::encode_frame(1, &[3, 2, 0, 7], &mut reply);
        let sending = Sending {
            response_timeout: Duration::from_millis(100),
            could_be_doubled: true,
            late_may_come: false,
        };
        self.now += Duration::from_secs(1);
        self.line
            .send(request, frame, sending, N2LateReplies::default(), self.now);
        let sent = self.line.quiet_since();
        let exchanged = self.line.heard(&reply, sent + after);
        let over = exchanged.or_else(|| self.line.on_time(sent + Duration::from_secs(1)).ok());
        matches!(over.expect("it is over").ended, Ended::Reply(_))
    }
}

#[test]
fn only_replies_that_are_early_again_and_again_show_a_line_without_wire_time() {
    let (early, regular) = (Duration::from_millis(1), Duration::from_millis(10));
    let mut bench = Bench::new();
    for _ in 0..5 {
        assert!(!bench.believes(early), "it came once more");
        assert!(!bench.believes(early));
        assert!(bench.believes(regular), "which takes them back");
    }
    for _ in 0..3 {
        assert!(!bench.believes(early));
    }
    assert!(bench.believes(early) && bench.believes(early), "no wire");
    assert!(bench.believes(regular));
    assert!(!bench.believes(early), "a wire all the same");
}

#[test]
fn a_request_waits_for_silence_but_not_for_ever() {
    let mut bench = Bench::new();
    let since = bench.now;
    let mut now = since;
    assert_eq!(bench.line.clear_at(since), since + Duration::from_millis(4));
    while !bench.line.babbles(since) {
        now += Duration::from_millis(2);
        assert!(bench.line.heard(&[0x55], now).is_none());
        assert!(bench.line.clear_at(since) > now || bench.line.babbles(since));
    }
    assert!(bench.line.clear_at(since) <= now + Duration::from_millis(4));
    assert!(now <= since + BABBLE + Duration::from_millis(4));
}
