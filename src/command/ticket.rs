//! The one place where commands are answered, counted and audited.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use tokio::sync::oneshot;

use super::{Answer, Origin, Outcome, SourceKind};
use crate::cache::{Histogram, HistogramSnapshot};

/// Counters of commands, for the metrics.
#[derive(Debug, Default)]
pub struct WriteStats {
    results: Mutex<BTreeMap<(SourceKind, &'static str), u64>>,
    seconds: Histogram,
}

impl WriteStats {
    /// Commands by source and result code.
    pub fn results(&self) -> BTreeMap<(SourceKind, &'static str), u64> {
        self.results.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Time from acceptance to answer.
    pub fn seconds(&self) -> HistogramSnapshot {
        self.seconds.snapshot()
    }

    fn note(&self, source: SourceKind, answer: &Answer) {
        let mut results = self.results.lock().unwrap_or_else(PoisonError::into_inner);
        *results.entry((source, answer.outcome.code())).or_default() += 1;
        self.seconds.observe(answer.latency);
    }
}

/// Answers a command exactly once: by [`Ticket::answer`], or as "shutting down" when it is dropped.
#[derive(Debug)]
pub struct Ticket {
    origin: Origin,
    drive: String,
    what: String,
    write: bool,
    accepted: Instant,
    stats: Arc<WriteStats>,
    sender: Option<oneshot::Sender<Answer>>,
}

impl Ticket {
    /// A ticket and where its answer arrives. `what` describes the command for the audit; reads (`write`
    /// false) are neither counted nor audited.
    pub fn new(
        origin: Origin,
        drive: &str,
        what: String,
        write: bool,
        accepted: Instant,
        stats: Arc<WriteStats>,
    ) -> (Ticket, oneshot::Receiver<Answer>) {
        let (sender, receiver) = oneshot::channel();
        let ticket = Ticket {
            origin,
            drive: drive.to_string(),
            what,
            write,
            accepted,
            stats,
            sender: Some(sender),
        };
        (ticket, receiver)
    }

    /// Who commanded.
    pub fn origin(&self) -> &Origin {
        &self.origin
    }

    /// Answers the command.
    pub fn answer(mut self, outcome: Outcome, now: Instant) {
        self.settle(outcome, now);
    }

    fn settle(&mut self, outcome: Outcome, now: Instant) {
        let Some(sender) = self.sender.take() else { return };
        let answer = Answer {
            outcome,
            latency: now.saturating_duration_since(self.accepted),
        };
        if self.write {
            self.stats.note(self.origin.kind, &answer);
            tracing::info!(
                target: "audit",
                source = self.origin.kind.name(),
                who = %self.origin.who,
                drive = %self.drive,
                command = %self.what,
                result = answer.outcome.code(),
                latency_us = answer.latency.as_micros() as u64,
                "{}", answer.outcome
            );
        }
        // The client may have gone: the command was answered all the same.
        let _ = sender.send(answer);
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        if self.sender.is_some() {
            self.settle(Outcome::ShuttingDown, Instant::now());
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub(crate) fn ticket(stats: &Arc<WriteStats>, now: Instant) -> (Ticket, oneshot::Receiver<Answer>) {
        let origin = Origin {
            kind: SourceKind::Mqtt,
            who: "t".to_string(),
        };
        Ticket::new(origin, "d", "run=true".to_string(), true, now, stats.clone())
    }

    #[test]
    fn one_answer_also_when_dropped() {
        let stats = Arc::new(WriteStats::default());
        let now = Instant::now();
        let (first, mut answered) = ticket(&stats, now);
        first.answer(Outcome::TimedOut, now);
        assert_eq!(answered.try_recv().unwrap().outcome, Outcome::TimedOut);
        let (second, mut dropped) = ticket(&stats, now);
        drop(second);
        assert_eq!(dropped.try_recv().unwrap().outcome, Outcome::ShuttingDown);
        assert_eq!(stats.results().values().sum::<u64>(), 2);
        assert_eq!(stats.seconds().count, 2);
    }
}
