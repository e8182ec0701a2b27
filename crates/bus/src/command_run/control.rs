//! Commands of a family that follows the `[control]` of its profile: the words of a start, a stop, a change of direction and a
//! reset, and the steps of a sequence. Pure.
//!
//! Steps of a command to a drive with `[control]`. A stop is one write and waits for nothing. Only a run command
//! starts a sequence; a sequence that fails after its last word ends with a stop.

use std::time::{Duration, Instant};

use super::known_words::KnownWords;
use super::steps::{Action, Check, Permit, RequestContext, Step, StepPurpose};
use drivegate_core::permit::{Form, KnownRun, Motor, OnRunning, Repeats, Wants};
use drivegate_model::drive::control::{self, Control, ControlItem, Mask, OwnWord, Run, Setting, Until};
use drivegate_model::drive::model::Kind;
use drivegate_model::drive::{ModelPoint, PointIndex, Profile, Raw, Value};
use drivegate_proto::{Reply, RequestPdu, Table};

/// Pause between two looks at a state for which a sequence waits.
pub(super) const LOOK_PAUSE: Duration = Duration::from_millis(20);

/// A word for the control register, made from the word that the drive has when it is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Word {
    /// A stop, with a direction where the order has one.
    Stop(Option<bool>),
    /// Only the direction is set.
    Direction(bool),
    /// Checks whether the direction may be written to its separate register; that write follows.
    DirectionElsewhere(bool),
    /// Writes the direction that was kept for this start to its separate register.
    KeptDirection,
    /// A run, with a direction where the order has one.
    Run(Option<bool>),
    /// The word with this number in the start sequence.
    Sequence(usize, Option<bool>),
    /// Prepares a pulse of these bits, usually a reset: clears the bits, and the run command if the motor is at standstill.
    ResetLow(Setting),
    /// Sets the bits of a reset pulse.
    ResetHigh(Setting),
    /// Writes the word after a reset pulse.
    ResetEnd(Setting),
    /// Bits that belong to no command of `[control]`.
    Others(Setting),
}

impl Word {
    /// The bits of a pulse that the word begins, sets or ends.
    fn pulsed(self) -> Option<Setting> {
        match self {
            Word::ResetLow(setting) | Word::ResetHigh(setting) | Word::ResetEnd(setting) => Some(setting),
            _ => None,
        }
    }

    /// The kind of write, where the word does not decide whether the motor is to run.
    fn wants(self) -> Option<Wants> {
        match self {
            Word::Stop(_) | Word::KeptDirection | Word::Run(_) | Word::Sequence(..) => None,
            Word::Direction(_) => Some(Wants::Direction),
            Word::DirectionElsewhere(_) => Some(Wants::DirectionElsewhere),
            Word::ResetLow(setting) if setting.place.is_some() => Some(Wants::ResetElsewhere),
            Word::ResetLow(_) | Word::ResetHigh(_) => Some(Wants::Reset),
            Word::ResetEnd(_) => Some(Wants::ResetEnd),
            Word::Others(_) => Some(Wants::Others),
        }
    }

    /// Effect of the word on a motor that keeps its run command.
    fn on_running(self, control: &Control) -> OnRunning {
        match self {
            Word::ResetLow(reset) | Word::ResetHigh(reset) if stops_by_reset(control, reset) => OnRunning::Stops,
            Word::ResetLow(_) | Word::ResetHigh(_) if starts_by_reset(control) => OnRunning::Restarts,
            _ => OnRunning::Harmless,
        }
    }
}

/// The result of building a control word.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Made {
    /// This request must be sent.
    Send(Step),
    /// Nothing is sent because the drive already has the word.
    Nothing,
    /// What the word would repeat must be judged before the word is made.
    Judge(Repeats),
    /// The running state must be read before the word is made.
    Look,
    /// Nothing is sent now: this direction is kept for the next start.
    AtNextStart(bool),
}

/// A state for which a sequence waits.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct AwaitedState {
    /// The register that shows the awaited state.
    raw: Raw,
    name: String,
    mask: Mask,
    /// Time after which the sequence is given up.
    pub(super) timeout: Duration,
    /// The step as text, with its word.
    step: String,
    /// When the wait for this state began.
    pub(super) since: Option<Instant>,
    /// The value last read from the register.
    seen: Option<u64>,
}

impl AwaitedState {
    fn of(profile: &Profile, steps: &[control::Step], number: usize) -> Option<AwaitedState> {
        let step = steps.get(number)?;
        let Until::State(mask) = step.until else {
            return None;
        };
        let point = profile.points.get(mask.point)?;
        Some(AwaitedState {
            raw: point.raw()?.clone(),
            name: point.name.clone(),
            mask,
            timeout: step.timeout,
            step: format!("step {} of {} ({:#06x})", number + 1, steps.len(), step.write.value),
            since: None,
            seen: None,
        })
    }

    /// The read of the awaited state.
    pub(super) fn state_read(&self) -> Step {
        let pdu = RequestPdu::Read {
            table: self.raw.table,
            start: self.raw.address,
            count: self.raw.form.items(),
        };
        Step::new(StepPurpose::AskState, pdu)
    }

    /// Whether the reply shows the awaited state.
    pub(super) fn is_shown(&mut self, reply: &Reply) -> bool {
        let words = reply.words();
        let value = words.and_then(|words| self.raw.decode(&words, Kind::Integer));
        // A whole register without scale: never negative.
        self.seen = value.map(|value| value.as_f64() as u64).or(self.seen);
        value.is_some() && self.seen.is_some_and(|seen| self.mask.holds(seen))
    }

    /// The state that was not seen in time, as text.
    pub(super) fn not_reached(&self) -> String {
        let AwaitedState {
            name,
            mask,
            timeout,
            step,
            ..
        } = self;
        let seen = self
            .seen
            .map_or("was not read".to_string(), |seen| format!("is {seen:#06x}"));
        format!(
            "{step}: `{name}` {seen}, not {:#06x} in {:#06x}, within {timeout:?}; the start was abandoned",
            mask.is, mask.mask
        )
    }
}

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
        let elsewhere = control
            .reverse
            .and_then(|setting| Some((setting, setting.place?)))
            .filter(|_| !matches!(control.run, Run::Pair { .. }));
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
fn coil_of(control: &Control) -> Option<ControlItem> {
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
                    None => actions.push(Action::Word(Word::Sequence(number, reverse))),
                    Some(place) => actions.push(Action::Send(write(place, step.write.applied(0), profile))),
                }
                match step.until {
                    Until::Written => {}
                    Until::Time(time) => actions.push(Action::Wait(time)),
                    Until::State(_) => {
                        let state = AwaitedState::of(profile, steps, number);
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

fn write(place: ControlItem, word: u16, profile: &Profile) -> RequestPdu {
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

/// The request that writes a word, based on the known control word; or the read of the control word if it is not known.
/// `motor` is the state of the motor as the drive reported it right before; `None` if it was not read.
pub(super) fn word(
    word: Word,
    words: &KnownWords,
    profile: &Profile,
    known: RequestContext,
    motor: Option<Motor>,
) -> Made {
    let Some(control) = profile.control.as_ref() else {
        return Made::Nothing;
    };
    let at = control.at;
    let either = || words.stop_by_either().filter(|_| matches!(word, Word::Stop(_)));
    let own = words
        .get(at.table, at.address)
        .map(|own| control.standing(own))
        .or_else(either);
    if asks_first(word, control, own, known, motor) {
        return Made::Send(read_of(at));
    }
    let pulsed = word.pulsed();
    let released = own.map(|own| {
        let own = control.without_reset(own);
        pulsed.map_or(own, |pulsed| pulsed.released(own))
    });
    let base = released.unwrap_or(0);
    let form = match basis(word, control, words, released, known, motor) {
        Basis::Certain(form) => form,
        Basis::Judged(repeats) => match known.permit {
            Some(Permit::Write(of)) if of == repeats => repeats.form(),
            Some(Permit::Look(of)) if of == repeats => return Made::Look,
            _ => return Made::Judge(repeats),
        },
    };
    let runs = form == Form::AsItStands;
    let stays = match runs {
        true => control.always.applied(base),
        false => control.resting(base),
    };
    let sent = |place: ControlItem, word: u16| Made::Send(Step::new(StepPurpose::Execute, write(place, word, profile)));
    match word {
        Word::Direction(reverse) | Word::DirectionElsewhere(reverse) if form == Form::AtNextStart => {
            Made::AtNextStart(reverse)
        }
        Word::Stop(reverse) => {
            let stop = control.stop_word(base);
            let turned = reverse.map_or(stop, |reverse| control.with_direction(stop, reverse));
            sent(at, if control.is_own_stop(at, turned) { turned } else { stop })
        }
        Word::Direction(reverse) => match &control.run {
            Run::Pair { forward, reverse: back } => {
                let run = if reverse { back } else { forward };
                match runs && run.place.is_none() {
                    true => sent(at, run.applied(stays)),
                    // While the motor is at standstill, no bit of the drive stores the direction.
                    false => Made::AtNextStart(reverse),
                }
            }
            Run::One(_) | Run::Steps(_) => sent(at, control.with_direction(stays, reverse)),
        },
        Word::DirectionElsewhere(_) => Made::Nothing,
        Word::KeptDirection => {
            let place = control.reverse.and_then(|setting| Some((setting, setting.place?)));
            match place.zip(words.at_next_start()) {
                Some(((setting, place), reverse)) => {
                    let word = if reverse { setting.applied(0) } else { setting.undone(0) };
                    sent(place, word)
                }
                None => Made::Nothing,
            }
        }
        Word::Run(reverse) => {
            let (place, word) = run_word(control, stays, reverse, words);
            sent(place.unwrap_or(at), word)
        }
        Word::Sequence(number, reverse) => {
            let Run::Steps(steps) = &control.run else {
                return Made::Nothing;
            };
            let Some(step) = steps.get(number) else {
                return Made::Nothing;
            };
            let reverse = reverse.or(words.at_next_start());
            let reverse = reverse.or_else(|| own.and_then(|own| control.direction_of(own)));
            let word = step.write.applied(stays);
            sent(
                at,
                reverse.map_or(word, |reverse| control.with_direction(word, reverse)),
            )
        }
        // The word of a motor that runs stays as it is, as does one that the drive has. The coil of a motor that stands is written
        // in any case: no other write of the reset takes away a run command that another master has set since the last reading.
        Word::ResetLow(reset) if runs && reset.place.is_some() => Made::Nothing,
        Word::ResetLow(_) if own == Some(stays) && (known.running || coil_of(control).is_none()) => Made::Nothing,
        Word::ResetHigh(reset) => sent(at, reset.applied(stays)),
        Word::ResetLow(_) | Word::ResetEnd(_) => sent(at, stays),
        Word::Others(bits) => sent(at, bits.applied(stays)),
    }
}

/// Whether a reset starts a motor that has tripped and whose run command is still on.
fn starts_by_reset(control: &Control) -> bool {
    control.restarts_on_reset
}

/// Whether a reset by the control word also takes the run command away.
fn stops_by_reset(control: &Control, reset: Setting) -> bool {
    reset.place.is_none() && control.runs().iter().any(|run| !reset.agrees(run))
}

/// What decides which run command is written together with a word.
enum Basis {
    /// The word is formed this way, whatever the motor does.
    Certain(Form),
    /// The word would repeat this, which is judged first.
    Judged(Repeats),
}

/// What decides which run command is written together with a word. `released` is the known control word without a reset.
fn basis(
    word: Word,
    control: &Control,
    words: &KnownWords,
    released: Option<u16>,
    known: RequestContext,
    motor: Option<Motor>,
) -> Basis {
    // A word that itself decides whether the motor runs repeats nothing.
    let Some(wants) = word.wants() else {
        return Basis::Certain(Form::AsItStands);
    };
    // The drive may have received a stop that it did not acknowledge, and its motor may still be slowing down.
    if known.stopped {
        return Basis::Certain(Form::WithoutRun);
    }
    let Some(holds) = holds(control, words, released) else {
        return Basis::Certain(Form::WithoutRun);
    };
    Basis::Judged(Repeats {
        wants,
        holds,
        told: known.check == Check::Read,
        motor,
        on_running: word.on_running(control),
    })
}

/// The run command that the drive is known to have; `None` if it is known to have a stop.
fn holds(control: &Control, words: &KnownWords, released: Option<u16>) -> Option<KnownRun> {
    let place = control.run_place();
    let own = place == control.at;
    let word = if own {
        released
    } else {
        words.get(place.table, place.address)
    };
    match word {
        None => Some(KnownRun::Unknown),
        Some(word) if control.is_stop(place, word) => None,
        Some(word) if control.is_run(place, word) && (!own || control.always.holds(word)) => Some(KnownRun::Run),
        Some(_) => Some(KnownRun::Other),
    }
}

/// Whether the word must first be read from the drive, because a bit is to keep its value. A stop and a start need
/// no read, unless the other bits must be kept and are unknown.
fn asks_first(word: Word, control: &Control, own: Option<u16>, known: RequestContext, motor: Option<Motor>) -> bool {
    let is_coil = matches!(control.at.table, Table::Coil | Table::DiscreteInput);
    if is_coil || known.blind || known.check != Check::NotYet {
        return false;
    }
    match (control.own_word, word) {
        (OwnWord::Shadow, _) => false,
        // These words are not written to the control register.
        (_, Word::DirectionElsewhere(_) | Word::KeptDirection) => false,
        (OwnWord::Read, Word::Stop(_) | Word::ResetEnd(_)) => false,
        (OwnWord::Read, Word::Run(_)) if control.run_place() != control.at => false,
        (OwnWord::Read, Word::ResetHigh(_) | Word::Run(_) | Word::Sequence(..)) => own.is_none(),
        (OwnWord::Read, Word::Direction(_) | Word::ResetLow(_) | Word::Others(_)) => true,
        (OwnWord::Kept, word) => own.is_none_or(|own| {
            // A run command that the order does not contain may have been taken away elsewhere since the word was
            // read; writing it again would start the motor.
            let running = motor.map_or(known.running, |motor| motor == Motor::Runs);
            let is_taken_away = !running && matches!(word, Word::ResetLow(_));
            let stops = is_taken_away || control.is_stop(control.at, own);
            let is_low = running && matches!(word, Word::ResetLow(pulse) if pulse.released(own) == own);
            !known.names_run && !stops && !is_low
        }),
    }
}

/// The word for a run command, and its register if that is not the control word.
fn run_word(control: &Control, kept: u16, reverse: Option<bool>, words: &KnownWords) -> (Option<ControlItem>, u16) {
    let ordered = reverse.or(words.at_next_start());
    match &control.run {
        Run::Pair { forward, reverse: back } => {
            let stands = control.direction_of(kept);
            let turned = ordered.or(stands).or(words.direction).unwrap_or(false);
            let run = if turned { back } else { forward };
            (run.place, run.applied(if run.place.is_some() { 0 } else { kept }))
        }
        Run::One(setting) => {
            let word = setting.applied(kept);
            (
                None,
                ordered.map_or(word, |reverse| control.with_direction(word, reverse)),
            )
        }
        Run::Steps(_) => (None, kept),
    }
}

fn read_of(place: ControlItem) -> Step {
    let (start, count) = (place.address, 1);
    let table = place.table;
    Step::new(StepPurpose::ReadWord, RequestPdu::Read { table, start, count })
}

/// Whether the word with this number is the last of the sequence, which starts the motor.
pub(super) fn is_last(profile: &Profile, number: usize) -> bool {
    let run = profile.control.as_ref().map(|control| &control.run);
    matches!(run, Some(Run::Steps(steps)) if number + 1 == steps.len())
}

/// The register of `[control]` whose word is learned from the drive's reports; `None` if the drive reports
/// something else there.
pub fn read_place(profile: &Profile) -> Option<ControlItem> {
    let control = profile.control.as_ref()?;
    (control.own_word == OwnWord::Read).then_some(control.at)
}
