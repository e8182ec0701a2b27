//! Confirms an acknowledged command by the first later read that shows its effect. Pure.

use std::time::{Duration, Instant};

use drivegate_core::order::{Order, Receipt, written};
use drivegate_core::process_image::Reading;
use drivegate_model::drive::profile::Form;
use drivegate_model::drive::{ModelPoint, Point, PointIndex, Profile, Value};

/// Commands to one drive that are watched at one time; beyond that the oldest stays "acknowledged".
const WATCHED: usize = 8;
/// A motor counts as decelerating if its speed falls by more than this, in Hz, or in percent if no frequency is
/// read. Less is ripple.
const RIPPLE: f64 = 0.25;

/// On a busy line the next read may be late; a missing effect is reported only after this multiple of the
/// confirmation time.
const UNREAD: u32 = 5;

/// The effect that a read must show.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Effect {
    /// Effect: the motor runs.
    Runs,
    /// The motor does not run, or is at standstill.
    Stops,
    /// Effect: no fault is active.
    NoFault,
    /// The point (index in the profile) reads back as written.
    ReadBack(PointIndex, Value),
}

impl Effect {
    /// Whether the newer effect supersedes the older one.
    fn same_subject(self, other: Effect) -> bool {
        match (self, other) {
            (Effect::Runs | Effect::Stops, Effect::Runs | Effect::Stops) | (Effect::NoFault, Effect::NoFault) => true,
            (Effect::ReadBack(a, _), Effect::ReadBack(b, _)) => a == b,
            _ => false,
        }
    }

    /// The missing effect as text.
    fn missing(self, profile: &Profile) -> String {
        match self {
            Effect::Runs => "the motor does not run".to_string(),
            Effect::Stops => "the motor does not stop".to_string(),
            Effect::NoFault => "the fault is still active".to_string(),
            Effect::ReadBack(index, value) => {
                let name = profile.points.get(index).map_or("?", |p| p.name.as_str());
                format!("`{name}` does not read {value}")
            }
        }
    }
}

/// The effects of the command that polling will show; empty if it shows none.
pub fn effects(profile: &Profile, order: &Order) -> Vec<Effect> {
    let mut effects: Vec<Effect> = Vec::new();
    let mut add = |effect: Option<Effect>| {
        if let Some(effect) = effect
            && !effects.contains(&effect)
        {
            effects.push(effect);
        }
    };
    match order {
        Order::Points(values) => {
            for (index, value) in values {
                add(effect_of(profile, *index, *value));
            }
        }
        Order::Write(pdu) => {
            let Some((table, items)) = written(pdu) else {
                return effects;
            };
            let run = items
                .iter()
                .find_map(|(address, word)| profile.runs_by(table, *address, *word));
            let index = profile.model_index(ModelPoint::Run);
            add(index
                .zip(run)
                .and_then(|(index, run)| effect_of(profile, index, Value::Bool(run))));
            let word_at = |address| items.iter().find(|(at, _)| *at == address).map(|(_, word)| *word);
            for (index, point) in profile.points.enumerate().filter(|(_, p)| p.write && !p.pulse) {
                let Some(raw) = point.raw().filter(|r| r.table == table) else {
                    continue;
                };
                let words: Option<Vec<u16>> = raw.addresses().map(word_at).collect();
                if let Some(value) = words.and_then(|words| raw.decode(&words, point.kind())) {
                    add(effect_of(profile, index, value));
                }
            }
        }
        // A parameter is read back before it is acknowledged, so it needs no confirmation.
        Order::Parameter(_) => {}
        Order::Read(_) => {}
    }
    effects
}

fn effect_of(profile: &Profile, index: PointIndex, value: Value) -> Option<Effect> {
    let is = |point| profile.model_index(point) == Some(index);
    let reads = |point| profile.model_point(point).is_some_and(Point::is_read);
    if is(ModelPoint::Run) && reads(ModelPoint::Running) {
        return Some(if value.as_bool() { Effect::Runs } else { Effect::Stops });
    }
    if is(ModelPoint::FaultReset) {
        return (value.as_bool() && reads(ModelPoint::Fault)).then_some(Effect::NoFault);
    }
    let point = profile.points.get(index)?;
    let readable = point.is_read() && !point.pulse && point.raw().is_some();
    readable.then_some(Effect::ReadBack(index, value))
}

/// Whether the reading shows the effect, by samples read after `since`; `None` if there are no such samples.
fn shows(effect: Effect, reading: &Reading<'_>, since: Instant) -> Option<bool> {
    let after =
        |sample: drivegate_model::drive::Sample| sample.good().filter(|_| sample.at.is_some_and(|at| at > since));
    let model = |point| after(reading.model(point));
    match effect {
        Effect::Runs => model(ModelPoint::Running).map(Value::as_bool),
        Effect::NoFault => model(ModelPoint::Fault).map(|fault| !fault.as_bool()),
        Effect::Stops => {
            let stopped = model(ModelPoint::Running).map(|running| !running.as_bool());
            // The speed is not used: in percent of a band from a minimum frequency, 0 % is a motor that turns.
            let stands = model(ModelPoint::OutputFrequency).map(is_standstill);
            stopped.into_iter().chain(stands).reduce(|a, b| a || b)
        }
        Effect::ReadBack(index, value) => {
            let read = after(reading.sample(index))?;
            let raw = reading.spec.profile.points.get(index)?.raw()?;
            Some(match raw.form {
                Form::Bit { .. } => read.as_bool() == value.as_bool(),
                // Values are compared as the register holds them.
                _ => raw.encode(read, 0).ok() == raw.encode(value, 0).ok(),
            })
        }
    }
}

fn is_standstill(output_frequency: Value) -> bool {
    output_frequency.as_f64() == 0.0
}

/// The speed of the motor in either direction: its output frequency, because that falls to zero while a percentage
/// of a band does not; the percentage if the profile has nothing else.
fn speed(reading: &Reading<'_>) -> Option<Speed> {
    let has = |point: &ModelPoint| reading.spec.profile.model_point(*point).is_some();
    let point = [ModelPoint::OutputFrequency, ModelPoint::ActualSpeed]
        .into_iter()
        .find(has)?;
    let value = reading.model(point).good()?.as_f64().abs();
    Some(Speed {
        value,
        unit: point.unit(),
    })
}

/// The magnitude of a motor's speed.
#[derive(Debug, Clone, Copy)]
struct Speed {
    value: f64,
    /// `Hz`, or `%` where no frequency is read.
    unit: &'static str,
}

/// An effect that a read must show.
#[derive(Debug, Clone, Copy)]
struct Awaited {
    effect: Effect,
    /// Whether the drive was read since, as far as the effect could show: not every value is read in every round.
    was_read: bool,
}

/// An acknowledged command that waits for confirmation.
#[derive(Debug)]
struct Watch {
    effects: Vec<Awaited>,
    since: Instant,
    within: Duration,
    /// Lowest speed since the acknowledgement, and when it last fell.
    slowest: Option<Speed>,
    fell_at: Instant,
    /// The command, as text.
    what: String,
    /// The latest reason why the effect cannot be seen.
    unseen: Option<String>,
    /// Whether supervision, or the shutdown of the gateway, gave the command.
    own: bool,
    /// Receipts of clients that wait for confirmation; empty once the time has passed without a conclusion.
    receipts: Vec<Receipt>,
}

impl Watch {
    fn is_over(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.since) >= self.within
    }

    fn has(&self, effect: Effect) -> bool {
        self.effects.iter().any(|awaited| awaited.effect == effect)
    }

    /// Whether a motor that is to stop still slows down.
    fn slows_down(&self, now: Instant) -> bool {
        self.has(Effect::Stops) && now.saturating_duration_since(self.fell_at) < self.within
    }

    /// Whether it is too early to report an unread effect as missing.
    fn waits_for_reads(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.since) < self.within * UNREAD
    }

    /// Whether it is too early to report the effect as missing: the motor is still decelerating, or the drive was not
    /// read.
    fn is_open(&self, now: Instant) -> bool {
        let unread = self.effects.iter().any(|awaited| !awaited.was_read);
        (unread && self.waits_for_reads(now)) || self.slows_down(now)
    }

    /// Takes the effects that can now be reported as missing.
    fn take_missing(&mut self, now: Instant) -> Vec<Awaited> {
        let waits = self.waits_for_reads(now);
        let (missing, open) = self
            .effects
            .drain(..)
            .partition(|awaited: &Awaited| awaited.was_read || !waits);
        self.effects = open;
        missing
    }

    /// The missing effects of a command as text.
    fn report(&self, missing: &[Awaited], profile: &Profile, now: Instant) -> String {
        let Watch { what, within, .. } = self;
        if missing.iter().all(|awaited| !awaited.was_read) {
            let within = *within * UNREAD;
            return format!(
                "acknowledged {what} but was not read within {within:?}; whether it took effect is unknown"
            );
        }
        if let Some(unseen) = &self.unseen {
            return format!("acknowledged {what}; whether it took effect is unknown: {unseen}");
        }
        let passed = now.saturating_duration_since(self.since).as_secs();
        let within = (*within).max(Duration::from_secs(passed));
        let read = missing.iter().filter(|awaited| awaited.was_read);
        let missing: Vec<String> = read.map(|awaited| awaited.effect.missing(profile)).collect();
        let missing = missing.join(", ");
        format!("acknowledged {what} but did not show it within {within:?}: {missing}")
    }

    /// Ends the wait at `now`: waiting clients get the reason, if known.
    fn let_go(&mut self, now: Instant) {
        let falling = self.slowest.filter(|_| self.slows_down(now));
        let slows = falling.map(|speed| format!("the motor is still slowing down, {:.0} {}", speed.value, speed.unit));
        let why = self.unseen.clone().or(slows);
        for receipt in self.receipts.drain(..) {
            match &why {
                Some(why) => receipt.cannot_be_seen(why),
                None => drop(receipt),
            }
        }
    }

    fn note_speed(&mut self, reading: &Reading<'_>, now: Instant) {
        let Some(speed) = speed(reading) else {
            return;
        };
        match self.slowest {
            Some(slowest) if speed.value >= slowest.value - RIPPLE => {}
            Some(_) => (self.slowest, self.fell_at) = (Some(speed), now),
            None => self.slowest = Some(speed),
        }
    }
}

/// A command that showed no effect in time.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unconfirmed {
    /// The missing effects as text.
    pub text: String,
    /// The motor was to run, and does not.
    pub does_not_run: bool,
    /// Whether the command was the action of a lease.
    pub own: bool,
}

/// The acknowledged commands of a drive that may still be confirmed.
#[derive(Debug, Default)]
pub struct Confirmations {
    watches: Vec<Watch>,
    /// Points that must be read to show the effect of the last commands.
    to_read: Vec<PointIndex>,
}

impl Confirmations {
    /// Watches for the effects of a command that was acknowledged at `now`; `reading` is the known state of the
    /// drive at that time. Older commands with the opposite effect are no longer watched.
    pub fn watch(&mut self, effects: Vec<Effect>, receipts: Vec<Receipt>, reading: &Reading<'_>, now: Instant) {
        self.watches.retain(|w| {
            let pointless = |old: &Effect| effects.iter().any(|new| new.same_subject(*old));
            !w.effects.iter().any(|awaited| pointless(&awaited.effect))
        });
        if effects.is_empty() {
            return;
        }
        if self.watches.len() >= WATCHED {
            self.watches.remove(0);
        }
        self.to_read.extend(effects.iter().filter_map(|effect| match effect {
            Effect::ReadBack(index, _) => Some(*index),
            Effect::Runs | Effect::Stops | Effect::NoFault => None,
        }));
        let unread = |effect| Awaited {
            effect,
            was_read: false,
        };
        self.watches.push(Watch {
            effects: effects.into_iter().map(unread).collect(),
            since: now,
            within: reading.spec.profile.confirm_within,
            slowest: speed(reading),
            fell_at: now,
            what: receipts
                .first()
                .map(|receipt| receipt.what().to_string())
                .unwrap_or_default(),
            unseen: None,
            own: receipts.iter().any(|receipt| receipt.is_of_gateway()),
            receipts,
        });
    }

    /// The drive was read: confirms the commands whose effect it shows in time.
    pub fn take_reading(&mut self, reading: &Reading<'_>, now: Instant) {
        let mut index = 0;
        while let Some(watch) = self.watches.get_mut(index) {
            let since = watch.since;
            watch.note_speed(reading, now);
            if !watch.is_over(now) || watch.is_open(now) {
                let stops = watch.has(Effect::Stops);
                watch.unseen = stops.then(|| reading.may_turn()).flatten();
                let unseen = watch.unseen.is_some();
                watch.effects.retain_mut(|awaited| {
                    let shown = shows(awaited.effect, reading, since);
                    awaited.was_read |= shown.is_some();
                    shown != Some(true) || (unseen && awaited.effect == Effect::Stops)
                });
            }
            if watch.is_over(now) {
                // The effect was shown too late for the waiting clients.
                watch.let_go(now);
            }
            if watch.effects.is_empty() {
                let receipts = self.watches.remove(index).receipts;
                receipts.into_iter().for_each(|receipt| receipt.confirm(now));
            } else {
                index += 1;
            }
        }
    }

    /// Commands whose effect did not appear in time, as text, each once. For a motor that is still decelerating, or
    /// points not read since, nothing is reported yet, but the wait ends.
    pub fn expire(&mut self, profile: &Profile, now: Instant) -> Vec<Unconfirmed> {
        let mut late = Vec::new();
        self.watches.retain_mut(|watch| {
            if !watch.is_over(now) {
                return true;
            }
            watch.let_go(now);
            if watch.slows_down(now) {
                return true;
            }
            let missing = watch.take_missing(now);
            if !missing.is_empty() {
                let runs = |awaited: &Awaited| awaited.was_read && awaited.effect == Effect::Runs;
                late.push(Unconfirmed {
                    text: watch.report(&missing, profile, now),
                    does_not_run: missing.iter().any(runs),
                    own: watch.own,
                });
            }
            !watch.effects.is_empty()
        });
        late
    }

    /// Ends all waits: acknowledged commands stay acknowledged.
    pub fn clear(&mut self) {
        *self = Confirmations::default();
    }

    /// Points whose next read confirms a command that has just been acknowledged. Polling alone would not read them: they
    /// may be read only when a drive comes online, and a command that changes nothing writes nothing, or their read may have
    /// been done between the write and the acknowledgement of the whole command.
    pub fn take_to_read(&mut self) -> Vec<PointIndex> {
        std::mem::take(&mut self.to_read)
    }

    /// Whether no command is being watched.
    pub fn is_empty(&self) -> bool {
        self.watches.is_empty()
    }
}

#[cfg(test)]
mod tests;
