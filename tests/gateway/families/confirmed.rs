//! Orders of every family end as confirmed once the drive shows them, and as not confirmed if it does not; a stop
//! of all drives is proven.

use super::Rig;
use super::cases::{Case, cases};
use crate::support::process::{get, until};

fn confirms(case: &Case) {
    let rig = Rig::new(case, false);
    let name = case.profile;
    let confirmed = |values: &str| {
        let (status, result) = rig.command(values);
        assert_eq!(
            (status, result["result"].as_str()),
            (200, Some("confirmed")),
            "{name} {values}: {result}"
        );
    };
    rig.order(&case.reference);
    confirmed("{\"run\": true}");
    // Nothing was ordered before, so a run command alone turns the motor forward.
    rig.printed("motor forward", 0);
    confirmed("{\"run\": false}");
    confirmed("{\"run\": true}");
    rig.drive.signal("USR1");
    rig.site.until_state("drive", "fault");
    confirmed("{\"fault_reset\": true}");
    confirmed("{\"run\": true}");
    let (status, stopped) = rig.post("stop", "{}");
    assert_eq!(
        (status, &stopped["drives"][0]["outcome"]),
        (200, &serde_json::json!("standing")),
        "{name}: {stopped}"
    );
}

/// Tests every third family from `first` on, so that three tests can run side by side.
fn every_third(first: usize) {
    for case in cases().iter().skip(first).step_by(3) {
        println!("{}", case.profile);
        confirms(case);
    }
}

#[test]
fn what_is_shown_is_confirmed_1() {
    every_third(0);
}

#[test]
fn what_is_shown_is_confirmed_2() {
    every_third(1);
}

#[test]
fn what_is_shown_is_confirmed_3() {
    every_third(2);
}

/// A drive that acknowledges a run word but does not run: the answer and an event report it.
#[test]
fn a_start_that_is_ignored_is_not_confirmed() {
    for case in cases().iter().filter(|case| !case.has_sequence()) {
        let rig = Rig::new(case, true);
        rig.order(&case.reference);
        let (_, result) = rig.command("{\"run\": true}");
        assert_eq!(result["result"], "acknowledged", "{}: {result}", case.profile);
        until("the event", || {
            let (_, log) = get(rig.site.http, "/api/v1/events/log?kind=not_confirmed").unwrap();
            log.contains("does not run").then_some(())
        });
        rig.command("{\"run\": false}");
    }
}
