//! The only module in which commands get their results and are counted and audited.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use tokio::sync::oneshot;

use super::audit::{Audit, AuditRecord, Change, Reach, RunOrdered};
use super::{Answer, CONFIRMED, Origin, Outcome, SourceKind, StopEnd};
use crate::process_image::{Histogram, HistogramSnapshot};

/// The log of all commands of a gateway: how many ended with which result, how long that took, and the audit.
#[derive(Debug, Default)]
pub struct CommandLog {
    results: Mutex<BTreeMap<(SourceKind, &'static str), u64>>,
    seconds: Histogram,
    audit: Audit,
}

impl CommandLog {
    /// Number of commands by source and result code.
    pub fn results(&self) -> BTreeMap<(SourceKind, &'static str), u64> {
        self.results.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Histogram of the times from acceptance to result.
    pub fn seconds(&self) -> HistogramSnapshot {
        self.seconds.snapshot()
    }

    /// The audit records of the last commands.
    pub fn audit(&self) -> &Audit {
        &self.audit
    }

    fn note(&self, source: SourceKind, answer: &Answer) {
        let mut results = self.results.lock().unwrap_or_else(PoisonError::into_inner);
        *results.entry((source, answer.outcome.code())).or_default() += 1;
        // The wait of another master is not a delay of the gateway.
        if source != SourceKind::OtherMaster {
            self.seconds.observe(answer.latency);
        }
    }
}

/// Gives a command exactly one result: by [`Ticket::answer`] or [`Ticket::acknowledge`], or "shutting down" when
/// dropped. The audit record follows once the whole outcome of the command is known.
#[derive(Debug)]
pub struct Ticket {
    origin: Origin,
    drive: String,
    what: String,
    changes: Vec<Change>,
    /// The other drives that the command starts or stops, by name.
    runs: Vec<(String, bool)>,
    write: bool,
    accepted: Instant,
    command_log: Arc<CommandLog>,
    sender: Option<oneshot::Sender<Answer>>,
    confirmation: Option<oneshot::Sender<Result<Duration, String>>>,
    answered: Option<(Outcome, Duration)>,
    confirmed: Option<Duration>,
    /// Why no read can show the effect of the command.
    unseen: Option<String>,
    /// Whether no part of the command was written yet.
    waits: bool,
    /// Reports the result of this stop to the rest of its order.
    stop: Option<StopEnd>,
}

impl Ticket {
    /// A ticket and the receiver of its result. `what` describes the command for the audit; reads (`write` false) are
    /// neither counted nor audited.
    pub fn new(
        origin: Origin,
        drive: &str,
        what: String,
        write: bool,
        accepted: Instant,
        command_log: Arc<CommandLog>,
    ) -> (Ticket, oneshot::Receiver<Answer>) {
        let (sender, receiver) = oneshot::channel();
        let ticket = Ticket {
            origin,
            drive: drive.to_string(),
            what,
            changes: Vec::new(),
            runs: Vec::new(),
            write,
            accepted,
            command_log,
            sender: Some(sender),
            confirmation: None,
            answered: None,
            confirmed: None,
            unseen: None,
            waits: false,
            stop: None,
        };
        (ticket, receiver)
    }

    /// The values that the command sets, for the audit.
    pub fn with_changes(mut self, changes: Vec<Change>) -> Ticket {
        self.changes = changes;
        self
    }

    /// Sets the drives that a command to several drives starts or stops.
    pub(crate) fn with_runs(mut self, runs: Vec<(String, bool)>) -> Ticket {
        self.runs = runs;
        self
    }

    /// Sets where the result of a stop is reported to the rest of its order.
    pub(crate) fn with_rest(mut self, end: StopEnd) -> Ticket {
        self.stop = Some(end);
        self
    }

    /// Receiver of the time from acceptance to the read that showed the effect, or of the reason why no read can
    /// show it. It closes without a value if no read showed the effect within the profile's time after the
    /// acknowledgement.
    pub fn confirmation(&mut self) -> oneshot::Receiver<Result<Duration, String>> {
        let (sender, receiver) = oneshot::channel();
        self.confirmation = Some(sender);
        receiver
    }

    /// The origin of the command.
    pub fn origin(&self) -> &Origin {
        &self.origin
    }

    /// The command as text.
    pub fn what(&self) -> &str {
        &self.what
    }

    /// The client, as shares are calculated: see [`Origin::client`].
    pub fn client(&self) -> &str {
        self.origin.client()
    }

    /// Ends the command with its final outcome.
    pub fn answer(mut self, outcome: Outcome, now: Instant) {
        self.settle(outcome, now);
    }

    /// Reports the acknowledgement; the confirmation may follow.
    pub fn acknowledge(mut self, outcome: Outcome, now: Instant) -> Receipt {
        self.settle(outcome, now);
        Receipt(self)
    }

    fn settle(&mut self, outcome: Outcome, now: Instant) {
        let Some(sender) = self.sender.take() else { return };
        if let Some(end) = &self.stop {
            end.note(&outcome);
        }
        let latency = now.saturating_duration_since(self.accepted);
        self.answered = Some((outcome.clone(), latency));
        let answer = Answer { outcome, latency };
        if self.write {
            self.command_log.note(self.origin.kind, &answer);
            self.note_run(&answer.outcome, now);
        }
        // The command counts as answered even if the client no longer waits.
        let _ = sender.send(answer);
    }

    /// Records who started or stopped a motor: the next read that shows the change looks this up.
    fn note_run(&self, outcome: &Outcome, now: Instant) {
        let run = self.changes.iter().rev().find_map(|change| change.run);
        let may_be_done = outcome.reach() == Reach::Sent && !matches!(outcome, Outcome::Exception(_));
        let runs = self.runs.iter().map(|(drive, run)| (drive.as_str(), *run));
        let runs = run.map(|run| (self.drive.as_str(), run)).into_iter().chain(runs);
        for (drive, run) in runs.filter(|_| may_be_done) {
            let who = format!("{} {}", self.origin.kind.name(), self.origin.who);
            self.command_log.audit.ordered(drive, RunOrdered { run, who, at: now });
        }
    }

    fn audit(&mut self) {
        let Some((outcome, latency)) = self.answered.take().filter(|_| self.write) else {
            return;
        };
        let (result, text) = match self.confirmed {
            Some(_) => (CONFIRMED, "the drive acknowledged it and shows its effect".to_string()),
            None => match &self.unseen {
                Some(why) if self.waits => (outcome.code(), why.clone()),
                Some(why) => (outcome.code(), format!("{outcome}; {why}")),
                None => (outcome.code(), outcome.to_string()),
            },
        };
        let record = AuditRecord {
            time: SystemTime::now(),
            source: self.origin.kind.name(),
            share: self.origin.client().clone(),
            client: std::mem::take(&mut self.origin.who),
            drive: std::mem::take(&mut self.drive),
            command: std::mem::take(&mut self.what),
            points: std::mem::take(&mut self.changes),
            result,
            text,
            latency,
            confirmed: self.confirmed,
            count: 1,
            fate: outcome.fate(),
        };
        self.command_log
            .audit
            .record(record, outcome.reach(), self.accepted + latency);
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        if self.sender.is_some() {
            self.settle(Outcome::ShuttingDown, Instant::now());
        }
        self.audit();
    }
}

/// An acknowledged command that may still be confirmed. If dropped, its result stays "acknowledged".
#[derive(Debug)]
pub struct Receipt(Ticket);

impl Receipt {
    /// Confirms the command after a read showed its effect.
    pub fn confirm(mut self, now: Instant) {
        let time = now.saturating_duration_since(self.0.accepted);
        self.0.confirmed = Some(time);
        if let Some(sender) = self.0.confirmation.take() {
            // The client may have disconnected, or may not have requested the confirmation.
            let _ = sender.send(Ok(time));
        }
    }

    /// No read can show the effect, for this reason.
    pub fn cannot_be_seen(mut self, why: &str) {
        self.0.unseen = Some(why.to_string());
        if let Some(sender) = self.0.confirmation.take() {
            let _ = sender.send(Err(why.to_string()));
        }
    }

    /// The command is accepted but not written yet; `why` is the reason why it takes effect later.
    pub fn waits(mut self, why: &str) {
        self.0.waits = true;
        self.cannot_be_seen(why);
    }

    /// Whether the command came from the gateway itself, not from a client.
    pub fn is_of_gateway(&self) -> bool {
        !self.0.origin.kind.is_client()
    }

    /// The command as one line of text.
    pub fn what(&self) -> &str {
        &self.0.what
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub(crate) fn ticket(command_log: &Arc<CommandLog>, now: Instant) -> (Ticket, oneshot::Receiver<Answer>) {
        let origin = Origin::new(SourceKind::Mqtt, "t");
        Ticket::new(origin, "d", "run=true".to_string(), true, now, command_log.clone())
    }

    #[test]
    fn one_answer_also_when_dropped() {
        let command_log = Arc::new(CommandLog::default());
        let now = Instant::now();
        let (first, mut answered) = ticket(&command_log, now);
        first.answer(Outcome::TimedOut, now);
        assert_eq!(answered.try_recv().unwrap().outcome, Outcome::TimedOut);
        let (second, mut dropped) = ticket(&command_log, now);
        drop(second);
        assert_eq!(dropped.try_recv().unwrap().outcome, Outcome::ShuttingDown);
        assert_eq!(command_log.results().values().sum::<u64>(), 2);
        assert_eq!(command_log.seconds().count, 2);
        let audited = command_log.audit().parsed();
        let results: Vec<_> = audited.iter().map(|r| &r["result"]).collect();
        assert_eq!(results, ["timeout", "shutting_down"]);
    }

    #[test]
    fn a_confirmation_comes_after_the_one_answer() {
        let command_log = Arc::new(CommandLog::default());
        let now = Instant::now();
        let acknowledged = Outcome::Acknowledged(drivegate_proto::Reply::Written);
        let (mut ticket, mut answer) = ticket(&command_log, now);
        let mut confirmation = ticket.confirmation();
        let receipt = ticket.acknowledge(acknowledged.clone(), now + Duration::from_millis(5));
        assert_eq!(answer.try_recv().unwrap().outcome, acknowledged);
        assert!(command_log.audit().parsed().is_empty(), "one line has both");
        receipt.confirm(now + Duration::from_millis(9));
        assert_eq!(confirmation.try_recv(), Ok(Ok(Duration::from_millis(9))));
        let record = &command_log.audit().parsed()[0];
        assert_eq!(
            (&record["result"], &record["latency_ms"]),
            (&"confirmed".into(), &5.0.into())
        );
        assert_eq!(record["confirmed_ms"], 9.0);
        let (mut ticket, _answer) = self::ticket(&command_log, now);
        let mut confirmation = ticket.confirmation();
        drop(ticket.acknowledge(acknowledged, now));
        assert!(confirmation.try_recv().is_err());
        assert_eq!(command_log.audit().parsed()[1]["result"], "acknowledged");
        assert_eq!(command_log.results().values().sum::<u64>(), 2);
    }
}
