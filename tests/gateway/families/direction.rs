//! The word 0 of the common model stops a motor that runs in reverse and clears its direction: a run command alone then turns
//! the motor forward.

use super::cases::{Case, cases};
use super::{Answer, Rig, command};
use crate::support::process::until;

fn turns_forward_behind_a_stop(case: &Case) {
    let rig = Rig::new(case, false);
    let name = case.profile;
    rig.order(&case.reference);
    assert_eq!(rig.exchange(&command(true, true, false)), Answer::Done, "{name}");
    rig.printed("motor reverse", 0);
    rig.site.until_state("drive", "running");
    assert_eq!(rig.exchange(&command(false, false, false)), Answer::Done, "{name}");
    rig.printed("motor stopped", 0);
    until("the end of running", || (rig.state() != "running").then_some(()));
    let (status, result) = rig.command("{\"run\": true}");
    assert_eq!(status, 200, "{name}: {result}");
    rig.printed("motor forward", 0);
    assert_eq!(rig.drive.output().matches("motor reverse").count(), 1, "{name}");
}

/// A run command alone leaves a motor in reverse that turned so before the drive went offline: the
/// gateway does not know the word of these drives any more, and cannot read it.
fn keeps_turning(case: &Case) {
    let rig = Rig::new(case, false);
    let name = case.profile;
    rig.order(&case.reference);
    assert_eq!(rig.exchange(&command(true, true, false)), Answer::Done, "{name}");
    rig.printed("motor reverse", 0);
    rig.site.until_state("drive", "running");
    rig.drive.signal("STOP");
    rig.site.until_state("drive", "offline");
    rig.drive.signal("CONT");
    rig.site.until_state("drive", "running");
    // Late replies of the outage may hold the first orders up; the second of two that are taken follows the word of the first.
    for _ in 0..2 {
        until("a run command that the drive takes", || {
            (rig.command("{\"run\": true}").0 == 200).then_some(())
        });
    }
    assert_eq!(rig.drive.output().matches("motor forward").count(), 0, "{name}");
}

#[test]
fn a_run_command_alone_reverses_no_motor() {
    let unreadable = ["weg", "danfoss", "teco", "toshiba"];
    for case in cases().iter().filter(|case| unreadable.contains(&case.peer)) {
        println!("{}", case.profile);
        keeps_turning(case);
    }
}

fn every_third(first: usize) {
    // The drives of these two peers reverse by the sign of the reference.
    let turns_back = |case: &&Case| !["abb", "invertek"].contains(&case.peer);
    for case in cases().iter().filter(turns_back).skip(first).step_by(3) {
        println!("{}", case.profile);
        turns_forward_behind_a_stop(case);
    }
}

#[test]
fn a_stop_clears_the_direction_1() {
    every_third(0);
}

#[test]
fn a_stop_clears_the_direction_2() {
    every_third(1);
}

#[test]
fn a_stop_clears_the_direction_3() {
    every_third(2);
}
