//! Points that are read in the fast class where the line carries it. Pure.

use std::sync::Arc;

use super::predict;
use drivegate_core::process_image::{BusSpec, DriveSpec};
use drivegate_model::drive::Profile;
use drivegate_proto::wire::Silence;

/// The drives of a bus with the points `fast_if_carried` of their profiles in the fast class, if the line carries
/// that with a fifth to spare; applied to all drives of the bus or to none. `None` also if there are no such
/// points.
pub fn faster_points(spec: &BusSpec, silence: Silence, drives: &[DriveSpec]) -> Option<Vec<DriveSpec>> {
    with_faster_points(drives).filter(|faster| predict(spec, silence, faster).is_comfortable())
}

/// The drives with these points in the fast class, whether or not the line can carry it.
pub(super) fn with_faster_points(drives: &[DriveSpec]) -> Option<Vec<DriveSpec>> {
    // Drives of a family share their changed profile, as they shared the original.
    let mut made: Vec<(Arc<Profile>, Arc<Profile>)> = Vec::new();
    let mut faster = drives.to_vec();
    for drive in &mut faster {
        let known = made.iter().find(|(slower, _)| Arc::ptr_eq(slower, &drive.profile));
        if let Some((_, profile)) = known {
            drive.profile = profile.clone();
        } else if let Some(profile) = drive.profile.with_faster_points() {
            let profile = Arc::new(profile);
            made.push((drive.profile.clone(), profile.clone()));
            drive.profile = profile;
        }
    }
    (!made.is_empty()).then_some(faster)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use drivegate_model::drive::plan::Plan;
    use drivegate_model::drive::{ModelPoint, PollClass};
    use drivegate_proto::LineFormat;
    use drivegate_testkit as testkit;

    fn line(cycle: u64, profiles: &[&str]) -> Option<Vec<DriveSpec>> {
        let spec = BusSpec {
            format: LineFormat::new(9600, "8N2").unwrap(),
            cycle: Duration::from_millis(cycle),
            slow_cycle: Duration::from_secs(30),
            ..testkit::bus_spec("line1")
        };
        let drive = |(number, name): (usize, &&str)| {
            testkit::monitored(
                &format!("d{number}"),
                "line1",
                1 + number as u8,
                &testkit::profile(name),
            )
        };
        let drives: Vec<DriveSpec> = profiles.iter().enumerate().map(drive).collect();
        faster_points(&spec, Silence::Spec, &drives)
    }

    fn is_fast(drive: &DriveSpec, point: ModelPoint) -> bool {
        drive.profile.model_point(point).unwrap().class == PollClass::Fast
    }

    #[test]
    fn the_motor_speed_is_as_fresh_as_the_state_where_the_line_carries_it() {
        let drives = line(1000, &["vacon-cx", "vacon-nx", "vacon-cx"]).expect("a second is enough");
        assert!(drives.iter().all(|drive| is_fast(drive, ModelPoint::MotorSpeed)));
        assert!(!is_fast(&drives[0], ModelPoint::DcLinkVoltage), "it was not asked for");
        assert!(
            Arc::ptr_eq(&drives[0].profile, &drives[2].profile),
            "one profile for both"
        );
        let fast = |drive: &DriveSpec| {
            let plan = Plan::of(&drive.profile);
            plan.reads.iter().filter(|read| read.class == PollClass::Fast).count()
        };
        let slow = testkit::monitored("d", "line1", 1, &testkit::profile("vacon-cx"));
        assert_eq!(fast(&drives[0]), fast(&slow) + 1, "one read more in a round");
    }

    #[test]
    fn a_line_that_is_busy_without_it_stays_as_it_is() {
        assert!(line(150, &["vacon-cx", "vacon-cx", "vacon-cx"]).is_none());
        assert!(line(1000, &["vacon-nx"]).is_none(), "nothing to make faster");
    }
}
