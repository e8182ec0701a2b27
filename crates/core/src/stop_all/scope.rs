//! The drives that a command to stop all includes.

use crate::plant::{DriveHandle, Plant};
use crate::process_image::{Access, Machine};

/// The drives that a command stops; only controlled ones are included.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Scope {
    /// All drives of the gateway.
    Gateway,
    /// All drives of the bus with this name.
    Bus(String),
    /// All drives of these buses.
    Buses(Vec<String>),
    /// All drives with this `group`.
    Group(String),
    /// These machines, whatever their names are.
    Machines(Vec<Machine>),
}

/// Why a command to stop all has no drives.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NothingToStop {
    /// No bus or group has this name.
    #[error("there is no {kind} `{name}`, so no stop was sent; known: {}", .known.join(", "))]
    Unknown {
        /// Kind of the name: `bus` or `group`.
        kind: &'static str,
        /// The name that was requested.
        name: String,
        /// The names that exist, for the message.
        known: Vec<String>,
    },
    /// No drive of the bus or group is controlled.
    #[error("none of these drives has access = \"control\", so no stop was sent")]
    NotControlled,
}

impl Scope {
    /// The scope of a request that began when the plant was `earlier`: the name of a bus or group stands for the machines
    /// that it meant then.
    ///
    /// # Errors
    /// If the name meant no drives then.
    pub fn as_of(self, earlier: &Plant) -> Result<Scope, NothingToStop> {
        match self {
            Scope::Bus(_) | Scope::Group(_) => {
                let drives = self.drives(earlier)?;
                Ok(Scope::Machines(drives.iter().map(DriveHandle::machine).collect()))
            }
            Scope::Gateway | Scope::Buses(_) | Scope::Machines(_) => Ok(self),
        }
    }

    /// The drives to stop, bus by bus.
    ///
    /// # Errors
    /// If the scope contains no drives.
    pub fn drives(&self, plant: &Plant) -> Result<Vec<DriveHandle>, NothingToStop> {
        let mut found = false;
        let mut drives: Vec<DriveHandle> = Vec::new();
        for drive in plant.drives().filter(|drive| self.has(drive)) {
            found = true;
            if drive.image.spec.access == Access::Control {
                drives.push(drive);
            }
        }
        let unknown = |kind, name: &String, mut known: Vec<String>| {
            known.sort();
            known.dedup();
            let name = name.clone();
            NothingToStop::Unknown { kind, name, known }
        };
        match (self, found, drives.is_empty()) {
            (Scope::Bus(name), false, _) => {
                let buses = plant.buses.iter().map(|bus| bus.image.spec.name.clone());
                Err(unknown("bus", name, buses.collect()))
            }
            (Scope::Group(name), false, _) => {
                let groups = plant.drives().filter_map(|drive| drive.image.spec.group.clone());
                Err(unknown("group", name, groups.collect()))
            }
            (_, _, true) => Err(NothingToStop::NotControlled),
            _ => Ok(drives),
        }
    }

    fn has(&self, drive: &DriveHandle) -> bool {
        let spec = &drive.image.spec;
        match self {
            Scope::Gateway => true,
            Scope::Bus(name) => spec.bus == *name,
            Scope::Buses(names) => names.contains(&spec.bus),
            Scope::Group(name) => spec.group.as_ref() == Some(name),
            Scope::Machines(machines) => machines.contains(&drive.machine()),
        }
    }
}
