//! Tests of the whole recorder in virtual time: the test tapes reads of a bus, and they become recordings.

mod files;
mod trends;

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use super::assemble::assemble;
use super::recorder::{Note, NoteBody};
use super::recording::Recording;
use super::*;
use crate::process_image::{
    BusImage, BusSpec, DriveSpec, Link, Outcome, PointTrigger, TapedFrame, TapedRead, Taping, TriggerLimit, Verdict,
};
use crate::testkit::{self, bus_spec, monitored, nx};
use drivegate_model::drive::{DriveIndex, ModelPoint};
use drivegate_proto::{LineFormat, Table};

const POLL: Duration = Duration::from_millis(10);
const STALE_AFTER: Duration = Duration::from_secs(1);
/// Bits of the status word: ready, running, fault, warning.
const RUNS: u16 = 0x0003;
const FAULT: u16 = 0x0008;
const WARNING: u16 = 0x0010;

pub(super) fn options() -> RecorderOptions {
    RecorderOptions {
        dir: PathBuf::from("/nowhere"),
        before: Duration::from_secs(30),
        after: Duration::from_secs(10),
        max_bytes: 1 << 30,
        max_count: 100,
        warnings: false,
    }
}

/// A line with Vacon NX drives. The test itself does the polls.
pub(super) struct Rig {
    pub(super) bus: Arc<BusImage>,
    pub(super) recorder: Recorder,
    pub(super) history: Arc<History>,
    pub(super) clock: Clock,
}

impl Rig {
    pub(super) fn new(options: RecorderOptions, drives: usize, triggers: &[PointTrigger]) -> Rig {
        let nx = nx();
        let image = |number: usize| {
            let spec = DriveSpec {
                triggers: triggers.to_vec(),
                ..monitored(&format!("pump-{number}"), "line1", number as u8, &nx)
            };
            let image = testkit::image(spec);
            image.update(|s| s.link = Link::Online(SystemTime::UNIX_EPOCH));
            image
        };
        let spec = BusSpec {
            format: LineFormat::new(115_200, "8N1").unwrap(),
            cycle: POLL,
            ..bus_spec("line1")
        };
        let bus = Arc::new(BusImage::new(spec, (1..=drives).map(image).collect()));
        let clock = Clock {
            now: Instant::now() + Duration::from_secs(3600),
            wall: SystemTime::UNIX_EPOCH + Duration::from_millis(1_770_000_000_000),
        };
        let history = Arc::<History>::default();
        let mut recorder = Recorder::new(options, history.clone());
        assert!(
            recorder
                .adopt(std::slice::from_ref(&bus), STALE_AFTER, clock)
                .is_empty()
        );
        Rig {
            bus,
            recorder,
            history,
            clock,
        }
    }

    pub(super) fn history(&self) -> Arc<DriveHistory> {
        self.history.drive("pump-1").unwrap()
    }

    pub(super) fn pass(&mut self, time: Duration) {
        self.clock.now += time;
        self.clock.wall += time;
    }

    /// The drive is polled: status word, current in 0.1 A, fault code.
    pub(super) fn poll(&mut self, drive: usize, status: u16, current: u16, code: u16) {
        let at = self.clock.now;
        let words = [status, 0, 8200, 4100, 1200, current, 0, 0, 0, 655, code];
        self.bus.tape.read(DriveIndex::new(drive), || TapedRead {
            at,
            table: Table::Holding,
            start: 2100,
            words: words.into(),
        });
    }

    pub(super) fn fail(&mut self, drive: usize) {
        let at = self.clock.now;
        self.bus.tape.frame(|| TapedFrame {
            at,
            drive: Some(DriveIndex::new(drive)),
            verdict: Verdict::Timeout,
            bytes: [].into(),
        });
    }

    /// Polls at the cadence for a time; the recordings that are complete.
    pub(super) fn polls(&mut self, time: Duration, mut poll: impl FnMut(&mut Rig, usize)) -> Vec<Recording> {
        let mut made = Vec::new();
        for n in 0..(time.as_millis() / POLL.as_millis()) as usize {
            poll(self, n);
            self.pass(POLL);
            if n % 10 == 9 {
                made.extend(self.recorder.tick(self.clock).iter().map(assemble));
            }
        }
        made
    }
}

const SECOND: Duration = Duration::from_secs(1);

#[test]
fn an_over_current_ramp_is_found_to_the_value_and_the_poll() {
    let mut rig = Rig::new(options(), 1, &[]);
    // 40 s at 80 A, then 0.7 A more at each poll until it trips at the 100th.
    assert!(rig.polls(40 * SECOND, |rig, _| rig.poll(0, RUNS, 800, 0)).is_empty());
    let made = rig.polls(12 * SECOND, |rig, n| match n {
        0..100 => rig.poll(0, RUNS, 800 + 7 * n as u16, 0),
        100 => rig.poll(0, FAULT, 0, 1),
        _ => rig.poll(0, FAULT, 0, 1),
    });
    let [recording] = &made[..] else {
        panic!("{}", made.len())
    };
    let header = &recording.header;
    assert_eq!(
        (header.trigger, header.from, header.to),
        (TriggerKind::Fault, -30.0, 10.0)
    );
    let currents = recording.values_of("motor_current");
    // Expected: 30 s before the fault, the poll that shows the fault, and 10 s after it, without a missing poll.
    assert_eq!(currents.len(), 3000 + 1 + 1000);
    for (place, (t, value)) in currents.iter().enumerate() {
        let poll = place as i64 - 3000;
        assert!((t - poll as f64 * 0.01).abs() < 1e-6, "{t} at {poll}");
        let expected = match poll {
            0.. => 0.0,
            -100..0 => 80.0 + 0.7 * (poll + 100) as f64,
            _ => 80.0,
        };
        assert!((value.as_f64().unwrap() - expected).abs() < 1e-9, "{value} at {poll}");
    }
    assert_eq!(
        header.summary,
        "fault 1: overcurrent; speed 82 %, current 149.3 A rising, DC 655 V"
    );
    assert_eq!(header.time, "2026-02-02T02:40:41.000000Z");
    assert_eq!(header.id, "20260202T024041.000Z-pump-1");
}

#[test]
fn a_fault_of_one_poll_makes_a_recording_and_one_that_is_there_at_first_does_not() {
    let mut rig = Rig::new(options(), 2, &[]);
    let made = rig.polls(60 * SECOND, |rig, n| {
        rig.poll(
            0,
            if n == 3500 { FAULT } else { RUNS },
            0,
            if n == 3500 { 53 } else { 0 },
        );
        rig.poll(1, FAULT, 0, 9);
    });
    let [recording] = &made[..] else {
        panic!("{}", made.len())
    };
    assert_eq!(recording.header.drive.name, "pump-1");
    let faults = recording.values_of("fault");
    let seen: Vec<f64> = faults.iter().filter(|(_, v)| **v == true).map(|(t, _)| *t).collect();
    assert_eq!(seen, [0.0]);
    assert!(
        recording.header.summary.starts_with("fault 53: "),
        "{}",
        recording.header.summary
    );
}

#[test]
fn warnings_make_recordings_only_where_that_is_wanted() {
    for (warnings, expected) in [(false, 0), (true, 1)] {
        let mut rig = Rig::new(RecorderOptions { warnings, ..options() }, 1, &[]);
        let made = rig.polls(20 * SECOND, |rig, n| {
            rig.poll(0, if n > 500 { RUNS | WARNING } else { RUNS }, 0, 0);
        });
        assert_eq!(made.len(), expected);
    }
}

#[test]
fn a_point_beyond_its_limit_for_its_time_makes_one_recording() {
    let nx = testkit::nx();
    let above = PointTrigger {
        point: nx.point_index("motor_current").unwrap(),
        limit: TriggerLimit::Above(120.0),
        lasts: 2 * SECOND,
    };
    let mut rig = Rig::new(options(), 1, &[above]);
    let made = rig.polls(60 * SECOND, |rig, n| {
        // The value is beyond its limit for 1.9 s, back for one poll, then beyond it for long.
        let high = (1000..3000).contains(&n) && n != 1190;
        rig.poll(0, RUNS, if high { 1201 } else { 1200 }, 0);
    });
    let [recording] = &made[..] else {
        panic!("{}", made.len())
    };
    assert_eq!(recording.header.trigger, TriggerKind::Point);
    let currents = recording.values_of("motor_current");
    let beyond = currents
        .iter()
        .filter(|(t, value)| *t <= 0.0 && *t > -2.0 - 1e-9 && value.as_f64() == Some(120.1));
    assert_eq!(beyond.count(), 201, "two seconds without interruption");
    assert!(
        recording.header.summary.starts_with("motor_current above 120 A; "),
        "{}",
        recording.header.summary
    );
}

#[test]
fn a_burst_of_errors_is_told_of_with_the_drive_that_has_most_of_them() {
    let mut rig = Rig::new(options(), 3, &[]);
    let made = rig.polls(30 * SECOND, |rig, n| {
        rig.poll(0, RUNS, 0, 0);
        if n >= 500 && n % 50 == 0 {
            rig.fail(1);
        }
        if n >= 500 && n % 150 == 0 {
            rig.fail(2);
        }
    });
    let [recording] = &made[..] else {
        panic!("{}", made.len())
    };
    assert_eq!(
        (recording.header.trigger, recording.header.drive.name.as_str()),
        (TriggerKind::LineErrors, "pump-2")
    );
    let summary = &recording.header.summary;
    assert!(
        summary.contains("failed within 10 s") && summary.contains("timeouts"),
        "{summary}"
    );
    // A drive that does not answer at all makes one of another kind.
    let mut rig = Rig::new(options(), 1, &[]);
    rig.bus.drives[0].update(|s| s.link = Link::Offline(SystemTime::UNIX_EPOCH));
    assert!(
        rig.polls(30 * SECOND, |rig, n| if n % 10 == 0 {
            rig.fail(0)
        })
        .is_empty()
    );
}

#[test]
fn triggers_while_a_recording_goes_on_are_noted_in_it() {
    let mut rig = Rig::new(options(), 1, &[]);
    rig.polls(5 * SECOND, |rig, _| rig.poll(0, RUNS, 0, 0));
    let command = |at| Trigger {
        kind: TriggerKind::Command,
        at,
        text: "requested by uid 0".to_string(),
    };
    let clock = rig.clock;
    let first = rig.recorder.trigger("pump-1", command(clock.now), clock);
    assert_eq!(rig.recorder.trigger("pump-9", command(clock.now), clock), None);
    rig.recorder.note(
        "line1",
        Some("pump-1"),
        &Note {
            at: clock.now,
            body: NoteBody::Command {
                source: "mqtt",
                client: "t".to_string(),
                command: "run=false".to_string(),
                result: "confirmed",
                latency: Duration::from_millis(9),
            },
        },
    );
    let made = rig.polls(20 * SECOND, |rig, n| {
        rig.poll(0, if n == 100 { FAULT } else { RUNS }, 0, 5)
    });
    let [recording] = &made[..] else {
        panic!("{}", made.len())
    };
    assert_eq!(Some(&recording.header.id), first.as_ref());
    let more: Vec<_> = recording
        .header
        .more
        .iter()
        .map(|more| (more.t, more.trigger))
        .collect();
    assert_eq!(more, [(1.0, TriggerKind::Fault)]);
    assert_eq!(recording.header.from, -30.0);
    assert_eq!(recording.samples.len(), 1501, "there was no more before");
    assert_eq!((recording.commands[0].t, recording.commands[0].latency_ms), (0.0, 9.0));
}

#[test]
fn what_repeats_makes_a_recording_a_minute() {
    let mut rig = Rig::new(options(), 1, &[]);
    let mut begun = 0;
    let lost = |rig: &mut Rig| {
        let trigger = Trigger {
            kind: TriggerKind::Lost,
            at: rig.clock.now,
            text: "away".to_string(),
        };
        rig.recorder.trigger("pump-1", trigger, rig.clock)
    };
    assert_eq!(lost(&mut rig), None, "it was never there");
    rig.poll(0, RUNS, 0, 0);
    rig.recorder.tick(rig.clock);
    for _ in 0..300 {
        lost(&mut rig);
        rig.pass(SECOND);
        begun += rig.recorder.tick(rig.clock).len();
    }
    assert_eq!(begun, 5);
}

#[test]
fn memory_is_bounded_by_the_budget_and_enough_for_every_poll() {
    let mut rig = Rig::new(options(), 1, &[]);
    let spec = rig.bus.drives[0].spec.clone();
    let budget = budget::Budget::of(&rig.bus.spec, &[spec], &options());
    // 41 s at 10 ms, with a quarter in reserve, and the slow reads.
    let read = packed_ring::packed_read(11);
    assert!(
        (4100 * read..4100 * read * 3 / 2).contains(&budget.samples[0]),
        "{budget:?}"
    );
    // A line that is faster than any real one: the oldest go.
    for _ in 0..20_000 {
        rig.poll(0, RUNS, 0, 0);
        rig.pass(Duration::from_micros(100));
        rig.recorder.tick(rig.clock);
    }
    let trigger = Trigger {
        kind: TriggerKind::Command,
        at: rig.clock.now,
        text: String::new(),
    };
    rig.recorder.trigger("pump-1", trigger, rig.clock);
    let made = rig.recorder.end(rig.clock);
    assert_eq!(made.len(), 1);
    assert_eq!(made[0].samples.len(), budget.samples[0] / read);
    let off = RecorderOptions {
        max_count: 0,
        ..options()
    };
    assert_eq!(budget::Budget::of(&rig.bus.spec, &[], &off).total(), 0);
}

#[test]
fn a_reload_keeps_what_stays_and_ends_what_goes() {
    let mut rig = Rig::new(options(), 1, &[]);
    rig.polls(5 * SECOND, |rig, n| {
        rig.poll(0, if n == 300 { FAULT } else { RUNS }, 0, 5)
    });
    let (bus, clock) = (rig.bus.clone(), rig.clock);
    assert!(
        rig.recorder
            .adopt(std::slice::from_ref(&bus), STALE_AFTER, clock)
            .is_empty()
    );
    assert!(bus.tape.records(Taping::Reads));
    let made = rig.recorder.adopt(&[], STALE_AFTER, clock);
    assert!(!bus.tape.records(Taping::Reads));
    let [recording] = &made.iter().map(assemble).collect::<Vec<_>>()[..] else {
        panic!()
    };
    assert_eq!((recording.samples.len(), recording.header.to), (500, 2.0));
}
