//! The journal of a restore: the former values, the new ones and the progress. The journal is on disk before the
//! first parameter is written, so that an interrupted restore can be resumed or undone.
//!
//! ```text
//! # drivegate restore 2
//! drive: pump-1
//! bus: line1
//! port: /dev/ttyUSB0
//! address: 1
//! family: vacon-nx
//! identification: none
//! begun: 2026-03-02T07:40:12Z
//! by: local_socket uid 0
//! phase: writing
//! done: 1
//! saved: no
//! save: none
//! need: none
//!
//! 101 5000 10000 kept 102 # 102 Maximum frequency: 50.00 Hz → 100.00 Hz
//! checksum: 5e884898da28047151d0e56f8dc62927
//! ```
//!
//! A row is the PDU address, the former value, the new one, whether the drive keeps it without power, and the name of the parameter.

mod on_disk;

pub use on_disk::JournalFile;

use std::fmt::Write as _;

use super::file::{self, CHECKSUM, Id};
use super::plan::{Handling, Need, ParameterWrite, Plan};
use crate::process_image::Machine;
use drivegate_model::drive::Profile;

/// The first line of a journal.
const HEAD: &str = "# drivegate restore 2";
/// First line of journals that contain the name of the drive but not its bus and address.
const HEAD_WITHOUT_PLACE: &str = "# drivegate restore 1";
/// Name of the file, in the directory of the drive's readings.
const NAME: &str = "restore.journal";
/// Name of one that was set aside.
const RELEASED: &str = "restore.released";

/// The phase of a restore.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// The restore writes the new values.
    Writing,
    /// All new values are written; the drive is being ordered to save them.
    Saving,
    /// The restore writes the former values back.
    TakingBack,
    /// All former values are written; the drive is being ordered to save them.
    SavingBack,
}

impl Phase {
    const ALL: [(Phase, &'static str); 4] = [
        (Phase::Writing, "writing"),
        (Phase::Saving, "saving"),
        (Phase::TakingBack, "taking back"),
        (Phase::SavingBack, "saving the former values"),
    ];

    /// Name of the phase.
    pub fn name(self) -> &'static str {
        Phase::ALL
            .iter()
            .find(|(phase, _)| *phase == self)
            .map_or("", |(_, name)| name)
    }
}

/// The machine to which a journal belongs. The names are those from the start of the restore, as text.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Owner {
    /// Name of the drive.
    pub drive: String,
    /// Name of the drive's bus; empty in journals of earlier versions.
    pub bus: String,
    /// Name of the drive's profile.
    pub family: String,
    /// The machine; `None` in journals of earlier versions, which only contain a name.
    pub machine: Option<Machine>,
    /// The machine's identification.
    pub identification: String,
}

impl Owner {
    /// Parses the head of a journal, even if the rest cannot be parsed.
    ///
    /// # Errors
    /// If the text is not a journal: contains the reason.
    pub fn parse(text: &str) -> Result<Owner, String> {
        owner(&mut body_of(text)?.lines())
    }

    /// Bus and address of the machine, as text.
    pub fn place(&self) -> String {
        match &self.machine {
            Some(machine) => format!("`{}` at {machine}", self.drive),
            None => format!("`{}`, profile `{}`", self.drive, self.family),
        }
    }
}

/// The text of a journal without its checksum, after checking that.
fn body_of(text: &str) -> Result<String, String> {
    let body = text.trim_end_matches('\n');
    let (body, sum) = body.rsplit_once('\n').ok_or("it is empty, or its end is missing")?;
    let body = format!("{body}\n");
    if ![HEAD, HEAD_WITHOUT_PLACE]
        .iter()
        .any(|head| body.starts_with(&format!("{head}\n")))
    {
        return Err(format!("its first line is not `{HEAD}`"));
    }
    if sum.strip_prefix("checksum: ") != Some(checksum(&body).as_str()) {
        return Err("it does not match its checksum: it is damaged, or was edited".to_string());
    }
    Ok(body)
}

/// The value of `key` in the next line.
fn header<'a>(lines: &mut impl Iterator<Item = &'a str>, key: &str) -> Result<String, String> {
    let line = lines.next().unwrap_or_default();
    let value = line.strip_prefix(key).and_then(|rest| rest.strip_prefix(": "));
    let value = value.map(str::to_string);
    value.ok_or_else(|| format!("expected `{key}: …`, found `{line}`"))
}

fn owner<'a>(lines: &mut impl Iterator<Item = &'a str>) -> Result<Owner, String> {
    let has_place = lines.next() == Some(HEAD);
    let drive = header(lines, "drive")?;
    if !has_place {
        return Ok(Owner {
            drive,
            bus: String::new(),
            family: header(lines, "family")?,
            machine: None,
            identification: NO_IDENTIFICATION.to_string(),
        });
    }
    let (bus, port) = (header(lines, "bus")?, header(lines, "port")?);
    let address = header(lines, "address")?.parse();
    let family = header(lines, "family")?;
    Ok(Owner {
        drive,
        bus,
        machine: Some(Machine {
            port,
            address: address.map_err(|_| "`address` is not a number")?,
            profile: family.clone(),
        }),
        family,
        identification: header(lines, "identification")?,
    })
}

/// Placeholder for the identification of a family without one.
pub const NO_IDENTIFICATION: &str = "none";

/// The journal of a restore.
#[derive(Debug, Clone, PartialEq)]
pub struct Journal {
    /// The machine to which the journal belongs.
    pub of: Owner,
    /// When the restore began, RFC 3339.
    pub begun: String,
    /// Client that started the restore.
    pub by: String,
    /// Phase of the restore.
    pub phase: Phase,
    /// Parameters of this phase that were done when the journal was written; perhaps more were.
    pub done: usize,
    /// The drive may have been ordered to save values of this restore.
    pub saved: bool,
    /// The plan of writing the new values.
    pub plan: Plan,
}

impl Journal {
    /// The file. `profile` names the point that must hold.
    pub fn text(&self, profile: &Profile) -> String {
        let yes = |is: bool| if is { "yes" } else { "no" };
        let handling = &self.plan.handling;
        let save = handling.save.map(|(address, value)| format!("{address} {value}"));
        let need = handling.needs.as_ref().map(|need| {
            let point = profile.points.get(need.point).map_or("?", |point| point.name.as_str());
            let code = need.exception.map_or("-".to_string(), |code| code.to_string());
            format!("{point} {} {code} {}", yes(need.value), file::one_line(&need.remedy))
        });
        let none = || "none".to_string();
        let of = &self.of;
        let place = of.machine.as_ref().map(|machine| {
            let (port, address) = (file::one_line(&machine.port), machine.address);
            format!("bus: {}\nport: {port}\naddress: {address}\n", of.bus)
        });
        let identification = place
            .as_ref()
            .map(|_| format!("identification: {}\n", file::one_line(&of.identification)));
        let mut text = format!(
            "{}\ndrive: {}\n{}family: {}\n{}begun: {}\nby: {}\nphase: {}\ndone: {}\nsaved: {}\nsave: {}\nneed: {}\n\n",
            if place.is_some() { HEAD } else { HEAD_WITHOUT_PLACE },
            of.drive,
            place.unwrap_or_default(),
            of.family,
            identification.unwrap_or_default(),
            self.begun,
            file::one_line(&self.by),
            self.phase.name(),
            self.done,
            yes(self.saved),
            save.unwrap_or_else(none),
            need.unwrap_or_else(none),
        );
        for write in &self.plan.writes {
            let (from, to) = (file::text_of(write.from), file::text_of(write.to));
            let kept = if write.volatile { "volatile" } else { "kept" };
            let (address, id, line) = (write.address, &write.id, file::one_line(&write.line));
            // Writing to a string does not fail.
            let _ = writeln!(text, "{address} {from} {to} {kept} {id} # {line}");
        }
        let checksum = checksum(&text);
        let _ = writeln!(text, "checksum: {checksum}");
        text
    }

    /// Reads a journal of a drive of that family.
    ///
    /// # Errors
    /// If the text is not a journal of this family: contains the reason.
    pub fn parse(text: &str, profile: &Profile) -> Result<Journal, String> {
        let body = body_of(text)?;
        let mut lines = body.lines();
        let of = owner(&mut lines)?;
        if of.family != profile.name {
            return Err(format!(
                "it is for a drive of family {}, but the drive is configured as {}",
                of.family, profile.name
            ));
        }
        let mut header = |key: &str| header(&mut lines, key);
        let (begun, by) = (header("begun")?, header("by")?);
        let phase = header("phase")?;
        let phase = Phase::ALL
            .iter()
            .find(|(_, name)| *name == phase)
            .map(|(phase, _)| *phase);
        let phase = phase.ok_or("its phase is unknown")?;
        let done = header("done")?.parse().map_err(|_| "`done` is not a number")?;
        let saved = yes_or_no(&header("saved")?)?;
        let save = match header("save")?.as_str() {
            "none" => None,
            text => Some(pair(text).ok_or("`save` is not an address and a value")?),
        };
        let needs = match header("need")?.as_str() {
            "none" => None,
            text => Some(need(text, profile)?),
        };
        let rows = lines.filter(|line| !line.is_empty());
        let writes: Result<Vec<ParameterWrite>, String> = rows
            .map(|line| row(line).ok_or_else(|| format!("`{line}` is not a parameter with its values")))
            .collect();
        Ok(Journal {
            of,
            begun,
            by,
            phase,
            done,
            saved,
            plan: Plan {
                writes: writes?,
                handling: Handling { needs, save },
                ..Plan::default()
            },
        })
    }
}

fn yes_or_no(text: &str) -> Result<bool, String> {
    match text {
        "yes" => Ok(true),
        "no" => Ok(false),
        other => Err(format!("`{other}` is neither yes nor no")),
    }
}

fn pair(text: &str) -> Option<(u16, u16)> {
    let (address, value) = text.split_once(' ')?;
    Some((address.parse().ok()?, value.parse().ok()?))
}

fn need(text: &str, profile: &Profile) -> Result<Need, String> {
    let mut parts = text.splitn(4, ' ');
    let mut part = || parts.next().unwrap_or_default();
    let (name, value, code, remedy) = (part(), part(), part(), part());
    let point = profile
        .point_index(name)
        .ok_or_else(|| format!("profile `{}` has no point `{name}`", profile.name))?;
    let exception = match code {
        "-" => None,
        code => Some(code.parse().map_err(|_| format!("`{code}` is not an exception code"))?),
    };
    Ok(Need {
        point,
        value: yes_or_no(value)?,
        exception,
        remedy: remedy.to_string(),
    })
}

fn row(line: &str) -> Option<ParameterWrite> {
    let (row, note) = line.split_once(" # ")?;
    let mut parts = row.splitn(5, ' ');
    let address = parts.next()?.parse().ok()?;
    let (from, to) = (file::value_of(parts.next()?)?, file::value_of(parts.next()?)?);
    let volatile = match parts.next()? {
        "volatile" => true,
        "kept" => false,
        _ => return None,
    };
    Some(ParameterWrite {
        id: Id::new(parts.next()?),
        address,
        from,
        to,
        line: note.to_string(),
        volatile,
    })
}

fn checksum(text: &str) -> String {
    file::digest_of(text, CHECKSUM)
}

#[cfg(test)]
pub(super) mod tests {
    use proptest::prelude::*;

    use std::fs;

    use super::*;
    use crate::testkit;
    use drivegate_model::drive::parameters::RawValue;

    pub(crate) fn profile() -> std::sync::Arc<Profile> {
        testkit::nx()
    }

    pub(crate) fn write(id: u16, from: u16, to: u16) -> ParameterWrite {
        ParameterWrite {
            id: Id::new(&id.to_string()),
            address: id - 1,
            from: RawValue::Word(from),
            to: RawValue::Word(to),
            line: format!("{id}: {from} → {to}"),
            volatile: id.is_multiple_of(2),
        }
    }

    pub(crate) fn owner_at(address: u8) -> Owner {
        Owner {
            drive: "pump-1".to_string(),
            bus: "line1".to_string(),
            family: "vacon-nx".to_string(),
            machine: Some(Machine {
                port: "/dev/ttyUSB0".to_string(),
                address,
                profile: "vacon-nx".to_string(),
            }),
            identification: NO_IDENTIFICATION.to_string(),
        }
    }

    pub(crate) fn journal(writes: Vec<ParameterWrite>) -> Journal {
        Journal {
            of: owner_at(1),
            begun: "2026-03-02T07:40:12Z".to_string(),
            by: "local_socket uid 0".to_string(),
            phase: Phase::Writing,
            done: 0,
            saved: false,
            plan: Plan {
                writes,
                ..Plan::default()
            },
        }
    }

    #[test]
    fn damage_and_other_families_are_told() {
        let profile = profile();
        let mut journal = journal(vec![write(102, 5000, 10_000)]);
        journal.plan.handling = Handling {
            needs: Some(Need {
                point: drivegate_model::drive::PointIndex::new(0),
                value: false,
                exception: Some(0x22),
                remedy: "switch the operator to PRGM".to_string(),
            }),
            save: Some((0x0900, 0)),
        };
        let text = journal.text(&profile);
        assert_eq!(Journal::parse(&text, &profile), Ok(journal.clone()));
        let why = |text: &str| Journal::parse(text, &profile).unwrap_err();
        assert!(why(&text.replace("5000", "5001")).contains("checksum"));
        assert!(why("").contains("empty"));
        journal.of.family = "vacon-cx".to_string();
        assert!(why(&journal.text(&profile)).contains("family vacon-cx"));
    }

    #[test]
    fn one_of_an_earlier_version_knows_a_name_only() {
        let profile = profile();
        let mut journal = journal(vec![write(102, 5000, 10_000)]);
        (journal.of.machine, journal.of.bus) = (None, String::new());
        let text = journal.text(&profile);
        assert!(
            text.starts_with("# drivegate restore 1\ndrive: pump-1\nfamily: vacon-nx\nbegun: "),
            "{text}"
        );
        assert_eq!(Journal::parse(&text, &profile), Ok(journal.clone()));
        assert_eq!(Owner::parse(&text), Ok(journal.of));
    }

    #[test]
    fn one_of_an_earlier_version_is_taken_up_by_the_drive_with_its_name() {
        let profile = profile();
        let folder = tempfile::tempdir().unwrap();
        let file = JournalFile::new(folder.path(), "pump-1");
        let earlier = Journal {
            of: Owner {
                machine: None,
                bus: String::new(),
                ..owner_at(1)
            },
            ..journal(vec![write(102, 5000, 10_000)])
        };
        let write = |of: &Owner, text: &str| file.write(of, text);
        write(&earlier.of, &earlier.text(&profile)).unwrap();
        for other in [
            Owner {
                drive: "pump-2".to_string(),
                ..owner_at(1)
            },
            Owner {
                family: "vacon-cx".to_string(),
                ..owner_at(1)
            },
        ] {
            let why = write(&other, "other").unwrap_err().to_string();
            assert!(why.contains("`pump-1`, profile `vacon-nx`"), "{why}");
            file.remove(&other).unwrap();
            assert_eq!(file.read().unwrap(), Some(earlier.text(&profile)));
        }
        // When the restore is resumed, its machine is written into the journal; another machine with the same name
        // then cannot resume the restore.
        let taken_up = Journal {
            of: owner_at(1),
            ..earlier
        };
        write(&taken_up.of, &taken_up.text(&profile)).unwrap();
        assert_eq!(file.read().unwrap(), Some(taken_up.text(&profile)));
        assert!(write(&owner_at(2), "other").is_err());
        file.remove(&taken_up.of).unwrap();
        assert_eq!(file.read().unwrap(), None);
    }

    #[test]
    fn the_journal_of_another_machine_is_neither_replaced_nor_removed() {
        let profile = profile();
        let folder = tempfile::tempdir().unwrap();
        let file = JournalFile::new(folder.path(), "pump-1");
        let own = journal(vec![write(102, 5000, 10_000)]);
        file.write(&own.of, &own.text(&profile)).unwrap();
        let other = owner_at(2);
        let why = file.write(&other, "two").unwrap_err().to_string();
        assert!(why.contains("`pump-1` at address 1 on /dev/ttyUSB0"), "{why}");
        file.remove(&other).unwrap();
        assert_eq!(file.read().unwrap(), Some(own.text(&profile)));
        assert_eq!(JournalFile::all(folder.path()).unwrap(), std::slice::from_ref(&file));
        file.remove(&own.of).unwrap();
        assert_eq!(JournalFile::all(folder.path()).unwrap(), []);
    }

    #[test]
    fn it_is_there_until_it_is_removed_or_set_aside() {
        let folder = tempfile::tempdir().unwrap();
        let file = JournalFile::new(&folder.path().join("state/params"), "pump-1");
        assert_eq!(file.read().unwrap(), None);
        let of = owner_at(1);
        file.write(&of, "one").unwrap();
        file.write(&of, "two").unwrap();
        assert_eq!(file.read().unwrap().as_deref(), Some("two"));
        file.remove(&of).unwrap();
        file.remove(&of).unwrap();
        assert_eq!(file.read().unwrap(), None);
        file.write(&of, "three").unwrap();
        let aside = file.release().unwrap();
        assert_eq!(
            (file.read().unwrap(), fs::read(aside).unwrap()),
            (None, b"three".to_vec())
        );
        fs::write(folder.path().join("state/params/file"), "").unwrap();
        let below_a_file = JournalFile::new(&folder.path().join("state/params/file"), "x");
        assert_eq!(below_a_file.read().unwrap(), None);
        assert!(below_a_file.write(&of, "x").is_err());
    }

    proptest! {
        #[test]
        fn nothing_is_lost_and_no_cut_is_taken_for_a_whole(
            rows in proptest::collection::vec((2u16..2000, any::<u16>(), any::<u16>()), 0..40),
            done in 0usize..50,
            cut in any::<proptest::sample::Index>(),
        ) {
            let profile = profile();
            let mut journal = journal(rows.into_iter().map(|(id, from, to)| write(id, from, to)).collect());
            journal.done = done;
            let text = journal.text(&profile);
            prop_assert_eq!(Journal::parse(&text, &profile), Ok(journal));
            let cut = cut.index(text.len() - 1);
            if let Some(part) = text.get(..cut) {
                prop_assert!(Journal::parse(part, &profile).is_err());
            }
        }

        #[test]
        fn no_text_is_too_odd(text in "\\PC*") {
            let profile = profile();
            let _ = Journal::parse(&text, &profile);
            let body = format!("{HEAD}\n{text}\n");
            let _ = Journal::parse(&format!("{body}checksum: {}\n", checksum(&body)), &profile);
        }
    }
}
