//! The drive in a proof: the worst behaviour of a drive with such a profile. It starts whenever a run command is
//! set and nothing prevents it, and keeps turning until a stop arrives. Pure.

use std::collections::BTreeMap;

use drivegate_core::order::written;
use drivegate_model::drive::control::{Control, ControlItem, Run, Setting, Step, Until};
use drivegate_model::drive::{PointIndex, Profile};
use drivegate_proto::{Reply, RequestPdu};

/// The state in which a proof begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Start {
    /// Just switched on: every register holds 0.
    PoweredUp,
    /// The drive was stopped by the gateway.
    Stopped,
    /// The drive has received all words of its start sequence except the last.
    Prepared,
    Running {
        reverse: bool,
    },
    /// A fault occurred while the motor ran: the run command is still set.
    FaultedRunning,
    FaultedStopped,
    /// The drive was stopped by another word of the profile, the one with this index.
    StoppedOtherwise(usize),
    /// The motor ran at the last poll, and a fault has occurred since.
    FaultedSince,
    /// The motor ran at the last poll, and the drive has been switched off and on since.
    RestartedSince,
    /// The motor ran at the last poll and has been stopped at the panel since; it starts whenever a command is
    /// written while its word is a run command.
    StoppedSince,
    /// The control word is a run command except for the bits of `always`.
    WithoutAlways,
    /// The drive is under panel control; the gateway's word is a stop.
    Local,
    /// The drive is under panel control; the gateway's word is a run command.
    LocalRunning,
}

impl Start {
    /// Every state that a drive of this profile can have.
    pub(super) fn all(control: &Control) -> Vec<Start> {
        let mut all = vec![
            Start::PoweredUp,
            Start::Stopped,
            Start::Prepared,
            Start::Running { reverse: false },
            Start::Running { reverse: true },
            Start::FaultedRunning,
            Start::FaultedStopped,
            Start::FaultedSince,
            Start::RestartedSince,
            Start::StoppedSince,
            Start::WithoutAlways,
            Start::Local,
            Start::LocalRunning,
        ];
        all.extend((0..control.also_stop.len()).map(Start::StoppedOtherwise));
        all
    }

    /// Whether the last poll showed the motor running, and it has stopped since.
    pub(super) fn has_stopped(self) -> bool {
        matches!(self, Start::FaultedSince | Start::RestartedSince | Start::StoppedSince)
    }

    pub(super) fn in_words(self) -> &'static str {
        match self {
            Start::PoweredUp => "just powered up",
            Start::Stopped => "stopped by the gateway",
            Start::Prepared => "prepared to run",
            Start::Running { reverse: false } => "running forward",
            Start::Running { reverse: true } => "running in reverse",
            Start::FaultedRunning => "faulted, the run command still set",
            Start::FaultedStopped => "faulted and stopped",
            Start::FaultedSince => "faulted since the last poll, the run command still set",
            Start::RestartedSince => "restarted since the last poll, when it ran",
            Start::StoppedSince => "stopped at its panel since the last poll, when it ran",
            Start::WithoutAlways => "stopped, its word a run command without the bits of `always`",
            Start::StoppedOtherwise(_) => "stopped by a word of `also_stop`",
            Start::Local => "commanded at its panel, stopped",
            Start::LocalRunning => "commanded at its panel, the run command still set",
        }
    }
}

#[derive(Debug, Clone)]
pub(super) struct Drive<'p> {
    profile: &'p Profile,
    control: &'p Control,
    words: BTreeMap<(u8, u16), u16>,
    /// Number of steps of the sequence that the drive has taken.
    prepared: usize,
    /// The direction in which the motor runs: `true` is reverse; `None` if it does not run.
    pub(super) running: Option<bool>,
    pub(super) fault: bool,
    local: bool,
}

fn key(place: ControlItem) -> (u8, u16) {
    (place.table as u8, place.address)
}

impl<'p> Drive<'p> {
    /// A drive in this state; `None` if drives of the profile cannot have it.
    pub(super) fn new(profile: &'p Profile, control: &'p Control, start: Start) -> Option<Drive<'p>> {
        let mut drive = Drive {
            profile,
            control,
            words: BTreeMap::new(),
            prepared: 0,
            running: None,
            fault: false,
            local: false,
        };
        let reverse = start == Start::Running { reverse: true };
        if reverse && control.reverse.is_none() && !matches!(control.run, Run::Pair { .. }) {
            return None;
        }
        let steps = drive.steps().len();
        match start {
            Start::PoweredUp | Start::RestartedSince => {}
            Start::Stopped | Start::FaultedStopped | Start::Local => drive.put_stop(),
            Start::Prepared => {
                let last = steps.checked_sub(2)?;
                let word = drive.steps().get(last)?.write;
                drive.put(word.place.unwrap_or(control.at), word.value);
                drive.prepared = last + 1;
            }
            Start::Running { .. } | Start::FaultedRunning | Start::FaultedSince | Start::LocalRunning => {
                drive.prepared = steps;
                drive.put_run(reverse);
                drive.running = Some(reverse);
            }
            Start::StoppedSince => {
                drive.prepared = steps;
                drive.put_run(reverse);
            }
            Start::WithoutAlways => {
                drive.prepared = steps;
                drive.put_run(reverse);
                let without = drive.word(control.at) & !control.always.set;
                let is_other = without != drive.word(control.at) && !control.is_run(control.at, without);
                drive.put(control.at, is_other.then_some(without)?);
            }
            Start::StoppedOtherwise(number) => {
                drive.prepared = steps;
                drive.put_run(reverse);
                let stop = control.also_stop.get(number)?;
                drive.put(control.at, stop.applied(drive.word(control.at)));
            }
        }
        use Start::{FaultedRunning, FaultedSince, FaultedStopped};
        drive.fault = matches!(start, FaultedRunning | FaultedStopped | FaultedSince);
        drive.local = matches!(start, Start::Local | Start::LocalRunning);
        if drive.fault || drive.local {
            (drive.running, drive.prepared) = (None, 0);
        }
        Some(drive)
    }

    fn steps(&self) -> &'p [Step] {
        match &self.control.run {
            Run::Steps(steps) => steps,
            _ => &[],
        }
    }

    fn put(&mut self, place: ControlItem, word: u16) {
        self.words.insert(key(place), word);
    }

    fn put_stop(&mut self) {
        let place = self.control.stop.place.unwrap_or(self.control.at);
        self.put(place, self.control.stop_word(0));
    }

    fn put_run(&mut self, reverse: bool) {
        let runs = self.control.runs();
        let run = if reverse { runs.last() } else { runs.first() };
        let Some(run) = run else { return };
        let own = self.control.always.applied(0);
        let word = self.control.with_direction(run.applied(own), reverse);
        self.put(run.place.unwrap_or(self.control.at), word);
        if let Some((setting, place)) = self.control.reverse.and_then(|setting| Some((setting, setting.place?))) {
            self.put(place, if reverse { setting.applied(0) } else { setting.undone(0) });
        }
    }

    /// The word in this register.
    pub(super) fn word(&self, place: ControlItem) -> u16 {
        self.words.get(&key(place)).copied().unwrap_or(0)
    }

    fn word_of(&self, setting: &Setting) -> u16 {
        self.word(setting.place.unwrap_or(self.control.at))
    }

    pub(super) fn reset_is_set(&self) -> bool {
        let reset = self.control.fault_reset;
        reset.is_some_and(|reset| !reset.setting.once && reset.setting.holds(self.word_of(&reset.setting)))
    }

    /// Processes a request and returns the reply.
    pub(super) fn receives(&mut self, pdu: &RequestPdu) -> Reply {
        if let RequestPdu::Read { table, start, count } = pdu {
            let word = |address| self.read(ControlItem { table: *table, address });
            let words: Vec<u64> = vec![word(*start)];
            let value = words.first().copied().unwrap_or(0);
            return match (table.is_bits(), count) {
                (true, _) => Reply::Bits(vec![value != 0; usize::from(*count)]),
                (false, 2) => Reply::Registers(vec![(value >> 16) as u16, value as u16]),
                (false, _) => Reply::Registers(vec![value as u16; usize::from(*count)]),
            };
        }
        if let Some((table, items)) = written(pdu) {
            for (address, word) in items {
                self.take_word(ControlItem { table, address }, word);
            }
        }
        Reply::Written
    }

    fn take_word(&mut self, place: ControlItem, word: u16) {
        let before = self.word(place);
        self.put(place, word);
        let here = |setting: &Setting| setting.place.unwrap_or(self.control.at) == place;
        if self.control.is_stop(place, word) {
            self.running = None;
            self.prepared = self.prepared.min(self.steps().len().saturating_sub(1));
        }
        let reset = self.control.fault_reset.map(|reset| reset.setting).filter(here);
        if reset.is_some_and(|reset| reset.holds(word) && (reset.once || !reset.holds(before))) {
            self.fault = false;
        }
        let once = self
            .control
            .runs()
            .iter()
            .any(|run| run.once && here(run) && self.control.is_run(place, word));
        self.step(place, word);
        if !self.fault && !self.local && (once || self.is_commanded()) {
            self.running = Some(self.direction());
        }
    }

    /// Processes a word of the sequence, if it is the next one or an earlier one.
    fn step(&mut self, place: ControlItem, word: u16) {
        let free = self
            .control
            .reverse
            .filter(|setting| setting.place.is_none())
            .map_or(0, |setting| setting.mask);
        let holds = |step: &Step| {
            let here = step.write.place.unwrap_or(self.control.at) == place;
            here && (word ^ step.write.value) & step.write.mask & !free == 0
        };
        let taken = self.steps().iter().take(self.prepared + 1).rposition(holds);
        if let Some(number) = taken.filter(|_| !self.fault && !self.local) {
            self.prepared = number + 1;
        }
    }

    /// Whether a run command that lasts longer than a pulse is in effect.
    fn is_commanded(&self) -> bool {
        let prepared = self.prepared >= self.steps().len();
        let stands = |run: &Setting| {
            let place = run.place.unwrap_or(self.control.at);
            !run.once && self.control.is_run(place, self.word(place))
        };
        let stopped = {
            let stop = &self.control.stop;
            stop.place.is_some() && stop.holds(self.word_of(stop))
        };
        prepared && !stopped && self.control.runs().iter().any(stands)
    }

    fn direction(&self) -> bool {
        if let Some(setting) = self
            .control
            .reverse
            .filter(|_| !matches!(self.control.run, Run::Pair { .. }))
        {
            return setting.holds(self.word_of(&setting));
        }
        match &self.control.run {
            Run::Pair { reverse, .. } => reverse.holds(self.word_of(reverse)),
            Run::One(_) | Run::Steps(_) => false,
        }
    }

    /// The content of a register: the control word, or a status word that follows from the steps and the motor.
    fn read(&self, place: ControlItem) -> u64 {
        if let Some(word) = self.words.get(&key(place)) {
            return u64::from(*word);
        }
        let is_here = |point: PointIndex| {
            let raw = self.profile.points.get(point).and_then(|point| point.raw());
            raw.is_some_and(|raw| (raw.table, raw.address) == (place.table, place.address))
        };
        let states = self.steps().iter().map(|step| step.until);
        let states: Vec<_> = states
            .map(|until| match until {
                Until::State(mask) if is_here(mask.point) => Some(mask),
                _ => None,
            })
            .collect();
        let reached = states.iter().take(self.prepared).flatten().next_back();
        match (reached, states.iter().flatten().next()) {
            (Some(mask), _) => mask.is,
            (None, Some(first)) => !first.is & first.mask,
            (None, None) => 0,
        }
    }
}
