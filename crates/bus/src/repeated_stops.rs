//! Repeats a stop after a write that got no answer, because a network may delay the write and let the stop overtake
//! it: without the repetition the write could have the last word. Pure: time is an argument.

use std::time::{Duration, Instant};

use drivegate_core::order::written;
use drivegate_model::drive::Profile;
use drivegate_proto::RequestPdu;

/// Times after the stop at which the stop is written again.
const AGAIN: [Duration; 2] = [Duration::from_secs(1), Duration::from_secs(3)];
/// Time for which a write without an answer may still arrive.
const MAY_ARRIVE: Duration = Duration::from_secs(30);

/// The stops of a drive that are still to be written again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RepeatedStops {
    /// When a write other than a stop last got no answer.
    unanswered: Option<Instant>,
    due: [Option<Instant>; AGAIN.len()],
}

/// Whether the write starts or stops the motor; `None` if it does neither.
fn runs_by(profile: &Profile, pdu: &RequestPdu) -> Option<bool> {
    let (table, items) = written(pdu)?;
    items
        .iter()
        .find_map(|(address, word)| profile.runs_by(table, *address, *word))
}

impl RepeatedStops {
    /// A write of this request got no answer.
    pub(super) fn not_answered(&mut self, profile: &Profile, pdu: &RequestPdu, now: Instant) {
        if pdu.is_write() && runs_by(profile, pdu) != Some(false) {
            self.unanswered = Some(now);
        }
    }

    /// Notes that a request is sent: a run command supersedes an earlier stop. The other writes of a start (`of_start`)
    /// change nothing, even if their words are those of a stop: another stop may end the start before its run command.
    pub(super) fn sending(&mut self, profile: &Profile, pdu: &RequestPdu, of_start: bool, now: Instant) {
        match runs_by(profile, pdu) {
            Some(true) => self.due = [None; AGAIN.len()],
            Some(false) if of_start => {}
            Some(false) => {
                let unanswered = self.unanswered.take();
                if unanswered.is_some_and(|at| now.saturating_duration_since(at) < MAY_ARRIVE) {
                    self.due = AGAIN.map(|after| Some(now + after));
                }
            }
            None => {}
        }
    }

    /// Whether a stop is still to be written again, or may have to be.
    pub fn is_any(&self) -> bool {
        *self != RepeatedStops::default()
    }

    /// Whether a stop is due again; each stop is repeated only once.
    pub(super) fn take_due(&mut self, now: Instant) -> bool {
        let mut due = self.due.iter_mut();
        due.any(|due| due.take_if(|due| *due <= now).is_some())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stop_behind_an_unanswered_write_is_due_twice_more() {
        let profile = drivegate_testkit::profile("vacon-nx");
        let word = |value| RequestPdu::write_register(2000, value);
        let (run, stop, reference) = (word(1), word(0), RequestPdu::write_register(2002, 500));
        for (lost, repeats) in [(&run, 2), (&reference, 2), (&stop, 0)] {
            let start = Instant::now();
            let at = |ms| start + Duration::from_millis(ms);
            let mut stops = RepeatedStops::default();
            stops.not_answered(&profile, lost, start);
            stops.sending(&profile, &stop, false, at(500));
            let due = |stops: &mut RepeatedStops| {
                (0..10_000u64)
                    .step_by(100)
                    .filter(|ms| stops.take_due(at(*ms)))
                    .collect::<Vec<u64>>()
            };
            let times = due(&mut stops);
            assert_eq!(times, [1500, 3500][..repeats], "{lost:?}");
            stops.sending(&profile, &stop, false, at(10_000));
            assert_eq!(
                due(&mut stops),
                [0u64; 0],
                "a stop that is written again is behind no other write"
            );
        }
    }

    #[test]
    fn a_start_behind_the_stop_ends_it_and_so_does_time() {
        let profile = drivegate_testkit::profile("vacon-nx");
        let word = |value| RequestPdu::write_register(2000, value);
        let now = Instant::now();
        let mut stops = RepeatedStops::default();
        stops.not_answered(&profile, &word(1), now);
        stops.sending(&profile, &word(0), false, now);
        stops.sending(&profile, &word(1), true, now);
        assert!(!stops.take_due(now + Duration::from_secs(9)));
        stops.not_answered(&profile, &word(1), now);
        stops.sending(&profile, &word(0), false, now + MAY_ARRIVE);
        assert!(!stops.take_due(now + 2 * MAY_ARRIVE));
    }
}
