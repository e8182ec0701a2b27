//! What a bus of N2 says to a drive beside reading and commanding it (n2.md 2 and 4). Pure: time is an argument.
//!
//! A drive that has started anew answers nothing before it is identified; then it reports, to polls, all it has. So a
//! drive is identified first, its report is taken (and thrown away: the layout is not known, values are read), then it
//! is read. `N00` at any time means that it has started anew: the same again.
//!
//! A reply names neither drive nor request. After an exchange that was not answered, or not believably, a late value of
//! one drive could pass for that of another. So the whole line has a fence then: it rests for the time of another reply,
//! and the next thing said, to whichever drive, is Identify, whose answer no float and no acknowledgement looks like. A
//! state does (a byte of 10h), and a late identity looks like a state; so a poll comes behind, whose answer is neither.
//! A stop does not wait for that: its acknowledgement is not taken for true, it goes out once more.

use std::time::Instant;

use super::transaction::Ended;
use crate::codec::n2::{N2Options, Session};
use crate::codec::{Exception, Reply};
use crate::command::Urgency;

/// Polls in which a drive has to tell all its changes.
pub const MOST_POLLS: u8 = 16;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// Identified never, or not since it went away.
    Unknown,
    /// It has said that it waits for Identify.
    Waiting,
    /// It reports what has changed: polls left, and whether the next one acknowledges the report before.
    Reporting { left: u8, again: bool },
    /// It is read and commanded.
    Ready,
}

/// What has to be answered in its own form before an answer on the line is believed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Fence {
    /// Nothing: no answer is owed.
    #[default]
    Open,
    /// Identify, and a poll behind it.
    Identify,
    /// A poll.
    Poll,
}

#[derive(Debug, Clone)]
struct Drive {
    options: N2Options,
    phase: Phase,
    /// A stop went out behind such an exchange and was acknowledged, perhaps late and by mistake.
    stop_repeated: bool,
    polled: Option<Instant>,
    /// It answered something since it was identified.
    proved: bool,
    /// The device type that was told last.
    device: Option<u8>,
}

/// What came of an exchange.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Progress {
    /// What is due next is decided anew.
    Going,
    /// The drive is of another type than its profile says; told once.
    Unlike(u8),
    /// Something has changed: the drive is to be read.
    Changed,
    /// The drive has started anew.
    Restarted,
    /// It did not answer to be believed.
    Failed,
}

/// The sessions with the drives of a bus; none on a bus of another protocol.
#[derive(Debug, Default)]
pub struct Sessions {
    drives: Vec<Drive>,
    /// Of the line, not of a drive: the answer that is owed could pass for that of any drive.
    fence: Fence,
    /// Until then the line rests: what comes meanwhile is nobody's answer.
    rest: Option<Instant>,
}

impl Sessions {
    /// Sessions with drives of these options.
    pub fn new(drives: impl IntoIterator<Item = N2Options>) -> Sessions {
        let drive = |options: N2Options| Drive {
            phase: first(&options),
            options,
            stop_repeated: false,
            polled: None,
            proved: false,
            device: None,
        };
        Sessions {
            drives: drives.into_iter().map(drive).collect(),
            ..Sessions::default()
        }
    }

    /// Whether the bus has sessions at all.
    pub fn is_empty(&self) -> bool {
        self.drives.is_empty()
    }

    /// What must be said to the drive before it is read (`None`) or commanded.
    pub fn before(&mut self, drive: usize, command: Option<Urgency>, now: Instant) -> Option<Session> {
        let fence = self.fence;
        let drive = self.drives.get_mut(drive)?;
        let fenced = drive.options.identify && command != Some(Urgency::Stop);
        if (fenced && fence == Fence::Identify) || matches!(drive.phase, Phase::Unknown | Phase::Waiting) {
            return Some(Session::Identify);
        }
        let fenced = fenced && fence == Fence::Poll;
        if command.is_some() && !fenced {
            return None;
        }
        if drive.phase == Phase::Ready && (fenced || drive.is_due(now)) {
            drive.report();
        }
        match drive.phase {
            Phase::Reporting { again, .. } => Some(Session::Poll { again }),
            _ => None,
        }
    }

    /// A step that [`Sessions::before`] gave is over.
    pub fn done(&mut self, drive: usize, step: Session, ended: &Ended, now: Instant) -> Progress {
        let heard = self.heard(drive, ended);
        let (Progress::Going, Ended::Reply(reply)) = (heard, ended) else {
            return if step == Session::Identify {
                Progress::Failed
            } else {
                heard
            };
        };
        if self.is_late_identity(step, reply) {
            self.raise();
            return Progress::Failed;
        }
        self.fence = match (self.fence, step) {
            (Fence::Identify, Session::Identify) => Fence::Poll,
            (Fence::Poll, Session::Poll { .. }) => Fence::Open,
            (fence, _) => fence,
        };
        let Some(drive) = self.drives.get_mut(drive) else {
            return Progress::Failed;
        };
        match (step, reply) {
            (Session::Identify, reply) => drive.identified(reply),
            (_, Reply::Changes(digits)) => drive.reported(!digits.is_empty(), now),
            // A drive that knows no polls, or no reports, is read all the same.
            _ => drive.reported(false, now),
        }
    }

    /// Whether the answer to a poll behind a fence is that to an Identify which was thought to be answered.
    fn is_late_identity(&self, step: Session, reply: &Reply) -> bool {
        let (Fence::Poll, Session::Poll { .. }, Reply::Changes(digits)) = (self.fence, step, reply) else {
            return false;
        };
        let told = |device: u8| digits.eq_ignore_ascii_case(format!("{device:02X}").as_bytes());
        let mut drives = self.drives.iter();
        drives.any(|drive| told(drive.options.device_type) || drive.device.is_some_and(told))
    }

    /// An answer is owed, or one came that nobody asked for.
    fn raise(&mut self) {
        self.fence = Fence::Identify;
        for drive in &mut self.drives {
            drive.stop_repeated = false;
        }
    }

    /// Any exchange with the drive is over; [`Progress::Failed`] where it was refused though just identified.
    pub fn heard(&mut self, drive: usize, ended: &Ended) -> Progress {
        if matches!(ended, Ended::Silent | Ended::Corrupt(_)) {
            if self.drives.is_empty() {
                return Progress::Going;
            }
            self.raise();
            return Progress::Failed;
        }
        let Some(drive) = self.drives.get_mut(drive) else {
            return Progress::Going;
        };
        match ended {
            Ended::Reply(Reply::Exception(Exception::N2_RESTARTED)) => {
                let known = drive.proved;
                drive.phase = Phase::Waiting;
                drive.proved = false;
                if known { Progress::Restarted } else { Progress::Failed }
            }
            Ended::Reply(Reply::Identified(_)) => Progress::Going,
            _ => {
                drive.proved = true;
                Progress::Going
            }
        }
    }

    /// Characters came that nobody asked for: perhaps the answer to what was asked last.
    pub fn strayed(&mut self) {
        if !self.drives.is_empty() {
            self.raise();
        }
    }

    /// The drive owes an answer, which may come until then. A drive that is known to be away owes none, so that it does
    /// not cost the others more than its probes.
    pub fn owes(&mut self, drive: usize, until: Instant) {
        if self.drives.get(drive).is_some_and(|drive| drive.proved) {
            self.rest = self.rest.max(Some(until));
        }
    }

    /// Whether an answer is owed, so that what cannot be believed may be that one.
    pub fn is_fenced(&self) -> bool {
        self.fence != Fence::Open
    }

    /// Until when nothing but a stop goes on the line.
    pub fn rest(&self) -> Option<Instant> {
        self.rest
    }

    /// Whether the acknowledgement of a stop proves nothing, because it may be that of what was not answered before.
    /// The stop goes out once more, and only once.
    pub fn doubts_stop(&mut self, drive: usize) -> bool {
        let fenced = self.is_fenced();
        let Some(drive) = self.drives.get_mut(drive) else {
            return false;
        };
        let doubted = fenced && !drive.stop_repeated;
        drive.stop_repeated = doubted;
        doubted
    }

    /// Drives that are due for a poll and would not be asked otherwise, because nothing of them is read so often.
    pub fn neglected(&self, now: Instant) -> impl Iterator<Item = usize> {
        let due = move |drive: &Drive| drive.phase == Phase::Ready && drive.polled.is_some() && drive.is_due(now);
        let drives = self.drives.iter().enumerate();
        drives.filter(move |(_, drive)| due(drive)).map(|(index, _)| index)
    }

    /// The drive does not answer any more: it is asked again by Identify.
    pub fn gone(&mut self, drive: usize) {
        if let Some(drive) = self.drives.get_mut(drive) {
            drive.phase = first(&drive.options);
            drive.proved = false;
            drive.polled = None;
        }
    }

    /// The port was lost: all drives are found anew.
    pub fn reset(&mut self) {
        (0..self.drives.len()).for_each(|drive| self.gone(drive));
        self.fence = Fence::Open;
        self.rest = None;
    }
}

fn first(options: &N2Options) -> Phase {
    if options.identify { Phase::Unknown } else { Phase::Ready }
}

impl Drive {
    fn is_due(&self, now: Instant) -> bool {
        let since = |at| now.saturating_duration_since(at);
        self.polled.is_none_or(|at| since(at) >= self.options.poll)
    }

    /// The drive is asked what has changed.
    fn report(&mut self) {
        self.phase = Phase::Reporting {
            left: MOST_POLLS,
            again: false,
        };
    }

    fn identified(&mut self, reply: &Reply) -> Progress {
        match self.phase {
            Phase::Unknown | Phase::Waiting => self.report(),
            // What is acknowledged may never have come.
            Phase::Reporting { left, .. } => self.phase = Phase::Reporting { left, again: false },
            Phase::Ready => {}
        }
        // One that refuses to be identified is there all the same.
        let Reply::Identified(device) = reply else {
            return Progress::Going;
        };
        let before = self.device.replace(*device);
        if *device != self.options.device_type && before != Some(*device) {
            Progress::Unlike(*device)
        } else {
            Progress::Going
        }
    }

    fn reported(&mut self, changes: bool, now: Instant) -> Progress {
        let left = match self.phase {
            Phase::Reporting { left, .. } => left.saturating_sub(1),
            _ => 0,
        };
        if changes && left > 0 {
            self.phase = Phase::Reporting { left, again: true };
            return Progress::Going;
        }
        self.phase = Phase::Ready;
        self.polled = Some(now);
        // The last poll of a series tells of all of it.
        if left + 1 < MOST_POLLS {
            Progress::Changed
        } else {
            Progress::Going
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    const IDENTIFY: Session = Session::Identify;
    const POLL: Session = Session::Poll { again: false };
    const AGAIN: Session = Session::Poll { again: true };

    struct Bench {
        sessions: Sessions,
        now: Instant,
    }

    fn bench() -> Bench {
        Bench {
            sessions: Sessions::new([N2Options::DEFAULT]),
            now: Instant::now(),
        }
    }

    fn changes(digits: &[u8]) -> Ended {
        Ended::Reply(Reply::Changes(digits.to_vec()))
    }

    fn identity() -> Ended {
        Ended::Reply(Reply::Identified(0x10))
    }

    fn value() -> Ended {
        Ended::Reply(Reply::Registers(vec![0x4248, 0]))
    }

    fn restarted() -> Ended {
        Ended::Reply(Reply::Exception(Exception::N2_RESTARTED))
    }

    impl Bench {
        fn before(&mut self, command: Option<Urgency>) -> Option<Session> {
            self.sessions.before(0, command, self.now)
        }

        fn done(&mut self, step: Session, ended: &Ended) -> Progress {
            self.sessions.done(0, step, ended, self.now)
        }

        /// Identified, its report taken, and read once.
        fn ready() -> Bench {
            let mut bench = bench();
            bench.done(IDENTIFY, &identity());
            bench.done(POLL, &changes(b""));
            bench.sessions.heard(0, &value());
            assert_eq!(bench.before(None), None);
            bench
        }
    }

    #[test]
    fn identify_report_read() {
        let mut bench = bench();
        assert_eq!(bench.before(None), Some(IDENTIFY));
        assert_eq!(bench.before(Some(Urgency::Stop)), Some(IDENTIFY), "it would answer N00");
        assert_eq!(bench.done(IDENTIFY, &identity()), Progress::Going);
        assert_eq!(bench.before(Some(Urgency::Stop)), None, "a stop waits for no report");
        assert_eq!(bench.before(None), Some(POLL));
        assert_eq!(bench.done(POLL, &changes(b"102404248")), Progress::Going);
        assert_eq!(bench.before(None), Some(AGAIN));
        assert_eq!(bench.done(AGAIN, &changes(b"")), Progress::Changed);
        assert_eq!(bench.before(None), None);
        bench.now += N2Options::DEFAULT.poll;
        assert_eq!(bench.before(Some(Urgency::Command)), None);
        assert_eq!(
            bench.before(None),
            Some(POLL),
            "a drive that is not polled takes itself for alone"
        );
        assert_eq!(bench.done(POLL, &changes(b"")), Progress::Going);
        assert_eq!(bench.before(None), None);
    }

    #[test]
    fn a_report_that_never_ends() {
        let mut bench = bench();
        bench.done(IDENTIFY, &identity());
        let mut polls = 0;
        while let Some(step) = bench.before(None) {
            bench.done(step, &changes(b"10240"));
            polls += 1;
        }
        assert_eq!(polls, MOST_POLLS);
    }

    #[test]
    fn a_fence_after_every_exchange_that_failed() {
        for ended in [Ended::Silent, Ended::Corrupt("x")] {
            let mut bench = Bench::ready();
            assert_eq!(bench.sessions.heard(0, &ended), Progress::Failed);
            assert_eq!(bench.before(None), Some(IDENTIFY));
            assert_eq!(bench.before(Some(Urgency::Command)), Some(IDENTIFY));
            assert_eq!(bench.before(Some(Urgency::Stop)), None);
            assert_eq!(bench.done(IDENTIFY, &Ended::Silent), Progress::Failed);
            assert_eq!(bench.before(None), Some(IDENTIFY));
            assert_eq!(bench.done(IDENTIFY, &identity()), Progress::Going);
            assert_eq!(bench.before(Some(Urgency::Command)), Some(POLL));
            assert_eq!(bench.before(Some(Urgency::Stop)), None);
            assert_eq!(bench.before(None), Some(POLL));
            assert_eq!(bench.done(POLL, &changes(b"")), Progress::Going);
            assert_eq!(bench.before(Some(Urgency::Command)), None);
            assert_eq!(bench.before(None), None, "no report again");
        }
    }

    #[test]
    fn a_stop_behind_an_unanswered_exchange_goes_out_twice() {
        let mut bench = Bench::ready();
        assert!(!bench.sessions.doubts_stop(0));
        bench.sessions.heard(0, &Ended::Silent);
        assert!(bench.sessions.doubts_stop(0));
        assert!(!bench.sessions.doubts_stop(0));
    }

    /// Two drives that were identified and read.
    fn two() -> Sessions {
        let now = Instant::now();
        let mut sessions = Sessions::new([N2Options::DEFAULT, N2Options::DEFAULT]);
        for drive in 0..2 {
            sessions.done(drive, IDENTIFY, &identity(), now);
            sessions.done(drive, POLL, &changes(b""), now);
            sessions.heard(drive, &value());
            assert_eq!(sessions.before(drive, None, now), None);
        }
        sessions
    }

    #[test]
    fn the_fence_is_of_the_line() {
        let now = Instant::now();
        let mut sessions = two();
        sessions.heard(0, &Ended::Silent);
        assert_eq!(sessions.before(1, None, now), Some(IDENTIFY), "another drive's value");
        assert_eq!(sessions.before(1, Some(Urgency::Command), now), Some(IDENTIFY));
        assert_eq!(sessions.before(1, Some(Urgency::Stop), now), None);
        assert!(sessions.doubts_stop(1), "another drive's acknowledgement");
        assert!(!sessions.doubts_stop(1));
        sessions.done(1, IDENTIFY, &identity(), now);
        assert_eq!(sessions.before(0, None, now), Some(POLL));
        sessions.done(0, POLL, &changes(b""), now);
        assert_eq!(
            (sessions.before(0, None, now), sessions.before(1, None, now)),
            (None, None)
        );
        assert!(!sessions.doubts_stop(0));
        // Characters of nobody, whoever was spoken to.
        sessions.strayed();
        assert_eq!(sessions.before(1, None, now), Some(IDENTIFY));
        // A drive that goes away leaves the fence to the others.
        sessions.gone(0);
        assert_eq!(sessions.before(1, None, now), Some(IDENTIFY));
        sessions.reset();
        sessions.done(1, IDENTIFY, &identity(), now);
        assert_eq!(
            sessions.before(1, Some(Urgency::Command), now),
            None,
            "a port that was opened anew owes nothing"
        );
    }

    #[test]
    fn a_state_that_looks_like_an_identity_opens_no_fence() {
        let now = Instant::now();
        let mut sessions = two();
        sessions.heard(0, &Ended::Silent);
        // A late state of 10h; the identity of the other drive comes when that is polled.
        sessions.done(1, IDENTIFY, &identity(), now);
        assert_eq!(sessions.done(1, POLL, &changes(b"10"), now), Progress::Failed);
        assert_eq!(sessions.before(1, None, now), Some(IDENTIFY));
        sessions.done(1, IDENTIFY, &identity(), now);
        assert_eq!(sessions.before(1, None, now), Some(POLL));
        assert_eq!(
            sessions.done(1, POLL, &changes(b"12"), now),
            Progress::Going,
            "no device is a 12h"
        );
        assert_eq!(sessions.before(1, None, now), Some(AGAIN), "it is a report");
        assert_eq!(sessions.before(0, None, now), None);
    }

    #[test]
    fn the_line_rests_for_a_drive_that_is_there() {
        let (now, later) = (Instant::now(), Instant::now() + Duration::from_millis(250));
        let mut sessions = two();
        assert_eq!(sessions.rest(), None);
        sessions.owes(0, later);
        sessions.owes(1, now);
        assert_eq!(sessions.rest(), Some(later));
        sessions.reset();
        sessions.owes(0, later);
        assert_eq!(sessions.rest(), None, "a probe does not keep the others waiting");
    }

    #[test]
    fn who_is_not_asked_is_polled_all_the_same() {
        let now = Instant::now();
        let mut sessions = two();
        assert_eq!(sessions.neglected(now).count(), 0);
        let later = now + N2Options::DEFAULT.poll + Duration::from_secs(1);
        sessions.gone(0);
        assert_eq!(sessions.neglected(later).collect::<Vec<_>>(), [1]);
    }

    #[test]
    fn a_restart_begins_anew() {
        let mut bench = Bench::ready();
        assert_eq!(bench.sessions.heard(0, &restarted()), Progress::Restarted);
        assert_eq!(bench.before(Some(Urgency::Stop)), Some(IDENTIFY));
        assert_eq!(bench.done(IDENTIFY, &identity()), Progress::Going);
        assert_eq!(bench.before(None), Some(POLL));
        assert_eq!(bench.done(POLL, &restarted()), Progress::Failed, "identified in vain");
        assert_eq!(bench.before(None), Some(IDENTIFY));
    }

    #[test]
    fn a_drive_that_is_no_vendors_device_is_told_once() {
        let mut bench = bench();
        let other = Ended::Reply(Reply::Identified(0x11));
        assert_eq!(bench.done(IDENTIFY, &other), Progress::Unlike(0x11));
        assert_eq!(bench.done(IDENTIFY, &other), Progress::Going);
    }

    #[test]
    fn drives_that_are_not_to_be_identified() {
        let options = N2Options {
            identify: false,
            poll: Duration::from_secs(60),
            ..N2Options::DEFAULT
        };
        let mut bench = Bench {
            sessions: Sessions::new([options]),
            now: Instant::now(),
        };
        assert_eq!(bench.before(None), Some(POLL));
        bench.done(POLL, &changes(b""));
        bench.sessions.heard(0, &Ended::Silent);
        assert_eq!(bench.before(None), None);
        bench.sessions.heard(0, &value());
        bench.sessions.heard(0, &restarted());
        assert_eq!(bench.before(None), Some(IDENTIFY), "it asked for it");
    }

    #[test]
    fn other_buses_have_none() {
        let mut sessions = Sessions::default();
        assert!(sessions.is_empty());
        assert_eq!(sessions.before(0, None, Instant::now()), None);
        assert_eq!(sessions.heard(0, &Ended::Silent), Progress::Going);
        assert!(!sessions.doubts_stop(0));
    }
}
