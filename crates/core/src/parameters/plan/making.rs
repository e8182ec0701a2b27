//! Making a plan: differences between two drives, exceptions, reasons against it.

use std::collections::BTreeSet;

use super::super::difference::Difference;
use super::super::file::{Entry, Id, ParameterFile};
use super::{Handling, Need, ParameterWrite, Plan, Risk, Wishes, order, text};
use drivegate_model::drive::Profile;
use drivegate_model::drive::parameters::{RawValue, has};

/// A plan of a restore that is being made.
pub(super) struct Making<'a> {
    profile: &'a Profile,
    wanted: &'a ParameterFile,
    present: &'a ParameterFile,
    wishes: &'a Wishes,
    same_application: bool,
    plan: Plan,
    refused: Vec<String>,
    risks: Vec<Risk>,
}

/// End of an identification with an unread point.
pub const NOT_KNOWN: &str = "not known";

/// The value of a parameter after the plan is carried out.
struct End {
    id: Id,
    written: bool,
    value: Option<RawValue>,
}

/// The value that was read, if any.
fn value_of(file: &ParameterFile, id: &Id) -> Option<RawValue> {
    file.values.get(id).and_then(|entry| entry.value.as_ref().ok().copied())
}

/// Whether both values are the same number of the same kind. 0.0 and -0.0 count as the same number.
fn same(a: RawValue, b: RawValue) -> bool {
    same_kind(a, b) && a.number() == b.number()
}

fn same_kind(a: RawValue, b: RawValue) -> bool {
    matches!(
        (a, b),
        (RawValue::Word(_), RawValue::Word(_)) | (RawValue::Float(_), RawValue::Float(_))
    )
}

impl<'a> Making<'a> {
    /// Compares files of the family of `profile`.
    pub(super) fn new(
        profile: &'a Profile,
        wanted: &'a ParameterFile,
        present: &'a ParameterFile,
        wishes: &'a Wishes,
    ) -> Making<'a> {
        Making {
            profile,
            wanted,
            present,
            wishes,
            same_application: wanted.application() == present.application(),
            plan: Plan::default(),
            refused: Vec::new(),
            risks: Vec::new(),
        }
    }

    /// The plan, or every reason against it.
    pub(super) fn make(mut self) -> Result<(Plan, Vec<Risk>), Vec<String>> {
        self.compare_drives();
        self.find_named();
        self.collect();
        self.note_what_one_side_has();
        self.check_ratings();
        self.check_limits();
        self.finish()
    }

    /// Adds an objection that the user may override.
    fn doubt(&mut self, what: String, remedy: &str) {
        if self.wishes.force {
            self.risks.push(Risk(what));
        } else {
            self.refused
                .push(format!("{what}; {remedy}, or take the risk with --force"));
        }
    }

    fn is_named_singly(&self, id: &Id) -> bool {
        self.wishes.only.contains(id)
    }

    /// Whether the parameter is to be restored, unless there is an objection.
    fn is_asked_for(&self, id: &Id) -> bool {
        self.wishes.only.is_empty() || self.is_named_singly(id)
    }

    /// Compares identification, application and nameplate of both drives.
    fn compare_drives(&mut self) {
        let (profile, wanted, present) = (self.profile, self.wanted, self.present);
        if wanted.identification != present.identification {
            let what = format!(
                "the drives identify themselves differently: {} `{}`, in the file `{}`",
                present.drive, present.identification, wanted.identification
            );
            self.doubt(what, "restore to a drive of the same kind");
        } else if present.identification.contains(NOT_KNOWN) {
            let what = format!(
                "whether the drives are of the same kind is unknown: `{}`",
                present.identification
            );
            self.doubt(what, "read them again");
        }
        if !self.same_application {
            let what = format!(
                "the drives have different parameters: {} {}, in the file {}: their application, size or software \
                 differs",
                present.drive,
                present.application(),
                wanted.application()
            );
            self.doubt(what, "choose the same application and read the drive again");
        }
        let list = &profile.parameters;
        let ids: BTreeSet<&Id> = wanted.values.keys().chain(present.values.keys()).collect();
        for id in ids {
            let address = list.address(id.name());
            if !address.is_some_and(|address| has(&list.rules.nameplate, address)) || self.is_named_singly(id) {
                continue;
            }
            match (value_of(wanted, id), value_of(present, id)) {
                (Some(there), Some(here)) if same(there, here) => {}
                (Some(there), Some(here)) => {
                    let what = format!("the drives differ in size: {}", self.line(id, here, there));
                    self.doubt(what, "restore to a drive of the same size");
                }
                _ => {
                    let what = format!("whether the drives are the same size is unknown: {id} was not read from both");
                    self.doubt(what, "read them again");
                }
            }
        }
    }

    /// Parameters named by the user must exist on both sides.
    fn find_named(&mut self) {
        let missing = |id: &Id| {
            let side = [(self.wanted, "the file"), (self.present, "the drive")];
            side.into_iter()
                .find_map(|(file, side)| match file.values.get(id).map(|entry| &entry.value) {
                    None => Some(format!("{side} has no parameter `{id}`; see `drivegate params show`")),
                    Some(Err(why)) => Some(format!("parameter {id} of {side} was not read: {why}; read it again")),
                    Some(Ok(_)) => None,
                })
        };
        let missing: Vec<String> = self.wishes.only.iter().filter_map(missing).collect();
        self.refused.extend(missing);
    }

    /// Sorts the differences: written, left out, or refused.
    fn collect(&mut self) {
        let (profile, wanted) = (self.profile, self.wanted);
        let all = wanted.read_values();
        let asked: Vec<(&Id, RawValue)> = all.filter(|(id, _)| self.is_asked_for(id)).collect();
        for (id, to) in asked {
            let Some(from) = value_of(self.present, id).filter(|from| !same(*from, to)) else {
                continue;
            };
            let address = profile.parameters.address(id.name());
            // An address has one name, and is written once.
            let Some(address) = address.filter(|address| profile.parameters.id(*address).as_deref() == Some(id.name()))
            else {
                self.leave_out(id, from, to, "the profile does not know it");
                continue;
            };
            if let Some(why) = self.leaves_out(id, address) {
                self.leave_out(id, from, to, &why);
            } else if let Err(why) = self.check_value(id, address, from, to) {
                self.refused.push(why);
            } else {
                self.plan.writes.push(ParameterWrite {
                    id: id.clone(),
                    address,
                    from,
                    to,
                    line: self.line(id, from, to),
                    volatile: has(&profile.parameters.rules.volatile, address),
                });
            }
        }
    }

    fn leave_out(&mut self, id: &Id, from: RawValue, to: RawValue, why: &str) {
        let line = self.line(id, from, to);
        self.plan.left_out.push((id.clone(), format!("{line}; {why}")));
    }

    /// Why a parameter is not written although it differs.
    fn leaves_out(&self, id: &Id, address: u16) -> Option<String> {
        if !self.profile.parameter_is_writable(address) {
            return Some("it can only be read".to_string());
        }
        if self.is_named_singly(id) {
            return None;
        }
        if let Some(why) = self.profile.parameters.rules.held_back(address) {
            return Some(why.to_string());
        }
        (!self.same_application && !self.has_name(address))
            .then(|| "it has no name, and may mean something else in the drive's application".to_string())
    }

    fn has_name(&self, address: u16) -> bool {
        let parameter = self.profile.parameters.by_address(address);
        parameter.is_some_and(|parameter| !parameter.label.name.is_empty())
    }

    fn check_value(&self, id: &Id, address: u16, from: RawValue, to: RawValue) -> Result<(), String> {
        let is_object = self.profile.parameter_words() == 2;
        if !same_kind(from, to) || is_object != matches!(to, RawValue::Float(_)) {
            return Err(format!(
                "{id}: one of its values is a register, the other an analog output of N2; the file is not for this \
                 drive's family"
            ));
        }
        let parameter = self.profile.parameters.by_address(address);
        match parameter.and_then(|parameter| parameter.range.as_ref().filter(|_| !parameter.accepts(to))) {
            None => Ok(()),
            Some(range) => Err(format!(
                "{}: outside the drive's range, {} to {}; restore the others with --only",
                self.line(id, from, to),
                range.start(),
                range.end()
            )),
        }
    }

    fn line(&self, id: &Id, from: RawValue, to: RawValue) -> String {
        let note = |file: &ParameterFile| {
            file.values
                .get(id)
                .map_or(String::new(), |entry: &Entry| entry.note.clone())
        };
        let line = Difference {
            id: id.clone(),
            before: Some(from),
            after: Some(to),
            note_before: note(self.present),
            note_after: note(self.wanted),
        }
        .line();
        text::with_counts(line, from, to)
    }

    fn note_what_one_side_has(&mut self) {
        if !self.wishes.only.is_empty() {
            return;
        }
        let (wanted, present) = (&self.wanted.values, &self.present.values);
        let unread = |entry: Option<&Entry>| entry.is_some_and(|entry| entry.value.is_err());
        let groups = [
            (
                "only the file has",
                ids(wanted.keys().filter(|id| !present.contains_key(id))),
            ),
            (
                "only the drive has",
                ids(present.keys().filter(|id| !wanted.contains_key(id))),
            ),
            (
                "not read when the file was made",
                ids(wanted.keys().filter(|id| unread(wanted.get(id)))),
            ),
            (
                "not read from the drive now",
                ids(present.keys().filter(|id| unread(present.get(id)))),
            ),
        ];
        for (what, ids) in groups.into_iter().filter(|(_, ids)| !ids.is_empty()) {
            self.plan
                .notes
                .push(format!("left as they are, {what}: {}", text::list(&ids)));
        }
        let unnamed = self.plan.writes.iter().filter(|write| !self.has_name(write.address));
        let unnamed = ids(unnamed.map(|write| &write.id));
        if !unnamed.is_empty() {
            self.plan.notes.push(format!(
                "the profile has no name for {}: any of them may select the control place, restart the drive by \
                 itself or configure the bus; check them",
                text::list(&unnamed)
            ));
        }
    }

    /// Objects to changed ratings of supply and motor, since those of another drive may not fit.
    fn check_ratings(&mut self) {
        let ratings = &self.profile.parameters.rules.ratings;
        let changed = self.plan.writes.iter().filter(|write| has(ratings, write.address));
        let named = changed.filter(|write| !self.is_named_singly(&write.id));
        let lines: Vec<String> = named.map(|write| write.line.clone()).collect();
        if lines.is_empty() {
            return;
        }
        let what = format!("ratings of supply or motor change: {}", lines.join("; "));
        if self.wanted.drive == self.present.drive {
            self.plan.notes.push(format!("{what}; compare them with the motor"));
        } else {
            self.doubt(
                what,
                "compare them with the motor of the drive, or restore the others with --only",
            );
        }
    }

    /// The final values must not violate limits, unless the values of the other drive violated them, too.
    fn check_limits(&mut self) {
        let profile = self.profile;
        for limit in &profile.parameters.rules.limits {
            let (upper, lower) = (self.in_the_end(limit.upper), self.in_the_end(limit.lower));
            let (Some(high), Some(low)) = (upper.value, lower.value) else {
                continue;
            };
            if high.number() >= low.number() || !(upper.written || lower.written) {
                continue;
            }
            let (upper, lower) = (upper.id, lower.id);
            let held = |id| value_of(self.wanted, id).map(RawValue::number);
            if matches!((held(&upper), held(&lower)), (Some(high), Some(low)) if high < low) {
                let note = format!("{upper} will be below {lower}, as it was on {}", self.wanted.drive);
                self.plan.notes.push(note);
            } else {
                let what = format!("{upper} would be below {lower}, which it limits");
                self.doubt(what, "restore both of them");
            }
        }
    }

    fn in_the_end(&self, address: u16) -> End {
        let id = Id::new(&self.profile.parameters.id(address).unwrap_or_default());
        let write = self.plan.writes.iter().find(|write| write.address == address);
        End {
            written: write.is_some(),
            value: write.map(|write| write.to).or_else(|| value_of(self.present, &id)),
            id,
        }
    }

    fn finish(mut self) -> Result<(Plan, Vec<Risk>), Vec<String>> {
        if !self.refused.is_empty() {
            return Err(self.refused);
        }
        let rules = &self.profile.parameters.rules;
        let writes = std::mem::take(&mut self.plan.writes);
        self.plan.writes = order::safe(writes, &rules.limits, |address| {
            let id = self.profile.parameters.id(address)?;
            value_of(self.present, &Id::new(&id))
        });
        let writes = &self.plan.writes;
        self.plan.handling = Handling {
            needs: rules
                .lock
                .as_ref()
                .filter(|lock| writes.iter().any(|write| has(&lock.of, write.address)))
                .map(|lock| Need {
                    point: lock.point,
                    value: false,
                    exception: lock.exception,
                    remedy: lock.remedy.clone(),
                }),
            save: rules.save.filter(|_| writes.iter().any(|write| !write.volatile)),
        };
        let volatile = ids(writes.iter().filter(|write| write.volatile).map(|write| &write.id));
        if !volatile.is_empty() {
            let note = format!("the drive loses these at power-off: {}", text::list(&volatile));
            self.plan.notes.push(note);
        }
        if !rules.note.is_empty() && !self.plan.writes.is_empty() {
            self.plan.notes.push(rules.note.clone());
        }
        Ok((self.plan, self.risks))
    }
}

fn ids<'a>(ids: impl Iterator<Item = &'a Id>) -> Vec<Id> {
    ids.cloned().collect()
}
