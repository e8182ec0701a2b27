//! A client of a running gateway's HTTP server, for commands that show its state.

mod gateway;

use std::collections::VecDeque;
use std::fmt;
use std::future::poll_fn;
use std::pin::Pin;
use std::str::FromStr;
use std::time::Duration;

use hyper::body::{Body as _, Bytes, Incoming};
use hyper::client::conn::http1::{self, Connection};
use hyper::{Request, Response, StatusCode, Uri, header};
use hyper_util::rt::TokioIo;
use serde::Deserialize;
use tokio::time::timeout;

pub(super) use self::gateway::Gateway;
use self::gateway::Stream;

/// Time for the connection and the head of the reply.
const OPEN_TIMEOUT: Duration = Duration::from_secs(10);
/// A stream that is silent for this long is dead: the gateway sends a comment every 10 s.
const SILENCE: Duration = Duration::from_secs(35);
/// Longest reply that is not a stream, longest line of a stream.
const MOST_BYTES: usize = 1 << 20;
/// Largest document: some thousand drives with all their points.
const MOST_DOCUMENT: usize = 1 << 26;

/// Address of a gateway's HTTP server: `http://host:port`, with a path behind a proxy that adds one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Url {
    tls: bool,
    /// An IPv6 address without its brackets.
    host: String,
    port: u16,
    authority: String,
    path: String,
}

impl FromStr for Url {
    type Err = String;

    fn from_str(text: &str) -> Result<Url, String> {
        let form = "write it as http://127.0.0.1:9488";
        let uri: Uri = text.parse().map_err(|why| format!("{why}; {form}"))?;
        let tls = match uri.scheme_str() {
            Some("http") => false,
            Some("https") => true,
            _ => return Err(format!("http:// is missing; {form}")),
        };
        let authority = uri.authority().map(ToString::to_string).unwrap_or_default();
        if authority.contains('@') || uri.query().is_some() {
            return Err(format!("user, password and query are not supported; {form}"));
        }
        let host = uri.host().unwrap_or_default();
        Ok(Url {
            tls,
            host: host.trim_start_matches('[').trim_end_matches(']').to_string(),
            port: uri.port_u16().unwrap_or(if tls { 443 } else { 80 }),
            authority,
            path: uri.path().trim_end_matches('/').to_string(),
        })
    }
}

impl fmt::Display for Url {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let scheme = if self.tls { "https" } else { "http" };
        write!(f, "{scheme}://{}{}", self.authority, self.path)
    }
}

/// Why a gateway sent nothing; the messages say what, where and what to do.
#[derive(Debug, thiserror::Error)]
pub(super) enum ClientError {
    /// Nothing listens there, or the connection is blocked.
    #[error(
        "cannot reach the gateway: {1}; {0}; start it with an [http] section, or pass its `listen` address with --url"
    )]
    Unreachable(Url, String),
    /// A file of the command line cannot be used.
    #[error("{0}")]
    File(String),
    /// The TLS handshake failed.
    #[error("no TLS connection: {0}")]
    Tls(String),
    /// The gateway refused, with a reason.
    #[error("{error}; {url}; {remedy}")]
    Refused {
        /// The gateway.
        url: Box<Url>,
        /// Its message.
        error: String,
        /// What to do.
        remedy: String,
    },
    /// The reply is not that of a gateway.
    #[error("{1}; {0}; check that this is the address of drivegate's [http] section")]
    Strange(Url, String),
    /// The stream ended early.
    #[error(
        "the gateway ended the stream{1}; {0}; it was stopped, or a reload removed the bus: start it and try again"
    )]
    Ended(Url, String),
    /// Nothing was received for too long.
    #[error("the gateway stopped responding; {0}; check the gateway and the network, then try again")]
    Silent(Url),
}

/// The body of an error reply.
#[derive(Debug, Deserialize)]
struct Problem {
    error: String,
    #[serde(default)]
    known: Vec<String>,
}

/// An event of a stream.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct StreamEvent {
    /// Its name; empty for an ordinary one.
    pub(super) name: String,
    /// Its text.
    pub(super) data: String,
}

/// A stream of server-sent events.
#[derive(Debug)]
pub(super) struct EventStream {
    url: Url,
    wire: Wire,
    body: Incoming,
    parser: Parser,
}

impl EventStream {
    /// Requests a stream; `path` begins with a slash.
    ///
    /// # Errors
    /// When the gateway cannot be reached, refuses, or is not a gateway.
    pub(super) async fn open(gateway: &Gateway, path: &str) -> Result<EventStream, ClientError> {
        let url = &gateway.url;
        let late = || ClientError::Unreachable(url.clone(), "no reply within 10 s".to_string());
        let (wire, response) = timeout(OPEN_TIMEOUT, ask(gateway, path)).await.map_err(|_| late())??;
        let kind = response.headers().get(header::CONTENT_TYPE);
        let is_stream = kind.is_some_and(|kind| kind.as_bytes().starts_with(b"text/event-stream"));
        let status = response.status();
        let stream = EventStream {
            url: url.clone(),
            wire,
            body: response.into_body(),
            parser: Parser::default(),
        };
        if status == StatusCode::OK && is_stream {
            return Ok(stream);
        }
        Err(timeout(OPEN_TIMEOUT, stream.refusal(status))
            .await
            .map_err(|_| late())?)
    }

    /// The next event. Cancel safe.
    ///
    /// # Errors
    /// When the stream is over.
    pub(super) async fn next(&mut self) -> Result<StreamEvent, ClientError> {
        loop {
            if let Some(event) = self.parser.take() {
                return Ok(event);
            }
            let Ok(chunk) = timeout(SILENCE, self.chunk()).await else {
                return Err(ClientError::Silent(self.url.clone()));
            };
            let bytes = match chunk {
                Some(Ok(bytes)) => bytes,
                Some(Err(error)) => return Err(ClientError::Ended(self.url.clone(), format!(" ({error})"))),
                None => return Err(ClientError::Ended(self.url.clone(), String::new())),
            };
            self.parser
                .feed(&bytes)
                .map_err(|why| ClientError::Strange(self.url.clone(), why))?;
        }
    }

    async fn chunk(&mut self) -> Option<hyper::Result<Bytes>> {
        loop {
            let frame = self
                .wire
                .with(poll_fn(|cx| Pin::new(&mut self.body).poll_frame(cx)))
                .await?;
            match frame.map(hyper::body::Frame::into_data) {
                Ok(Ok(bytes)) => return Some(Ok(bytes)),
                // Trailers.
                Ok(Err(_)) => {}
                Err(error) => return Some(Err(error)),
            }
        }
    }

    /// The error in a reply that is not a stream.
    async fn refusal(mut self, status: StatusCode) -> ClientError {
        let mut text = Vec::new();
        while let Some(Ok(bytes)) = self.chunk().await {
            text.extend_from_slice(&bytes);
            if text.len() > MOST_BYTES {
                break;
            }
        }
        let url = self.url;
        match serde_json::from_slice::<Problem>(&text) {
            Ok(Problem { error, known }) => ClientError::Refused {
                remedy: match known.as_slice() {
                    [] if status == StatusCode::UNAUTHORIZED || status == StatusCode::FORBIDDEN => {
                        "pass a token with scope `read` with --token-file".to_string()
                    }
                    [] if status == StatusCode::MISDIRECTED_REQUEST => "reload the gateway after that".to_string(),
                    [] => "try again later".to_string(),
                    known => format!("known: {}", known.join(", ")),
                },
                url: Box::new(url),
                error,
            },
            Err(_) => ClientError::Strange(url, format!("the server answered `{status}` without a stream")),
        }
    }
}

/// Requests a document; `path` begins with a slash.
///
/// # Errors
/// When the gateway cannot be reached, refuses, or is not a gateway.
pub(super) async fn get_json(gateway: &Gateway, path: &str) -> Result<serde_json::Value, ClientError> {
    let url = &gateway.url;
    let late = || ClientError::Unreachable(url.clone(), "no reply within 10 s".to_string());
    let whole = async {
        let (wire, response) = ask(gateway, path).await?;
        let status = response.status();
        let mut stream = EventStream {
            url: url.clone(),
            wire,
            body: response.into_body(),
            parser: Parser::default(),
        };
        if status != StatusCode::OK {
            return Err(stream.refusal(status).await);
        }
        let mut text = Vec::new();
        while let Some(chunk) = stream.chunk().await {
            let chunk = chunk.map_err(|error| ClientError::Ended(url.clone(), format!(" ({error})")))?;
            text.extend_from_slice(&chunk);
            if text.len() > MOST_DOCUMENT {
                return Err(ClientError::Strange(url.clone(), "the reply is too long".to_string()));
            }
        }
        serde_json::from_slice(&text)
            .map_err(|error| ClientError::Strange(url.clone(), format!("the reply is not JSON ({error})")))
    };
    timeout(OPEN_TIMEOUT, whole).await.map_err(|_| late())?
}

/// Requests a short text, such as that of `/readyz`, and whether its status is 200.
///
/// # Errors
/// When the gateway cannot be reached, or the server is another one.
pub(super) async fn get_text(gateway: &Gateway, path: &str) -> Result<(bool, String), ClientError> {
    let url = &gateway.url;
    let late = || ClientError::Unreachable(url.clone(), "no reply within 10 s".to_string());
    let whole = async {
        let (wire, response) = ask(gateway, path).await?;
        let status = response.status();
        if !matches!(status, StatusCode::OK | StatusCode::SERVICE_UNAVAILABLE) {
            let why = format!("the server answered `{status}`");
            return Err(ClientError::Strange(url.clone(), why));
        }
        let mut stream = EventStream {
            url: url.clone(),
            wire,
            body: response.into_body(),
            parser: Parser::default(),
        };
        let mut text = Vec::new();
        while let Some(chunk) = stream.chunk().await {
            let chunk = chunk.map_err(|error| ClientError::Ended(url.clone(), format!(" ({error})")))?;
            text.extend_from_slice(&chunk);
            if text.len() > MOST_BYTES {
                return Err(ClientError::Strange(url.clone(), "the reply is too long".to_string()));
            }
        }
        Ok((status == StatusCode::OK, String::from_utf8_lossy(&text).into_owned()))
    };
    timeout(OPEN_TIMEOUT, whole).await.map_err(|_| late())?
}

async fn ask(gateway: &Gateway, path: &str) -> Result<(Wire, Response<Incoming>), ClientError> {
    let url = &gateway.url;
    let unreachable = |why: String| ClientError::Unreachable(url.clone(), why);
    let token = gateway.token()?;
    let stream = gateway.connect().await?;
    let strange = |error: hyper::Error| ClientError::Strange(url.clone(), format!("not an HTTP reply ({error})"));
    let (mut sender, connection) = http1::handshake(TokioIo::new(stream)).await.map_err(strange)?;
    let mut wire = Wire(Some(Box::pin(connection)));
    let mut request = Request::get(format!("{}{path}", url.path))
        .header(header::HOST, &url.authority)
        .header(header::ACCEPT, "text/event-stream, application/json");
    if let Some(token) = token {
        request = request.header(header::AUTHORIZATION, format!("Bearer {token}"));
    }
    let request = request
        .body(String::new())
        .map_err(|error| unreachable(error.to_string()))?;
    let response = wire.with(sender.send_request(request)).await.map_err(strange)?;
    Ok((wire, response))
}

/// The connection, which is polled only while a reply or event is awaited.
struct Wire(Option<Pin<Box<Connected>>>);

type Connected = Connection<TokioIo<Box<dyn Stream>>, String>;

impl fmt::Debug for Wire {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Wire")
    }
}

impl Wire {
    async fn with<T>(&mut self, wanted: impl Future<Output = T>) -> T {
        let mut wanted = std::pin::pin!(wanted);
        poll_fn(|cx| {
            // How the connection ended shows in the result of the awaited future.
            if self.0.as_mut().is_some_and(|wire| wire.as_mut().poll(cx).is_ready()) {
                self.0 = None;
            }
            wanted.as_mut().poll(cx)
        })
        .await
    }
}

/// Parses the bytes of a stream into events.
#[derive(Debug, Default)]
struct Parser {
    line: Vec<u8>,
    name: String,
    data: String,
    ready: VecDeque<StreamEvent>,
}

impl Parser {
    fn feed(&mut self, bytes: &[u8]) -> Result<(), String> {
        for &byte in bytes {
            if byte == b'\n' {
                let line = std::mem::take(&mut self.line);
                self.take_line(String::from_utf8_lossy(&line).trim_end_matches('\r'));
            } else {
                self.line.push(byte);
            }
            if self.line.len() + self.data.len() > MOST_BYTES {
                return Err("an event is too long".to_string());
            }
        }
        Ok(())
    }

    fn take_line(&mut self, line: &str) {
        if line.is_empty() {
            let (name, data) = (std::mem::take(&mut self.name), std::mem::take(&mut self.data));
            if !data.is_empty() {
                self.ready.push_back(StreamEvent { name, data });
            }
            return;
        }
        // A line that begins with a colon is a comment: a field without a name.
        let (field, value) = line.split_once(':').unwrap_or((line, ""));
        let value = value.strip_prefix(' ').unwrap_or(value);
        match field {
            "event" => self.name = value.to_string(),
            "data" => {
                if !self.data.is_empty() {
                    self.data.push('\n');
                }
                self.data.push_str(value);
            }
            _ => {}
        }
    }

    fn take(&mut self) -> Option<StreamEvent> {
        self.ready.pop_front()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn urls() {
        let url: Url = "http://127.0.0.1:9488".parse().unwrap();
        assert_eq!(
            (url.host.as_str(), url.port, url.path.as_str()),
            ("127.0.0.1", 9488, "")
        );
        let url: Url = "http://[::1]/plant/".parse().unwrap();
        assert_eq!((url.host.as_str(), url.port, url.path.as_str()), ("::1", 80, "/plant"));
        assert_eq!(url.to_string(), "http://[::1]/plant");
        let url: Url = "https://gateway.example".parse().unwrap();
        assert_eq!((url.tls, url.host.as_str(), url.port), (true, "gateway.example", 443));
        assert_eq!(url.to_string(), "https://gateway.example");
        for (bad, why) in [
            ("127.0.0.1:9488", "http:// is missing"),
            ("gateway", "http:// is missing"),
            ("http://me:secret@gateway", "not supported"),
            ("http://gateway/?a=b", "not supported"),
            ("http://", "write it as"),
            ("", "write it as"),
        ] {
            let error = bad.parse::<Url>().unwrap_err();
            assert!(error.contains(why), "{bad}: {error}");
        }
    }

    #[test]
    fn events_in_any_pieces() {
        let text = b"retry: 2000\r\n: open\n\ndata: {\"a\":1}\n\n: alive\n\nevent: lagged\ndata:{\"lost\":3}\ndata: x\n\ndata: cut";
        let all = [
            StreamEvent {
                name: String::new(),
                data: "{\"a\":1}".to_string(),
            },
            StreamEvent {
                name: "lagged".to_string(),
                data: "{\"lost\":3}\nx".to_string(),
            },
        ];
        for size in 1..=text.len() {
            let mut parser = Parser::default();
            for piece in text.chunks(size) {
                parser.feed(piece).unwrap();
            }
            let taken: Vec<StreamEvent> = std::iter::from_fn(|| parser.take()).collect();
            assert_eq!(taken, all, "pieces of {size}");
        }
    }

    #[test]
    fn an_event_without_end_is_refused() {
        let mut parser = Parser::default();
        let piece = [b'x'; 4096];
        assert!((0..300).any(|_| parser.feed(&piece).is_err()));
    }
}
