//! Rules of the comparison; the whole behaviour with a drive is tested in the seeded world.

use drivegate_testkit::nx;

use super::*;
use drivegate_model::drive::profile::Profiles;
use drivegate_model::drive::{PointIndex, PollClass};

fn pair<'p>(profile: &'p drivegate_model::drive::Profile, name: &str) -> (&'p Point, &'p Point) {
    let point = profile.points.iter().find(|point| point.name == name).unwrap();
    (point, profile.points.get(point.monitor.unwrap()).unwrap())
}

#[test]
fn what_a_comparison_shows() {
    let nx = nx();
    let code = pair(&nx, "fault_code");
    assert_eq!(
        compare(code, (0.0, 0.0), 0.0),
        Verdict::Nothing,
        "no fault proves nothing"
    );
    assert_eq!(compare(code, (16.0, 16.0), 16.0), Verdict::Agrees);
    assert_eq!(compare(code, (16.0, 16.0), 0.0), Verdict::Differs);
    assert_eq!(
        compare(code, (0.0, 16.0), 16.0),
        Verdict::Nothing,
        "the fault came in between"
    );
    assert_eq!(compare(code, (0.0, 0.0), 16.0), Verdict::Differs);
    let torque = pair(&nx, "motor_torque");
    assert_eq!(compare(torque, (40.0, 43.0), 41.5), Verdict::Agrees);
    assert_eq!(compare(torque, (2.0, 0.0), 1.0), Verdict::Nothing, "both are about 0");
    assert_eq!(
        compare(torque, (40.0, 41.0), 0.0),
        Verdict::Nothing,
        "the register is perhaps not there"
    );
    assert_eq!(compare(torque, (350.0, 350.0), 41.0), Verdict::Differs);
    // The motor speeds up: the monitored value lies between the earlier and the later process data.
    assert_eq!(compare(torque, (10.0, 90.0), 50.0), Verdict::Agrees);
}

#[test]
fn trust_is_lost_after_three_and_comes_back_after_two() {
    let now = Instant::now();
    let mut compared = Compared {
        point: PointIndex::new(0),
        monitor: PointIndex::new(1),
        registers: None,
        is_code: false,
        is_0_by_registers: true,
        trust: Trust::Unproven(now, PAUSE.0),
        open: None,
        last: 0.0,
    };
    let mut judge = |verdict| {
        compared.judge(verdict, now);
        (compared.trust, compared.is_monitored())
    };
    assert_eq!(judge(Verdict::Differs), (Trust::Doubted(1, 0), true), "at once");
    judge(Verdict::Agrees);
    assert_eq!(judge(Verdict::Agrees), (Trust::Proven, false));
    for _ in 0..2 {
        judge(Verdict::Differs);
    }
    assert_eq!(judge(Verdict::Differs), (Trust::Differs(0), true));
    assert_eq!(judge(Verdict::Nothing), (Trust::Differs(0), true), "0 proves nothing");
    judge(Verdict::Agrees);
    judge(Verdict::Differs);
    judge(Verdict::Agrees);
    assert_eq!(
        judge(Verdict::Agrees),
        (Trust::Proven, false),
        "the selection was restored"
    );
}

#[test]
fn every_monitoring_register_is_in_a_request_of_its_own_class() {
    for name in ["vacon-nx", "eaton-svx", "eaton-hvx"] {
        let profiles = Profiles::built_in();
        let profile = profiles.get(name).unwrap();
        let plan = drivegate_model::drive::Plan::of(profile);
        for point in profile.points.iter().filter(|point| point.monitor.is_some()) {
            let monitor = Registers::of(profile.points.get(point.monitor.unwrap()).unwrap()).unwrap();
            let in_plan = plan.monitors.iter().filter(|read| monitor.are_in(read));
            assert_eq!(in_plan.count(), 1, "{name} {}", point.name);
        }
        assert!(plan.monitors.iter().all(|read| read.class == PollClass::Monitor));
    }
}

#[test]
fn a_code_that_stays_0_gives_no_reason_to_compare() {
    let (nx, now, drive) = (nx(), Instant::now(), DriveIndex::new(0));
    let mut selections = Selections::new([&nx.points].into_iter(), now);
    let plan = drivegate_model::drive::Plan::of(&nx);
    let code = Registers::of(pair(&nx, "fault_code").0).unwrap();
    let read = plan.reads.iter().find(|read| code.are_in(read)).unwrap();
    let mut words = vec![0; usize::from(read.count)];
    assert!(
        selections.are_concerned_by(drive, read, &words, now),
        "nothing is proved"
    );
    for compared in selections.points(drive) {
        compared.trust = Trust::Unproven(now + PAUSE.0, PAUSE.0);
    }
    assert!(!selections.are_concerned_by(drive, read, &words, now));
    words[usize::from(code.first - read.start)] = 16;
    assert!(selections.are_concerned_by(drive, read, &words, now), "a fault came");
    let monitor = plan.monitors.first().unwrap();
    assert!(selections.are_concerned_by(drive, monitor, &[0], now));
}
