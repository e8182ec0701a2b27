//! A run command that names no direction, to a drive that has not shown yet in which direction its motor turns: the reads
//! that show the direction go first, because the run command would reverse a motor that turns the other way.

use std::time::Instant;

use crate::command_run::names_no_direction;
use crate::drive_state::DriveState;
use crate::schedule::Schedule;
use drivegate_core::order::Command;
use drivegate_core::queue::Ready;
use drivegate_model::drive::control::{Control, OwnWord, Run};
use drivegate_model::drive::{DriveIndex, ModelPoint, PlannedRead, PointIndex, Profile, Source};
use drivegate_proto::Table;

/// The points that show in which direction a motor turns by its command.
const SHOWN_BY: [ModelPoint; 4] = [
    ModelPoint::Running,
    ModelPoint::Reversed,
    ModelPoint::Remote,
    ModelPoint::SpeedReference,
];

/// When to ask again whether this command may begin; `None` if it awaits no direction. The reads that it awaits go before the
/// other polls. A read that the drive refuses or leaves unanswered is not awaited.
pub(super) fn waits_for_direction(
    command: &Command,
    index: DriveIndex,
    drive: &DriveState,
    profile: &Profile,
    schedule: &mut Schedule,
    now: Instant,
) -> Option<Ready> {
    let control = profile.control.as_ref().filter(|control| run_sets_direction(control))?;
    if !names_no_direction(profile, &command.intent.order) || drive.words.handed_over(control).is_some() {
        return None;
    }
    profile.model_index(ModelPoint::Reversed)?;
    let places: Vec<(Table, u16)> = SHOWN_BY.into_iter().flat_map(|point| places(profile, point)).collect();
    let covers = |read: &PlannedRead| places.iter().any(|(table, address)| read.covers(*table, *address));
    if !schedule.awaits(index, covers) {
        return None;
    }
    schedule.read_soon(index, covers, now);
    Some(Ready::At(now + super::LOOK_ROUND))
}

/// Whether a run command that names no direction sets one, because the word that it is made from may be unknown or has none.
fn run_sets_direction(control: &Control) -> bool {
    let is_pair = matches!(control.run, Run::Pair { .. });
    control.own_word == OwnWord::Shadow || is_pair || control.direction_elsewhere().is_some()
}

/// The registers and bits that show a point.
fn places(profile: &Profile, point: ModelPoint) -> Vec<(Table, u16)> {
    let place = |index: PointIndex| {
        let raw = profile.points.get(index)?.raw()?;
        Some((raw.table, raw.address))
    };
    let Some(index) = profile.model_index(point) else {
        return Vec::new();
    };
    match profile.points.get(index).map(|point| &point.source) {
        Some(Source::Derived(derived)) => derived.sources().filter_map(place).collect(),
        Some(Source::Raw(_)) | None => place(index).into_iter().collect(),
    }
}
