//! Values of the configuration that TOML has no type for.

use std::fmt::Display;
use std::net::{IpAddr, SocketAddr};
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::Duration;

use ipnet::IpNet;

use crate::document::{Place, Reader, format_duration, nearest};

/// Most characters of a name.
pub(super) const NAME_LENGTH: usize = 64;

/// A duration between two bounds; `default` when it is absent or wrong.
pub(super) fn duration(
    reader: &Reader<'_>,
    key: &str,
    default: Duration,
    bounds: &RangeInclusive<Duration>,
) -> Duration {
    optional_duration(reader, key, bounds).unwrap_or(default)
}

/// A duration between two bounds, if it is there and right.
pub(super) fn optional_duration(reader: &Reader<'_>, key: &str, bounds: &RangeInclusive<Duration>) -> Option<Duration> {
    let value: Duration = reader.optional(key)?;
    if bounds.contains(&value) {
        return Some(value);
    }
    let [value, least, most] = [value, *bounds.start(), *bounds.end()].map(format_duration);
    reader.problem(key, format!("{value} is out of range; write \"{least}\" to \"{most}\""));
    None
}

/// A whole number between two bounds; `default` when it is absent or wrong.
pub(super) fn number<T: Copy + TryFrom<i64> + PartialOrd + Display>(
    reader: &Reader<'_>,
    key: &str,
    default: T,
    bounds: &RangeInclusive<T>,
) -> T {
    optional_number(reader, key, bounds).unwrap_or(default)
}

/// A whole number between two bounds, if it is there and right.
pub(super) fn optional_number<T: Copy + TryFrom<i64> + PartialOrd + Display>(
    reader: &Reader<'_>,
    key: &str,
    bounds: &RangeInclusive<T>,
) -> Option<T> {
    let value: i64 = reader.optional(key)?;
    let fitting = T::try_from(value).ok().filter(|fitting| bounds.contains(fitting));
    if fitting.is_none() {
        let (least, most) = (bounds.start(), bounds.end());
        reader.problem(key, format!("{value} is out of range; write {least} to {most}"));
    }
    fitting
}

/// One of several words; `default` when it is absent or wrong.
pub(super) fn choice<T: Copy>(reader: &Reader<'_>, key: &str, default: T, choices: &[(&str, T)]) -> T {
    let parse = |text: &str| match choices.iter().find(|(word, _)| *word == text) {
        Some((_, value)) => Ok(*value),
        None => Err(unknown_word(text, choices.iter().map(|(word, _)| *word))),
    };
    reader.parsed(key, parse).unwrap_or(default)
}

/// ``unknown word `x`; write "a" or "b"``, with the nearest word if one is near.
pub(super) fn unknown_word<'a>(text: &str, words: impl Iterator<Item = &'a str> + Clone) -> String {
    match nearest(text, words.clone()) {
        Some(near) => format!("unknown word `{text}`; did you mean \"{near}\"?"),
        None => {
            let words: Vec<String> = words.map(|word| format!("\"{word}\"")).collect();
            format!("unknown word `{text}`; write {}", words.join(" or "))
        }
    }
}

/// A name that can stand in topics, labels and addresses, with its place.
pub(super) fn name(reader: &Reader<'_>, joints: &str) -> Option<(String, Place)> {
    let text: String = reader.required("name")?;
    if let Err(message) = check_name(&text, joints) {
        reader.problem("name", message);
        return None;
    }
    Some((text, reader.place_of("name")))
}

fn check_name(text: &str, joints: &str) -> Result<(), String> {
    let letter = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit();
    let shape = text.starts_with(letter) && text.chars().all(|c| letter(c) || joints.contains(c));
    if shape && text.len() <= NAME_LENGTH {
        return Ok(());
    }
    let joints: Vec<String> = joints.chars().map(String::from).collect();
    Err(format!(
        "`{text}` cannot be a name; write a-z, 0-9 and {}, {NAME_LENGTH} characters at most, a letter or digit first",
        joints.join(", ")
    ))
}

/// An address to listen on.
pub(super) fn socket(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| {
        let port = text.rsplit(':').next().and_then(|port| port.parse::<u16>().ok());
        let port = port.unwrap_or(1502);
        format!(
            "`{text}` is no IP address with a port; write for example \"127.0.0.1:{port}\" or \"[::1]:{port}\"; host names \
             are not taken"
        )
    })
}

/// A network in CIDR form, or a single address.
pub(super) fn network(text: &str) -> Result<IpNet, String> {
    let host = || text.parse::<IpAddr>().map(IpNet::from).ok();
    text.parse::<IpNet>()
        .ok()
        .or_else(host)
        .map(|net| net.trunc())
        .ok_or_else(|| format!("`{text}` is no network; write for example \"192.168.1.0/24\" or \"192.168.1.7/32\""))
}

/// A list of strings, each parsed; every bad item is a problem.
pub(super) fn list<T>(
    reader: &Reader<'_>,
    key: &str,
    default: Vec<T>,
    parse: impl Fn(&str) -> Result<T, String>,
) -> Vec<T> {
    let Some(items) = reader.optional::<Vec<String>>(key) else {
        return default;
    };
    let mut values = Vec::new();
    for item in items {
        match parse(&item) {
            Ok(value) => values.push(value),
            Err(message) => reader.problem(key, message),
        }
    }
    values
}

/// `host:port` or `[v6]:port`; the port may be left out where there is a default.
pub(super) fn host_port(text: &str, default: Option<u16>) -> Option<(String, u16)> {
    let (host, port) = match text.strip_prefix('[') {
        Some(rest) => {
            let (host, rest) = rest.split_once(']')?;
            host.parse::<std::net::Ipv6Addr>().ok()?;
            match rest.strip_prefix(':') {
                Some(port) => (host, Some(port)),
                None if rest.is_empty() => (host, None),
                None => return None,
            }
        }
        None => match text.split_once(':') {
            Some((host, port)) => (host, Some(port)),
            None => (text, None),
        },
    };
    let sound = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_' | ':');
    if host.is_empty() || !host.chars().all(sound) {
        return None;
    }
    let port = match port {
        Some(port) => port.parse().ok().filter(|port| *port != 0)?,
        None => default?,
    };
    Some((host.to_string(), port))
}

/// `path` as seen from the directory of the configuration file.
pub(super) fn resolved(base: &Path, path: PathBuf) -> PathBuf {
    if path.is_absolute() { path } else { base.join(path) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names() {
        for good in ["a", "pump-1", "1st_pump", &"x".repeat(64)] {
            assert_eq!(check_name(good, "-_"), Ok(()), "{good}");
        }
        for bad in ["", "-a", "Pump", "a b", "a/b", "a+", "ä", "a.b", &"x".repeat(65)] {
            assert!(check_name(bad, "-_").is_err(), "{bad}");
        }
        assert!(check_name("a_b", "-").is_err());
    }

    #[test]
    fn hosts_and_ports() {
        let some = |host: &str, port| Some((host.to_string(), port));
        assert_eq!(host_port("broker:1", Some(1883)), some("broker", 1));
        assert_eq!(host_port("broker", Some(1883)), some("broker", 1883));
        assert_eq!(host_port("[::1]:77", None), some("::1", 77));
        assert_eq!(host_port("[::1]", Some(5)), some("::1", 5));
        for bad in [
            "", ":1", "a:", "a:0", "a:70000", "a:b", "a", "[::1", "[::1]x", "::1", "a/b:1", "u@h:1",
        ] {
            assert_eq!(host_port(bad, None), None, "{bad}");
        }
    }

    #[test]
    fn networks() {
        assert_eq!(network("10.1.2.3/8").unwrap().to_string(), "10.0.0.0/8");
        assert_eq!(network("10.1.2.3").unwrap().to_string(), "10.1.2.3/32");
        assert_eq!(network("::1").unwrap().to_string(), "::1/128");
        for bad in ["", "10.0.0.0/33", "10.0.0", "localhost"] {
            assert!(network(bad).is_err(), "{bad}");
        }
    }
}
