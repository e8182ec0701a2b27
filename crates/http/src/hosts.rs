//! The names and addresses that the HTTP server accepts. Otherwise a malicious web page whose name resolves to this
//! machine (DNS rebinding) could read everything through a user's browser. Pure.

use std::net::IpAddr;

/// Names that always mean this machine, in addition to names that end in `.localhost`.
const LOOPBACK: [&str; 4] = ["localhost", "localhost.localdomain", "ip6-localhost", "ip6-loopback"];
/// Longest name of a host.
const LONGEST_NAME: usize = 255;

/// A host name or address without a port.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Host {
    Address(IpAddr),
    /// A name in lower case, without a final dot.
    Name(String),
}

impl Host {
    /// Parses a host as in the header `Host` or in a URL: a name or an address, possibly with a port.
    pub(super) fn parse(text: &str) -> Option<Host> {
        let (host, port) = match text.strip_prefix('[') {
            Some(rest) => {
                let (address, rest) = rest.split_once(']')?;
                let port = if rest.is_empty() { "" } else { rest.strip_prefix(':')? };
                let IpAddr::V6(address) = address.parse().ok()? else {
                    return None;
                };
                (Host::Address(IpAddr::V6(address).to_canonical()), port)
            }
            None => {
                let (name, port) = text.split_once(':').unwrap_or((text, ""));
                (Host::name(name)?, port)
            }
        };
        let is_port =
            port.bytes().all(|byte| byte.is_ascii_digit()) && (port.is_empty() || port.parse::<u16>().is_ok());
        is_port.then_some(host)
    }

    /// Reads a name or an address of `hosts` in the configuration; an IPv6 address may have brackets.
    pub(super) fn configured(text: &str) -> Option<Host> {
        match text.parse::<IpAddr>() {
            Ok(address) => Some(Host::Address(address.to_canonical())),
            Err(_) => Host::parse(text).filter(|_| text.starts_with('[') || !text.contains(':')),
        }
    }

    fn name(text: &str) -> Option<Host> {
        if let Ok(address) = text.parse::<IpAddr>() {
            return address.is_ipv4().then_some(Host::Address(address));
        }
        let text = text.strip_suffix('.').unwrap_or(text);
        let sound = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_');
        let is_label = |label: &str| !label.is_empty() && label.chars().all(sound);
        let is_name = text.len() <= LONGEST_NAME && text.split('.').all(is_label);
        is_name.then(|| Host::Name(text.to_ascii_lowercase()))
    }
}

/// Host names under which the server answers.
#[derive(Debug, PartialEq)]
pub(super) struct Hosts(Vec<Host>);

impl Hosts {
    /// The hosts of this gateway: the loopback, its machine's name `own_name`, and the configured hosts.
    pub(super) fn new(own_name: &str, configured: &[String]) -> Hosts {
        let short = own_name.split('.').next().unwrap_or_default();
        let own = [own_name, short].into_iter().filter_map(Host::parse);
        Hosts(
            own.chain(configured.iter().filter_map(|text| Host::configured(text)))
                .collect(),
        )
    }

    /// Whether a request to `host` that arrived at this machine's address `local` is meant for this gateway.
    pub(super) fn contain(&self, host: &Host, local: IpAddr) -> bool {
        let own = match host {
            Host::Address(address) => address.is_loopback() || *address == local.to_canonical(),
            Host::Name(name) => LOOPBACK.contains(&name.as_str()) || name.ends_with(".localhost"),
        };
        own || self.0.contains(host)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn forms_of_a_host() {
        let name = |text: &str| Some(Host::Name(text.to_string()));
        let address = |text: &str| Some(Host::Address(text.parse().unwrap()));
        for (text, host) in [
            ("localhost", name("localhost")),
            ("LocalHost.:9488", name("localhost")),
            ("Gateway.Plant.Example:443", name("gateway.plant.example")),
            ("my_gateway", name("my_gateway")),
            ("gateway:", name("gateway")),
            ("127.0.0.1:9488", address("127.0.0.1")),
            ("[::1]:9488", address("::1")),
            ("[FE80::1]", address("fe80::1")),
            ("[::ffff:10.0.0.1]:80", address("10.0.0.1")),
        ] {
            assert_eq!(Host::parse(text), host, "{text}");
        }
        let long = "a".repeat(LONGEST_NAME + 1);
        for bad in [
            "",
            ".",
            "..",
            "a..b",
            ".a",
            "a b",
            "a/b",
            "user@a",
            "a:b",
            "a:1:2",
            "::1",
            "[::1",
            "[::1]x",
            "[::1]:x",
            "[]",
            "[127.0.0.1]",
            "[fe80::1%eth0]",
            "a:65536",
            "a:-1",
            "a:+1",
            "ä",
            "a\t",
            "*",
            "a,b",
            &long,
        ] {
            assert_eq!(Host::parse(bad), None, "{bad:?}");
        }
        assert_eq!(Host::configured("::1"), address("::1"));
        assert_eq!(Host::configured("[::1]"), address("::1"));
        assert_eq!(Host::configured("Gateway"), name("gateway"));
        for bad in ["gateway:80", "10.0.0.1:80", "*.plant", "http://gateway"] {
            assert_eq!(Host::configured(bad), None, "{bad}");
        }
    }

    #[test]
    fn own_hosts() {
        let hosts = Hosts::new(
            "Gw1.plant.example",
            &["proxy.example".to_string(), "192.0.2.7".to_string()],
        );
        let local = "10.0.0.5".parse().unwrap();
        let own = |text: &str| hosts.contain(&Host::parse(text).unwrap(), local);
        for text in [
            "localhost:9488",
            "app.localhost",
            "127.0.0.1",
            "127.9.9.9",
            "[::1]",
            "10.0.0.5:9488",
            "[::ffff:10.0.0.5]",
            "gw1",
            "GW1.PLANT.EXAMPLE.",
            "proxy.example:443",
            "192.0.2.7",
        ] {
            assert!(own(text), "{text}");
        }
        for text in [
            "evil.example",
            "10.0.0.6",
            "gw1.evil.example",
            "xgw1",
            "localhost.evil.example",
            "[fe80::1]",
            "127.1",
            "2130706433",
            "0.0.0.0",
        ] {
            assert!(!own(text), "{text}");
        }
    }
}
