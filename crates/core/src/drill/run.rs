//! A drill that is armed or in progress, step by step.

mod checks;
mod interruption;
mod observation;

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use tokio::sync::broadcast::Receiver;

use super::{ARMED, DrillOptions, DrillReport, DrillState, DrillStep, Kind, Proof};
use crate::event::{Event, EventKind};
use crate::order::{AuditRecord, Authority, Order, Origin, SourceKind};
use crate::permit::DrillLock;
use crate::plant::{DriveHandle, OrderRequest, Placed, Plant};
use crate::process_image::Machine;
use crate::stop_all::OneStop;
use drivegate_model::drive::{ModelPoint, Value};

/// Maximum time to write the start of a drill to disk; after that the operator no longer expects the motor to start.
const KEEP: Duration = Duration::from_secs(5);
/// Time within which the start command of a drill may be sent; a guard may delay it.
const START: Duration = Duration::from_secs(60);
/// How long a start is retried if it needs a value that has not been read yet, and the pause between retries.
const START_AGAIN: Duration = Duration::from_secs(15);
const AGAIN: Duration = Duration::from_millis(500);
/// Maximum time to reach the speed.
const SPEED_UP: Duration = Duration::from_secs(60);
/// How long the motor runs at its speed before it is stopped.
const STEADY: Duration = Duration::from_secs(2);
/// Share of the requested speed that counts as reached.
const AT_SPEED: f64 = 0.8;
/// Assumed run-up time of a drive that does not report its speed in percent.
const UNTOLD_SPEED: Duration = Duration::from_secs(10);
/// Maximum time to the first read after a silence, or after the limit.
const READ: Duration = Duration::from_secs(15);
/// Time between two looks from which the gateway has paused.
const PAUSE: Duration = Duration::from_secs(1);
/// Maximum time for the acknowledgement of a stop, and for standstill before the next test.
const LAST_STOP: Duration = Duration::from_secs(60);
/// Maximum age of an interrupted drill whose motor is stopped at the next start of the gateway. After more time,
/// someone else may have started the motor.
const CUT_OFF: Duration = Duration::from_secs(3600);

/// A drill that is armed or in progress.
#[derive(Debug)]
pub(super) struct Run {
    report: DrillReport,
    machine: Machine,
    drive: DriveHandle,
    /// Client that armed the drill.
    who: Origin,
    /// The origin under which the drill sends its own commands.
    own: Origin,
    options: DrillOptions,
    records: Option<Receiver<Arc<AuditRecord>>>,
    /// Stops of the drive that the drill expects so far.
    stops: u64,
    step: Step,
    since: Instant,
    /// When the drill was last evaluated.
    looked: Instant,
    /// The longest pause of the gateway since the stop was caused.
    paused: Option<Duration>,
    /// When the current test began.
    began: Instant,
    /// Index of the current test.
    at: usize,
    proofs: Vec<Proof>,
}

/// The phases of a drill.
#[derive(Debug)]
enum Step {
    Armed,
    /// The start of the drill is being written to disk in this generation, so that the next process knows of the
    /// running motor.
    Keeping(u64),
    /// The start was refused and is retried.
    Waiting,
    /// The start command of the motor was given.
    Starting(Placed),
    /// The drive acknowledged the start; when the motor was first seen turning.
    SpeedingUp(Option<Instant>),
    /// The motor runs at the speed of the drill.
    Steady,
    /// The stop was caused at this time; the motor must now come to a standstill.
    Caused(Instant, Cause),
    /// The test is over; the motor is stopped in any case.
    Clearing(OneStop),
    /// The gateway was killed during the drill: the motor is stopped as soon as the drive is online.
    CutOff,
    /// The drill ended with this result; the stop that ends it is not acknowledged yet.
    Ending(DrillState, OneStop),
    Over,
}

/// The event that should stop the motor.
#[derive(Debug)]
enum Cause {
    Order(Placed),
    /// The client is silent; whether the lease has stopped the motor.
    Client {
        stopped: bool,
    },
    /// The gateway sends nothing to the drive until this time.
    Gateway(Instant),
}

/// Text of a drill during which the gateway was killed.
const CUT_OFF_TEXT: &str = "the gateway was killed or lost power during it";

/// Ends the report of an interrupted drill for which no stop is sent, and why not.
pub(super) fn ended_without_stop(mut report: DrillReport, why: &str, time: SystemTime) -> Ended {
    report.state = DrillState::Aborted;
    report.text = format!("{CUT_OFF_TEXT}; {why}; look at the motor");
    report.ended_at = Some(text_of(time));
    for step in report.steps.iter_mut().filter(|step| !step.state.is_over()) {
        step.state = DrillState::NotProven;
        step.seen = CUT_OFF_TEXT.to_string();
    }
    Ended {
        who: Origin::new(SourceKind::Shutdown, "interrupted drill"),
        report,
    }
}

/// Whether an interrupted drill is so recent that its motor must be stopped. If the clock was set back, every drill
/// counts as recent.
pub(super) fn is_recent(report: &DrillReport, time: SystemTime) -> bool {
    let started = report
        .started_at
        .as_deref()
        .and_then(|at| humantime::parse_rfc3339(at).ok());
    started.is_none_or(|started| time.duration_since(started).unwrap_or_default() <= CUT_OFF)
}

/// A client as text.
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
        // A drive that was stopped by its own fieldbus supervision has a fault, so this way is tested last.
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
            own: who.clone().of_drill(format!("drill of {}", who.who)),
            who: who.clone(),
            report,
            machine,
            drive: drive.clone(),
            options,
            records: None,
            stops: 0,
            step: Step::Armed,
            since: now,
            looked: now,
            paused: None,
            began: now,
            at: 0,
            proofs: Vec::new(),
        }
    }

    /// A drill that was in progress when the gateway was killed: its motor may still run.
    pub(super) fn cut_off(report: DrillReport, drive: &DriveHandle, now: Instant) -> Run {
        let own = Origin::new(SourceKind::Shutdown, "interrupted drill");
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
            looked: now,
            paused: None,
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

    /// Ends the drill if it was armed and not started in time; returns whether it ended it.
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

    /// Starts the drill. If drills are saved, the motor starts once generation `keep` is on disk.
    pub(super) fn start(&mut self, plant: &Plant, keep: Option<u64>, now: Instant, time: SystemTime) {
        self.records = Some(plant.command_log.audit().subscribe());
        self.stops = self.drive.stops();
        self.lock(None);
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

    /// Whether the drill waits until its start is on disk.
    pub(super) fn waits_for_disk(&self) -> bool {
        matches!(self.step, Step::Keeping(_))
    }

    /// Starts the motor if the start of the drill is on disk: all generations up to `kept` are.
    pub(super) fn kept(&mut self, kept: u64, now: Instant) {
        if matches!(self.step, Step::Keeping(generation) if generation <= kept) {
            self.begin_step(now);
        }
    }

    /// The start of the drill cannot be written to disk, so nothing is started. Returns whether the drill was
    /// waiting for that.
    pub(super) fn not_kept(&mut self, why: &str, time: SystemTime) -> bool {
        let waits = self.waits_for_disk();
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

    /// Starts the motor at the low speed of the drill.
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
        let request = OrderRequest::new(order, self.own.clone(), Authority::Write)
            .within(START)
            .waiting(true);
        let placed = self.drive.place(request, now);
        self.go(Step::Starting(placed), now);
    }

    /// Ends the drill for another reason: the motor is stopped.
    pub(super) fn abort(&mut self, why: &str, now: Instant, time: SystemTime) {
        match self.step {
            Step::Armed | Step::Keeping(_) => self.finish(DrillState::Aborted, why.to_string(), time),
            // These steps already lead to a stop, so an abort changes nothing.
            Step::CutOff | Step::Ending(..) | Step::Over => {}
            _ => self.end(DrillState::Aborted, why.to_string(), now),
        }
    }

    /// Ends the drill with this result, as soon as its last stop is acknowledged.
    fn end(&mut self, state: DrillState, why: String, now: Instant) {
        self.lock(None);
        if let Some(step) = self.current().filter(|step| !step.state.is_over()) {
            step.state = state;
            step.seen.clone_from(&why);
        }
        self.not_tried();
        self.report.text = why;
        let stop = OneStop::place(&self.drive, self.machine.clone(), &self.own, now);
        self.go(Step::Ending(state, stop), now);
    }

    /// Reserves the drive for the drill: other orders are refused, and until `quiet_until` nothing but stops is sent.
    fn lock(&self, quiet_until: Option<Instant>) {
        let who = format!("drill `{}`", self.report.id);
        let lock = DrillLock { who, quiet_until };
        self.drive.bus.queue.set_drill(self.drive.index, Some(lock));
    }

    fn not_tried(&mut self) {
        for step in self
            .report
            .steps
            .iter_mut()
            .filter(|step| step.state == DrillState::Armed)
        {
            step.state = DrillState::NotProven;
            step.seen = "not tried".to_string();
        }
    }

    fn finish(&mut self, state: DrillState, text: String, time: SystemTime) {
        self.drive.bus.queue.set_drill(self.drive.index, None);
        self.not_tried();
        self.report.state = state;
        self.report.text = text;
        self.report.ended_at = Some(text_of(time));
        self.step = Step::Over;
    }

    /// Evaluates the progress of the drill. Returns whether it continues.
    pub(super) fn advance(&mut self, plant: &Plant, now: Instant, time: SystemTime) -> bool {
        let gap = now.saturating_duration_since(std::mem::replace(&mut self.looked, now));
        self.paused = self.paused.max(Some(gap).filter(|gap| *gap > PAUSE));
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
            Step::Starting(placed) => self.check_start(placed, now),
            Step::SpeedingUp(turned) => self.check_speed(turned, &reading, now),
            Step::Steady => self.check_steady(&reading, now, time),
            Step::Caused(cause, how) => self.check_cause(cause, how, &reading, (now, time)),
            Step::Clearing(stop) => self.check_cleared(stop, plant, now),
            Step::CutOff => self.check_cut_off(plant, now),
            Step::Ending(state, stop) => self.check_end(state, stop, plant, (now, time)),
            Step::Over => {}
        }
        !matches!(self.step, Step::Over)
    }
}

/// A drill that has ended.
#[derive(Debug)]
pub(super) struct Ended {
    who: Origin,
    pub(super) report: DrillReport,
}

impl Ended {
    /// Adds the drill to the audit and publishes its event.
    pub(super) fn publish(&self, plant: &Plant, now: Instant, time: SystemTime) {
        let DrillReport { drive, bus, state, .. } = &self.report;
        let kinds: Vec<&str> = self.report.steps.iter().map(|step| step.kind.name()).collect();
        let what = format!("drill {} at {} %", kinds.join(", "), self.report.speed);
        let result = (state.name(), self.report.text.as_str());
        plant.command_log.audit().note(&self.who, (drive, &what), result, now);
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
