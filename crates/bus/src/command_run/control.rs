//! The actions of a family that follows the `[control]` of its profile: a start, a stop, a change of direction, a reset,
//! and the steps of a sequence. Pure.
//!
//! A stop is one write and waits for nothing. Only a run command starts a sequence; a sequence that fails after its last
//! word ends with a stop.

use std::time::Duration;

use super::awaited_state::AwaitedState;
use super::known_words::KnownWords;
use super::steps::Action;
use super::word::{SequenceWord, Word};
use drivegate_model::drive::control::{Control, ControlItem, Run, Setting, Until};
use drivegate_model::drive::{ModelPoint, PointIndex, Profile, Value};
use drivegate_proto::{RequestPdu, Table};

/// The values in a command for points that follow from `[control]`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Ordered {
    run: Option<bool>,
    reverse: Option<bool>,
    reset: bool,
}

impl Ordered {
    /// Adds the value to the command, if `[control]` defines how its point is written. Returns whether it does.
    pub(super) fn note_value(&mut self, profile: &Profile, index: PointIndex, value: Value) -> bool {
        let is = |point: ModelPoint| {
            let model = profile.model_index(point);
            let written = model.and_then(|model| profile.points.get(model)?.write_to);
            written.or(model) == Some(index)
        };
        let on = value.as_bool();
        if profile.control.is_none() {
            return false;
        }
        if is(ModelPoint::Run) {
            self.run = Some(on);
        } else if is(ModelPoint::Reverse) {
            self.reverse = Some(on);
        } else if is(ModelPoint::FaultReset) {
            self.reset |= on;
        } else {
            return false;
        }
        true
    }

    /// Whether the value decides whether the motor is to run.
    pub(super) fn says_run(mut self, profile: &Profile, index: PointIndex, value: Value) -> bool {
        self.note_value(profile, index, value) && self.run.is_some()
    }

    /// The actions, in the order that is safe. `stopped`: a stop went before them.
    pub(super) fn actions(self, profile: &Profile, stop: bool, stopped: bool) -> Vec<Action> {
        let Some(control) = profile.control.as_ref() else {
            return Vec::new();
        };
        let mut actions = Vec::new();
        let elsewhere = control.direction_elsewhere();
        let turned = self.reverse.zip(elsewhere).map(|(reverse, (setting, place))| {
            let word = if reverse { setting.applied(0) } else { setting.undone(0) };
            Action::Send(write(place, word, profile))
        });
        if stop && self.run == Some(false) {
            actions.extend(stops(control, profile, self.reverse));
            // No word of the stop has the direction: the next run command alone would turn the motor as before.
            actions.extend(turned.clone());
        }
        if self.reset {
            actions.extend(resets(control, profile, stopped || stop));
        }
        if stop {
            return actions;
        }
        match (self.reverse, elsewhere) {
            (Some(reverse), Some(_)) => {
                let may = self
                    .run
                    .is_none()
                    .then_some(Action::Word(Word::DirectionElsewhere(reverse)));
                actions.extend(may.into_iter().chain(turned));
            }
            (None, Some(_)) if self.run == Some(true) => actions.push(Action::Word(Word::KeptDirection)),
            _ => {}
        }
        match (self.run, self.reverse) {
            (Some(true), reverse) => actions.extend(runs(control, profile, reverse)),
            // A stop is split off from other commands before, so this command contains nothing else.
            (Some(false), reverse) => actions.extend(stops(control, profile, reverse)),
            (None, Some(reverse)) if elsewhere.is_none() => actions.push(Action::Word(Word::Direction(reverse))),
            (None, _) => {}
        }
        actions
    }
}

fn stops(control: &Control, profile: &Profile, reverse: Option<bool>) -> Vec<Action> {
    let mut actions = Vec::new();
    match control.stop.place.or(coil_of(control)) {
        None => actions.push(Action::Word(Word::Stop(reverse))),
        Some(place) => actions.push(Action::Send(write(place, control.stop.applied(0), profile))),
    }
    // Run settings at other places are removed as well.
    let stands = |setting: &Setting| !setting.once && setting.place != control.stop.place;
    let mut done: Vec<ControlItem> = Vec::new();
    for setting in control.runs().iter().filter(|setting| stands(setting)) {
        let place = setting.place.unwrap_or(control.at);
        if !done.contains(&place) {
            done.push(place);
            actions.push(Action::Send(write(place, 0, profile)));
        }
    }
    actions
}

/// The control word as a coil, if it is one; a coil has no other bits.
pub(super) fn coil_of(control: &Control) -> Option<ControlItem> {
    Some(control.at).filter(|at| at.table == Table::Coil)
}

fn resets(control: &Control, profile: &Profile, stopped: bool) -> Vec<Action> {
    let Some(reset) = control.fault_reset else {
        return Vec::new();
    };
    let wait = Action::Wait(reset.pulse);
    let setting = reset.setting;
    let mut actions = Vec::new();
    match setting.place {
        None => {
            actions.extend(pulse(setting, reset.pulse));
            if setting.once {
                actions.truncate(3);
            }
        }
        Some(place) => {
            // One pause serves both: the run command is taken away, and the reset bit returns to its former value.
            if !stopped {
                actions.push(Action::Word(Word::ResetLow(setting)));
            }
            let (high, low) = (setting.applied(0), low_of(&setting));
            if !setting.once {
                actions.push(Action::Send(write(place, low, profile)));
            }
            if !stopped || !setting.once {
                actions.push(wait.clone());
            }
            actions.push(Action::ResetElsewhere(write(place, high, profile)));
            if !setting.once {
                actions.extend([wait, Action::ResetOver(write(place, low, profile))]);
            }
        }
    }
    actions
}

/// The actions of a pulse of these bits of the control word.
pub(super) fn pulse(setting: Setting, wait: Duration) -> [Action; 5] {
    [
        Action::Word(Word::ResetLow(setting)),
        Action::Wait(wait),
        Action::Word(Word::ResetHigh(setting)),
        Action::Wait(wait),
        Action::Word(Word::ResetEnd(setting)),
    ]
}

/// The word of a separate reset register between two resets.
fn low_of(setting: &Setting) -> u16 {
    match setting.value {
        0 => setting.mask,
        _ => 0,
    }
}

fn runs(control: &Control, profile: &Profile, reverse: Option<bool>) -> Vec<Action> {
    match &control.run {
        Run::Steps(steps) => {
            let mut actions = Vec::new();
            for (number, step) in steps.iter().enumerate() {
                match step.write.place {
                    None => {
                        let word = SequenceWord {
                            write: step.write,
                            is_first: number == 0,
                            is_last: number + 1 == steps.len(),
                        };
                        actions.push(Action::Word(Word::Sequence(word, reverse)));
                    }
                    Some(place) => actions.push(Action::Send(write(place, step.write.applied(0), profile))),
                }
                match step.until {
                    Until::Written => {}
                    Until::Time(time) => actions.push(Action::Wait(time)),
                    Until::State(mask) => {
                        let state = AwaitedState::of(profile, mask, step, (number + 1, steps.len()));
                        actions.extend(state.map(|state| Action::Await(Box::new(state))));
                    }
                }
            }
            actions
        }
        Run::One(setting) => match setting.place.or(coil_of(control)) {
            None => vec![Action::Word(Word::Run(reverse))],
            Some(place) => vec![Action::Send(write(place, setting.applied(0), profile))],
        },
        Run::Pair { .. } => vec![Action::Word(Word::Run(reverse))],
    }
}

pub(super) fn write(place: ControlItem, word: u16, profile: &Profile) -> RequestPdu {
    match place.table {
        Table::Coil | Table::DiscreteInput => profile.functions.write_coil(place.address, word != 0),
        Table::Holding | Table::Input => profile.functions.write_register(place.address, word),
    }
}

/// Whether all words of a sequence but the last can be left out, because the motor already runs by this command.
pub(super) fn is_prepared(profile: &Profile, words: &KnownWords, running: bool) -> bool {
    let Some(control) = profile.control.as_ref().filter(|_| running) else {
        return false;
    };
    let own = words.get(control.at.table, control.at.address);
    own.is_some_and(|own| control.is_run(control.at, own))
}
