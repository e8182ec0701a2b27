use std::sync::Arc;

use rustls::OtherError;
use rustls_pki_types::{ServerName, UnixTime};

use super::*;

fn told(error: Error, peer: Peer) -> String {
    explain(&io::Error::new(io::ErrorKind::InvalidData, error), peer).expect("an error of TLS")
}

fn refused(cause: CertificateError) -> String {
    told(cause.into(), BROKER)
}

#[test]
fn every_refusal_has_a_cause_and_a_remedy() {
    let time = UnixTime::since_unix_epoch(std::time::Duration::from_secs(1_767_225_600));
    let of_webpki = |cause: webpki::Error| CertificateError::Other(OtherError(Arc::new(cause)));
    let expected = ServerName::try_from("10.0.0.5").unwrap();
    for (cause, what, remedy) in [
        (
            CertificateError::ExpiredContext { time, not_after: time },
            "expired on 2026-01-01T00:00:00Z",
            "renew",
        ),
        (
            CertificateError::NotValidForNameContext {
                expected: expected.clone(),
                presented: Vec::new(),
            },
            "does not name the host `10.0.0.5`",
            "subjectAltName = IP:10.0.0.5, or name the certificate itself in mqtt.ca",
        ),
        (
            CertificateError::NotValidForNameContext {
                expected,
                presented: vec![
                    "DnsName(\"broker.local\")".to_string(),
                    "IpAddress(10.0.0.6)".to_string(),
                ],
            },
            "is for `broker.local`, `10.0.0.6`, not for `10.0.0.5`",
            "connect by a name in it",
        ),
        (
            of_webpki(webpki::Error::CaUsedAsEndEntity),
            "a CA certificate",
            "name the certificate itself in mqtt.ca",
        ),
        (
            of_webpki(webpki::Error::UnsupportedCertVersion),
            "X.509 version 1",
            "-extfile with a subjectAltName",
        ),
        (
            of_webpki(webpki::Error::UnsupportedCriticalExtension),
            "critical extension",
            "reissued",
        ),
        (
            of_webpki(webpki::Error::MaximumPathDepthExceeded),
            "(MaximumPathDepthExceeded)",
            "reissued",
        ),
        (
            CertificateError::InvalidPurpose,
            "is not valid for use by a server",
            "serverAuth",
        ),
        (CertificateError::BadSignature, "not signed with the key", "mqtt.ca"),
        (CertificateError::UnknownIssuer, "not in mqtt.ca", "add"),
    ] {
        let text = refused(cause);
        let (left, right) = text.split_once("; ").unwrap_or_else(|| panic!("no remedy: {text}"));
        assert!(left.contains(what), "{text}");
        assert!(right.contains(remedy), "{text}");
        assert!(!text.contains("OtherError") && !right.contains("; "), "{text}");
    }
}

#[test]
fn alerts_are_told_by_who_sent_them() {
    let alert = |alert, peer| told(Error::AlertReceived(alert), peer);
    let broker = alert(AlertDescription::HandshakeFailure, BROKER);
    assert!(broker.contains("P-521"), "{broker}");
    let broker = alert(AlertDescription::CertificateRequired, BROKER);
    assert!(broker.ends_with("set mqtt.certificate and mqtt.key"), "{broker}");
    let client = alert(AlertDescription::UnknownCA, Peer::Client);
    assert!(
        client.ends_with("give the client the certificate of that CA"),
        "{client}"
    );
}

#[test]
fn what_is_no_error_of_tls_is_told_by_others() {
    let refused = io::Error::from(io::ErrorKind::ConnectionRefused);
    assert_eq!(explain(&refused, BROKER), None);
    assert!(!is_handshake_end(&refused));
    assert!(is_handshake_end(&io::Error::new(
        io::ErrorKind::UnexpectedEof,
        "tls handshake eof"
    )));
}
