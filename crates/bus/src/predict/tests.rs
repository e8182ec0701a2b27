use std::sync::Arc;
use std::time::Instant;

use drivegate_testkit::{bus_spec, monitored};

use super::super::schedule::{Cadence, Decision, Polled, Schedule};
use super::*;
use drivegate_model::drive::{DriveIndex, Profile};

/// A family whose drives are read by one fast request of 11 registers, and by slow ones of 10 each.
fn profile(bauds: &str, slow: usize) -> Arc<Profile> {
    let mut text = format!(
        "name = \"p\"\nprotocols = [\"modbus-rtu\"]\nbauds = {bauds}\nturnaround = \"0.5ms\"\n\
         [[range]]\ntable = \"holding\"\nfirst = 2100\nlast = 2110\nread = 11\nholes = true\n"
    );
    for k in 0..slow {
        let first = 100 * k;
        text += &format!(
            "[[range]]\ntable = \"holding\"\nfirst = {first}\nlast = {}\nread = 10\nholes = true\n",
            first + 9
        );
        for address in [first, first + 9] {
            text += &format!("[[point]]\nname = \"s{address}\"\nat = \"holding {address}\"\nclass = \"slow\"\n");
        }
    }
    for address in [2100, 2110] {
        text += &format!("[[point]]\nname = \"f{address}\"\nat = \"holding {address}\"\nclass = \"fast\"\n");
    }
    Arc::new(Profile::parse("p.toml", &text, false).unwrap())
}

fn drives(profile: &Arc<Profile>, count: u8) -> Vec<DriveSpec> {
    (1..=count)
        .map(|address| monitored(&format!("d{address}"), "b", address, profile))
        .collect()
}

fn spec(baud: u32, cycle_ms: u64, slow_ms: u64) -> BusSpec {
    BusSpec {
        format: LineFormat::new(baud, "8N1").unwrap(),
        cycle: Duration::from_millis(cycle_ms),
        slow_cycle: Duration::from_millis(slow_ms),
        ..bus_spec("b")
    }
}

fn ms(time: Option<Duration>) -> f64 {
    time.map_or(f64::NAN, |t| t.as_secs_f64() * 1e3)
}

#[track_caller]
fn near(found: f64, wanted: f64) {
    assert!(
        (found - wanted).abs() < 0.001 * wanted.max(1.0),
        "{found} is not {wanted}"
    );
}

#[test]
fn wire_time_is_request_recognition_turnaround_reply_silence() {
    // 38400 8N1, 10 bits a character: request 8 characters 2.0833 ms, recognition 3.5 characters 0.9115 ms,
    // turnaround 0.5 ms, reply of 11 registers 27 characters 7.03125 ms, silence 0.9115 ms or 1.75 ms.
    let drives = drives(&profile("[]", 0), 1);
    for (silence, wanted) in [
        (Silence::Chars, 11.4375),
        (Silence::Spec, 12.2760),
        (Silence::Fixed(Duration::from_millis(5)), 15.5260),
    ] {
        let p = predict(&spec(38_400, 20, 1000), silence, &drives);
        near(ms(Some(p.requests[0].wire)), wanted);
        near(ms(p.fast_cycle), 20.0);
        near(p.load, wanted / 20.0);
        assert_eq!((p.slow_cycle, p.shortage), (None, None));
    }
}

#[test]
fn a_saturated_line_gives_slow_polls_five_percent() {
    // Fast round 10 x 11.4375 ms; slow round 10 x 2 requests of 10 registers: 8 + 25 characters and twice 3.5, 10.9167 ms.
    let drives = drives(&profile("[9600, 38400]", 2), 10);
    let p = predict(&spec(38_400, 10, 1000), Silence::Chars, &drives);
    near(ms(p.fast_cycle), 114.375 / 0.95);
    near(ms(p.slow_cycle), 218.333 / 0.05);
    assert_eq!(p.load, 1.0);
    near(p.demand, 11.4375 + 0.21833);
    let shortage = p.shortage.unwrap();
    assert_eq!(shortage.fast.unwrap().requests, 10);
    assert_eq!(shortage.slow.unwrap().requests, 20);
    // Three slow requests fit after the fast ones of a round: 114.375 + 3 * 10.9167 ms = 147.1 ms, and 3 * 10.9167
    // / 148 is the share they need. A single drive needs too much, so no split helps.
    let cycle = Duration::from_millis(148);
    assert_eq!(shortage.remedies, [Remedy::Cycle { cycle, baud: None }]);
    assert_eq!(
        shortage.finding().to_string(),
        "the line cannot carry cycle = \"10ms\" and slow_cycle = \"1s\": fast polling of 10 requests takes 114.4 ms, every 120.4 ms, slow polling of 20 requests takes 218.3 ms, every 4366.7 ms; set cycle = \"148ms\""
    );
    let carried = predict(&spec(38_400, 148, 1000), Silence::Chars, &drives);
    assert_eq!(carried.shortage, None);
}

#[test]
fn the_highest_baud_is_told_even_when_it_does_not_carry_all() {
    // At 9600 baud a drive takes 44.25 ms, at 38400 baud 11.4375 ms.
    let drives = drives(&profile("[9600, 19200, 38400]", 0), 1);
    let p = predict(&spec(9600, 10, 1000), Silence::Chars, &drives);
    let cycle = |ms, baud| Remedy::Cycle {
        cycle: Duration::from_millis(ms),
        baud,
    };
    assert_eq!(p.shortage.unwrap().remedies, [cycle(12, Some(38_400)), cycle(45, None)]);
}

#[test]
fn slow_polls_take_what_is_left() {
    // 5 fast requests of 11.4375 ms leave 17.8 ms of 75 ms: room for one slow request of 10.9 ms, ten make a
    // slow round.
    let drives = drives(&profile("[38400]", 2), 5);
    let p = predict(&spec(38_400, 75, 200), Silence::Chars, &drives);
    near(ms(p.fast_cycle), 75.0);
    near(ms(p.slow_cycle), 750.0);
    let shortage = p.shortage.unwrap();
    assert_eq!((shortage.fast, shortage.slow.map(|s| s.requests)), (None, Some(10)));
    let longer = Remedy::SlowCycle(Duration::from_millis(750));
    assert!(shortage.remedies.contains(&longer), "{shortage:?}");
    assert_eq!(predict(&spec(38_400, 75, 750), Silence::Chars, &drives).shortage, None);
}

#[test]
fn the_least_baud_of_the_profile_that_would_do() {
    let drives = drives(&profile("[9600, 19200, 38400, 115200]", 0), 3);
    let p = predict(&spec(9600, 40, 1000), Silence::Chars, &drives);
    assert_eq!(p.shortage.as_ref().unwrap().remedies[0], Remedy::Baud(38_400));
    let message = p.shortage.unwrap().finding().to_string();
    assert!(
        message.contains("cannot carry cycle = \"40ms\"") && message.contains("set baud = 38400"),
        "{message}"
    );
    let at = predict(&spec(38_400, 40, 1000), Silence::Chars, &drives);
    assert_eq!(at.shortage, None);
}

#[test]
fn a_family_without_bauds_gets_the_usual_ones() {
    let drives = drives(&profile("[]", 0), 3);
    let p = predict(&spec(38_400, 15, 1000), Silence::Chars, &drives);
    assert_eq!(p.shortage.as_ref().unwrap().remedies[0], Remedy::Baud(115_200));
}

#[test]
fn else_the_bus_is_split() {
    // At 38400 baud a drive takes 11.4375 ms of 25 ms: two drives fit on a bus, so seven drives need four buses.
    let drives = drives(&profile("[19200, 38400]", 0), 7);
    let p = predict(&spec(38_400, 25, 1000), Silence::Chars, &drives);
    assert_eq!(
        p.shortage.as_ref().unwrap().remedies[0],
        Remedy::Split { buses: 4, baud: None }
    );
    assert!(
        p.shortage
            .unwrap()
            .finding()
            .to_string()
            .contains("split the bus into 4 buses")
    );
    // At 19200 baud one drive takes 22.4 ms, so seven drives need seven buses; at 38400 baud they need four.
    let p = predict(&spec(19_200, 25, 1000), Silence::Chars, &drives);
    let split = Remedy::Split {
        buses: 4,
        baud: Some(38_400),
    };
    assert_eq!(p.shortage.as_ref().unwrap().remedies[0], split);
}

#[test]
fn nothing_to_read_is_no_load() {
    let p = predict(&spec(9600, 10, 1000), Silence::Spec, &[]);
    assert_eq!((p.fast_cycle, p.slow_cycle, p.load), (None, None, 0.0));
    assert!(p.requests.is_empty() && p.shortage.is_none());
}

#[test]
fn the_built_in_family_reads_as_planned() {
    let profiles = drivegate_model::drive::profile::Profiles::built_in();
    let drives = drives(profiles.get("vacon-nx").unwrap(), 2);
    let p = predict(&spec(9600, 100, 1000), Silence::Spec, &drives);
    let of_first: Vec<_> = p
        .requests
        .iter()
        .filter(|r| r.drive == 0)
        .map(|r| (r.read.class, r.read.start, r.read.count))
        .collect();
    let (fast, slow, once) = (PollClass::Fast, PollClass::Slow, PollClass::Once);
    assert_eq!(
        of_first,
        [
            (fast, 2100, 11),
            (slow, 7, 2),
            (slow, 100, 2),
            (slow, 2000, 3),
            (once, 102, 2),
            (once, 732, 2)
        ]
    );
    // 9600 8N1: 8 + 3.5 + 27 + 3.5 characters of 1.0417 ms, turnaround 2 ms.
    near(ms(Some(p.requests[0].wire)), 45.75);
}

#[test]
fn every_remedy_carries_the_cadences() {
    let mut tried = 0;
    for (count, slow) in [(1, 1), (1, 2), (3, 0), (3, 2), (10, 1), (10, 3)] {
        let drives = drives(&profile("[9600, 19200, 38400, 115200]", slow), count);
        for baud in [9600, 38_400, 115_200] {
            for (cycle, slow_cycle) in [(10, 1000), (20, 100), (50, 300), (200, 1000), (500, 600)] {
                let asked = spec(baud, cycle, slow_cycle);
                let Some(shortage) = predict(&asked, Silence::Spec, &drives).shortage else {
                    continue;
                };
                for remedy in shortage.remedies {
                    let mut mended = asked.clone();
                    match remedy {
                        Remedy::Baud(baud) => mended.format.baud = baud,
                        Remedy::Cycle { cycle, baud } => {
                            mended.cycle = cycle;
                            mended.format.baud = baud.unwrap_or(mended.format.baud);
                        }
                        Remedy::SlowCycle(cycle) => mended.slow_cycle = cycle,
                        Remedy::Split { buses, .. } => {
                            assert!(buses > 1 && buses <= usize::from(count));
                            continue;
                        }
                    }
                    let left = predict(&mended, Silence::Spec, &drives).shortage;
                    assert_eq!(
                        left, None,
                        "{remedy:?} for {count} drives, {slow} slow requests, {asked:?}"
                    );
                    tried += 1;
                }
            }
        }
    }
    assert!(tried > 50, "{tried}");
}

/// Fast and slow cycles, s, that the real schedule achieves on a line in virtual time.
fn scheduled(spec: &BusSpec, silence: Silence, drives: &[DriveSpec]) -> (f64, f64) {
    let requests = predict(spec, silence, drives).requests;
    let cost = |drive: DriveIndex, read: &PlannedRead| {
        let found = requests.iter().find(|r| r.drive == drive && r.read == *read);
        found.map_or(Duration::ZERO, |r| r.wire)
    };
    let plans: Vec<Plan> = drives.iter().map(|d| Plan::of(&d.profile)).collect();
    let begin = Instant::now();
    let cadence = Cadence {
        fast: spec.cycle,
        slow: spec.slow_cycle,
        retries: 1,
    };
    let mut schedule = Schedule::new(cadence, &plans.iter().collect::<Vec<_>>(), cost, begin);
    let (warm, end) = (begin + Duration::from_secs(100), begin + Duration::from_secs(1100));
    let mut now = begin;
    let (mut rounds, mut slow) = (0.0, 0.0);
    while now < end {
        match schedule.next(now, None) {
            Decision::Idle(until) => now = until,
            Decision::Poll(poll) => {
                let took = cost(poll.drive, &poll.read);
                now += took;
                schedule.poll_done(&poll, Polled::Ok, took, now);
                slow += f64::from(u8::from(poll.read.class == PollClass::Slow && now > warm));
            }
            Decision::Command(_) => panic!("nobody commands"),
        }
        rounds += f64::from(u8::from(schedule.take_round().is_some() && now > warm));
    }
    let requests = requests.iter().filter(|r| r.read.class == PollClass::Slow).count();
    (1000.0 / rounds, 1000.0 * requests as f64 / slow)
}

#[track_caller]
fn as_scheduled(spec: &BusSpec, drives: &[DriveSpec]) {
    let p = predict(spec, Silence::Chars, drives);
    let (fast_cycle, slow_cycle) = scheduled(spec, Silence::Chars, drives);
    for (predicted, found) in [
        (ms(p.fast_cycle), fast_cycle * 1e3),
        (ms(p.slow_cycle), slow_cycle * 1e3),
    ] {
        let off = (found / predicted - 1.0).abs();
        assert!(
            off < 0.01,
            "{found} ms, predicted were {predicted} ms: {} drives, {spec:?}",
            drives.len()
        );
    }
}

#[test]
fn the_schedule_does_what_is_predicted() {
    for (baud, cycle, slow_cycle, count, slow) in [
        (38_400, 10, 1000, 1, 2),
        (38_400, 10, 1000, 10, 2),
        (38_400, 15, 1000, 1, 1),
        (38_400, 15, 200, 1, 2),
        (38_400, 20, 500, 1, 2),
        (38_400, 75, 200, 5, 2),
        (38_400, 100, 1000, 5, 1),
        (38_400, 147, 1000, 10, 2),
        (38_400, 148, 1000, 10, 2),
        (9600, 100, 2000, 2, 3),
        (115_200, 10, 1000, 1, 2),
        (115_200, 50, 1000, 8, 4),
        (115_200, 50, 300, 8, 4),
    ] {
        as_scheduled(&spec(baud, cycle, slow_cycle), &drives(&profile("[]", slow), count));
    }
    let profiles = drivegate_model::drive::profile::Profiles::built_in();
    let family = profiles.get("vacon-nx").unwrap();
    for (baud, cycle, count) in [
        (9600, 10, 1),
        (9600, 10, 31),
        (19_200, 200, 3),
        (38_400, 10, 10),
        (38_400, 20, 1),
        (38_400, 50, 3),
        (115_200, 10, 1),
        (115_200, 100, 10),
    ] {
        as_scheduled(&spec(baud, cycle, 1000), &drives(family, count));
    }
}
