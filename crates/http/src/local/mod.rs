//! The local socket: the HTTP API for commands on the machine of the gateway (`socket_door.rs`).
//!
//! The permissions of the socket's file decide who may connect, and any client that can connect may command as far
//! as the drives allow. Commands are placed like all others ([`drivegate_core::plant::DriveHandle::place`]) and audited with
//! the user id of the client's process. Connections and times are bounded; if there are too many connections, an
//! idle one is closed in favour of the new one.

pub(crate) mod control;
mod path;

use std::net::{IpAddr, Ipv4Addr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use futures_util::FutureExt;
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader};
use tokio::net::UnixStream;
use tokio::task::JoinHandle;
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use self::path::Bound;
use crate::{LocalUser, SocketDoor};
use drivegate_core::order::{Authority, Proof, Right, SourceKind};
use drivegate_core::plant::SharedPlant;
use drivegate_north::connection_limit::{CloseReason, ConnectionLimit, ConnectionPermit, Limits, Newcomer};
use drivegate_north::reading::{Dated, Reader, is_readable};
use drivegate_north::{NorthState, Server, ServerError};

pub use control::{Control, ReloadOrder, absolute};
pub use path::{RuntimeDirectories, SocketPath};

/// Maximum number of simultaneous clients.
const MAX_CLIENTS: usize = 32;
/// The address under which all local clients are counted, so that they share one limit.
const THIS_MACHINE: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);
/// Time for the first byte of a client.
const FIRST_BYTE: Duration = Duration::from_secs(10);
/// Wait after an accept error, such as no free descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Options of the local socket.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// The path of the socket.
    pub socket: SocketPath,
    /// The gateway of this socket, if that gateway has a configuration file.
    pub control: Option<Control>,
}

/// What local clients can reach: the HTTP API and the gateway control.
#[derive(Debug)]
struct Door {
    http: SocketDoor,
    control: Option<Control>,
    right: Arc<AtomicBool>,
}

/// The running local socket server.
#[derive(Debug)]
pub struct Local {
    path: PathBuf,
    /// Whether local users may still write.
    right: Arc<AtomicBool>,
    task: JoinHandle<()>,
    connections: TaskTracker,
}

impl Local {
    /// The path of the socket.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The open connections: each ends when the orders received over it are answered, even if the server has stopped.
    pub fn connections(&self) -> TaskTracker {
        self.connections.clone()
    }
}

impl Server for Local {
    const NAME: &'static str = "the local socket";
    type Options = Options;

    /// Starts the server at the first available path. It runs until `cancel`, whatever clients do.
    ///
    /// # Errors
    /// If the socket cannot be bound; contains what failed and where.
    async fn start(
        options: Options,
        plant: SharedPlant,
        stats: Arc<NorthState>,
        cancel: CancellationToken,
    ) -> Result<Local, ServerError> {
        let paths = options.socket.of_gateway(&RuntimeDirectories::of_this_process());
        let first = paths.first().cloned().unwrap_or_default();
        let bound = path::bind_first(&paths)
            .await
            .map_err(|cause| ServerError::Local { path: first, cause })?;
        let path = bound.path.clone();
        let right = Arc::new(AtomicBool::new(true));
        let door = Arc::new(Door {
            right: right.clone(),
            http: SocketDoor::new(&plant, &stats, cancel.clone()),
            control: options.control,
        });
        tracing::info!(target: "drivegate::local", path = %path.display(), "local socket: listening");
        let connections = TaskTracker::new();
        let task = tokio::spawn(accept(bound, door, connections.clone(), cancel));
        Ok(Local {
            path,
            right,
            task,
            connections,
        })
    }

    /// The file's permissions are the right to command. After its removal, another socket may be open to other
    /// users, so the rights end.
    fn end_rights(&self, _: Option<&Options>) {
        self.right.store(false, Ordering::Release);
    }

    /// The socket file is removed; a request in progress still gets its response from the bus.
    async fn stopped(self) {
        if let Err(error) = self.task.await {
            tracing::error!(target: "drivegate::local", "the local socket ended unexpectedly: {error}; please report \
                                                         this");
        }
    }
}

async fn accept(bound: Bound, door: Arc<Door>, connections: TaskTracker, cancel: CancellationToken) {
    let limit = ConnectionLimit::new(Limits::new(MAX_CLIENTS, MAX_CLIENTS));
    let newcomer = Newcomer {
        address: THIS_MACHINE,
        listener: 0,
        cancel: &cancel,
    };
    // A client may have connected and sent bytes while this runtime was stalled.
    let reader = Reader::here();
    loop {
        let accepted = match bound.listener.accept().now_or_never() {
            Some(accepted) => accepted,
            None => {
                reader.nothing(Instant::now(), || is_readable(&bound.listener));
                match cancel.run_until_cancelled(bound.listener.accept()).await {
                    Some(accepted) => accepted,
                    None => return,
                }
            }
        };
        if cancel.is_cancelled() {
            return;
        }
        reader.note_read(Instant::now(), false, || false);
        match accepted {
            Ok((stream, _)) => match limit.acquire(newcomer, Instant::now(), || Some(Authority::Write)) {
                Ok((permit, _)) => {
                    let stream = Dated::new(stream, Arc::new(reader.accepted()));
                    drop(connections.spawn(serve(stream, door.clone(), permit)));
                }
                Err(_) => turn_away(&stream),
            },
            Err(error) => {
                tracing::debug!(target: "drivegate::local", "cannot accept a local client: {error}; retrying");
                cancel.run_until_cancelled(tokio::time::sleep(ACCEPT_PAUSE)).await;
            }
        }
    }
}

/// Answers a client beyond the limit. The part of the answer that does not fit into the buffer of the socket is discarded.
fn turn_away(stream: &UnixStream) {
    let body = format!("{{\"error\":\"{MAX_CLIENTS} local clients are already connected; try again\"}}");
    let head =
        "HTTP/1.1 503 Service Unavailable\r\ncontent-type: application/json\r\nretry-after: 1\r\nconnection: close";
    let _ = stream.try_write(format!("{head}\r\ncontent-length: {}\r\n\r\n{body}", body.len()).as_bytes());
}

/// The reply to a client that does not use HTTP.
const NOT_HTTP: &str =
    "{\"error\":\"this socket serves HTTP; try curl --unix-socket PATH http://gateway/api/v1/drives\"}\n";

/// Serves one client until it disconnects, is idle too long or yields to another one.
async fn serve(stream: Dated<UnixStream>, door: Arc<Door>, permit: ConnectionPermit) {
    // Without a user id the command could not be audited, so the connection is closed.
    let Ok(peer) = stream.stream().peer_cred() else {
        return;
    };
    let reader = stream.reader().clone();
    let place = permit.place();
    let mut stream = BufReader::new(stream);
    let first = timeout(FIRST_BYTE, stream.fill_buf());
    match place.closing().run_until_cancelled(first).await {
        None if place.close_reason() == Some(CloseReason::Displaced) => turn_away(stream.get_ref().stream()),
        Some(Ok(Ok([first, ..]))) if first.is_ascii_uppercase() => {
            let user = LocalUser {
                kind: SourceKind::LocalSocket,
                who: format!("uid {}", peer.uid()).into(),
                proof: Proof::Uid(peer.uid()),
                right: Right::of(door.right.clone()),
                control: door.control.clone(),
            };
            door.http.serve((stream, reader), user, place).await;
        }
        Some(Ok(Ok([_, ..]))) => {
            let _ = timeout(FIRST_BYTE, stream.write_all(NOT_HTTP.as_bytes())).await;
        }
        _ => {}
    }
}
