//! A connection: reads requests from the socket and writes the answers, with time limits.

use std::convert::Infallible;
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use futures_util::FutureExt;
use futures_util::stream::StreamExt;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::time::{Instant, Sleep};
use tokio_util::sync::CancellationToken;

use super::dialogue::{Consumed, Dialogue};
use super::forwarded_request::AnsweredRequest;
use super::frame::NotModbus;
use super::session::ClientSession;
use crate::connection_limit::{CloseReason, ConnectionPlace};
use crate::reading::Reader;

/// Time limit for the rest of a frame.
const FRAME_TIMEOUT: Duration = Duration::from_secs(10);
/// Time limit for the client to accept a part of its replies.
const WRITE_TIMEOUT: Duration = Duration::from_secs(10);
/// Time for pending requests when the gateway stops, and for closing the connection.
const CLOSE_TIMEOUT: Duration = Duration::from_millis(500);
/// Time for pending requests after a reload has ended the connection: longer than any request waits for the bus.
const ANSWERED_WITHIN: Duration = Duration::from_secs(30);
/// Maximum number of bytes that are read and discarded before a connection is closed.
const MAX_DISCARDED: usize = 64 * 1024;
/// Number of requests after which a client that sends without pause yields to the others.
const TURN: usize = 128;

/// Why a connection ended.
#[derive(Debug, thiserror::Error)]
enum End {
    #[error("the client closed the connection")]
    Client,
    #[error("closed: the listener or the gateway is stopping")]
    Stopping,
    #[error(transparent)]
    Closed(#[from] CloseReason),
    #[error("closed: not Modbus TCP: {0}")]
    NotModbus(#[from] NotModbus),
    #[error("closed: the client did not complete a frame within {FRAME_TIMEOUT:?}")]
    HalfFrame,
    #[error("closed: no request for {0:?} (`idle_timeout`)")]
    Idle(Duration),
    #[error("closed: the client read none of its replies within {WRITE_TIMEOUT:?}")]
    NotReading,
    #[error("connection lost: {0}")]
    Lost(#[from] io::Error),
}

/// Serves a client until it disconnects, violates the protocol, is idle for `idle_timeout`, or must yield its
/// `place`. Requests that wait for the bus are answered before the end, unless the whole server is `stopping`.
/// Returns the protocol that the client used instead of Modbus TCP.
pub(super) async fn serve<S: AsyncRead + AsyncWrite + Unpin>(
    (stream, reader): (S, Arc<Reader>),
    session: ClientSession,
    idle_timeout: Option<Duration>,
    place: &ConnectionPlace,
    stopping: &CancellationToken,
) -> Option<NotModbus> {
    tracing::debug!(target: "drivegate::north::modbus_tcp", client = session.who(), "Modbus TCP: connected");
    let now = Instant::now();
    let mut connection = Connection {
        now,
        reader,
        stream,
        dialogue: Dialogue::new(session),
        place,
        since_yield: 0,
        idle: idle_timeout.map(|timeout| Idle::new(timeout, now)),
    };
    let end = match connection.run().await {
        Ok(never) => match never {},
        Err(end) => end,
    };
    if matches!(end, End::Stopping | End::Closed(_)) {
        connection.finish_pending(stopping).await;
    }
    // With TLS, a close notification distinguishes a regular end from a truncation.
    if !matches!(end, End::Lost(_) | End::NotReading) {
        close(&mut connection.stream).await;
    }
    if matches!(end, End::NotModbus(_)) {
        let _ = tokio::time::timeout(CLOSE_TIMEOUT, connection.discard_input()).await;
    }
    tracing::debug!(target: "drivegate::north::modbus_tcp", client = connection.dialogue.who(), "Modbus TCP: {end}");
    match end {
        End::NotModbus(spoken) => Some(spoken),
        _ => None,
    }
}

/// Closes the connection of a client that is not served.
pub(super) async fn close<S: AsyncWrite + Unpin>(stream: &mut S) {
    let _ = tokio::time::timeout(CLOSE_TIMEOUT, stream.shutdown()).await;
}

struct Connection<'p, S> {
    stream: S,
    dialogue: Dialogue,
    place: &'p ConnectionPlace,
    /// The time as of the last wait; the clock is read once per request.
    now: Instant,
    /// Reader of the stream.
    reader: Arc<Reader>,
    /// Requests since the last yield.
    since_yield: usize,
    idle: Option<Idle>,
}

impl<S: AsyncRead + AsyncWrite + Unpin> Connection<'_, S> {
    async fn run(&mut self) -> Result<Infallible, End> {
        // When this is set, reading stops; the requests that wait for the bus are still answered.
        let mut input_end: Option<End> = None;
        let mut half_frame_since: Option<Instant> = None;
        // One future serves the whole connection, so that it registers with the token once and not for every request.
        let place = self.place;
        let mut closing = std::pin::pin!(place.closing().cancelled());
        loop {
            let consumed = self.process(&mut input_end);
            self.dialogue.collect(self.now.into_std());
            // Noted before the responses are sent: a client with a response is in use.
            if consumed.frames > 0 {
                self.used();
            }
            if !flush_at_once(&mut self.stream, &mut self.dialogue)? {
                self.reader.ceased();
                tokio::select! {
                    biased;
                    () = &mut closing => return Err(self.close_reason()),
                    flushed = flush(&mut self.stream, &mut self.dialogue) => flushed?,
                }
                self.now = Instant::now();
            }
            if consumed.frames > 0 {
                half_frame_since = None;
                self.yield_if_due(consumed.frames).await;
                if self.since_yield == 0 && place.closing().is_cancelled() {
                    return Err(self.close_reason());
                }
            }
            let full = self.dialogue.is_full();
            let unusable = matches!(input_end, Some(End::NotModbus(_)));
            if !full && !unusable && self.dialogue.has_more() {
                self.now = Instant::now();
                continue;
            }
            if let (Some(_), false) = (&input_end, self.dialogue.is_waiting()) {
                return Err(input_end.unwrap_or(End::Client));
            }
            // While the gateway itself does not read, an incomplete frame is not the client's fault.
            let half = self.dialogue.has_input() && !full && input_end.is_none();
            half_frame_since = half.then(|| half_frame_since.unwrap_or_else(Instant::now));
            let reading = if full || input_end.is_some() {
                Reading::Paused
            } else {
                Reading::On
            };
            let event = tokio::select! {
                biased;
                event = self.next(reading, half_frame_since) => event?,
                () = &mut closing => return Err(self.close_reason()),
            };
            self.now = Instant::now();
            match event {
                Event::Answer(answered) => {
                    self.dialogue.finish(answered, self.now.into_std());
                    self.used();
                }
                Event::Input(0) => input_end = Some(End::Client),
                Event::Input(count) => self.dialogue.received(count, self.reader.last()),
            }
        }
    }

    /// Processes the input, unless an earlier part was not Modbus.
    fn process(&mut self, input_end: &mut Option<End>) -> Consumed {
        if matches!(input_end, Some(End::NotModbus(_))) {
            return Consumed::default();
        }
        let (consumed, misfit) = self.dialogue.process(self.now.into_std());
        if let Some(misfit) = misfit {
            *input_end = Some(misfit.into());
        }
        consumed
    }

    /// Why the connection must end.
    fn close_reason(&self) -> End {
        self.place.close_reason().map_or(End::Stopping, End::Closed)
    }

    /// Waits for answers of the bus and, with `Reading::On`, for input.
    async fn next(&mut self, reading: Reading, half_frame_since: Option<Instant>) -> Result<Event, End> {
        let waits = self.dialogue.is_waiting();
        let (space, waiting) = self.dialogue.parts();
        let reads = reading == Reading::On;
        if reads && let Some(count) = self.stream.read(space).now_or_never() {
            return Ok(Event::Input(count?));
        }
        // A client that is waiting does not flood the gateway, so its task need not yield.
        self.since_yield = 0;
        tokio::select! {
            biased;
            Some(answered) = waiting.next() => Ok(Event::Answer(answered)),
            count = self.stream.read(space), if reads => Ok(Event::Input(count?)),
            () = expired(half_frame_since) => Err(End::HalfFrame),
            timeout = Idle::wait_until_idle(self.idle.as_mut()), if !waits => Err(End::Idle(timeout)),
        }
    }

    /// The client made requests: the idle timeout restarts.
    fn used(&mut self) {
        self.place.use_at(self.now.into_std(), true);
        if let Some(idle) = &mut self.idle {
            idle.since = self.now;
        }
    }

    /// Yields to other clients after [`TURN`] requests.
    async fn yield_if_due(&mut self, frames: usize) {
        self.since_yield += frames;
        if self.since_yield >= TURN {
            self.since_yield = 0;
            tokio::task::yield_now().await;
        }
    }

    /// Reads and discards the data that the client sent after data that is not Modbus. The system resets a
    /// connection that is closed with unread input, and the client could then lose the last answers.
    async fn discard_input(&mut self) {
        let (mut space, mut discarded) = ([0; 1024], 0);
        while let Ok(count) = self.stream.read(&mut space).await
            && count > 0
            && discarded < MAX_DISCARDED
        {
            discarded += count;
        }
    }

    /// Answers pending requests: each was accepted, and its answer arrives within its expiry. When the server
    /// stops, they have half a second.
    async fn finish_pending(&mut self, stopping: &CancellationToken) {
        // A client that reads its answers too slowly is not waited for.
        let within = |flushed: Result<Result<(), End>, _>| flushed.unwrap_or(Err(End::NotReading));
        let answered = async {
            within(tokio::time::timeout(CLOSE_TIMEOUT, flush(&mut self.stream, &mut self.dialogue)).await)?;
            while let Some(answered) = self.dialogue.parts().1.next().await {
                self.dialogue.finish(answered, Instant::now().into_std());
                within(tokio::time::timeout(CLOSE_TIMEOUT, flush(&mut self.stream, &mut self.dialogue)).await)?;
            }
            Ok::<(), End>(())
        };
        let stops = async {
            stopping.cancelled().await;
            tokio::time::sleep(CLOSE_TIMEOUT).await;
        };
        tokio::select! {
            biased;
            _ = tokio::time::timeout(ANSWERED_WITHIN, answered) => {}
            () = stops => {}
        }
    }
}

/// Whether a connection reads input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Reading {
    On,
    /// Reading is paused: the client has finished, or too many of its requests wait.
    Paused,
}

/// An event of a connection.
enum Event {
    /// The bus has answered a request.
    Answer(AnsweredRequest),
    /// Number of bytes from the client, 0 at the end of the stream.
    Input(usize),
}

/// The idle time of the client. The timer is reset only when it fires, not with each request.
struct Idle {
    timeout: Duration,
    since: Instant,
    timer: Pin<Box<Sleep>>,
}

impl Idle {
    fn new(timeout: Duration, now: Instant) -> Idle {
        Idle {
            timeout,
            since: now,
            timer: Box::pin(tokio::time::sleep(timeout)),
        }
    }

    /// Waits until the client was idle for the whole timeout; forever without one.
    async fn wait_until_idle(idle: Option<&mut Idle>) -> Duration {
        let Some(idle) = idle else {
            return std::future::pending().await;
        };
        loop {
            idle.timer.as_mut().await;
            let end = idle.since + idle.timeout;
            if end <= Instant::now() {
                return idle.timeout;
            }
            idle.timer.as_mut().reset(end);
        }
    }
}

/// Writes the output if the stream accepts all of it at once, as it usually does; this needs no timer and no registration.
fn flush_at_once<S: AsyncWrite + Unpin>(stream: &mut S, dialogue: &mut Dialogue) -> Result<bool, End> {
    let output = &mut dialogue.output;
    while !output.is_empty() {
        match stream.write(output).now_or_never().transpose()? {
            None => return Ok(false),
            Some(0) => return Err(io::Error::from(io::ErrorKind::WriteZero).into()),
            Some(count) if count == output.len() => {
                output.clear();
                return Ok(stream.flush().now_or_never().transpose()?.is_some());
            }
            Some(count) => drop(output.drain(..count)),
        }
    }
    Ok(true)
}

/// Writes the output; if this future is dropped, the unwritten part stays in the output.
async fn flush<S: AsyncWrite + Unpin>(stream: &mut S, dialogue: &mut Dialogue) -> Result<(), End> {
    let output = &mut dialogue.output;
    while !output.is_empty() {
        // The time limit restarts with every byte accepted: a slow network is not a stalled client.
        let written = tokio::time::timeout(WRITE_TIMEOUT, stream.write(output)).await;
        match written.map_err(|_| End::NotReading)?? {
            0 => return Err(io::Error::from(io::ErrorKind::WriteZero).into()),
            count if count == output.len() => output.clear(),
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
