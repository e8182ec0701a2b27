//! `[http]`.

use std::net::SocketAddr;

use super::values;
use crate::document::{Place, Reader};
use crate::north::http;

pub(super) const DEFAULT_HTTP: &str = "127.0.0.1:9488";

/// An address that a server listens on, and where it stands.
pub(super) type Listener = (SocketAddr, Place);

pub(super) fn read_http(reader: &Reader<'_>) -> (Option<http::Options>, Option<Listener>) {
    let listen = match reader.has("listen") {
        true => reader.parsed("listen", values::socket),
        false => values::socket(DEFAULT_HTTP).ok(),
    };
    reader.finish();
    (
        listen.map(|listen| http::Options { listen }),
        listen.map(|listen| (listen, reader.place_of("listen"))),
    )
}
