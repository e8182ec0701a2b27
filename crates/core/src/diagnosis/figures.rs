//! The counters: for each drive and for the line, in steps of the last minute. Bounded; a successful transaction costs
//! a few additions.

mod drive;

use std::time::{Duration, Instant};

pub use self::drive::{Drive, Sign};

use super::STEP;
use super::counters::{Contrast, FADE, InPhase, LATENCY, LONGEST_AGE, MAINS, Running, STEPS, Window, lock};
use super::signature::{self, Answering, Shape};
use drivegate_model::drive::{DriveIndex, PerDrive};
use drivegate_proto::describe::{self, Kind};
use drivegate_proto::wire::BAUDS;
use drivegate_proto::{LineFormat, Protocol, Request};

/// Maximum memory per drive; a line has at most 2 KiB in addition.
pub const BYTES_PER_DRIVE: usize = 512;
/// Number of requests in a row without a reply that count as absence: the drive is off, not badly connected.
const ABSENCE: u16 = 12;
/// A reply within this time after a request without a reply may be a late reply to that request.
const LATE: Duration = Duration::from_secs(5);
/// Time for which the rest of a damaged reply may be on the line.
const LEFT_OVER: Duration = Duration::from_millis(50);
/// Maximum number of bytes between two transactions that are kept until it is clear whether they are a frame.
const MOST_IDLE: usize = 300;
/// Losses of the port that are remembered, and for how long.
const LOSSES: usize = 8;
const LOSSES_FOR: Duration = Duration::from_secs(600);

/// The result of a transaction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum End {
    /// The drive replied, perhaps with an exception.
    Answered,
    /// No reply arrived in time.
    Silent,
    /// The reply was invalid.
    Damaged,
    /// A reply that may belong to another request, so it says nothing about the line.
    Doubtful,
}

#[derive(Debug, Clone, Copy)]
pub struct Exchange<'e> {
    /// Index of the drive on the bus.
    pub drive: DriveIndex,
    /// The request of the transaction.
    pub request: &'e Request,
    pub frame: &'e [u8],
    /// All bytes received in this transaction.
    pub seen: &'e [u8],
    /// Bytes received after the reply.
    pub behind: &'e [u8],
    /// Whether foreign frames or stray bytes are among `seen`.
    pub foreign: bool,
    /// Result of the transaction.
    pub end: End,
    /// Silence before the request.
    pub gap: Duration,
    /// When the request was started.
    pub began: Instant,
    /// When the transaction ended.
    pub at: Instant,
    /// When the last bytes arrived; irrelevant if no bytes arrived.
    pub heard_at: Instant,
    /// Time until the reply started; `None` without a reply.
    pub turnaround: Option<Duration>,
}

/// The settings of a line.
#[derive(Debug, Clone, Copy)]
pub struct Line {
    pub protocol: Protocol,
    /// Baud rate and character format.
    pub format: LineFormat,
    /// Silence before each request; on a line of another master the least that is usual.
    pub silence: Duration,
    /// Time for the first byte of a reply.
    pub response_timeout: Duration,
}

/// The counters of a line.
#[derive(Debug, Clone)]
pub struct Figures {
    /// Settings of the line.
    pub line: Line,
    pub drives: PerDrive<Drive>,
    /// Number of valid replies by the millisecond of their arrival, modulo the latency timer. Requests after a
    /// pause are counted in the same way.
    arrivals: Window<LATENCY>,
    paced: Window<LATENCY>,
    running: Running,
    /// Requests sent directly after a reply, compared with requests after a pause.
    pub pause: Contrast,
    /// Number of valid replies from an address to which no request was sent, by step.
    wrong: Window<1>,
    idle: Vec<u8>,
    last: Option<(DriveIndex, End)>,
    /// When the previous transaction ended.
    last_at: Instant,
    epoch: Instant,
    step_ends: Instant,
    opened: Option<Instant>,
    answered_since_opened: bool,
    losses: [Option<Instant>; LOSSES],
    /// Replies that were too early for the configured baud rate, by the lowest of [`BAUDS`] that they fit.
    early: Window<{ BAUDS.len() + 1 }>,
    /// Connections that a device server closed, and that were remade.
    reconnects: Window<1>,
}

impl Figures {
    /// A line whose port is not open yet, with drives at these addresses.
    pub fn new(line: Line, addresses: impl IntoIterator<Item = u8>, now: Instant) -> Figures {
        let drive = |address| Drive {
            address,
            window: Window::new(),
            slowest: Window::new(),
            response_timeout: line.response_timeout,
            run: 0,
            run_paused: [0; 2],
            silent_at: None,
            mains: InPhase::default(),
            unanswered: Some(0),
        };
        Figures {
            line,
            drives: addresses.into_iter().map(drive).collect(),
            arrivals: Window::new(),
            paced: Window::new(),
            running: Running::default(),
            pause: Contrast::default(),
            wrong: Window::new(),
            idle: Vec::new(),
            last: None,
            last_at: now,
            epoch: now,
            step_ends: now + STEP,
            opened: None,
            answered_since_opened: false,
            losses: [None; LOSSES],
            early: Window::new(),
            reconnects: Window::new(),
        }
    }

    /// Notes that the port was opened.
    pub fn port_opened(&mut self, now: Instant) {
        self.opened = Some(now);
        self.answered_since_opened = false;
        (self.last, self.idle) = (None, Vec::new());
        for drive in &mut self.drives {
            (drive.run, drive.run_paused, drive.silent_at) = (0, [0; 2], None);
        }
    }

    /// The port was lost.
    pub fn port_lost(&mut self, now: Instant) {
        if self.opened.take().is_some() {
            self.losses.rotate_right(1);
            self.losses[0] = Some(now);
        }
    }

    /// A device server closed its connection, and the gateway connected again.
    pub fn reconnected(&mut self) {
        self.reconnects.add(0, 1);
    }

    /// How often a device server closed its connection in the last minute, and in how many steps of that minute.
    pub fn reconnects(&self) -> (u32, usize) {
        let steps = self.reconnects.each(0).filter(|count| *count > 0).count();
        (self.reconnects.sum(0), steps)
    }

    /// Notes that a reply was too early for the configured baud rate and is possible at `baud`.
    pub fn note_too_early(&mut self, baud: u32) {
        self.early.add(BAUDS.partition_point(|usual| *usual < baud), 1);
    }

    /// Number of replies in the last minute that were too early for the configured baud rate, by the lowest baud
    /// rate of [`BAUDS`] at which they are possible. The last count is of replies that are possible at none.
    pub fn early(&self) -> [u32; BAUDS.len() + 1] {
        std::array::from_fn(|place| self.early.sum(place))
    }

    /// Number of recent losses of the port.
    pub fn losses(&self, now: Instant) -> usize {
        let lately = |at: &&Instant| now.saturating_duration_since(**at) < LOSSES_FOR;
        self.losses.iter().flatten().filter(lately).count()
    }

    /// How long the port has been open.
    pub(crate) fn open_for(&self, now: Instant) -> Option<Duration> {
        self.opened.map(|opened| now.saturating_duration_since(opened))
    }

    /// Whether any drive has answered since the port was opened.
    pub(crate) fn answered_since_opened(&self) -> bool {
        self.answered_since_opened
    }

    /// Whether any drive runs from now on, as read at some time in the last `age`.
    pub fn set_running(&mut self, runs: bool, age: Duration) {
        self.running.age = self.running.age.max(age).min(LONGEST_AGE);
        self.running.change(runs);
    }

    /// Whether any drive of the line runs.
    pub fn runs(&self) -> bool {
        self.running.runs
    }

    /// The contrast of the line: errors while no drive runs and while one runs.
    pub fn while_running(&self) -> &Contrast {
        &self.running.contrast
    }

    /// How often this sign of a fault was counted in the last minute, for all drives together.
    pub fn sum(&self, sign: Sign) -> u32 {
        self.drives.iter().map(|drive| drive.sum(sign)).sum()
    }

    /// Number of valid replies in the last minute from addresses to which no request was sent.
    pub fn wrong_address(&self) -> u32 {
        self.wrong.sum(0)
    }

    /// Counts a transaction that has ended.
    pub fn exchange(&mut self, exchange: &Exchange<'_>) {
        self.settle_idle(exchange.began);
        let protocol = self.line.protocol;
        let answered = exchange.end == End::Answered;
        let seen = signature::of(protocol, exchange.request, exchange.frame, exchange.seen, answered);
        let condition = self.condition(exchange.gap);
        let Some(drive) = self.drives.get_mut(exchange.drive) else {
            return;
        };
        if let Some(echoed) = seen.echoed {
            drive.add(Sign::EchoShown);
            if echoed {
                drive.add(Sign::Echoed);
            }
        }
        let excused = self.is_excused(exchange);
        let Some(drive) = self.drives.get_mut(exchange.drive) else {
            return;
        };
        match exchange.end {
            End::Damaged | End::Silent if excused => {
                drive.add(Sign::Tried);
                if exchange.end == End::Silent {
                    drive.silent_at = Some(exchange.at);
                }
            }
            End::Answered => self.answered(exchange, seen.shape),
            End::Damaged => self.damaged(exchange, seen.shape),
            End::Silent => {
                drive.add(Sign::Tried);
                drive.run = drive.run.saturating_add(1);
                drive.unanswered = drive.unanswered.map(|asked| asked.saturating_add(1));
                if let Some(count) = condition.and_then(|condition| drive.run_paused.get_mut(condition)) {
                    *count = count.saturating_add(1);
                }
                drive.silent_at = Some(exchange.at);
            }
            End::Doubtful => {}
        }
        if let (Some(condition), End::Answered | End::Damaged, false) = (condition, exchange.end, excused) {
            self.pause.add(condition, 1.0, 0.0);
        }
        if exchange.foreign && !matches!(seen.shape, Shape::Led(_)) {
            let parts = describe::parts(protocol, exchange.request, exchange.frame, exchange.seen, answered);
            for part in parts.into_iter().filter(|part| part.kind == Kind::Foreign) {
                if part.range.end + exchange.behind.len() <= exchange.seen.len() {
                    self.answer_of_another(exchange.seen.get(part.range).unwrap_or_default(), exchange.at);
                }
            }
        }
        self.last = Some((exchange.drive, exchange.end));
        self.last_at = exchange.at;
        if answered {
            self.stray(exchange.behind);
        }
    }

    /// Whether a failure may be caused by bytes left on the line by a failed transaction with another drive just before.
    fn is_excused(&self, exchange: &Exchange<'_>) -> bool {
        let just_before = exchange.began.saturating_duration_since(self.last_at) < LEFT_OVER;
        exchange.end != End::Answered
            && just_before
            && self
                .last
                .is_some_and(|(drive, end)| drive != exchange.drive && end == End::Damaged)
    }

    fn condition(&self, gap: Duration) -> Option<usize> {
        let silence = self.line.silence;
        if gap <= silence.mul_f64(1.5) + Duration::from_millis(1) {
            Some(0)
        } else {
            (gap >= silence * 4 && gap >= Duration::from_millis(20)).then_some(1)
        }
    }

    fn answered(&mut self, exchange: &Exchange<'_>, shape: Shape) {
        self.is_there(exchange.drive, exchange.at);
        self.answered_since_opened = true;
        self.running.add(1.0, 0.0, exchange.at);
        self.arrivals.add(self.millisecond(exchange.at), 1);
        let follows = self.last.is_some_and(|(_, end)| end == End::Answered);
        if follows && exchange.gap >= self.line.silence + Duration::from_millis(4) {
            self.paced.add(self.millisecond(exchange.began), 1);
        }
        let (middle, length) = self.middle(exchange);
        let Some(drive) = self.drives.get_mut(exchange.drive) else {
            return;
        };
        let limit = drive.response_timeout / 2;
        drive.add(Sign::Answered);
        if let Shape::Led(zero) = shape {
            drive.add(Sign::Led);
            if zero {
                drive.add(Sign::LedZero);
            }
        }
        if let Some(turnaround) = exchange.turnaround {
            if turnaround > limit {
                drive.add(Sign::Slow);
            }
            drive.replied_after(turnaround);
        }
        drive.mains.add(middle, length, false);
    }

    fn damaged(&mut self, exchange: &Exchange<'_>, shape: Shape) {
        self.is_there(exchange.drive, exchange.at);
        let damage = self.damage_at(exchange);
        let Some(drive) = self.drives.get_mut(exchange.drive) else {
            return;
        };
        match shape {
            Shape::CutEcho => drive.add(Sign::CutEcho),
            Shape::StartLost => drive.add(Sign::StartLost),
            Shape::Led(zero) => {
                drive.add(Sign::Led);
                if zero {
                    drive.add(Sign::LedZero);
                }
            }
            Shape::Overlong | Shape::Nothing | Shape::Sound | Shape::EndLost | Shape::Garbled => {
                drive.add(Sign::Damaged);
                if shape == Shape::Overlong {
                    drive.add(Sign::Overlong);
                }
                if let Some(at) = damage {
                    drive.mains.add(at, Duration::ZERO, true);
                }
                self.running.add(1.0, 1.0, exchange.at);
            }
        }
    }

    /// The drive replied: earlier requests without a reply count, unless it was absent.
    fn is_there(&mut self, drive: DriveIndex, at: Instant) {
        let Some(drive) = self.drives.get_mut(drive) else {
            return;
        };
        drive.unanswered = None;
        let (run, paused) = (std::mem::take(&mut drive.run), std::mem::take(&mut drive.run_paused));
        if run == 0 || run > ABSENCE {
            return;
        }
        drive.window.add(Sign::Silent as usize, run);
        drive.silent_at = drive
            .silent_at
            .filter(|silent| at.saturating_duration_since(*silent) <= LATE);
        self.running.add(f32::from(run), f32::from(run), at);
        for (condition, count) in paused.into_iter().enumerate() {
            self.pause.add(condition, f32::from(count), f32::from(count));
        }
    }

    /// The time of the middle of a reply on the wire and, for text protocols, where the damaged character is known,
    /// the time that the whole reply took.
    fn middle(&self, exchange: &Exchange<'_>) -> (Instant, Duration) {
        let length = self.line.format.chars(exchange.seen.len());
        let middle = exchange.heard_at.checked_sub(length / 2).unwrap_or(exchange.at);
        (
            middle,
            if self.line.protocol.is_text() {
                length
            } else {
                Duration::ZERO
            },
        )
    }

    /// When a reply was damaged: in a text protocol a character may show it, else the middle is taken.
    fn damage_at(&self, exchange: &Exchange<'_>) -> Option<Instant> {
        if !self.line.protocol.is_text() {
            return Some(self.middle(exchange).0);
        }
        let misfit = signature::misfit(self.line.protocol, exchange.seen)?;
        exchange
            .heard_at
            .checked_sub(self.line.format.chars(exchange.seen.len() - misfit))
    }

    fn millisecond(&self, at: Instant) -> usize {
        (at.saturating_duration_since(self.epoch).as_millis() % LATENCY as u128) as usize
    }

    /// Counts bytes that arrived without a request.
    pub fn stray(&mut self, bytes: &[u8]) {
        let room = MOST_IDLE.saturating_sub(self.idle.len());
        self.idle.extend(bytes.iter().take(room));
    }

    /// The bytes since the last transaction are complete.
    fn settle_idle(&mut self, now: Instant) {
        if self.idle.is_empty() {
            return;
        }
        let bytes = std::mem::take(&mut self.idle);
        // Bytes that follow a damaged reply may be the rest of that reply.
        if !self.answer_of_another(&bytes, now)
            && let Some((drive, End::Answered)) = self.last
            && let Some(drive) = self.drives.get_mut(drive)
        {
            drive.add(Sign::Idle);
        }
    }

    /// Counts a valid but unexpected reply: a late one, a second one, or one from an address that was not polled.
    fn answer_of_another(&mut self, bytes: &[u8], at: Instant) -> bool {
        let Some(answering) = signature::answer(self.line.protocol, bytes) else {
            return false;
        };
        let asked = self.last.map(|(drive, _)| drive);
        let drive = match answering {
            Answering::Address(address) => self.drives.position(|drive| drive.address == address),
            // An N2 reply has no address, so any drive that was silent recently may have sent it late.
            Answering::Anybody => {
                let silent = self.drives.enumerate().filter(|(_, drive)| drive.was_silent(at));
                silent
                    .max_by_key(|(_, drive)| drive.silent_at)
                    .map(|(place, _)| place)
                    .or(asked)
            }
        };
        let is_second = drive.is_some() && self.last == drive.map(|drive| (drive, End::Answered));
        match drive.and_then(|drive| self.drives.get_mut(drive)) {
            Some(drive) if drive.was_silent(at) => drive.replied_late(at),
            Some(drive) if is_second => drive.add(Sign::Second),
            _ => self.wrong.add(0, 1),
        }
        true
    }

    /// Whether a step has ended by `now`, so that the rules are to be evaluated.
    pub fn is_step_over(&self, now: Instant) -> bool {
        now >= self.step_ends
    }

    /// Starts the next step of the last minute.
    pub fn next_step(&mut self, now: Instant) {
        let missed = now.saturating_duration_since(self.step_ends).as_secs() / STEP.as_secs();
        for _ in 0..=missed.min(STEPS as u64) {
            for drive in &mut self.drives {
                drive.window.roll();
                drive.slowest.roll();
                drive.mains.sums.iter_mut().flatten().for_each(|sum| *sum *= FADE);
            }
            self.arrivals.roll();
            self.paced.roll();
            self.wrong.roll();
            self.early.roll();
            self.reconnects.roll();
            self.running.contrast.fade();
            self.running.age = self.running.age.mul_f32(FADE);
            self.pause.fade();
        }
        self.step_ends = now + STEP;
    }

    /// How closely arrivals keep to the steps of a latency timer, 0 to 1, and how many there were; requests after a pause likewise.
    pub(crate) fn in_steps(&self) -> [(f64, u32); 2] {
        [lock(&self.arrivals), lock(&self.paced)]
    }

    /// For each mains frequency: number of damaged replies with an earlier one to compare with, and how much closer
    /// in phase to that one they are than the valid replies of the same drive, -2 to 2.
    pub(crate) fn in_phase(&self) -> [(f32, f32); MAINS.len()] {
        let of = |place: usize| {
            let sums = self.drives.iter().filter_map(|drive| drive.mains.sums.get(place));
            let (mut count, mut closer) = (0.0, 0.0);
            for &[bad, bad_cosines, good, good_cosines] in sums.filter(|[bad, _, good, _]| *bad >= 1.0 && *good >= 1.0)
            {
                // Each drive counts with the smaller of its two numbers, since the smaller one limits the certainty.
                let weight = bad.min(good);
                count += weight;
                closer += weight * (bad_cosines / bad - good_cosines / good);
            }
            (count, if count > 0.0 { closer / count } else { 0.0 })
        };
        std::array::from_fn(of)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_drive_takes_as_much_memory_as_is_stated() {
        assert!(size_of::<Drive>() <= BYTES_PER_DRIVE, "{}", size_of::<Drive>());
        assert!(size_of::<Figures>() + MOST_IDLE <= 2048, "{}", size_of::<Figures>());
    }
}
