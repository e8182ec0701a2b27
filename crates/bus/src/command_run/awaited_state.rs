//! The state of the drive for which a start sequence waits. Pure.

use std::time::{Duration, Instant};

use super::steps::{Step, StepPurpose};
use drivegate_model::drive::control::{self, Mask};
use drivegate_model::drive::model::Kind;
use drivegate_model::drive::{Profile, Raw};
use drivegate_proto::{Reply, RequestPdu};

/// Pause between two looks at a state for which a sequence waits.
pub(super) const LOOK_PAUSE: Duration = Duration::from_millis(20);

/// A state for which a sequence waits.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct AwaitedState {
    /// The register that shows the awaited state.
    raw: Raw,
    name: String,
    mask: Mask,
    /// Time after which the sequence is given up.
    timeout: Duration,
    /// The step as text, with its word.
    step: String,
    /// When the wait for this state began.
    since: Option<Instant>,
    /// The value last read from the register.
    seen: Option<u64>,
}

impl AwaitedState {
    /// The state that ends this step, which has this number among so many; `None` if no register shows it.
    pub(super) fn of(
        profile: &Profile,
        mask: Mask,
        step: &control::Step,
        (number, count): (usize, usize),
    ) -> Option<AwaitedState> {
        let point = profile.points.get(mask.point)?;
        Some(AwaitedState {
            raw: point.raw()?.clone(),
            name: point.name.clone(),
            mask,
            timeout: step.timeout,
            step: format!("step {number} of {count} ({:#06x})", step.write.value),
            since: None,
            seen: None,
        })
    }

    /// The read of the awaited state.
    ///
    /// # Errors
    /// If the time limit has passed at `now`; contains the state that was not seen, as text.
    pub(super) fn state_read(&mut self, now: Instant) -> Result<Step, String> {
        let since = *self.since.get_or_insert(now);
        if now.saturating_duration_since(since) >= self.timeout {
            return Err(self.not_reached());
        }
        let pdu = RequestPdu::Read {
            table: self.raw.table,
            start: self.raw.address,
            count: self.raw.form.items(),
        };
        Ok(Step::new(StepPurpose::AskState, pdu))
    }

    /// Whether the reply shows the awaited state.
    pub(super) fn is_shown(&mut self, reply: &Reply) -> bool {
        let words = reply.words();
        let value = words.and_then(|words| self.raw.decode(&words, Kind::Integer));
        // A whole register without scale: never negative.
        self.seen = value.map(|value| value.as_f64() as u64).or(self.seen);
        value.is_some() && self.seen.is_some_and(|seen| self.mask.holds(seen))
    }

    /// The state that was not seen in time, as text.
    fn not_reached(&self) -> String {
        let AwaitedState {
            name,
            mask,
            timeout,
            step,
            ..
        } = self;
        let seen = self
            .seen
            .map_or("was not read".to_string(), |seen| format!("is {seen:#06x}"));
        format!(
            "{step}: `{name}` {seen}, not {:#06x} in {:#06x}, within {timeout:?}; the start was abandoned",
            mask.is, mask.mask
        )
    }
}
