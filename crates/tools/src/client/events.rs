//! A client's stream of server-sent events.

use std::collections::VecDeque;
use std::time::Duration;

use hyper::{StatusCode, header};
use tokio::time::timeout;

use super::exchange::Opened;
use super::{Client, ClientError, GatewayRequest};

/// A stream that is silent for this long is dead: the gateway sends a comment every 10 s.
const SILENCE: Duration = Duration::from_secs(35);
/// Longest line of an event stream.
const MOST_BYTES: usize = 1 << 20;

/// An event of the stream.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct StreamEvent {
    /// Name of the event; empty for an ordinary one.
    pub(crate) name: String,
    /// Text of the event.
    pub(crate) data: String,
}

/// A stream of server-sent events.
#[derive(Debug)]
pub(crate) struct EventStream {
    opened: Opened,
    parser: Parser,
}

impl EventStream {
    /// Requests a stream; `path` begins with a slash.
    ///
    /// # Errors
    /// When the gateway cannot be reached, refuses, or is not a gateway.
    pub(crate) async fn open(client: &Client, path: &str) -> Result<EventStream, ClientError> {
        let asked = GatewayRequest::view(path);
        let opened = client.open(&asked).await?;
        let kind = opened.headers.get(header::CONTENT_TYPE);
        let is_stream = kind.is_some_and(|kind| kind.as_bytes().starts_with(b"text/event-stream"));
        if opened.status == StatusCode::OK && is_stream {
            let parser = Parser::default();
            return Ok(EventStream { opened, parser });
        }
        let reply = opened.whole(&asked).await?;
        Err(match reply.status {
            StatusCode::OK => reply.strange("the server answered `200 OK` without a stream".to_string()),
            _ => reply.refusal(&asked),
        })
    }

    /// Waits for the next event. Cancel safe.
    ///
    /// # Errors
    /// If the event stream has ended.
    pub(crate) async fn next(&mut self) -> Result<StreamEvent, ClientError> {
        loop {
            if let Some(event) = self.parser.take() {
                return Ok(event);
            }
            let place = self.opened.place.clone();
            let Ok(chunk) = timeout(SILENCE, self.opened.chunk()).await else {
                return Err(ClientError::Silent(place));
            };
            let bytes = match chunk {
                Some(Ok(bytes)) => bytes,
                Some(Err(error)) => return Err(ClientError::Ended(place, format!(" ({error})"))),
                None => return Err(ClientError::Ended(place, String::new())),
            };
            self.parser
                .feed(&bytes)
                .map_err(|why| ClientError::Strange(place, why))?;
        }
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
