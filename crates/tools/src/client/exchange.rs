//! A request to the gateway and its reply.

use std::borrow::Cow;
use std::fmt;
use std::future::poll_fn;
use std::pin::Pin;
use std::time::Duration;

use hyper::body::{Body as _, Bytes, Incoming};
use hyper::client::conn::http1::{self, Connection};
use hyper::header::HeaderMap;
use hyper::{Method, Request, StatusCode, header};
use hyper_util::rt::TokioIo;
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::time::timeout;

use super::ClientError;
use super::door::{Door, Stream};
use drivegate_http::messages::{EXPECT, ErrorReply, Expected};

/// Largest reply, bytes: enough for some thousand drives with all their points.
const MOST_DOCUMENT: usize = 1 << 26;
/// Time limit for the reply to a request that only shows present values.
const SHOWN_WITHIN: Duration = Duration::from_secs(10);
/// Time limit for any other reply: a command may wait for its turn and its confirmation, a read for a slow line, a
/// reload for its files.
const DONE_WITHIN: Duration = Duration::from_secs(40);

/// A request to a gateway.
#[derive(Debug, Clone)]
pub(crate) struct GatewayRequest {
    method: Method,
    /// Path of the request, beginning with a slash.
    path: String,
    body: String,
    pub(super) within: Duration,
    /// The remedy if the reply is lost.
    lost: Cow<'static, str>,
    /// Remedy if the request is refused, unless the status already gives one.
    refused: Cow<'static, str>,
}

impl GatewayRequest {
    /// A GET of values that the gateway already has: it is answered at once, so the time limit is short.
    pub(crate) fn view(path: impl Into<String>) -> GatewayRequest {
        GatewayRequest {
            within: SHOWN_WITHIN,
            ..GatewayRequest::get(path)
        }
    }

    pub(crate) fn get(path: impl Into<String>) -> GatewayRequest {
        GatewayRequest {
            method: Method::GET,
            path: path.into(),
            body: String::new(),
            within: DONE_WITHIN,
            lost: "try again".into(),
            refused: "".into(),
        }
    }

    pub(crate) fn post(path: impl Into<String>, body: &impl Serialize) -> GatewayRequest {
        GatewayRequest {
            method: Method::POST,
            // Strings, figures and JSON: this cannot fail.
            body: serde_json::to_string(body).unwrap_or_default(),
            ..GatewayRequest::get(path)
        }
    }

    pub(crate) fn delete(path: impl Into<String>) -> GatewayRequest {
        GatewayRequest {
            method: Method::DELETE,
            ..GatewayRequest::get(path)
        }
    }

    /// The remedy if the reply is lost.
    pub(crate) fn if_lost(self, lost: impl Into<Cow<'static, str>>) -> GatewayRequest {
        GatewayRequest {
            lost: lost.into(),
            ..self
        }
    }

    /// Sets the remedy if the request is refused, unless the status already gives one.
    pub(crate) fn if_refused(self, refused: impl Into<Cow<'static, str>>) -> GatewayRequest {
        GatewayRequest {
            refused: refused.into(),
            ..self
        }
    }

    /// Whether the request may be sent again without doing anything twice.
    pub(super) fn only_reads(&self) -> bool {
        self.method == Method::GET
    }
}

/// A reply whose head was received.
pub(super) struct Opened {
    pub(super) status: StatusCode,
    pub(super) headers: HeaderMap,
    /// Where the reply comes from, for messages.
    pub(super) place: String,
    over_network: bool,
    body: Incoming,
    wire: Wire,
}

impl fmt::Debug for Opened {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Opened({} {})", self.place, self.status)
    }
}

impl Opened {
    /// Sends a request over a connection, and waits for the head of its reply.
    ///
    /// # Errors
    /// If the connection reports an error.
    pub(super) async fn send(
        stream: Box<dyn Stream>,
        door: &Door,
        authorization: Option<&str>,
        expected: Option<&Expected>,
        asked: &GatewayRequest,
    ) -> hyper::Result<Opened> {
        let (mut sender, connection) = http1::handshake(TokioIo::new(stream)).await?;
        let mut wire = Wire(Some(Box::pin(connection)));
        let (prefix, authority) = door.base();
        let mut request = Request::new(asked.body.clone());
        *request.method_mut() = asked.method.clone();
        // All parts of the path were validated or percent-encoded before.
        *request.uri_mut() = format!("{prefix}{}", asked.path).parse().unwrap_or_default();
        let headers = request.headers_mut();
        let expected = expected.map(|expected| {
            let text = serde_json::to_string(expected).unwrap_or_default();
            percent_encoding::utf8_percent_encode(&text, percent_encoding::NON_ALPHANUMERIC).to_string()
        });
        let fields = [
            (header::HOST, Some(authority)),
            (header::ACCEPT, Some("text/event-stream, application/json")),
            (header::AUTHORIZATION, authorization),
            (header::HeaderName::from_static(EXPECT), expected.as_deref()),
        ];
        for (name, value) in fields {
            if let Some(Ok(value)) = value.map(header::HeaderValue::from_str) {
                headers.insert(name, value);
            }
        }
        let (head, body) = wire.with(sender.send_request(request)).await?.into_parts();
        Ok(Opened {
            status: head.status,
            headers: head.headers,
            place: door.to_string(),
            over_network: door.is_network(),
            body,
            wire,
        })
    }

    /// The next piece of the reply's body.
    pub(super) async fn chunk(&mut self) -> Option<hyper::Result<Bytes>> {
        loop {
            let frame = self
                .wire
                .with(poll_fn(|cx| Pin::new(&mut self.body).poll_frame(cx)))
                .await?;
            match frame.map(hyper::body::Frame::into_data) {
                Ok(Ok(bytes)) => return Some(Ok(bytes)),
                // HTTP trailers are ignored.
                Ok(Err(_)) => {}
                Err(error) => return Some(Err(error)),
            }
        }
    }

    /// Reads the body of the reply and returns the whole reply.
    ///
    /// # Errors
    /// If the reply does not arrive completely.
    pub(super) async fn whole(mut self, asked: &GatewayRequest) -> Result<Reply, ClientError> {
        let place = self.place.clone();
        let whole = async {
            let mut text = Vec::new();
            while let Some(chunk) = self.chunk().await {
                text.extend_from_slice(&chunk.map_err(|error| asked.lost(&place, &error.to_string()))?);
                if text.len() > MOST_DOCUMENT {
                    return Err(ClientError::Strange(place.clone(), "the reply is too long".to_string()));
                }
            }
            Ok(text)
        };
        let text = match timeout(asked.within, whole).await {
            Ok(text) => text?,
            Err(_) => return Err(asked.late(&place)),
        };
        Ok(Reply {
            status: self.status,
            text,
            place: self.place,
            over_network: self.over_network,
        })
    }
}

impl GatewayRequest {
    pub(super) fn late(&self, place: &str) -> ClientError {
        self.lost(place, &format!("no reply within {} s", self.within.as_secs()))
    }

    pub(super) fn lost(&self, place: &str, why: &str) -> ClientError {
        ClientError::Lost(format!("the gateway did not reply: {why}; {place}; {}", self.lost))
    }
}

/// A complete reply.
#[derive(Debug)]
pub(crate) struct Reply {
    pub(crate) status: StatusCode,
    text: Vec<u8>,
    place: String,
    over_network: bool,
}

impl Reply {
    /// The document of a reply that is not a refusal.
    ///
    /// # Errors
    /// If the gateway refuses the request, or the server is not a gateway.
    pub(crate) fn accepted<T: DeserializeOwned>(self, asked: &GatewayRequest) -> Result<T, ClientError> {
        if self.status.is_success() {
            self.document()
        } else {
            Err(self.refusal(asked))
        }
    }

    /// The document of a reply with any status; `None` if its body is of another type.
    pub(crate) fn parsed<T: DeserializeOwned>(&self) -> Option<T> {
        serde_json::from_slice(&self.text).ok()
    }

    /// The document of a reply of any status.
    ///
    /// # Errors
    /// If the reply is not such a document.
    pub(crate) fn document<T: DeserializeOwned>(self) -> Result<T, ClientError> {
        serde_json::from_slice(&self.text).map_err(|error| self.strange(format!("unexpected reply ({error})")))
    }

    /// The body of a reply of any status.
    pub(crate) fn bytes(&self) -> &[u8] {
        &self.text
    }

    /// The text of a reply of any status.
    pub(crate) fn text(&self) -> String {
        String::from_utf8_lossy(&self.text).into_owned()
    }

    pub(crate) fn strange(&self, why: String) -> ClientError {
        if self.over_network {
            ClientError::Strange(self.place.clone(), why)
        } else {
            ClientError::Refused(format!("{why}; {}; restart the gateway", self.place))
        }
    }

    /// The error that a reply reports.
    pub(crate) fn refusal(&self, asked: &GatewayRequest) -> ClientError {
        let Some(ErrorReply { error, known }) = self.parsed() else {
            return match self.status {
                StatusCode::METHOD_NOT_ALLOWED if !asked.only_reads() => ClientError::Refused(format!(
                    "the gateway accepts no commands over HTTP; {}; set commands = true in its [http] section",
                    self.place
                )),
                StatusCode::SERVICE_UNAVAILABLE => {
                    ClientError::Refused(format!("the gateway is busy; {}; try again", self.place))
                }
                status => self.strange(format!("the server answered `{status}`")),
            };
        };
        let remedy = match self.status {
            _ if !known.is_empty() => format!("known: {}", known.join(", ")),
            StatusCode::UNAUTHORIZED if !asked.only_reads() => {
                "pass a file with USER:PASSWORD with --token-file".to_string()
            }
            StatusCode::UNAUTHORIZED | StatusCode::FORBIDDEN if asked.only_reads() => {
                "pass a token with scope `read` with --token-file".to_string()
            }
            StatusCode::MISDIRECTED_REQUEST if self.over_network => "reload the gateway after that".to_string(),
            StatusCode::PRECONDITION_FAILED => {
                "the gateway there runs with another configuration: reload it, or name its file with --config"
                    .to_string()
            }
            StatusCode::NOT_FOUND if !self.over_network => {
                "the gateway there runs with another configuration or version: reload or restart it".to_string()
            }
            StatusCode::SERVICE_UNAVAILABLE => "try again".to_string(),
            _ => asked.refused.to_string(),
        };
        ClientError::Refused(match remedy.as_str() {
            "" => format!("{error}; {}", self.place),
            remedy => format!("{error}; {}; {remedy}", self.place),
        })
    }
}

/// The connection, which is polled only while a reply or event is awaited.
struct Wire(Option<Pin<Box<Connected>>>);

type Connected = Connection<TokioIo<Box<dyn Stream>>, String>;

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
