//! Why a TLS connection failed, and the remedy, in terms of the configuration instead of the library.

use std::error::Error as StdError;
use std::io;

use rustls::{AlertDescription, CertificateError, Error};

use super::certificate::printable;
use super::date;
use super::key::{SUPPORTED_KEYS, algorithm};
use super::server_trust::UnknownIssuer;

/// The peer of a TLS connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Peer {
    /// A server that the gateway or one of its commands connects to.
    Server {
        /// Name of the setting with the certificates that verify the server.
        ca: &'static str,
        /// Name of the setting for the gateway's own certificate; empty if there is no such setting.
        own: &'static str,
    },
    /// A client of the gateway.
    Client,
}

/// A broker that the MQTT client connects to.
pub const BROKER: Peer = Peer::Server {
    ca: "mqtt.ca",
    own: "mqtt.certificate and mqtt.key",
};
/// A gateway that a command connects to over HTTPS.
pub const GATEWAY: Peer = Peer::Server { ca: "--ca", own: "" };

/// Fault and remedy as `what; what to do`; `None` if the error does not come from TLS.
pub fn explain(error: &(dyn StdError + 'static), peer: Peer) -> Option<String> {
    let (what, remedy) = match found(error)? {
        Error::InvalidCertificate(cause) => certificate(cause, peer),
        Error::AlertReceived(alert) => alerted(*alert, peer),
        Error::InvalidMessage(_) => (
            "it does not speak TLS on this port".to_string(),
            not_tls(peer).to_string(),
        ),
        Error::PeerIncompatible(why) => (
            format!("there is no version of TLS, key exchange or cipher in common ({why:?})"),
            "allow TLS 1.2 or 1.3 with ECDHE and AES-GCM or ChaCha20 at the other end".to_string(),
        ),
        Error::NoCertificatesPresented => (
            "it shows no certificate".to_string(),
            match peer {
                Peer::Server { .. } => "give it a certificate".to_string(),
                Peer::Client => "give the client a certificate of the CA in client_ca".to_string(),
            },
        ),
        // The configuration does not cause any other error.
        error => return Some(format!("TLS: {error}")),
    };
    Some(format!("{what}; {remedy}"))
}

/// What [`explain`] finds, or the error's own text.
pub fn in_words(error: &(dyn StdError + 'static), peer: Peer) -> String {
    explain(error, peer).unwrap_or_else(|| error.to_string())
}

/// Whether a server closed the connection in the middle of the handshake.
pub fn is_handshake_end(error: &(dyn StdError + 'static)) -> bool {
    use io::ErrorKind::{BrokenPipe, ConnectionAborted, ConnectionReset, UnexpectedEof};
    let mut next = Some(error);
    while let Some(error) = next {
        if let Some(io) = error.downcast_ref::<io::Error>() {
            return matches!(
                io.kind(),
                BrokenPipe | ConnectionAborted | ConnectionReset | UnexpectedEof
            );
        }
        next = error.source();
    }
    false
}

/// The library's error inside the given error.
fn found<'a>(error: &'a (dyn StdError + 'static)) -> Option<&'a Error> {
    let mut next = Some(error);
    while let Some(error) = next {
        if let Some(found) = error.downcast_ref::<Error>() {
            return Some(found);
        }
        // The error inside an I/O error is not returned by `source`.
        let inner = error.downcast_ref::<io::Error>().and_then(io::Error::get_ref);
        next = match inner {
            Some(inner) => Some(inner),
            None => error.source(),
        };
    }
    None
}

fn not_tls(peer: Peer) -> &'static str {
    match peer {
        BROKER => "set the broker's TLS port in mqtt.url, usually 8883, or mqtt:// for a port without TLS",
        Peer::Server { .. } => "write http:// for a gateway without TLS",
        Peer::Client => "let the client use TLS here, or the port without TLS",
    }
}

/// Name of the setting with the certificates that verify the other end.
fn trusted(peer: Peer) -> &'static str {
    match peer {
        Peer::Server { ca, .. } => ca,
        Peer::Client => "client_ca",
    }
}

fn certificate(cause: &CertificateError, peer: Peer) -> (String, String) {
    use CertificateError as E;
    let ca = trusted(peer);
    let pin = match peer {
        Peer::Server { .. } => format!(", or name the certificate itself in {ca}"),
        Peer::Client => String::new(),
    };
    let reissue = |as_what: &str| format!("have it reissued {as_what}{pin}");
    match cause {
        E::ExpiredContext { not_after, .. } => (
            format!("its certificate expired on {}", date(not_after.as_secs())),
            "renew it, or set the clock of this machine".to_string(),
        ),
        E::Expired => (
            "the dates in its certificate contradict each other".to_string(),
            "have it reissued".to_string(),
        ),
        E::NotValidYetContext { not_before, .. } => (
            format!("its certificate is not valid before {}", date(not_before.as_secs())),
            "set the clock of this machine, or have it reissued".to_string(),
        ),
        E::NotValidForNameContext { expected, presented } => wrong_name(&expected.to_str(), presented, &pin),
        E::UnknownIssuer => (
            format!("its certificate was issued by a CA that is not in {ca}"),
            format!("add the certificate of that CA to {ca}"),
        ),
        E::BadSignature => (
            format!("its certificate was not signed with the key of the CA in {ca} that it names"),
            format!("put the current certificate of that CA into {ca}: a renewed CA may have a new key"),
        ),
        E::Revoked => (
            "its certificate was revoked".to_string(),
            "have a new one issued".to_string(),
        ),
        E::InvalidPurpose | E::InvalidPurposeContext { .. } => {
            let (role, usage) = match peer {
                Peer::Server { .. } => ("a server", "serverAuth"),
                Peer::Client => ("a client", "clientAuth"),
            };
            (
                format!("its certificate is not valid for use by {role}"),
                format!("have it reissued with extendedKeyUsage = {usage}"),
            )
        }
        E::UnsupportedSignatureAlgorithmContext {
            signature_algorithm_id, ..
        } => (
            format!(
                "its certificate, or that of its CA, is signed by {}, which the gateway does not support",
                algorithm(signature_algorithm_id)
            ),
            reissue("with a signature of SHA-256 or SHA-384"),
        ),
        E::UnsupportedSignatureAlgorithmForPublicKeyContext {
            public_key_algorithm_id,
            ..
        } => (
            format!(
                "its certificate, or that of its CA, has a key of {}, which the gateway does not support with its signature",
                algorithm(public_key_algorithm_id)
            ),
            format!("use keys of {SUPPORTED_KEYS}"),
        ),
        E::UnhandledCriticalExtension => critical_extension(),
        E::BadEncoding => (
            "its certificate is not valid X.509".to_string(),
            "have it reissued".to_string(),
        ),
        E::Other(inner) => {
            let inner: &(dyn StdError + 'static) = &*inner.0;
            match (
                inner.downcast_ref::<UnknownIssuer>(),
                inner.downcast_ref::<webpki::Error>(),
            ) {
                (Some(unknown), _) => unknown_issuer(unknown, ca),
                (_, Some(cause)) => by_webpki(cause, &reissue),
                _ => (format!("its certificate is refused ({inner})"), reissue("")),
            }
        }
        cause => (format!("its certificate is refused ({cause:?})"), reissue("")),
    }
}

fn unknown_issuer(unknown: &UnknownIssuer, ca: &str) -> (String, String) {
    let UnknownIssuer { name, issuer, .. } = unknown;
    let where_ = format!("not among the certificates of {ca}, or of this system where {ca} is not set");
    if unknown.self_issued {
        let what = format!("its certificate `{name}` is signed by itself, and {where_}");
        return (what, format!("if it is the right server, add that certificate to {ca}"));
    }
    (
        format!("its certificate `{name}` is signed by `{issuer}`, which is {where_}"),
        format!("add the certificate of `{issuer}` to {ca}"),
    )
}

fn wrong_name(expected: &str, presented: &[String], pin: &str) -> (String, String) {
    let subject_alternative = match expected.parse::<std::net::IpAddr>() {
        Ok(address) => format!("IP:{address}"),
        Err(_) => format!("DNS:{expected}"),
    };
    if presented.is_empty() {
        return (
            format!("its certificate does not name the host `{expected}` (it has no subjectAltName)"),
            format!(
                "have it reissued with subjectAltName = {subject_alternative}{pin} if its common name is that host"
            ),
        );
    }
    // `DnsName("broker")`, `IpAddress(10.0.0.5)`
    let word = |name: &String| {
        let inner = name
            .split_once('(')
            .map_or(name.as_str(), |(_, inner)| inner.trim_end_matches(')'));
        format!("`{}`", printable(inner.trim_matches('"')))
    };
    let names: Vec<String> = presented.iter().map(word).collect();
    (
        format!("its certificate is for {}, not for `{expected}`", names.join(", ")),
        format!("connect by a name in it, or have it reissued with subjectAltName = {subject_alternative}"),
    )
}

fn critical_extension() -> (String, String) {
    (
        "its certificate has a critical extension that the gateway does not support".to_string(),
        "have it reissued without that extension, or with the extension not critical".to_string(),
    )
}

fn by_webpki(cause: &webpki::Error, reissue: &dyn Fn(&str) -> String) -> (String, String) {
    use webpki::Error as E;
    let (what, as_what) = match cause {
        E::CaUsedAsEndEntity => (
            "its certificate is a CA certificate (basicConstraints CA:TRUE), not one for a server or client",
            "with basicConstraints = CA:FALSE",
        ),
        E::EndEntityUsedAsCa => (
            "its certificate is signed by a certificate that is not a CA (basicConstraints is not CA:TRUE)",
            "by a CA",
        ),
        E::UnsupportedCertVersion => (
            "its certificate, or that of a CA in its chain, is X.509 version 1, which has no names and usages",
            "as version 3, for which openssl x509 -req needs -extfile with a subjectAltName",
        ),
        E::UnsupportedCriticalExtension => return critical_extension(),
        E::NameConstraintViolation => (
            "its certificate is for a name that its CA may not certify",
            "with a name within the CA's nameConstraints",
        ),
        E::PathLenConstraintViolated => (
            "there are more intermediate CAs than the root allows (pathlen)",
            "by a CA closer to the root",
        ),
        E::SignatureAlgorithmMismatch => ("its certificate is inconsistent about its signature algorithm", ""),
        cause => return (format!("its certificate is refused ({cause:?})"), reissue("")),
    };
    (what.to_string(), reissue(as_what).replace("  ", " "))
}

fn alerted(alert: AlertDescription, peer: Peer) -> (String, String) {
    use AlertDescription as A;
    let shown = format!("{alert:?}");
    let own = match peer {
        Peer::Server { own, .. } => own,
        Peer::Client => "the certificate of this server",
    };
    let (what, remedy) = match (alert, peer) {
        (A::HandshakeFailure | A::InsufficientSecurity, Peer::Server { .. }) => (
            "it has no algorithm in common with the gateway: perhaps its certificate has a key that the gateway does \
             not support, such as P-521, or it does not allow TLS 1.2 with ECDHE",
            format!("give it a certificate with a key of {SUPPORTED_KEYS}, and allow TLS 1.2 or 1.3"),
        ),
        (A::ProtocolVersion, _) => (
            "it allows only versions of TLS before 1.2",
            "allow TLS 1.2 or 1.3 at the other end".to_string(),
        ),
        (A::CertificateRequired | A::NoCertificate, Peer::Server { .. }) if !own.is_empty() => {
            ("it requires a client certificate", format!("set {own}"))
        }
        (A::UnknownCA, Peer::Client) => (
            "it does not know the CA of the gateway's certificate",
            "give the client the certificate of that CA".to_string(),
        ),
        (A::UnknownCA, _) => (
            "it does not know the CA of the gateway's certificate",
            format!("use a certificate of its CA in {own}"),
        ),
        (A::CertificateExpired, _) => (
            "for it the gateway's certificate has expired or is not valid yet",
            format!("renew {own}, or set the clocks"),
        ),
        (A::CertificateRevoked, _) => ("the gateway's certificate was revoked", format!("renew {own}")),
        (A::BadCertificate | A::CertificateUnknown | A::UnsupportedCertificate | A::AccessDenied, _) => (
            "it does not accept the gateway's certificate",
            match peer {
                Peer::Server { .. } => format!("check its log for the reason, and check {own}"),
                Peer::Client => {
                    "give the client the CA of this server, and let it connect by a name in the certificate".to_string()
                }
            },
        ),
        (A::UnrecognisedName, _) => (
            "it has no certificate for the name used to connect to it",
            "connect by a name that its certificate has".to_string(),
        ),
        _ => ("it ended the handshake", "check its log for the reason".to_string()),
    };
    (format!("{what} (alert {shown})"), remedy)
}

#[cfg(test)]
mod tests;
