use super::*;
use drivegate_proto::Table;

const DEADLINE: Duration = Duration::from_millis(105);

fn read(start: u16, count: u16) -> RequestPdu {
    RequestPdu::read(Table::Holding, start, count)
}

#[test]
fn only_what_could_be_mistaken_waits() {
    let now = Instant::now();
    let mut late = LateReplies::default();
    late.given_up(&read(2100, 11), now - DEADLINE, now);
    assert_eq!(late.blocks(&read(2100, 11), now), None, "the same request");
    assert_eq!(late.blocks(&read(2000, 3), now), None, "another length");
    assert_eq!(
        late.blocks(&RequestPdu::write_register(0, 1), now),
        None,
        "another function"
    );
    assert_eq!(
        late.blocks(&read(0, 11), now),
        Some(now + FORGOTTEN_AFTER),
        "looks the same"
    );
    assert_eq!(late.blocks(&read(0, 11), now + FORGOTTEN_AFTER), None, "forgotten");
}

#[test]
fn echoes_of_writes() {
    let now = Instant::now();
    let mut late = LateReplies::default();
    late.given_up(&RequestPdu::write_register(2000, 1), now - DEADLINE, now);
    assert_eq!(late.blocks(&RequestPdu::write_register(2000, 0), now), None);
    late.given_up(&RequestPdu::write_registers(2000, &[1, 2]), now - DEADLINE, now);
    let other = RequestPdu::write_registers(2000, &[0, 2]);
    assert!(late.blocks(&other, now).is_some());
}

/// A drive answers each request after 110 ms while the deadline is 105 ms, so it is always one reply behind. Two
/// look-alike reads are always due.
#[test]
fn a_drive_that_is_one_reply_behind_is_never_misunderstood() {
    let (a, b) = (read(2100, 3), read(2104, 3));
    let behind = Duration::from_millis(110);
    let start = Instant::now();
    let (mut now, mut late) = (start, LateReplies::default());
    let mut coming: std::collections::VecDeque<(Instant, RequestPdu)> = std::collections::VecDeque::new();
    let mut answered = [0, 0];
    let mut turn = 0;
    while now < start + Duration::from_secs(20) {
        turn += 1;
        let order = if turn % 2 == 0 { [&a, &b] } else { [&b, &a] };
        let Some(asked) = order.into_iter().find(|pdu| late.blocks(pdu, now).is_none()) else {
            now += Duration::from_millis(1);
            coming.retain(|(at, _)| *at > now);
            continue;
        };
        // Bytes that arrived while no request was open are noise.
        coming.retain(|(at, _)| *at > now);
        coming.push_back((now + behind, asked.clone()));
        let sent = now;
        let deadline = now + DEADLINE;
        match coming.front().cloned().filter(|(at, _)| *at <= deadline) {
            Some((at, of)) => {
                coming.pop_front();
                now = at;
                assert_eq!(&of, asked, "after {:?}", now - start);
                answered[usize::from(of == b)] += 1;
                late.answered(asked, sent, now);
            }
            None => {
                now = deadline;
                late.given_up(asked, now - DEADLINE, now);
            }
        }
        now += Duration::from_millis(2);
    }
    assert!(answered.iter().all(|count| *count > 5), "both are read: {answered:?}");
}

#[test]
fn a_request_whose_reply_is_late_is_not_held_back_for_ever() {
    let start = Instant::now();
    let mut late = LateReplies::default();
    let (a, b) = (read(2100, 3), read(2104, 3));
    late.given_up(&a, start - DEADLINE, start);
    let ms = Duration::from_millis;
    let mut longest = Duration::ZERO;
    let (mut last_a, mut first_b) = (start, None);
    for millisecond in 0..5000 {
        let now = start + ms(millisecond);
        if first_b.is_none() && late.blocks(&b, now).is_none() {
            first_b = Some(now - start);
        }
        if millisecond % 12 == 0 && late.blocks(&a, now).is_none() {
            longest = longest.max(now - last_a);
            last_a = now;
            late.answered(&a, now, now);
        }
    }
    assert!(first_b.is_some_and(|at| at < ms(2200)), "{first_b:?}");
    assert!(longest < ms(1200), "{longest:?}");
    assert!(start + ms(5000) - last_a < ms(20), "the late reply is forgotten");
}

#[test]
fn a_late_acknowledgement_does_not_stand_for_a_write_that_another_overtook() {
    let now = Instant::now();
    let write = |value| RequestPdu::WriteRegister { address: 2000, value };
    let mut late = LateReplies::default();
    late.given_up(&write(1), now - DEADLINE, now);
    assert_eq!(late.blocks(&write(1), now), None, "tried again at once");
    late.answered(&write(0), now, now);
    assert_eq!(late.blocks(&write(1), now), Some(now + FORGOTTEN_AFTER));
    assert_eq!(late.blocks(&write(0), now), None);
}

#[test]
fn the_first_acknowledgement_of_a_stop_that_was_overtaken_proves_nothing() {
    let now = Instant::now();
    let write = |value| RequestPdu::WriteRegister { address: 2000, value };
    let (stop, run) = (write(0), write(1));
    let mut late = LateReplies::default();
    late.given_up(&stop, now - DEADLINE, now);
    assert!(!late.proves_nothing(&stop, now, now), "nothing came in between");
    late.answered(&run, now, now);
    assert!(!late.proves_nothing(&run, now, now));
    assert!(late.proves_nothing(&stop, now, now), "it may be that of the first one");
    late.answered(&stop, now, now);
    assert!(!late.proves_nothing(&stop, now, now), "the second one counts");
    late.answered(&stop, now, now);
    assert_eq!(late.blocks(&run, now), None);
    // After this time the late reply is no longer expected.
    late.given_up(&stop, now - DEADLINE, now);
    late.answered(&run, now, now);
    let later = now + FORGOTTEN_AFTER;
    assert!(!late.proves_nothing(&stop, later, later));
}

#[test]
fn an_acknowledgement_that_may_be_that_of_a_look_alike_proves_nothing() {
    let now = Instant::now();
    let registers = |value| RequestPdu::WriteRegisters {
        start: 2000,
        values: vec![value, 0],
    };
    let coils = |on| RequestPdu::WriteCoils {
        start: 0,
        bits: vec![on, false],
    };
    for (run, stop) in [(registers(1), registers(0)), (coils(true), coils(false))] {
        let mut late = LateReplies::default();
        late.given_up(&run, now - DEADLINE, now);
        assert!(late.proves_nothing(&stop, now, now));
        assert!(!late.proves_nothing(&stop, now, now), "the second one counts");
        late.answered(&stop, now, now);
        // The stop was sent twice and acknowledged once.
        assert!(late.blocks(&run, now).is_some());
        let later = now + FORGOTTEN_AFTER;
        assert_eq!(late.blocks(&run, later), None);

        late.given_up(&run, later, later);
        late.given_up(&run, later, later);
        assert!(late.proves_nothing(&stop, later, later) && late.proves_nothing(&stop, later, later));
        assert!(!late.proves_nothing(&stop, later, later), "one for each try");
        let forgotten = later + FORGOTTEN_AFTER;
        late.given_up(&run, later, later);
        assert!(!late.proves_nothing(&stop, forgotten, forgotten));
    }
}

#[test]
fn a_drive_that_never_answers_does_not_hold_up_a_stop() {
    let now = Instant::now();
    let write = |value| RequestPdu::WriteRegisters {
        start: 2000,
        values: vec![value],
    };
    let mut late = LateReplies::default();
    for _ in 0..100 {
        late.given_up(&write(1), now - DEADLINE, now);
        late.given_up(&read(1500, 1), now - DEADLINE, now);
    }
    let doubts =
        |late: &mut LateReplies, pdu: &RequestPdu| (0..100).take_while(|_| late.proves_nothing(pdu, now, now)).count();
    assert_eq!(doubts(&mut late, &write(0)), 3);
    assert_eq!(doubts(&mut late, &read(2000, 1)), 1);
}

#[test]
fn a_write_that_was_not_answered_may_have_been_taken_all_the_same() {
    let now = Instant::now();
    let write = |value| RequestPdu::WriteRegister { address: 2000, value };
    let mut late = LateReplies::default();
    late.given_up(&write(0), now - DEADLINE, now);
    late.given_up(&write(1), now - DEADLINE, now);
    assert!(late.proves_nothing(&write(0), now, now));
    assert!(!late.proves_nothing(&write(0), now, now));
}

/// The ages of the samples of a request every 20 ms, answered after 5 ms, after one reply was lost. Another
/// register is read every `other` rounds.
fn ages_after_a_lost_reply(other: u32) -> Vec<Duration> {
    let start = Instant::now();
    let (mut late, ms) = (LateReplies::default(), Duration::from_millis);
    let a = read(2100, 11);
    late.given_up(&a, start, start + DEADLINE);
    let age = |round: u32| {
        let sent = start + DEADLINE + ms(2) + round * ms(20);
        let at = sent + ms(5);
        let asked_by = late.asked_by(&a, at);
        late.answered(&a, sent, at);
        if (round + 1).is_multiple_of(other) {
            late.settled_by(&read(2000, 3), at);
        }
        at - asked_by
    };
    (0..500).map(age).collect()
}

#[test]
fn one_lost_reply_does_not_date_samples_back_for_ever() {
    let ms = Duration::from_millis;
    for other in [1, 50] {
        let ages = ages_after_a_lost_reply(other);
        let (doubtful, settled) = ages.split_at(other as usize);
        assert_eq!(ages[0], ms(112), "it may be the older reply");
        assert!(
            doubtful[1..].iter().all(|age| *age == ms(25)),
            "one request back: {ages:?}"
        );
        assert!(settled.iter().all(Duration::is_zero), "{ages:?}");
    }
    let never = ages_after_a_lost_reply(1_000);
    assert!(
        never[1..].iter().all(|age| *age == ms(25)),
        "one request back: {never:?}"
    );
}

#[test]
fn only_a_reply_that_can_be_no_late_one_settles_the_order() {
    let now = Instant::now();
    let later = now + Duration::from_millis(20);
    let (a, half) = (read(2100, 11), read(2100, 5));
    let mut late = LateReplies::default();
    late.given_up(&a, now - DEADLINE, now);
    late.answered(&a, now, now);
    late.settled_by(&read(0, 11), now);
    assert_eq!(late.asked_by(&a, later), now, "it looks the same");
    late.given_up(&half, now - DEADLINE, now);
    late.settled_by(&half, now);
    assert_eq!(late.asked_by(&a, later), now, "it may be late itself");
    late.settled_by(&read(0, 3), now);
    assert_eq!(late.asked_by(&a, later), later);
    assert!(
        late.blocks(&read(0, 11), now).is_some(),
        "look-alikes wait for their time"
    );
    late.given_up(&a, now, later);
    assert_eq!(late.asked_by(&a, later), now, "lost once more");
}
