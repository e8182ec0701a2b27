//! Checks that need the whole profile: states that the gateway would read from its own command, and suspicious
//! settings that a person should check.

use super::super::control::{Control, Mask, OwnWord, Run, Until};
use super::super::model::ModelPoint;
use super::super::profile::{Point, Profile, Raw, Source};
use crate::document::Reader;
use crate::drive::{Derived, PointIndex};

pub(super) fn check(reader: &Reader<'_>, profile: &Profile) {
    let Some(control) = &profile.control else { return };
    refuse_own_word(reader, profile, control);
    if profile.model_point(ModelPoint::Run).is_some_and(|run| run.write)
        && profile.model_index(ModelPoint::Running).is_none()
    {
        reader.warning(
            "control",
            "no point or state is `running`: no start and no stop is confirmed, and no lease stops the motor",
            "name the bit or the state that shows it",
        );
    }
    warn_of_running_at_power_up(reader, profile, control);
    warn_of_invalid_states(reader, profile, control);
    for point in [ModelPoint::SpeedReference, ModelPoint::FrequencyReference] {
        warn_of_offset(reader, profile, point);
    }
}

/// The masks of a status word, by the point of the common model or the step to which they belong.
fn masks(profile: &Profile, control: &Control) -> Vec<(String, Mask)> {
    let of_state = |point: &ModelPoint| match &profile.model_point(*point)?.source {
        Source::Derived(Derived::State { any }) => Some((point.name().to_string(), any.clone())),
        _ => None,
    };
    let states = ModelPoint::STATUS_WORD.iter().filter_map(of_state);
    let states = states.flat_map(|(name, any)| any.into_iter().map(move |mask| (name.clone(), mask)));
    let steps = match &control.run {
        Run::Steps(steps) => steps.as_slice(),
        Run::One(_) | Run::Pair { .. } => &[],
    };
    let of_step = |step: &super::super::control::Step| match step.until {
        Until::State(mask) => Some(("until of a step".to_string(), mask)),
        _ => None,
    };
    states.chain(steps.iter().filter_map(of_step)).collect()
}

fn raw_of(profile: &Profile, index: PointIndex) -> Option<&Raw> {
    profile.points.get(index).and_then(Point::raw)
}

/// Refuses states read from a control word that reads back what was written: it shows what was ordered, not what
/// the drive does.
fn refuse_own_word(reader: &Reader<'_>, profile: &Profile, control: &Control) {
    if control.own_word != OwnWord::Read {
        return;
    }
    let is_own = |raw: &Raw| raw.covers(control.at.table, control.at.address);
    let of_masks = masks(profile, control).into_iter();
    let of_masks = of_masks.filter(|(_, mask)| raw_of(profile, mask.point).is_some_and(is_own));
    let of_bits = ModelPoint::STATUS_WORD.iter().filter(|point| {
        let raw = profile.model_point(**point).filter(|point| !point.write);
        raw.and_then(Point::raw).is_some_and(is_own)
    });
    let names = of_masks.map(|(name, _)| name);
    for name in names.chain(of_bits.map(|point| point.name().to_string())) {
        reader.problem(
            "control",
            format!("`{name}` is read from the control word, which reads as it was written"),
            "name the register with the status; if this one reads as it, write own_word = \"shadow\"",
        );
    }
}

/// Warns if 0 would mean running: a drive that was just switched on has 0 in its registers and coils.
fn warn_of_running_at_power_up(reader: &Reader<'_>, profile: &Profile, control: &Control) {
    let place = control.run_place();
    let written = profile.model_point(ModelPoint::Run).is_some_and(|run| run.write);
    if written && control.is_run(place, 0) {
        reader.warning(
            "control",
            format!(
                "0 in {} {} is a run command: a drive that is switched on may start",
                place.table, place.address
            ),
            "check in the manual that 1 starts the drive; if not, make sure that it has another value when it is switched on",
        );
    }
}

/// Warns about a status word with a value that the profile declares invalid: every state in it would then be bad.
fn warn_of_invalid_states(reader: &Reader<'_>, profile: &Profile, control: &Control) {
    let masks = masks(profile, control);
    let state_of = |index: PointIndex, word: u64| {
        let of_point = || masks.iter().filter(|(_, mask)| mask.point == index);
        let shown = of_point()
            .find(|(_, mask)| mask.holds(word))
            .map(|(name, _)| format!("`{name}`"));
        shown.or_else(|| (word == 0 && of_point().next().is_some()).then(|| "a drive that stands".to_string()))
    };
    for (index, point) in profile.points.enumerate() {
        let invalid = point.raw().map_or(&[][..], |raw| &raw.invalid);
        let legal = invalid.iter().find_map(|word| Some((word, state_of(index, *word)?)));
        if let Some((word, state)) = legal {
            reader.warning(
                "point",
                format!(
                    "{word:#06x} of `{}` shows {state}, but is `invalid`: its states are bad then",
                    point.name
                ),
                "leave that value out of `invalid`",
            );
        }
    }
}

/// Warns about an offset of a reference: its register contains 0 until it is written.
fn warn_of_offset(reader: &Reader<'_>, profile: &Profile, model: ModelPoint) {
    let Some(point) = profile.model_point(model).filter(|point| point.write) else {
        return;
    };
    let target = point.write_to.and_then(|to| profile.points.get(to)).unwrap_or(point);
    if let Some(raw) = target.raw().filter(|raw| raw.offset < 0.0) {
        reader.warning(
            "point",
            format!(
                "0 in the register of `{}` means {} {}: a drive that is started before a reference was written turns in reverse",
                target.name, raw.offset, target.unit
            ),
            "write a reference before the first start, or check `offset` in the manual",
        );
    }
}
