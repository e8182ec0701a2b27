//! Registers to which a drive never replies although it replies to others: lists them, and what to write in the profile.

use super::{Cause, Certainty, Finding};
use drivegate_model::drive::{DriveIndex, PlannedRead, Profile};

/// Maximum number of registers and points that one verdict lists.
const NAMED: usize = 6;

/// The finding about reads of a drive of this profile that get no reply and cannot be divided further. `answered`
/// is the number of other requests to the drive that were answered in the last minute.
pub fn finding(drive: DriveIndex, profile: &Profile, reads: &[PlannedRead], answered: u32) -> Finding {
    let points = points_of(profile, reads);
    let places: Vec<String> = reads.iter().map(place).collect();
    let named = match points.as_slice() {
        [] => String::new(),
        points => format!(" ({})", few(points)),
    };
    Finding {
        cause: Cause::RegisterUnanswered,
        drive: Some(drive),
        certainty: Certainty::Certain,
        evidence: format!(
            "no reply to reads of {}{named}, while {answered} other requests were answered in the last minute",
            few(&places)
        ),
        remedy: Some(remedy(profile, &points)),
    }
}

/// The points of a profile that these reads cover.
fn points_of(profile: &Profile, reads: &[PlannedRead]) -> Vec<String> {
    let covered = profile.points.iter().filter(|point| {
        let raw = point.raw();
        raw.is_some_and(|raw| {
            raw.addresses()
                .any(|at| reads.iter().any(|read| read.covers(raw.table, at)))
        })
    });
    covered.map(|point| point.name.clone()).collect()
}

fn remedy(profile: &Profile, points: &[String]) -> String {
    if points.is_empty() {
        return "no point uses them: in a profile of your own, set holes = false in the [[range]] that contains them"
            .to_string();
    }
    let quoted: Vec<String> = points.iter().map(|name| format!("\"{name}\"")).collect();
    format!(
        "compare the addresses with the device's list; if it does not have them, use a profile of your own with \
         base = \"{}\" and remove = [{}]",
        profile.name,
        quoted.join(", ")
    )
}

/// Table and addresses of a read, such as `holding 2105` or `input 40-41`.
fn place(read: &PlannedRead) -> String {
    match read.count {
        0 | 1 => format!("{} {}", read.table, read.start),
        count => format!(
            "{} {}-{}",
            read.table,
            read.start,
            u32::from(read.start) + u32::from(count) - 1
        ),
    }
}

fn few(all: &[String]) -> String {
    match all.get(..NAMED) {
        Some(first) if all.len() > NAMED => format!("{} and {} more", first.join(", "), all.len() - NAMED),
        _ => all.join(", "),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_model::drive::PollClass;
    use drivegate_model::drive::profile::Profiles;
    use drivegate_proto::Table;

    fn read(start: u16, count: u16) -> PlannedRead {
        PlannedRead {
            class: PollClass::Fast,
            table: Table::Holding,
            start,
            count,
            wide: 0,
        }
    }

    fn of(reads: &[PlannedRead]) -> Finding {
        let profile = Profiles::built_in().get("vacon-nx").unwrap().clone();
        finding(DriveIndex::new(0), &profile, reads, 812)
    }

    #[test]
    fn registers_points_and_the_line_of_the_profile() {
        let named = of(&[read(2105, 1)]);
        assert_eq!(
            named.evidence,
            "no reply to reads of holding 2105 (motor_current), while 812 other requests were answered in the last minute"
        );
        assert!(
            named
                .remedy
                .is_some_and(|text| text.ends_with("base = \"vacon-nx\" and remove = [\"motor_current\"]"))
        );
        let gap = of(&[read(9000, 2)]);
        assert!(
            gap.evidence
                .starts_with("no reply to reads of holding 9000-9001, while")
        );
        assert!(gap.remedy.is_some_and(|text| text.contains("holes = false")));
    }

    #[test]
    fn many_registers_stay_one_line() {
        let all: Vec<PlannedRead> = (0..40).map(|start| read(9000 + start, 1)).collect();
        assert!(of(&all).evidence.contains("holding 9005 and 34 more, while"));
    }
}
