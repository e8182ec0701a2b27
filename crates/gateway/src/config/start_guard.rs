//! Reads `guard` and `interlocks` of a drive.

use super::keys::{DRIVE, GUARD, INTERLOCK};
use drivegate_core::process_image::Access;
use drivegate_core::start_guard::{Guard, Interlock};
use drivegate_model::document::{Place, Reader};
use drivegate_model::drive::{ModelPoint, Profile};

/// Start guard and interlocks as configured, with the places of the keys that depend on other drives.
#[derive(Debug, Default)]
pub(super) struct Guards {
    pub(super) guard: Option<Guard>,
    pub(super) interlocks: Vec<(Interlock, Place, Place)>,
}

pub(super) fn read(reader: &Reader<'_>, access: Access, profile: Option<&Profile>) -> Guards {
    let tables = DRIVE.interlocks.tables(reader);
    let interlocks: Vec<_> = tables.iter().filter_map(read_interlock).collect();
    let guards = Guards {
        guard: read_guard(reader),
        interlocks,
    };
    for key in [DRIVE.guard.name, DRIVE.interlocks.name] {
        if reader.has(key) && access != Access::Control {
            reader.problem(
                key,
                "the drive is only monitored, so the gateway never starts it",
                format!("set access = \"control\" for the drive, or remove `{key}`"),
            );
        }
    }
    let writes_run = |profile: &Profile| profile.model_point(ModelPoint::Run).is_some_and(|run| run.write);
    if let Some(profile) = profile.filter(|profile| !writes_run(profile))
        && guards.interlocks.iter().any(|(interlock, ..)| interlock.trip)
    {
        reader.problem(
            DRIVE.interlocks.name,
            format!(
                "the profile `{}` writes no `run`, so nothing can stop the drive",
                profile.name
            ),
            "leave trip out, or give the point `run` of the profile `write = true`",
        );
    }
    guards
}

fn read_guard(reader: &Reader<'_>) -> Option<Guard> {
    let table = DRIVE.guard.table(reader)?;
    let guard = Guard {
        starts_per_hour: GUARD.starts_per_hour.written(&table),
        min_off: GUARD.min_off.get(&table),
        min_run: GUARD.min_run.get(&table),
        stagger: GUARD.stagger.get(&table),
    };
    table.finish();
    Some(guard)
}

fn read_interlock(table: &Reader<'_>) -> Option<(Interlock, Place, Place)> {
    let (drive, point) = (INTERLOCK.drive.placed(table), INTERLOCK.point.placed(table));
    let (is, trip) = (INTERLOCK.is.get(table), INTERLOCK.trip.get(table));
    table.finish();
    let ((drive, drive_at), (point, point_at)) = (drive?, point?);
    let interlock = Interlock { drive, point, is, trip };
    Some((interlock, drive_at, point_at))
}
