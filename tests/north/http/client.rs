//! A plain HTTP client.

use std::net::SocketAddr;

use serde_json::Value;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader, Lines};
use tokio::net::TcpStream;
use tokio::time::timeout;

pub(crate) use crate::support::process::PATIENCE;

/// A complete HTTP reply.
#[derive(Debug)]
pub(crate) struct Reply {
    pub(crate) status: u16,
    pub(crate) head: String,
    pub(crate) body: String,
}

impl Reply {
    /// The header of that name, which must be written in lower case.
    pub(crate) fn header(&self, name: &str) -> Option<&str> {
        self.head.lines().find_map(|line| {
            let (key, value) = line.split_once(':')?;
            key.eq_ignore_ascii_case(name).then(|| value.trim())
        })
    }

    pub(crate) fn json(&self) -> Value {
        assert_eq!(self.header("content-type"), Some("application/json"), "{}", self.body);
        serde_json::from_str(&self.body).expect("JSON")
    }
}

impl Reply {
    /// Parses a reply from its text.
    fn parse(text: &str) -> Reply {
        let (head, body) = text.split_once("\r\n\r\n").expect("a head");
        let status = head.split(' ').nth(1).and_then(|s| s.parse().ok()).expect("a status");
        let chunked = head.to_ascii_lowercase().contains("transfer-encoding: chunked");
        let body = if chunked { unchunked(body) } else { body.to_string() };
        Reply {
            status,
            head: head.to_string(),
            body,
        }
    }
}

/// Sends one request on a separate connection and reads to its end.
pub(crate) async fn request(address: SocketAddr, method: &str, path: &str, headers: &str) -> Reply {
    let head = format!("{method} {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n{headers}\r\n");
    raw(address, &head).await
}

pub(crate) async fn raw(address: SocketAddr, request: &str) -> Reply {
    let exchange = async {
        let mut stream = TcpStream::connect(address).await.expect("a connection");
        stream.write_all(request.as_bytes()).await.expect("sent");
        let mut bytes = Vec::new();
        stream.read_to_end(&mut bytes).await.expect("a reply");
        String::from_utf8(bytes).expect("text")
    };
    let text = timeout(PATIENCE, exchange).await.expect("a reply in time");
    Reply::parse(&text)
}

fn unchunked(mut body: &str) -> String {
    let mut whole = String::new();
    while let Some((size, rest)) = body.split_once("\r\n") {
        let size = usize::from_str_radix(size, 16).expect("a chunk size");
        whole += &rest[..size];
        body = rest[size..].trim_start_matches("\r\n");
        if size == 0 {
            break;
        }
    }
    whole
}

/// Sends a POST with a body on a separate connection and reads to its end.
pub(crate) async fn post(address: SocketAddr, path: &str, headers: &str, body: &str) -> Reply {
    let length = body.len();
    let head = format!(
        "POST {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n{headers}Content-Length: {length}\r\n\r\n"
    );
    raw(address, &(head + body)).await
}

pub(crate) async fn get(address: SocketAddr, path: &str) -> Reply {
    request(address, "GET", path, "").await
}

/// An event stream that stays open.
pub(crate) struct EventStream {
    lines: Lines<BufReader<TcpStream>>,
    pub(crate) head: String,
}

/// A message of the event stream.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct Message {
    pub(crate) event: String,
    pub(crate) id: String,
    pub(crate) data: String,
}

impl Message {
    pub(crate) fn json(&self) -> Value {
        serde_json::from_str(&self.data).expect("JSON")
    }
}

impl EventStream {
    pub(crate) async fn open(address: SocketAddr, path: &str, headers: &str) -> EventStream {
        let mut stream = TcpStream::connect(address).await.expect("a connection");
        // HTTP/1.0 keeps chunk sizes out of the lines.
        let request = format!("GET {path} HTTP/1.0\r\nHost: localhost\r\n{headers}\r\n");
        stream.write_all(request.as_bytes()).await.expect("sent");
        let mut lines = BufReader::new(stream).lines();
        let mut head = String::new();
        while let Some(line) = next_line(&mut lines).await.filter(|line| !line.is_empty()) {
            head += &line;
            head += "\n";
        }
        EventStream { lines, head }
    }

    /// The next event with data; comments are skipped. `None` at the end of the stream.
    pub(crate) async fn next(&mut self) -> Option<Message> {
        let mut message = Message::default();
        loop {
            let line = next_line(&mut self.lines).await?;
            match line.split_once(':') {
                Some(("event", value)) => message.event = value.trim().to_string(),
                Some(("id", value)) => message.id = value.trim().to_string(),
                Some(("data", value)) => message.data += value.trim(),
                _ if line.is_empty() && !message.data.is_empty() => return Some(message),
                _ => {}
            }
        }
    }

    /// Waits for the comment that every stream begins with: the server listens from then on.
    pub(crate) async fn opened(mut self) -> EventStream {
        while let Some(line) = next_line(&mut self.lines).await {
            if line.starts_with(':') {
                return self;
            }
        }
        panic!("the stream ended:\n{}", self.head);
    }
}

async fn next_line(lines: &mut Lines<BufReader<TcpStream>>) -> Option<String> {
    timeout(PATIENCE, lines.next_line())
        .await
        .expect("a line in time")
        .ok()
        .flatten()
}
