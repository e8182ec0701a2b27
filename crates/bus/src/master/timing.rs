//! Times of a transaction: silence before its request, and the wait for its reply.

use std::time::Duration;

use super::{Master, Turn};
use drivegate_core::order::Target;
use drivegate_core::process_image::Timing;
use drivegate_model::drive::DriveIndex;

/// Number of response timeouts within which a late N2 reply may arrive.
pub(super) const N2_LATE: u32 = 3;
/// Longest wait for a late reply: a silent drive is probed within 10 s.
const LONGEST_N2_LATE: Duration = Duration::from_secs(9);
/// Time for the first byte of the reply to a probe of an offline drive, or to a stop, unless the drive is known to
/// be slower: probing it every 10 s then costs less than 2 % of the line.
const PROBE_TIMEOUT: Duration = Duration::from_millis(160);
/// One in this number of probes waits as long as any other request, because the drive may be slow.
const PATIENT_PROBES: u32 = 6;

impl Master {
    pub(super) fn timeout_of(&self, turn: &Turn) -> Duration {
        if let Some(timeout) = self.passed_on_timeout(turn) {
            return timeout;
        }
        let Target::Drive(index) = turn.target() else {
            return self.response_timeout;
        };
        let probes = *self.probes.of(index);
        let patient = probes <= self.retries_of(index) || probes.is_multiple_of(PATIENT_PROBES);
        let timeout = self.response_timeout_of(index);
        if self.schedule.is_online(index) || patient {
            return timeout;
        }
        timeout.min(PROBE_TIMEOUT.max(2 * self.drives.of(index).answers_within))
    }

    /// The drive's own times, if it has any configured.
    fn timing_of(&self, target: Target) -> Timing {
        let own = |drive| self.bus.image.drives.of(drive).spec.timing;
        target.drive().map_or_else(Timing::default, own)
    }

    pub(super) fn response_timeout_of(&self, target: impl Into<Target>) -> Duration {
        let own = self.timing_of(target.into()).response_timeout;
        own.unwrap_or(self.response_timeout)
    }

    pub(super) fn retries_of(&self, drive: DriveIndex) -> u32 {
        self.timing_of(drive.into()).retries.unwrap_or(self.retries)
    }

    /// Silence before the request of this turn, and after its reply before a request to another drive.
    pub(crate) fn silence_of(&self, turn: &Turn) -> Duration {
        self.timing_of(turn.target()).silence.unwrap_or(self.silence)
    }

    /// Time within which a late reply may arrive on an N2 line.
    pub(super) fn n2_window(&self) -> Duration {
        let own = self
            .bus
            .image
            .drives
            .iter()
            .filter_map(|image| image.spec.timing.response_timeout);
        let longest = own.chain([self.response_timeout]).max().unwrap_or_default();
        (N2_LATE * longest).min(LONGEST_N2_LATE)
    }
}
