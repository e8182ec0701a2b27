//! Supervision: polling keeps a drive's own watchdog satisfied even if no client commands it. So a drive can have a
//! lease, renewed by the commands and heartbeats of a commanding client; when it expires while the drive runs, or
//! its run command is set, the configured action is written. Not a safety function. Pure: time is an argument.
//!
//! A lease begins when a command has reached the wire, and again when that order has ended. A waiting command keeps
//! the lease alive, but only until the order expires; one that was refused, expired or replaced renews nothing. A
//! client that returns suspends an action that is not on the wire yet; if its order ends without reaching the wire,
//! the action is due again.

use std::time::{Duration, Instant};

use tokio::sync::oneshot::Receiver;
use tokio::sync::oneshot::error::TryRecvError;

use super::command_run::KnownWords;
use super::news::{Adopted, News};
use drivegate_core::order::{Answer, Outcome, Refusal};
use drivegate_core::process_image::{LeaseAction, Reading, Unavailable};
use drivegate_model::drive::control::ControlItem;
use drivegate_model::drive::{
    COMMUNICATION_ERROR_REACTION, COMMUNICATION_TIMEOUT, DriveIndex, FIELDBUS_FAULT_RESPONSE, ModelPoint, PollClass,
    Profile, Quality, Value,
};

/// Time after which an action that was not acknowledged is written again.
const AGAIN: Duration = Duration::from_secs(1);
/// Maximum number of reasons for a failed action that are distinguished; each is reported once.
const MOST_REASONS: usize = 8;

/// The lease of a drive, as handed over to the next bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Lease {
    state: State,
    /// Time by which the lease was prolonged since it was last renewed.
    prolonged: Duration,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum State {
    /// No client has commanded the drive since the gateway started.
    #[default]
    Unheard,
    /// No client has commanded the drive since the gateway started, and it was reported that the drive runs.
    RunsUnheard,
    /// The lease has been running since this time.
    Held(Instant),
    /// The lease expired while the drive ran, and the action is not acknowledged yet.
    RanOut,
    /// The lease has ended: the motor was at standstill without a run command when the lease expired, or the action was
    /// acknowledged.
    Ended,
}

impl From<State> for Lease {
    fn from(state: State) -> Lease {
        Lease {
            state,
            prolonged: Duration::ZERO,
        }
    }
}

impl Lease {
    /// A lease that runs since this time.
    pub fn held(since: Instant) -> Lease {
        State::Held(since).into()
    }

    /// The lease, with its time limit extended by a period in which the gateway did not run.
    #[must_use]
    pub fn after(self, stood: Duration) -> Lease {
        match self.state {
            State::Held(since) => Lease {
                state: State::Held(since + stood),
                ..self
            },
            _ => self,
        }
    }

    /// The protection that ends with the lease if no drive continues it, as text; `None` for a lease that has ended
    /// or never started.
    pub fn ends(self) -> Option<&'static str> {
        match self.state {
            State::Unheard | State::RunsUnheard | State::Ended => None,
            State::Held(_) => Some("nothing stops it any more if its client goes silent"),
            State::RanOut => Some("its action, which the drive has not acknowledged, is no longer written"),
        }
    }
}

/// The inputs of supervision, except process data.
#[derive(Debug, Clone, Copy)]
pub(super) struct Orders {
    /// Until when a client's queued or started command keeps the lease alive.
    pub(super) held_until: Option<Instant>,
}

/// The action that supervision requires.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Demand {
    /// Supervision requires no action.
    None,
    /// Write this point of the model; report the result to [`Supervision::ordered`].
    Write(ModelPoint, Value),
    /// Withdraw an action that is queued and not started.
    Withdraw,
}

/// The supervision of one drive.
#[derive(Debug, Default)]
pub(super) struct Supervision {
    lease: Lease,
    /// Receiver of the action's pending result.
    answer: Option<Receiver<Answer>>,
    next_try: Option<Instant>,
    /// The reported reason why the action could not be written.
    refused: Option<Refusal>,
    /// Whether it was reported that the drive does not show whether it runs.
    blind_reported: bool,
    /// How long the drive has answered without showing whether its motor runs, and when that was last calculated.
    waited: Option<(Duration, Instant)>,
    /// A failure of the action that is not reported yet.
    failure: Option<Outcome>,
    /// Failed attempts of the present action, and the reported reasons.
    failures: u32,
    reasons: Vec<String>,
}

impl Supervision {
    /// Continues the lease of the previous bus.
    pub(super) fn take_over(&mut self, lease: Lease) {
        self.lease = lease;
    }

    /// The lease for the handover to the next bus.
    pub(super) fn lease(&self) -> Lease {
        self.lease
    }

    /// Whether the lease is running.
    pub(super) fn is_held(&self) -> bool {
        matches!(self.lease.state, State::Held(_))
    }

    /// Whether the lease expired, and its action is not acknowledged.
    pub(super) fn owes_action(&self) -> bool {
        self.lease.state == State::RanOut
    }

    /// Whether the drive runs and no client has commanded it since the gateway started.
    pub(super) fn runs_unclaimed(&self) -> bool {
        self.lease.state == State::RunsUnheard
    }

    /// Renews the lease: a client's command was sent or ended, or its heartbeat arrived.
    pub(super) fn renew(&mut self, now: Instant) {
        self.lease = Lease::held(match self.lease.state {
            State::Held(since) => since.max(now),
            _ => now,
        });
        self.begin_anew();
    }

    /// Extends the lease by a time during which the gateway itself received nothing, by at most one timeout since
    /// the lease was renewed.
    pub(super) fn prolong(&mut self, time: Duration, timeout: Duration) {
        if let State::Held(since) = &mut self.lease.state {
            let time = time.min(timeout.saturating_sub(self.lease.prolonged));
            *since += time;
            self.lease.prolonged += time;
        }
    }

    /// Starts again, because the action or the lease has changed.
    fn begin_anew(&mut self) {
        (self.refused, self.next_try) = (None, None);
        (self.failure, self.failures) = (None, 0);
        self.reasons.clear();
    }

    /// The action that is due at `now`.
    pub(super) fn due_action(
        &mut self,
        reading: &Reading<'_>,
        words: &KnownWords,
        orders: Orders,
        now: Instant,
        news: &mut Vec<News>,
        drive: DriveIndex,
    ) -> Demand {
        let Some(spec) = &reading.spec.supervision else {
            return Demand::None;
        };
        self.count_in_vain(reading, now);
        let held = orders.held_until.is_some_and(|until| until > now);
        match self.lease.state {
            State::Unheard => {
                if !held && reading.is_set(ModelPoint::Running) {
                    self.lease = State::RunsUnheard.into();
                    news.push(News::RunsUnsupervised(
                        drive,
                        if spec.adopt { Adopted::Yes } else { Adopted::No },
                    ));
                    if spec.adopt {
                        self.renew(now);
                    }
                }
                Demand::None
            }
            State::Ended | State::RunsUnheard => {
                self.report_failure(news, drive);
                Demand::None
            }
            // The action of the previous lease, which a client that is back has suspended permanently.
            State::Held(_) if self.answer.is_some() => Demand::Withdraw,
            State::Held(since) => {
                if has_run_out(since, spec.timeout, now) && !held {
                    self.runs_out(since, reading, words, news, drive);
                }
                match self.lease.state {
                    State::RanOut => self.act(reading, now),
                    _ => Demand::None,
                }
            }
            State::RanOut => {
                self.note_answer(now);
                self.report_failure(news, drive);
                match self.lease.state {
                    // Suspended: anyone who is back decides, if the order reaches the wire.
                    State::RanOut if held && self.answer.is_some() => Demand::Withdraw,
                    State::RanOut if !held => self.act(reading, now),
                    _ => Demand::None,
                }
            }
        }
    }

    /// Handles the expiry of a lease that started at `since`. Whether a drive runs that is silent, or not read
    /// since, is unknown: its lease stays until it is read. For a drive that replies without reporting this, the
    /// wait is limited.
    fn runs_out(
        &mut self,
        since: Instant,
        reading: &Reading<'_>,
        words: &KnownWords,
        news: &mut Vec<News>,
        drive: DriveIndex,
    ) {
        let in_vain = self.waits_in_vain(reading);
        let Some(running) = self.running(since, reading, words, in_vain, news, drive) else {
            return;
        };
        // A motor with its run command on may run, or start, whatever its status shows.
        let commanded = || is_commanded(reading, words, since, in_vain);
        let Some(acts) = running.then_some(true).or_else(commanded) else {
            return;
        };
        let read_since = reading.model(ModelPoint::Running).at.is_none_or(|at| at > since);
        if acts {
            let holds = matches!(
                reading.spec.supervision.as_ref().map(|s| &s.action),
                Some(LeaseAction::LeaveRunning)
            );
            self.lease = if holds { State::Ended } else { State::RanOut }.into();
            self.begin_anew();
            news.push(News::LeaseRanOut(drive));
        } else if read_since {
            self.lease = State::Ended.into();
        }
    }

    /// Counts how long the drive has answered without showing whether its motor runs. Time in which it does not
    /// answer is not counted: everything is read again after that.
    fn count_in_vain(&mut self, reading: &Reading<'_>, now: Instant) {
        let is_shown =
            |point| reading.spec.profile.model_point(point).is_none() || reading.model(point).good().is_some();
        if [ModelPoint::Running, ModelPoint::Run].into_iter().all(is_shown) {
            self.waited = None;
            return;
        }
        let online = reading.snapshot.link.is_online();
        let (time, until) = self.waited.unwrap_or((Duration::ZERO, now));
        let passed = now.saturating_duration_since(until);
        let time = if online { time + passed } else { time };
        self.waited = Some((time, now));
    }

    /// Whether the drive has answered for as long as a read of its running state may take.
    fn waits_in_vain(&self, reading: &Reading<'_>) -> bool {
        let online = reading.snapshot.link.is_online();
        let time = self.waited.map_or(Duration::ZERO, |(time, _)| time);
        let points = [ModelPoint::Running, ModelPoint::Run];
        let mut points = points
            .iter()
            .filter_map(|point| reading.spec.profile.model_point(*point));
        let slow = points.any(|point| point.raw().is_some() && point.class == PollClass::Slow);
        let patience = reading.stale_after + if slow { reading.slow_cycle } else { Duration::ZERO };
        online && time >= patience
    }

    /// Whether the motor runs. If the drive answers without reporting this, its run command counts instead; an
    /// unknown run command counts as set.
    fn running(
        &mut self,
        since: Instant,
        reading: &Reading<'_>,
        words: &KnownWords,
        in_vain: bool,
        news: &mut Vec<News>,
        drive: DriveIndex,
    ) -> Option<bool> {
        if let Some(running) = reading.model(ModelPoint::Running).good() {
            return Some(running.as_bool());
        }
        if !reading.snapshot.link.is_online() || !(in_vain || does_not_say(reading)) {
            return None;
        }
        if !std::mem::replace(&mut self.blind_reported, true) {
            news.push(News::RunningUnknown(drive));
        }
        // A run command that was read before the last order says nothing about what that order did.
        let run = reading.model(ModelPoint::Run);
        if let Some(set) = run.good().filter(|_| run.at.is_some_and(|at| at > since)) {
            return Some(set.as_bool());
        }
        Some(written_run(&reading.spec.profile, words).unwrap_or(true))
    }

    /// Records the result of the pending action.
    fn note_answer(&mut self, now: Instant) {
        let Some(answer) = &mut self.answer else { return };
        match answer.try_recv() {
            Err(TryRecvError::Empty) => return,
            Ok(answer) if answer.outcome.is_ok() => self.lease = State::Ended.into(),
            Ok(answer) => self.not_acknowledged(answer.outcome, now),
            Err(TryRecvError::Closed) => self.next_try = Some(now + AGAIN),
        }
        self.answer = None;
    }

    /// Schedules the action again after a failure.
    fn not_acknowledged(&mut self, outcome: Outcome, now: Instant) {
        self.next_try = Some(now + AGAIN);
        self.failure = Some(outcome).filter(has_failed);
    }

    /// Reports a failed action, and one that succeeded after that.
    fn report_failure(&mut self, news: &mut Vec<News>, drive: DriveIndex) {
        if let Some(outcome) = self.failure.take() {
            self.failures = self.failures.saturating_add(1);
            let why = outcome.to_string();
            let is_new = self.reasons.len() < MOST_REASONS && !self.reasons.contains(&why);
            if is_new {
                self.reasons.push(why.clone());
            }
            let why = is_new.then_some(why);
            news.push(News::ActionFailed { drive, why });
        }
        if self.lease.state == State::Ended && self.failures > 0 {
            news.push(News::ActionTaken {
                drive,
                failures: std::mem::take(&mut self.failures),
            });
        }
    }

    /// Writes the action; to a silent drive, when it is back.
    fn act(&mut self, reading: &Reading<'_>, now: Instant) -> Demand {
        let waits = self.answer.is_some();
        let due = !waits && self.next_try.is_none_or(|at| at <= now) && reading.snapshot.link.is_online();
        match reading.spec.supervision.as_ref().map(|s| &s.action) {
            Some(LeaseAction::Stop) if due => Demand::Write(ModelPoint::Run, Value::Bool(false)),
            Some(LeaseAction::SpeedReference(percent)) if due => {
                // The limits may exclude a reference with that sign.
                let is_refused = matches!(self.refused, Some(Refusal::BadValue(_)));
                let percent = if is_refused {
                    *percent
                } else {
                    keeping_sign(*percent, reading)
                };
                Demand::Write(ModelPoint::SpeedReference, Value::Number(percent))
            }
            _ => Demand::None,
        }
    }

    /// The action was ordered, or refused. Whether a refusal is to be reported: each is once.
    pub(super) fn ordered(&mut self, ordered: Result<Receiver<Answer>, Refusal>, now: Instant) -> Option<Refusal> {
        match ordered {
            Ok(answer) => {
                self.answer = Some(answer);
                None
            }
            Err(refusal) => {
                self.next_try = Some(now + AGAIN);
                let new = self.refused.as_ref() != Some(&refusal);
                self.refused = Some(refusal.clone());
                new.then_some(refusal)
            }
        }
    }

    /// Withdraws the action, unless it was sent and will still get its result.
    pub(super) fn withdrawn(&mut self, now: Instant) {
        match self.lease.state {
            State::RanOut => {
                self.note_answer(now);
                if self.answer.is_none() {
                    self.next_try = None;
                }
            }
            _ => self.answer = None,
        }
    }

    /// Records results before a bus ends: an acknowledged action is not due again.
    pub(super) fn settle(&mut self, now: Instant) {
        if self.lease.state == State::RanOut {
            self.note_answer(now);
        }
    }
}

/// The reference with the sign of the one in force: a lease that ends reverses no motor.
fn keeping_sign(percent: f64, reading: &Reading<'_>) -> f64 {
    // The last known value counts however old it is: a drive may be back from an outage, and its reference not read yet.
    let in_force = reading.model(ModelPoint::SpeedReference).value.map(Value::as_f64);
    if percent > 0.0 && in_force.is_some_and(|percent| percent < 0.0) {
        -percent
    } else {
        percent
    }
}

/// Whether the drive answers without reporting whether its motor runs, because it refuses the point or the point is
/// not read.
fn does_not_say(reading: &Reading<'_>) -> bool {
    let Some(point) = reading.spec.profile.model_point(ModelPoint::Running) else {
        return true;
    };
    match point.raw() {
        Some(_) if !point.is_read() => true,
        Some(raw) => matches!(
            reading.words(raw.table, raw.address, raw.form.items()),
            Err(Unavailable::Refused(_))
        ),
        None => reading.age().is_some() && reading.model(ModelPoint::Running).quality == Quality::Bad,
    }
}

/// Whether the run command is set in the drive's word, as read since the last order; as last written, if waiting
/// for the read was useless or the drive does not report its word; `None` while it must still be read. A word
/// unknown in both ways counts as unset.
fn is_commanded(reading: &Reading<'_>, words: &KnownWords, since: Instant, in_vain: bool) -> Option<bool> {
    let sample = reading.model(ModelPoint::Run);
    if let Some(run) = sample.good().filter(|_| sample.at.is_some_and(|at| at > since)) {
        return Some(run.as_bool());
    }
    let profile = &reading.spec.profile;
    let run = profile.run_place();
    let control = profile.control.as_ref();
    let is_unreadable = |place: ControlItem| control.is_some_and(|control| control.is_unreadable(place));
    let is_read = |place: ControlItem| {
        let word = reading.words(place.table, place.address, 1);
        !is_unreadable(place) && matches!(word, Ok(_) | Err(Unavailable::Stale))
    };
    if !in_vain && run.is_some_and(is_read) {
        return None;
    }
    Some(written_run(profile, words).unwrap_or(false))
}

/// The run command in the drive's word, as far as the word is known.
pub(super) fn written_run(profile: &Profile, words: &KnownWords) -> Option<bool> {
    let place = profile.run_place()?;
    let word = words.get(place.table, place.address)?;
    Some(profile.runs_by(place.table, place.address, word).unwrap_or(false))
}

/// Whether a lease that was renewed last at `since` ends.
fn has_run_out(since: Instant, timeout: Duration, now: Instant) -> bool {
    now.saturating_duration_since(since) >= timeout
}

/// Whether this outcome is a failed action; not if another command replaced the action, or the bus restarts.
fn has_failed(outcome: &Outcome) -> bool {
    !matches!(
        outcome,
        Outcome::Withdrawn | Outcome::Replaced | Outcome::Purged | Outcome::ShuttingDown
    )
}

/// A drive's own response to a silent master, as far as its registers show it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum OwnResponse {
    /// The response was not read yet, or the profile has no point for it.
    Unknown,
    /// The response is switched off in the drive; contains the point that shows this.
    Off(&'static str),
    /// The drive responds, if settings without a register are set too (such as the timeout of an option board).
    On,
}

/// Points that show a drive's own response to a silent master, with the value that means no response.
const RESPONSES: [(&str, f64); 3] = [
    (FIELDBUS_FAULT_RESPONSE, 0.0),
    (COMMUNICATION_TIMEOUT, 0.0),
    (COMMUNICATION_ERROR_REACTION, 3.0),
];

/// The drive's own response; "none" only if one of the profile's points shows that.
pub(super) fn own_response(reading: &Reading<'_>) -> OwnResponse {
    let mut seen = OwnResponse::Unknown;
    for (name, none) in RESPONSES {
        let Some(point) = reading.spec.profile.point_index(name) else {
            continue;
        };
        let Some(value) = reading.sample(point).good() else {
            return OwnResponse::Unknown;
        };
        if value.as_f64() == none {
            return OwnResponse::Off(name);
        }
        seen = OwnResponse::On;
    }
    seen
}

#[cfg(test)]
mod tests;
