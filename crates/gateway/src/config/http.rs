//! `[http]`, and settings shared by all listeners.

use std::net::SocketAddr;
use std::path::Path;
use std::time::SystemTime;

use super::keys::HTTP;
use super::{files, values};
use drivegate_http::{Credential, Credentials, Tokens, Users};
use drivegate_model::document::{Finding, Place, Reader};
use drivegate_north::tls::{ServerIdentity, TlsFile};

/// An address on which a server listens, with its place in the file.
pub(super) type Listener = (SocketAddr, Place);

/// The valid settings of `[http]`.
pub(super) struct Http {
    pub(super) options: Option<drivegate_http::Options>,
    pub(super) listener: Option<Listener>,
    /// Whether the configuration asks for commands.
    pub(super) commands: bool,
}

pub(super) fn read_http(reader: &Reader<'_>, base: &Path) -> Http {
    let listen = HTTP.listen.read(reader);
    let hosts = HTTP.hosts.get(reader);
    let tokens = read_tokens(reader, base);
    let users = read_users(reader, base);
    let identity = read_identity(reader, base);
    let commands = HTTP.commands.get(reader);
    reader.finish();
    if let Some(listen) = listen {
        warn_of_reach(reader, listen);
    }
    let users_are_told = users.is_some() || reader.has(HTTP.users_file.name);
    let may_command = !commands || is_safe_to_command(reader, listen, users_are_told);
    // A file that is configured and cannot be used is reported, and the server is then left out.
    let usable = (tokens.is_some() || !reader.has(HTTP.tokens_file.name))
        && (users.is_some() || !reader.has(HTTP.users_file.name))
        && (identity.is_some() || !reader.has(HTTP.certificate.name))
        && may_command;
    let options = listen.filter(|_| usable).map(|listen| drivegate_http::Options {
        listen,
        hosts,
        tokens,
        users: users.filter(|_| commands),
        identity,
        max_connections: drivegate_http::MAX_CONNECTIONS,
    });
    Http {
        options,
        listener: listen.map(|listen| (listen, HTTP.listen.place(reader))),
        commands,
    }
}

fn read_tokens(reader: &Reader<'_>, base: &Path) -> Option<Tokens> {
    let key = &HTTP.tokens_file;
    let path = values::resolved(base, key.read(reader)?);
    credentials(reader, key.name, &path, "every request is refused")
}

fn read_users(reader: &Reader<'_>, base: &Path) -> Option<Users> {
    let key = &HTTP.users_file;
    let path = values::resolved(base, key.read(reader)?);
    files::warn_of_readers(reader, key.name, &path);
    let users = credentials(reader, key.name, &path, "nobody can log in")?;
    if !HTTP.commands.get(reader) {
        let what = "the users are not used while `commands` is off";
        reader.warning(key.name, what, "set commands = true, or remove users_file");
    }
    Some(users)
}

/// Reads a file of tokens or users; `without` describes the effect of an unusable file.
fn credentials<C: Credential>(
    reader: &Reader<'_>,
    key: &'static str,
    path: &Path,
    without: &str,
) -> Option<Credentials<C>> {
    let unread = |error: std::io::Error| {
        let finding = files::cannot_read(path, &error);
        match error.kind() {
            std::io::ErrorKind::NotFound => Finding {
                remedy: format!(
                    "create it with `drivegate {} add --file {} NAME`",
                    C::KIND,
                    path.display()
                ),
                ..finding
            },
            _ => finding,
        }
    };
    let text = std::fs::read_to_string(path).map_err(unread);
    let text = reader.accept(key, text)?;
    let (path, kind) = (path.display(), C::KIND);
    match Credentials::parse(&text) {
        Ok(all) => {
            if all.list().is_empty() {
                let what = format!("{path} contains no {kind}, so {without}");
                reader.warning(key, what, format!("add one with `drivegate {kind} add`"));
            }
            Some(all)
        }
        Err((line, error)) => {
            let remedy = format!("remove the line, and create another with `drivegate {kind} add`");
            reader.problem(key, format!("{path}:{line}: {error}"), remedy);
            None
        }
    }
}

/// Whether commands can be enabled: there must be users, and passwords must not travel in clear text.
fn is_safe_to_command(reader: &Reader<'_>, listen: Option<SocketAddr>, has_users: bool) -> bool {
    let key = HTTP.commands.name;
    if !has_users {
        reader.problem(
            key,
            "commands need users, and there is no `users_file`",
            "set users_file to a file made by `drivegate user add`",
        );
    }
    let is_private = reader.has(HTTP.certificate.name) || listen.is_none_or(|listen| listen.ip().is_loopback());
    if !is_private {
        reader.problem(
            key,
            "commands without TLS would send passwords in clear text over the network",
            "set certificate and key, or listen on 127.0.0.1, for instance behind a reverse proxy with TLS",
        );
    }
    has_users && is_private
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

/// Warns about data that the network can read.
fn warn_of_reach(reader: &Reader<'_>, listen: SocketAddr) {
    if listen.ip().is_loopback() {
        return;
    }
    if !reader.has(HTTP.tokens_file.name) {
        reader.warning(
            HTTP.listen.name,
            format!("{listen} can be reached from the network, and every client may read all data"),
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
