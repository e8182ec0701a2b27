use std::time::Duration;

use super::*;
use drivegate_model::drive::DriveIndex;

const IDENTIFY: Session = Session::Identify;
const POLL: Session = Session::Poll { again: false };
const AGAIN: Session = Session::Poll { again: true };

struct N2Drive {
    sessions: N2Sessions,
    now: Instant,
}

fn rig() -> N2Drive {
    N2Drive {
        sessions: N2Sessions::new([N2Options::DEFAULT]),
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

impl N2Drive {
    fn before(&mut self, command: Option<Urgency>) -> Option<Session> {
        self.sessions.before(DriveIndex::new(0), command, self.now)
    }

    fn done(&mut self, step: Session, ended: &Ended) -> Progress {
        self.sessions.done(DriveIndex::new(0), step, ended, self.now)
    }

    /// A drive that was identified, has reported, and was read once.
    fn ready() -> N2Drive {
        let mut rig = rig();
        rig.done(IDENTIFY, &identity());
        rig.done(POLL, &changes(b""));
        rig.sessions.transaction_ended(DriveIndex::new(0), &value());
        assert_eq!(rig.before(None), None);
        rig
    }
}

#[test]
fn identify_report_read() {
    let mut rig = rig();
    assert_eq!(rig.before(None), Some(IDENTIFY));
    assert_eq!(rig.before(Some(Urgency::Stop)), Some(IDENTIFY), "it would answer N00");
    assert_eq!(rig.done(IDENTIFY, &identity()), Progress::Going);
    assert_eq!(rig.before(Some(Urgency::Stop)), None, "a stop waits for no report");
    assert_eq!(rig.before(None), Some(POLL));
    assert_eq!(rig.done(POLL, &changes(b"102404248")), Progress::Going);
    assert_eq!(rig.before(None), Some(AGAIN));
    assert_eq!(rig.done(AGAIN, &changes(b"")), Progress::Changed);
    assert_eq!(rig.before(None), None);
    rig.now += N2Options::DEFAULT.poll;
    assert_eq!(rig.before(Some(Urgency::Command)), None);
    assert_eq!(
        rig.before(None),
        Some(POLL),
        "a drive that is not polled takes itself for alone"
    );
    assert_eq!(rig.done(POLL, &changes(b"")), Progress::Going);
    assert_eq!(rig.before(None), None);
}

#[test]
fn a_report_that_never_ends() {
    let mut rig = rig();
    rig.done(IDENTIFY, &identity());
    let mut polls = 0;
    while let Some(step) = rig.before(None) {
        rig.done(step, &changes(b"10240"));
        polls += 1;
    }
    assert_eq!(polls, MOST_POLLS);
}

/// Two drives that were already identified and read.
fn two() -> N2Sessions {
    let now = Instant::now();
    let mut sessions = N2Sessions::new([N2Options::DEFAULT, N2Options::DEFAULT]);
    for drive in [0, 1].map(DriveIndex::new) {
        sessions.done(drive, IDENTIFY, &identity(), now);
        sessions.done(drive, POLL, &changes(b""), now);
        sessions.transaction_ended(drive, &value());
        assert_eq!(sessions.before(drive, None, now), None);
    }
    sessions
}

#[test]
fn who_is_not_asked_is_polled_all_the_same() {
    let now = Instant::now();
    let mut sessions = two();
    assert_eq!(sessions.neglected(now).count(), 0);
    let later = now + N2Options::DEFAULT.poll + Duration::from_secs(1);
    sessions.gone(DriveIndex::new(0));
    assert_eq!(sessions.neglected(later).collect::<Vec<_>>(), [1]);
}

#[test]
fn a_restart_begins_anew() {
    let mut rig = N2Drive::ready();
    assert_eq!(
        rig.sessions.transaction_ended(DriveIndex::new(0), &restarted()),
        Progress::Restarted
    );
    assert_eq!(rig.before(Some(Urgency::Stop)), Some(IDENTIFY));
    assert_eq!(rig.done(IDENTIFY, &identity()), Progress::Going);
    assert_eq!(rig.before(None), Some(POLL));
    assert_eq!(rig.done(POLL, &restarted()), Progress::Failed, "identified in vain");
    assert_eq!(rig.before(None), Some(IDENTIFY));
}

#[test]
fn a_drive_that_is_no_vendors_device_is_told_once() {
    let mut rig = rig();
    let other = Ended::Reply(Reply::Identified(0x11));
    assert_eq!(rig.done(IDENTIFY, &other), Progress::Unlike(0x11));
    assert_eq!(rig.done(IDENTIFY, &other), Progress::Going);
}

#[test]
fn drives_that_are_not_to_be_identified() {
    let options = N2Options {
        identify: false,
        poll: Duration::from_secs(60),
        ..N2Options::DEFAULT
    };
    let mut rig = N2Drive {
        sessions: N2Sessions::new([options]),
        now: Instant::now(),
    };
    assert_eq!(rig.before(None), Some(POLL));
    rig.done(POLL, &changes(b""));
    rig.sessions.transaction_ended(DriveIndex::new(0), &Ended::Silent);
    assert_eq!(rig.before(None), None);
    rig.sessions.transaction_ended(DriveIndex::new(0), &value());
    rig.sessions.transaction_ended(DriveIndex::new(0), &restarted());
    assert_eq!(rig.before(None), Some(IDENTIFY), "it asked for it");
}

#[test]
fn other_buses_have_none() {
    let mut sessions = N2Sessions::default();
    assert!(sessions.is_empty());
    assert_eq!(sessions.before(DriveIndex::new(0), None, Instant::now()), None);
    assert_eq!(
        sessions.transaction_ended(DriveIndex::new(0), &Ended::Silent),
        Progress::Going
    );
}

#[test]
fn a_device_type_that_no_other_reply_has_confirmed_is_forgotten() {
    let drive = DriveIndex::new(0);
    let other = Ended::Reply(Reply::Identified(0));
    // The drive is away, and its identity was the late state of another drive.
    let mut rig = rig();
    assert_eq!(rig.done(IDENTIFY, &other), Progress::Unlike(0));
    assert_eq!(rig.sessions.device(drive), 0);
    rig.sessions.transaction_ended(drive, &Ended::Silent);
    rig.sessions.gone(drive);
    assert_eq!(rig.sessions.device(drive), 0x10);
    // A late refusal makes it forgotten, too.
    rig.done(IDENTIFY, &other);
    rig.sessions.transaction_ended(drive, &restarted());
    assert_eq!(rig.sessions.device(drive), 0x10);
    // A drive that was read keeps its type, and a report of another one needs a reply of its own.
    rig.done(IDENTIFY, &other);
    rig.sessions.transaction_ended(drive, &value());
    for _ in 0..2 {
        rig.sessions.gone(drive);
        assert_eq!(rig.sessions.device(drive), 0);
    }
    rig.done(IDENTIFY, &identity());
    rig.sessions.gone(drive);
    assert_eq!(rig.sessions.device(drive), 0x10);
}

#[test]
fn a_drive_that_only_seemed_to_be_identified_is_identified_again() {
    let mut rig = rig();
    rig.done(IDENTIFY, &identity());
    assert_eq!(rig.before(None), Some(POLL));
    assert_eq!(rig.done(POLL, &Ended::Silent), Progress::Failed);
    assert_eq!(
        rig.before(None),
        Some(IDENTIFY),
        "a poll looks like the reads of the others"
    );
    // A stop needs no poll.
    rig.done(IDENTIFY, &identity());
    rig.sessions.transaction_ended(DriveIndex::new(0), &Ended::Silent);
    assert_eq!(rig.before(Some(Urgency::Stop)), Some(IDENTIFY));
    // One lost reply of a drive that has replied to more shows nothing.
    rig.done(IDENTIFY, &identity());
    rig.done(POLL, &changes(b"11"));
    rig.done(AGAIN, &Ended::Silent);
    assert_eq!(rig.before(None), Some(AGAIN));
}

#[test]
fn a_stop_goes_by_turns_with_identify_to_a_drive_that_does_not_reply() {
    let (mut rig, stop) = (rig(), Some(Urgency::Stop));
    rig.done(IDENTIFY, &Ended::Silent);
    assert_eq!(rig.before(stop), Some(IDENTIFY), "it was never there");
    let mut rig = N2Drive::ready();
    rig.sessions.gone(DriveIndex::new(0));
    for _ in 0..2 {
        assert_eq!(rig.before(stop), Some(IDENTIFY));
        rig.done(IDENTIFY, &Ended::Silent);
        assert_eq!(rig.before(stop), None, "perhaps its replies are lost");
        assert_eq!(rig.before(Some(Urgency::Command)), Some(IDENTIFY), "no other command");
        rig.sessions.transaction_ended(DriveIndex::new(0), &Ended::Silent);
    }
    rig.done(IDENTIFY, &identity());
    assert_eq!(rig.before(stop), None);
}
