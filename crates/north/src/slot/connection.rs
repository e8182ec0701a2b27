//! The connection of a tool over TCP: the bare bytes, or a COM port by RFC 2217.

use std::future::poll_fn;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::dialogue::Dialogue;
use super::terms::Tool;
use crate::connection_limit::{CloseReason, ConnectionPlace};
use crate::reading::{Dated, Source};
use drivegate_line::{ServedPort, telnet_escaped};

/// Time for a tool to take an answer.
const WRITE_TIMEOUT: Duration = Duration::from_secs(5);
/// Time after a request during which a tool counts as in use: it does not yield to another connection from its address.
const IN_USE: Duration = Duration::from_secs(10);
/// Time limit for closing the connection.
const CLOSE_TIMEOUT: Duration = Duration::from_millis(500);

/// Why a connection ended.
#[derive(Debug, thiserror::Error)]
enum End {
    #[error("the tool closed the connection")]
    Tool,
    #[error("closed: the slot or the gateway is stopping")]
    Stopping,
    #[error(transparent)]
    Closed(#[from] CloseReason),
    #[error("closed: no request for {0:?} (`idle_timeout`)")]
    Idle(Duration),
    #[error("closed: the tool read none of its replies within {WRITE_TIMEOUT:?}")]
    NotReading,
    #[error("connection lost: {0}")]
    Lost(#[from] io::Error),
}

#[derive(Debug)]
pub(super) struct Connection<S> {
    stream: Dated<S>,
    dialogue: Dialogue,
    port: Option<ServedPort>,
    /// Bytes still to be written to the stream.
    output: Vec<u8>,
    last_request: Instant,
}

impl<S: AsyncRead + AsyncWrite + Source + Unpin> Connection<S> {
    /// A connection that begins with `greeting`; with a `port`, the connection uses telnet.
    pub(super) fn new(stream: Dated<S>, tool: Arc<Tool>, port: Option<ServedPort>, greeting: Vec<u8>) -> Connection<S> {
        Connection {
            stream,
            dialogue: Dialogue::new(tool),
            port,
            output: greeting,
            last_request: Instant::now(),
        }
    }

    /// Serves the tool until it disconnects, is idle for `idle_timeout`, or must yield its `place`. An open request
    /// is answered before the end, unless the gateway is `stopping`.
    pub(super) async fn serve(
        mut self,
        idle_timeout: Option<Duration>,
        place: &ConnectionPlace,
        stopping: &CancellationToken,
    ) {
        tracing::info!(target: "drivegate::north::slot", tool = self.dialogue.who(), "tool slot: connected");
        let end = loop {
            if let Err(end) = self.turn(idle_timeout, place).await {
                break end;
            }
        };
        if matches!(end, End::Stopping | End::Closed(_)) {
            // A tool that takes no answer is not waited for.
            let _ = stopping.run_until_cancelled(self.finish()).await;
        }
        self.dialogue.ended();
        let _ = tokio::time::timeout(CLOSE_TIMEOUT, self.stream.shutdown()).await;
        tracing::info!(target: "drivegate::north::slot", tool = self.dialogue.who(), "tool slot: {end}");
    }

    /// Waits for the answer to the last request of the tool. If the answer does not arrive within a second, it
    /// never arrives.
    async fn finish(&mut self) -> Result<(), End> {
        self.dialogue.finished().await;
        self.flush().await
    }

    /// Waits for one event and processes it.
    async fn turn(&mut self, idle_timeout: Option<Duration>, place: &ConnectionPlace) -> Result<(), End> {
        let mut buffer = [0; 1024];
        self.flush().await?;
        place.use_at(Instant::now().into_std(), self.last_request.elapsed() < IN_USE);
        let idle_at = idle_timeout.filter(|_| !self.dialogue.is_waiting());
        let idle_at = idle_at.map(|timeout| (timeout, self.last_request + timeout));
        let wake_at = self.dialogue.wake_at().map(Instant::from_std);
        // This wake-up lets the place be taken as soon as the tool is idle.
        let rests_at = Some(self.last_request + IN_USE).filter(|at| *at > Instant::now());
        let timer = [wake_at, idle_at.map(|(_, at)| at), rests_at]
            .into_iter()
            .flatten()
            .min();
        let reads = self.dialogue.reads();
        let dialogue = &mut self.dialogue;
        tokio::select! {
            biased;
            () = place.closing().cancelled() => return Err(place.close_reason().map_or(End::Stopping, End::Closed)),
            () = poll_fn(|cx| dialogue.poll(cx, std::time::Instant::now())) => {}
            count = self.stream.read(&mut buffer), if reads => match count? {
                0 => return Err(End::Tool),
                count => self.take(buffer.get(..count).unwrap_or_default()),
            },
            () = sleep_until(timer) => {
                self.dialogue.on_time(std::time::Instant::now());
                if let Some((timeout, at)) = idle_at
                    && at <= Instant::now()
                {
                    return Err(End::Idle(timeout));
                }
            }
        }
        Ok(())
    }

    /// Processes bytes that the tool sent.
    fn take(&mut self, bytes: &[u8]) {
        let mut data = Vec::with_capacity(bytes.len());
        match &mut self.port {
            Some(port) => self.output.extend(port.take(bytes, &mut data)),
            None => data.extend_from_slice(bytes),
        }
        let arrival = self.stream.reader().last();
        if self.dialogue.received(&data, arrival, std::time::Instant::now()) {
            self.last_request = Instant::now();
        }
    }

    async fn flush(&mut self) -> Result<(), End> {
        let answers = std::mem::take(&mut self.dialogue.output);
        match self.port {
            Some(_) => self.output.extend(telnet_escaped(&answers)),
            None => self.output.extend(answers),
        }
        if self.output.is_empty() {
            return Ok(());
        }
        let written = tokio::time::timeout(WRITE_TIMEOUT, self.stream.write_all(&self.output)).await;
        written.map_err(|_| End::NotReading)??;
        self.output.clear();
        Ok(())
    }
}

/// Sleeps until this time; for ever with `None`.
pub(super) async fn sleep_until(at: Option<Instant>) {
    match at {
        Some(at) => tokio::time::sleep_until(at).await,
        None => std::future::pending().await,
    }
}
