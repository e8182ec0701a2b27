//! Whether an acknowledged command shows its effect: the first read after it that shows it confirms it. Pure.

use std::time::{Duration, Instant};

use crate::cache::Reading;
use crate::command::{Order, Receipt, written};
use crate::drive::profile::Form;
use crate::drive::{ModelPoint, PollClass, Profile, Value};

/// Commands watched at one time; beyond that the oldest stays "acknowledged".
const WATCHED: usize = 64;
/// A motor whose speed fell by this, in percent of the speed range, is on its way to a stop.
const SLOWER: f64 = 0.5;

/// What a read must show.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Effect {
    /// The motor runs.
    Runs,
    /// The motor stands, or is slower than at the acknowledgement.
    Stops,
    /// No fault is active.
    NoFault,
    /// The point (index in the profile) reads as it was written.
    ReadBack(usize, Value),
}

impl Effect {
    /// Two effects of which the newer one makes the older one pointless.
    fn same_subject(self, other: Effect) -> bool {
        match (self, other) {
            (Effect::Runs | Effect::Stops, Effect::Runs | Effect::Stops) | (Effect::NoFault, Effect::NoFault) => true,
            (Effect::ReadBack(a, _), Effect::ReadBack(b, _)) => a == b,
            _ => false,
        }
    }

    /// For people: what was not seen.
    fn missing(self, profile: &Profile) -> String {
        match self {
            Effect::Runs => "the motor does not run".to_string(),
            Effect::Stops => "the motor does not slow down".to_string(),
            Effect::NoFault => "the fault is still active".to_string(),
            Effect::ReadBack(index, value) => {
                let name = profile.points.get(index).map_or("?", |p| p.name.as_str());
                format!("`{name}` does not read {value}")
            }
        }
    }
}

/// What the order must show, as far as the plan reads it; empty when nothing of it is read.
pub fn effects(profile: &Profile, order: &Order) -> Vec<Effect> {
    let mut effects: Vec<Effect> = Vec::new();
    let mut add = |effect: Option<Effect>| {
        if let Some(effect) = effect
            && !effects.contains(&effect)
        {
            effects.push(effect);
        }
    };
    match order {
        Order::Points(values) => {
            for (index, value) in values {
                add(effect_of(profile, *index, *value));
            }
        }
        Order::Write(pdu) => {
            let Some((table, items)) = written(pdu) else {
                return effects;
            };
            let word_at = |address| items.iter().find(|(at, _)| *at == address).map(|(_, word)| *word);
            for (index, point) in profile.points.iter().enumerate().filter(|(_, p)| p.write && !p.pulse) {
                let Some(raw) = point.raw().filter(|r| r.table == table) else {
                    continue;
                };
                let words: Option<Vec<u16>> = raw.addresses().map(word_at).collect();
                if let Some(value) = words.and_then(|words| raw.decode(&words, point.kind())) {
                    add(effect_of(profile, index, value));
                }
            }
        }
        Order::Read(_) => {}
    }
    effects
}

fn effect_of(profile: &Profile, index: usize, value: Value) -> Option<Effect> {
    let is = |point| profile.model_index(point) == Some(index);
    let reads = |point| profile.model_point(point).is_some_and(|p| p.class != PollClass::Never);
    if is(ModelPoint::Run) && reads(ModelPoint::Running) {
        return Some(if value.as_bool() { Effect::Runs } else { Effect::Stops });
    }
    if is(ModelPoint::FaultReset) {
        return (value.as_bool() && reads(ModelPoint::Fault)).then_some(Effect::NoFault);
    }
    let point = profile.points.get(index)?;
    let readable = point.class != PollClass::Never && !point.pulse && point.raw().is_some();
    readable.then_some(Effect::ReadBack(index, value))
}

/// Whether the reading shows it, by samples that were read after `since`.
fn shows(effect: Effect, reading: &Reading<'_>, since: Instant, speed: Option<f64>) -> bool {
    let after = |sample: crate::drive::Sample| sample.good().filter(|_| sample.at.is_some_and(|at| at > since));
    match effect {
        Effect::Runs => after(reading.model(ModelPoint::Running)).is_some_and(Value::as_bool),
        Effect::NoFault => after(reading.model(ModelPoint::Fault)).is_some_and(|fault| !fault.as_bool()),
        Effect::Stops => {
            let stands = after(reading.model(ModelPoint::Running)).is_some_and(|running| !running.as_bool());
            let slower = after(reading.model(ModelPoint::ActualSpeed))
                .zip(speed)
                .is_some_and(|(now, before)| now.as_f64().abs() < before - SLOWER);
            stands || slower
        }
        Effect::ReadBack(index, value) => {
            let read = after(reading.sample(index));
            let raw = reading.spec.profile.points.get(index).and_then(|p| p.raw());
            match (read, raw) {
                (Some(read), Some(raw)) if matches!(raw.form, Form::Bit { .. }) => read.as_bool() == value.as_bool(),
                // Compared as the register holds them.
                (Some(read), Some(raw)) => raw.encode(read, 0).ok() == raw.encode(value, 0).ok(),
                _ => false,
            }
        }
    }
}

/// An acknowledged command whose effect is waited for.
#[derive(Debug)]
struct Watch {
    drive: usize,
    effects: Vec<Effect>,
    since: Instant,
    within: Duration,
    /// Amount of the speed at the acknowledgement, percent.
    speed: Option<f64>,
    receipt: Receipt,
}

impl Watch {
    fn is_over(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.since) >= self.within
    }
}

/// A command that showed no effect in time.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NotConfirmed {
    /// Index of the drive.
    pub drive: usize,
    /// For people.
    pub text: String,
}

/// The acknowledged commands of a bus that may still be confirmed.
#[derive(Debug, Default)]
pub struct Confirmations(Vec<Watch>);

impl Confirmations {
    /// A command was acknowledged at `now`; `reading` is the drive as it is known then. Older commands that want the
    /// contrary are not waited for any more.
    pub fn watch(&mut self, drive: usize, effects: Vec<Effect>, receipt: Receipt, reading: &Reading<'_>, now: Instant) {
        self.0.retain(|w| {
            let pointless = |old: &Effect| effects.iter().any(|new| new.same_subject(*old));
            w.drive != drive || !w.effects.iter().any(pointless)
        });
        if effects.is_empty() {
            return;
        }
        if self.0.len() >= WATCHED {
            self.0.remove(0);
        }
        self.0.push(Watch {
            drive,
            effects,
            since: now,
            within: reading.spec.profile.confirm_within,
            speed: reading.model(ModelPoint::ActualSpeed).good().map(|v| v.as_f64().abs()),
            receipt,
        });
    }

    /// A drive was read: what shows its effect now, in time, is confirmed.
    pub fn look(&mut self, drive: usize, reading: &Reading<'_>, now: Instant) {
        let mut index = 0;
        while let Some(watch) = self.0.get_mut(index) {
            if watch.drive == drive && !watch.is_over(now) {
                let (since, speed) = (watch.since, watch.speed);
                watch.effects.retain(|e| !shows(*e, reading, since, speed));
                if watch.effects.is_empty() {
                    self.0.remove(index).receipt.confirm(now);
                    continue;
                }
            }
            index += 1;
        }
    }

    /// What showed no effect in time, each told once. `profile` gives that of a drive.
    pub fn expire<'p>(&mut self, profile: impl Fn(usize) -> Option<&'p Profile>, now: Instant) -> Vec<NotConfirmed> {
        let mut told = Vec::new();
        self.0.retain(|watch| {
            let over = watch.is_over(now);
            if over {
                let missing: Vec<String> = profile(watch.drive)
                    .map(|p| watch.effects.iter().map(|e| e.missing(p)).collect())
                    .unwrap_or_default();
                told.push(NotConfirmed {
                    drive: watch.drive,
                    text: format!(
                        "acknowledged {} but did not show it within {:?}: {}",
                        watch.receipt.what(),
                        watch.within,
                        missing.join(", ")
                    ),
                });
            }
            !over
        });
        told
    }

    /// Waits for nothing any more: what was acknowledged stays so.
    pub fn clear(&mut self) {
        self.0.clear();
    }

    /// Whether none is watched.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

#[cfg(test)]
mod tests {

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
            let origin = Origin::new(SourceKind::Mqtt, "t");
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
}
