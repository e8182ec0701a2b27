//! The word for the control register of a drive whose profile has `[control]`: made from the word that the drive has, or
//! kept back until a read or the gate has shown whether it may be written. Pure.

use super::control::{coil_of, write};
use super::known_words::KnownWords;
use super::steps::{Check, Permit, RequestContext, Step, StepPurpose};
use drivegate_core::permit::{Form, KnownRun, Motor, OnRunning, Repeats, Wants};
use drivegate_model::drive::Profile;
use drivegate_model::drive::control::{Control, ControlItem, OwnWord, Run, Setting};
use drivegate_proto::{RequestPdu, Table};

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
    /// A word of the start sequence, with a direction where the order has one.
    Sequence(SequenceWord, Option<bool>),
    /// Prepares a pulse of these bits, usually a reset: clears the bits, and the run command if the motor is at standstill.
    ResetLow(Setting),
    /// Sets the bits of a reset pulse.
    ResetHigh(Setting),
    /// Writes the word after a reset pulse.
    ResetEnd(Setting),
    /// Bits that belong to no command of `[control]`.
    Others(Setting),
}

/// A word of a start sequence.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct SequenceWord {
    /// The bits that the word sets and clears.
    pub(super) write: Setting,
    pub(super) is_first: bool,
    /// The last word starts the motor.
    pub(super) is_last: bool,
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

/// The request that writes a word, based on the known control word; or the read of the control word if it is not known.
/// `motor` is the state of the motor as the drive reported it right before; `None` if it was not read.
pub(super) fn made(
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
    let base = released.unwrap_or_else(|| {
        let reverse = match word {
            Word::Run(_) | Word::Sequence(..) => words.unnamed_direction(control),
            _ => words.ordered_direction(control),
        };
        control.unknown_word(reverse)
    });
    let form = match basis(word, control, words, released, known, motor) {
        Basis::Certain(form) => form,
        Basis::Judged(repeats) => match known.permit {
            Some(Permit::Write(of)) if of == repeats => repeats.form(),
            Some(Permit::Look(of)) if of == repeats => return Made::Look,
            _ => return Made::Judge(repeats),
        },
    };
    let runs = form == Form::AsItStands;
    let stays = if runs {
        control.always.applied(base)
    } else {
        control.resting(base)
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
                if runs && run.place.is_none() {
                    sent(at, run.applied(stays))
                } else {
                    // While the motor is at standstill, no bit of the drive stores the direction.
                    Made::AtNextStart(reverse)
                }
            }
            Run::One(_) | Run::Steps(_) => sent(at, control.with_direction(stays, reverse)),
        },
        Word::DirectionElsewhere(_) => Made::Nothing,
        Word::KeptDirection => {
            let due = control.direction_elsewhere().and_then(|(setting, place)| {
                // A drive whose coil is 0 runs forward, unless the coil has the opposite meaning.
                let is_unknown = setting.value == 0 && words.get(place.table, place.address).is_none();
                let reverse = words
                    .at_next_start()
                    .or(is_unknown.then(|| words.unnamed_direction(control)))?;
                Some((place, if reverse { setting.applied(0) } else { setting.undone(0) }))
            });
            due.map_or(Made::Nothing, |(place, word)| sent(place, word))
        }
        Word::Run(reverse) => {
            let (place, word) = run_word(control, stays, reverse, words);
            sent(place.unwrap_or(at), word)
        }
        Word::Sequence(step, reverse) => {
            let reverse = reverse.or(words.at_next_start());
            let reverse = reverse.unwrap_or_else(|| {
                let own = own.and_then(|own| control.direction_of(own));
                own.unwrap_or_else(|| words.unnamed_direction(control))
            });
            sent(at, control.with_direction(step.write.applied(stays), reverse))
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
            let turned = ordered.or(stands).unwrap_or_else(|| words.unnamed_direction(control));
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

/// The register of `[control]` whose word is learned from the drive's reports; `None` if the drive reports
/// something else there.
pub fn read_place(profile: &Profile) -> Option<ControlItem> {
    let control = profile.control.as_ref()?;
    (control.own_word == OwnWord::Read).then_some(control.at)
}
