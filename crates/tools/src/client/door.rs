//! The ways to reach a gateway, and the connection over them.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rustls_pki_types::ServerName;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpStream, UnixStream};
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;

use super::{ClientError, Url};
use drivegate_http::{InProcess, basic_authorization};
use drivegate_north::tls;

/// Remedy for a failed TLS handshake whose error suggests none.
const NO_TLS: &str = "pass the CA of the gateway's certificate with --ca, or use http://";

/// A way to reach a gateway.
#[derive(Debug, Clone)]
pub(crate) enum Door {
    /// The HTTP server of the gateway.
    Network(Network),
    /// The local socket of the gateway.
    Socket(PathBuf),
    /// A gateway's parts in this process.
    InProcess(Arc<InProcess>),
}

/// An HTTP server on the network, with the CA and the token for it.
#[derive(Debug, Clone)]
pub(crate) struct Network {
    pub(crate) url: Url,
    /// CA certificates; `None` for the certificates of the system.
    pub(crate) ca: Option<PathBuf>,
    pub(crate) token_file: Option<PathBuf>,
}

/// A connection, with TLS or without.
pub(crate) trait Stream: AsyncRead + AsyncWrite + Unpin + Send {}

impl<S: AsyncRead + AsyncWrite + Unpin + Send> Stream for S {}

/// Reason why a connection was not made.
#[derive(Debug)]
pub(super) enum NotConnected {
    /// No gateway listens at this address.
    Nobody,
    /// A gateway may exist there; the text says why it was not reached.
    Because(String),
    /// The error is final: no further address is tried.
    Final(ClientError),
}

impl fmt::Display for Door {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Door::Network(network) => network.url.fmt(f),
            Door::Socket(path) => path.display().fmt(f),
            Door::InProcess(_) => f.write_str("its bus"),
        }
    }
}

impl Door {
    pub(super) fn is_network(&self) -> bool {
        matches!(self, Door::Network(_))
    }

    /// The path prefix of a request, and the host.
    pub(super) fn base(&self) -> (&str, &str) {
        match self {
            Door::Network(network) => (&network.url.path, &network.url.authority),
            Door::Socket(_) | Door::InProcess(_) => ("", "gateway"),
        }
    }

    /// Value of the `Authorization` header.
    ///
    /// # Errors
    /// If the token file cannot be read.
    pub(super) fn authorization(&self) -> Result<Option<String>, ClientError> {
        match self {
            Door::Network(network) => network.token_file.as_deref().map(authorization).transpose(),
            Door::Socket(_) | Door::InProcess(_) => Ok(None),
        }
    }

    /// Connects to the gateway.
    ///
    /// # Errors
    /// If no gateway listens, or the TLS handshake fails.
    pub(super) async fn connect(&self) -> Result<Box<dyn Stream>, NotConnected> {
        match self {
            Door::Network(network) => network.connect().await,
            Door::Socket(path) => match UnixStream::connect(path).await {
                Ok(stream) => Ok(Box::new(stream)),
                Err(error) if is_nobody(&error) => Err(NotConnected::Nobody),
                Err(error) => Err(NotConnected::Because(format!(
                    "cannot connect to {}: {error}",
                    path.display()
                ))),
            },
            Door::InProcess(door) => match door.connect() {
                Some(stream) => Ok(Box::new(stream)),
                None => Err(NotConnected::Because("too many requests at once".to_string())),
            },
        }
    }
}

/// Whether the error means that no gateway listens there.
fn is_nobody(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionRefused, NotADirectory, NotFound};
    matches!(error.kind(), ConnectionRefused | NotFound | NotADirectory)
}

/// The token, or user and password, in the form of the header.
fn authorization(file: &Path) -> Result<String, ClientError> {
    let text = std::fs::read_to_string(file).map_err(|error| {
        let shown = file.display();
        ClientError::File(format!(
            "cannot read the token: {error}; {shown}; check the path and its permissions"
        ))
    })?;
    let text = text.trim();
    Ok(if text.contains(':') {
        basic_authorization(text)
    } else {
        format!("Bearer {text}")
    })
}

impl Network {
    async fn connect(&self) -> Result<Box<dyn Stream>, NotConnected> {
        let socket = TcpStream::connect((self.url.host.as_str(), self.url.port))
            .await
            .map_err(|error| NotConnected::Because(error.to_string()))?;
        Ok(if self.url.tls {
            Box::new(self.with_tls(socket).await.map_err(NotConnected::Final)?)
        } else {
            Box::new(socket)
        })
    }

    async fn with_tls(&self, socket: TcpStream) -> Result<TlsStream<TcpStream>, ClientError> {
        let config = tls::client(self.ca.as_deref(), None).map_err(ClientError::File)?;
        let failed = |why: String| {
            let (what, remedy) = why.split_once("; ").unwrap_or((&why, NO_TLS));
            ClientError::Tls(format!("{what}; {}; {remedy}", self.url))
        };
        let name = ServerName::try_from(self.url.host.clone()).map_err(|error| failed(error.to_string()))?;
        let handshake = TlsConnector::from(config).connect(name, socket);
        handshake
            .await
            .map_err(|error| failed(tls::in_words(&error, tls::GATEWAY)))
    }
}
