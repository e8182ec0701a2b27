//! Which registers and coils a raw write may set, in addition to those of writable points. Pure.
//!
//! A register without a writable point can change the meaning of the writable ones: with another maximum frequency 80 % is
//! another speed, past every limit of the configuration. So it is written only if the drive's configuration permits that.

use std::ops::RangeInclusive;

use super::Profile;
use drivegate_proto::Table;

/// The raw writes that a drive's configuration allows in addition to its writable points.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum RawWrites {
    /// No raw writes except to writable points.
    #[default]
    Points,
    /// Only these PDU addresses, for registers and coils alike.
    Ranges(Vec<RangeInclusive<u16>>),
    /// All addresses that the profile allows to be written.
    All,
}

impl RawWrites {
    /// The first of the `addresses` of one write that must not be set; `None` if the write is allowed. A write that
    /// contains the control word is always allowed, so that process data can be written as one block and no stop is
    /// refused.
    pub fn refused(
        &self,
        profile: &Profile,
        table: Table,
        addresses: impl Iterator<Item = u16> + Clone,
    ) -> Option<u16> {
        let is_control_word = |address: u16| {
            let at = profile.control.as_ref().map(|control| control.at);
            let places = [profile.run_place(), at];
            places
                .into_iter()
                .flatten()
                .any(|at| (at.table, at.address) == (table, address))
        };
        if addresses.clone().any(is_control_word) {
            return None;
        }
        let mut addresses = addresses;
        addresses.find(|address| !self.admits(profile, table, *address))
    }

    fn admits(&self, profile: &Profile, table: Table, address: u16) -> bool {
        let configured = match self {
            RawWrites::Points => false,
            RawWrites::Ranges(ranges) => ranges.iter().any(|range| range.contains(&address)),
            RawWrites::All => true,
        };
        configured || is_of_writable_point(profile, table, address)
    }

    /// The addresses that the profile allows but this setting refuses, as the longest possible ranges.
    pub fn refused_ranges(&self, profile: &Profile) -> Vec<(Table, RangeInclusive<u16>)> {
        let mut refused: Vec<(Table, RangeInclusive<u16>)> = Vec::new();
        for range in profile.ranges.iter().filter(|range| range.write > 0) {
            for address in range.addresses.clone() {
                if self.refused(profile, range.table, std::iter::once(address)).is_none() {
                    continue;
                }
                match refused.last_mut() {
                    Some((table, last)) if *table == range.table && last.end().checked_add(1) == Some(address) => {
                        *last = *last.start()..=address;
                    }
                    _ => refused.push((range.table, address..=address)),
                }
            }
        }
        refused
    }
}

/// Whether a command to a point sets this register or coil; a point that is read in one register and written in
/// another uses the latter.
fn is_of_writable_point(profile: &Profile, table: Table, address: u16) -> bool {
    let covers = |raw: &super::Raw| raw.covers(table, address);
    let points = profile.points.iter();
    points
        .filter(|point| point.write && point.write_to.is_none())
        .any(|point| point.raw().is_some_and(covers))
}

/// Ranges of addresses in words: `holding 100 to 731, 734; coil 5`.
pub fn in_words(ranges: &[(Table, RangeInclusive<u16>)]) -> String {
    let tables = ranges.chunk_by(|(one, _), (other, _)| one == other);
    let parts = tables.filter_map(|of_table| {
        let (table, _) = of_table.first()?;
        Some(format!("{} {}", table.name(), addresses_in_words(of_table)))
    });
    parts.collect::<Vec<_>>().join("; ")
}

/// The addresses as text, without the tables.
pub fn addresses_in_words(ranges: &[(Table, RangeInclusive<u16>)]) -> String {
    let words = ranges.iter().map(|(_, range)| match range.clone().into_inner() {
        (first, last) if first == last => first.to_string(),
        (first, last) => format!("{first} to {last}"),
    });
    words.collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::drive::profile::Profiles;

    fn profile(name: &str) -> Arc<Profile> {
        Profiles::built_in().get(name).unwrap().clone()
    }

    fn refused(rule: &RawWrites, profile: &Profile, table: Table, addresses: RangeInclusive<u16>) -> Option<u16> {
        rule.refused(profile, table, addresses)
    }

    #[test]
    fn a_block_goes_out_with_the_control_word_or_with_writable_points_only() {
        let nx = profile("vacon-nx");
        let holding = |addresses| refused(&RawWrites::Points, &nx, Table::Holding, addresses);
        assert_eq!(holding(2000..=2002), None, "the frame of the manual: 10 07D0 0003");
        assert_eq!(holding(2000..=2010), None);
        assert_eq!(holding(2002..=2010), None, "reference and process data");
        assert_eq!(holding(2001..=2002), Some(2001), "the general control word alone");
        assert_eq!(holding(101..=101), Some(101), "maximum frequency");
        assert_eq!(holding(732..=733), None, "parameters that are points");
        assert_eq!(holding(733..=734), Some(734), "a writable one beside one of no point");
        assert_eq!(refused(&RawWrites::Points, &nx, Table::Coil, 2000..=2000), Some(2000));
    }

    #[test]
    fn what_the_configuration_names_goes_out() {
        let nx = profile("vacon-nx");
        let some = RawWrites::Ranges(vec![101..=199, 300..=300]);
        for (addresses, wanted) in [
            (100..=100, Some(100)),
            (101..=199, None),
            (199..=200, Some(200)),
            (300..=300, None),
        ] {
            assert_eq!(
                refused(&some, &nx, Table::Holding, addresses.clone()),
                wanted,
                "{addresses:?}"
            );
        }
        assert_eq!(refused(&RawWrites::All, &nx, Table::Holding, 100..=1998), None);
    }

    #[test]
    fn a_point_that_is_written_elsewhere_does_not_open_the_register_it_is_read_from() {
        let mut teco = profile("teco-7300pa");
        let index = teco.point_index("frequency_reference").unwrap();
        assert!(teco.points.get(index).unwrap().write && teco.points.get(index).unwrap().write_to.is_some());
        assert_eq!(
            refused(&RawWrites::Points, &teco, Table::Holding, 0x23..=0x23),
            Some(0x23)
        );
        assert_eq!(refused(&RawWrites::Points, &teco, Table::Holding, 2..=2), None);
        // Without a run command, the drive has no control word.
        for point in &mut Arc::make_mut(&mut teco).points {
            point.write = false;
        }
        assert_eq!(refused(&RawWrites::Points, &teco, Table::Holding, 2..=2), Some(2));
        assert_eq!(
            refused(&RawWrites::Points, &teco, Table::Holding, 1..=2),
            None,
            "the word that would stop it"
        );
    }

    #[test]
    fn no_family_loses_its_control_word() {
        for profile in Profiles::built_in().iter() {
            let control = profile.control.as_ref();
            // A family that can only be read has no control register.
            let Some((table, address)) = control.map(|control| (control.at.table, control.at.address)) else {
                assert_eq!(profile.ranges.iter().map(|range| range.write).max(), Some(0));
                continue;
            };
            assert_eq!(
                refused(&RawWrites::Points, profile, table, address..=address),
                None,
                "{}",
                profile.name
            );
            let lost = RawWrites::Points.refused_ranges(profile);
            assert!(lost.iter().all(|(of, range)| *of != table || !range.contains(&address)));
            assert_eq!(RawWrites::All.refused_ranges(profile), []);
        }
    }

    #[test]
    fn the_ranges_that_are_refused_in_words() {
        let words = |name: &str| in_words(&RawWrites::Points.refused_ranges(&profile(name)));
        assert_eq!(words("vacon-nx"), "holding 100 to 731, 734 to 1998, 2001");
        assert_eq!(words("vacon-cx"), "holding 1 to 98, 100 to 9898, 9900 to 9998");
        let pair = [(Table::Coil, 3..=3), (Table::Holding, 8..=9)];
        assert_eq!(in_words(&pair), "coil 3; holding 8 to 9");
    }
}
