//! The frequency range of a drive on which a command depends: the range that converted Hz to percent, or that
//! applied a limit in one unit to the other. Pure.

use std::time::Instant;

use super::{Becomes, becomes};
use crate::process_image::Reading;
use drivegate_model::drive::{Bound, PointIndex, Profile, Source, Value};
use drivegate_proto::Table;

/// A frequency range as it was when a command was admitted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrequencyRange {
    minimum: Bound,
    maximum: Bound,
    /// Lowest and highest frequency in Hz at the admission.
    was: (f64, f64),
}

impl FrequencyRange {
    /// Whether the range is unchanged. A command may have changed the drive's own range at `written`; a range read
    /// before that is not valid.
    pub fn holds(&self, drive: &Reading<'_>, written: Option<Instant>) -> bool {
        let read_before = |end: PointIndex| {
            drive
                .sample(end)
                .at
                .zip(written)
                .is_some_and(|(at, written)| at <= written)
        };
        !self.ends().any(read_before) && drive.band(self.minimum, self.maximum) == Some(self.was)
    }

    /// The points of the drive with the limits of its range.
    pub(crate) fn ends(&self) -> impl Iterator<Item = PointIndex> {
        ends((self.minimum, self.maximum))
    }
}

/// The frequency ranges by which a command to `asked` sets the register to this point and value, and by which it
/// keeps the limits.
pub(crate) fn rests_on(drive: &Reading<'_>, asked: PointIndex, written: (PointIndex, Value)) -> Vec<FrequencyRange> {
    let mut ranges = Vec::new();
    for (index, point) in drive.spec.profile.points.enumerate() {
        let matters = index == asked || drive.spec.limits.contains_key(&point.name);
        let Some((minimum, maximum)) = matters.then(|| band(&drive.spec.profile, index)).flatten() else {
            continue;
        };
        if becomes(drive, index, written) == Becomes::Untouched {
            continue;
        }
        let Some(was) = drive.band_for_commands(minimum, maximum) else {
            continue;
        };
        let range = FrequencyRange { minimum, maximum, was };
        if !ranges.contains(&range) {
            ranges.push(range);
        }
    }
    ranges
}

/// Whether the register is an end of a frequency range on which commands may depend.
pub fn is_range_end(profile: &Profile, table: Table, address: u16) -> bool {
    let bands = profile.points.indexes().filter_map(|point| band(profile, point));
    let mut raws = bands.flat_map(ends).filter_map(|end| profile.points.get(end)?.raw());
    raws.any(|raw| raw.covers(table, address))
}

/// The ends of the band by which commands to that point are converted.
fn band(profile: &Profile, point: PointIndex) -> Option<(Bound, Bound)> {
    let point = profile.points.get(point)?;
    match (&point.source, point.write_to) {
        (_, Some(target)) => band(profile, target),
        (Source::Derived(derived), None) => derived.band().map(|(_, minimum, maximum)| (minimum, maximum)),
        (Source::Raw(_), None) => None,
    }
}

fn ends((minimum, maximum): (Bound, Bound)) -> impl Iterator<Item = PointIndex> {
    [minimum, maximum].into_iter().filter_map(|end| match end {
        Bound::Point(point) => Some(point),
        Bound::Fixed(_) | Bound::Configured => None,
    })
}
