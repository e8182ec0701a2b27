//! The pseudo-terminal of a slot: a serial port that an old program opens.

use std::fs::File;
use std::future::poll_fn;
use std::io;
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use tokio::io::AsyncReadExt;
use tokio::net::unix::pipe;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::connection::sleep_until;
use super::dialogue::Dialogue;
use super::terms::{Terms, Tool};
use crate::reading::{Dated, Reader};
use drivegate_core::order::Proof;
use drivegate_line::Pty;

/// Pause before a pseudo-terminal that could not be opened is tried again.
const AGAIN: Duration = Duration::from_secs(5);
/// Time without a byte after which the program may have been killed: the port then does what the last close of a port does.
const RESTS: Duration = Duration::from_secs(2);

/// Serves the pseudo-terminal whose link is `path` until `cancel`. If it cannot be opened, the slot runs without
/// it, logs each reason once, and retries. An open request of a program is answered at the end, unless the gateway
/// is `stopping`.
pub(super) async fn serve(path: PathBuf, terms: Arc<Terms>, cancel: CancellationToken, stopping: CancellationToken) {
    let bus = terms.slot.bus.clone();
    let mut told = String::new();
    loop {
        let why = match open(&path) {
            Ok(pty) => {
                tracing::info!(target: "drivegate::north::slot", %bus, path = %path.display(), "tool slot: open");
                told.clear();
                let shown = path.display().to_string();
                let tool = Tool::new(terms.clone(), &shown, "pty", Proof::Pty(shown.as_str().into()));
                match Port::new(pty, Arc::new(tool)) {
                    Ok(mut port) => match cancel.run_until_cancelled(port.serve()).await {
                        None => {
                            stopping.run_until_cancelled(port.finish()).await;
                            return;
                        }
                        Some(error) => error,
                    },
                    Err(error) => error,
                }
            }
            Err(error) => error,
        };
        let why = why.to_string();
        if why != told {
            tracing::warn!(target: "drivegate::north::slot", %bus, "tool slot: no pseudo-terminal: {why}; retrying \
                                                                    every {} s", AGAIN.as_secs());
            told = why;
        }
        if cancel.run_until_cancelled(tokio::time::sleep(AGAIN)).await.is_none() {
            return;
        }
    }
}

fn open(path: &Path) -> io::Result<Pty> {
    let pty = Pty::open(Some(path))?;
    pty.share()?;
    Ok(pty)
}

struct Port {
    pty: Pty,
    /// The gateway's end of the pseudo-terminal. The runtime treats it as a pipe.
    reader: Dated<pipe::Receiver>,
    dialogue: Dialogue,
    /// When bytes were last received or sent; `None` once the port is idle.
    used: Option<Instant>,
}

impl Port {
    fn new(pty: Pty, tool: Arc<Tool>) -> io::Result<Port> {
        let same = File::from(pty.as_fd().try_clone_to_owned()?);
        Ok(Port {
            reader: Dated::new(pipe::Receiver::from_file_unchecked(same)?, Arc::new(Reader::here())),
            pty,
            dialogue: Dialogue::new(tool),
            used: None,
        })
    }

    /// Serves until the system reports an error.
    async fn serve(&mut self) -> io::Error {
        loop {
            if let Err(error) = self.turn().await {
                return error;
            }
        }
    }

    async fn turn(&mut self) -> io::Result<()> {
        let wake_at = self.dialogue.wake_at().map(Instant::from_std);
        let rests_at = self.used.map(|at| at + RESTS).filter(|_| !self.dialogue.is_waiting());
        let timer = [wake_at, rests_at].into_iter().flatten().min();
        let reads = self.dialogue.reads();
        let dialogue = &mut self.dialogue;
        let mut buffer = [0; 1024];
        let asked = tokio::select! {
            biased;
            () = poll_fn(|cx| dialogue.poll(cx, std::time::Instant::now())) => false,
            count = self.reader.read(&mut buffer), if reads => {
                let bytes = count.map(|count| buffer.get(..count).unwrap_or_default())?;
                self.used = Some(Instant::now());
                let arrival = self.reader.reader().last();
                self.dialogue.received(bytes, arrival, std::time::Instant::now())
            }
            () = sleep_until(timer) => {
                if rests_at.is_some_and(|at| at <= Instant::now()) {
                    self.used = None;
                    self.pty.settle();
                }
                self.dialogue.on_time(std::time::Instant::now())
            }
        };
        if asked {
            // An unread answer to an earlier request is not an answer to this one.
            self.pty.discard_unread();
        }
        self.write();
        Ok(())
    }

    /// Waits for the answer to the program's last request.
    async fn finish(&mut self) {
        self.dialogue.finished().await;
        self.write();
    }

    /// Writes as a serial port does, which does not wait for a program that does not read: bytes without room are lost.
    fn write(&mut self) {
        let answer = std::mem::take(&mut self.dialogue.output);
        if answer.is_empty() {
            return;
        }
        self.used = Some(Instant::now());
        let written = self.pty.write(&answer).unwrap_or(0);
        if written < answer.len() {
            self.pty.discard_unread();
        }
    }
}
