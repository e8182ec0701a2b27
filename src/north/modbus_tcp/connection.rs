//! One connection: bytes in, frames to the session, answers out.

use std::convert::Infallible;
use std::io;
use std::pin::Pin;
use std::time::Duration;

use futures_util::FutureExt;
use futures_util::stream::StreamExt;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::time::{Instant, Sleep};
use tokio_util::sync::CancellationToken;

use super::dialogue::Dialogue;
use super::forwarded_request::AnsweredRequest;
use super::frame::NotModbus;
use super::session::ClientSession;

/// Time for the rest of a frame.
const FRAME_TIMEOUT: Duration = Duration::from_secs(10);
/// Time for the client to take some of its answers.
const WRITE_TIMEOUT: Duration = Duration::from_secs(10);
/// Time for requests under way when the gateway stops, and for a farewell on the wire.
const FAREWELL: Duration = Duration::from_millis(500);
/// Requests after which other clients get their turn, should this one send on and on.
const TURN: usize = 128;

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
    #[error("closed: no request for {0:?} (`idle_timeout`)")]
    Idle(Duration),
    #[error("closed: the client took none of its answers within {WRITE_TIMEOUT:?}")]
    NotReading,
    #[error("connection lost: {0}")]
    Lost(#[from] io::Error),
}

/// Serves a client until it leaves, misbehaves, is silent for `idle_timeout` or the gateway stops.
pub(super) async fn serve<S: AsyncRead + AsyncWrite + Unpin>(
    stream: S,
    session: ClientSession,
    idle_timeout: Option<Duration>,
    cancel: CancellationToken,
) {
    tracing::debug!(client = session.who(), "Modbus TCP: connected");
    let now = Instant::now();
    let mut connection = Connection {
        now,
        stream,
        dialogue: Dialogue::new(session),
        since_yield: 0,
        idle: idle_timeout.map(|timeout| Idle::new(timeout, now)),
    };
    let end = match connection.run(&cancel).await {
        Ok(never) => match never {},
        Err(end) => end,
    };
    if matches!(end, End::Cancelled) {
        connection.farewell().await;
    }
    // A TLS client wants to hear that this is the end and no cut.
    if !matches!(end, End::Lost(_) | End::NotReading) {
        let _ = tokio::time::timeout(FAREWELL, connection.stream.shutdown()).await;
    }
    tracing::debug!(client = connection.dialogue.who(), "Modbus TCP: {end}");
}

struct Connection<S> {
    stream: S,
    dialogue: Dialogue,
    /// The time, as of the last wait: read once a request.
    now: Instant,
    /// Requests since others had their turn.
    since_yield: usize,
    idle: Option<Idle>,
}

impl<S: AsyncRead + AsyncWrite + Unpin> Connection<S> {
    async fn run(&mut self, cancel: &CancellationToken) -> Result<Infallible, End> {
        let mut client_done = false;
        let mut half_frame_since: Option<Instant> = None;
        // One future for all turns: it enters the token's list once, not with every request.
        let mut cancelled = std::pin::pin!(cancel.cancelled());
        loop {
            let worked = self.dialogue.work(self.now.into_std());
            self.dialogue.collect(self.now.into_std());
            if !flush_at_once(&mut self.stream, &mut self.dialogue)? {
                tokio::select! {
                    biased;
                    () = &mut cancelled => return Err(End::Cancelled),
                    flushed = flush(&mut self.stream, &mut self.dialogue) => flushed?,
                }
                self.now = Instant::now();
            }
            let consumed = worked?;
            if consumed.frames > 0 {
                half_frame_since = None;
                self.touch();
                self.give_way(consumed.frames).await;
                if self.since_yield == 0 && cancel.is_cancelled() {
                    return Err(End::Cancelled);
                }
            }
            let full = self.dialogue.is_full();
            if !full && self.dialogue.has_more() {
                self.now = Instant::now();
                continue;
            }
            if client_done && !self.dialogue.is_waiting() {
                return Err(End::Client);
            }
            // While it is the gateway that does not read on, a half frame is nobody's fault.
            let half = self.dialogue.has_input() && !full && !client_done;
            half_frame_since = half.then(|| half_frame_since.unwrap_or_else(Instant::now));
            let reads = !full && !client_done;
            let event = tokio::select! {
                biased;
                event = self.next(reads, half_frame_since) => event?,
                () = &mut cancelled => return Err(End::Cancelled),
            };
            self.now = Instant::now();
            match event {
                Event::Answer(answered) => {
                    self.dialogue.finish(answered, self.now.into_std());
                    self.touch();
                }
                Event::Input(0) => client_done = true,
                Event::Input(count) => self.dialogue.received(count),
            }
        }
    }

    /// Waits for input, if the connection `reads`, and for answers of the bus.
    async fn next(&mut self, reads: bool, half_frame_since: Option<Instant>) -> Result<Event, End> {
        let waits = self.dialogue.is_waiting();
        let (space, waiting) = self.dialogue.parts();
        if reads && let Some(count) = self.stream.read(space).now_or_never() {
            return Ok(Event::Input(count?));
        }
        // A client that waits does not flood the gateway: no need to yield.
        self.since_yield = 0;
        tokio::select! {
            biased;
            Some(answered) = waiting.next() => Ok(Event::Answer(answered)),
            count = self.stream.read(space), if reads => Ok(Event::Input(count?)),
            () = expired(half_frame_since) => Err(End::HalfFrame),
            timeout = Idle::over(self.idle.as_mut()), if !waits => Err(End::Idle(timeout)),
        }
    }

    /// The client uses its connection.
    fn touch(&mut self) {
        if let Some(idle) = &mut self.idle {
            idle.since = self.now;
        }
    }

    /// Lets the other clients have the processor after so many requests of this one.
    async fn give_way(&mut self, frames: usize) {
        self.since_yield += frames;
        if self.since_yield >= TURN {
            self.since_yield = 0;
            tokio::task::yield_now().await;
        }
    }

    /// Gives the requests under way a last chance to be answered.
    async fn farewell(&mut self) {
        let answered = async {
            flush(&mut self.stream, &mut self.dialogue).await?;
            while let Some(answered) = self.dialogue.parts().1.next().await {
                self.dialogue.finish(answered, Instant::now().into_std());
                flush(&mut self.stream, &mut self.dialogue).await?;
            }
            Ok::<(), End>(())
        };
        // Who does not answer or listen within that time has been waited for long enough.
        let _ = tokio::time::timeout(FAREWELL, answered).await;
    }
}

/// What a connection waits for.
enum Event {
    /// An answer from the bus.
    Answer(AnsweredRequest),
    /// So many bytes from the client, 0 at its end.
    Input(usize),
}

/// How long the client has been silent. The timer is set anew only when it runs out, not with each request.
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

    /// Waits until the client was silent for the whole time; for good without a limit.
    async fn over(idle: Option<&mut Idle>) -> Duration {
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

/// Writes the output if the stream takes all of it without waiting, as it nearly always does: no timer, no registration.
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

/// Writes the output; when it is dropped half way, the output keeps what was not written.
async fn flush<S: AsyncWrite + Unpin>(stream: &mut S, dialogue: &mut Dialogue) -> Result<(), End> {
    let output = &mut dialogue.output;
    while !output.is_empty() {
        // The time runs anew with every byte taken: a slow line is no reason to give a client up.
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
