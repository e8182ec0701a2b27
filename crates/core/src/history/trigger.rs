//! Triggers that start recordings. Pure.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use crate::event::EventKind;
use crate::order::AuditRecord;
use crate::process_image::{Reading, TriggerLimit};
use drivegate_model::drive::{DriveIndex, ModelPoint, Value};

/// Errors on a line within [`BURST_IN`] that are a burst.
pub const BURST: usize = 10;
/// Time in which errors on a line are counted.
pub const BURST_IN: Duration = Duration::from_secs(10);

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TriggerKind {
    /// A fault appeared, even for a single poll.
    Fault,
    /// A warning appeared.
    Warning,
    /// The drive no longer replies.
    Lost,
    /// A lease expired.
    Supervision,
    /// A stop was not acknowledged.
    RefusedStop,
    /// An acknowledged command showed no effect.
    NotConfirmed,
    /// Many transactions on the line failed.
    LineErrors,
    /// A point was beyond its limit for a time.
    Point,
    /// The recording was requested by a client.
    Command,
}

impl TriggerKind {
    pub const ALL: [TriggerKind; 9] = [
        TriggerKind::Fault,
        TriggerKind::Warning,
        TriggerKind::Lost,
        TriggerKind::Supervision,
        TriggerKind::RefusedStop,
        TriggerKind::NotConfirmed,
        TriggerKind::LineErrors,
        TriggerKind::Point,
        TriggerKind::Command,
    ];

    /// Whether the trigger has an event of its own, which gives the cause.
    pub(crate) fn has_event(self) -> bool {
        match self {
            TriggerKind::Fault
            | TriggerKind::Warning
            | TriggerKind::Lost
            | TriggerKind::Supervision
            | TriggerKind::NotConfirmed => true,
            TriggerKind::RefusedStop | TriggerKind::LineErrors | TriggerKind::Point | TriggerKind::Command => false,
        }
    }

    /// The name in payloads and labels.
    pub fn name(self) -> &'static str {
        match self {
            TriggerKind::Fault => "fault",
            TriggerKind::Warning => "warning",
            TriggerKind::Lost => "lost",
            TriggerKind::Supervision => "supervision",
            TriggerKind::RefusedStop => "refused_stop",
            TriggerKind::NotConfirmed => "not_confirmed",
            TriggerKind::LineErrors => "line_errors",
            TriggerKind::Point => "point",
            TriggerKind::Command => "command",
        }
    }

    /// Time after a recording of this kind before the same drive makes another one: a trigger that repeats, or that
    /// a client can repeat, must not displace the other recordings.
    pub(super) fn pause(self) -> Duration {
        match self {
            TriggerKind::Fault | TriggerKind::Supervision | TriggerKind::Command => Duration::ZERO,
            _ => Duration::from_secs(60),
        }
    }

    /// The kind of an event that makes a recording. A fault is seen in the samples.
    pub(super) fn of_event(kind: EventKind) -> Option<TriggerKind> {
        match kind {
            EventKind::Offline => Some(TriggerKind::Lost),
            EventKind::Supervision => Some(TriggerKind::Supervision),
            EventKind::NotConfirmed => Some(TriggerKind::NotConfirmed),
            _ => None,
        }
    }
}

/// A trigger that occurred at a time.
#[derive(Debug, Clone, PartialEq)]
pub struct Trigger {
    pub kind: TriggerKind,
    /// Time of the trigger.
    pub at: Instant,
    /// Text of the trigger.
    pub text: String,
}

/// Whether the record is a stop that the drive did not acknowledge and that no newer command replaced. The refused
/// rest of a write whose stop was carried out does not count, even if the write repeats the stop.
pub(super) fn is_refused_stop(record: &AuditRecord) -> bool {
    const TAKEN: [&str; 7] = [
        "acknowledged",
        crate::order::CONFIRMED,
        "replaced",
        "purged",
        "withdrawn",
        "shutting_down",
        "interrupted",
    ];
    !TAKEN.contains(&record.result) && record.run() == Some(false)
}

/// The last values of a drive whose changes trigger recordings.
#[derive(Debug, Default)]
pub(super) struct Watch {
    fault: Option<bool>,
    code: i64,
    warning: Option<bool>,
    /// For each trigger of the drive: since when it holds, and whether it has made its recording.
    points: Vec<Option<(Instant, bool)>>,
}

impl Watch {
    /// Evaluates the triggers for a drive that was read at `at`.
    pub(super) fn check(&mut self, reading: &Reading<'_>, at: Instant, warnings: bool) -> Option<Trigger> {
        let fault = self.fault(reading);
        let warning = self.warning(reading).filter(|_| warnings);
        let point = self.points(reading, at);
        let (kind, text) = fault.or(warning).or(point)?;
        Some(Trigger { kind, at, text })
    }

    fn fault(&mut self, reading: &Reading<'_>) -> Option<(TriggerKind, String)> {
        let fault = reading.model(ModelPoint::Fault).good()?.as_bool();
        let code = match fault.then(|| reading.model(ModelPoint::FaultCode).good()) {
            Some(Some(Value::Integer(code))) => code,
            _ => 0,
        };
        let came = fault && self.fault.replace(fault) == Some(false);
        self.fault = Some(fault);
        // A fault code that is read only after the fault is not another fault.
        let before = std::mem::replace(&mut self.code, code);
        let changed = fault && before != 0 && code != 0 && before != code;
        (came || changed).then(|| (TriggerKind::Fault, "fault".to_string()))
    }

    fn warning(&mut self, reading: &Reading<'_>) -> Option<(TriggerKind, String)> {
        let warning = reading.model(ModelPoint::Warning).good()?.as_bool();
        let before = self.warning.replace(warning);
        (warning && before == Some(false)).then(|| (TriggerKind::Warning, "warning".to_string()))
    }

    fn points(&mut self, reading: &Reading<'_>, at: Instant) -> Option<(TriggerKind, String)> {
        let triggers = &reading.spec.triggers;
        self.points.resize(triggers.len(), None);
        let mut fired = None;
        for (trigger, state) in triggers.iter().zip(&mut self.points) {
            let value = reading.sample(trigger.point).good().map(Value::as_f64);
            let beyond = value.is_some_and(|value| match trigger.limit {
                TriggerLimit::Above(limit) => value > limit,
                TriggerLimit::Below(limit) => value < limit,
            });
            if !beyond {
                *state = None;
                continue;
            }
            let (since, done) = state.get_or_insert((at, false));
            if !*done && at.saturating_duration_since(*since) >= trigger.lasts {
                *done = true;
                let point = reading.spec.profile.points.get(trigger.point);
                let (name, unit) = point.map_or(("", ""), |point| (point.name.as_str(), point.unit.as_str()));
                let side = match trigger.limit {
                    TriggerLimit::Above(limit) => format!("above {limit}"),
                    TriggerLimit::Below(limit) => format!("below {limit}"),
                };
                let text = format!("{name} {side} {unit}");
                fired = fired.or(Some((TriggerKind::Point, text.trim_end().to_string())));
            }
        }
        fired
    }
}

/// Counts failed transactions of a line.
#[derive(Debug, Default)]
pub(super) struct LineErrors {
    /// Times of the recent errors, each with its drive.
    recent: VecDeque<(Instant, DriveIndex)>,
}

impl LineErrors {
    /// Notes a failed transaction with a drive that answered before. Returns the drive with most failures, once
    /// they are a burst.
    pub(super) fn note(&mut self, at: Instant, drive: DriveIndex) -> Option<(DriveIndex, Trigger)> {
        self.recent.push_back((at, drive));
        while let Some((oldest, _)) = self.recent.front() {
            if at.saturating_duration_since(*oldest) <= BURST_IN {
                break;
            }
            self.recent.pop_front();
        }
        if self.recent.len() < BURST {
            return None;
        }
        let of = |drive: DriveIndex| self.recent.iter().filter(|(_, other)| *other == drive).count();
        let most = self
            .recent
            .iter()
            .map(|(_, drive)| *drive)
            .max_by_key(|drive| of(*drive))?;
        let text = format!(
            "{} transactions on the line failed within {} s, {} of them with this drive",
            self.recent.len(),
            BURST_IN.as_secs(),
            of(most)
        );
        self.recent.clear();
        let kind = TriggerKind::LineErrors;
        Some((most, Trigger { kind, at, text }))
    }
}
