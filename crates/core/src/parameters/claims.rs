//! Assigns the journals of interrupted restores to the configured drives. A journal belongs to a machine; if that
//! machine is no longer configured, a drive at its address or with its name may be the half-restored one. Pure.

use super::journal::{JournalFile, Owner};
use crate::process_image::Machine;

/// Why a journal concerns a configured drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Claim {
    /// The journal belongs to this machine.
    Own,
    /// The journal's machine is no longer configured; this drive has its address but another profile.
    Place,
    /// The journal's machine is no longer configured; this drive has its name.
    Name,
}

/// The claims of the journals on the configured drives.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Claims {
    /// For each drive, in order: the journal that concerns it, if there is one, and why.
    pub drives: Vec<Option<(usize, Claim)>>,
    /// Journals that belong to no configured drive.
    pub orphans: Vec<usize>,
}

/// Assigns the `journals`, each with its owner, to the `drives`, each with its name.
pub fn claims(journals: &[(JournalFile, Result<Owner, String>)], drives: &[(Machine, &str)]) -> Claims {
    let mut claims = Claims {
        drives: vec![None; drives.len()],
        orphans: Vec::new(),
    };
    for (journal, (file, owner)) in journals.iter().enumerate() {
        let machine = owner.as_ref().ok().and_then(|owner| owner.machine.as_ref());
        // A journal without a machine concerns the drive of its name, as in earlier versions.
        let directory = file.drive();
        let name = owner.as_ref().map_or(directory.as_str(), |owner| &owner.drive);
        let named = || drives.iter().position(|(_, other)| *other == name);
        let found = match machine {
            None => named().map(|drive| (drive, Claim::Own)),
            Some(machine) => {
                let own = drives.iter().position(|(other, _)| other == machine);
                let place = || {
                    drives
                        .iter()
                        .position(|(other, _)| (&other.port, other.address) == (&machine.port, machine.address))
                };
                own.map(|drive| (drive, Claim::Own))
                    .or_else(|| place().map(|drive| (drive, Claim::Place)))
                    .or_else(|| named().map(|drive| (drive, Claim::Name)))
            }
        };
        if found.is_none_or(|(_, claim)| claim != Claim::Own) {
            claims.orphans.push(journal);
        }
        if let Some((drive, claim)) = found
            && let Some(concerned) = claims.drives.get_mut(drive)
            && concerned.is_none_or(|(_, other)| claim < other)
        {
            *concerned = Some((journal, claim));
        }
    }
    claims
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::super::journal::tests::owner_at;
    use super::*;

    fn drive(address: u8, name: &str) -> (Machine, &str) {
        (owner_at(address).machine.unwrap(), name)
    }

    #[test]
    fn a_journal_goes_with_its_machine_and_not_with_its_name() {
        let file = JournalFile::new(Path::new("params"), "pump-1");
        let journals = [(file.clone(), Ok(owner_at(1)))];
        let of = |drives: &[(Machine, &str)]| {
            let claims = claims(&journals, drives);
            let drives: Vec<Option<Claim>> = claims
                .drives
                .into_iter()
                .map(|one| one.map(|(_, claim)| claim))
                .collect();
            (drives, claims.orphans.len())
        };
        let own = Some(Claim::Own);
        assert_eq!(of(&[drive(1, "pump-1"), drive(2, "pump-2")]), (vec![own, None], 0));
        assert_eq!(
            of(&[drive(2, "pump-1"), drive(1, "pump-2")]),
            (vec![None, own], 0),
            "swapped"
        );
        assert_eq!(of(&[drive(1, "fan")]), (vec![own], 0), "renamed");
        assert_eq!(
            of(&[drive(3, "pump-1"), drive(2, "pump-2")]),
            (vec![Some(Claim::Name), None], 1)
        );
        assert_eq!(of(&[drive(2, "pump-2")]), (vec![None], 1), "removed");
        let other_profile = Machine {
            profile: "vacon-cx".to_string(),
            ..owner_at(1).machine.unwrap()
        };
        assert_eq!(
            of(&[(other_profile, "x"), drive(2, "pump-1")]),
            (vec![Some(Claim::Place), None], 1)
        );
        let of_name = Owner {
            machine: None,
            ..owner_at(1)
        };
        for owner in [Ok(of_name), Err("damaged".to_string())] {
            let claims = claims(&[(file.clone(), owner)], &[drive(2, "pump-2"), drive(7, "pump-1")]);
            assert_eq!(
                (claims.drives, claims.orphans),
                (vec![None, Some((0, Claim::Own))], vec![])
            );
        }
    }
}
