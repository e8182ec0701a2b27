//! The client of all commands that send requests to a gateway: HTTP over its local socket, over the network, or
//! within the process.

mod door;
mod events;
mod exchange;
mod gateway;
mod url;

use std::error::Error as _;
use std::io;
use std::path::PathBuf;
use std::time::Duration;

use hyper::StatusCode;
use serde::de::DeserializeOwned;
use tokio::time::timeout;

pub(crate) use self::door::Door;
use self::door::NotConnected;
pub(crate) use self::events::EventStream;
use self::exchange::Opened;
pub(crate) use self::exchange::{GatewayRequest, Reply};
pub(crate) use self::gateway::Gateway;
pub(crate) use self::url::Url;
use drivegate_http::messages::{ErrorReply, Expected};

/// Time limit for connecting.
const CONNECT: Duration = Duration::from_secs(10);
/// Maximum number of attempts for a request that only reads, if the connection is interrupted. A gateway that is
/// shutting down interrupts connections, and has ended a moment later.
const TRIES: u32 = 5;
/// Pause between two attempts to reach the gateway.
const PAUSE: Duration = Duration::from_millis(200);

/// Why a gateway sent no reply; the messages contain problem, place and remedy.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ClientError {
    /// No gateway listens there, or the connection is blocked.
    #[error(
        "cannot reach the gateway: {1}; {0}; start it with an [http] section, or pass its `listen` address with --url"
    )]
    Unreachable(String, String),
    /// No gateway of the configuration listens at its sockets.
    #[error("no running gateway was found: {}; {}", .0.describe(), .0.remedy())]
    NotFound(NotFound),
    /// A file of the command line cannot be used.
    #[error("{0}")]
    File(String),
    /// The TLS handshake failed.
    #[error("no TLS connection: {0}")]
    Tls(String),
    /// The gateway refused, with a reason.
    #[error("{0}")]
    Refused(String),
    /// The reply did not arrive, or arrived incomplete.
    #[error("{0}")]
    Lost(String),
    /// The reply is not that of a gateway.
    #[error("{1}; {0}; check that this is the address of drivegate's [http] section")]
    Strange(String, String),
    /// The event stream ended early.
    #[error(
        "the gateway ended the stream{1}; {0}; it was stopped, or a reload removed the bus: start it and try again"
    )]
    Ended(String, String),
    /// No data was received within the time limit.
    #[error("the gateway stopped responding; {0}; check the gateway and the network, then try again")]
    Silent(String),
}

impl From<ClientError> for String {
    fn from(error: ClientError) -> String {
        error.to_string()
    }
}

/// Why no gateway was found at the local sockets.
#[derive(Debug, Default)]
pub(crate) struct NotFound {
    /// Sockets that could not be opened.
    pub(crate) closed: Vec<String>,
    /// Names of other gateways that were found.
    pub(crate) others: Vec<String>,
    file: Option<PathBuf>,
}

impl NotFound {
    fn describe(&self) -> String {
        let reasons: Vec<&str> = self.closed.iter().chain(&self.others).map(String::as_str).collect();
        let why = if reasons.is_empty() {
            "no gateway listens".to_string()
        } else {
            reasons.join(", ")
        };
        match &self.file {
            Some(file) => format!("{why}; {}", file.display()),
            None => why,
        }
    }

    /// What to do: a socket that cannot be opened needs another user, and without one the gateway does not run.
    pub(crate) fn remedy(&self) -> String {
        match &self.file {
            _ if !self.closed.is_empty() => "use sudo, or join the group of the socket".to_string(),
            Some(file) => format!("start it: drivegate run --config {}", file.display()),
            None => "start the gateway".to_string(),
        }
    }
}

/// A client of the first gateway that is the expected one.
#[derive(Debug, Clone)]
pub(crate) struct Client {
    doors: Vec<Door>,
    /// The expected gateway; `None` accepts any.
    expected: Option<Expected>,
    /// Path of the configuration, for messages.
    file: Option<PathBuf>,
}

impl Client {
    /// A client of the gateway that listens at this address, whichever gateway this is.
    pub(crate) fn through(door: Door) -> Client {
        Client {
            doors: vec![door],
            expected: None,
            file: None,
        }
    }

    /// The addresses at which the client looks for the gateway.
    pub(crate) fn doors(&self) -> &[Door] {
        &self.doors
    }

    /// Sends a request and waits for the head of the reply.
    ///
    /// # Errors
    /// If no gateway is found, or it does not answer.
    async fn open(&self, asked: &GatewayRequest) -> Result<Opened, ClientError> {
        let mut missed = NotFound {
            file: self.file.clone(),
            ..NotFound::default()
        };
        for door in &self.doors {
            let opened = match self.open_at(door, asked).await {
                Ok(opened) => opened,
                Err(NotConnected::Nobody) => continue,
                Err(NotConnected::Because(why)) if door.is_network() => {
                    missed.closed.push(why);
                    let why = missed.closed.join(", ");
                    return Err(ClientError::Unreachable(door.to_string(), why));
                }
                Err(NotConnected::Because(why)) => {
                    missed.closed.push(why);
                    continue;
                }
                Err(NotConnected::Final(error)) => return Err(error),
            };
            if opened.status != StatusCode::MISDIRECTED_REQUEST || door.is_network() {
                return Ok(opened);
            }
            let reply: Option<ErrorReply> = opened.whole(asked).await?.parsed();
            let why = reply.map_or("another gateway".to_string(), |reply| reply.error);
            missed.others.push(format!("at {door} {why}"));
        }
        Err(ClientError::NotFound(missed))
    }

    async fn open_at(&self, door: &Door, asked: &GatewayRequest) -> Result<Opened, NotConnected> {
        let authorization = door.authorization().map_err(NotConnected::Final)?;
        let mut tries = 1;
        loop {
            let stream = match timeout(CONNECT, door.connect()).await {
                Ok(stream) => stream?,
                Err(_) => return Err(NotConnected::Because("no connection within 10 s".to_string())),
            };
            let sent = Opened::send(stream, door, authorization.as_deref(), self.expected.as_ref(), asked);
            let place = || door.to_string();
            let error = match timeout(asked.within, sent).await {
                Ok(Ok(opened)) => return Ok(opened),
                Ok(Err(error)) => error,
                Err(_) => return Err(NotConnected::Final(asked.late(&place()))),
            };
            if door.is_network() {
                let why = format!("not an HTTP reply ({error})");
                return Err(NotConnected::Final(ClientError::Strange(place(), why)));
            }
            if tries == TRIES || !asked.only_reads() || !is_cut_off(&error) {
                return Err(NotConnected::Final(asked.lost(&place(), &error.to_string())));
            }
            tries += 1;
            tokio::time::sleep(PAUSE).await;
        }
    }

    /// Sends a request and waits for the reply.
    ///
    /// # Errors
    /// If no gateway is found, or it does not answer.
    pub(crate) async fn ask(&self, asked: &GatewayRequest) -> Result<Reply, ClientError> {
        self.open(asked).await?.whole(asked).await
    }

    /// Calls [`Client::ask`] outside of a runtime.
    ///
    /// # Errors
    /// The errors of [`Client::ask`], as a message.
    pub(crate) fn ask_now(&self, asked: &GatewayRequest) -> Result<Reply, String> {
        Ok(crate::runtime()?.block_on(self.ask(asked))?)
    }

    /// The document at `path`, which begins with a slash.
    ///
    /// # Errors
    /// If no gateway is found, or it refuses.
    pub(crate) async fn view<T: DeserializeOwned>(&self, path: &str) -> Result<T, ClientError> {
        let asked = GatewayRequest::view(path);
        self.ask(&asked).await?.accepted(&asked)
    }
}

fn is_cut_off(error: &hyper::Error) -> bool {
    use io::ErrorKind::{BrokenPipe, ConnectionReset, UnexpectedEof};
    let cause = error.source().and_then(|cause| cause.downcast_ref::<io::Error>());
    let is_cut = |error: &io::Error| matches!(error.kind(), BrokenPipe | ConnectionReset | UnexpectedEof);
    error.is_incomplete_message() || error.is_closed() || error.is_canceled() || cause.is_some_and(is_cut)
}

/// A name as a part of a path or query.
pub(crate) fn encoded(name: &str) -> String {
    percent_encoding::utf8_percent_encode(name, percent_encoding::NON_ALPHANUMERIC).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_closed_socket_is_not_a_gateway_that_does_not_run() {
        let missed = |closed: &[&str], file: Option<&str>| NotFound {
            closed: closed.iter().map(ToString::to_string).collect(),
            others: Vec::new(),
            file: file.map(PathBuf::from),
        };
        let refused = "cannot connect to /run/drivegate/drivegate.sock: Permission denied (os error 13)";
        for (missed, wanted) in [
            (
                missed(&[refused], Some("/etc/d.toml")),
                format!("no running gateway was found: {refused}; /etc/d.toml; use sudo, or join the group of the socket"),
            ),
            (
                missed(&[], Some("/etc/d.toml")),
                "no running gateway was found: no gateway listens; /etc/d.toml; start it: drivegate run --config /etc/d.toml"
                    .to_string(),
            ),
            (
                missed(&[], None),
                "no running gateway was found: no gateway listens; start the gateway".to_string(),
            ),
        ] {
            assert_eq!(ClientError::NotFound(missed).to_string(), wanted);
        }
    }
}
