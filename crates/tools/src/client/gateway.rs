//! Which gateway is asked, and the connection to it.

use std::path::PathBuf;

use rustls_pki_types::ServerName;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;

use super::{ClientError, Url};
use crate::north::{GATEWAY, client_tls, explain};

/// What to do about a handshake that says nothing of its own.
const NO_TLS: &str = "pass the CA of the gateway's certificate with --ca, or use http://";

/// The options that say which gateway is asked, and how.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct Gateway {
    /// The gateway's HTTP server.
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:9488")]
    pub(super) url: Url,
    /// PEM file of the CA that signed the gateway's certificate, for https:// [default: those of the system].
    #[arg(long, value_name = "FILE")]
    ca: Option<PathBuf>,
    /// File whose only line is a token of the gateway, with scope `read`.
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
}

/// A connection, with TLS or without.
pub(super) trait Stream: AsyncRead + AsyncWrite + Unpin + Send {}

impl<S: AsyncRead + AsyncWrite + Unpin + Send> Stream for S {}

impl Gateway {
    /// One without a token.
    pub(crate) fn at(url: Url, ca: Option<PathBuf>) -> Gateway {
        let token_file = None;
        Gateway { url, ca, token_file }
    }

    /// The token to send, if one is configured.
    ///
    /// # Errors
    /// Its file cannot be read.
    pub(super) fn token(&self) -> Result<Option<String>, ClientError> {
        let Some(path) = &self.token_file else { return Ok(None) };
        let text = std::fs::read_to_string(path).map_err(|error| {
            let shown = path.display();
            ClientError::File(format!(
                "cannot read the token: {error}; {shown}; check the path and its permissions"
            ))
        })?;
        Ok(Some(text.trim().to_string()))
    }

    /// Connects.
    ///
    /// # Errors
    /// Nobody listens, or the TLS handshake fails.
    pub(super) async fn connect(&self) -> Result<Box<dyn Stream>, ClientError> {
        let socket = TcpStream::connect((self.url.host.as_str(), self.url.port))
            .await
            .map_err(|error| ClientError::Unreachable(self.url.clone(), error.to_string()))?;
        Ok(match self.url.tls {
            false => Box::new(socket),
            true => Box::new(self.with_tls(socket).await?),
        })
    }

    async fn with_tls(&self, socket: TcpStream) -> Result<TlsStream<TcpStream>, ClientError> {
        let config = client_tls(self.ca.as_deref()).map_err(ClientError::File)?;
        let failed = |why: String| {
            let (what, remedy) = why.split_once("; ").unwrap_or((&why, NO_TLS));
            ClientError::Tls(format!("{what}; {}; {remedy}", self.url))
        };
        let name = ServerName::try_from(self.url.host.clone()).map_err(|error| failed(error.to_string()))?;
        let handshake = TlsConnector::from(config).connect(name, socket);
        handshake
            .await
            .map_err(|error| failed(explain(&error, GATEWAY).unwrap_or_else(|| error.to_string())))
    }
}
