//! The steps of a command in their safe order, and the request for each step.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use super::awaited_state::AwaitedState;
use super::control::{self, Ordered};
use super::known_words::KnownWords;
use super::parameter::ParameterRun;
use super::word::Word;
use drivegate_core::order::{Refusal, written};
use drivegate_core::permit::Repeats;
use drivegate_model::drive::control::Setting;
use drivegate_model::drive::profile::Form;
use drivegate_model::drive::{Point, PointIndex, Profile, Raw, Value};
use drivegate_proto::n2::Session;
use drivegate_proto::{RequestPdu, Table};

#[derive(Debug, Clone, PartialEq)]
pub(super) enum Action {
    /// A raw request, or a write of a whole register.
    Send(RequestPdu),
    /// A write of a value that the drive stores; it is left out if a read shows that the drive already has the value.
    Change {
        pdu: RequestPdu,
        table: Table,
        items: Vec<(u16, u16)>,
    },
    /// Ends an earlier override, so that the drive controls the value itself again; a failure changes nothing.
    Release(RequestPdu),
    /// Bits of one word; its other bits keep their known values.
    Bits { raw: Raw, changes: Vec<(u8, bool)> },
    /// Clears a pulse bit outside the control word, if it is set.
    PulseLow { raw: Raw, bit: u8, invert: bool },
    /// Sets the bit of a pulse outside the control word.
    PulseHigh { raw: Raw, bit: u8, invert: bool },
    /// Clears the bit at the end of a pulse.
    PulseEnd { raw: Raw, bit: u8, invert: bool },
    /// A pause, usually two update periods of the drive.
    Wait(Duration),
    /// A word for the control register, as `[control]` of the profile defines it.
    Word(Word),
    /// Waits for the state that ends a step of a sequence.
    Await(Box<AwaitedState>),
    /// Sets a reset in its separate register.
    ResetElsewhere(RequestPdu),
    /// Clears the reset in its separate register.
    ResetOver(RequestPdu),
    /// A write of a parameter, in several steps.
    Parameter(Box<ParameterRun>),
}

/// The purpose of a request of a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StepPurpose {
    /// Reads the drive's own word, whose other bits must not change.
    ReadWord,
    /// Reads whether the drive has the value already, which would spare its memory a write.
    Compare,
    /// Carries out the order itself.
    Execute,
    /// Ends an override, so that the drive controls the output itself again.
    Release,
    /// Reads whether the motor runs, right before a write of a parameter or of a word that does not itself decide that.
    Look,
    /// Reads the state that ends a step of a sequence.
    AskState,
    /// Reads whether the drive took a parameter.
    ReadBack,
}

/// A request that is a step of a command.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Step {
    /// Purpose of the step.
    pub purpose: StepPurpose,
    /// The request to send.
    pub pdu: RequestPdu,
}

impl Action {
    /// Whether the action sets a reset.
    pub(super) fn is_reset(&self) -> bool {
        matches!(
            self,
            Action::PulseHigh { .. } | Action::Word(Word::ResetHigh(_)) | Action::ResetElsewhere(_)
        )
    }

    pub(super) fn ends_reset(&self) -> bool {
        matches!(
            self,
            Action::PulseEnd { .. } | Action::Word(Word::ResetEnd(_)) | Action::ResetOver(_)
        )
    }
}

impl Step {
    pub(super) fn new(purpose: StepPurpose, pdu: RequestPdu) -> Step {
        Step { purpose, pdu }
    }
}

/// Whether the present value was read before the write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Check {
    NotYet,
    Read,
    /// The drive does not report its word, so reading it is useless.
    InVain,
}

/// What is known for building a step's request, in addition to the known words.
#[derive(Debug, Clone, Copy)]
pub(super) struct RequestContext {
    pub(super) check: Check,
    /// Whether the control word cannot be read.
    pub(super) blind: bool,
    /// Whether the command decides whether the motor is to run.
    pub(super) names_run: bool,
    /// Whether a stop of the motor is on its way: then no word contains a run command, whatever the drive reports.
    pub(super) stopped: bool,
    /// Whether the motor runs, as last reported.
    pub(super) running: bool,
    /// Whether the drive itself changes bits of a register.
    pub(super) masks: bool,
    /// The last answer about what a word would repeat.
    pub(super) permit: Option<Permit>,
}

/// What may be sent, as long as the next word would repeat exactly this.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Permit {
    /// The word may be written.
    Write(Repeats),
    /// The reads that show whether the motor runs may be sent.
    Look(Repeats),
}

/// A word, with the bits of it that change.
type WordChange = (Raw, Vec<(u8, bool)>);

/// Whether a command sets every bit of the profile that can be commanded, reset bits apart.
pub(super) fn sets_all_bits(profile: &Profile, values: &[(PointIndex, Value)]) -> bool {
    let level = |p: &Point| p.write && !p.pulse && p.raw().is_some_and(|r| matches!(r.form, Form::Bit { .. }));
    let mut bits = profile.points.enumerate().filter(|(_, p)| level(p));
    bits.all(|(bit, _)| values.iter().any(|(index, _)| *index == bit))
}

/// Why a command cannot be sent: a point has no register in the drive, or a value does not fit its register.
/// Admitted commands have neither problem; a command that has one must not end as if the drive had accepted it.
pub(super) fn unsendable(profile: &Profile, values: &[(PointIndex, Value)]) -> Option<Refusal> {
    values.iter().find_map(|(index, value)| {
        let Some(point) = profile.points.get(*index) else {
            return Some(Refusal::NotWritable(format!("there is no point {index}")));
        };
        let name = &point.name;
        if Ordered::default().note_value(profile, *index, *value) {
            return None;
        }
        match point.raw().map(|raw| raw.encode(*value, 0)) {
            Some(Ok(words)) if !words.is_empty() => None,
            Some(Ok(_)) => Some(Refusal::BadValue(format!("`{name}` = {value} cannot be encoded"))),
            Some(Err(why)) => Some(Refusal::BadValue(format!("`{name}`: {why}"))),
            None => Some(Refusal::NotWritable(format!(
                "`{name}` is derived, not a register of the drive, and cannot be written"
            ))),
        }
    })
}

/// Whether a command decides whether the motor is to run.
pub(super) fn names_run(profile: &Profile, values: &[(PointIndex, Value)]) -> bool {
    let Some(control) = &profile.control else {
        return false;
    };
    let place = control.run_place();
    let bits = control.each_run().fold(0, |bits, run| bits | run.mask);
    let is_run = |raw: &Raw| (raw.table, raw.address) != (place.table, place.address) || bits_of(raw) & bits != 0;
    values.iter().any(|(index, value)| {
        let raw = profile.points.get(*index).and_then(|point| point.raw());
        let covers = raw.is_some_and(|raw| raw.covers(place.table, place.address) && is_run(raw));
        covers || Ordered::default().says_run(profile, *index, *value)
    })
}

/// The bits of its first word that a raw value uses.
fn bits_of(raw: &Raw) -> u16 {
    match raw.form {
        Form::Bit { bit, .. } => 1u16.checked_shl(bit.into()).unwrap_or_default(),
        Form::Bits { first, count } => {
            let bits = first..first.saturating_add(count);
            bits.fold(0, |mask, bit| mask | 1u16.checked_shl(bit.into()).unwrap_or_default())
        }
        _ => u16::MAX,
    }
}

/// The actions of a command. `stopped` means that the command is the rest of one whose stop was sent before.
pub(super) fn actions(
    profile: &Profile,
    values: &[(PointIndex, Value)],
    stop: bool,
    stopped: bool,
) -> VecDeque<Action> {
    let mut numbers = VecDeque::new();
    let mut pulses = VecDeque::new();
    let mut words: BTreeMap<(Table, u16), WordChange> = BTreeMap::new();
    let mut control = Ordered::default();
    let at = profile
        .control
        .as_ref()
        .map(|control| (control.at.table, control.at.address));
    for (index, value) in values {
        if control.note_value(profile, *index, *value) {
            continue;
        }
        let Some(point) = profile.points.get(*index) else {
            continue;
        };
        let Some(raw) = point.raw() else { continue };
        let is_control = Some((raw.table, raw.address)) == at && raw.table == Table::Holding;
        match raw.form {
            Form::Bit { bit, invert } if point.pulse => {
                if value.as_bool() {
                    let length = 2 * profile.update_period;
                    pulses.extend(if is_control {
                        control::pulse(setting_of(&[(bit, !invert)]), length)
                    } else {
                        pulse(raw, bit, invert, length)
                    });
                }
            }
            Form::Bit { .. } | Form::Bits { .. } => {
                // Admitted values fit; a value that does not fit is left out rather than sent wrong.
                let Some(word) = raw.encode(*value, 0).ok().and_then(|words| words.first().copied()) else {
                    continue;
                };
                let entry = words
                    .entry((raw.table, raw.address))
                    .or_insert_with(|| (raw.clone(), Vec::new()));
                let bits = bits_of(raw);
                let changed = (0..16u8).filter(|bit| (bits >> bit) & 1 == 1);
                entry.1.extend(changed.map(|bit| (bit, (word >> bit) & 1 == 1)));
            }
            _ => {
                let pdu = raw
                    .encode(*value, 0)
                    .ok()
                    .and_then(|words| write_of(raw.address, words));
                numbers.extend(pdu.map(Action::Send));
            }
        }
    }
    let others = words.into_iter().map(|(place, (raw, changes))| {
        if Some(place) == at && raw.table == Table::Holding {
            Action::Word(Word::Others(setting_of(&changes)))
        } else {
            Action::Bits { raw, changes }
        }
    });
    // A stop goes first, a run command last. Without either, nothing is written before a read has shown whether the
    // words may be written.
    let commands = control.actions(profile, stop, stopped);
    if stop {
        commands
            .into_iter()
            .chain(others)
            .chain(numbers)
            .chain(pulses)
            .collect()
    } else if names_run(profile, values) {
        numbers
            .into_iter()
            .chain(pulses)
            .chain(others)
            .chain(commands)
            .collect()
    } else {
        pulses
            .into_iter()
            .chain(others)
            .chain(commands)
            .chain(numbers)
            .collect()
    }
}

/// A bit of another register or coil, set for a time.
fn pulse(raw: &Raw, bit: u8, invert: bool, length: Duration) -> [Action; 5] {
    let raw = || raw.clone();
    [
        Action::PulseLow {
            raw: raw(),
            bit,
            invert,
        },
        Action::Wait(length),
        Action::PulseHigh {
            raw: raw(),
            bit,
            invert,
        },
        Action::Wait(length),
        Action::PulseEnd {
            raw: raw(),
            bit,
            invert,
        },
    ]
}

/// Bits of the control word with their new values.
fn setting_of(changes: &[(u8, bool)]) -> Setting {
    let bits = |of: &dyn Fn(bool) -> bool| {
        let of = changes.iter().filter(|(_, on)| of(*on));
        of.fold(0u16, |word, (bit, _)| word | (1 << bit))
    };
    Setting {
        place: None,
        mask: bits(&|_| true),
        value: bits(&|on| on),
        once: false,
    }
}

fn write_of(address: u16, words: Vec<u16>) -> Option<RequestPdu> {
    match words.as_slice() {
        [] => None,
        [value] => Some(RequestPdu::WriteRegister { address, value: *value }),
        _ => Some(RequestPdu::WriteRegisters {
            start: address,
            values: words,
        }),
    }
}

/// The request for an action with the known words; a read if a word is unknown; `None` if nothing is to be done.
pub(super) fn step_of(action: &Action, words: &KnownWords, profile: &Profile, known: RequestContext) -> Option<Step> {
    let execute = |pdu: &RequestPdu| Step::new(StepPurpose::Execute, pdu.clone());
    match action {
        // These actions become requests only when they are reached.
        Action::Wait(_) | Action::Word(_) | Action::Await(_) => None,
        Action::Send(pdu) | Action::ResetElsewhere(pdu) | Action::ResetOver(pdu) => Some(execute(pdu)),
        Action::Parameter(run) => Some(run.step()),
        Action::Release(pdu) => Some(Step::new(StepPurpose::Release, pdu.clone())),
        Action::Change { pdu, table, items } => match known.check {
            // An earlier read is not proof, because the value may have been changed at the drive since: a write
            // must not be left out because of it.
            Check::NotYet if words.differs(*table, items) => Some(execute(pdu)),
            Check::NotYet => {
                let read = read_of(*table, items).map(|read| Step::new(StepPurpose::Compare, read));
                read.or_else(|| Some(execute(pdu)))
            }
            Check::Read => (!words.has(*table, items)).then(|| execute(pdu)),
            Check::InVain => Some(execute(pdu)),
        },
        Action::Bits { raw, changes } => bits(action, raw, changes.clone(), words, profile, known),
        Action::PulseHigh { raw, bit, invert } => bits(action, raw, vec![(*bit, !invert)], words, profile, known),
        Action::PulseEnd { raw, bit, invert } => bits(action, raw, vec![(*bit, *invert)], words, profile, known),
        Action::PulseLow { raw, bit, invert } => bits(action, raw, vec![(*bit, *invert)], words, profile, known),
    }
}

/// The write that changes bits of one word, or the read that it needs first.
fn bits(
    action: &Action,
    raw: &Raw,
    changes: Vec<(u8, bool)>,
    words: &KnownWords,
    profile: &Profile,
    known: RequestContext,
) -> Option<Step> {
    let only_if_set = matches!(action, Action::PulseLow { .. });
    let address = raw.address;
    if raw.table == Table::Coil {
        let on = changes.first().is_some_and(|(_, on)| *on);
        return Some(Step::new(StepPurpose::Execute, RequestPdu::WriteCoil { address, on }));
    }
    let read = RequestPdu::Read {
        table: raw.table,
        start: address,
        count: 1,
    };
    let read = Step::new(StepPurpose::ReadWord, read);
    if profile.is_settings(raw.table, address) && !matches!(action, Action::PulseEnd { .. }) {
        // An earlier read is not proof: other bits may have been changed at the drive since.
        if known.masks {
            return Some(Step::new(StepPurpose::Execute, mask(address, &changes)));
        }
        if known.check == Check::NotYet {
            return Some(read);
        }
    }
    let Some(old) = words.get(Table::Holding, address).or(known.blind.then_some(0)) else {
        return Some(read);
    };
    let set = |word: u16, (bit, on): (u8, bool)| if on { word | (1 << bit) } else { word & !(1 << bit) };
    let value = changes.into_iter().fold(old, set);
    let kept = matches!(action, Action::Bits { .. }) && known.check == Check::Read && {
        profile.is_settings(raw.table, address) && profile.writes_on_change(raw.table, &[(address, value)])
    };
    if (only_if_set || kept) && value == old {
        return None;
    }
    Some(Step::new(
        StepPurpose::Execute,
        RequestPdu::WriteRegister { address, value },
    ))
}

/// The mask write that changes these bits and keeps the others.
fn mask(address: u16, changes: &[(u8, bool)]) -> RequestPdu {
    let bits = |on: bool| {
        let of = changes.iter().filter(|(_, to)| *to == on);
        of.fold(0u16, |word, (bit, _)| word | (1 << bit))
    };
    RequestPdu::MaskWrite {
        address,
        and_mask: !(bits(true) | bits(false)),
        or_mask: bits(true),
    }
}

/// Converts a write to spare the drive's memory, if writing wears it: the write is left out if the drive reports
/// that it already has the values; an N2 override is released afterwards if the profile requires that. A stop is
/// never left out.
pub(super) fn write_on_change(action: Action, profile: &Profile) -> Vec<Action> {
    let written = match &action {
        Action::Send(pdu) => written(pdu).map(|(table, items)| (pdu.clone(), table, items)),
        Action::Bits { raw, changes } if raw.table == Table::Coil => changes.first().map(|(_, on)| {
            let (address, on) = (raw.address, *on);
            let pdu = RequestPdu::WriteCoil { address, on };
            (pdu, raw.table, vec![(address, u16::from(on))])
        }),
        _ => None,
    };
    let Some((pdu, table, items)) = written.filter(|(_, table, items)| profile.writes_on_change(*table, items)) else {
        return vec![action];
    };
    let address = items.first().map(|(address, _)| *address);
    let release = address
        .filter(|_| profile.releases(table))
        .map(|address| Action::Release(RequestPdu::N2(Session::Release { table, address })));
    let change = Action::Change { pdu, table, items };
    [change].into_iter().chain(release).collect()
}

/// The read of the words that a write would set.
fn read_of(table: Table, items: &[(u16, u16)]) -> Option<RequestPdu> {
    let (start, _) = *items.first()?;
    let count = u16::try_from(items.len()).ok()?;
    Some(RequestPdu::Read { table, start, count })
}
