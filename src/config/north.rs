//! `[http]`, and what all listeners share.

use std::net::SocketAddr;
use std::path::Path;
use std::time::SystemTime;

use super::keys::HTTP;
use super::{files, values};
use crate::document::{Finding, Place, Reader};
use crate::north::http::{self, Tokens};
use crate::north::{ServerIdentity, TlsFile};

/// An address that a server listens on, and its place.
pub(super) type Listener = (SocketAddr, Place);

pub(super) fn read_http(reader: &Reader<'_>, base: &Path) -> (Option<http::Options>, Option<Listener>) {
    let listen = HTTP.listen.read(reader);
    let hosts = HTTP.hosts.get(reader);
    let tokens = read_tokens(reader, base);
    let identity = read_identity(reader, base);
    reader.finish();
    if let Some(listen) = listen {
        warn_of_reach(reader, listen);
    }
    // Both are reported if they are there and cannot be used.
    let usable = (tokens.is_some() || !reader.has(HTTP.tokens_file.name))
        && (identity.is_some() || !reader.has(HTTP.certificate.name));
    let options = listen.filter(|_| usable).map(|listen| http::Options {
        listen,
        hosts,
        tokens,
        identity,
        max_connections: http::MAX_CONNECTIONS,
    });
    (options, listen.map(|listen| (listen, HTTP.listen.place(reader))))
}

pub(super) fn parse_host(text: &str) -> Result<String, Finding> {
    match http::is_host(text) {
        true => Ok(text.to_string()),
        false => Err(Finding::new(
            format!("`{text}` is not a host name or an address"),
            "write it without scheme and port, such as \"gateway.example.com\"",
        )),
    }
}

fn read_tokens(reader: &Reader<'_>, base: &Path) -> Option<Tokens> {
    let key = &HTTP.tokens_file;
    let path = values::resolved(base, key.read(reader)?);
    let text = std::fs::read_to_string(&path).map_err(|error| files::cannot_read(&path, &error));
    let text = reader.accept(key.name, text)?;
    match Tokens::parse(&text) {
        Ok(tokens) => {
            if tokens.list().is_empty() {
                let what = format!("{} contains no token, so nobody is answered", path.display());
                reader.warning(key.name, what, "add one with `drivegate token add`");
            }
            Some(tokens)
        }
        Err((line, error)) => {
            let remedy = "remove the line, and make another with `drivegate token add`";
            reader.problem(key.name, format!("{}:{line}: {error}", path.display()), remedy);
            None
        }
    }
}

fn read_identity(reader: &Reader<'_>, base: &Path) -> Option<ServerIdentity> {
    let [certificate, key] = [&HTTP.certificate, &HTTP.key].map(|key| Some(values::resolved(base, key.read(reader)?)));
    let names = [HTTP.certificate.name, HTTP.key.name];
    values::both_or_none(reader, names);
    let (certificate, key) = (certificate?, key?);
    files::warn_of_readers(reader, HTTP.key.name, &key);
    let loaded = ServerIdentity::load(&certificate, &key, SystemTime::now());
    files::reported(reader, loaded, |file| match file {
        TlsFile::Key => HTTP.key.name,
        _ => HTTP.certificate.name,
    })
}

/// Warns of what the network can read.
fn warn_of_reach(reader: &Reader<'_>, listen: SocketAddr) {
    if listen.ip().is_loopback() {
        return;
    }
    if !reader.has(HTTP.tokens_file.name) {
        reader.warning(
            HTTP.listen.name,
            format!("{listen} can be reached from the network, and everybody who connects may read all data"),
            "set tokens_file, or listen on 127.0.0.1 behind a reverse proxy that asks for a login",
        );
    } else if !reader.has(HTTP.certificate.name) {
        reader.warning(
            HTTP.listen.name,
            format!("{listen} can be reached from the network without TLS, so tokens are sent in clear text"),
            "set certificate and key",
        );
    }
}
