//! The drives that a command to stop all includes.

use crate::order::Refusal;
use crate::permit::out_of_reach;
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
    /// The machines that a bus or group meant when the request began, with their names then.
    Meant {
        /// The part of the message if none of them is left.
        kind: &'static str,
        /// Name of the bus or group.
        name: String,
        drives: Vec<(Machine, String)>,
    },
}

/// What the names of buses and groups mean in a plant. A plant that a reload replaced is not kept for them: it would keep
/// its buses, which others take for served.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NamedDrives(Vec<NamedDrive>);

#[derive(Debug, Clone, PartialEq, Eq)]
struct NamedDrive {
    machine: Machine,
    name: String,
    bus: String,
    group: Option<String>,
    is_controlled: bool,
}

impl NamedDrives {
    /// The meanings in this plant.
    pub fn of(plant: &Plant) -> NamedDrives {
        let named = |drive: DriveHandle| NamedDrive {
            machine: drive.machine(),
            name: drive.image.spec.name.clone(),
            bus: drive.image.spec.bus.clone(),
            group: drive.image.spec.group.clone(),
            is_controlled: drive.image.spec.access == Access::Control,
        };
        NamedDrives(plant.drives().map(named).collect())
    }
}

/// Why a command to stop all has no drives.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NothingToStop {
    /// No bus or group has this name.
    #[error("there is no {kind} `{name}`, so no stop was sent; known: {}", .known.join(", "))]
    Unknown {
        /// What has the name: `bus`, `group`, or the drives left of them.
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
    /// The scope of a request that began when names had the meanings of `earlier`: the name of a bus or group stands for the
    /// machines that it meant then.
    ///
    /// # Errors
    /// If the name meant no drives then.
    pub fn as_of(self, earlier: &NamedDrives) -> Result<Scope, NothingToStop> {
        let all = &earlier.0;
        let is_named = |drive: &&NamedDrive| match &self {
            Scope::Bus(name) => drive.bus == *name,
            Scope::Group(name) => drive.group.as_ref() == Some(name),
            Scope::Gateway | Scope::Buses(_) | Scope::Meant { .. } => false,
        };
        let named: Vec<&NamedDrive> = all.iter().filter(is_named).collect();
        let controlled = named.iter().filter(|drive| drive.is_controlled);
        let drives: Vec<(Machine, String)> = controlled
            .map(|drive| (drive.machine.clone(), drive.name.clone()))
            .collect();
        let (kind, name) = match self {
            Scope::Bus(name) if named.is_empty() => {
                return Err(unknown("bus", &name, all.iter().map(|drive| drive.bus.clone())));
            }
            Scope::Group(name) if named.is_empty() => {
                let groups = all.iter().filter_map(|drive| drive.group.clone());
                return Err(unknown("group", &name, groups));
            }
            Scope::Bus(_) | Scope::Group(_) if drives.is_empty() => return Err(NothingToStop::NotControlled),
            Scope::Bus(name) => ("controlled drive left of the bus", name),
            Scope::Group(name) => ("controlled drive left of the group", name),
            Scope::Gateway | Scope::Buses(_) | Scope::Meant { .. } => return Ok(self),
        };
        Ok(Scope::Meant { kind, name, drives })
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
        match (self, found, drives.is_empty()) {
            (Scope::Bus(name), false, _) => {
                let buses = plant.buses.iter().map(|bus| bus.image.spec.name.clone());
                Err(unknown("bus", name, buses))
            }
            (Scope::Group(name), false, _) => {
                let groups = plant.drives().filter_map(|drive| drive.image.spec.group.clone());
                Err(unknown("group", name, groups))
            }
            (Scope::Meant { kind, name, .. }, _, true) => {
                let names = plant.drives().map(|drive| drive.image.spec.name.clone());
                Err(unknown(kind, name, names))
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
            Scope::Meant { drives, .. } => drives.iter().any(|(machine, _)| *machine == drive.machine()),
        }
    }

    /// The drives that were meant when the request began and that no stop reaches any more, each with the reason.
    pub(super) fn lost(&self, plant: &Plant) -> Vec<(Machine, String, Refusal)> {
        let Scope::Meant { drives, .. } = self else {
            return Vec::new();
        };
        let why = |machine: &Machine| match plant.drive_at(machine) {
            Some(drive) if drive.image.spec.access == Access::Control => None,
            reached => Some(out_of_reach(reached.is_none())),
        };
        let lost = drives
            .iter()
            .filter_map(|(machine, name)| Some((machine.clone(), name.clone(), why(machine)?)));
        lost.collect()
    }
}

fn unknown(kind: &'static str, name: &str, known: impl Iterator<Item = String>) -> NothingToStop {
    let mut known: Vec<String> = known.collect();
    known.sort();
    known.dedup();
    let name = name.to_string();
    NothingToStop::Unknown { kind, name, known }
}
