//! Single transactions on a line without another master, for commands that search for drives.

use std::time::{Duration, Instant};

use super::line_state::{Exchanged, LineState, Sending};
use super::n2_late_replies::N2LateReplies;
use super::transaction::Ended;
use drivegate_core::diagnosis::signature::{self, Shape};
use drivegate_line::{Line, Lost, Woken};
use drivegate_proto::{LineFormat, Protocol, Reply, Request};

/// A line with its settings, for single transactions.
#[derive(Debug)]
pub struct Prober<'l> {
    line: &'l Line,
    protocol: Protocol,
    timeout: Duration,
    state: LineState,
    unasked: usize,
}

/// The result of a single request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Answer {
    /// Result of the transaction.
    pub ended: Ended,
    /// Observed time until the reply started; only for replies with values.
    pub turnaround: Option<Duration>,
    /// Whether the adapter echoed the request.
    pub echoed: bool,
    /// Number of received bytes, without an echo.
    pub bytes: usize,
    /// Form of the received bytes.
    pub shape: Shape,
    /// A gateway in between reported that nothing answers at the address, which counts as silence.
    pub no_way: bool,
}

impl Answer {
    fn of(protocol: Protocol, exchanged: Exchanged, sent: &[u8], now: Instant) -> Answer {
        let seen = exchanged.transaction.seen();
        let answered = matches!(exchanged.ended, Ended::Reply(_));
        let signature = signature::of(protocol, exchanged.transaction.request(), sent, seen, answered);
        let echoed = seen.starts_with(sent);
        let values = matches!(&exchanged.ended, Ended::Reply(reply) if !matches!(reply, Reply::Exception(_)));
        let turnaround = exchanged.transaction.first_byte().filter(|_| values).map(|first| {
            // If the driver delivers a reply as a whole, its first byte arrived earlier by the duration of the reply.
            let by_first = first.saturating_duration_since(exchanged.sent);
            let by_last = now.saturating_duration_since(exchanged.sent);
            by_first.min(by_last.saturating_sub(exchanged.reply_time))
        });
        Answer {
            turnaround,
            echoed,
            bytes: seen.len() - if echoed { sent.len() } else { 0 },
            shape: signature.shape,
            no_way: matches!(exchanged.ended, Ended::Reply(Reply::Exception(code)) if code.is_no_answer()),
            ended: match exchanged.ended {
                Ended::Reply(Reply::Exception(code)) if code.is_no_answer() => Ended::Silent,
                ended => ended,
            },
        }
    }
}

impl Prober<'_> {
    /// Sends requests of `protocol` on an open line; `timeout` is the time for the first byte of a reply.
    pub fn new(
        line: &Line,
        protocol: Protocol,
        format: LineFormat,
        silence: Duration,
        timeout: Duration,
    ) -> Prober<'_> {
        Prober {
            line,
            protocol,
            timeout,
            state: LineState::new(protocol, format, silence, Instant::now()),
            unasked: 0,
        }
    }

    /// Duration of a transaction without a reply.
    pub fn patience(&self, request: &Request) -> Duration {
        self.state.patience(request, self.timeout)
    }

    /// The longest time of a request, calculated without a line.
    pub fn patience_of(
        protocol: Protocol,
        format: LineFormat,
        silence: Duration,
        timeout: Duration,
        request: &Request,
    ) -> Duration {
        LineState::new(protocol, format, silence, Instant::now()).patience(request, timeout)
    }

    /// Number of bytes received without a request.
    pub fn unasked(&self) -> usize {
        self.unasked
    }

    /// Listens for `time` without a request.
    ///
    /// # Errors
    /// If the port is lost while listening.
    pub fn listen_for(&mut self, time: Duration) -> Result<(), Lost> {
        let until = Instant::now() + time;
        while Instant::now() < until {
            self.listen(until)?;
        }
        Ok(())
    }

    /// Sends one request and returns its result.
    ///
    /// # Errors
    /// If the port is lost during the transaction.
    pub fn ask(&mut self, request: &Request) -> Result<Answer, Lost> {
        let since = Instant::now();
        while let Some(clear) =
            Some(self.state.clear_at(since, self.state.silence())).filter(|clear| Instant::now() < *clear)
        {
            self.listen(clear)?;
        }
        let mut frame = Vec::with_capacity(32);
        self.protocol.encode(request, &mut frame);
        let sending = Sending {
            silence: self.state.silence(),
            response_timeout: self.timeout,
            could_be_doubled: false,
            late_may_come: false,
        };
        self.state.send(request.clone(), frame.clone(), sending, Instant::now());
        self.line.send(&frame)?;
        loop {
            let now = Instant::now();
            let until = match self.state.on_time(now) {
                Ok(exchanged) => return Ok(Answer::of(self.protocol, exchanged, &frame, now)),
                Err(until) => until.unwrap_or_else(Instant::now),
            };
            if let Some(exchanged) = self.listen(until)? {
                return Ok(Answer::of(self.protocol, exchanged, &frame, Instant::now()));
            }
        }
    }

    /// Listens until this time, or until bytes arrive. Returns the transaction if they complete it.
    fn listen(&mut self, until: Instant) -> Result<Option<Exchanged>, Lost> {
        let mut buffer = [0u8; 512];
        if self.line.wait(until, None, !self.state.is_underway())? != Woken::Readable {
            return Ok(None);
        }
        let count = self.line.receive(&mut buffer)?;
        if !self.state.is_underway() {
            self.unasked += count;
        }
        Ok(self.state.received(
            buffer.get(..count).unwrap_or_default(),
            &mut N2LateReplies::default(),
            Instant::now(),
        ))
    }
}
