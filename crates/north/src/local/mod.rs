//! The local socket: what `drivegate read`, `write`, `record`, `reload` and `health` connect to, on the machine of the gateway. A
//! client whose first byte is not `{` is served the HTTP API (`http/socket_door.rs`).
//!
//! Who may connect is decided by the permissions of the socket's file, and whoever may connect may command, as far as the
//! drives allow it. Commands go the way of all others ([`crate::plant::DriveHandle::place`]) and are audited with the user
//! id of the client's process. Lines, connections and times are bounded; when there are too many connections, one that waits
//! for no response is closed in favour of the newcomer.

mod answer;
pub(crate) mod control;
mod path;
pub mod protocol;
mod restart;

use std::io;
use std::net::{IpAddr, Ipv4Addr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use futures_util::FutureExt;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::UnixStream;
use tokio::task::JoinHandle;
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;

use self::path::Bound;
use self::protocol::{Failure, FailureCode, MAX_REQUEST, Outcome, Request, Response, VERSION};
use crate::NorthStats;
use crate::command::{Authority, Origin, Proof, SourceKind};
use crate::connection_limit::{CloseReason, ConnectionLimit, ConnectionPermit, Limits, Newcomer};
use crate::http::{LocalUser, SocketDoor};
use crate::plant::{Plant, SharedPlant};

pub use answer::answer;
pub use control::{Control, ReloadOrder, absolute};
pub use path::{RuntimeDirectories, SocketPath};

/// Clients at one time.
const MAX_CLIENTS: usize = 32;
/// All clients are of this machine and share one limit.
const THIS_MACHINE: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);
/// Time for a request to arrive, counted from the connection or from the response before.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(10);
/// Time for a client to take its response.
const RESPONSE_TIMEOUT: Duration = Duration::from_secs(5);
/// Wait after an accept error, such as no free descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// How the server is configured.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Where it listens.
    pub socket: SocketPath,
    /// The gateway that it belongs to, where that has a configuration file.
    pub control: Option<Control>,
}

/// What a client may ask.
#[derive(Debug)]
struct Asked {
    /// The HTTP API, for clients that speak it.
    door: SocketDoor,
    plant: SharedPlant,
    stats: Arc<NorthStats>,
    control: Option<Control>,
}

impl Asked {
    async fn answer(&self, request: &Request, origin: Origin, came: Instant) -> Outcome {
        let plant = self.plant.load_full();
        let control = self.control.as_ref();
        let answered = match request {
            Request::Reload(asked) => control::reload(control, asked, origin.who.to_string())
                .await
                .map(Outcome::Reload),
            Request::StopAll(asked) => control::stop_all(control, asked, &plant, &origin)
                .await
                .map(Outcome::StopAll),
            Request::Health(asked) => control::health(control, asked, &plant, &self.stats).map(Outcome::Health),
            of_drive => Ok(answer(of_drive, &self.plant, origin, came).await),
        };
        answered.unwrap_or_else(Outcome::Error)
    }
}

/// The running server.
#[derive(Debug)]
pub struct Local {
    path: PathBuf,
    task: JoinHandle<()>,
}

impl Local {
    /// Where it listens.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Waits until it takes no more clients and its file is removed. A request that is being carried out gets its
    /// response from the bus.
    pub async fn stopped(self) {
        if let Err(error) = self.task.await {
            tracing::error!(target: "drivegate::local", "the local socket ended by itself: {error}; report this");
        }
    }
}

/// Starts the server at the first path that it can have. It runs until `cancel`, whatever clients do.
///
/// # Errors
/// When the socket cannot be bound: what and where.
pub async fn start(
    options: &Options,
    plant: SharedPlant,
    stats: Arc<NorthStats>,
    cancel: CancellationToken,
) -> io::Result<Local> {
    let paths = options.socket.of_gateway(&RuntimeDirectories::of_this_process());
    let first = paths.first().map(|path| path.display().to_string()).unwrap_or_default();
    let bound = path::bind_first(&paths)
        .await
        .map_err(|error| io::Error::new(error.kind(), format!("cannot listen on {first}: {error}")))?;
    let path = bound.path.clone();
    let control = options.control.clone();
    let door = SocketDoor::new(&plant, &stats, cancel.clone());
    let asked = Arc::new(Asked {
        door,
        plant,
        stats,
        control,
    });
    tracing::info!(target: "drivegate::local", path = %path.display(), "local socket: listening");
    let task = tokio::spawn(accept(bound, asked, cancel));
    Ok(Local { path, task })
}

async fn accept(bound: Bound, asked: Arc<Asked>, cancel: CancellationToken) {
    let limit = ConnectionLimit::new(Limits::new(MAX_CLIENTS, MAX_CLIENTS));
    let newcomer = Newcomer {
        address: THIS_MACHINE,
        listener: 0,
        cancel: &cancel,
    };
    while let Some(accepted) = cancel.run_until_cancelled(bound.listener.accept()).await {
        match accepted {
            Ok((stream, _)) => match limit.acquire(newcomer, Instant::now(), || Some(Authority::Write)) {
                Ok((permit, _)) => drop(tokio::spawn(serve(stream, asked.clone(), permit))),
                Err(_) => turn_away(&stream, &asked.plant.load()),
            },
            Err(error) => {
                tracing::debug!(target: "drivegate::local", "cannot accept a local client: {error}; trying again");
                cancel.run_until_cancelled(tokio::time::sleep(ACCEPT_PAUSE)).await;
            }
        }
    }
}

/// Answers a client that is too many. What does not fit the socket's buffer at once is dropped.
fn turn_away(stream: &UnixStream, plant: &Plant) {
    let message = format!("{MAX_CLIENTS} local clients are connected already; try again");
    let failure = Failure::new(FailureCode::Busy, message);
    let _ = stream.try_write(&response(plant, Outcome::Error(failure)));
}

fn response(plant: &Plant, result: Outcome) -> Vec<u8> {
    protocol::line(&Response {
        v: VERSION,
        gateway: plant.gateway.clone(),
        result,
    })
}

/// Serves one client until it leaves, falls silent, takes no response or yields to another one.
async fn serve(stream: UnixStream, asked: Arc<Asked>, permit: ConnectionPermit) {
    // Without a user id there is nobody to hold the command against.
    let Ok(peer) = stream.peer_cred() else { return };
    let place = permit.place();
    let origin = Origin::new(SourceKind::LocalSocket, format!("uid {}", peer.uid())).proven(Proof::Uid(peer.uid()));
    // What is found at once may have come since.
    let mut since = Instant::now();
    let mut stream = BufReader::new(stream);
    if speaks_http(&mut stream, place.closing()).await {
        let user = LocalUser {
            uid: peer.uid(),
            control: asked.control.clone(),
        };
        return asked.door.serve(stream, user, place).await;
    }
    loop {
        let request = timeout(REQUEST_TIMEOUT, next_line(&mut stream, since));
        let Some(Ok(Ok((line, came)))) = place.closing().run_until_cancelled(request).await else {
            break;
        };
        since = Instant::now();
        place.use_at(since, true);
        let (result, goes_on) = match line {
            Line::End => break,
            Line::TooLong => {
                let message = format!("the request is longer than {MAX_REQUEST} bytes");
                (Outcome::Error(Failure::new(FailureCode::BadRequest, message)), false)
            }
            Line::Whole(line) => match protocol::parse(&line) {
                Ok(request) => (asked.answer(&request, origin.clone(), came).await, true),
                Err(failure) => (Outcome::Error(failure), true),
            },
        };
        let response = response(&asked.plant.load(), result);
        let written = timeout(RESPONSE_TIMEOUT, stream.write_all(&response)).await;
        if !matches!(written, Ok(Ok(()))) || !goes_on {
            break;
        }
        place.use_at(Instant::now(), false);
    }
    if place.close_reason() == Some(CloseReason::Displaced) {
        turn_away(stream.get_ref(), &asked.plant.load());
    }
}

/// Whether the client's first byte is that of an HTTP request; a request of the other protocol begins with `{`.
async fn speaks_http(stream: &mut BufReader<UnixStream>, closing: &CancellationToken) -> bool {
    let first = timeout(REQUEST_TIMEOUT, stream.fill_buf());
    let first = closing.run_until_cancelled(first).await;
    matches!(first, Some(Ok(Ok(bytes))) if bytes.first().is_some_and(u8::is_ascii_uppercase))
}

enum Line {
    /// With its end: what a client began and did not end is not carried out.
    Whole(Vec<u8>),
    TooLong,
    End,
}

/// The next line, and when its first byte came: what is there at once may have come at `since`.
async fn next_line(reader: &mut (impl AsyncBufReadExt + Unpin), since: Instant) -> io::Result<(Line, Instant)> {
    let mut line = Vec::new();
    let came = match reader.fill_buf().now_or_never() {
        Some(there) => there.map(|_| since)?,
        None => reader.fill_buf().await.map(|_| Instant::now())?,
    };
    reader.take(MAX_REQUEST as u64).read_until(b'\n', &mut line).await?;
    let line = match line.last() {
        Some(b'\n') => Line::Whole(line),
        _ if line.len() == MAX_REQUEST => Line::TooLong,
        _ => Line::End,
    };
    Ok((line, came))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn a_request_counts_from_its_first_byte() {
        let (mut client, server) = tokio::io::duplex(4096);
        let mut reader = BufReader::new(server);
        let begun = Instant::now();
        let reading = tokio::spawn(async move {
            let first = next_line(&mut reader, begun).await.unwrap();
            let since = Instant::now();
            // Both are there at once.
            let second = next_line(&mut reader, since).await.unwrap();
            (first.1, since, second.1)
        });
        tokio::task::yield_now().await;
        client.write_all(b"{\"v\"").await.unwrap();
        tokio::task::yield_now().await;
        let half = Instant::now();
        std::thread::sleep(Duration::from_millis(5));
        client.write_all(b": 1}\n{}\n").await.unwrap();
        let (first, since, second) = reading.await.unwrap();
        assert!(begun <= first && first <= half, "when it began");
        assert_eq!(second, since);
    }
}
