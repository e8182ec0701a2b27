//! Checks interlocks and staggers across all drives.

use std::collections::BTreeSet;
use std::sync::Arc;

use super::bus;
use super::drive::Found;
use super::settings::BusSettings;
use drivegate_core::process_image::{Access, DriveSpec};
use drivegate_model::document::{Document, nearest};
use drivegate_model::drive::model::Kind;
use drivegate_model::drive::{Plan, PointIndex, Profile};

/// Reports interlocks that can never be satisfied, or have no effect.
pub(super) fn check(document: &Document, buses: &[bus::Found]) {
    let drives = || buses.iter().flat_map(|bus| &bus.drives);
    let name = |found: &Found| found.name.as_ref().map(|(name, _)| name.clone());
    let names: Vec<String> = drives().filter_map(name).collect();
    for found in drives() {
        for (interlock, drive_at, point_at) in &found.guards.interlocks {
            if name(found).as_ref() == Some(&interlock.drive) {
                document.problem(
                    drive_at,
                    format!("`{}` is an interlock on itself", interlock.drive),
                    "name another drive; the drive itself enforces what its own points forbid",
                );
                continue;
            }
            let Some(of) = drives().find(|of| name(of).as_ref() == Some(&interlock.drive)) else {
                let near = nearest(&interlock.drive, names.iter().map(String::as_str));
                document.problem(
                    drive_at,
                    format!("there is no drive `{}`", interlock.drive),
                    near.map_or_else(
                        || format!("known: {}", names.join(", ")),
                        |near| format!("did you mean `{near}`?"),
                    ),
                );
                continue;
            };
            // A drive with a wrong profile is an error already.
            let Some(profile) = of.spec.as_ref().map(|spec| &spec.profile) else {
                continue;
            };
            if let Some((what, remedy)) = unfit(profile, &interlock.point) {
                document.problem(point_at, what, remedy);
            }
        }
    }
}

/// Why a point cannot be an interlock; `None` if it is a polled boolean.
fn unfit(profile: &Profile, name: &str) -> Option<(String, String)> {
    let plan = Plan::of(profile);
    let is_bit = |index: PointIndex| {
        let point = profile.points.get(index);
        point.is_some_and(|point| !point.hidden && point.kind() == Kind::Bool) && plan.shows(profile, index)
    };
    if profile.point_index(name).is_some_and(is_bit) {
        return None;
    }
    let bits = profile.points.enumerate().filter(|(index, _)| is_bit(*index));
    let near = nearest(name, bits.map(|(_, point)| point.name.as_str()));
    let list = || format!("`drivegate profiles show {}` lists the points", profile.name);
    Some((
        format!(
            "profile `{}` has no point `{name}` that is true or false and polled",
            profile.name
        ),
        near.map_or_else(list, |near| format!("did you mean `{near}`?")),
    ))
}

/// Lets the starts of drives count that share a group, or a bus, with a drive that has `stagger`.
pub(super) fn note_staggers(buses: &mut [BusSettings]) {
    let staggers = |drive: &DriveSpec| drive.guard.is_some_and(|guard| !guard.stagger.is_zero());
    let drives = buses.iter().flat_map(|bus| &bus.drives);
    let groups: BTreeSet<Arc<str>> = drives
        .filter(|drive| staggers(drive))
        .map(DriveSpec::starts_with)
        .collect();
    for drive in buses.iter_mut().flat_map(|bus| &mut bus.drives) {
        drive.staggers = drive.access != Access::Listen && groups.contains(&drive.starts_with());
    }
}
