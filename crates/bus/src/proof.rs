//! Proves the commands of a profile with `[control]`: every state of a drive, every command, each frame lost,
//! refused or repeated, a stop and the end of its time limit at every step. The proof runs the command code of the
//! bus itself ([`super::command_run`]), not a copy, against the worst drive that matches the profile. Pure: the
//! clock is only read once, for the start of virtual time.

mod drive;
mod frame;

use std::sync::Arc;
use std::time::{Duration, Instant};

use self::drive::{Drive, Start};
use self::frame::{Fate, Frame, different, in_words};
use super::command_run::{CommandRun, KnownWords, Next, Step, StepPurpose};
use drivegate_core::order::{
    Admitted, Arrival, Command, CommandLog, Order, Origin, Outcome, SourceKind, Ticket, Urgency, Window, written,
};
use drivegate_model::drive::control::{Control, ControlItem, OwnWord, Run, Setting};
use drivegate_model::drive::{DriveIndex, ModelPoint, PointIndex, Profile, Value};
use drivegate_proto::{Exception, Reply, Table};

/// Maximum number of requests of a command, including the reads of a state that it waits for; a command that sends more
/// has no end.
const MOST_FRAMES: usize = 1000;
/// Duration of a request, and the pause before a state is read again.
const EXCHANGE: Duration = Duration::from_millis(10);
const LOOK_AGAIN: Duration = Duration::from_secs(1);
/// Longer than the steps of any sequence may wait.
const LONGEST: Duration = Duration::from_secs(600);

/// The extent of a proof without a counterexample.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Proof {
    /// Number of commands that were run to their end.
    pub commands: usize,
    /// Number of requests that the commands sent.
    pub frames: usize,
}

/// A case in which a command does something that it must not do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Counterexample {
    /// What the command did wrong, as text.
    pub what: String,
    /// State of the drive before the command.
    pub state: String,
    pub command: String,
    /// The requests of the case with their words in hex, and their results.
    pub frames: Vec<String>,
}

impl std::fmt::Display for Counterexample {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(f, "{}", self.what)?;
        writeln!(f, "  drive    {}", self.state)?;
        write!(f, "  command  {}", self.command)?;
        for frame in &self.frames {
            write!(f, "\n  frame    {frame}")?;
        }
        Ok(())
    }
}

impl Counterexample {
    pub fn line(&self) -> String {
        let frames = self.frames.join(", then ");
        let Counterexample {
            what, state, command, ..
        } = self;
        if frames.is_empty() {
            format!("{what} (drive {state}; command {command})")
        } else {
            format!("{what} (drive {state}; command {command}; {frames})")
        }
    }
}

const FATES: [Fate; 9] = [
    Fate::RequestLost,
    Fate::ReplyLost,
    Fate::Repeated,
    Fate::Refused(Exception::FUNCTION),
    Fate::Refused(Exception::ADDRESS),
    Fate::Refused(Exception::VALUE),
    Fate::Refused(Exception::DEVICE_FAILURE),
    Fate::Refused(Exception::ACKNOWLEDGE),
    Fate::Refused(Exception::BUSY),
];

/// Incidents in between, after that many requests.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Event {
    None,
    Fate(usize, Fate),
    Stop(usize),
    Expiry(usize),
}

/// A command as the points that it sets.
type Sets = &'static [(ModelPoint, bool)];

const STOP: Sets = &[(ModelPoint::Run, false)];

const COMMANDS: [Sets; 10] = [
    STOP,
    &[(ModelPoint::Run, false), (ModelPoint::Reverse, false)],
    &[(ModelPoint::Run, true)],
    &[(ModelPoint::Run, true), (ModelPoint::Reverse, true)],
    &[(ModelPoint::Run, true), (ModelPoint::Reverse, false)],
    &[(ModelPoint::Reverse, true)],
    &[(ModelPoint::Reverse, false)],
    &[(ModelPoint::FaultReset, true)],
    &[(ModelPoint::FaultReset, true), (ModelPoint::Reverse, true)],
    &[(ModelPoint::FaultReset, true), (ModelPoint::Run, true)],
];

/// Proves the profile, whether it is commanded by `[control]` or by points of one bit each; a profile without
/// commands needs no proof.
///
/// # Errors
/// If the profile fails the proof; contains a counterexample.
pub fn prove(profile: &Profile) -> Result<Proof, Box<Counterexample>> {
    let Some(control) = &profile.control else {
        return Ok(Proof::default());
    };
    overlaps(profile)?;
    explore(profile, control)
}

fn explore(profile: &Profile, control: &Control) -> Result<Proof, Box<Counterexample>> {
    let mut proof = Proof::default();
    for start in Start::all(control) {
        for known in [true, false] {
            let commands = COMMANDS
                .iter()
                .map(|sets| Case::new(profile, control, start, known, sets));
            let words = control.also_stop.iter();
            let words = words.map(|stop| Case::of_word(profile, control, start, known, stop));
            for case in commands.chain(words).flatten() {
                let frames = case.run(Event::None)?;
                proof.add(frames.len());
                for number in different(&frames) {
                    for fate in FATES {
                        proof.add(case.run(Event::Fate(number, fate))?.len());
                    }
                    proof.add(case.run(Event::Stop(number + 1))?.len());
                    proof.add(case.run(Event::Expiry(number + 1))?.len());
                }
            }
        }
    }
    Ok(proof)
}

impl Proof {
    fn add(&mut self, frames: usize) {
        self.commands += 1;
        self.frames += frames;
    }
}

/// Checks that neither a writable point nor a parameter shares a register with the commands, except a point with
/// its own bits in a word whose other bits are kept.
fn overlaps(profile: &Profile) -> Result<(), Box<Counterexample>> {
    let found = |what: String, command: String| {
        Err(Box::new(Counterexample {
            what: format!("{what} writes into the control word, past [control]"),
            state: "any".to_string(),
            command,
            frames: Vec::new(),
        }))
    };
    for (index, point) in profile.points.enumerate() {
        if point.is_commanded() && profile.is_past_commands(index) {
            return found(format!("point `{}`", point.name), format!("{} = …", point.name));
        }
    }
    for parameter in &profile.parameters.named {
        if profile.commands_in(parameter.address, 1) {
            return found(
                format!("parameter {}", parameter.id),
                format!("params restore of {}", parameter.id),
            );
        }
    }
    Ok(())
}

/// A command to a drive in one state.
#[derive(Debug)]
struct Case<'p> {
    profile: &'p Profile,
    control: &'p Control,
    start: Start,
    /// Whether the gateway knows the control word at the start of the case.
    known: bool,
    sets: Sets,
    order: Order,
}

/// The progress of a proof's case.
struct Progress<'p> {
    drive: Drive<'p>,
    words: KnownWords,
    now: Instant,
    frames: Vec<Frame>,
    /// When the reset bit was set.
    reset_at: Option<Instant>,
    /// Whether the motor ran when the command was given, or was running at a stop in between.
    ran: bool,
}

impl<'p> Case<'p> {
    /// A case of the proof; `None` if the profile lacks one of the points, or its drives have no such state.
    fn new(profile: &'p Profile, control: &'p Control, start: Start, known: bool, sets: Sets) -> Option<Case<'p>> {
        Drive::new(profile, control, start)?;
        let values = sets
            .iter()
            .map(|(point, on)| Some((profile.model_index(*point)?, Value::Bool(*on))));
        let values: Option<Vec<(PointIndex, Value)>> = values.collect();
        Some(Case {
            profile,
            control,
            start,
            known,
            sets,
            order: Order::Points(values?),
        })
    }

    /// A run command with these bits, written raw: a stop.
    fn of_word(
        profile: &'p Profile,
        control: &'p Control,
        start: Start,
        known: bool,
        stop: &Setting,
    ) -> Option<Case<'p>> {
        let reverse = start == Start::Running { reverse: true };
        let running = Drive::new(profile, control, Start::Running { reverse })?;
        let word = stop.applied(running.word(control.at));
        let pdu = profile.functions.write_register(control.at.address, word);
        let case = Case::new(profile, control, start, known, STOP)?;
        Some(Case {
            order: Order::Write(pdu),
            ..case
        })
    }

    fn is_raw(&self) -> bool {
        matches!(self.order, Order::Write(_))
    }

    fn shows(&self, point: ModelPoint) -> Option<bool> {
        self.sets.iter().find(|(of, _)| *of == point).map(|(_, on)| *on)
    }

    fn is_stop(&self) -> bool {
        self.shows(ModelPoint::Run) == Some(false)
    }

    fn begin(&self, order: Order, urgency: Urgency, now: Instant, expires: Instant) -> CommandRun {
        let origin = Origin::new(SourceKind::LocalSocket, "proof");
        let (ticket, _) = Ticket::new(origin, "", String::new(), false, now, Arc::new(CommandLog::default()));
        let admitted = Admitted {
            order,
            urgency,
            reference_only: false,
            ranges: Vec::new(),
        };
        let window = Window {
            arrival: Arrival::now(now),
            expires,
            waits: false,
        };
        let command = Command::new(DriveIndex::new(0), admitted, self.profile, window, ticket);
        CommandRun::new(command, self.profile)
    }

    /// Runs the command to its end while this event happens; returns its requests.
    fn run(&self, event: Event) -> Result<Vec<Frame>, Box<Counterexample>> {
        let now = Instant::now();
        let Some(drive) = Drive::new(self.profile, self.control, self.start) else {
            return Ok(Vec::new());
        };
        let mut progress = Progress {
            ran: drive.running.is_some(),
            drive,
            words: KnownWords::default(),
            now,
            frames: Vec::new(),
            reset_at: None,
        };
        if self.known {
            // The gateway still knows a restarted drive in the state from when it ran.
            let before = match self.start {
                Start::RestartedSince => Drive::new(self.profile, self.control, Start::Running { reverse: false }),
                _ => None,
            };
            let at = self.control.at;
            let word = before.as_ref().unwrap_or(&progress.drive).word(at);
            progress.words.learn(at.table, at.address, word);
        }
        let urgency = if self.is_stop() {
            Urgency::Stop
        } else {
            Urgency::Command
        };
        let expires = now + LONGEST;
        let mut run = self.begin(self.order.clone(), urgency, now, expires);
        let mut stopped = false;
        let mut late = Duration::ZERO;
        let outcome = loop {
            let sent = progress.frames.len();
            if event == Event::Stop(sent) && !std::mem::replace(&mut stopped, true) {
                let over = run.purge();
                self.stop_between(&mut progress)?;
                if let Some(outcome) = over {
                    break outcome;
                }
            }
            if event == Event::Expiry(sent) {
                late = LONGEST;
            }
            let fate = match event {
                Event::Fate(number, fate) if number == sent => Some(fate),
                _ => None,
            };
            match self.step(&mut run, &mut progress, fate, late, stopped)? {
                Some(outcome) => break outcome,
                None if progress.frames.len() > MOST_FRAMES || progress.now > expires => {
                    return Err(self.wrong("the command does not end", &progress));
                }
                None => {}
            }
        };
        self.judge(event, &outcome, &progress, stopped)?;
        Ok(progress.frames)
    }

    /// A stop in the middle of the command.
    fn stop_between(&self, progress: &mut Progress<'p>) -> Result<(), Box<Counterexample>> {
        let Some(run) = self.profile.model_index(ModelPoint::Run) else {
            return Ok(());
        };
        let expires = progress.now + LONGEST;
        let stop = Order::Points(vec![(run, Value::Bool(false))]);
        let mut stop = self.begin(stop, Urgency::Stop, progress.now, expires);
        progress.frames.push(Frame::Stop);
        for _ in 0..MOST_FRAMES {
            if self.step(&mut stop, progress, None, Duration::ZERO, true)?.is_some() {
                break;
            }
        }
        if progress.drive.running.is_some() {
            return Err(self.wrong("a stop in the middle of the command does not stop the motor", progress));
        }
        progress.ran = false;
        Ok(())
    }

    /// Takes one step of a command; returns the outcome if the command has ended.
    fn step(
        &self,
        run: &mut CommandRun,
        progress: &mut Progress<'p>,
        fate: Option<Fate>,
        late: Duration,
        stopped: bool,
    ) -> Result<Option<Outcome>, Box<Counterexample>> {
        let runs = progress.drive.running.is_some() && !progress.drive.fault;
        let running = runs || self.start.has_stopped();
        let step = match run.next(&progress.words, self.profile, running, progress.now + late) {
            Next::Done => return Ok(Some(run.success())),
            Next::Wait(until) => {
                progress.now = until.checked_sub(late).unwrap_or(until).max(progress.now);
                return Ok(None);
            }
            Next::Send(step) => step,
        };
        run.sent(&step);
        self.note(&step, fate, progress)?;
        // A run command that is set anyway is not counted as given by the word that keeps it.
        let stood = self
            .control
            .is_run(self.control.at, progress.drive.word(self.control.at));
        let reply = match fate {
            Some(Fate::RequestLost | Fate::Refused(_)) => None,
            Some(Fate::Repeated) => {
                progress.drive.receives(&step.pdu);
                Some(progress.drive.receives(&step.pdu))
            }
            Some(Fate::ReplyLost) | None => Some(progress.drive.receives(&step.pdu)),
        };
        // Repeated reads of the drive's state change nothing, so a few of them are enough.
        let again = progress.frames.iter().rev().take(2).all(Frame::is_read) && progress.frames.len() > 1;
        progress.now += if again { LOOK_AGAIN } else { EXCHANGE };
        self.check(&step, progress, stopped, stood)?;
        if step.purpose == StepPurpose::Look && matches!(fate, None | Some(Fate::Repeated)) {
            run.set_motor_state(runs);
            return Ok(None);
        }
        Ok(match (fate, reply) {
            (Some(Fate::Refused(code)), _) if step.pdu.is_write() && code.leaves_open() => {
                run.failed(&step, Outcome::Unknown(code), 1)
            }
            (Some(Fate::Refused(code)), _) => run.answered(&step, Reply::Exception(code), &mut progress.words),
            (Some(Fate::RequestLost | Fate::ReplyLost), _) | (_, None) => run.failed(&step, Outcome::TimedOut, 1),
            (_, Some(reply)) => run.answered(&step, reply, &mut progress.words),
        })
    }

    /// Keeps the frame, and checks whether a pulse lasted long enough.
    fn note(&self, step: &Step, fate: Option<Fate>, progress: &mut Progress<'p>) -> Result<(), Box<Counterexample>> {
        progress.frames.push(Frame::Request(step.pdu.clone(), fate));
        let Some(reset) = self.control.fault_reset else {
            return Ok(());
        };
        let Some((table, items)) = written(&step.pdu) else {
            return Ok(());
        };
        let place = reset.setting.place.unwrap_or(self.control.at);
        let word = items
            .iter()
            .find(|(address, _)| (table, *address) == (place.table, place.address));
        let Some((_, word)) = word else { return Ok(()) };
        if reset.setting.holds(*word) {
            progress.reset_at = Some(progress.now);
        } else if let Some(at) = progress.reset_at.take()
            && progress.now.saturating_duration_since(at) < reset.pulse
            && !reset.setting.once
            && !self.control.is_stop(place, *word)
        {
            return Err(self.wrong("the pulse of a reset is too short", progress));
        }
        Ok(())
    }

    /// Checks what must hold after every request.
    fn check(
        &self,
        step: &Step,
        progress: &Progress<'p>,
        stopped: bool,
        stood: bool,
    ) -> Result<(), Box<Counterexample>> {
        let starts = self.shows(ModelPoint::Run) == Some(true) && !stopped;
        if progress.drive.running.is_some() && !progress.ran && !starts {
            return Err(self.wrong("the motor starts without a run command", progress));
        }
        let Some((table, items)) = written(&step.pdu) else {
            return Ok(());
        };
        for (address, word) in items {
            let place = ControlItem { table, address };
            let own = place == self.control.at && !is_coil(place) && !self.is_raw();
            if own && !self.keeps_always(word) {
                return Err(self.wrong("a word lacks a bit of `always`", progress));
            }
            if self.says_both(place, word) {
                return Err(self.wrong("forward and reverse are set together", progress));
            }
            if place == self.control.at && self.control.is_run(place, word) && !stood && !starts && !progress.ran {
                return Err(self.wrong("a word that runs the drive is sent without a run command", progress));
            }
        }
        Ok(())
    }

    fn keeps_always(&self, word: u16) -> bool {
        // A complete word from the profile is exempt, as the profile requires it to be written unchanged.
        let wholes = self.control.runs().into_iter().chain([self.control.stop]);
        let mut wholes = wholes.chain(self.control.fault_reset.map(|reset| reset.setting));
        self.control.always.holds(word) || wholes.any(|setting| setting.mask == u16::MAX && setting.value == word)
    }

    fn says_both(&self, place: ControlItem, word: u16) -> bool {
        let Run::Pair { forward, reverse } = &self.control.run else {
            return false;
        };
        let here = |setting: &Setting| setting.place.unwrap_or(self.control.at) == place;
        let (one, other) = (forward.value & !reverse.value, reverse.value & !forward.value);
        let bits = forward.mask.count_ones() < 16 && one != 0 && other != 0;
        bits && here(forward) && word & one == one && word & other == other
    }

    /// Checks what must hold when the command has ended.
    fn judge(
        &self,
        event: Event,
        outcome: &Outcome,
        progress: &Progress<'p>,
        stopped: bool,
    ) -> Result<(), Box<Counterexample>> {
        let runs = progress.drive.running.is_some();
        if (self.is_stop() && outcome.is_ok() || stopped) && runs {
            return Err(self.wrong("the motor runs after a stop", progress));
        }
        if self.is_stop() && event == Event::None {
            // Other bits of a word must be kept, which needs a read first if the word is unknown.
            let reads = usize::from(self.control.own_word == OwnWord::Kept && !self.known);
            let first = progress.frames.iter().take(1 + reads).find(|frame| frame.is_write());
            if !outcome.is_ok() || runs || first.is_none() {
                return Err(self.wrong("a stop does not stop the motor in one request", progress));
            }
        }
        // A drive that refuses the end of the pulse answers with an exception.
        if progress.drive.reset_is_set() && !matches!(outcome, Outcome::Exception(_)) {
            return Err(self.wrong("a reset bit is left set", progress));
        }
        let sequence = matches!(self.control.run, Run::Steps(_));
        let refused = matches!(outcome, Outcome::Exception(_) | Outcome::Refused(_));
        // A drive that was stopped at its panel starts at any write of a run command.
        let late = self.start == Start::StoppedSince && self.shows(ModelPoint::Run) == Some(true);
        if !outcome.is_ok() && runs && !progress.ran && !late && (sequence || refused) {
            return Err(self.wrong("the command failed but the motor runs", progress));
        }
        if event != Event::None {
            return Ok(());
        }
        self.judge_effect(outcome, progress)
    }

    /// Checks that an undisturbed command has its effect.
    fn judge_effect(&self, outcome: &Outcome, progress: &Progress<'p>) -> Result<(), Box<Counterexample>> {
        use Start::{PoweredUp, Prepared, Stopped, StoppedOtherwise};
        let stands = matches!(self.start, PoweredUp | Stopped | Prepared | StoppedOtherwise(_));
        let starts = self.shows(ModelPoint::Run) == Some(true);
        let direction = self.shows(ModelPoint::Reverse);
        if starts && stands {
            if !outcome.is_ok() || progress.drive.running.is_none() {
                return Err(self.wrong("a run command does not start the motor", progress));
            }
            // Without a direction in the order, a word that is not known anywhere turns the motor forward.
            let unasked =
                !self.known && self.control.own_word == OwnWord::Shadow || self.control.direction_elsewhere().is_some();
            let wanted = direction.or(unasked.then_some(false));
            if wanted.is_some_and(|reverse| progress.drive.running != Some(reverse)) {
                return Err(self.wrong("the motor runs in the wrong direction", progress));
            }
        }
        let resets = self.shows(ModelPoint::FaultReset) == Some(true);
        use Start::{FaultedRunning, FaultedSince, FaultedStopped};
        let faulted = matches!(self.start, FaultedRunning | FaultedStopped | FaultedSince);
        if resets && faulted && progress.drive.fault {
            return Err(self.wrong("a reset does not reset the fault", progress));
        }
        Ok(())
    }

    fn wrong(&self, what: &str, progress: &Progress<'p>) -> Box<Counterexample> {
        let known = if self.known {
            ""
        } else {
            "; the gateway does not know its control word"
        };
        let sets = self.sets.iter().map(|(point, on)| format!("{} = {on}", point.name()));
        let command = match &self.order {
            Order::Write(pdu) => in_words(pdu),
            _ => sets.collect::<Vec<_>>().join(", "),
        };
        Box::new(Counterexample {
            what: what.to_string(),
            state: format!("{}{known}", self.start.in_words()),
            command,
            frames: progress.frames.iter().map(Frame::to_string).collect(),
        })
    }
}

fn is_coil(place: ControlItem) -> bool {
    matches!(place.table, Table::Coil | Table::DiscreteInput)
}

#[cfg(test)]
mod tests;
