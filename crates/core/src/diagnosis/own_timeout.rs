//! Recognises a drive that was tripped by its own communication timeout soon after a command although the line was
//! sound. Many drives restart this timeout only on writes.

use std::time::Duration;

use super::{Cause, Certainty, Finding};
use drivegate_model::drive::{DriveIndex, Profile};

/// Longest time between the last write to a drive and a fault that is reported as a trip by the drive's own timeout.
pub const WITHIN: Duration = Duration::from_secs(30);

/// A new fault of a drive, and the gateway's writes before the fault.
#[derive(Debug, Clone, Copy)]
pub struct Trip {
    /// The fault code; 0 if the drive reports none.
    pub fault: i64,
    /// Time since the last write that the drive acknowledged.
    pub after: Duration,
    /// Whether the gateway repeats word or reference for the drive (`refresh`).
    pub repeats: bool,
}

/// The finding about a new fault; `None` if nothing points to the drive's own communication timeout.
pub fn finding(drive: DriveIndex, profile: &Profile, trip: Trip) -> Option<Finding> {
    if trip.after > WITHIN {
        return None;
    }
    let named = u16::try_from(trip.fault).is_ok_and(|code| profile.timeout_faults.contains(&code));
    let counts_writes = profile.control_table().is_some_and(|control| control.refresh.is_some());
    let unfed = counts_writes && !trip.repeats;
    let certainty = match (named, unfed) {
        (true, true) => Certainty::Certain,
        (true, false) => Certainty::Likely,
        (false, true) if trip.fault == 0 => Certainty::Fits,
        _ => return None,
    };
    let fault = match profile.fault_text(trip.fault) {
        text if trip.fault == 0 || text.is_empty() => "a fault without a code".to_string(),
        text if text == trip.fault.to_string() => format!("fault {text}"),
        text => format!("fault {} ({text})", trip.fault),
    };
    let remedy = if unfed {
        "the drive's own timeout counts only writes: set refresh = \"1s\" for this drive, with supervision"
    } else {
        "compare the time of the drive's own timeout with the cycle of the bus and with outages of the line: \
         `drivegate profiles show` says what the timeout counts"
    };
    Some(Finding {
        cause: Cause::OwnTimeout,
        drive: Some(drive),
        certainty,
        evidence: format!(
            "{fault} came {:.1} s after the last write to the drive",
            trip.after.as_secs_f64()
        ),
        remedy: Some(remedy.to_string()),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_model::drive::profile::Profiles;

    #[test]
    fn by_the_code_by_what_the_timeout_counts_and_by_the_time() {
        let profiles = Profiles::built_in();
        let of = |name: &str, fault, seconds, repeats| {
            let trip = Trip {
                fault,
                after: Duration::from_secs(seconds),
                repeats,
            };
            let found = finding(DriveIndex::new(0), profiles.get(name).unwrap(), trip);
            found.map(|found| (found.certainty, found.evidence))
        };
        let said = |certainty, text: &str| Some((certainty, text.to_string()));
        // A fieldbus fault of a family whose timeout polls restart.
        let fieldbus = "fault 53 (fieldbus fault) came 3.0 s after the last write to the drive";
        assert_eq!(of("vacon-nx", 53, 3, false), said(Certainty::Likely, fieldbus));
        assert_eq!(of("vacon-nx", 1, 3, false), None, "overcurrent");
        assert_eq!(of("vacon-nx", 53, 31, false), None, "long after any write");
        // A family whose timeout counts writes, and one that shows no code.
        let serial = "fault 28 (serial link lost) came 3.0 s after the last write to the drive";
        assert_eq!(of("abb-acs550", 28, 3, false), said(Certainty::Likely, serial));
        assert_eq!(of("abb-acs550", 1, 3, false), None);
        let unnamed = "a fault without a code came 3.0 s after the last write to the drive";
        assert_eq!(of("danfoss-fc", 0, 3, false), said(Certainty::Fits, unnamed));
        assert_eq!(of("danfoss-fc", 0, 3, true), None);
    }
}
