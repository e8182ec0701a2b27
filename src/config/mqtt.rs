//! `[mqtt]`.

use std::fs::File;
use std::io::Read;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::values;
use crate::document::{Reader, format_duration, parse_size};
use crate::north::mqtt::{Buffer, Options, Secret};

pub(super) const DEFAULT_URL: &str = "mqtt://127.0.0.1:1883";
pub(super) const DEFAULT_BASE: &str = "drivegate";
pub(super) const DEFAULT_MIN_INTERVAL: Duration = Duration::from_millis(100);
pub(super) const DEFAULT_MAX_INTERVAL: Duration = Duration::from_secs(60);
pub(super) const DEFAULT_BUFFER_DIR: &str = "/var/lib/drivegate";
pub(super) const DEFAULT_BUFFER: &str = "64MiB";

const MIN_INTERVAL: RangeInclusive<Duration> = Duration::ZERO..=Duration::from_secs(3600);
const MAX_INTERVAL: RangeInclusive<Duration> = Duration::from_millis(10)..=Duration::from_secs(86_400);
const BUFFER: RangeInclusive<u64> = (64 << 10)..=(1 << 40);
/// Most bytes of a secret: a file that is longer is no password.
const SECRET: u64 = 4096;

struct Broker {
    host: String,
    port: u16,
    tls: bool,
}

pub(super) fn read(reader: &Reader<'_>, base: &Path, gateway: Option<&str>) -> Option<Options> {
    let broker = match reader.has("url") {
        true => reader.parsed("url", parse_url),
        false => parse_url(DEFAULT_URL).ok(),
    };
    let tls = broker.as_ref().is_some_and(|b| b.tls);
    let client_id = reader
        .parsed("client_id", |text| match text {
            "" => Err("the client id is empty; write a name or leave the key out".to_string()),
            text => Ok(text.to_string()),
        })
        .unwrap_or_else(|| format!("drivegate-{}", gateway.unwrap_or_default()));
    let username: Option<String> = reader.optional("username");
    let password = read_password(reader, base);
    if (reader.has("password") || reader.has("password_file")) && username.is_none() && !reader.has("username") {
        reader.problem("username", "there is a password without a user; write username = \"…\"");
    }
    let ca = read_pem(reader, "ca", base);
    let identity = read_identity(reader, base);
    if !tls && broker.is_some() && (reader.has("ca") || reader.has("certificate")) {
        reader.warning(
            "url",
            "certificates are not used on an mqtt:// connection; write mqtts:// for TLS",
        );
    }
    let topics = reader.parsed("base", parse_base);
    let (min_interval, max_interval) = read_publish(reader);
    let commands = reader.or("commands", false);
    let buffer = read_buffer(reader, base);
    if reader.or("home_assistant", false) {
        reader.problem(
            "home_assistant",
            "home_assistant = true is not served by this version; remove it",
        );
    }
    reader.finish();
    let Broker { host, port, tls } = broker?;
    Some(Options {
        host,
        port,
        tls,
        client_id,
        username,
        password,
        ca,
        identity,
        base: topics.unwrap_or_else(|| DEFAULT_BASE.to_string()),
        min_interval,
        max_interval,
        commands,
        buffer,
    })
}

fn parse_url(text: &str) -> Result<Broker, String> {
    let bad = |why: &str| {
        format!(
            "`{}` {why}; write \"mqtt://host:port\" or \"mqtts://host:port\"",
            hidden(text)
        )
    };
    let (scheme, rest) = text.split_once("://").ok_or_else(|| bad("has no scheme"))?;
    let (tls, port) = match scheme {
        "mqtt" => (false, 1883),
        "mqtts" => (true, 8883),
        _ => return Err(bad("is no MQTT address")),
    };
    if rest.contains('@') {
        return Err("the address holds a user; write username and password_file as keys of their own".to_string());
    }
    let server = rest.strip_suffix('/').unwrap_or(rest);
    let (host, port) = values::host_port(server, Some(port)).ok_or_else(|| bad("names no host and port"))?;
    Ok(Broker { host, port, tls })
}

/// The address without what may be a password.
fn hidden(url: &str) -> String {
    match url.rsplit_once('@') {
        Some((_, host)) => format!("…@{host}"),
        None => url.to_string(),
    }
}

/// `password` or the text of `password_file`; what the environment sets wins over what the file sets.
fn read_password(reader: &Reader<'_>, base: &Path) -> Option<Secret> {
    let plain: Option<String> = reader.optional("password");
    let file: Option<PathBuf> = reader.optional("password_file");
    let from_env = |key: &str| reader.place_of(key).env.is_some();
    let (plain, file) = match (plain, file, from_env("password"), from_env("password_file")) {
        (Some(plain), Some(_), true, false) => (Some(plain), None),
        (Some(_), Some(file), false, true) => (None, Some(file)),
        (Some(_), Some(_), ..) => {
            reader.problem(
                "password",
                "both password and password_file are set; remove one of them",
            );
            return None;
        }
        (plain, file, ..) => (plain, file),
    };
    match file.map(|file| secret(&values::resolved(base, file))) {
        None => plain.map(Secret),
        Some(Ok(text)) => Some(Secret(text)),
        Some(Err(message)) => {
            reader.problem("password_file", message);
            None
        }
    }
}

/// The first line of a secret file.
fn secret(path: &Path) -> Result<String, String> {
    let mut text = String::new();
    File::open(path)
        .and_then(|file| file.take(SECRET).read_to_string(&mut text))
        .map_err(|error| cannot_read(path, &error))?;
    let line = text.lines().next().unwrap_or_default();
    if line.is_empty() {
        return Err(format!("{} is empty; write the password into it", path.display()));
    }
    if text.trim_end_matches(['\r', '\n']).contains('\n') || text.len() as u64 == SECRET {
        return Err(format!(
            "{} is no password: it has several lines; write one line",
            path.display()
        ));
    }
    Ok(line.to_string())
}

fn cannot_read(path: &Path, error: &std::io::Error) -> String {
    format!(
        "cannot read {}: {error}; check the path and its permissions",
        path.display()
    )
}

/// Path of a PEM file that can be read now.
fn read_pem(reader: &Reader<'_>, key: &str, base: &Path) -> Option<PathBuf> {
    let path = values::resolved(base, reader.optional(key)?);
    let readable = File::open(&path).and_then(|file| match file.metadata()?.is_file() {
        true => Ok(()),
        false => Err(std::io::Error::other("it is no file")),
    });
    if let Err(error) = readable {
        reader.problem(key, cannot_read(&path, &error));
    }
    Some(path)
}

fn read_identity(reader: &Reader<'_>, base: &Path) -> Option<(PathBuf, PathBuf)> {
    let certificate = read_pem(reader, "certificate", base);
    let key = read_pem(reader, "key", base);
    for (there, missing) in [("certificate", "key"), ("key", "certificate")] {
        if reader.has(there) && !reader.has(missing) {
            reader.problem(
                there,
                format!("`{there}` stands without `{missing}`; write both or none"),
            );
        }
    }
    Some((certificate?, key?))
}

fn parse_base(text: &str) -> Result<String, String> {
    let levels = || text.split('/');
    let bad = text.contains(['+', '#', '\0']) || text.starts_with('$') || levels().any(str::is_empty);
    if bad {
        return Err(format!(
            "`{text}` cannot begin a topic; write levels joined by /, none empty, without + and #, no $ first"
        ));
    }
    Ok(text.to_string())
}

fn read_publish(reader: &Reader<'_>) -> (Duration, Duration) {
    let Some(table) = reader.table("publish") else {
        return (DEFAULT_MIN_INTERVAL, DEFAULT_MAX_INTERVAL);
    };
    let least = values::duration(&table, "min_interval", DEFAULT_MIN_INTERVAL, &MIN_INTERVAL);
    let most = values::duration(&table, "max_interval", DEFAULT_MAX_INTERVAL, &MAX_INTERVAL);
    if least > most {
        table.problem(
            "min_interval",
            format!(
                "min_interval = {} is longer than max_interval = {}; swap them or raise max_interval",
                format_duration(least),
                format_duration(most)
            ),
        );
    }
    table.finish();
    (least, most)
}

fn read_buffer(reader: &Reader<'_>, base: &Path) -> Option<Buffer> {
    let table = reader.table("buffer")?;
    let dir = table.or("dir", PathBuf::from(DEFAULT_BUFFER_DIR));
    let size = match table.has("max_bytes") {
        true => table.parsed("max_bytes", |text| match parse_size(text)? {
            bytes if BUFFER.contains(&bytes) => Ok(bytes),
            _ => Err(format!("{text} is out of range; write \"64KiB\" to \"1024GiB\"")),
        }),
        false => parse_size(DEFAULT_BUFFER).ok(),
    };
    table.finish();
    Some(Buffer {
        dir: values::resolved(base, dir),
        max_bytes: size?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn broker_addresses() {
        let of = |text| parse_url(text).map(|b| (b.host, b.port, b.tls));
        assert_eq!(of("mqtt://broker"), Ok(("broker".into(), 1883, false)));
        assert_eq!(of("mqtts://broker/"), Ok(("broker".into(), 8883, true)));
        assert_eq!(of("mqtt://[::1]:1884"), Ok(("::1".into(), 1884, false)));
        for bad in [
            "",
            "broker",
            "tcp://b",
            "http://b:1",
            "mqtt://",
            "mqtt://b:x",
            "mqtt://b/topic",
        ] {
            assert!(of(bad).is_err(), "{bad}");
        }
        let told = of("mqtt://me:geheim@b").unwrap_err() + &of("x://me:geheim@b").unwrap_err();
        assert!(!told.contains("geheim"), "{told}");
    }

    #[test]
    fn topics() {
        for good in ["drivegate", "plant/hall 2", "ä"] {
            assert!(parse_base(good).is_ok(), "{good}");
        }
        for bad in ["", "/a", "a/", "a//b", "a/+", "#", "$SYS"] {
            assert!(parse_base(bad).is_err(), "{bad}");
        }
    }
}
