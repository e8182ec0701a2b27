//! Explains why a drive does not run: causes from its points, its profile and the last command. Pure: state and
//! time are arguments.
//!
//! A profile names the bits of its family that prevent a motor from running (`blocks` of a point); the rest follows
//! from the common model. States that a family does not report are listed as unknown instead of being assumed.

use crate::drive::PointIndex;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use super::model::{ModelPoint, Sample, Value};
use super::profile::{Point, Profile};

/// DC link voltage in V below which it is not charged: the lowest supply of these families is 200 V, rectified 280 V.
const UNCHARGED: f64 = 50.0;

/// Word for an unknown cause.
const NOT_KNOWN: &str = "not_known";
/// Word for local control in `blocks` of a point.
const LOCAL_CONTROL: &str = "local_control";
/// Word for an interlock in `blocks` of a point.
const INTERLOCKED: &str = "interlocked";

/// One reason why a motor does not run.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Cause {
    /// The reason in one word, for programs.
    pub cause: String,
    /// The evidence for the cause.
    pub evidence: String,
    /// Age of the evidence, ms; absent if the evidence is not a reading.
    pub age_ms: Option<u64>,
    /// The remedy for the cause.
    pub remedy: String,
    /// The client that gave the order, if the cause is the last order.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub by: Option<String>,
    /// Result code of the order, if it was refused.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub result: Option<String>,
    /// Time after which a start that must wait may be tried again.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub retry_after_ms: Option<u64>,
}

/// Whether a motor runs, and why not.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Explanation {
    /// Whether the motor runs; `None` if unknown.
    pub runs: Option<bool>,
    /// Why the drive does not run, the most significant cause first; empty while it runs.
    pub causes: Vec<Cause>,
    /// States that the family does not report, so that they cannot be excluded as causes.
    pub not_told: Vec<String>,
}

impl Explanation {
    /// The causes with their evidence as one line; `None` if there are none.
    pub fn blocked_by(&self) -> Option<String> {
        let cause = |Cause { cause, evidence, .. }: &Cause| {
            if evidence.starts_with(cause.as_str()) {
                evidence.clone()
            } else {
                format!("{cause} ({evidence})")
            }
        };
        let causes: Vec<String> = self.causes.iter().map(cause).collect();
        (!causes.is_empty()).then(|| causes.join(", "))
    }

    /// Adds a cause outside the drive; it replaces the entry for an unknown cause.
    pub fn add(&mut self, cause: Cause) {
        self.causes.retain(|cause| cause.cause != NOT_KNOWN);
        self.causes.push(cause);
    }

    /// One word for each cause, in the order of the causes and without repetition.
    pub fn names(&self) -> Vec<String> {
        let mut words: Vec<String> = Vec::new();
        for Cause { cause, .. } in &self.causes {
            if !words.contains(cause) {
                words.push(cause.clone());
            }
        }
        words
    }
}

/// Whether the drive can be reached.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Contact {
    /// The process data of the drive is fresh.
    Fresh,
    /// The drive answers, but its process data is too old.
    Stale,
    /// The drive does not answer.
    Silent,
    /// The drive has not been polled yet.
    Untried,
    /// The port is not open, and why.
    BusDown(Option<String>),
}

/// The last order that concerns the run command.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunOrder {
    /// Effect of the order on the motor.
    pub run: RunWish,
    /// The result of the last order.
    pub fate: Fate,
    /// Kind of the giver of the order.
    pub by: Giver,
    /// Source and client, as text.
    pub who: String,
    /// The outcome of the order as text.
    pub text: String,
    /// The outcome as a result code.
    pub result: String,
    /// How long ago the last order ended.
    pub age: Duration,
}

/// The purpose of a command for the motor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunWish {
    /// The order was to run.
    Run,
    /// The order was to stop.
    Stop,
    /// The order was a fault reset, which starts nothing.
    Reset,
}

/// The result of a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fate {
    /// The drive acknowledged the order.
    Taken,
    /// The gateway or the drive refused the order.
    Refused,
    /// The order was accepted and not sent.
    NotSent,
    /// The order was sent, but it is unknown whether the drive accepted it.
    Unsure,
}

/// Who gave the last order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Giver {
    /// A client gave the order.
    Client,
    /// Supervision gave the order, because a lease expired.
    Supervision,
    /// The gateway gave the order when it was stopped.
    Shutdown,
    /// An interlock that no longer holds gave the order.
    Interlock,
    /// The gateway gave the order when local control took over the drive while its run command was on.
    LocalControl,
}

/// Everything except the points that explains a standstill.
pub struct Situation<'s> {
    /// The present time.
    pub now: Instant,
    /// Whether the drive can be reached.
    pub contact: Contact,
    /// When the drive's process data was last read.
    pub read_at: Option<Instant>,
    /// Whether this gateway may command the drive.
    pub is_commandable: bool,
    /// Why the drive accepts only stops and what ends that; `None` if it accepts all commands.
    pub held: Option<String>,
    /// The last command of the run point; requested only while the motor does not run.
    pub order: &'s dyn Fn() -> Option<RunOrder>,
}

/// Explains why the drive does not run; `sample` returns its points by their index in the profile.
pub fn explain(profile: &Profile, sample: &dyn Fn(PointIndex) -> Sample, situation: &Situation<'_>) -> Explanation {
    let look = Examination {
        profile,
        sample,
        situation,
    };
    if let Some(cause) = look.unreachable() {
        let mut causes = vec![cause];
        causes.extend(look.held());
        causes.extend(look.order_in_the_way((situation.order)(), None));
        return Explanation {
            runs: None,
            causes,
            not_told: Vec::new(),
        };
    }
    let runs = look.bit(ModelPoint::Running).map(|(running, _)| running);
    if runs == Some(true) && look.turns() != Some(false) {
        return Explanation {
            runs,
            ..Explanation::default()
        };
    }
    let mut causes: Vec<Cause> = look.fault().into_iter().chain(look.blocking_points()).collect();
    causes.extend(look.local_control(&causes));
    causes.extend(look.uncharged());
    causes.extend(look.not_ready(&causes));
    causes.extend(look.held().filter(|_| runs != Some(true)));
    causes.extend(look.command(&causes));
    causes.extend(look.warning());
    if causes.is_empty() && runs == Some(false) {
        causes.push(look.unknown());
    }
    Explanation {
        // A drive that is enabled and stopped counts as not running.
        runs: runs.map(|running| running && causes.is_empty()),
        causes,
        not_told: look.not_told(),
    }
}

struct Examination<'l> {
    profile: &'l Profile,
    sample: &'l dyn Fn(PointIndex) -> Sample,
    situation: &'l Situation<'l>,
}

impl Examination<'_> {
    fn age(&self, at: Option<Instant>) -> Option<u64> {
        let age = self.situation.now.saturating_duration_since(at?);
        Some(u64::try_from(age.as_millis()).unwrap_or(u64::MAX))
    }

    fn cause(&self, cause: &str, evidence: String, at: Option<Instant>, remedy: &str) -> Cause {
        Cause {
            cause: cause.to_string(),
            evidence,
            age_ms: self.age(at),
            remedy: remedy.to_string(),
            ..Cause::default()
        }
    }

    fn model(&self, point: ModelPoint) -> Option<(Value, Option<Instant>)> {
        let sample = (self.sample)(self.profile.model_index(point)?);
        Some((sample.good()?, sample.at))
    }

    fn bit(&self, point: ModelPoint) -> Option<(bool, Option<Instant>)> {
        self.model(point).map(|(value, at)| (value.as_bool(), at))
    }

    /// Whether a speed is not zero; `None` if no speed is known.
    fn turns(&self) -> Option<bool> {
        let speeds = [
            ModelPoint::OutputFrequency,
            ModelPoint::ActualSpeed,
            ModelPoint::MotorSpeed,
        ];
        let known = speeds.into_iter().filter_map(|speed| self.model(speed));
        known.map(|(value, _)| value.as_f64() != 0.0).reduce(|a, b| a || b)
    }

    /// The cause if the drive cannot be reached.
    fn unreachable(&self) -> Option<Cause> {
        let read_at = self.situation.read_at;
        let (cause, evidence, remedy) = match &self.situation.contact {
            Contact::Fresh => return None,
            Contact::Stale => (
                "stale",
                "its process data is too old to tell".to_string(),
                "check load and errors of the bus: the line may be overloaded or disturbed",
            ),
            Contact::Silent if self.profile.counts_messages => (
                "offline",
                "it does not reply".to_string(),
                "check its power supply, wiring and address; if a master has set it to listen-only mode (function 08, \
                 subfunction 04), write restart_communication=true with `drivegate write`",
            ),
            Contact::Silent => (
                "offline",
                "it does not reply".to_string(),
                "check its power supply, wiring and address; a drive whose control board has no power is silent",
            ),
            Contact::Untried => (
                "offline",
                "it has not been polled yet".to_string(),
                "wait until the bus has polled it",
            ),
            Contact::BusDown(why) => (
                "bus_down",
                why.clone()
                    .unwrap_or_else(|| "the port of its bus is not open".to_string()),
                "check the adapter and the port of the bus",
            ),
        };
        Some(self.cause(cause, evidence, read_at, remedy))
    }

    fn fault(&self) -> Option<Cause> {
        let (_, at) = self.bit(ModelPoint::Fault).filter(|(fault, _)| *fault)?;
        let code = match self.model(ModelPoint::FaultCode) {
            Some((Value::Integer(code), _)) if code != 0 => Some(code),
            _ => None,
        };
        let known = code.and_then(|code| self.profile.faults.get(&u16::try_from(code).ok()?));
        let evidence = match (code, known) {
            (Some(code), Some(fault)) => {
                let because = match fault.cause.as_str() {
                    "" => String::new(),
                    cause => format!(" ({cause})"),
                };
                let unsure = if fault.verified { "" } else { ", text not verified" };
                let panel = match fault.panel.as_str() {
                    "" => String::new(),
                    panel => format!(", at the panel {panel}"),
                };
                format!("fault {code}: {}{because}{panel}{unsure}", fault.text)
            }
            (Some(code), None) => format!("fault {code}, without a text in the profile"),
            (None, _) => "a fault is active; its code is unknown".to_string(),
        };
        let reset = match self
            .profile
            .model_point(ModelPoint::FaultReset)
            .filter(|point| point.write)
        {
            Some(_) => "then write fault_reset",
            None => "then reset the drive at its panel",
        };
        let remedy = match known
            .map(|fault| fault.remedy.as_str())
            .filter(|remedy| !remedy.is_empty())
        {
            Some(remedy) => format!("{remedy}; {reset}"),
            None => format!("remove the cause as described in the drive's manual; {reset}"),
        };
        Some(self.cause("fault", evidence, at, &remedy))
    }

    /// Points that keep the motor from running, by the profile.
    fn blocking_points(&self) -> impl Iterator<Item = Cause> + '_ {
        let points = self.profile.points.enumerate();
        points.filter_map(|(index, point)| {
            let blocks = point.blocks.as_ref()?;
            let sample = (self.sample)(index);
            let value = sample.good().filter(|value| value.as_bool() == blocks.when)?;
            // A drive that is ready waits for no interlock, whatever an uncertain bit shows (HVX status word bit 8,
            // on which table and legend of the manual contradict each other).
            let ready = || self.bit(ModelPoint::Ready).is_some_and(|(ready, _)| ready);
            if !point.verified && blocks.cause == INTERLOCKED && ready() {
                return None;
            }
            let unsure = if point.verified { "" } else { ", address not verified" };
            let evidence = format!("{}{unsure}", reads(point, value));
            Some(self.cause(&blocks.cause, evidence, sample.at, &blocks.remedy))
        })
    }

    /// A cause for another control place, if no point of the profile has shown which one.
    fn local_control(&self, found: &[Cause]) -> Option<Cause> {
        let (_, at) = self.bit(ModelPoint::Remote).filter(|(remote, _)| !remote)?;
        if found.iter().any(|cause| cause.cause == LOCAL_CONTROL) {
            return None;
        }
        let evidence = "remote is off: the drive obeys its panel or its terminals".to_string();
        Some(self.cause(LOCAL_CONTROL, evidence, at, "select the fieldbus as its control place"))
    }

    fn uncharged(&self) -> Option<Cause> {
        let (voltage, at) = self.model(ModelPoint::DcLinkVoltage)?;
        let volts = voltage.as_f64();
        (volts < UNCHARGED).then(|| {
            let remedy = "switch the mains on; check fuses, contactor and charging circuit";
            self.cause("no_dc_link", format!("dc_link_voltage is {volts} V"), at, remedy)
        })
    }

    fn not_ready(&self, found: &[Cause]) -> Option<Cause> {
        let (_, at) = self.bit(ModelPoint::Ready).filter(|(ready, _)| !ready)?;
        // Another control place does not make a drive unready.
        if found.iter().any(|cause| cause.cause != LOCAL_CONTROL) {
            return None;
        }
        let evidence = "ready is off, and the drive does not report why".to_string();
        let remedy = "check its enable and interlock inputs, the mains and its display";
        let note = self
            .profile
            .model_point(ModelPoint::Ready)
            .map_or("", |point| &point.note);
        let remedy = if note.is_empty() {
            remedy.to_string()
        } else {
            format!("{remedy}; of this family: ready {note}")
        };
        Some(self.cause("not_ready", evidence, at, &remedy))
    }

    /// The drive takes no order to run from any client.
    fn held(&self) -> Option<Cause> {
        let remedy = "wait for its parameter restore to finish; `drivegate params restore` resumes, undoes or \
                      releases an interrupted one";
        let held = self.situation.held.clone();
        held.map(|why| self.cause("held", why, None, remedy))
    }

    /// Causes in the commands: no run command, or zero reference.
    fn command(&self, found: &[Cause]) -> Vec<Cause> {
        let order = (self.situation.order)();
        let reads = self.bit(ModelPoint::Run);
        let taken = order
            .as_ref()
            .filter(|order| order.fate == Fate::Taken)
            .map(|order| order.run);
        match (reads, taken) {
            (Some((true, _)), _) | (None, Some(RunWish::Run)) => {
                let zero = self.zero_reference();
                let direction = self.direction(found).filter(|_| zero.is_none());
                zero.into_iter().chain(direction).collect()
            }
            (reads, _) => {
                let at = reads.and_then(|(_, at)| at);
                // A fault also takes the run command away, so another master is not the cause then.
                let is_fault = found.iter().any(|cause| cause.cause == "fault");
                if is_fault && taken == Some(RunWish::Run) {
                    return Vec::new();
                }
                let in_the_way = self.order_in_the_way(order, at);
                in_the_way
                    .or_else(|| reads.map(|_| self.no_order(at)))
                    .into_iter()
                    .collect()
            }
        }
    }

    /// The cause in the last order; `read_at` is when the drive was last seen without a run command.
    fn order_in_the_way(&self, order: Option<RunOrder>, read_at: Option<Instant>) -> Option<Cause> {
        let order = order?;
        let ended = self.situation.now.checked_sub(order.age);
        let (who, text) = (&order.who, &order.text);
        let (cause, evidence, remedy) = match (order.run, order.fate, order.by) {
            (RunWish::Run, Fate::Refused, _) => (
                "order_refused",
                format!("run from {who} was refused: {text}"),
                "correct this, then send run again",
            ),
            (RunWish::Run, Fate::NotSent, _) => (
                "order_expired",
                format!("run from {who} was not sent: {text}"),
                "send it again; check the load of the bus if it happens again",
            ),
            (RunWish::Run, Fate::Unsure, _) => (
                "order_unanswered",
                format!("run from {who} was not acknowledged: {text}"),
                "check whether the drive replies, then send it again",
            ),
            (RunWish::Run, Fate::Taken, _) if read_at > ended => (
                "other_master",
                format!("run from {who} was acknowledged, but run is now off in the drive"),
                "look for another master that writes the control word; a drive that restarted has lost the command",
            ),
            (RunWish::Run, Fate::Taken, _) => return None,
            (RunWish::Stop, Fate::Taken | Fate::Unsure, Giver::Supervision) => (
                "supervision",
                format!("its lease expired, and {}", stopped(order.fate, text)),
                "have the client renew the lease with commands or heartbeats, then send run again",
            ),
            (RunWish::Stop, Fate::Taken | Fate::Unsure, Giver::Shutdown) => (
                "stopped_by_gateway",
                format!("the gateway shut down, and {}", stopped(order.fate, text)),
                "send run again",
            ),
            (RunWish::Stop, Fate::Taken | Fate::Unsure, Giver::Interlock) => (
                "stopped_by_interlock",
                format!("an interlock was not satisfied, and {}", stopped(order.fate, text)),
                "send run again once it is satisfied",
            ),
            (RunWish::Stop, Fate::Taken | Fate::Unsure, Giver::LocalControl) => (
                "stopped_by_gateway",
                format!(
                    "the drive was switched to its local control place, and {}",
                    stopped(order.fate, text)
                ),
                "send run again",
            ),
            (RunWish::Stop, Fate::Taken | Fate::Unsure, Giver::Client) => (
                "stopped_by_order",
                match order.fate {
                    Fate::Unsure => format!("a stop from {who} was sent but not acknowledged: {text}"),
                    _ => format!("{who} stopped it"),
                },
                "send run again if it may run",
            ),
            (RunWish::Reset, Fate::Taken | Fate::Unsure, _) => (
                "fault_was_reset",
                format!("{who} reset its fault, and a reset does not start the motor"),
                "send run again",
            ),
            (RunWish::Stop | RunWish::Reset, Fate::Refused | Fate::NotSent, _) => return None,
        };
        Some(Cause {
            by: Some(order.who.clone()),
            result: (order.fate == Fate::Refused).then(|| order.result.clone()),
            ..self.cause(cause, evidence, ended, remedy)
        })
    }

    fn no_order(&self, at: Option<Instant>) -> Cause {
        let evidence = "run is off in the drive, and this gateway sent no command".to_string();
        let remedy = if self.situation.is_commandable {
            "send run"
        } else {
            "this gateway only monitors it: its controller must start it"
        };
        self.cause("no_run_order", evidence, at, remedy)
    }

    fn zero_reference(&self) -> Option<Cause> {
        // The reference in Hz is checked first, because zero percent may be the minimum frequency.
        let references = [ModelPoint::FrequencyReference, ModelPoint::SpeedReference];
        let known = |point| self.model(point).map(|(value, at)| (point, value, at));
        let (point, value, at) = references.into_iter().find_map(known)?;
        (value.as_f64() == 0.0).then(|| {
            let evidence = format!("run is on, and {} is 0 {}", point.name(), point.unit());
            self.cause("reference_zero", evidence, at, "send a reference above zero")
        })
    }

    /// The cause that nothing prevents the run except the reverse direction, which a parameter can forbid.
    fn direction(&self, found: &[Cause]) -> Option<Cause> {
        let (_, at) = self.bit(ModelPoint::Reverse).filter(|(reverse, _)| *reverse)?;
        let (reversed, _) = self.bit(ModelPoint::Reversed)?;
        let is_ready = self.bit(ModelPoint::Ready).is_some_and(|(ready, _)| ready);
        (found.is_empty() && is_ready && !reversed).then(|| {
            let evidence = "run and reverse are on and the drive is ready, but it does not turn in reverse".to_string();
            let remedy = "send reverse = false, or allow the direction in the drive's parameters";
            self.cause("direction_blocked", evidence, at, remedy)
        })
    }

    fn warning(&self) -> Option<Cause> {
        let (_, at) = self.bit(ModelPoint::Warning).filter(|(warning, _)| *warning)?;
        let evidence = "the drive reports a warning".to_string();
        Some(self.cause("warning", evidence, at, "read it on the drive's display"))
    }

    fn unknown(&self) -> Cause {
        let (_, at) = self.bit(ModelPoint::Running).unzip();
        let evidence = "nothing that the drive reports prevents it from running".to_string();
        let remedy = "look at its display; check what it does not report";
        self.cause(NOT_KNOWN, evidence, at.flatten(), remedy)
    }

    fn not_told(&self) -> Vec<String> {
        let has = |point| self.profile.model_index(point).is_some();
        let blocks = |word: &str| {
            let mut rules = self.profile.points.iter().filter_map(|point| point.blocks.as_ref());
            rules.any(|blocks| blocks.cause == word)
        };
        let told = [
            ("control place", has(ModelPoint::Remote) || blocks(LOCAL_CONTROL)),
            ("interlock", blocks(INTERLOCKED)),
            ("enable input", blocks("no_enable")),
            ("warning", has(ModelPoint::Warning)),
            ("run command", self.bit(ModelPoint::Run).is_some()),
        ];
        let untold = told.into_iter().filter(|(_, told)| !told);
        untold.map(|(what, _)| what.to_string()).collect()
    }
}

/// The result of a stop by the gateway itself, as text.
fn stopped(fate: Fate, text: &str) -> String {
    match fate {
        Fate::Taken => "it acknowledged the stop".to_string(),
        _ => format!("a stop was sent but not acknowledged: {text}"),
    }
}

/// The reading of a point, as text.
fn reads(point: &Point, value: Value) -> String {
    let name = &point.name;
    match (point.text_of(value), value) {
        (Some(text), _) => format!("{name} is {text}"),
        (None, Value::Bool(true)) => format!("{name} is on"),
        (None, Value::Bool(false)) => format!("{name} is off"),
        (None, value) => format!("{name} is {value} {}", point.unit).trim_end().to_string(),
    }
}

#[cfg(test)]
mod tests;
