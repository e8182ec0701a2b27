//! A drive that was stopped at its panel, was switched off and on, or has tripped since its last poll: no order
//! without a run command starts its motor. The Python drives share nothing with the profiles.

use std::time::Duration;

use drivegate_model::drive::profile::Profiles;

use super::Rig;
use super::cases::{Case, cases};
use crate::support::process::until;

/// Signal to the drive, and the text that it prints.
const HAPPENS: [(&str, &str); 3] = [
    ("USR2", "stopped at the panel"),
    ("HUP", "restarted"),
    ("USR1", "tripped"),
];

/// Pairs of orders, the second sent before the next poll.
const ORDERS: [&[&str]; 4] = [
    &["{\"reverse\": true}", "{\"reverse\": false}"],
    &[
        "{\"reverse\": true, \"speed_reference\": 60}",
        "{\"speed_reference\": 50}",
    ],
    &["{\"fault_reset\": true}", "{\"reverse\": true}"],
    &["{\"fault_reset\": true, \"reverse\": true, \"expires_ms\": 10000}"],
];

fn stays_as_it_is(case: &Case) {
    let rig = Rig::polled_every("400ms", case, false);
    let name = case.profile;
    let profile = Profiles::built_in().get(name).unwrap().clone();
    let has = |point: &str| profile.point_index(point).is_some();
    let can = |values: &str| {
        ["reverse", "fault_reset"]
            .iter()
            .all(|point| has(point) || !values.contains(point))
    };
    let run = if has("reverse") {
        "{\"run\": true, \"reverse\": false}"
    } else {
        "{\"run\": true}"
    };
    for (signal, printed) in HAPPENS {
        for orders in ORDERS {
            let orders: Vec<&str> = orders.iter().copied().filter(|values| can(values)).collect();
            rig.order(&case.reference);
            let before = rig.starts();
            let (status, result) = rig.command(run);
            assert_eq!(status, 200, "{name}: {result}");
            rig.printed("motor forward", 0);
            rig.site.until_state("drive", "running");
            assert_eq!(rig.starts(), before + 1, "{name}: {}", rig.drive.output());
            let happened = rig.drive.output().matches(printed).count();
            rig.drive.signal(signal);
            rig.printed(printed, happened);
            for (place, values) in orders.iter().enumerate() {
                let (_, result) = rig.command(values);
                let waits = result["note"]
                    .as_str()
                    .unwrap_or_default()
                    .contains("takes effect with the next start");
                // The control word says that the drive runs, its status that it does not.
                let is_kept = signal == "USR2" && place == 0 && values.starts_with("{\"reverse\"");
                assert!(waits || !is_kept, "{name}: {printed}, {values}: {result}");
                assert!(result["ok"] == true, "{name}: {printed}, {values}: {result}");
            }
            std::thread::sleep(Duration::from_millis(150));
            assert_eq!(
                rig.starts(),
                before + 1,
                "{name}: {printed}, {orders:?}\n{}",
                rig.drive.output()
            );
            let (status, result) = rig.command("{\"run\": false}");
            assert_eq!(status, 200, "{name}: {result}");
            if signal == "USR1" && has("fault_reset") {
                rig.command("{\"fault_reset\": true}");
            } else if signal == "USR1" {
                // The reset of this family is unknown.
                rig.drive.signal("HUP");
                rig.printed("restarted", 0);
            }
        }
    }
}

/// Orders that are given while the motor is at standstill take effect at the next start.
#[test]
fn a_direction_that_waits_is_that_of_the_next_start() {
    for name in [
        "danfoss-fc",
        "yaskawa-v1000",
        "siemens-g120",
        "hitachi-wj200",
        "invt-goodrive",
    ] {
        let all = cases();
        let case = all.iter().find(|case| case.profile == name).unwrap();
        let rig = Rig::polled_every("400ms", case, false);
        rig.order(&case.reference);
        rig.command("{\"run\": true, \"reverse\": false}");
        rig.printed("motor forward", 0);
        rig.site.until_state("drive", "running");
        rig.drive.signal("USR2");
        rig.printed("motor stopped", 0);
        let (_, result) = rig.command("{\"reverse\": true}");
        assert_eq!(result["result"], "acknowledged", "{name}: {result}");
        until(&format!("{name}: the record of the direction"), || {
            let audit = rig.site.audit();
            let mut texts = audit.iter().filter_map(|record| record["text"].as_str());
            texts
                .any(|text| text.starts_with("the direction takes effect"))
                .then_some(())
        });
        rig.command("{\"run\": false}");
        rig.command("{\"run\": true}");
        rig.printed("motor reverse", 0);
        rig.command("{\"run\": false}");
    }
}

fn every_third(first: usize) {
    for case in cases().iter().skip(first).step_by(3) {
        println!("{}", case.profile);
        stays_as_it_is(case);
    }
}

#[test]
fn no_order_without_run_starts_it_1() {
    every_third(0);
}

#[test]
fn no_order_without_run_starts_it_2() {
    every_third(1);
}

#[test]
fn no_order_without_run_starts_it_3() {
    every_third(2);
}
