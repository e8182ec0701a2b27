//! How a drive without hand-written words reacts to the words written to it, according to `[control]` of its profile.

use super::reactions::{KnownState, MotorEffect, WordEffect};
use drivegate_model::drive::control::{Control, ControlItem, Run, Setting, Step};

fn place_of(setting: &Setting, control: &Control) -> ControlItem {
    setting.place.unwrap_or(control.at)
}

/// The effect of a word that is written to one of the addresses of the profile's commands.
pub(super) fn effect_of(control: &Control, known: &KnownState<'_>, place: ControlItem, word: u16) -> WordEffect {
    let own = place == control.at;
    let here = |setting: &Setting| place_of(setting, control) == place;
    let holds = |setting: &Setting| match place_of(setting, control) {
        at if at == place => setting.holds(word),
        at if at == control.at => setting.holds(known.before),
        at => setting.holds((known.at)(at.table, at.address)),
    };
    let resets = control.fault_reset.is_some_and(|reset| {
        let stood = own && reset.setting.holds(known.before);
        here(&reset.setting) && reset.setting.holds(word) && !stood
    });
    let reverse = || control.reverse.as_ref().is_some_and(holds);
    let does = match (&control.run, next_step(control, known.position, place, word)) {
        (Run::Steps(steps), Some(step)) if step + 1 == steps.len() => MotorEffect::Runs { reverse: reverse() },
        (Run::Steps(_), Some(step)) => MotorEffect::Prepares(step + 1),
        _ if here(&control.stop) && holds(&control.stop) => MotorEffect::Stops,
        _ if control.is_stop(place, word) => MotorEffect::Coasts,
        // A word without its constant bits has no effect.
        _ if own && !control.always.holds(word) => MotorEffect::Nothing,
        (Run::One(run), _) if holds(run) && concerns_run(control, place) => MotorEffect::Runs { reverse: reverse() },
        (Run::Pair { forward, reverse }, _) if here(forward) || here(reverse) => {
            match (holds(forward), holds(reverse)) {
                (true, false) => MotorEffect::Runs { reverse: false },
                (false, true) => MotorEffect::Runs { reverse: true },
                _ => MotorEffect::Nothing,
            }
        }
        _ => MotorEffect::Nothing,
    };
    WordEffect { does, resets, word }
}

/// The last step of the sequence that has this word and can come next.
fn next_step(control: &Control, position: usize, place: ControlItem, word: u16) -> Option<usize> {
    let Run::Steps(steps) = &control.run else {
        return None;
    };
    let direction = control.reverse.filter(|reverse| reverse.place.is_none());
    let free = direction.map_or(0, |reverse| reverse.mask);
    let is = |step: &Step| {
        place_of(&step.write, control) == place && (word ^ step.write.value) & step.write.mask & !free == 0
    };
    let whole = place != control.at || control.always.holds(word);
    let reached = steps.iter().take(position + 1);
    reached
        .enumerate()
        .filter(|(_, step)| whole && is(step))
        .map(|(step, _)| step)
        .max()
}

/// Whether a write to this register can start the motor or reverse it.
fn concerns_run(control: &Control, place: ControlItem) -> bool {
    let mut of_run = control.runs().into_iter().chain(control.reverse);
    of_run.any(|setting| place_of(&setting, control) == place)
}

/// All registers that take commands.
pub(super) fn places(control: &Control) -> Vec<ControlItem> {
    let steps: &[Step] = match &control.run {
        Run::Steps(steps) => steps,
        Run::One(_) | Run::Pair { .. } => &[],
    };
    let settings = control.runs().into_iter().chain(steps.iter().map(|step| step.write));
    let settings = settings.chain([control.stop]).chain(control.reverse);
    let settings = settings.chain(control.fault_reset.map(|reset| reset.setting));
    std::iter::once(control.at)
        .chain(settings.filter_map(|setting| setting.place))
        .collect()
}

/// Whether the run command only acts at the moment when it is written.
pub(super) fn acts_once(control: &Control) -> bool {
    control.runs().iter().all(|setting| setting.once)
}
