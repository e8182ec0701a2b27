//! Tests of the wire in virtual time.

use super::super::simulated_drive::{DriveOptions, ModelOptions};
use super::super::teco::TecoOptions;
use super::*;
use proptest::prelude::*;

const READ_STATUS: [u8; 8] = [0x01, 0x03, 0x08, 0x34, 0x00, 0x0B, 0x47, 0xA3];
/// Length of the reply to the request, characters.
const REPLY_CHARS: usize = 27;

fn us(micros: u64) -> Duration {
    Duration::from_micros(micros)
}

fn rules() -> LineRules {
    LineRules::new(LineFormat::new(38_400, "8N1").unwrap())
}

fn line(rules: LineRules, faults: FaultPlan) -> HalfDuplex {
    let drives = [DriveOptions::nx(1), DriveOptions::nx(2)];
    HalfDuplex::new(rules, Slaves::new(drives, SimTime::ZERO), faults, Transcript::new(100))
}

/// Lets the line run to `until`; returns (due, bytes) of each delivery.
fn run(line: &mut HalfDuplex, until: SimTime) -> Vec<(SimTime, Vec<u8>)> {
    let mut seen = Vec::new();
    while let Some(wake) = line.wake().filter(|wake| wake.at <= until) {
        line.on_time(wake.at);
        let mut bytes = Vec::new();
        while let Some(due) = line.take_due(wake.at, &mut bytes) {
            assert_eq!(due, wake.at, "woken at the right time");
            seen.push((due, std::mem::take(&mut bytes)));
        }
    }
    seen
}

/// Time from the read of a request to the end of its reply: 8 + 3.5 + 27 characters and the turnaround.
fn exchange_time(format: &LineFormat) -> Duration {
    format.chars(8) + format.silence_chars() + us(500) + format.chars(REPLY_CHARS)
}

#[test]
fn a_reply_takes_its_time_on_the_wire() {
    let rules = rules();
    let mut line = line(rules.clone(), FaultPlan::default());
    let asked = us(1000);
    line.on_bytes(&READ_STATUS, asked);
    let seen = run(&mut line, us(100_000));
    assert_eq!(seen.len(), 1);
    assert_eq!(seen[0].0, asked + exchange_time(&rules.format));
    assert_eq!(seen[0].1.len(), REPLY_CHARS);
    let frames = line.transcript().frames();
    assert_eq!(frames[0].to_string(), "0.001000 > 01 03 08 34 00 0B 47 A3");
    assert_eq!(frames[0].end, asked + rules.format.chars(8));
    assert_eq!(frames[1].end, seen[0].0);
    let s = line.statistics();
    assert_eq!(
        (s.requests, s.replies, s.bytes_in, s.bytes_out),
        (1, 1, 8, REPLY_CHARS as u64)
    );
}

#[test]
fn chunks_come_as_a_fifo_hands_them_over() {
    for (delivery, chunks) in [(Delivery::Chunks(1), 27), (Delivery::Chunks(14), 2)] {
        let rules = LineRules { delivery, ..rules() };
        let mut line = line(rules.clone(), FaultPlan::default());
        line.on_bytes(&READ_STATUS, SimTime::ZERO);
        let seen = run(&mut line, us(100_000));
        assert_eq!(seen.len(), chunks);
        let begun = exchange_time(&rules.format) - rules.format.chars(REPLY_CHARS);
        let mut characters = 0;
        for (due, bytes) in &seen {
            characters += bytes.len();
            assert_eq!(*due, begun + rules.format.chars(characters));
        }
        assert_eq!(characters, REPLY_CHARS);
    }
}

#[test]
fn a_frame_in_pieces_is_one_frame() {
    let mut line = line(rules(), FaultPlan::default());
    line.on_bytes(&READ_STATUS[..3], us(0));
    line.on_bytes(&READ_STATUS[3..], us(10));
    assert_eq!(run(&mut line, us(100_000)).len(), 1);
    assert_eq!(
        line.transcript().frames()[0].end,
        rules().format.chars(8),
        "no time between the pieces"
    );
    line.on_bytes(&READ_STATUS[..3], us(100_000));
    line.on_bytes(&READ_STATUS[3..], us(110_000));
    assert!(run(&mut line, us(200_000)).is_empty());
    assert_eq!(line.statistics().bad_crc, 2, "two fragments");
}

#[test]
fn the_silence_between_frames() {
    let silence = rules().format.silence_chars();
    let tolerated = silence.mul_f64(0.98);
    for (gap, strict, violations, replies) in [
        (silence, true, 0, 2),
        (tolerated, true, 0, 2),
        (us(800), true, 1, 1),
        (us(800), false, 1, 2),
        (us(0), true, 1, 1),
    ] {
        let mut line = line(LineRules { strict, ..rules() }, FaultPlan::default());
        line.on_bytes(&READ_STATUS, us(0));
        let end = run(&mut line, us(100_000))[0].0;
        line.on_bytes(&READ_STATUS, end + gap);
        run(&mut line, us(200_000));
        let s = line.statistics();
        assert_eq!(
            (s.silence_violations, s.replies),
            (violations, replies),
            "gap {gap:?} strict {strict}"
        );
        assert_eq!(s.collisions, 0);
    }
    // The silence is also required after a frame that no drive answers, and after a broadcast.
    for first in [[9, 3, 8, 0x34, 0, 11, 0, 0], [0, 6, 7, 0xD0, 0, 0, 0x88, 0x96]] {
        let mut line = line(rules(), FaultPlan::default());
        line.on_bytes(&first, us(0));
        line.on_bytes(&READ_STATUS, rules().format.chars(8) + silence);
        run(&mut line, us(100_000));
        assert_eq!(
            (line.statistics().silence_violations, line.statistics().replies),
            (0, 1)
        );
    }
}

#[test]
fn talking_into_a_reply_is_a_collision_and_spoils_it() {
    let mut line = line(rules(), FaultPlan::default());
    line.on_bytes(&READ_STATUS, us(0));
    line.on_bytes(&READ_STATUS, us(8000));
    let seen = run(&mut line, us(100_000));
    assert_eq!(seen.len(), 1);
    assert!(
        rtu::open_frame(&seen[0].1).is_none(),
        "the rest of the reply is garbage"
    );
    assert_eq!((line.statistics().collisions, line.statistics().requests), (1, 1));
    line.on_bytes(&READ_STATUS, us(200_000));
    assert!(
        rtu::open_frame(&run(&mut line, us(300_000))[0].1).is_some(),
        "the line recovers"
    );
}

#[test]
fn faults_come_over_the_wire_and_are_not_the_masters_doing() {
    let plan = |fault| FaultPlan::default().on_request(1, fault);
    let exchange = exchange_time(&rules().format);
    let deliveries = |fault| {
        let mut line = line(rules(), plan(fault));
        line.on_bytes(&READ_STATUS, us(0));
        let seen = run(&mut line, us(1_000_000));
        let s = line.statistics();
        assert_eq!((s.faults, s.silence_violations, s.collisions), (1, 0, 0), "{fault:?}");
        seen
    };
    assert!(deliveries(Fault::Drop).is_empty() && deliveries(Fault::Deaf).is_empty());
    let late = deliveries(Fault::Late(us(20_000)));
    assert_eq!(late[0].0, exchange + us(20_000));
    let double = deliveries(Fault::Double);
    assert_eq!(double[1].0, double[0].0 + rules().format.chars(REPLY_CHARS));
    let echo = deliveries(Fault::Echo);
    assert_eq!(
        (echo[0].0, echo[0].1.as_slice()),
        (
            rules().format.chars(8) + rules().format.silence_chars(),
            READ_STATUS.as_slice()
        )
    );
    assert_eq!(deliveries(Fault::Split).len(), REPLY_CHARS);
    assert_eq!(deliveries(Fault::Exception(4))[0].1[..3], [1, 0x83, 4]);

    let mut line = line(rules(), plan(Fault::Late(us(20_000))));
    line.on_bytes(&READ_STATUS, us(0));
    line.on_time(us(5000));
    line.on_bytes(&READ_STATUS, us(25_000));
    assert_eq!(
        run(&mut line, us(1_000_000)).len(),
        2,
        "the late reply and the true one"
    );
    let s = line.statistics();
    assert_eq!((s.provoked_overlaps, s.collisions, s.silence_violations), (1, 0, 0));
}

#[test]
fn a_real_uart_keeps_the_time_itself() {
    let rules = LineRules {
        wire: Wire::Real,
        ..rules()
    };
    let mut line = line(rules.clone(), FaultPlan::default());
    let read = us(10_000);
    line.on_bytes(&READ_STATUS, read);
    assert_eq!(line.transcript().frames().len(), 0);
    let seen = run(&mut line, us(100_000));
    assert_eq!(
        seen[0].0,
        read + rules.format.silence_chars() + us(500),
        "written when the reply begins"
    );
    assert_eq!(line.transcript().frames()[0].start, read - rules.format.chars(8));
}

#[test]
fn an_instant_line_answers_at_once() {
    let rules = LineRules {
        wire: Wire::Instant,
        turnaround: Duration::ZERO,
        ..rules()
    };
    let mut line = line(rules, FaultPlan::default());
    for _ in 0..3 {
        line.on_bytes(&READ_STATUS[..5], us(7));
        assert!(line.wake().is_some_and(|wake| !wake.delivery));
        line.on_bytes(&READ_STATUS[5..], us(7));
        assert_eq!(run(&mut line, us(7)).len(), 1);
    }
    line.on_bytes(&READ_STATUS[..5], us(7));
    run(&mut line, us(50_000));
    assert_eq!(line.statistics().bad_crc, 1, "a fragment is thrown away");
    assert_eq!(line.statistics().silence_violations, 0);
}

#[test]
fn a_flood_is_bounded() {
    let mut line = line(rules(), FaultPlan::default());
    for millisecond in 0..1000 {
        line.on_bytes(&[0xFF; 500], us(millisecond * 1000));
    }
    assert!(
        line.incoming
            .as_ref()
            .is_some_and(|frame| frame.bytes.len() == framing::kept(Protocol::ModbusRtu))
    );
    run(&mut line, Duration::from_secs(1000));
    assert_eq!(line.statistics().bytes_in, 500_000);
    assert_eq!(line.statistics().bad_crc, 1);
    line.on_bytes(&READ_STATUS, Duration::from_secs(2000));
    assert_eq!(run(&mut line, Duration::from_secs(2001)).len(), 1);
}

/// [`READ_STATUS`] and the length of its reply in Modbus ASCII.
const ASCII_READ_STATUS: &[u8; 17] = b":01030834000BB5\r\n";
const ASCII_REPLY_CHARS: usize = 1 + 2 * 26 + 2;

fn ascii_rules() -> LineRules {
    LineRules {
        turnaround: us(15_000),
        ..LineRules::of(Protocol::ModbusAscii, LineFormat::new(9600, "7E1").unwrap())
    }
}

#[test]
fn an_ascii_reply_begins_a_turnaround_after_the_line_feed() {
    let rules = ascii_rules();
    let mut line = line(rules.clone(), FaultPlan::default());
    line.on_bytes(&ASCII_READ_STATUS[..5], us(0));
    // A pause that would end a Modbus RTU frame.
    line.on_bytes(&ASCII_READ_STATUS[5..], us(500_000));
    let seen = run(&mut line, us(1_000_000));
    let asked = us(500_000) + rules.format.chars(12);
    let replied = asked + us(15_000) + rules.format.chars(ASCII_REPLY_CHARS);
    assert_eq!(
        (seen.len(), seen[0].0, seen[0].1.len()),
        (1, replied, ASCII_REPLY_CHARS)
    );
    assert!(seen[0].1.starts_with(b":0103160541"), "{:?}", seen[0].1);
    // Modbus ASCII requires no silence between frames.
    line.on_bytes(ASCII_READ_STATUS, replied);
    assert_eq!(run(&mut line, us(2_000_000)).len(), 1);
    let s = line.statistics();
    assert_eq!((s.requests, s.silence_violations, s.bad_crc), (2, 0, 0));
}

/// A TECO that answers a wrong check code does so after its usual turnaround; the request counts as a bad frame.
#[test]
fn an_answer_to_a_wrong_check_code_takes_its_time_too() {
    let rules = ascii_rules();
    let teco = TecoOptions {
        answer_check_error: true,
        ..TecoOptions::default()
    };
    let drives = [DriveOptions::new(1, ModelOptions::Teco(teco))];
    let slaves = Slaves::new(drives, SimTime::ZERO);
    let mut line = HalfDuplex::new(rules.clone(), slaves, FaultPlan::default(), Transcript::new(100));
    line.on_bytes(b":010300200001DC\r\n", us(0));
    let seen = run(&mut line, us(1_000_000));
    let answer = b":0183007C\r\n".to_vec();
    let due = rules.format.chars(17) + us(15_000) + rules.format.chars(answer.len());
    assert_eq!(seen, [(due, answer)]);
    line.on_bytes(b":010300200001DB\r\n", us(1_000_000));
    assert!(run(&mut line, us(2_000_000))[0].1.starts_with(b":010302"));
    let s = line.statistics();
    assert_eq!((s.requests, s.replies, s.bad_crc), (1, 2, 1));
}

#[test]
fn an_ascii_fragment_is_thrown_away_after_a_second_or_by_a_colon() {
    let (head, tail) = ASCII_READ_STATUS.split_at(9);
    for (pause, replies) in [(us(990_000), 1), (us(1_010_000), 0)] {
        let mut line = line(ascii_rules(), FaultPlan::default());
        line.on_bytes(head, us(0));
        line.on_bytes(tail, ascii_rules().format.chars(9) + pause);
        assert_eq!(run(&mut line, Duration::from_secs(9)).len(), replies, "{pause:?}");
    }
    for wire in [Wire::Simulated, Wire::Real, Wire::Instant] {
        let mut line = line(LineRules { wire, ..ascii_rules() }, FaultPlan::default());
        for noise in [&[0xFF; 2000][..], head, b":01\r:", b"\n", b":01030834000bb5\n"] {
            line.on_bytes(noise, us(0));
        }
        line.on_bytes(ASCII_READ_STATUS, us(0));
        assert_eq!(run(&mut line, Duration::from_secs(9)).len(), 1, "{wire:?}");
        assert_eq!((line.statistics().requests, line.statistics().collisions), (1, 0));
        assert!(line.wake().is_none());
    }
}

#[test]
fn an_ascii_request_that_follows_without_waiting_spoils_the_reply() {
    let mut line = line(ascii_rules(), FaultPlan::default());
    line.on_bytes(&ASCII_READ_STATUS.repeat(2), us(0));
    let seen = run(&mut line, Duration::from_secs(1));
    assert_eq!(seen.len(), 1);
    assert_eq!((line.statistics().requests, line.statistics().collisions), (1, 1));
    let sound = |bytes: &[u8]| Protocol::ModbusAscii.open_frame(bytes).is_some();
    assert!(!sound(&seen[0].1));
    line.on_bytes(ASCII_READ_STATUS, Duration::from_secs(2));
    assert!(sound(&run(&mut line, Duration::from_secs(3))[0].1));
}

proptest! {
    #[test]
    fn no_bytes_at_any_time_panic_and_nothing_is_early(
        chunks in prop::collection::vec((prop::collection::vec(any::<u8>(), 0..40), 0u64..20_000, any::<bool>()), 0..40),
        wire in prop_oneof![Just(Wire::Simulated), Just(Wire::Real), Just(Wire::Instant)],
        ascii in any::<bool>(),
        size in 1u8..30,
    ) {
        let (rules, question): (_, &[u8]) = if ascii {
            (ascii_rules(), ASCII_READ_STATUS)
        } else {
            (rules(), &READ_STATUS)
        };
        let rules = LineRules { wire, delivery: Delivery::Chunks(size), strict: false, ..rules };
        let mut line = line(rules, FaultPlan::new("echo=0.2,double=0.2,late=0.2,split=0.2".parse().unwrap(), 1));
        let (mut now, mut sound) = (SimTime::ZERO, 0);
        for (bytes, later, request) in chunks {
            now += us(later);
            run(&mut line, now);
            line.on_bytes(if request { question } else { &bytes }, now);
            sound += u64::from(request);
        }
        run(&mut line, now + Duration::from_secs(10));
        prop_assert!(line.wake().is_none(), "the line falls silent");
        prop_assert!(line.statistics().requests <= sound);
    }
}

/// The card answers 15 ms after a message (reference/drives.md 5.1), whatever turnaround the line has for other drives.
#[test]
fn a_drive_takes_its_own_turnaround() {
    let format = LineFormat::new(19_200, "7N2").unwrap();
    for (own, turnaround) in [(true, us(15_000)), (false, us(500))] {
        let mut model = ModelOptions::by_name("teco").unwrap();
        if !own {
            model.take_turnaround_of_line();
        }
        let slaves = Slaves::new([DriveOptions::new(1, model)], SimTime::ZERO);
        let rules = LineRules::of(Protocol::ModbusAscii, format);
        let mut line = HalfDuplex::new(rules, slaves, FaultPlan::default(), Transcript::new(9));
        line.on_bytes(b":01080000AA55F8\r\n", us(0));
        let seen = run(&mut line, us(1_000_000));
        assert_eq!(
            seen[0],
            (2 * format.chars(17) + turnaround, b":01080000AA55F8\r\n".to_vec())
        );
    }
}
