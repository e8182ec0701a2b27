//! Through the running gateway: a client of its local socket.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::net::UnixStream;

use super::Target;
use crate::local_client::{exchange, is_nobody};
use crate::north::local::protocol::{FailureCode, Outcome, Request};
use crate::north::local::{RuntimeDirectories, SocketPath};
use crate::report;

/// How often a request that only reads is sent in all where the connection is cut off: a gateway that just ends does that, and
/// has gone a moment later.
const TRIES: u32 = 5;
/// Pause before the next of them.
const PAUSE: Duration = Duration::from_millis(200);

/// Why no gateway was asked, for the message when the port cannot be opened either.
#[derive(Debug)]
pub(super) struct NotFound(pub(super) String);

/// Sends the request to the gateway of the target's configuration, if one runs.
///
/// # Errors
/// When one runs but gives no outcome; the line must not be tried then.
pub(super) async fn ask(target: &Target, request: &Request) -> Result<Result<Outcome, NotFound>, String> {
    let paths = target.settings.socket.of_client(&RuntimeDirectories::of_this_process());
    let (mut reasons, mut others) = (Vec::new(), Vec::new());
    'paths: for path in &paths {
        let mut tries = 1;
        let response = loop {
            let stream = match UnixStream::connect(path).await {
                Ok(stream) => stream,
                Err(error) if is_nobody(&error) => continue 'paths,
                Err(error) => {
                    let reason = format!("cannot connect to {}: {error}", path.display());
                    // A serial port is locked by its owner; with a device server there would be two masters on the line.
                    if target.bus.spec.port.contains("://") {
                        return Err(format!(
                            "{reason}; bus `{}`; use sudo, or join the group of the socket",
                            target.bus.spec.name
                        ));
                    }
                    reasons.push(reason);
                    continue 'paths;
                }
            };
            match exchange(stream, request).await {
                Ok(response) => break response,
                Err(error) if tries < TRIES && is_cut_off(&error) && only_reads(request) => {
                    tries += 1;
                    tokio::time::sleep(PAUSE).await;
                }
                Err(error) => return Err(lost(path, request, &error)),
            }
        };
        match response.result {
            Outcome::Error(failure) if failure.code == FailureCode::OtherGateway => {
                others.push(format!("at {} {}", path.display(), failure.message));
            }
            Outcome::Error(failure) => return Err(refused(path, failure.code, &failure.message)),
            outcome => return Ok(Ok(outcome)),
        }
    }
    if !others.is_empty() {
        report::note(&format!("{}; the command opens the port itself", others.join(", ")));
    }
    reasons.extend(others);
    Ok(Err(NotFound(not_found(target, &paths, reasons))))
}

/// Whether a request may be sent again without doing anything twice.
fn only_reads(request: &Request) -> bool {
    matches!(request, Request::Read(_) | Request::Why(_) | Request::Health(_))
}

fn is_cut_off(error: &io::Error) -> bool {
    use io::ErrorKind::{BrokenPipe, ConnectionReset, UnexpectedEof};
    matches!(error.kind(), BrokenPipe | ConnectionReset | UnexpectedEof)
}

fn lost(path: &Path, request: &Request, error: &io::Error) -> String {
    let remedy = match request {
        Request::Read(_)
        | Request::Why(_)
        | Request::Record(_)
        | Request::Params(_)
        | Request::StopAll(_)
        | Request::Reload(_)
        | Request::Health(_) => "try again",
        Request::ParamsRestore(_) => {
            "a started restore continues in the gateway: see `drivegate params restore --look DRIVE`"
        }
        Request::Write(_) => "whether the drive took the command is not known: read before you repeat it",
    };
    format!("the gateway did not answer: {error}; {}; {remedy}", path.display())
}

fn refused(path: &Path, code: FailureCode, message: &str) -> String {
    let remedy = match code {
        FailureCode::Busy => "try again",
        FailureCode::NoParameters => {
            "parameters can be read of drives whose profile lists them, on lines that the gateway owns"
        }
        FailureCode::NotRestored => return format!("{message}; {}", path.display()),
        FailureCode::NotRecorded => "set max_count of [recordings] above 0 and reload",
        FailureCode::OtherConfiguration | FailureCode::UnknownDrive | FailureCode::UnknownPoint => {
            "the gateway there runs with another configuration: reload it, or name its file by --config"
        }
        _ => "gateway and command may be of different versions: restart the gateway",
    };
    format!("{message}; {}; {remedy}", path.display())
}

fn not_found(target: &Target, paths: &[PathBuf], reasons: Vec<String>) -> String {
    match &target.settings.socket {
        _ if !reasons.is_empty() => reasons.join(", "),
        SocketPath::Off => "`socket` of [gateway] is off, so a running gateway cannot be asked".to_string(),
        SocketPath::At(path) => format!("no gateway listens at {}", path.display()),
        SocketPath::Default => {
            let mut directories: Vec<String> = paths
                .iter()
                .filter_map(|path| path.parent())
                .map(|dir| dir.display().to_string())
                .collect();
            directories.dedup();
            format!("no gateway listens in {}", directories.join(" or "))
        }
    }
}
