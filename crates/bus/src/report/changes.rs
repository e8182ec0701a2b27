//! Starts, stops, warnings and control places: which changes become events (each one, unless they are too
//! frequent), and which client caused them.

use std::time::{Duration, Instant, SystemTime};

use super::Report;
use drivegate_core::event::{Event, EventKind};
use drivegate_core::order::Origin;
use drivegate_core::process_image::Reading;
use drivegate_model::drive::{DriveIndex, ModelPoint, Value};

/// Time from a command to the poll that shows the motor running, ramps and slow polls included.
const STARTS_WITHIN: Duration = Duration::from_secs(30);
/// Maximum time from a stop command to the poll that shows the motor at standstill.
const STOPS_WITHIN: Duration = Duration::from_secs(300);

/// Points whose changes are events, with the texts for their start and end.
pub(super) const WATCHED: [(ModelPoint, [(EventKind, &str); 2]); 3] = [
    (
        ModelPoint::Running,
        [(EventKind::Started, "has started"), (EventKind::Stopped, "has stopped")],
    ),
    (
        ModelPoint::Warning,
        [
            (EventKind::Warning, "reports a warning"),
            (EventKind::WarningEnd, "no longer reports a warning"),
        ],
    ),
    (
        ModelPoint::Remote,
        [
            (EventKind::ControlPlace, "is controlled by the fieldbus"),
            (EventKind::ControlPlace, "is no longer controlled by the fieldbus"),
        ],
    ),
];

/// Changes of a bit that are reported at once.
const BURST: u32 = 10;
/// Time after which one more change is reported.
const EVERY: Duration = Duration::from_secs(10);

/// A bit whose changes become events.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Watched {
    /// Value as last reported; `None` before the first read.
    reported: Option<bool>,
    /// The value last read, and when it changed to that.
    seen: Option<(bool, Option<Instant>)>,
    /// Number of changes since the last report.
    changes: u64,
    /// Recent reports, and since when they are counted.
    spent: Option<(u32, Instant)>,
}

/// A change of a bit to be reported.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Change {
    /// Present value of the bit.
    pub(super) value: bool,
    /// When the bit changed the last time before, if that was seen.
    pub(super) before: Option<Instant>,
    /// Number of earlier changes that were not reported.
    pub(super) left_out: u64,
}

impl Watched {
    /// Processes a reading of the bit. The first value read is not a change. A bit that changes too often is
    /// reported at intervals, with the number of omitted changes, and finally with its value.
    pub(super) fn read(&mut self, value: bool, now: Instant) -> Option<Change> {
        let Some((seen, before)) = self.seen else {
            (self.seen, self.reported) = (Some((value, None)), Some(value));
            return None;
        };
        if seen != value {
            self.changes += 1;
            self.seen = Some((value, Some(now)));
        }
        if self.reported == Some(value) || !self.may_report(now) {
            return None;
        }
        self.reported = Some(value);
        let changes = std::mem::take(&mut self.changes);
        Some(Change {
            value,
            before: before.filter(|_| changes == 1),
            left_out: changes.saturating_sub(1),
        })
    }

    /// Whether the bit was set at the last read.
    fn is_set(&self) -> bool {
        self.seen.is_some_and(|(value, _)| value)
    }

    fn may_report(&mut self, now: Instant) -> bool {
        let (spent, since) = self.spent.unwrap_or((0, now));
        let passed = now.saturating_duration_since(since);
        let regained = u32::try_from(passed.as_nanos() / EVERY.as_nanos()).unwrap_or(u32::MAX);
        let (spent, since) = match spent.saturating_sub(regained) {
            0 => (0, now),
            left => (left, since + EVERY * regained),
        };
        let may = spent < BURST;
        self.spent = Some((spent + u32::from(may), since));
        may
    }
}

/// Text with the cause of a start or stop: the client that gave the command.
fn cause(who: &str) -> String {
    match who.split_once(' ') {
        Some(("supervision", Origin::LOCAL)) => ": the drive was switched to its local control place".to_string(),
        Some(("supervision", _)) => ": supervision timed out".to_string(),
        Some(("shutdown", _)) => ": the gateway is shutting down".to_string(),
        Some(("interlock", _)) => ": an interlock is not satisfied".to_string(),
        _ => format!(": commanded by {who}"),
    }
}

impl Report {
    /// Starts, stops, warnings and control places that changed with the last poll. The value at the first read is not
    /// an event; a change while the drive was offline is one.
    pub(super) fn report_state(&mut self, index: DriveIndex, reading: &Reading<'_>) {
        let now = reading.now;
        let samples = WATCHED.map(|(point, _)| reading.model(point));
        for ((place, (point, changes)), sample) in WATCHED.into_iter().enumerate().zip(&samples) {
            let Some(Value::Bool(value)) = sample.good() else {
                continue;
            };
            let watched = self.watched.of_mut(index).get_mut(place);
            let Some(change) = watched.and_then(|watched| watched.read(value, now)) else {
                continue;
            };
            let [comes, goes] = changes;
            let (kind, words) = if value { comes } else { goes };
            let name = &reading.spec.name;
            let by = (point == ModelPoint::Running).then(|| self.who(name, change, now));
            let mut text = format!("drive {name} {words}");
            match &by {
                Some(Some(who)) => text += &cause(who),
                Some(None) if reading.is_set(ModelPoint::Fault) => text += ": it has a fault",
                Some(None) => {
                    text += ", without a command from this gateway: at the drive, by another master or by itself"
                }
                None => {}
            }
            if change.left_out > 0 {
                text += &format!(" ({} changes before it omitted, too frequent)", change.left_out);
            }
            self.publish(Event {
                drive: Some(name.clone()),
                by: by.flatten(),
                ..Event::new(kind, SystemTime::now(), text)
            });
        }
        let [running, ..] = &samples;
        let age = running
            .at
            .map_or(Duration::ZERO, |at| now.saturating_duration_since(at));
        let runs = self.watched.iter().any(|[running, ..]| running.is_set());
        self.diagnosis.figures().set_running(runs, age);
    }

    /// The client that ordered the start or stop of a motor: that of the last order to the drive, if the order fits and had
    /// no other effect before.
    fn who(&self, drive: &str, change: Change, now: Instant) -> Option<String> {
        let ordered = self.command_log.audit().last_ordered(drive)?;
        let within = if change.value { STARTS_WITHIN } else { STOPS_WITHIN };
        let is_recent = now.saturating_duration_since(ordered.at) <= within;
        let is_new = change.left_out == 0 && change.before.is_none_or(|before| ordered.at > before);
        (ordered.run == change.value && is_recent && is_new).then_some(ordered.who)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn each_change_is_reported_once() {
        let (mut bit, start) = (Watched::default(), Instant::now());
        let mut reported = Vec::new();
        for second in 0..100u32 {
            // The first read is not a change.
            let value = second / 20 % 2 == 0;
            if let Some(change) = bit.read(value, start + SECOND * second) {
                reported.push((second, change));
            }
        }
        let seconds: Vec<u32> = reported.iter().map(|(second, _)| *second).collect();
        assert_eq!(seconds, [20, 40, 60, 80]);
        assert_eq!(reported[1].1.before, Some(start + 20 * SECOND));
        assert!(reported.iter().all(|(_, change)| change.left_out == 0));
    }

    proptest! {
        /// Property for a bit that changes in any way: the number of events is bounded, no change goes uncounted,
        /// and the last event has the true value.
        #[test]
        fn a_bit_that_flaps_is_bounded_and_told_in_the_end(reads in prop::collection::vec((any::<bool>(), 0u64..3000), 1..2000)) {
            let (mut bit, start) = (Watched::default(), Instant::now());
            let (mut now, mut last, mut changes, mut reported, mut told) = (start, None, 0u64, 0u64, None);
            for (value, pause) in reads {
                now += Duration::from_millis(pause);
                changes += u64::from(last.is_some_and(|last| last != value));
                told = told.or(Some(value));
                last = Some(value);
                if let Some(change) = bit.read(value, now) {
                    prop_assert_eq!(change.value, value);
                    prop_assert!(told != Some(value), "one after the other");
                    told = Some(value);
                    reported += 1;
                    changes -= 1 + change.left_out;
                }
            }
            let most = u64::from(BURST) + (now - start).as_secs() / EVERY.as_secs() + 1;
            prop_assert!(reported <= most, "{} of {}", reported, most);
            // The bit does not change any more.
            let last = last.unwrap();
            if let Some(change) = bit.read(last, now + 2 * EVERY) {
                told = Some(change.value);
                changes -= 1 + change.left_out;
            }
            prop_assert_eq!(told, Some(last));
            prop_assert!(changes % 2 == 0, "what is left goes there and back");
        }
    }
}
