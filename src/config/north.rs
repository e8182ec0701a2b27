//! `[http]`, and what all listeners share.

use std::net::SocketAddr;

use super::keys::HTTP;
use crate::document::{Place, Reader};
use crate::north::http;

/// An address that a server listens on, and its place.
pub(super) type Listener = (SocketAddr, Place);

pub(super) fn read_http(reader: &Reader<'_>) -> (Option<http::Options>, Option<Listener>) {
    let listen = HTTP.listen.read(reader);
    reader.finish();
    (
        listen.map(|listen| http::Options {
            listen,
            max_connections: http::MAX_CONNECTIONS,
        }),
        listen.map(|listen| (listen, HTTP.listen.place(reader))),
    )
}
