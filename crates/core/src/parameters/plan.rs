//! The plan of a restore: the writes to a drive, their order, and reasons against it. Pure.

mod making;
mod order;
#[cfg(test)]
mod tests;
mod text;

use super::file::{Id, ParameterFile};
use drivegate_model::drive::parameters::RawValue;
use drivegate_model::drive::{PointIndex, Profile};
use making::Making;
pub use making::NOT_KNOWN;

#[derive(Debug, Clone, PartialEq)]
pub struct ParameterWrite {
    /// Id of the parameter.
    pub id: Id,
    /// PDU address of the parameter's (first) holding register.
    pub address: u16,
    /// The present value in the drive.
    pub from: RawValue,
    /// The value to write.
    pub to: RawValue,
    /// The change as text for people, with the counts on the bus: `102 Maximum frequency: 50.00 Hz → 100.00 Hz
    /// (5000 → 10000)`.
    pub line: String,
    /// Whether the drive loses the value without power.
    pub volatile: bool,
}

/// A condition that the drive requires for some of the writes.
#[derive(Debug, Clone, PartialEq)]
pub struct Need {
    /// Point of the profile (index) that shows the condition.
    pub point: PointIndex,
    /// The required reading of the point. Even then the drive may still refuse.
    pub value: bool,
    /// Exception code with which the drive refuses a write under other conditions, N2 codes with 0x80 added; `None`
    /// if no manual states it.
    pub exception: Option<u8>,
    /// The remedy: `switch the operator to PRGM`.
    pub remedy: String,
}

/// How the drive takes and keeps parameters, from the profile.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Handling {
    /// The condition for the first write; `None` if no write needs one.
    pub needs: Option<Need>,
    /// Register that is written once at the end so that the drive saves the values: (PDU address, value). `None` if
    /// every write is saved at once, or if values cannot be saved.
    pub save: Option<(u16, u16)>,
}

/// The plan of a restore.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Plan {
    /// The writes, in a command in which every step keeps the limits between parameters.
    pub writes: Vec<ParameterWrite>,
    /// How the drive takes and keeps the parameters.
    pub handling: Handling,
    /// Parameters that differ and are not written: how they differ and why they are left out, as text.
    pub left_out: Vec<(Id, String)>,
    /// Notes about parameters that only one side has, that were not read, or that are not saved.
    pub notes: Vec<String>,
}

/// The parameters the user named, and whether the risks are accepted.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Wishes {
    /// Only these parameters, including those that are not restored by default. Empty: all.
    pub only: Vec<Id>,
    /// Treat refusals that can be forced as risks.
    pub force: bool,
}

/// A reason against the restore that the user overrode: as text.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Risk(pub String);

/// Plans the writes that change the drive from `present` to `wanted`.
///
/// The notes of both files become part of [`ParameterWrite::line`]; [`ParameterFile::named`] renews them.
///
/// # Errors
/// If the restore is not possible: contains every reason, each with the difference and the remedy.
pub fn plan(
    profile: &Profile,
    wanted: &ParameterFile,
    present: &ParameterFile,
    wishes: &Wishes,
) -> Result<(Plan, Vec<Risk>), Vec<String>> {
    let of_another = [wanted, present].into_iter().find(|file| file.family != profile.name);
    if let Some(file) = of_another {
        return Err(vec![format!(
            "the parameters of {} are for the family `{}`, but the drive is of `{}`: their parameters differ; nothing \
             can be restored",
            file.drive, file.family, profile.name
        )]);
    }
    Making::new(profile, wanted, present, wishes).make()
}

impl Plan {
    /// The plan that undoes the first `done` writes: the former values, in reverse order. After each step the drive has
    /// a state it had before, so the limits are kept as well.
    #[must_use]
    pub fn back(&self, done: usize) -> Plan {
        let writes = self.writes.iter().take(done).rev().map(|write| ParameterWrite {
            from: write.to,
            to: write.from,
            line: format!("undone: {}", write.line),
            ..write.clone()
        });
        Plan {
            writes: writes.collect(),
            handling: self.handling.clone(),
            ..Plan::default()
        }
    }
}
