//! Events of drives and of the bus.

use std::time::{Instant, SystemTime};

use super::{RECENT, Report, goes_offline};
use crate::confirm::Unconfirmed;
use crate::news::Adopted;
use drivegate_core::event::{Event, EventKind, RefusedCommand};
use drivegate_core::plant::explain;
use drivegate_core::process_image::{LeaseAction, Snapshot};
use drivegate_core::queue::Denied;
use drivegate_model::drive::DriveIndex;

impl Report {
    /// Publishes an event of a drive; `text` makes the message from the drive's name.
    pub(crate) fn drive_event(
        &self,
        index: DriveIndex,
        kind: EventKind,
        fault_code: Option<i64>,
        text: impl FnOnce(&str) -> String,
    ) {
        let drive = self.image.drives.of(index);
        let name = drive.spec.name.clone();
        let text = text(&name);
        self.event(kind, Some(name), fault_code, text);
    }

    pub(super) fn event(&self, kind: EventKind, drive: Option<String>, fault_code: Option<i64>, text: String) {
        self.publish(Event {
            drive,
            fault_code,
            ..Event::new(kind, SystemTime::now(), text)
        });
    }

    pub(super) fn publish(&self, event: Event) {
        self.events.publish(Event {
            bus: self.image.spec.name.clone(),
            ..event
        });
    }

    /// Reports a command that was refused when it was about to be sent, like any other refusal.
    pub(super) fn denied(&self, denied: &Denied, now: Instant) {
        let Denied {
            drive,
            origin,
            what,
            refusal,
        } = denied;
        let drive = self.image.drives.of(*drive);
        let refused = RefusedCommand {
            client: origin.client(),
            reason: refusal.code(),
            kind: refusal.event_kind(),
            bus: &drive.spec.bus,
            drive: &drive.spec.name,
            text: format!("refused {what} from {} {}: {refusal}", origin.kind.name(), origin.who),
        };
        self.events.publish_refusal(refused, now);
    }

    /// Counts a failed action of supervision, and reports it if there is a `text`.
    pub(super) fn action_failed(&self, index: DriveIndex, text: impl FnOnce(&str) -> Option<String>) {
        let drive = self.image.drives.of(index);
        drive.count_supervision_failure();
        if let Some(text) = text(&drive.spec.name) {
            self.drive_event(index, EventKind::SupervisionFailed, None, |_| text);
        }
    }

    /// The action of the lease of a drive, in words.
    pub(super) fn action_of(&self, index: DriveIndex) -> &'static str {
        let supervision = &self.image.drives.of(index).spec.supervision;
        match supervision.as_ref().map(|supervision| &supervision.action) {
            Some(LeaseAction::SpeedReference(_)) => "the speed reference",
            _ => "the stop",
        }
    }

    /// A motor that was to run and does not: with the causes that are known.
    pub(super) fn not_confirmed(&self, index: DriveIndex, late: &Unconfirmed, now: Instant) {
        if late.own {
            self.action_failed(index, |name| {
                Some(format!(
                    "the lease action of {name} shows no effect: the drive {}",
                    late.text
                ))
            });
        }
        if !late.does_not_run {
            return self.drive_event(index, EventKind::NotConfirmed, None, |name| {
                format!("drive {name} {}", late.text)
            });
        }
        let drive = self.image.drives.of(index);
        let explanation = explain(&drive.reading(now, RECENT), &self.image, &self.command_log);
        let causes = explanation.blocked_by().map(|causes| format!("; blocked by {causes}"));
        self.drive_event(index, EventKind::NotConfirmed, None, |name| {
            format!("drive {name} {}{}", late.text, causes.unwrap_or_default())
        });
    }

    pub(super) fn lease_ran_out(&self, index: DriveIndex) {
        let drive = self.drive(index);
        let Some(supervision) = &drive.spec.supervision else {
            return;
        };
        drive.count_supervision();
        let action = match supervision.action {
            LeaseAction::Stop => "the drive is being stopped".to_string(),
            LeaseAction::LeaveRunning => "nothing is written".to_string(),
            LeaseAction::SpeedReference(percent) => format!("the speed reference is being set to {percent} %"),
        };
        let timeout = supervision.timeout;
        self.drive_event(index, EventKind::Supervision, None, |name| {
            format!("no client has commanded {name} for {timeout:?}: {action}")
        });
    }

    pub(super) fn refresh_ended(&self, index: DriveIndex, why: &str) {
        let name = &self.image.drives.of(index).spec.name;
        tracing::info!(
            target: "drivegate::bus::report", bus = %self.image.spec.name, drive = %name,
            "what was ordered is no longer written again (refresh): {why}"
        );
    }

    pub(super) fn runs_unsupervised(&self, index: DriveIndex, adopted: Adopted) {
        let then = match adopted {
            Adopted::Yes => "its lease starts now (supervision.adopt)",
            Adopted::No => {
                "its lease starts with the first command or heartbeat of a client; set supervision.adopt = true to \
                 start it \
                 whenever the drive is found running"
            }
        };
        self.drive_event(index, EventKind::Unsupervised, None, |name| {
            format!("drive {name} runs without a lease, since no client has commanded it; {then}")
        });
    }

    /// Shows a drive as offline for this reason.
    pub(crate) fn gone(&self, index: DriveIndex, why: &str) {
        if goes_offline(self.image.drives.of(index)) {
            self.drive_event(index, EventKind::Offline, None, |name| {
                format!("drive {name} is offline: {why}")
            });
        }
    }

    pub(super) fn offline_event(&self, index: DriveIndex, why: &str) {
        self.drive_event(index, EventKind::Offline, None, |name| {
            format!("drive {name} is offline: {why}; retrying at least every 10 s")
        });
    }

    pub(super) fn restarted(&self, index: DriveIndex) {
        let drive = self.drive(index);
        drive.update(Snapshot::expire_slow_values);
        self.drive_event(index, EventKind::Restarted, None, |name| {
            format!("drive {name} has restarted; it is read again and accepts only commands sent from now on")
        });
    }

    /// Reports a drive of another device type than its profile expects.
    pub(super) fn unlike(&self, index: DriveIndex, device: u8) {
        let drive = self.drive(index);
        let profile = &drive.spec.profile;
        self.drive_event(index, EventKind::UnlikeProfile, None, |name| {
            format!(
                "drive {name} reports device type {device:02X}h, but its profile `{}` expects {:02X}h; check address \
                 and profile, or set device_type in [n2] of the profile",
                profile.name, profile.n2.device_type
            )
        });
    }
}
