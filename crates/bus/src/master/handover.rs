//! What a bus that ends hands over to the next one on its line.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::Master;
use crate::command_run::OrderedDirection;
use crate::drive_state::DriveState;
use crate::late_replies::{FORGOTTEN_AFTER, LateReplies};
use crate::line_state::Learned;
use crate::refresh::Repeated;
use crate::repeated_stops::RepeatedStops;
use crate::supervision::Lease;
use drivegate_core::order::{Interruption, Outcome};
use drivegate_core::process_image::DriveImage;

/// State of a drive that continues over a reload.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CarriedState {
    /// Lease of the drive at the handover.
    pub lease: Lease,
    /// Refresh of orders for the drive's own timeout.
    pub repeated: Repeated,
    /// The stops that are to be written again.
    pub stops: RepeatedStops,
    /// The direction that was ordered last.
    pub direction: Option<OrderedDirection>,
}

impl CarriedState {
    /// The lease without the data for refreshes and repetitions.
    #[must_use]
    pub fn alone(self) -> CarriedState {
        CarriedState {
            lease: self.lease,
            ..CarriedState::default()
        }
    }

    /// The lease, with the time limit extended by a period in which the gateway did not run.
    #[must_use]
    pub fn after(self, stood: Duration) -> CarriedState {
        CarriedState {
            lease: self.lease.after(stood),
            ..self.alone()
        }
    }
}

/// State that an ended bus hands over to the next one on the same line.
#[derive(Debug, Clone, Default)]
pub struct Handover {
    /// The leases of its drives, in their order, with the orders that are refreshed under them.
    pub leases: Vec<CarriedState>,
    /// Time until which a reply to its last request may arrive; `None` if no bus used the line before.
    pub quiet_until: Option<Instant>,
    /// What the line has shown to the previous bus.
    pub learned: Option<Learned>,
}

impl Master {
    /// Ends the bus: started commands end. Returns the handover for the next bus. A transaction still on the line is
    /// aborted; it would have ended at `broken_off`.
    pub fn ended(&mut self, broken_off: Option<Instant>, now: Instant) -> Handover {
        if let Some(shutdown) = &mut self.shutdown {
            shutdown.end(&self.bus);
        }
        let mut queue = self.bus.queue.lock();
        for (index, drive) in self.drives.enumerate_mut() {
            if queue.take_renewed(index) {
                drive.supervision.renew(now);
            }
            if queue.is_ending()
                && let Some(stop) = drive.take_stop(now)
                && let Err(stop) = queue.give_back(stop)
            {
                stop.answer(&Outcome::ShuttingDown, now);
            }
        }
        queue.gate.settle(|_| false);
        drop(queue);
        for (drive, image) in self.drives.iter_mut().zip(&self.bus.image.drives) {
            // A heartbeat that arrived while the port was lost has not been evaluated yet.
            if let Some(at) = image.take_heartbeat() {
                drive.supervision.renew(at);
            }
        }
        let close = |(drive, image): (&mut DriveState, &Arc<DriveImage>)| {
            drive.close(&Outcome::ShuttingDown, Interruption::ShuttingDown, now);
            let control = image.spec.profile.control.as_ref();
            CarriedState {
                lease: drive.supervision.lease(),
                repeated: drive.refresh.handed_over(),
                stops: drive.repeated_stops,
                direction: control.and_then(|control| drive.words.handed_over(control)),
            }
        };
        let leases = self.drives.iter_mut().zip(&self.bus.image.drives).map(close).collect();
        self.abandon_background(Outcome::ShuttingDown, Interruption::ShuttingDown, now);
        let late = self
            .drives
            .iter()
            .map(|drive| &drive.late)
            .chain(self.waits.strangers.values());
        let late = late.filter_map(LateReplies::until);
        let window = if self.waits.sessions.is_empty() {
            FORGOTTEN_AFTER
        } else {
            self.n2_window()
        };
        let broken_off = broken_off.map(|deadline| deadline + window);
        Handover {
            leases,
            learned: None,
            quiet_until: late
                .chain(self.waits.n2_late.until())
                .chain(broken_off)
                .chain([now])
                .max(),
        }
    }
}
