//! The leases of drives over a reload. A lease belongs to a machine: it goes where that is, whatever it is called then, and where
//! the new configuration has it no more, an event says that it ended. Pure.

use std::collections::BTreeMap;
use std::time::SystemTime;

use crate::bus::supervision::Lease;
use crate::config::BusSettings;
use crate::event::{Event, EventKind};
use crate::process_image::{Access, DriveSpec, Machine};

/// What the buses that a reload stopped have left, until somebody goes on with it.
#[derive(Debug, Default)]
pub(super) struct Leases(BTreeMap<Machine, Left>);

/// A lease, and what the drive was called that had it.
#[derive(Debug)]
struct Left {
    lease: Lease,
    bus: String,
    drive: String,
}

impl Leases {
    /// A bus was stopped; `leases` are those of its drives, in their order.
    pub(super) fn left(&mut self, bus: &BusSettings, leases: Vec<Lease>) {
        for (drive, lease) in bus.drives.iter().zip(leases) {
            let left = Left {
                lease,
                bus: bus.spec.name.clone(),
                drive: drive.name.clone(),
            };
            self.0.insert(bus.spec.machine(drive), left);
        }
    }

    /// Those with which the drives of a new bus go on, in their order. One that is commanded no more has none.
    pub(super) fn of(&mut self, bus: &BusSettings) -> Vec<Lease> {
        let lease = |drive: &DriveSpec| match drive.access {
            Access::Control => self.0.remove(&bus.spec.machine(drive)).map(|left| left.lease),
            Access::Monitor | Access::Listen => None,
        };
        bus.drives.iter().map(lease).map(Option::unwrap_or_default).collect()
    }

    /// What happened to the others.
    pub(super) fn ended(self, time: SystemTime) -> impl Iterator<Item = Event> {
        self.0.into_iter().filter_map(move |(machine, left)| {
            let ends = left.lease.ends()?;
            let text = format!(
                "the reload ended the lease of {} ({machine}), which has no drive to command in the new \
                 configuration: {ends}",
                left.drive
            );
            Some(Event {
                bus: left.bus,
                drive: Some(left.drive),
                ..Event::new(EventKind::Supervision, time, text)
            })
        })
    }
}

#[cfg(test)]
mod tests;
