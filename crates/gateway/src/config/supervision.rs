//! `supervision` of a drive: how long its lease lasts and what happens at its end, checked against the drive's profile.

use std::time::{Duration, Instant};

use super::drive::Limits;
use super::keys::{ACTIONS, DRIVE, REFERENCE, SUPERVISION};
use drivegate_core::order::{Authority, Order, Refusal};
use drivegate_core::permit::admit;
use drivegate_core::process_image::{DriveImage, DriveSpec, LeaseAction, Supervision};
use drivegate_model::document::{Finding, Raw as Node, Reader};
use drivegate_model::drive::{ModelPoint, Plan, PointIndex, Profile, Source, Value};

pub(super) fn read(reader: &Reader<'_>, profile: Option<&Profile>, limits: &Limits) -> Option<Supervision> {
    if let Some(Node::Integer(_) | Node::Float(_) | Node::Text(_)) =
        reader.raw(DRIVE.supervision.name).map(|node| &node.value)
    {
        reader.problem(
            DRIVE.supervision.name,
            "`supervision` needs a timeout and an action",
            "write supervision = { timeout = \"5s\", action = \"stop\" }",
        );
        return None;
    }
    let table = DRIVE.supervision.table(reader)?;
    let timeout = SUPERVISION.timeout.read(&table);
    let action = read_action(&table, profile, limits);
    let adopt = SUPERVISION.adopt.get(&table);
    table.finish();
    if let Some(profile) = profile.filter(|profile| !shows_whether_it_runs(profile)) {
        reader.problem(
            DRIVE.supervision.name,
            format!(
                "profile `{}` has neither `running` nor a run command that is read, so the gateway could not detect \
                 whether a drive runs when its lease expires",
                profile.name
            ),
            "add one of them to the profile, or leave supervision out",
        );
    }
    Some(Supervision {
        timeout: timeout?,
        action: action?,
        adopt,
    })
}

/// Whether a drive of this profile reports that it runs, or at least that it has a run command.
fn shows_whether_it_runs(profile: &Profile) -> bool {
    let plan = Plan::of(profile);
    let is_read = |point| {
        let index = profile.model_index(point);
        index.is_some_and(|index| plan.shows(profile, index))
    };
    is_read(ModelPoint::Running) || is_read(ModelPoint::Run)
}

fn read_action(table: &Reader<'_>, profile: Option<&Profile>, limits: &Limits) -> Option<LeaseAction> {
    let key = SUPERVISION.action.name;
    let action = match table.raw(key).map(|node| &node.value) {
        None => LeaseAction::Stop,
        Some(Node::Table(_)) => {
            let inner = SUPERVISION.action.table(table)?;
            let reference: Option<f64> = inner.required(REFERENCE.speed_reference.name);
            inner.finish();
            LeaseAction::SpeedReference(reference?)
        }
        Some(_) => table.parsed(key, |text| {
            ACTIONS.find(text).map_err(|_| {
                Finding::new(
                    format!("unknown action `{text}`"),
                    format!("write {}", SUPERVISION.action.form.range()),
                )
            })
        })?,
    };
    let Some(profile) = profile else { return Some(action) };
    table.accept(key, check_action(&action, profile, limits))?;
    Some(action)
}

fn check_action(action: &LeaseAction, profile: &Profile, limits: &Limits) -> Result<(), Finding> {
    let needed = match action {
        LeaseAction::LeaveRunning => return Ok(()),
        LeaseAction::Stop => ModelPoint::Run,
        LeaseAction::SpeedReference(_) => ModelPoint::SpeedReference,
    };
    let Some(point) = profile.model_point(needed).filter(|p| p.write) else {
        return Err(Finding::new(
            format!("profile `{}` cannot write `{}`", profile.name, needed.name()),
            "use \"hold\" or another action",
        ));
    };
    let LeaseAction::SpeedReference(reference) = action else {
        return Ok(());
    };
    let range = limits.get(&point.name).or(point.range.as_ref());
    match range.filter(|range| !range.contains(reference)) {
        Some(range) => Err(Finding::new(
            format!("speed_reference = {reference} is outside the limits"),
            format!("write {} to {} percent", range.start(), range.end()),
        )),
        None => Ok(()),
    }
}

/// Reports an action that the limits of a reference in another unit refuse: the motor would keep its speed when the lease
/// expires. The action is judged as when it is due, for a drive of which nothing was read.
pub(super) fn check_limits(reader: &Reader<'_>, spec: &DriveSpec) {
    let Some(Supervision {
        action: LeaseAction::SpeedReference(reference),
        ..
    }) = spec.supervision
    else {
        return;
    };
    let profile = &spec.profile;
    let Some(speed) = profile.model_index(ModelPoint::SpeedReference) else {
        return;
    };
    let mut others = profile.points.enumerate().filter(|(index, _)| *index != speed);
    let is_limited = others.any(|(index, point)| {
        spec.limits.contains_key(&point.name) && written_for(profile, index) == written_for(profile, speed)
    });
    if !is_limited {
        return;
    }
    let image = DriveImage::new(spec.clone(), Duration::ZERO);
    let drive = image.reading(Instant::now(), Duration::ZERO);
    let order = Order::Points(vec![(speed, Value::Number(reference))]);
    match admit(order, &drive, Authority::Write) {
        Err(Refusal::BadValue(why)) => reader.problem(
            DRIVE.supervision.name,
            format!(
                "the limits refuse the action speed_reference = {reference}: {}",
                why.trim_end_matches("; nothing was written")
            ),
            "change the action or the limits",
        ),
        Err(Refusal::NotKnown(_)) => reader.warning(
            DRIVE.supervision.name,
            format!(
                "the limits may refuse the action speed_reference = {reference}, and the motor would keep its speed: that depends \
                 on the frequency range of the drive"
            ),
            "set frequency_range for the drive, or limit speed_reference instead",
        ),
        _ => {}
    }
}

/// The point whose register is written for a command to this one.
fn written_for(profile: &Profile, point: PointIndex) -> PointIndex {
    let next = |index: &PointIndex| {
        let point = profile.points.get(*index)?;
        match &point.source {
            _ if point.write_to.is_some() => point.write_to,
            Source::Derived(derived) => derived.band().map(|(of, ..)| of),
            Source::Raw(_) => None,
        }
    };
    let chain = std::iter::successors(Some(point), next);
    chain.take(profile.points.len()).last().unwrap_or(point)
}
