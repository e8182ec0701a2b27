//! The lease of a drive: renewed by its clients, and its action when it expires.

use std::sync::Arc;
use std::time::Instant;

use crate::drive_state::DriveState;
use crate::news::News;
use crate::supervision::{Demand, Orders};
use drivegate_core::order::{DEFAULT_EXPIRY, Origin, Outcome, SourceKind};
use drivegate_core::plant::{BusHandle, turn_away};
use drivegate_core::process_image::DriveImage;
use drivegate_model::drive::DriveIndex;

/// Evaluates the lease of a drive.
pub(crate) fn supervise(
    bus: &BusHandle,
    index: DriveIndex,
    image: &Arc<DriveImage>,
    drive: &mut DriveState,
    now: Instant,
    news: &mut Vec<News>,
) {
    if let Some(at) = image.take_heartbeat() {
        drive.supervision.renew(at);
    }
    let mut queue = bus.queue.lock();
    let (renewed, queued) = (queue.take_renewed(index), queue.client_waits_until(index));
    drop(queue);
    if renewed {
        drive.supervision.renew(now);
    }
    let orders = Orders {
        held_until: queued.max(drive.client_holds_until()),
    };
    let reading = image.reading(now, drive.fresh);
    let DriveState { supervision, words, .. } = drive;
    let demand = supervision.due_action(&reading, words, orders, now, news, index);
    image.set_unsupervised(supervision.runs_unclaimed());
    match demand {
        Demand::None => {}
        Demand::Withdraw => {
            bus.queue.lock().withdraw_supervision(index, now);
            drive.withdraw_supervision(now);
            drive.supervision.withdrawn(now);
        }
        Demand::Write(point, value) => {
            let origin = Origin::new(SourceKind::Supervision, Origin::LEASE);
            let ordered = bus.own_order(index, &reading, (point, value), origin.clone(), DEFAULT_EXPIRY);
            if let Some(refusal) = supervision.ordered(ordered, now) {
                let what = format!("{}={value}", point.name());
                let outcome = Outcome::Refused(refusal.clone());
                turn_away(&bus.command_log, &image.spec.name, &what, outcome, origin, now);
                news.push(News::ActionRefused {
                    drive: index,
                    what,
                    refusal,
                });
            }
        }
    }
}
