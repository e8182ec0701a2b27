//! Single exchanges on a line that nobody else uses: for commands that look for drives.

use std::time::{Duration, Instant};

use super::exchange::await_reply;
use super::transaction::{Ended, Transaction};
use crate::codec::{LineFormat, Protocol, Request};
use crate::drive::plan::WireTime;
use crate::line::{Line, Lost, Woken};

/// A line that does not fall silent is spoken on after this time.
const BABBLE: Duration = Duration::from_millis(300);

/// A line with its settings.
#[derive(Debug)]
pub struct Asker<'l> {
    line: &'l Line,
    protocol: Protocol,
    format: LineFormat,
    silence: Duration,
    timeout: Duration,
    quiet_since: Instant,
    frame: Vec<u8>,
}

impl Asker<'_> {
    /// Speaks `protocol` on an open line; `timeout` is the time for the first byte of a reply.
    pub fn new(line: &Line, protocol: Protocol, format: LineFormat, silence: Duration, timeout: Duration) -> Asker<'_> {
        Asker {
            line,
            protocol,
            format,
            silence,
            timeout,
            quiet_since: Instant::now(),
            frame: Vec::with_capacity(260),
        }
    }

    /// What an exchange without an answer takes.
    pub fn patience(&self, request: &Request) -> Duration {
        let wire = WireTime::of(self.protocol, &self.format, &request.pdu);
        self.silence + wire.request + self.timeout + wire.reply
    }

    /// One request and what became of it.
    ///
    /// # Errors
    /// When the port is gone.
    pub fn ask(&mut self, request: &Request) -> Result<Ended, Lost> {
        self.fall_silent()?;
        let wire = WireTime::of(self.protocol, &self.format, &request.pdu);
        let mut frame = std::mem::take(&mut self.frame);
        frame.clear();
        self.protocol.encode(request, &mut frame);
        let begun = Instant::now();
        self.line.send(&frame)?;
        let sent = begun + self.format.chars(frame.len());
        let mut transaction = Transaction::new(self.protocol, request, &frame, sent, self.timeout, wire.reply, false);
        let quiet_since = &mut self.quiet_since;
        let ended = await_reply(self.line, &mut transaction, begun, |bytes, now| {
            if !bytes.is_empty() {
                *quiet_since = now;
            }
        });
        self.quiet_since = self.quiet_since.max(sent);
        self.frame = frame;
        ended
    }

    fn fall_silent(&mut self) -> Result<(), Lost> {
        let give_up = Instant::now() + BABBLE;
        let mut buffer = [0u8; 512];
        loop {
            let free = (self.quiet_since + self.silence).min(give_up);
            match self.line.wait(free, None, true)? {
                Woken::Readable => {
                    if self.line.receive(&mut buffer)? > 0 {
                        self.quiet_since = Instant::now();
                    }
                    if Instant::now() >= give_up {
                        return Ok(());
                    }
                }
                _ => return Ok(()),
            }
        }
    }
}
