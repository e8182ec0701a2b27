//! Values of the configuration that are texts because TOML has no type for them.

use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};

use ipnet::IpNet;

use drivegate_model::document::{Finding, Reader, nearest};

/// Longest name, in characters.
pub(super) const NAME_LENGTH: usize = 64;

/// `"a"`, `"a" or "b"`, `"a", "b" or "c"`.
pub(super) fn any_of<'a>(words: impl Iterator<Item = &'a str>) -> String {
    let words: Vec<String> = words.map(|word| format!("\"{word}\"")).collect();
    match words.split_last() {
        Some((last, rest)) if !rest.is_empty() => format!("{} or {last}", rest.join(", ")),
        _ => words.concat(),
    }
}

/// The message ``unknown word `x` ``, with the nearest word or all words.
pub(super) fn unknown_word<'a>(text: &str, words: impl Iterator<Item = &'a str> + Clone) -> Finding {
    let remedy = match nearest(text, words.clone()) {
        Some(near) => format!("did you mean \"{near}\"?"),
        None => format!("write {}", any_of(words)),
    };
    Finding::new(format!("unknown word `{text}`"), remedy)
}

/// Checks a name that can be part of topics, labels and addresses; `joints` are allowed in addition to letters and
/// digits.
pub(super) fn check_name(text: &str, joints: &str) -> Result<(), Finding> {
    let letter = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit();
    let shape = text.starts_with(letter) && text.chars().all(|c| letter(c) || joints.contains(c));
    if shape && text.len() <= NAME_LENGTH {
        return Ok(());
    }
    let joints: Vec<String> = joints.chars().map(String::from).collect();
    Err(Finding::new(
        format!("`{text}` is not a valid name"),
        format!(
            "write a-z, 0-9 and {}, at most {NAME_LENGTH} characters, starting with a letter or digit",
            joints.join(", ")
        ),
    ))
}

/// Parses an address to listen on.
pub(super) fn socket<const PORT: u16>(text: &str) -> Result<SocketAddr, Finding> {
    text.parse().map_err(|_| {
        let port = text.rsplit(':').next().and_then(|port| port.parse::<u16>().ok());
        if text.parse::<IpAddr>().is_ok() {
            return Finding::new(
                format!("`{text}` has no port"),
                format!(
                    "write it with the port of this server, such as \"{}\"",
                    with_port(text, PORT)
                ),
            );
        }
        let port = port.unwrap_or(PORT);
        Finding::new(
            format!("`{text}` is not an IP address with a port"),
            format!("write for example \"127.0.0.1:{port}\" or \"[::1]:{port}\"; host names are not accepted"),
        )
    })
}

fn with_port(address: &str, port: u16) -> String {
    if address.contains(':') {
        format!("[{address}]:{port}")
    } else {
        format!("{address}:{port}")
    }
}

/// A network in CIDR notation, or a single address.
pub(super) fn network(text: &str) -> Result<IpNet, Finding> {
    let host = || text.parse::<IpAddr>().map(IpNet::from).ok();
    let network = text.parse::<IpNet>().ok().or_else(host);
    network.map(|network| network.trunc()).ok_or_else(|| {
        Finding::new(
            format!("`{text}` is not a network"),
            "write for example \"192.168.1.0/24\" or \"192.168.1.7/32\"",
        )
    })
}

/// Accepts any text as a value.
pub(super) fn any_text(text: &str) -> Result<String, Finding> {
    Ok(text.to_string())
}

/// Accepts any path as a value.
pub(super) fn path(text: &str) -> Result<PathBuf, Finding> {
    Ok(PathBuf::from(text))
}

/// Parses `host:port` or `[v6]:port`; the port may be omitted if `default` is given.
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

/// Reports that one of two keys is present without the other.
pub(super) fn both_or_none(reader: &Reader<'_>, names: [&str; 2]) {
    for [present, missing] in [names, [names[1], names[0]]] {
        if reader.has(present) && !reader.has(missing) {
            let what = format!("`{present}` without `{missing}`");
            reader.problem(present, what, "write both or none");
        }
    }
}

/// Reports names of buses that do not exist in the file, and removes them; `remedy` is shown if no similar name exists.
pub(super) fn known_buses(reader: &Reader<'_>, key: &str, names: &mut Vec<String>, known: &[&str], remedy: &str) {
    names.retain(|name| {
        let is_known = known.contains(&name.as_str());
        if !is_known {
            let near = nearest(name, known.iter().copied()).map(|near| format!("did you mean `{near}`?"));
            let remedy = near.unwrap_or_else(|| remedy.to_string());
            reader.problem(key, format!("there is no bus `{name}`"), remedy);
        }
        is_known
    });
}

/// `path` relative to the directory of the configuration file.
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
