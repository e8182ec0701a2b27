//! A drill that is armed or under way, step by step.

mod interruption;

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use tokio::sync::broadcast::Receiver;

use self::interruption::{LOCAL, is_local};
use super::{ARMED, DrillOptions, DrillReport, DrillState, DrillStep, Kind, Proof};
use crate::command::{AuditRecord, Authority, Order, Origin, Outcome, Refusal, SourceKind};
use crate::drive::{ModelPoint, Value};
use crate::event::{Event, EventKind};
use crate::plant::{DriveHandle, Placed, Plant};
use crate::process_image::{Machine, Reading};
use crate::stop_all::{OneStop, Standstill};

/// Time in which the start of a drill has to be on disk. A motor that starts later starts when nobody expects it.
const KEEP: Duration = Duration::from_secs(5);
/// Time in which a start is sent: a guard may delay it.
const START: Duration = Duration::from_secs(60);
/// Time for which a start is repeated that was refused since a value was not read yet, and the pause before each repetition.
const START_AGAIN: Duration = Duration::from_secs(15);
const AGAIN: Duration = Duration::from_millis(500);
/// Time in which the motor has to turn at its speed.
const SPEED_UP: Duration = Duration::from_secs(60);
/// Time for which it turns at its speed before it is stopped.
const STEADY: Duration = Duration::from_secs(2);
/// Share of its speed from which it turns at it.
const AT_SPEED: f64 = 0.8;
/// Where the drive does not tell its speed in percent, the motor turns at it so long after it began.
const UNTOLD_SPEED: Duration = Duration::from_secs(10);
/// Time after a silence in which a read has to come.
const READ: Duration = Duration::from_secs(15);
/// Time in which the last stop has to be acknowledged, and the motor to stand for the next way.
const LAST_STOP: Duration = Duration::from_secs(60);
/// Age up to which the motor of a drill that was cut off is stopped at the next start. Later somebody may have started it since.
const CUT_OFF: Duration = Duration::from_secs(3600);

/// A drill that is armed or under way.
#[derive(Debug)]
pub(super) struct Run {
    report: DrillReport,
    machine: Machine,
    drive: DriveHandle,
    /// Who armed it.
    who: Origin,
    /// The same, as the orders of the drill name it.
    own: Origin,
    options: DrillOptions,
    records: Option<Receiver<Arc<AuditRecord>>>,
    /// Stops that the drive has got, as far as the drill expects them.
    stops: u64,
    step: Step,
    since: Instant,
    /// When the way that is tried began.
    began: Instant,
    /// Place of the way that is tried.
    at: usize,
    proofs: Vec<Proof>,
}

/// What the drill does.
#[derive(Debug)]
enum Step {
    Armed,
    /// That it starts is being written to disk, as that generation: so a motor that a killed gateway leaves running is known.
    Keeping(u64),
    /// The start was refused, and is repeated.
    Waiting,
    /// The start is on its way to the drive.
    Starting(Placed),
    /// The motor has its start; when it was first seen to turn.
    SpeedingUp(Option<Instant>),
    /// It turns at its speed.
    Steady,
    /// It is to stop since then.
    Caused(Instant, Cause),
    /// The way was tried; the motor is stopped in any case.
    Clearing(OneStop),
    /// The gateway was killed during it: the motor is stopped once the drive is online.
    CutOff,
    /// The drill is over, and has ended so, but for its last stop.
    Ending(DrillState, OneStop),
    Over,
}

/// What is to stop the motor.
#[derive(Debug)]
enum Cause {
    Order(Placed),
    /// Its client is silent; whether its lease has stopped it.
    Client {
        stopped: bool,
    },
    /// Nothing is sent to the drive until then.
    Gateway(Instant),
}

/// What becomes of a way that is tried.
enum Seen {
    Nothing,
    Stood { took: Duration, upper_bound: bool },
    Ended(DrillState, String),
}

/// What is said of a drill during which the gateway was killed.
const CUT_OFF_TEXT: &str = "the gateway was killed or lost power during it";

/// Ends the report of a drill that was cut off without a stop, and says why there is none.
pub(super) fn ended_without_stop(mut report: DrillReport, why: &str, time: SystemTime) -> Ended {
    report.state = DrillState::Aborted;
    report.text = format!("{CUT_OFF_TEXT}; {why}; look at the motor");
    report.ended_at = Some(text_of(time));
    for step in report.steps.iter_mut().filter(|step| !step.state.is_over()) {
        step.state = DrillState::NotProven;
        step.seen = CUT_OFF_TEXT.to_string();
    }
    Ended {
        who: Origin::new(SourceKind::Shutdown, "drill cut off"),
        report,
    }
}

/// Whether a drill that was cut off is so young that its motor is stopped. A clock that was set back makes none old.
pub(super) fn is_recent(report: &DrillReport, time: SystemTime) -> bool {
    let started = report
        .started_at
        .as_deref()
        .and_then(|at| humantime::parse_rfc3339(at).ok());
    started.is_none_or(|started| time.duration_since(started).unwrap_or_default() <= CUT_OFF)
}

/// A client in words.
pub(super) fn named(who: &Origin) -> String {
    format!("{} {}", who.kind.name(), who.who)
}

fn text_of(time: SystemTime) -> String {
    humantime::format_rfc3339_millis(time).to_string()
}

impl Run {
    pub(super) fn armed(
        drive: &DriveHandle,
        (kinds, speed): (&[Kind], f64),
        options: DrillOptions,
        who: &Origin,
        (now, time): (Instant, SystemTime),
    ) -> Run {
        let spec = &drive.image.spec;
        let machine = drive.machine();
        let step = |kind: &Kind| DrillStep {
            kind: *kind,
            state: DrillState::Armed,
            cause_at: None,
            took_ms: None,
            upper_bound: false,
            seen: String::new(),
        };
        // A drive that stopped since its gateway fell silent has a fault: that way is tried last.
        let kinds = Kind::ALL.iter().filter(|kind| kinds.contains(kind));
        let stamp: String = text_of(time).chars().filter(|c| !matches!(c, '-' | ':')).collect();
        let report = DrillReport {
            id: format!("{stamp}-{}", spec.name),
            drive: spec.name.clone(),
            bus: spec.bus.clone(),
            port: machine.port.clone(),
            address: machine.address,
            profile: machine.profile.clone(),
            who: named(who),
            state: DrillState::Armed,
            text: format!("start it within {} s", ARMED.as_secs()),
            speed,
            max_speed: options.max_speed,
            limit_ms: u64::try_from(options.limit.as_millis()).unwrap_or(u64::MAX),
            armed_at: text_of(time),
            started_at: None,
            ended_at: None,
            last_stop: None,
            steps: kinds.map(step).collect(),
        };
        Run {
            own: who.clone().acting(format!("drill of {}", who.who)),
            who: who.clone(),
            report,
            machine,
            drive: drive.clone(),
            options,
            records: None,
            stops: 0,
            step: Step::Armed,
            since: now,
            began: now,
            at: 0,
            proofs: Vec::new(),
        }
    }

    /// A drill during which the gateway was killed: its motor may still run.
    pub(super) fn cut_off(report: DrillReport, drive: &DriveHandle, now: Instant) -> Run {
        let own = Origin::new(SourceKind::Shutdown, "drill cut off");
        let at = report.steps.iter().position(|step| step.state == DrillState::Running);
        Run {
            at: at.unwrap_or(report.steps.len()),
            machine: report.machine(),
            options: DrillOptions {
                max_speed: report.max_speed,
                limit: Duration::from_millis(report.limit_ms),
                every: Duration::MAX,
            },
            report,
            drive: drive.clone(),
            who: own.clone(),
            own,
            records: None,
            stops: 0,
            step: Step::CutOff,
            since: now,
            began: now,
            proofs: Vec::new(),
        }
    }

    pub(super) fn report(&self) -> &DrillReport {
        &self.report
    }

    pub(super) fn drive(&self) -> &DriveHandle {
        &self.drive
    }

    pub(super) fn is_of(&self, who: &Origin) -> bool {
        self.who.client() == who.client()
    }

    /// Whether it was armed and not started in time; it is over then.
    pub(super) fn expires(&mut self, now: Instant, time: SystemTime) -> bool {
        let expired = matches!(self.step, Step::Armed) && now.saturating_duration_since(self.since) > ARMED;
        if expired {
            self.finish(
                DrillState::Aborted,
                format!("it was not started within {} s", ARMED.as_secs()),
                time,
            );
        }
        expired
    }

    pub(super) fn over(self) -> (Ended, Vec<Proof>) {
        let ended = Ended {
            who: self.who,
            report: self.report,
        };
        (ended, self.proofs)
    }

    /// Starts it; where drills are kept, the motor starts once generation `keep` is on disk.
    pub(super) fn start(&mut self, plant: &Plant, keep: Option<u64>, now: Instant, time: SystemTime) {
        self.records = Some(plant.writes.audit().subscribe());
        self.stops = self.drive.stops();
        self.report.state = DrillState::Running;
        self.report.started_at = Some(text_of(time));
        match keep {
            Some(generation) => {
                self.report.text = "recording the start on disk".to_string();
                self.go(Step::Keeping(generation), now);
            }
            None => self.begin_step(now),
        }
    }

    /// What was started before generation `kept` was written may begin.
    pub(super) fn kept(&mut self, kept: u64, now: Instant) {
        if matches!(self.step, Step::Keeping(generation) if generation <= kept) {
            self.begin_step(now);
        }
    }

    /// Its start cannot be written: nothing is started. Whether it was waiting for that.
    pub(super) fn not_kept(&mut self, why: &str, time: SystemTime) -> bool {
        let waits = matches!(self.step, Step::Keeping(_));
        if waits {
            let why = format!("its start could not be recorded on disk ({why}); nothing was started");
            self.finish(DrillState::Aborted, why, time);
        }
        waits
    }

    fn go(&mut self, step: Step, now: Instant) {
        (self.step, self.since) = (step, now);
    }

    fn kind(&self) -> Option<Kind> {
        self.report.steps.get(self.at).map(|step| step.kind)
    }

    fn current(&mut self) -> Option<&mut DrillStep> {
        self.report.steps.get_mut(self.at)
    }

    /// The motor gets its start at the low speed.
    fn begin_step(&mut self, now: Instant) {
        if let Some(step) = self.current() {
            step.state = DrillState::Running;
        }
        self.began = now;
        self.give_start(now);
    }

    fn give_start(&mut self, now: Instant) {
        let profile = &self.drive.image.spec.profile;
        let points = [
            (ModelPoint::Run, Value::Bool(true)),
            (ModelPoint::SpeedReference, Value::Number(self.report.speed)),
        ];
        let order = points
            .into_iter()
            .filter_map(|(point, value)| Some((profile.model_index(point)?, value)));
        let order = Order::Points(order.collect());
        self.report.text = format!("starting the motor at {} %", self.report.speed);
        let drive = self.drive.clone().waiting(true);
        let placed = drive.place(order, self.own.clone(), Authority::Write, START, now);
        self.go(Step::Starting(placed), now);
    }

    /// Somebody ends it: the motor is stopped.
    pub(super) fn abort(&mut self, why: &str, now: Instant, time: SystemTime) {
        match self.step {
            Step::Armed | Step::Keeping(_) => self.finish(DrillState::Aborted, why.to_string(), time),
            // Its stop comes in any case.
            Step::CutOff | Step::Ending(..) | Step::Over => {}
            _ => self.end(DrillState::Aborted, why.to_string(), now),
        }
    }

    /// The drill ends so, once its last stop is there.
    fn end(&mut self, state: DrillState, why: String, now: Instant) {
        self.drive.bus.queue.keep_quiet(self.drive.index, None);
        if let Some(step) = self.current().filter(|step| !step.state.is_over()) {
            step.state = state;
            step.seen.clone_from(&why);
        }
        self.not_tried();
        self.report.text = why;
        let stop = OneStop::place(&self.drive, self.machine.clone(), &self.own, now);
        self.go(Step::Ending(state, stop), now);
    }

    fn not_tried(&mut self) {
        for step in self
            .report
            .steps
            .iter_mut()
            .filter(|step| step.state == DrillState::Armed)
        {
            step.state = DrillState::NotProven;
            step.seen = "it was not tried".to_string();
        }
    }

    fn finish(&mut self, state: DrillState, text: String, time: SystemTime) {
        self.drive.bus.queue.keep_quiet(self.drive.index, None);
        if self.report.started_at.is_some() {
            self.drive.image.hold.set(None);
        }
        self.not_tried();
        self.report.state = state;
        self.report.text = text;
        self.report.ended_at = Some(text_of(time));
        self.step = Step::Over;
    }

    /// Looks what became of it. Whether it goes on.
    pub(super) fn look(&mut self, plant: &Plant, now: Instant, time: SystemTime) -> bool {
        if !matches!(self.step, Step::CutOff | Step::Ending(..) | Step::Over)
            && let Some(why) = self.interruption(plant, now)
        {
            self.abort(&why, now, time);
        }
        let reading_drive = self.drive.clone();
        let reading = reading_drive.reading(now);
        match std::mem::replace(&mut self.step, Step::Over) {
            Step::Armed => self.step = Step::Armed,
            Step::Keeping(_) if now.saturating_duration_since(self.since) > KEEP => {
                let seconds = KEEP.as_secs();
                let why = format!("its start was not recorded on disk within {seconds} s; nothing was started");
                self.finish(DrillState::Aborted, why, time);
            }
            Step::Keeping(generation) => self.step = Step::Keeping(generation),
            Step::Waiting if now.saturating_duration_since(self.since) < AGAIN => self.step = Step::Waiting,
            Step::Waiting => self.give_start(now),
            Step::Starting(placed) => self.look_at_start(placed, now),
            Step::SpeedingUp(turned) => self.look_at_speed(turned, &reading, now),
            Step::Steady => self.look_steady(now, time),
            Step::Caused(cause, how) => self.look_at_cause(cause, how, &reading, (now, time)),
            Step::Clearing(stop) => self.look_cleared(stop, plant, now),
            Step::CutOff => self.look_cut_off(plant, now),
            Step::Ending(state, stop) => self.look_at_end(state, stop, plant, (now, time)),
            Step::Over => {}
        }
        !matches!(self.step, Step::Over)
    }

    fn look_at_start(&mut self, mut placed: Placed, now: Instant) {
        match placed.answer() {
            None => self.step = Step::Starting(placed),
            Some(answer) if answer.outcome.is_ok() => {
                let why = format!("drill `{}` is under way: only stops pass, and end it", self.report.id);
                self.drive.image.hold.set(Some(why));
                self.report.text = "waiting until the motor turns".to_string();
                self.go(Step::SpeedingUp(None), now);
            }
            // A value that the order needs was not read yet.
            Some(answer)
                if matches!(answer.outcome, Outcome::Refused(Refusal::NotKnown(_)))
                    && now.saturating_duration_since(self.began) < START_AGAIN =>
            {
                self.go(Step::Waiting, now);
            }
            Some(answer) => {
                let why = format!("the motor was not started: {}", answer.outcome);
                self.end(DrillState::NotProven, why, now);
            }
        }
    }

    fn look_at_speed(&mut self, turned: Option<Instant>, reading: &Reading<'_>, now: Instant) {
        // Only a client that is there keeps the lease: the drill is, until it falls silent.
        self.drive.heartbeat(&self.own, now);
        let turns = matches!(reading.standstill(None), Standstill::Turns(_));
        let turned = if turns { turned.or(Some(now)) } else { None };
        let told = reading
            .model(ModelPoint::ActualSpeed)
            .good()
            .map(|speed| speed.as_f64().abs());
        let at_speed = match (turned, told) {
            (None, _) => false,
            (Some(_), Some(speed)) => speed >= AT_SPEED * self.report.speed,
            (Some(since), None) => now.saturating_duration_since(since) >= UNTOLD_SPEED,
        };
        if at_speed {
            self.report.text = format!("the motor turns at {} %", self.report.speed);
            return self.go(Step::Steady, now);
        }
        if now.saturating_duration_since(self.since) > SPEED_UP {
            let seconds = SPEED_UP.as_secs();
            let why = match (turned, told) {
                (Some(_), Some(speed)) => format!("the motor turned at {speed:.1} % only, {seconds} s after its start"),
                _ => format!("the motor was not seen to turn within {seconds} s"),
            };
            return self.end(DrillState::NotProven, why, now);
        }
        self.step = Step::SpeedingUp(turned);
    }

    fn look_steady(&mut self, now: Instant, time: SystemTime) {
        self.drive.heartbeat(&self.own, now);
        if now.saturating_duration_since(self.since) < STEADY {
            self.step = Step::Steady;
            return;
        }
        let Some(step) = self.report.steps.get_mut(self.at) else {
            return self.end(DrillState::Passed, "passed".to_string(), now);
        };
        step.cause_at = Some(text_of(time));
        let cause = match step.kind {
            Kind::Order => {
                let run = self.drive.image.spec.profile.model_index(ModelPoint::Run);
                let order = Order::Points(run.map(|run| (run, Value::Bool(false))).into_iter().collect());
                let drive = self.drive.clone().at_once();
                let placed = drive.place(order, self.own.clone(), Authority::Write, self.options.limit, now);
                self.report.text = "an order to stop was given".to_string();
                Cause::Order(placed)
            }
            Kind::Client => {
                self.report.text = "the client is silent".to_string();
                Cause::Client { stopped: false }
            }
            Kind::Gateway => {
                let until = now + self.options.limit;
                self.drive.bus.queue.keep_quiet(self.drive.index, Some(until));
                self.report.text = format!(
                    "nothing is sent to the drive for {} s",
                    self.options.limit.as_secs_f64()
                );
                Cause::Gateway(until)
            }
        };
        self.stops = self.drive.stops();
        self.go(Step::Caused(now, cause), now);
    }

    fn look_at_cause(
        &mut self,
        cause: Instant,
        mut how: Cause,
        reading: &Reading<'_>,
        (now, time): (Instant, SystemTime),
    ) {
        if !matches!(how, Cause::Client { .. }) {
            // Its supervision is to write no stop meanwhile.
            self.drive.heartbeat(&self.own, now);
        }
        let seen = match &mut how {
            Cause::Order(placed) => self.seen_of_order(cause, placed, reading, now),
            Cause::Client { stopped } => match self.seen_since(cause, cause, reading, now) {
                Seen::Stood { .. } if !*stopped => {
                    let why = "the motor stood before its supervision stopped it".to_string();
                    Seen::Ended(DrillState::NotProven, why)
                }
                seen => seen,
            },
            Cause::Gateway(until) => self.seen_after(cause, *until, reading, now),
        };
        let limit = self.options.limit;
        let Some(step) = self.report.steps.get_mut(self.at) else {
            return;
        };
        let kind = step.kind;
        match seen {
            Seen::Nothing => self.step = Step::Caused(cause, how),
            Seen::Stood { took, upper_bound } if took <= limit || upper_bound => {
                step.state = DrillState::Passed;
                step.took_ms = Some(u64::try_from(took.as_millis()).unwrap_or(u64::MAX));
                step.upper_bound = upper_bound;
                let at_most = if upper_bound { "at most " } else { "" };
                step.seen = format!("the motor stood after {at_most}{:.1} s", took.as_secs_f64());
                self.proofs.push(Proof::new(&self.machine, kind, time, true));
                self.report.text.clone_from(&step.seen);
                let stop = OneStop::place(&self.drive, self.machine.clone(), &self.own, now);
                self.stops = self.drive.stops();
                match self.at + 1 < self.report.steps.len() {
                    true => self.go(Step::Clearing(stop), now),
                    false => {
                        self.report.text = "the motor stood in time in each way".to_string();
                        self.go(Step::Ending(DrillState::Passed, stop), now);
                    }
                }
            }
            Seen::Stood { took, .. } => {
                let why = format!(
                    "the motor stood after {:.1} s, allowed are {} s",
                    took.as_secs_f64(),
                    limit.as_secs_f64()
                );
                self.failed(kind, why, (now, time));
            }
            Seen::Ended(DrillState::Failed, why) => self.failed(kind, why, (now, time)),
            Seen::Ended(state, why) => self.end(state, why, now),
        }
    }

    fn failed(&mut self, kind: Kind, why: String, (now, time): (Instant, SystemTime)) {
        self.proofs.push(Proof::new(&self.machine, kind, time, false));
        self.end(DrillState::Failed, why, now);
    }

    fn seen_of_order(&mut self, cause: Instant, placed: &mut Placed, reading: &Reading<'_>, now: Instant) -> Seen {
        let accepted = placed.accepted();
        match placed.answer() {
            None if now.saturating_duration_since(cause) <= self.options.limit => Seen::Nothing,
            None => Seen::Ended(DrillState::Failed, "the stop was not acknowledged in time".to_string()),
            Some(answer) if answer.outcome.is_ok() => self.seen_since(cause, accepted + answer.latency, reading, now),
            Some(answer) => Seen::Ended(DrillState::Failed, format!("the stop failed: {}", answer.outcome)),
        }
    }

    /// Whether reads after `since` show that the motor stands.
    fn seen_since(&self, cause: Instant, since: Instant, reading: &Reading<'_>, now: Instant) -> Seen {
        let passed = now.saturating_duration_since(cause);
        match reading.standstill(Some(since)) {
            Standstill::Stands => Seen::Stood {
                took: passed,
                upper_bound: false,
            },
            _ if passed <= self.options.limit => Seen::Nothing,
            Standstill::Turns(what) => {
                let seconds = self.options.limit.as_secs_f64();
                Seen::Ended(
                    DrillState::Failed,
                    format!("after {seconds} s the motor still turns: {what}"),
                )
            }
            Standstill::Unknown(why) => Seen::Ended(DrillState::NotProven, format!("standstill was not seen: {why}")),
        }
    }

    /// Whether the first reads after the silence show that the motor stands.
    fn seen_after(&self, cause: Instant, until: Instant, reading: &Reading<'_>, now: Instant) -> Seen {
        if now < until {
            return Seen::Nothing;
        }
        match reading.standstill(Some(until)) {
            // Whether it was this switch that stopped it is not known.
            Standstill::Stands if is_local(reading) => Seen::Ended(DrillState::Aborted, LOCAL.to_string()),
            Standstill::Stands => Seen::Stood {
                took: until.saturating_duration_since(cause),
                upper_bound: true,
            },
            Standstill::Turns(what) => {
                let seconds = self.options.limit.as_secs_f64();
                let why = format!("after a silence of {seconds} s the motor still turns: {what}");
                Seen::Ended(DrillState::Failed, why)
            }
            Standstill::Unknown(_) if now < until + READ => Seen::Nothing,
            Standstill::Unknown(why) => Seen::Ended(DrillState::NotProven, format!("standstill was not seen: {why}")),
        }
    }

    /// The motor is stopped and stands before the next way is tried.
    fn look_cleared(&mut self, mut stop: OneStop, plant: &Plant, now: Instant) {
        stop.look(plant, now);
        self.stops = self.drive.stops();
        if stop.is_acknowledged() && stop.stands(plant, now) {
            self.drive.image.hold.set(None);
            self.at += 1;
            return self.begin_step(now);
        }
        if now.saturating_duration_since(self.since) > LAST_STOP {
            let why = "the stop before the next way was not acknowledged, or the motor did not stand".to_string();
            self.at += 1;
            return self.end(DrillState::NotProven, why, now);
        }
        self.step = Step::Clearing(stop);
    }

    /// Stops the motor once the drive is online; a stop to one that is not would fail.
    fn look_cut_off(&mut self, plant: &Plant, now: Instant) {
        if let Some(drive) = plant.drive_at(&self.machine) {
            self.drive = drive;
        }
        let waited = now.saturating_duration_since(self.since);
        if waited <= LAST_STOP && !self.drive.reading(now).snapshot.link.is_online() {
            self.step = Step::CutOff;
            return;
        }
        self.end(DrillState::Aborted, CUT_OFF_TEXT.to_string(), now);
    }

    fn look_at_end(&mut self, state: DrillState, mut stop: OneStop, plant: &Plant, (now, time): (Instant, SystemTime)) {
        stop.look(plant, now);
        let over = stop.is_acknowledged() || stop.is_refused();
        if !over && now.saturating_duration_since(self.since) <= LAST_STOP {
            self.step = Step::Ending(state, stop);
            return;
        }
        self.report.last_stop = Some(match stop.is_acknowledged() {
            true => "acknowledged".to_string(),
            false => stop.why_not(),
        });
        let text = std::mem::take(&mut self.report.text);
        self.finish(state, text, time);
    }
}

/// A drill that is over.
#[derive(Debug)]
pub(super) struct Ended {
    who: Origin,
    pub(super) report: DrillReport,
}

impl Ended {
    /// Adds it to the audit and publishes its event.
    pub(super) fn publish(&self, plant: &Plant, now: Instant, time: SystemTime) {
        let DrillReport { drive, bus, state, .. } = &self.report;
        let kinds: Vec<&str> = self.report.steps.iter().map(|step| step.kind.name()).collect();
        let what = format!("drill {} at {} %", kinds.join(", "), self.report.speed);
        let result = (state.name(), self.report.text.as_str());
        plant.writes.audit().note(&self.who, (drive, &what), result, now);
        let text = format!(
            "{what} by {}: {}: {}",
            self.report.who,
            state.name().replace('_', " "),
            self.report.text
        );
        plant.events.publish(Event {
            bus: bus.clone(),
            drive: Some(drive.clone()),
            ..Event::new(EventKind::Drill, time, text)
        });
    }
}
