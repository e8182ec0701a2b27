//! Address of a gateway's HTTP server.

use std::fmt;
use std::str::FromStr;

use hyper::Uri;

/// Address of a gateway's HTTP server: `http://host:port`, with a path if a proxy adds one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Url {
    pub(super) tls: bool,
    /// Host; an IPv6 address has no brackets.
    pub(super) host: String,
    pub(super) port: u16,
    pub(super) authority: String,
    pub(super) path: String,
}

impl FromStr for Url {
    type Err = String;

    fn from_str(text: &str) -> Result<Url, String> {
        let form = format!("write it as {}", meant(text));
        let uri: Uri = text.parse().map_err(|why| format!("{why}; {form}"))?;
        let tls = match uri.scheme_str() {
            Some("http") => false,
            Some("https") => true,
            _ => return Err(format!("http:// is missing; {form}")),
        };
        let authority = uri.authority().map(ToString::to_string).unwrap_or_default();
        if authority.contains('@') || uri.query().is_some() {
            return Err(format!("user, password and query are not supported; {form}"));
        }
        let host = uri.host().unwrap_or_default();
        Ok(Url {
            tls,
            host: host.trim_start_matches('[').trim_end_matches(']').to_string(),
            port: uri.port_u16().unwrap_or(if tls { 443 } else { 80 }),
            authority,
            path: uri.path().trim_end_matches('/').to_string(),
        })
    }
}

/// The address that was probably meant: with a scheme, and with the default port if none was given.
fn meant(text: &str) -> String {
    let host = text.rsplit("//").next().unwrap_or_default();
    let plain = host
        .chars()
        .all(|c| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | ':'));
    match (plain && !host.is_empty(), host.contains(':')) {
        (false, _) => "http://127.0.0.1:9488".to_string(),
        (true, true) => format!("http://{host}"),
        (true, false) => format!("http://{host}:9488"),
    }
}

impl fmt::Display for Url {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let scheme = if self.tls { "https" } else { "http" };
        write!(f, "{scheme}://{}{}", self.authority, self.path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn urls() {
        let url: Url = "http://127.0.0.1:9488".parse().unwrap();
        assert_eq!(
            (url.host.as_str(), url.port, url.path.as_str()),
            ("127.0.0.1", 9488, "")
        );
        let url: Url = "http://[::1]/plant/".parse().unwrap();
        assert_eq!((url.host.as_str(), url.port, url.path.as_str()), ("::1", 80, "/plant"));
        assert_eq!(url.to_string(), "http://[::1]/plant");
        let url: Url = "https://gateway.example".parse().unwrap();
        assert_eq!((url.tls, url.host.as_str(), url.port), (true, "gateway.example", 443));
        assert_eq!(url.to_string(), "https://gateway.example");
        for (bad, why) in [
            ("127.0.0.1:9488", "http:// is missing"),
            ("gateway", "http:// is missing; write it as http://gateway:9488"),
            ("10.0.0.5:80", "http:// is missing; write it as http://10.0.0.5:80"),
            ("http://me:secret@gateway", "not supported"),
            ("http://gateway/?a=b", "not supported"),
            ("http://", "write it as"),
            ("", "write it as"),
        ] {
            let error = bad.parse::<Url>().unwrap_err();
            assert!(error.contains(why), "{bad}: {error}");
        }
    }
}
