//! One connection: bytes in, frames to the session, answers out.

use std::convert::Infallible;
use std::io;
use std::time::Duration;

use futures_util::FutureExt;
use futures_util::stream::{FuturesUnordered, StreamExt};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::frame::{self, MAX_FRAME, NotModbus};
use super::session::{Session, Waiting};

/// Input that is worked off at a time.
const INPUT: usize = 32 * MAX_FRAME;
/// Output that is collected before it is written.
const OUTPUT: usize = 32 * 1024;
/// Requests of one connection that may wait for the bus; with so many under way no more are read.
const MOST_WAITING: usize = 16;
/// Time for the rest of a frame.
const FRAME_TIMEOUT: Duration = Duration::from_secs(10);
/// Time for the client to take some of its answers.
const WRITE_TIMEOUT: Duration = Duration::from_secs(10);
/// Time for requests under way when the gateway stops.
const FAREWELL: Duration = Duration::from_millis(500);

/// Why a connection ended.
#[derive(Debug, thiserror::Error)]
enum End {
    #[error("the client has closed the connection")]
    Client,
    #[error("the gateway stops")]
    Cancelled,
    #[error("closed: not Modbus TCP: {0}")]
    NotModbus(#[from] NotModbus),
    #[error("closed: the client did not finish a frame within {FRAME_TIMEOUT:?}")]
    HalfFrame,
    #[error("closed: the client took none of its answers within {WRITE_TIMEOUT:?}")]
    NotReading,
    #[error("connection lost: {0}")]
    Lost(#[from] io::Error),
}

/// Serves a client until it leaves, misbehaves or the gateway stops.
pub(super) async fn serve<S: AsyncRead + AsyncWrite + Unpin>(stream: S, session: Session, cancel: CancellationToken) {
    tracing::debug!(client = session.who(), "Modbus TCP: connected");
    let mut connection = Connection {
        stream,
        session,
        waiting: FuturesUnordered::new(),
        input: vec![0; INPUT],
        filled: 0,
        output: Vec::with_capacity(1024),
    };
    let end = match connection.run(&cancel).await {
        Ok(never) => match never {},
        Err(end) => end,
    };
    if matches!(end, End::Cancelled) {
        connection.farewell().await;
    }
    tracing::debug!(client = connection.session.who(), "Modbus TCP: {end}");
}

struct Connection<S> {
    stream: S,
    session: Session,
    waiting: FuturesUnordered<Waiting>,
    input: Vec<u8>,
    /// Bytes in `input` that are not worked off yet.
    filled: usize,
    output: Vec<u8>,
}

impl<S: AsyncRead + AsyncWrite + Unpin> Connection<S> {
    async fn run(&mut self, cancel: &CancellationToken) -> Result<Infallible, End> {
        let mut client_done = false;
        let mut half_frame_since: Option<Instant> = None;
        loop {
            let worked = self.work();
            self.collect();
            tokio::select! {
                biased;
                () = cancel.cancelled() => return Err(End::Cancelled),
                flushed = flush(&mut self.stream, &mut self.output) => flushed?,
            }
            if worked? > 0 {
                half_frame_since = None;
            }
            let full = self.waiting.len() >= MOST_WAITING;
            if !full && self.has_more() {
                continue;
            }
            if client_done && self.waiting.is_empty() {
                return Err(End::Client);
            }
            // While it is the gateway that does not read on, a half frame is nobody's fault.
            let half = self.filled > 0 && !full && !client_done;
            half_frame_since = half.then(|| half_frame_since.unwrap_or_else(Instant::now));
            tokio::select! {
                () = cancel.cancelled() => return Err(End::Cancelled),
                Some(finished) = self.waiting.next() => self.session.finish(&finished, &mut self.output),
                read = read(&mut self.stream, &mut self.input, self.filled), if !full && !client_done => match read? {
                    0 => client_done = true,
                    count => self.filled += count,
                },
                () = expired(half_frame_since) => return Err(End::HalfFrame),
            }
        }
    }

    /// Works off the frames in the input while there is room for what they cause; gives the bytes they took.
    fn work(&mut self) -> Result<usize, NotModbus> {
        let mut used = 0;
        self.session.refresh();
        let now = std::time::Instant::now();
        let result = loop {
            if self.waiting.len() >= MOST_WAITING || self.output.len() >= OUTPUT {
                break Ok(used);
            }
            match frame::decode(self.input.get(used..self.filled).unwrap_or_default()) {
                Ok(Some(frame)) => {
                    used += frame.used;
                    self.waiting.extend(self.session.take(&frame, now, &mut self.output));
                }
                Ok(None) => break Ok(used),
                Err(misfit) => break Err(misfit),
            }
        };
        self.input.copy_within(used..self.filled, 0);
        self.filled -= used;
        result
    }

    /// Whether the input has something to work off: a frame, or what will never become one.
    fn has_more(&self) -> bool {
        !matches!(
            frame::decode(self.input.get(..self.filled).unwrap_or_default()),
            Ok(None)
        )
    }

    /// Takes the answers that have come in the meantime, to write them together.
    fn collect(&mut self) {
        while let Some(Some(finished)) = self.waiting.next().now_or_never() {
            self.session.finish(&finished, &mut self.output);
        }
    }

    /// Gives the requests under way a last chance to be answered.
    async fn farewell(&mut self) {
        let answered = async {
            flush(&mut self.stream, &mut self.output).await?;
            while let Some(finished) = self.waiting.next().await {
                self.session.finish(&finished, &mut self.output);
                flush(&mut self.stream, &mut self.output).await?;
            }
            Ok::<(), End>(())
        };
        // Who does not answer or listen within that time has been waited for long enough.
        let _ = tokio::time::timeout(FAREWELL, answered).await;
    }
}

/// Reads behind the bytes that are there; the session works the buffer off so far that there is always room.
async fn read<S: AsyncRead + Unpin>(stream: &mut S, input: &mut [u8], filled: usize) -> io::Result<usize> {
    stream.read(input.get_mut(filled..).unwrap_or_default()).await
}

/// Writes the output; when it is dropped half way, the output keeps what was not written.
async fn flush<S: AsyncWrite + Unpin>(stream: &mut S, output: &mut Vec<u8>) -> Result<(), End> {
    if output.is_empty() {
        return Ok(());
    }
    while !output.is_empty() {
        // The time runs anew with every byte taken: a slow line is no reason to give a client up.
        let written = tokio::time::timeout(WRITE_TIMEOUT, stream.write(output)).await;
        match written.map_err(|_| End::NotReading)?? {
            0 => return Err(io::Error::from(io::ErrorKind::WriteZero).into()),
            count => drop(output.drain(..count)),
        }
    }
    Ok(tokio::time::timeout(WRITE_TIMEOUT, stream.flush())
        .await
        .map_err(|_| End::NotReading)??)
}

async fn expired(since: Option<Instant>) {
    match since {
        Some(since) => tokio::time::sleep_until(since + FRAME_TIMEOUT).await,
        None => std::future::pending().await,
    }
}

#[cfg(test)]
mod tests;
