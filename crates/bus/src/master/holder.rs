//! Reports to the holds of the drives: whose orders were carried out, and which drive is under local control.

use std::sync::Arc;
use std::time::Instant;

use crate::drive_state::DriveState;
use crate::supervision::written_run;
use drivegate_core::order::{DEFAULT_EXPIRY, Origin, SourceKind};
use drivegate_core::plant::BusHandle;
use drivegate_core::process_image::{DriveImage, Reading};
use drivegate_model::drive::{DriveIndex, ModelPoint, Value};

/// Reports to the queue whose commands were executed, and whether the drive is under local control.
pub(super) fn report_control(
    bus: &BusHandle,
    index: DriveIndex,
    image: &Arc<DriveImage>,
    drive: &mut DriveState,
    has_authority: bool,
    now: Instant,
) {
    drive.has_authority = has_authority;
    let carried_out = std::mem::take(&mut drive.carried_out);
    let reading = image.reading(now, drive.fresh);
    let remote = reading.model(ModelPoint::Remote).good().filter(|_| has_authority);
    let local = remote.map(|remote| !remote.as_bool());
    if local == drive.local && carried_out.is_empty() {
        return;
    }
    let before = std::mem::replace(&mut drive.local, local);
    let mut queue = bus.queue.lock();
    for (origin, is_stop) in &carried_out {
        queue.gate.hold_renewed(index, origin, now);
        if *is_stop {
            queue.gate.hold_stop_acknowledged(index, origin);
        }
    }
    if local != before {
        // An unknown control place does not count as local.
        queue.gate.set_local(index, local == Some(true));
    }
    let stops = queue.gate.rules().is_some_and(|rules| rules.stop_at_local);
    drop(queue);
    if stops && before == Some(false) && local == Some(true) {
        stop_at_local(bus, index, drive, &reading);
    }
}

/// Takes the run command away, so that nothing starts when local control returns the drive to the bus. If local
/// control was already active when the gateway started, nothing is written.
fn stop_at_local(bus: &BusHandle, index: DriveIndex, drive: &DriveState, reading: &Reading<'_>) {
    let run = reading.model(ModelPoint::Run).good().map(|run| run.as_bool());
    if !run
        .or_else(|| written_run(&reading.spec.profile, &drive.words))
        .unwrap_or(false)
    {
        return;
    }
    let origin = Origin::new(SourceKind::Supervision, Origin::LOCAL);
    let stop = (ModelPoint::Run, Value::Bool(false));
    if let Err(refusal) = bus.own_order(index, reading, stop, origin, DEFAULT_EXPIRY) {
        tracing::error!(
            target: "drivegate::bus::master", drive = %reading.spec.name,
            "its run command is set while it is under local control, and no stop can be sent: {refusal}"
        );
    }
}
