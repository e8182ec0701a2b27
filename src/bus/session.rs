//! What a bus of N2 says to a drive beside reading and commanding it (n2.md 2 and 4). Pure: time is an argument.
//!
//! A drive that has started anew answers nothing before it is identified; then it reports, to polls, all it has. So a
//! drive is identified first, its report is taken (and thrown away: the layout is not known, values are read), then it
//! is read. `N00` at any time means that it has started anew: the same again.
//!
//! A reply names neither drive nor request. After an exchange that was not answered, or not believably, a late value
//! could pass for the next one; so the next thing said to that drive is Identify, whose answer no value looks like. A
//! stop does not wait for that: its acknowledgement is not taken for true, it goes out once more.

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

#[derive(Debug, Clone)]
struct Drive {
    options: N2Options,
    phase: Phase,
    /// An exchange was not answered: a late answer may still come.
    fence: bool,
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
pub struct Sessions(Vec<Drive>);

impl Sessions {
    /// Sessions with drives of these options.
    pub fn new(drives: impl IntoIterator<Item = N2Options>) -> Sessions {
        let drive = |options: N2Options| Drive {
            phase: first(&options),
            options,
            fence: false,
            stop_repeated: false,
            polled: None,
            proved: false,
            device: None,
        };
        Sessions(drives.into_iter().map(drive).collect())
    }

    /// Whether the bus has sessions at all.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// What must be said to the drive before it is read (`None`) or commanded.
    pub fn before(&mut self, drive: usize, command: Option<Urgency>, now: Instant) -> Option<Session> {
        let drive = self.0.get_mut(drive)?;
        let fenced = drive.fence && drive.options.identify && command != Some(Urgency::Stop);
        if fenced || matches!(drive.phase, Phase::Unknown | Phase::Waiting) {
            return Some(Session::Identify);
        }
        if command.is_some() {
            return None;
        }
        let due = drive
            .polled
            .is_none_or(|at| now.saturating_duration_since(at) >= drive.options.poll);
        if drive.phase == Phase::Ready && due {
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
        let Some(drive) = self.0.get_mut(drive) else {
            return Progress::Failed;
        };
        let (Progress::Going, Ended::Reply(reply)) = (heard, ended) else {
            return if step == Session::Identify {
                Progress::Failed
            } else {
                heard
            };
        };
        match (step, reply) {
            (Session::Identify, reply) => drive.identified(reply),
            (_, Reply::Changes(digits)) => drive.reported(!digits.is_empty(), now),
            // A drive that knows no polls, or no reports, is read all the same.
            _ => drive.reported(false, now),
        }
    }

    /// Any exchange with the drive is over; [`Progress::Failed`] where it was refused though just identified.
    pub fn heard(&mut self, drive: usize, ended: &Ended) -> Progress {
        let Some(drive) = self.0.get_mut(drive) else {
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
            Ended::Reply(_) => {
                drive.proved = true;
                Progress::Going
            }
            Ended::Silent | Ended::Corrupt(_) => {
                drive.fence = true;
                drive.stop_repeated = false;
                Progress::Failed
            }
        }
    }

    /// Characters came that nobody asked for: perhaps the answer to what was asked last.
    pub fn strayed(&mut self, drive: usize) {
        if let Some(drive) = self.0.get_mut(drive) {
            drive.fence = true;
        }
    }

    /// Whether the acknowledgement of a stop proves nothing, because it may be that of what was not answered before.
    /// The stop goes out once more, and only once.
    pub fn doubts_stop(&mut self, drive: usize) -> bool {
        let Some(drive) = self.0.get_mut(drive) else {
            return false;
        };
        let doubted = drive.fence && !drive.stop_repeated;
        drive.stop_repeated = doubted;
        doubted
    }

    /// The drive does not answer any more: it is asked again by Identify.
    pub fn gone(&mut self, drive: usize) {
        if let Some(drive) = self.0.get_mut(drive) {
            drive.phase = first(&drive.options);
            drive.fence = false;
            drive.proved = false;
            drive.polled = None;
        }
    }

    /// The port was lost: all drives are found anew.
    pub fn reset(&mut self) {
        (0..self.0.len()).for_each(|drive| self.gone(drive));
    }
}

fn first(options: &N2Options) -> Phase {
    if options.identify { Phase::Unknown } else { Phase::Ready }
}

impl Drive {
    /// The drive is asked what has changed.
    fn report(&mut self) {
        self.phase = Phase::Reporting {
            left: MOST_POLLS,
            again: false,
        };
    }

    fn identified(&mut self, reply: &Reply) -> Progress {
        self.fence = false;
        if matches!(self.phase, Phase::Unknown | Phase::Waiting) {
            self.report();
        }
        match reply {
            Reply::Identified(device) if *device != self.options.device_type && self.device != Some(*device) => {
                self.device = Some(*device);
                Progress::Unlike(*device)
            }
            // One that refuses to be identified is there all the same.
            _ => Progress::Going,
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
