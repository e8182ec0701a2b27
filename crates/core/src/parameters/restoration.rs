//! A restore in progress: decides the next step and applies replies. Pure: time is an argument; the caller does the
//! I/O.
//!
//! Every parameter is a separate command, which the bus carries out only if the drive has the former value or the
//! new one, and only while the motor is at standstill; a drive that already has the new value is not written. So an
//! interrupted restore can be resumed or undone by going through all of its parameters again, whatever had reached
//! the drive.

use std::time::{Duration, Instant};

use super::journal::{Journal, Phase};
use super::plan::ParameterWrite;
use crate::order::{Outcome, ParameterOrder, Refusal};
use drivegate_model::drive::parameters::RawValue;
use drivegate_proto::{Exception, Reply};

/// Time without progress after which a restore ends.
const MOST_WAIT: Duration = Duration::from_secs(3600);
/// Pause before a request to a busy drive is repeated.
const BUSY_PAUSE: Duration = Duration::from_millis(200);
/// Pause before the next attempt if someone has to act first: the motor runs, or the drive is offline.
const PAUSE: Duration = Duration::from_secs(1);
/// How often progress is noted in the journal.
const NOTED: Duration = Duration::from_secs(1);
/// Maximum number of saves of one restore: a drive that loses unsaved values is written and saved again.
const MOST_SAVES: u32 = 3;

/// What the restore needs next.
#[derive(Debug, Clone, PartialEq)]
pub enum RestoreNeed {
    /// The present state of the journal must be on disk before anything else.
    Record,
    /// This order must be given to the bus.
    Set(ParameterOrder),
    /// The journal must be removed.
    Remove,
    /// Nothing is to be done, as the restore has ended.
    Nothing,
}

/// What follows an outcome during a restore.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Then {
    /// The next step follows at once.
    Go,
    /// The step is repeated after this time, for the reason given.
    Pause(Duration, String),
}

/// How a restore ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum End {
    /// The drive has all new values.
    Done,
    /// The drive has all former values.
    TakenBack,
    /// The restore was given up before anything was written: the reason.
    NothingWritten(String),
    /// The restore was given up with the drive possibly half restored, and the journal left: the reason.
    Unfinished(String),
}

#[derive(Debug, Clone, PartialEq)]
enum State {
    /// The journal must be written before the parameter at this index can be set.
    Recording(usize),
    /// The parameter at this index is being set; after the last one, the values are saved.
    Setting(usize),
    /// The restore has ended; only its journal still has to be removed.
    Removing(End),
    Over(End),
}

/// A restore in progress.
#[derive(Debug)]
pub struct Restoration {
    journal: Journal,
    /// The writes of the present direction, in their order.
    writes: Vec<ParameterWrite>,
    state: State,
    /// Whether a value on the drive may have been changed.
    touched: bool,
    /// Whether a value was written that is not saved yet, or was not read again since.
    wrote: bool,
    /// Whether the drive did not answer since the present pass over all parameters began: it may have been without power.
    was_away: bool,
    /// Number of passes that ended with a save, or because the drive was away.
    saves: u32,
    /// Since when the restore has been unable to continue.
    waits_since: Option<Instant>,
    noted: Instant,
}

impl Restoration {
    pub fn begin(journal: Journal, now: Instant) -> Restoration {
        Restoration::of(journal, false, now)
    }

    /// Resumes an interrupted restore.
    pub fn resume(mut journal: Journal, now: Instant) -> Restoration {
        journal.phase = Phase::Writing;
        Restoration::of(journal, true, now)
    }

    /// Undoes a restore that was interrupted.
    pub fn undo(mut journal: Journal, now: Instant) -> Restoration {
        journal.phase = Phase::TakingBack;
        Restoration::of(journal, true, now)
    }

    fn of(mut journal: Journal, touched: bool, now: Instant) -> Restoration {
        journal.done = 0;
        let writes = match journal.phase {
            Phase::Writing | Phase::Saving => journal.plan.writes.clone(),
            Phase::TakingBack | Phase::SavingBack => journal.plan.back(journal.plan.writes.len()).writes,
        };
        Restoration {
            journal,
            writes,
            state: State::Recording(0),
            touched,
            wrote: true,
            was_away: false,
            saves: 0,
            waits_since: None,
            noted: now,
        }
    }

    /// What the restore needs next.
    pub fn wanted(&self) -> RestoreNeed {
        match &self.state {
            State::Recording(_) => RestoreNeed::Record,
            State::Setting(place) => match self.writes.get(*place) {
                Some(write) => RestoreNeed::Set(ParameterOrder {
                    id: write.id.name().to_string(),
                    address: write.address,
                    from: Some(write.from),
                    to: write.to,
                }),
                None => match self.journal.plan.handling.save {
                    Some((address, value)) => RestoreNeed::Set(ParameterOrder {
                        id: "save".to_string(),
                        address,
                        from: None,
                        to: RawValue::Word(value),
                    }),
                    None => RestoreNeed::Nothing,
                },
            },
            State::Removing(_) => RestoreNeed::Remove,
            State::Over(_) => RestoreNeed::Nothing,
        }
    }

    /// The journal in the state that must be on disk.
    pub fn journal(&self) -> &Journal {
        &self.journal
    }

    /// Number of completed parameters, and of all.
    pub fn progress(&self) -> (usize, usize) {
        (self.journal.done, self.writes.len())
    }

    /// How the restore ended, once it has.
    pub fn end(&self) -> Option<&End> {
        match &self.state {
            State::Over(end) => Some(end),
            _ => None,
        }
    }

    /// Notes that the journal is on disk, or that it could not be written; in that case nothing more is written to
    /// the drive.
    pub fn recorded(&mut self, result: Result<(), String>, now: Instant) {
        self.noted = now;
        match result {
            Ok(()) => match self.state {
                State::Recording(place) if place < self.writes.len() || self.saves() => {
                    self.state = State::Setting(place)
                }
                _ => self.finish(),
            },
            Err(why) => self.give_up(format!("the journal cannot be written: {why}")),
        }
    }

    /// The journal is removed, or could not be. Without a write the drive is whole, whatever is left of the journal: on
    /// a read-only disk it was never written.
    pub fn removed(&mut self, result: Result<(), String>) {
        if let State::Removing(end) = &self.state {
            self.state = State::Over(match (result, end) {
                (Ok(()), end) => end.clone(),
                (Err(left), End::NothingWritten(why)) => {
                    End::NothingWritten(format!("{why}; a journal that exists cannot be removed: {left}"))
                }
                (Err(left), _) => End::Unfinished(format!(
                    "everything is written, but the journal cannot be removed: {left}"
                )),
            });
        }
    }

    /// Takes the outcome of the order that [`Restoration::wanted`] gave; returns what to do next.
    pub fn answered(&mut self, outcome: &Outcome, now: Instant) -> Then {
        let clean = matches!(outcome, Outcome::Refused(_) | Outcome::Exception(_));
        let not_sent = matches!(
            outcome,
            Outcome::Offline | Outcome::BusDown | Outcome::QueueFull | Outcome::Expired | Outcome::Purged
        );
        if !clean && !not_sent {
            self.touched = true;
        }
        self.was_away |= matches!(
            outcome,
            Outcome::TimedOut
                | Outcome::Garbled
                | Outcome::Unknown(_)
                | Outcome::Interrupted(_)
                | Outcome::Offline
                | Outcome::BusDown
        );
        match outcome {
            Outcome::Acknowledged(reply) => {
                self.waits_since = None;
                self.advance(*reply == Reply::Written, now)
            }
            Outcome::NotTaken(_) => self.stop(outcome.to_string()),
            Outcome::Refused(Refusal::MotorRuns(_)) => self.wait_for_people(
                "the motor is running; stop it".to_string(),
                "the motor is running, and parameters are written only while it is stopped",
                now,
            ),
            Outcome::Exception(code) => self.refused(*code, now),
            Outcome::Refused(refusal) => self.stop(refusal.to_string()),
            Outcome::TimedOut | Outcome::Garbled | Outcome::Unknown(_) => {
                self.pause(PAUSE, "the drive gives no valid reply", now)
            }
            Outcome::Interrupted(_)
            | Outcome::Purged
            | Outcome::Replaced
            | Outcome::Withdrawn
            | Outcome::NotStopped
            | Outcome::StopOnly(_)
            | Outcome::StopFailed(_) => self.pause(BUSY_PAUSE, "another request went first", now),
            Outcome::Expired | Outcome::QueueFull => self.pause(PAUSE, "the line is busy", now),
            Outcome::Offline => self.pause(PAUSE, "the drive does not reply", now),
            Outcome::BusDown => self.pause(PAUSE, "the bus is down", now),
            Outcome::ShuttingDown => self.pause(PAUSE, "the gateway is shutting down, or the bus restarts", now),
        }
    }

    /// The present order could not be given to the bus, for a reason that may pass.
    pub fn put_off(&mut self, why: &str, now: Instant) -> Then {
        self.pause(PAUSE, why, now)
    }

    /// Ends the restore from outside because it cannot continue.
    pub fn give_up(&mut self, why: String) {
        self.state = if self.touched {
            State::Over(End::Unfinished(why))
        } else {
            State::Removing(End::NothingWritten(why))
        };
    }

    /// The present order is done; `written` unless the drive had the value already.
    fn advance(&mut self, written: bool, now: Instant) -> Then {
        let State::Setting(place) = self.state else {
            return Then::Go;
        };
        let Some(write) = self.writes.get(place) else {
            return self.saved();
        };
        // What no save would keep is written again where nothing is saved.
        self.wrote |= written && !(write.volatile && self.saves());
        let next = place + 1;
        self.journal.done = self.journal.done.max(next);
        if next < self.writes.len() {
            let is_noted = self.saves > 0 || now.saturating_duration_since(self.noted) < NOTED;
            self.state = if is_noted {
                State::Setting(next)
            } else {
                State::Recording(next)
            };
            return Then::Go;
        }
        let again = self.saves() || self.was_away;
        if !again || !self.wrote {
            self.finish();
            return Then::Go;
        }
        if self.saves == MOST_SAVES {
            return self.stop("the drive keeps losing what is written: is it being switched off and on?".to_string());
        }
        if !self.saves() {
            return self.saved();
        }
        self.journal.saved = true;
        self.journal.phase = match self.journal.phase {
            Phase::Writing | Phase::Saving => Phase::Saving,
            Phase::TakingBack | Phase::SavingBack => Phase::SavingBack,
        };
        self.state = State::Recording(next);
        Then::Go
    }

    /// The drive has saved the values, or was away and needs no save. If it lost power before, some may be lost, so all are
    /// checked again.
    fn saved(&mut self) -> Then {
        self.saves += 1;
        (self.wrote, self.was_away) = (false, false);
        self.state = State::Setting(0);
        if self.writes.is_empty() {
            self.finish();
        }
        Then::Go
    }

    /// Whether the drive is made to save the values. Undoing unsaved values needs no save, which would wear its memory.
    fn saves(&self) -> bool {
        let leaves_out = self.journal.phase == Phase::TakingBack && !self.journal.saved;
        self.journal.plan.handling.save.is_some() && !leaves_out
    }

    fn finish(&mut self) {
        self.state = State::Removing(match self.journal.phase {
            Phase::Writing | Phase::Saving => End::Done,
            Phase::TakingBack | Phase::SavingBack => End::TakenBack,
        });
    }

    /// Handles an order that the drive refused.
    fn refused(&mut self, code: Exception, now: Instant) -> Then {
        let need = self.journal.plan.handling.needs.clone();
        match need.filter(|need| need.exception == Some(code.code())) {
            _ if code == Exception::BUSY => self.pause(BUSY_PAUSE, "the drive is busy", now),
            Some(need) => self.wait_for_people(
                need.remedy.clone(),
                &format!("the drive refused it with {code}: {}", need.remedy),
                now,
            ),
            None => self.stop(format!("the drive refused it with {code}")),
        }
    }

    /// Once a value was written, the restore waits for conditions that someone at the drive can fix; before the
    /// first write it gives up instead.
    fn wait_for_people(&mut self, waits: String, why: &str, now: Instant) -> Then {
        if self.touched {
            self.pause(PAUSE, &waits, now)
        } else {
            self.stop(why.to_string())
        }
    }

    fn pause(&mut self, pause: Duration, why: &str, now: Instant) -> Then {
        let since = *self.waits_since.get_or_insert(now);
        if now.saturating_duration_since(since) > MOST_WAIT {
            return self.stop(format!("{why}, for {} minutes", MOST_WAIT.as_secs() / 60));
        }
        Then::Pause(pause, why.to_string())
    }

    /// Ends the restore at the present order.
    fn stop(&mut self, why: String) -> Then {
        let place = match &self.state {
            State::Setting(place) => self.writes.get(*place).map(|write| write.line.clone()),
            _ => None,
        };
        let what = place.unwrap_or_else(|| "saving the values".to_string());
        self.give_up(format!("{what}: {why}"));
        Then::Go
    }
}

#[cfg(test)]
mod tests {
    use super::super::journal::tests::{journal, write};
    use super::*;

    const TAKEN: Outcome = Outcome::Acknowledged(Reply::Written);

    fn begun(count: u16, save: bool, now: Instant) -> Restoration {
        let mut journal = journal((0..count).map(|n| write(101 + n, n, n + 1)).collect());
        journal.plan.handling.save = save.then_some((0x0900, 0));
        Restoration::begin(journal, now)
    }

    /// The orders of a restore until its end; with `forgets` the drive loses unsaved values at its first save.
    fn wanted_ids(restoration: &mut Restoration, mut forgets: bool, now: Instant) -> Vec<String> {
        let (mut all, mut has) = (Vec::new(), std::collections::BTreeSet::new());
        let seen = Outcome::Acknowledged(Reply::Registers(vec![0]));
        loop {
            match restoration.wanted() {
                RestoreNeed::Record => {
                    all.push(format!("record {}", restoration.journal().phase.name()));
                    restoration.recorded(Ok(()), now);
                }
                RestoreNeed::Set(order) => {
                    let new = order.from.is_none() || has.insert(order.address);
                    if new {
                        all.push(order.what());
                    }
                    if order.from.is_none() && std::mem::take(&mut forgets) {
                        has.clear();
                    }
                    assert_eq!(restoration.answered(if new { &TAKEN } else { &seen }, now), Then::Go);
                }
                RestoreNeed::Remove => {
                    all.push("remove".to_string());
                    restoration.removed(Ok(()));
                }
                RestoreNeed::Nothing => return all,
            }
        }
    }

    #[test]
    fn the_journal_comes_first_and_goes_last() {
        let now = Instant::now();
        let mut restoration = begun(2, true, now);
        assert_eq!(
            wanted_ids(&mut restoration, false, now),
            [
                "record writing",
                "parameter 101: 0 -> 1",
                "parameter 102: 1 -> 2",
                "record saving",
                "save: 0",
                "remove"
            ]
        );
        assert_eq!(restoration.end(), Some(&End::Done));
        // The undo saves exactly the values that were saved before.
        let mut saved = restoration.journal().clone();
        let mut back = Restoration::undo(saved.clone(), now);
        assert_eq!(
            wanted_ids(&mut back, false, now),
            [
                "record taking back",
                "parameter 102: 2 -> 1",
                "parameter 101: 1 -> 0",
                "record saving the former values",
                "save: 0",
                "remove"
            ]
        );
        assert_eq!(back.end(), Some(&End::TakenBack));
        saved.saved = false;
        let mut back = Restoration::undo(saved, now);
        assert!(!wanted_ids(&mut back, false, now).contains(&"save: 0".to_string()));
    }

    #[test]
    fn what_a_drive_lost_before_it_was_saved_is_written_and_saved_anew() {
        let now = Instant::now();
        let mut restoration = begun(1, true, now);
        assert_eq!(
            wanted_ids(&mut restoration, true, now),
            [
                "record writing",
                "parameter 101: 0 -> 1",
                "record saving",
                "save: 0",
                "parameter 101: 0 -> 1",
                "record saving",
                "save: 0",
                "remove"
            ]
        );
    }

    #[test]
    fn what_a_drive_lost_while_it_was_away_is_written_again() {
        let (now, seen) = (Instant::now(), Outcome::Acknowledged(Reply::Registers(vec![0])));
        let next = |restoration: &Restoration| match restoration.wanted() {
            RestoreNeed::Set(order) => order.id,
            need => format!("{need:?}"),
        };
        for away in [Outcome::Offline, Outcome::TimedOut, Outcome::BusDown] {
            let mut restoration = begun(2, false, now);
            restoration.recorded(Ok(()), now);
            restoration.answered(&TAKEN, now);
            assert!(matches!(restoration.answered(&away, now), Then::Pause(..)));
            restoration.answered(&TAKEN, now);
            assert_eq!(next(&restoration), "101", "{away:?}");
            // The drive has lost the first value, so that is written once more; the second one is there.
            restoration.answered(&TAKEN, now);
            restoration.answered(&seen, now);
            assert_eq!(restoration.wanted(), RestoreNeed::Remove, "{away:?}");
        }
        // A drive that is away in every pass and never keeps anything.
        let mut restoration = begun(2, false, now);
        restoration.recorded(Ok(()), now);
        for _ in 0..=MOST_SAVES {
            restoration.answered(&TAKEN, now);
            restoration.answered(&Outcome::Offline, now);
            restoration.answered(&TAKEN, now);
        }
        assert!(matches!(restoration.end(), Some(End::Unfinished(why)) if why.contains("keeps losing")));
    }

    #[test]
    fn without_a_journal_nothing_is_written() {
        let now = Instant::now();
        let mut restoration = begun(2, false, now);
        restoration.recorded(Err("no space left".to_string()), now);
        assert_eq!(restoration.wanted(), RestoreNeed::Remove);
        restoration.removed(Ok(()));
        assert!(matches!(restoration.end(), Some(End::NothingWritten(why)) if why.contains("no space left")));
    }

    #[test]
    fn a_disk_that_takes_no_journal_and_removes_none_holds_no_untouched_drive() {
        let now = Instant::now();
        let read_only = || Err("read-only file system".to_string());
        let mut restoration = begun(2, false, now);
        restoration.recorded(read_only(), now);
        restoration.removed(read_only());
        assert!(matches!(restoration.end(), Some(End::NothingWritten(why)) if why.contains("cannot be written")));
        // Once everything is written, the journal that stays would hold the drive after a restart, too.
        let mut restoration = begun(1, false, now);
        restoration.recorded(Ok(()), now);
        restoration.answered(&TAKEN, now);
        restoration.removed(read_only());
        assert!(matches!(restoration.end(), Some(End::Unfinished(why)) if why.starts_with("everything is written")));
    }

    #[test]
    fn it_ends_at_the_first_that_does_not_stick() {
        let now = Instant::now();
        let mut restoration = begun(3, false, now);
        restoration.recorded(Ok(()), now);
        restoration.answered(&TAKEN, now);
        restoration.answered(&Outcome::NotTaken("it shows 7".to_string()), now);
        assert_eq!(restoration.wanted(), RestoreNeed::Nothing);
        assert!(matches!(restoration.end(), Some(End::Unfinished(why)) if why.starts_with("102: 1 → 2: ")));
        assert_eq!(restoration.progress(), (1, 3));
    }

    #[test]
    fn what_people_can_mend_is_waited_for_once_something_is_written() {
        let (now, runs) = (Instant::now(), Outcome::Refused(Refusal::MotorRuns("runs".to_string())));
        let mut restoration = begun(3, false, now);
        restoration.recorded(Ok(()), now);
        restoration.answered(&runs, now);
        restoration.removed(Ok(()));
        assert!(matches!(restoration.end(), Some(End::NothingWritten(_))));
        let mut restoration = begun(3, false, now);
        restoration.recorded(Ok(()), now);
        restoration.answered(&TAKEN, now);
        assert!(matches!(restoration.answered(&runs, now), Then::Pause(..)));
        assert!(matches!(restoration.answered(&Outcome::Offline, now), Then::Pause(..)));
        assert!(matches!(restoration.wanted(), RestoreNeed::Set(order) if order.id == "102"));
        restoration.answered(&runs, now + MOST_WAIT + PAUSE);
        assert!(matches!(restoration.end(), Some(End::Unfinished(why)) if why.contains("60 minutes")));
    }
}
