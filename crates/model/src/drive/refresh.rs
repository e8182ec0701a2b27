//! Which writes a refresh may repeat for a family: its control word, its reference, or both. Pure.
//!
//! The timeout of some drives counts only writes of the control word or of a reference, so polling does not restart
//! it; such a write is repeated. A setting that acts once, a coil, a separate register, and a value that the drive
//! stores are never repeated.

use std::time::Duration;

use super::control::{Control, OwnWord};
use super::{ModelPoint, PointIndex, Profile, Raw, Source};
use drivegate_proto::{Protocol, Table};

/// The shortest and the longest time between two refreshes.
pub const REFRESH: std::ops::RangeInclusive<Duration> = Duration::from_millis(100)..=Duration::from_secs(60);

/// The parts that a refresh repeats.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Repeats {
    /// Whether the control word is repeated.
    pub word: bool,
    /// Whether a reference is repeated.
    pub reference: bool,
}

impl Control {
    /// Bits of the control word to which `[control]` gives a meaning, except resets. A word with other bits is not
    /// repeated, since these may jog the motor.
    pub fn known_bits(&self) -> u16 {
        let here = |setting: &&super::control::Setting| setting.place.is_none();
        let runs = self.runs();
        let settings = runs
            .iter()
            .chain([&self.stop])
            .chain(&self.also_stop)
            .chain(&self.reverse);
        settings
            .filter(here)
            .fold(self.always.set | self.always.clear, |bits, setting| bits | setting.mask)
    }

    /// Whether run and stop are levels of one register.
    fn is_level(&self) -> bool {
        let level = |setting: &super::control::Setting| setting.place.is_none() && !setting.once;
        self.at.table == Table::Holding && self.runs().iter().all(level) && level(&self.stop)
    }

    /// Whether the drive reports its control word when read.
    pub fn is_read(&self) -> bool {
        self.own_word != OwnWord::Shadow
    }
}

impl Profile {
    /// The point whose register takes the commands for a point.
    pub fn behind(&self, index: PointIndex) -> PointIndex {
        let mut at = index;
        // Follows a point to the register behind it, through the point that takes its commands.
        for _ in 0..4 {
            let Some(point) = self.points.get(at) else { return at };
            let next = match (&point.source, point.write_to) {
                (_, Some(target)) => Some(target),
                (Source::Derived(derived), None) => derived.band().map(|(of, ..)| of),
                (Source::Raw(_), None) => None,
            };
            match next {
                Some(next) => at = next,
                None => return at,
            }
        }
        at
    }

    /// The registers that take the references of the common model.
    fn references(&self) -> impl Iterator<Item = &Raw> {
        let points = [ModelPoint::SpeedReference, ModelPoint::FrequencyReference];
        points
            .into_iter()
            .filter_map(|point| self.points.get(self.behind(self.model_index(point)?))?.raw())
    }

    /// Whether a refresh may repeat this register as a reference.
    pub fn is_repeated_reference(&self, address: u16) -> bool {
        let covers = |raw: &Raw| raw.covers(Table::Holding, address);
        self.references().any(covers) && !self.writes_on_change(Table::Holding, &[(address, 0)])
    }

    /// The parts that a refresh repeats.
    ///
    /// # Errors
    /// If commands are not repeated; contains the reason.
    pub fn repeats(&self) -> Result<Repeats, &'static str> {
        if self.protocols.contains(&Protocol::N2) {
            return Err("an N2 drive stores what is written");
        }
        let Some(control) = &self.control else {
            return Err("the profile has no run command");
        };
        if self.model_index(ModelPoint::Running).is_none() {
            return Err("the profile does not say where the drive reports whether its motor runs");
        }
        let is_stored = |address: u16| self.writes_on_change(Table::Holding, &[(address, 0)]);
        let repeats = Repeats {
            word: control.is_level() && !is_stored(control.at.address),
            reference: self
                .references()
                .any(|raw| raw.table == Table::Holding && !is_stored(raw.address)),
        };
        match repeats {
            Repeats {
                word: false,
                reference: false,
            } => Err("its commands act once or are stored, and it has no reference that is a level"),
            repeats => Ok(repeats),
        }
    }

    /// Whether one request can write both of these neighbouring registers.
    pub fn writes_together(&self, first: u16, count: u16) -> bool {
        let last = first.saturating_add(count.saturating_sub(1));
        self.ranges.iter().any(|range| {
            range.table == Table::Holding
                && range.write >= count
                && range.addresses.contains(&first)
                && range.addresses.contains(&last)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drive::profile::Profiles;

    /// A row for each family: the repeated parts, worked out by hand from the control words in their profiles. `-`
    /// means nothing.
    #[test]
    fn what_is_repeated_of_each_family() {
        let table = [
            ("abb-acs550", "word reference"),
            ("abb-acs580", "word reference"),
            ("danfoss-fc", "word reference"),
            ("delta-ms300", "reference"),
            ("eaton-hvx", "word reference"),
            ("eaton-hvx-n2", "-"),
            ("fuji-frenic", "word reference"),
            ("hitachi-wj200", "reference"),
            ("invertek-optidrive", "word reference"),
            ("invt-goodrive", "reference"),
            ("lenze-i550", "-"),
            ("ls-g100", "reference"),
            ("mitsubishi-d700", "word reference"),
            ("schneider-altivar", "word reference"),
            ("siemens-g120", "word reference"),
            ("siemens-v20", "word reference"),
            ("teco-7300pa", "word reference"),
            ("teco-7300pa-n2", "-"),
            ("teco-f510", "word reference"),
            ("toshiba-vf-s15", "word reference"),
            ("vacon-10", "word reference"),
            ("vacon-cx", "reference"),
            ("vacon-nx", "word reference"),
            ("vacon-nx-n2", "-"),
            ("weg-cfw", "word reference"),
            ("yaskawa-v1000", "word reference"),
        ];
        let all = Profiles::built_in();
        for (name, expected) in table {
            let found = match all.get(name).unwrap().repeats() {
                Ok(Repeats { word, reference }) => {
                    let parts = [word.then_some("word"), reference.then_some("reference")];
                    parts.into_iter().flatten().collect::<Vec<_>>().join(" ")
                }
                Err(_) => "-".to_string(),
            };
            assert_eq!(found, expected, "{name}");
        }
    }
}
