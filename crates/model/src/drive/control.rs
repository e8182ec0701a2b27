//! How a family is commanded: the control word, the words that run, stop and reset, and the sequence before them. Pure.

mod contradictions;

use crate::drive::PointIndex;
use std::time::Duration;

use super::profile::Raw;
use drivegate_proto::Table;

/// The section `[control]` of a profile.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Control {
    /// Place of the control word, or of a coil.
    pub at: ControlItem,
    /// What reading the control word returns.
    pub own_word: OwnWord,
    /// Bits with a fixed value in every word.
    pub always: Always,
    /// How the motor is started.
    pub run: Run,
    /// How the motor is stopped, and how a stop is recognised.
    pub stop: Setting,
    /// Other words of the control register that also stop the drive; the gateway never sends them.
    pub also_stop: Vec<Setting>,
    /// How the motor is reversed, unless that is part of `run`.
    pub reverse: Option<Setting>,
    /// How a fault is reset.
    pub fault_reset: Option<Reset>,
    /// A reset while a run command is set starts the motor.
    pub restarts_on_reset: bool,
    /// Interval of the refresh, if the family needs one because its timeout counts only writes.
    pub refresh: Option<Duration>,
    /// A refresh of the reference alone feeds that timeout, too.
    pub refresh_with_reference: bool,
}

/// A register or coil that takes commands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ControlItem {
    /// Modbus table of the place.
    pub table: Table,
    /// PDU address.
    pub address: u16,
}

impl ControlItem {
    /// The register or coil of a raw point.
    pub(super) fn of(raw: &Raw) -> ControlItem {
        ControlItem {
            table: raw.table,
            address: raw.address,
        }
    }
}

/// What reading the control word returns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum OwnWord {
    /// The register reads as the word written last.
    #[default]
    Read,
    /// The register cannot be read, or has another meaning when read: the gateway remembers its own word.
    Shadow,
    /// The commands are single bits of the word, defined by points of the profile; every command keeps the other
    /// bits, and the word is read before it is written if it is unknown.
    Kept,
}

/// Bits with a fixed value in every word.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Always {
    /// Bits that are always 1.
    pub set: u16,
    /// Bits that are always 0.
    pub clear: u16,
}

impl Always {
    /// The word with these bits set.
    pub fn applied(self, word: u16) -> u16 {
        (word | self.set) & !self.clear
    }

    /// Whether the word has all these bits set.
    pub fn holds(self, word: u16) -> bool {
        self.applied(word) == word
    }
}

/// Bits of a word with their values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Setting {
    /// Register of the word; `None` for the control word.
    pub place: Option<ControlItem>,
    /// The bits of the word that are meant.
    pub mask: u16,
    /// Values of the bits.
    pub value: u16,
    /// Whether the setting acts once, when it is written, so that clearing it has no effect.
    pub once: bool,
}

impl Setting {
    /// The word with these bits set to these values.
    pub fn applied(&self, word: u16) -> u16 {
        word & !self.mask | self.value & self.mask
    }

    /// Whether these bits of the word have these values.
    pub fn holds(&self, word: u16) -> bool {
        word & self.mask == self.value
    }

    /// The word with the opposite value of these bits, if there is only one bit.
    pub fn undone(&self, word: u16) -> u16 {
        word & !self.mask | !self.value & self.mask
    }

    /// The word with these bits in the state that they have between two pulses. Bits of a separate register are not in
    /// the word.
    pub fn released(&self, word: u16) -> u16 {
        match self.place {
            None if self.value == 0 => word | self.mask,
            None if self.holds(word) => word & !self.value,
            _ => word,
        }
    }

    /// Whether a word can satisfy this setting and another one at the same time.
    pub fn agrees(&self, other: &Setting) -> bool {
        let both = self.mask & other.mask;
        self.place != other.place || self.value & both == other.value & both
    }
}

/// How the motor is started.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Run {
    /// A single setting, forward; `reverse` sets the direction.
    One(Setting),
    /// A setting for each direction; never both.
    Pair {
        /// The word that runs the motor forward.
        forward: Setting,
        /// The setting that runs the motor in reverse.
        reverse: Setting,
    },
    /// A sequence of words; the last one runs.
    Steps(Vec<Step>),
}

/// A step of a start or reset sequence, which writes one word.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Step {
    /// The word to write; the direction bits are added to it as commanded.
    pub write: Setting,
    /// The condition under which the step is done.
    pub until: Until,
    /// Time limit after which the command fails.
    pub timeout: Duration,
}

/// The condition under which a step is done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Until {
    /// The step is done when its word was acknowledged.
    Written,
    /// The step is done when this time has passed after the write.
    Time(Duration),
    /// The step is done when this state is read.
    State(Mask),
}

/// A masked value of a register.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Mask {
    /// Index of the point.
    pub point: PointIndex,
    /// Bits of the register that count.
    pub mask: u64,
    /// Required value of these bits.
    pub is: u64,
}

impl Mask {
    /// Whether the register is in that state.
    pub fn holds(&self, word: u64) -> bool {
        word & self.mask == self.is
    }
}

/// A fault reset, which is a pulse.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reset {
    /// The bits to set, and to invert afterwards.
    pub setting: Setting,
    /// Time for which the bits are held.
    pub pulse: Duration,
    /// Whether more than one source has it.
    pub verified: bool,
}

impl Control {
    /// Every setting that starts the motor; for a sequence, its last word.
    pub fn runs(&self) -> Vec<Setting> {
        self.each_run().copied().collect()
    }

    /// The settings of [`Control::runs`], where no list of them is needed.
    pub fn each_run(&self) -> impl Iterator<Item = &Setting> {
        let (first, second) = match &self.run {
            Run::One(setting) => (Some(setting), None),
            Run::Pair { forward, reverse } => (Some(forward), Some(reverse)),
            Run::Steps(steps) => (steps.last().map(|step| &step.write), None),
        };
        first.into_iter().chain(second)
    }

    /// Whether the word, written to this register, stops the motor.
    pub fn is_stop(&self, place: ControlItem, word: u16) -> bool {
        self.is_own_stop(place, word) || self.is_also_stop(place, word)
    }

    /// Whether the word is the stop that the gateway itself writes.
    pub fn is_own_stop(&self, place: ControlItem, word: u16) -> bool {
        self.stop.place.unwrap_or(self.at) == place && self.stop.holds(word)
    }

    /// Whether the word is one of the other words that also stop the drive.
    fn is_also_stop(&self, place: ControlItem, word: u16) -> bool {
        place == self.at && self.also_stop.iter().any(|stop| stop.holds(word))
    }

    /// Whether the word, written to this register, starts the motor or keeps it running.
    pub fn is_run(&self, place: ControlItem, word: u16) -> bool {
        let of = |setting: &Setting| setting.place.unwrap_or(self.at) == place && self.holds_run(setting, word);
        !self.is_stop(place, word) && self.each_run().any(of)
    }

    /// Whether a client may write this word here unchanged: to the control register only words that clearly stop or
    /// run, to other registers only what they are meant for.
    pub fn admits(&self, place: ControlItem, word: u16) -> bool {
        if self.own_word == OwnWord::Kept {
            return true;
        }
        if place == self.at {
            return self.is_stop(place, word) || self.is_run(place, word) && self.always.holds(word);
        }
        let mut others = self.runs();
        others.extend(
            [
                Some(self.stop),
                self.reverse,
                self.fault_reset.map(|reset| reset.setting),
            ]
            .into_iter()
            .flatten(),
        );
        let here: Vec<&Setting> = others.iter().filter(|setting| setting.place == Some(place)).collect();
        here.is_empty()
            || here
                .iter()
                .any(|setting| word == setting.applied(0) || word == setting.undone(0))
    }

    /// The bits of the direction count for nothing in a sequence, nor does what resets.
    fn holds_run(&self, setting: &Setting, word: u16) -> bool {
        (word ^ setting.value) & setting.mask & !self.free() == 0
    }

    /// The direction bits of a sequence's words, which are set as commanded.
    pub(super) fn free(&self) -> u16 {
        match (&self.run, &self.reverse) {
            (Run::Steps(_), Some(reverse)) if reverse.place.is_none() => reverse.mask,
            _ => 0,
        }
    }

    /// The states of the control word that contain a run command: those of [`Control::runs`] without the words that
    /// also stop.
    pub(super) fn run_states(&self) -> Vec<Setting> {
        let (free, always) = (self.free(), self.always);
        let differ = |stop: &Setting| (stop.value & always.clear) | (!stop.value & stop.mask & always.set);
        let others = self.also_stop.iter().fold(0, |bits, stop| bits | differ(stop));
        let state = |run: Setting| {
            let others = match run.place {
                None => others & !run.mask,
                Some(_) => 0,
            };
            Setting {
                mask: run.mask & !free | others,
                value: run.value & !free | always.set & others,
                ..run
            }
        };
        self.runs().into_iter().map(state).collect()
    }

    /// The word from which the next one is made if the drive has `own`: after a stop by another word this is the
    /// normal stop word, so that no later write runs the motor.
    pub fn standing(&self, own: u16) -> u16 {
        if self.is_also_stop(self.at, own) {
            self.stop_word(own)
        } else {
            own
        }
    }

    /// The word without a reset: its reset bits are as between two resets.
    pub fn without_reset(&self, own: u16) -> u16 {
        let reset = self.fault_reset.map(|reset| reset.setting);
        reset.map_or(own, |reset| reset.released(own))
    }

    /// The word with this direction, if the direction is part of the control word.
    pub fn with_direction(&self, word: u16, reverse: bool) -> u16 {
        match self.reverse.filter(|setting| setting.place.is_none()) {
            Some(setting) if reverse => setting.applied(word),
            Some(setting) if setting.holds(word) || setting.mask.count_ones() == 1 => setting.undone(word),
            _ => word,
        }
    }

    /// The direction in the word, if any.
    pub fn direction_of(&self, word: u16) -> Option<bool> {
        if let Some(reverse) = self.reverse.filter(|setting| setting.place.is_none()) {
            return Some(reverse.holds(word));
        }
        match &self.run {
            Run::Pair { reverse, .. } if reverse.holds(word) => Some(true),
            Run::Pair { forward, .. } if forward.holds(word) => Some(false),
            _ => None,
        }
    }

    /// Whether the register is the control word of a drive that reads as something else.
    pub fn is_unreadable(&self, place: ControlItem) -> bool {
        self.own_word == OwnWord::Shadow && place == self.at
    }

    /// The direction that these words show, wherever the family has it; `None` if the word of that place is not known, or has
    /// no direction.
    pub fn direction_in(&self, word: impl Fn(ControlItem) -> Option<u16>) -> Option<bool> {
        if let Some((setting, place)) = self.direction_elsewhere() {
            return word(place).map(|word| setting.holds(word));
        }
        let Run::Pair { forward, reverse } = &self.run else {
            return word(self.at).and_then(|word| self.direction_of(word));
        };
        let holds = |run: &Setting| word(run.place.unwrap_or(self.at)).is_some_and(|word| run.holds(word));
        holds(reverse).then_some(true).or(holds(forward).then_some(false))
    }

    /// The direction where it has its own register or coil.
    pub fn direction_elsewhere(&self) -> Option<(Setting, ControlItem)> {
        let elsewhere = self.reverse.and_then(|setting| Some((setting, setting.place?)));
        elsewhere.filter(|_| !matches!(self.run, Run::Pair { .. }))
    }

    /// The place to which `run` is written.
    pub fn run_place(&self) -> ControlItem {
        let first = self.each_run().next().and_then(|setting| setting.place);
        first.unwrap_or(self.at)
    }

    /// The control word without a run command, made from the present one.
    pub fn resting(&self, own: u16) -> u16 {
        if self.stop.place.is_none() {
            return self.stop_word(own);
        }
        let runs = self.runs().into_iter().filter(|run| run.place.is_none());
        let bits = runs.fold(0, |bits, run| bits | run.value);
        self.always.applied(own & !bits)
    }

    /// The word from which the next one is made where the drive's own word is not known: in this direction and without a run
    /// command.
    pub fn unknown_word(&self, reverse: bool) -> u16 {
        let word = match &self.run {
            // A word without the other bits of a sequence would take the voltage off, and the motor would coast.
            Run::Steps(steps) => steps.last().map_or(0, |last| self.resting(last.write.value)),
            Run::One(_) | Run::Pair { .. } => 0,
        };
        self.with_direction(word, reverse)
    }

    /// The stop word, made from the present word.
    pub fn stop_word(&self, own: u16) -> u16 {
        match self.stop.place {
            None => self.stop.applied(self.always.applied(own)),
            Some(_) => self.stop.applied(0),
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::drive::Profile;

    use super::*;

    fn control(lines: &str) -> Control {
        let text = format!(
            "name = \"p\"\nprotocols = [\"modbus-rtu\"]\n[[range]]\ntable = \"holding\"\nfirst = 0\nlast = 9\nread = 5\nwrite = 2\n\
             [[point]]\nname = \"status_word\"\nat = \"holding 3\"\nclass = \"fast\"\nhidden = true\n\
             [control]\nat = \"holding 0\"\n{lines}\n"
        );
        let profile = Profile::parse("p.toml", &text, false).unwrap();
        profile.control.unwrap()
    }

    fn words(control: &Control, of: impl Fn(&Control, ControlItem, u16) -> bool, all: &[u16]) -> Vec<u16> {
        let place = control.at;
        all.iter().copied().filter(|word| of(control, place, *word)).collect()
    }

    /// The direction in the word of a sequence does not make it another command.
    #[test]
    fn a_run_command_reads_as_one_in_either_direction() {
        use crate::drive::profile::Profiles;
        use crate::drive::{Derived, ModelPoint, Source};

        for (name, forward, reverse) in [("schneider-altivar", 0x000F, 0x080F), ("siemens-g120", 0x047F, 0x0C7F)] {
            let profile = Profiles::built_in().get(name).unwrap().clone();
            let read = |point: ModelPoint, word: u64| match &profile.model_point(point).unwrap().source {
                Source::Derived(Derived::State { any }) => any.iter().any(|state| state.holds(word)),
                other => panic!("{name}: {other:?}"),
            };
            assert!(
                read(ModelPoint::Run, forward) && read(ModelPoint::Run, reverse),
                "{name}"
            );
            assert!(
                !read(ModelPoint::Reverse, forward) && read(ModelPoint::Reverse, reverse),
                "{name}"
            );
            assert!(!read(ModelPoint::Run, forward & !9), "{name}");
        }
    }

    /// Words that run and stop, taken by hand from the manuals' figures (`control-words.md`), for each form.
    #[test]
    fn words_that_run_and_stop() {
        let sequence = control(
            "always = { set = [1, 2, 3, 4, 5, 6, 10] }\nstop = { bit = 0, is = 0 }\nreverse = { bit = 11 }\n\
             run = { steps = [{ write = 0x047E, until = { point = \"status_word\", mask = 0x41, is = 1 } }, { write = 0x047F }] }\n\
             fault_reset = { mask = 0x81, value = 0x80 }",
        );
        let all = [0x0000, 0x047E, 0x047F, 0x0C7F, 0x04FE, 0x0476, 0x0477, 0x0C7E];
        assert_eq!(words(&sequence, Control::is_run, &all), [0x047F, 0x0C7F]);
        assert_eq!(
            words(&sequence, Control::is_stop, &all),
            [0x0000, 0x047E, 0x04FE, 0x0476, 0x0C7E]
        );
        assert_eq!((sequence.stop_word(0x0C7F), sequence.stop_word(0)), (0x0C7E, 0x047E));

        let pair = control("run = { forward_bit = 0, reverse_bit = 1 }\nstop = { mask = 3, value = 0 }");
        let all = [0, 1, 2, 3, 8, 9];
        assert_eq!(words(&pair, Control::is_run, &all), [1, 2, 9], "never both");
        assert_eq!(words(&pair, Control::is_stop, &all), [0, 8]);
        assert_eq!(pair.stop_word(2), 0, "reverse, too");

        let codes = control("run = { forward = 0x12, reverse = 0x22, once = true }\nstop = { mask = 3, value = 1 }");
        let all = [0, 1, 2, 0x12, 0x22, 0x11];
        assert_eq!(words(&codes, Control::is_run, &all), [0x12, 0x22]);
        assert_eq!(words(&codes, Control::is_stop, &all), [1, 0x11], "0 stops nothing");
    }
}
