use std::sync::Arc;

use super::*;
use crate::cache::{Access, DriveImage, DriveSpec, Link};
use crate::codec::{Reply, RequestPdu, Table};
use crate::command::{Origin, Outcome, SourceKind, Ticket, WriteStats};
use crate::drive::profile::Profiles;

struct Bench {
    drive: DriveImage,
    stats: Arc<WriteStats>,
    confirmations: Confirmations,
    now: Instant,
}

impl Bench {
    fn new() -> Bench {
        let spec = DriveSpec {
            access: Access::Control,
            turnaround: Duration::ZERO,
            ..DriveSpec::new("d", "b", 1, Profiles::built_in().get("vacon-nx").unwrap().clone())
        };
        let drive = DriveImage::new(spec, Duration::from_secs(1));
        drive.update(|s| s.link = Link::Online(std::time::SystemTime::now()));
        let mut bench = Bench {
            drive,
            stats: Arc::default(),
            confirmations: Confirmations::default(),
            now: Instant::now(),
        };
        bench.read(2100, &[0]);
        bench
    }

    fn acknowledge(&mut self, order: &Order) {
        let origin = Origin {
            kind: SourceKind::Mqtt,
            who: "t".to_string(),
        };
        let (ticket, _) = Ticket::new(origin, "d", "it".to_string(), true, self.now, self.stats.clone());
        let receipt = ticket.acknowledge(Outcome::Acknowledged(Reply::Written), self.now);
        let effects = effects(&self.drive.spec.profile, order);
        let reading = self.drive.reading(self.now, Duration::from_secs(1));
        self.confirmations.watch(0, effects, receipt, &reading, self.now);
    }

    fn set(&mut self, point: &str, value: Value) {
        let index = self.drive.spec.profile.point_index(point).unwrap();
        self.acknowledge(&Order::Points(vec![(index, value)]));
    }

    /// 10 ms later the drive answered with these words.
    fn read(&mut self, start: u16, words: &[u16]) {
        self.now += Duration::from_millis(10);
        let now = self.now;
        self.drive.update(|s| s.store(Table::Holding, start, words, now));
        let reading = self.drive.reading(now, Duration::from_secs(1));
        self.confirmations.look(0, &reading, now);
    }

    fn results(&self) -> Vec<&'static str> {
        self.stats.audit().recent().iter().map(|r| r.result).collect()
    }

    fn expired(&mut self) -> Vec<NotConfirmed> {
        let profile = self.drive.spec.profile.clone();
        self.confirmations.expire(|_| Some(&profile), self.now)
    }
}

#[test]
fn only_a_read_after_the_acknowledgement_confirms() {
    let mut bench = Bench::new();
    bench.read(2100, &[2]);
    bench.set("run", Value::Bool(true));
    let reading_before = bench.drive.reading(bench.now, Duration::from_secs(1));
    let now = bench.now;
    bench.confirmations.look(0, &reading_before, now);
    assert!(bench.results().is_empty(), "the old sample proves nothing");
    bench.read(2100, &[2]);
    assert_eq!(bench.results(), ["confirmed"]);
    assert_eq!(
        bench.stats.audit().recent()[0].confirmed,
        Some(Duration::from_millis(10))
    );
    assert!(bench.expired().is_empty());
}

#[test]
fn a_stop_is_confirmed_while_the_motor_slows_down() {
    let mut bench = Bench::new();
    bench.read(2100, &[2, 0, 5000]);
    bench.set("run", Value::Bool(false));
    bench.read(2100, &[2, 0, 4990]);
    assert!(bench.results().is_empty());
    bench.read(2100, &[2, 0, 4900]);
    assert_eq!(bench.results(), ["confirmed"]);
}

#[test]
fn references_and_raw_writes_are_read_back() {
    let mut bench = Bench::new();
    bench.set("speed_reference", Value::Number(33.333));
    bench.read(2002, &[0]);
    assert!(bench.results().is_empty());
    bench.read(2002, &[3333]);
    assert_eq!(bench.results(), ["confirmed"]);
    bench.acknowledge(&Order::Write(RequestPdu::WriteRegisters {
        start: 2000,
        values: vec![1, 0, 2000],
    }));
    bench.read(2000, &[1, 0, 2000]);
    assert_eq!(
        bench.results().len(),
        1,
        "the run bit was read back, the motor does not run yet"
    );
    bench.read(2100, &[2]);
    assert_eq!(bench.results(), ["confirmed", "confirmed"]);
}

#[test]
fn what_shows_too_late_is_not_confirmed() {
    let mut bench = Bench::new();
    bench.set("run", Value::Bool(true));
    bench.now += Duration::from_secs(2);
    bench.read(2100, &[2]);
    assert!(bench.results().is_empty());
    assert_eq!(bench.expired().len(), 1);
    assert_eq!(bench.results(), ["acknowledged"]);
}

#[test]
fn what_is_not_waited_for_any_more_stays_acknowledged() {
    let mut bench = Bench::new();
    bench.set("run", Value::Bool(true));
    bench.confirmations.clear();
    assert_eq!(bench.results(), ["acknowledged"]);
    bench.read(2100, &[2]);
    assert!(bench.expired().is_empty() && bench.results().len() == 1);
}

#[test]
fn what_does_not_show_is_told_once_and_what_was_overtaken_is_not() {
    let mut bench = Bench::new();
    bench.set("fault_reset", Value::Bool(true));
    bench.set("run", Value::Bool(true));
    bench.set("run", Value::Bool(false));
    assert_eq!(bench.results(), ["acknowledged"], "the stop overtook the run");
    bench.read(2100, &[8]);
    assert_eq!(bench.results(), ["acknowledged", "confirmed"], "it stands");
    bench.now += Duration::from_secs(2);
    let told = bench.expired();
    assert_eq!(told.len(), 1);
    assert_eq!(
        told[0].text,
        "acknowledged it but did not show it within 2s: the fault is still active"
    );
    assert_eq!(bench.results(), ["acknowledged", "confirmed", "acknowledged"]);
    assert!(bench.expired().is_empty() && bench.confirmations.is_empty());
}
