//! The leases of drives across a reload. A lease belongs to a machine and stays with it under any name; if the new
//! configuration no longer has the machine, an event reports the end. A reload that soon brings the machine back,
//! such as one that restores an earlier file, continues the lease. Pure.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use crate::config::BusSettings;
use drivegate_bus::master::CarriedState;
use drivegate_core::event::{Event, EventKind};
use drivegate_core::plant::BusHandle;
use drivegate_core::process_image::{Access, DriveSpec, Machine};
use drivegate_model::drive::control::Control;

/// Time for which the lease of a drive is kept after a reload left the drive out.
const RETURN: Duration = Duration::from_secs(120);
/// Maximum number of buses whose leases are kept; the latest ones are kept.
const MOST_BUSES: usize = 64;

/// The leases and states of buses stopped by a reload, until another bus continues them.
#[derive(Debug, Default)]
pub(super) struct Leases {
    left: BTreeMap<Machine, LeftLease>,
    parted: BTreeMap<Machine, (Instant, CarriedState)>,
}

/// A lease, with the name of the drive that had it.
#[derive(Debug)]
struct LeftLease {
    carried: CarriedState,
    /// The control by which the drive was commanded.
    control: Option<Control>,
    bus: String,
    drive: String,
}

/// State of drives that reloads have removed. Clones share the state.
#[derive(Debug, Default, Clone)]
pub(super) struct RemovedDrives(Arc<Mutex<KeptLeases>>);

#[derive(Debug, Default)]
struct KeptLeases {
    leases: BTreeMap<Machine, (Instant, CarriedState)>,
    buses: Vec<(Instant, BusHandle)>,
}

impl KeptLeases {
    /// Drops the leases that are too old to continue.
    fn forget(&mut self, now: Instant) {
        let is_kept = |at: &Instant| now.saturating_duration_since(*at) <= RETURN;
        self.leases.retain(|_, (at, _)| is_kept(at));
        self.buses.retain(|(at, _)| is_kept(at));
    }
}

impl RemovedDrives {
    fn lock(&self) -> MutexGuard<'_, KeptLeases> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Drops the leases that are too old to continue, because buses that ended occupy memory. Returns how long
    /// leases are kept after a reload.
    pub(super) fn forget(&self, now: Instant) -> Duration {
        self.lock().forget(now);
        RETURN
    }

    /// For a reload at `now`: the leases that may continue, and the buses that know who commanded their drives,
    /// latest first.
    pub(super) fn recall(&self, now: Instant) -> (Leases, Vec<BusHandle>) {
        let mut kept = self.lock();
        kept.forget(now);
        let leases = Leases {
            left: BTreeMap::new(),
            parted: std::mem::take(&mut kept.leases),
        };
        (leases, kept.buses.iter().rev().map(|(_, bus)| bus.clone()).collect())
    }

    /// The buses that reloads have stopped and that are still known.
    pub(super) fn buses(&self) -> Vec<BusHandle> {
        self.lock().buses.iter().map(|(_, bus)| bus.clone()).collect()
    }

    /// Keeps, after a reload, the leases that no bus continued and the buses that were stopped.
    pub(super) fn keep(&self, leases: &Leases, stopped: &[BusHandle], now: Instant) {
        let mut kept = self.lock();
        kept.leases.clone_from(&leases.parted);
        let left = leases
            .left
            .iter()
            .filter(|(_, left)| left.carried.lease.ends().is_some());
        kept.leases
            .extend(left.map(|(machine, left)| (machine.clone(), (now, left.carried.alone()))));
        kept.buses.extend(stopped.iter().map(|bus| (now, bus.clone())));
        let excess = kept.buses.len().saturating_sub(MOST_BUSES);
        kept.buses.drain(..excess);
    }
}

impl Leases {
    /// Takes the states of a stopped bus; `leases` are those of its drives, in order. A drive that could not have a
    /// lease and has nothing else to continue has left none.
    pub(super) fn left(&mut self, bus: &BusSettings, leases: Vec<CarriedState>) {
        let all = bus.drives.iter().zip(leases);
        let continues = |drive: &DriveSpec, carried: &CarriedState| {
            drive.supervision.is_some() || carried.stops.is_any() || carried.direction.is_some()
        };
        for (drive, carried) in all.filter(|(drive, carried)| is_commanded(drive) && continues(drive, carried)) {
            let left = LeftLease {
                carried,
                control: drive.profile.control.clone(),
                bus: bus.spec.name.clone(),
                drive: drive.name.clone(),
            };
            let machine = bus.spec.machine(drive);
            // The lease of a drive that is not supervised now still waits for a reload that supervises it again.
            if drive.supervision.is_some() {
                self.parted.remove(&machine);
            }
            self.left.insert(machine, left);
        }
    }

    /// The leases with which the drives of a new bus continue at `now`, in order. A drive that is no longer
    /// controlled has none. The clock of a lease stands still while its drive is removed, as while a drive is
    /// offline.
    pub(super) fn of(&mut self, bus: &BusSettings, now: Instant) -> Vec<CarriedState> {
        let mut lease = |drive: &DriveSpec| {
            let machine = bus.spec.machine(drive);
            if !is_commanded(drive) {
                return None;
            }
            let left = self.left.remove(&machine);
            if drive.supervision.is_none() {
                let kept = left.as_ref().map(|left| (left.carried.stops, left.carried.direction));
                // The time of the lease does not run until a configuration supervises the drive again.
                if let Some(left) = left {
                    self.parted.entry(machine).or_insert((now, left.carried.alone()));
                }
                return kept.map(|(stops, direction)| CarriedState {
                    stops,
                    direction,
                    ..CarriedState::default()
                });
            }
            // A refresh continues only where the drive is commanded as before.
            let left = left.map(|left| {
                if left.control == drive.profile.control {
                    left.carried
                } else {
                    left.carried.alone()
                }
            });
            let back = |(at, carried): (Instant, CarriedState)| carried.after(now.saturating_duration_since(at));
            match (left, self.parted.remove(&machine).map(back)) {
                // The drive was not supervised meanwhile.
                (Some(left), Some(parted)) => Some(CarriedState {
                    lease: parted.lease,
                    ..left
                }),
                (left, parted) => left.or(parted),
            }
        };
        bus.drives
            .iter()
            .map(|drive| lease(drive).unwrap_or_default())
            .collect()
    }

    /// Events for the leases that no drive continues.
    pub(super) fn ended(self, time: SystemTime) -> impl Iterator<Item = Event> {
        self.left.into_iter().filter_map(move |(machine, left)| {
            let ends = left.carried.lease.ends()?;
            let text = format!(
                "the reload ended the lease of {} ({machine}), which has no drive to command in the new \
                 configuration: {ends}; it continues if a reload within {} s brings the drive back",
                left.drive,
                RETURN.as_secs()
            );
            Some(Event {
                bus: left.bus,
                drive: Some(left.drive),
                ..Event::new(EventKind::Supervision, time, text)
            })
        })
    }
}

fn is_commanded(drive: &DriveSpec) -> bool {
    matches!(drive.access, Access::Control)
}

#[cfg(test)]
mod tests;
