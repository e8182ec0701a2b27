//! Conditions for which a transaction may have to wait: late replies, N2 sessions, guards of starts, a drill.

use std::collections::BTreeMap;
use std::time::Instant;

use crate::drive_state::DriveState;
use crate::late_replies::LateReplies;
use crate::n2_late_replies::N2LateReplies;
use crate::n2_session::N2Sessions;
use crate::start_gate::StartGate;
use drivegate_core::order::{BackgroundRequest, Command, Order, Target, Urgency};
use drivegate_core::queue::Ready;
use drivegate_model::drive::{DriveIndex, PerDrive};
use drivegate_proto::RequestPdu;

/// Conditions that a transaction may have to wait for.
#[derive(Debug)]
pub(super) struct Waits {
    /// The N2 sessions of the drives.
    pub(super) sessions: N2Sessions,
    pub(super) n2_late: N2LateReplies,
    /// Replies that may still arrive from addresses without a configured drive.
    pub(super) strangers: BTreeMap<u8, LateReplies>,
    /// Decides which starts may be written; `None` if no drive is guarded.
    pub(super) starts: Option<StartGate>,
    /// A drive to which a drill sends nothing but stops, and until when.
    pub(super) quiet: Option<(DriveIndex, Instant)>,
}

impl Waits {
    /// Until when a transaction is blocked; `None` if it is not.
    pub(super) fn blocks(
        &mut self,
        target: Target,
        pdu: &RequestPdu,
        drives: &mut PerDrive<DriveState>,
        now: Instant,
    ) -> Option<Instant> {
        let late = match target {
            // Only a poll may identify the drive.
            Target::Drive(drive) if self.sessions.before(drive, Some(Urgency::Read), now).is_some() => {
                return Some(now + super::LOOK_ROUND);
            }
            Target::Drive(drive) => Some(&mut drives.of_mut(drive).late),
            Target::Address(address) => self.strangers.get_mut(&address),
        };
        let late = late.and_then(|late| late.blocks(pdu, now));
        late.max(self.n2_late.blocks(pdu, now))
    }

    /// Until when a request has to wait because it would reach a drive to which a drill lets nothing be sent.
    pub(super) fn quiet_until(&self, request: &BackgroundRequest) -> Option<Instant> {
        let (quiet, until) = self.quiet?;
        (request.target == quiet).then_some(until)
    }

    /// Whether the drives that a passed-on request reaches are ready: none of them has a command in progress.
    pub(super) fn may_pass_on(&mut self, command: &Command, drives: &mut PerDrive<DriveState>, now: Instant) -> Ready {
        let busy = |drive: &DriveState| drive.is_busy(Urgency::Stop) || drive.is_busy(Urgency::Command);
        if command.reach().any(|drive| busy(drives.of(drive))) {
            return Ready::No;
        }
        let Order::Write(pdu) = &command.intent.order else {
            return Ready::Now;
        };
        let until = self.blocks(command.intent.target, pdu, drives, now);
        until.map_or(Ready::Now, Ready::At)
    }
}
