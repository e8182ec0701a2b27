//! Who holds the drives, as the line sees it: who was carried out, and which drive is under local control.

use std::sync::Arc;
use std::time::Instant;

use crate::drive::ModelPoint;
use crate::drive_state::DriveState;
use crate::plant::BusHandle;
use crate::process_image::DriveImage;

/// Tells the queue whose orders were carried out, and whether the drive's local control place has it.
pub(super) fn look_at_hold(
    bus: &BusHandle,
    index: usize,
    image: &Arc<DriveImage>,
    drive: &mut DriveState,
    guarded: bool,
    now: Instant,
) {
    drive.guarded = guarded;
    let carried_out = std::mem::take(&mut drive.carried_out);
    let remote = image.reading(now, drive.fresh).model(ModelPoint::Remote).good();
    // What is not known is not local.
    let local = guarded && remote.is_some_and(|remote| !remote.as_bool());
    if local == drive.local && carried_out.is_empty() {
        return;
    }
    let mut queue = bus.queue.lock();
    for origin in &carried_out {
        queue.hold_renewed(index, origin, now);
    }
    if local != drive.local {
        queue.set_local(index, local);
    }
    drive.local = local;
}
