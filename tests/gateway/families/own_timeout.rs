//! Drives whose own timeout counts only writes: `refresh` keeps them running while the gateway runs, and they trip
//! when it has ended. The Python drives trip two seconds after the last write.

use std::time::Duration;

use drivegate_model::drive::profile::Profiles;

use super::Rig;
use super::cases::{Case, cases};
use crate::support::process::{get, until};

/// Option that sets the drive's own timeout.
const TIMEOUT: &str = "timeout=3";

const REFRESH: &str = "refresh = \"500ms\"\nsupervision = { timeout = \"60s\", action = \"stop\" }\n";

fn sleep(seconds: u64) {
    std::thread::sleep(Duration::from_secs(seconds));
}

/// A drive that runs, whose gateway has that configuration.
fn running(case: &Case, keys: &str) -> Rig {
    let rig = Rig::with("50ms", keys, case, &[TIMEOUT]);
    rig.order(&case.reference);
    let (status, result) = rig.command("{\"run\": true}");
    assert_eq!(
        (status, &result["result"]),
        (200, &"confirmed".into()),
        "{}: {result}",
        case.profile
    );
    rig
}

fn timeouts(rig: &Rig) -> usize {
    rig.drive.output().matches("own timeout").count()
}

/// Under a refresh, a motor that was stopped at its drive, or whose drive was switched off and on, stays stopped; a
/// running one runs as long as the gateway, and no longer.
fn is_fed(case: &Case) {
    let name = case.profile;
    let rig = running(case, REFRESH);
    sleep(6);
    assert_eq!(timeouts(&rig), 0, "{name} tripped while it was fed");
    assert_eq!(rig.state(), "running", "{name}");
    for (signal, what) in [("USR2", "stopped at the panel"), ("HUP", "restarted")] {
        let starts = rig.starts();
        rig.drive.signal(signal);
        rig.printed(what, 0);
        sleep(3);
        assert_eq!(rig.starts(), starts, "{name} {what}: a refresh started the motor");
        assert_ne!(rig.state(), "running", "{name} {what}");
        // The control word of a drive that lost its run command like this is written again.
        rig.command("{\"run\": false}");
        rig.order(&case.reference);
        let (_, result) = rig.command("{\"run\": true}");
        assert_eq!(result["result"], "confirmed", "{name} {what}: {result}");
    }
    assert_eq!(timeouts(&rig), 0, "{name}");
    rig._gateway.signal("KILL");
    rig.printed("own timeout", 0);
    rig.printed("motor stopped", 2);
}

/// Families whose control word has levels that a refresh may repeat, or that need only the reference.
fn refreshed() -> Vec<Case> {
    let profiles = Profiles::built_in();
    let repeats = |case: &Case| profiles.get(case.profile).unwrap().repeats().is_ok();
    cases().into_iter().filter(repeats).collect()
}

#[test]
fn a_refresh_feeds_every_family_and_starts_none_1() {
    refreshed().iter().step_by(3).for_each(is_fed);
}

#[test]
fn a_refresh_feeds_every_family_and_starts_none_2() {
    refreshed().iter().skip(1).step_by(3).for_each(is_fed);
}

#[test]
fn a_refresh_feeds_every_family_and_starts_none_3() {
    refreshed().iter().skip(2).step_by(3).for_each(is_fed);
}

/// Without a refresh the drive trips, and the diagnosis of the line explains why.
#[test]
fn a_drive_that_is_not_fed_trips_and_is_diagnosed() {
    let profiles = Profiles::built_in();
    let needs = |case: &&Case| {
        let control = profiles.get(case.profile).unwrap().control_table();
        control.is_some_and(|control| control.refresh.is_some())
    };
    let all = cases();
    let needing: Vec<&Case> = all.iter().filter(needs).collect();
    assert!(!needing.is_empty());
    for case in needing {
        let rig = running(case, "refresh = \"off\"\n");
        rig.printed("own timeout", 0);
        let verdict = until("the verdict", || {
            let (_, text) = get(rig.site.http, "/api/v1/buses/line1/diagnosis")?;
            text.contains("own_timeout").then_some(text)
        });
        assert!(verdict.contains("set refresh = "), "{}: {verdict}", case.profile);
    }
}
