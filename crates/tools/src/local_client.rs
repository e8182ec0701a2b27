//! A client of the local socket of a running gateway.

use std::io;
use std::path::Path;
use std::time::Duration;

use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::UnixStream;
use tokio::time::timeout;

use crate::config::{self, Settings};
use crate::north::local::protocol::{FailureCode, MAX_RESPONSE, OfGateway, Outcome, Request, Response, request_line};
use crate::north::local::{RuntimeDirectories, SocketPath, absolute};

/// Time for a response: a command may wait for its turn and its confirmation, a read for a slow line, a reload for its
/// files.
const RESPONSE_TIMEOUT: Duration = Duration::from_secs(40);

/// Whether no gateway listens there.
pub(super) fn is_nobody(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionRefused, NotADirectory, NotFound};
    matches!(error.kind(), ConnectionRefused | NotFound | NotADirectory)
}

/// Sends a request and waits for its response.
///
/// # Errors
/// The gateway does not answer, or not in its protocol.
pub(super) async fn exchange(mut stream: UnixStream, request: &Request) -> io::Result<Response> {
    let exchange = async {
        // A gateway that turns a client away answers without waiting for its request.
        let written = stream.write_all(&request_line(request)).await;
        let mut line = Vec::new();
        BufReader::new((&mut stream).take(MAX_RESPONSE as u64))
            .read_until(b'\n', &mut line)
            .await?;
        if line.last() != Some(&b'\n') {
            written?;
            return Err(io::Error::new(io::ErrorKind::UnexpectedEof, "it closed the connection"));
        }
        serde_json::from_slice(&line).map_err(io::Error::from)
    };
    timeout(RESPONSE_TIMEOUT, exchange).await.map_err(io::Error::from)?
}

/// Why a gateway was not asked.
#[derive(Debug)]
pub(super) enum NotAsked {
    /// Its configuration has `socket = ""`.
    Off,
    /// In words.
    Because(String),
}

/// Asks the gateway that runs with the configuration file `config`, which may be invalid.
///
/// # Errors
/// No such gateway can be reached, or it does not answer.
pub(super) async fn ask_gateway(
    config: &Path,
    request: impl FnOnce(OfGateway) -> Request,
) -> Result<Outcome, NotAsked> {
    let socket = Settings::socket_of(config, config::environment());
    if socket == SocketPath::Off {
        return Err(NotAsked::Off);
    }
    let meant = absolute(config).display().to_string();
    let request = request(OfGateway { config: Some(meant) });
    let because = |why: String| Err(NotAsked::Because(why));
    let mut reasons = Vec::new();
    for path in socket.of_client(&RuntimeDirectories::of_this_process()) {
        let shown = path.display();
        let response = match UnixStream::connect(&path).await {
            Ok(stream) => exchange(stream, &request).await,
            Err(error) if is_nobody(&error) => continue,
            Err(error) => {
                reasons.push(format!("cannot connect to {shown}: {error}"));
                continue;
            }
        };
        match response.map(|response| response.result) {
            Err(error) => return because(format!("the gateway did not answer: {error}; {shown}; look at its log")),
            Ok(Outcome::Error(failure)) if failure.code == FailureCode::OtherGateway => {
                reasons.push(format!("at {shown} {}", failure.message));
            }
            Ok(Outcome::Error(failure)) => return because(format!("{}; {shown}; look at its log", failure.message)),
            Ok(outcome) => return Ok(outcome),
        }
    }
    let why = match reasons.is_empty() {
        true => "no gateway listens".to_string(),
        false => reasons.join(", "),
    };
    because(format!(
        "no running gateway was found: {why}; {}; start it with this file, use sudo, or join the group of the socket",
        config.display()
    ))
}
