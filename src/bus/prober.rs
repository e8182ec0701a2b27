//! Single exchanges on a line that nobody else uses: for commands that look for drives.

use std::time::{Duration, Instant};

use super::line_state::{LineState, Sending};
use super::n2_late_replies::N2LateReplies;
use super::transaction::Ended;
use crate::codec::{LineFormat, Protocol, Request};
use crate::line::{Line, Lost, Woken};

/// A line with its settings.
#[derive(Debug)]
pub struct Prober<'l> {
    line: &'l Line,
    protocol: Protocol,
    timeout: Duration,
    state: LineState,
}

impl Prober<'_> {
    /// Speaks `protocol` on an open line; `timeout` is the time for the first byte of a reply.
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
        }
    }

    /// What an exchange without an answer takes.
    pub fn patience(&self, request: &Request) -> Duration {
        self.state.patience(request, self.timeout)
    }

    /// One request and what became of it.
    ///
    /// # Errors
    /// When the port is gone.
    pub fn ask(&mut self, request: &Request) -> Result<Ended, Lost> {
        let since = Instant::now();
        while let Some(clear) = Some(self.state.clear_at(since)).filter(|clear| Instant::now() < *clear) {
            self.listen(clear)?;
        }
        let mut frame = Vec::with_capacity(32);
        self.protocol.encode(request, &mut frame);
        let sending = Sending {
            response_timeout: self.timeout,
            could_be_doubled: false,
            late_may_come: false,
        };
        let late = N2LateReplies::default();
        self.state
            .send(request.clone(), frame.clone(), sending, late, Instant::now());
        self.line.send(&frame)?;
        loop {
            let until = match self.state.on_time(Instant::now()) {
                Ok(exchanged) => return Ok(exchanged.ended),
                Err(until) => until.unwrap_or_else(Instant::now),
            };
            if let Some(ended) = self.listen(until)? {
                return Ok(ended);
            }
        }
    }

    /// Listens until then, or until bytes came. How the exchange ended, if it did by them.
    fn listen(&mut self, until: Instant) -> Result<Option<Ended>, Lost> {
        let mut buffer = [0u8; 512];
        if self.line.wait(until, None, !self.state.is_underway())? != Woken::Readable {
            return Ok(None);
        }
        let count = self.line.receive(&mut buffer)?;
        let exchanged = self
            .state
            .heard(buffer.get(..count).unwrap_or_default(), Instant::now());
        Ok(exchanged.map(|exchanged| exchanged.ended))
    }
}
