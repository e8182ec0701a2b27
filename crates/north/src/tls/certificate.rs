//! What the gateway itself reads from an X.509 certificate: names, validity, role, and what decides whether it is accepted in
//! addition to its signature. For checks before a connection, and messages after failed ones.
//!
//! Trust is decided by rustls: where a client's certificate is read, chain and signature were verified before.

use std::path::Path;
use std::time::{Duration, SystemTime};

use rustls_pki_types::{CertificateDer, IpAddr, ServerName};
use x509_cert::certificate::{Certificate, TbsCertificate, Version};
use x509_cert::der::asn1::{ObjectIdentifier, Utf8StringRef};
use x509_cert::der::{self, Decode, Tag, Tagged};
use x509_cert::ext::pkix::name::GeneralName;
use x509_cert::ext::pkix::{BasicConstraints, ExtendedKeyUsage, SubjectAltName};
use x509_cert::name::Name;

use super::fault::Problem;
use super::key::KeyKind;
use super::{date, seconds};
use drivegate_core::hex;

/// The role of a client (Modbus/TCP Security protocol specification, 8.4).
const ROLE: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.3.6.1.4.1.50316.802.1");
const COMMON_NAME: ObjectIdentifier = ObjectIdentifier::new_unwrap("2.5.4.3");
/// Longest role in a certificate, bytes.
const MAX_ROLE: usize = 256;
/// Longest name in the log, characters.
const MAX_NAME: usize = 64;
const SERVER_AUTH: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.3.6.1.5.5.7.3.1");
const ANY_USAGE: ObjectIdentifier = ObjectIdentifier::new_unwrap("2.5.29.37.0");
/// Time before the end of a certificate at which a warning begins.
const SOON: Duration = Duration::from_secs(30 * 86_400);

/// The parts of a certificate that the gateway uses.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct CertificateSummary {
    /// Common name of the subject, or the serial number; printable, at most 64 characters.
    pub(crate) name: String,
    /// Begin of the certificate's validity, seconds since 1970.
    pub(super) not_before: u64,
    /// End of the certificate's validity, seconds since 1970.
    pub(crate) not_after: u64,
    /// Role of a Modbus client, from the certificate.
    pub(crate) role: Result<Option<String>, RoleError>,
    /// Issuer of the certificate, for messages.
    pub(super) issuer: String,
    pub(super) self_issued: bool,
    /// Whether the certificate has a version below 3. Such certificates have no extensions.
    pub(super) is_old: bool,
    /// Whether the certificate may issue others.
    pub(super) is_ca: bool,
    pub(super) key: KeyKind,
    /// Names of hosts and addresses (subjectAltName).
    pub(super) names: Vec<String>,
    /// The common name as written, in a certificate without `names`.
    common_name: Option<String>,
    /// Whether a server may use the certificate (extended key usage).
    pub(super) serves: bool,
}

/// Why the role in a certificate is not accepted. A role can grant write access, so nothing ambiguous is accepted.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum RoleError {
    /// RFC 5280 allows one extension of each kind.
    #[error("the certificate has more than one role extension")]
    Repeated,
    /// Another string type, invalid UTF-8, an invalid length, or data after the string.
    #[error("the role in the certificate is not a UTF8String: {0}")]
    Malformed(der::Error),
    /// Longer than any role that is used.
    #[error("the role in the certificate has {0} bytes; at most {MAX_ROLE} are allowed")]
    TooLong(usize),
}

/// Reads the summary of a certificate.
///
/// # Errors
/// If the bytes are not one DER-encoded certificate.
pub(crate) fn read(der: &[u8]) -> der::Result<CertificateSummary> {
    let certificate = Certificate::from_der(der)?;
    let content = certificate.tbs_certificate();
    let validity = content.validity();
    let constraints = extension::<BasicConstraints>(content);
    let usages = extension::<ExtendedKeyUsage>(content);
    Ok(CertificateSummary {
        name: subject_name(&certificate),
        not_before: validity.not_before.to_unix_duration().as_secs(),
        not_after: validity.not_after.to_unix_duration().as_secs(),
        role: role(content.extensions().map_or(&[], Vec::as_slice)),
        issuer: issuer_name(content.issuer()),
        self_issued: content.issuer() == content.subject(),
        is_old: content.version() != Version::V3,
        is_ca: constraints.is_some_and(|constraints| constraints.ca),
        key: KeyKind::of(content.subject_public_key_info()),
        names: extension::<SubjectAltName>(content).map_or_else(Vec::new, |names| shown(&names)),
        common_name: common_name(content.subject()),
        serves: usages.is_none_or(|usages| usages.0.iter().any(|use_| [SERVER_AUTH, ANY_USAGE].contains(use_))),
    })
}

/// What is wrong with a certificate of a file: its validity at `now`, and what `further` finds.
pub(super) fn problems(
    file: &Path,
    der: &CertificateDer<'_>,
    now: SystemTime,
    further: impl FnOnce(CertificateSummary, String) -> Option<Problem>,
) -> Vec<Problem> {
    let shown = file.display().to_string();
    let [first, second] = match read(der) {
        Ok(certificate) => [certificate.validity(&shown, now), further(certificate, shown)],
        Err(_) => [Some(Problem::NotACertificate(shown)), None],
    };
    first.into_iter().chain(second).collect()
}

impl CertificateSummary {
    /// The fault in the validity period.
    fn validity(&self, file: &str, now: SystemTime) -> Option<Problem> {
        let now = seconds(now);
        let (name, file, end) = (self.name.clone(), file.to_string(), date(self.not_after));
        if now > self.not_after {
            return Some(Problem::Expired { name, file, end });
        }
        if now < self.not_before {
            let begin = date(self.not_before);
            return Some(Problem::NotYetValid { name, file, begin });
        }
        let soon = self.not_after - now < SOON.as_secs();
        soon.then_some(Problem::ExpiresSoon { name, file, end })
    }

    /// A problem if signatures by the key of this certificate cannot be verified.
    pub(super) fn unsupported_key(self, file: String) -> Option<Problem> {
        (!self.key.verifies).then_some(Problem::UnsupportedCaKey {
            name: self.name,
            file,
            kind: self.key.name,
        })
    }

    /// Whether the certificate has no names (subjectAltName) but its common name is this host or address; other
    /// programs then compare the common name.
    pub(super) fn is_commonly_named(&self, host: &ServerName<'_>) -> bool {
        let Some(common) = self.common_name.as_deref().filter(|_| self.names.is_empty()) else {
            return false;
        };
        match host {
            ServerName::DnsName(host) => host.as_ref().eq_ignore_ascii_case(common),
            ServerName::IpAddress(host) => IpAddr::try_from(common).is_ok_and(|address| address == *host),
            _ => false,
        }
    }

    /// Whether the certificate is for a host or address, as far as its names show.
    pub(super) fn is_for(&self, host: &str) -> bool {
        let Ok(host_name) = ServerName::try_from(host) else {
            return false;
        };
        let fits = |name: &String| match name.strip_prefix("*.") {
            Some(domain) => host
                .split_once('.')
                .is_some_and(|(_, rest)| rest.eq_ignore_ascii_case(domain)),
            None => name.eq_ignore_ascii_case(host),
        };
        self.is_commonly_named(&host_name) || self.names.iter().any(fits)
    }

    /// The names that the certificate is valid for, as text.
    pub(super) fn shown_names(&self) -> String {
        match (self.names.as_slice(), &self.common_name) {
            ([], Some(common)) => format!("only the common name `{}`", printable(common)),
            ([], None) => "no host".to_string(),
            (names, _) => names
                .iter()
                .map(|name| format!("`{name}`"))
                .collect::<Vec<_>>()
                .join(", "),
        }
    }
}

/// The name of the certificate's subject for messages, printable.
pub(super) fn subject_name(certificate: &Certificate) -> String {
    let certificate = certificate.tbs_certificate();
    let bytes = certificate.serial_number().as_bytes();
    let serial = || format!("serial {}", hex::encode(bytes.get(..MAX_NAME / 2).unwrap_or(bytes)));
    common_name(certificate.subject()).map_or_else(serial, |name| printable(&name))
}

fn role(extensions: &[x509_cert::ext::Extension]) -> Result<Option<String>, RoleError> {
    let mut roles = extensions.iter().filter(|extension| extension.extn_id == ROLE);
    let Some(extension) = roles.next() else { return Ok(None) };
    if roles.next().is_some() {
        return Err(RoleError::Repeated);
    }
    let role = Utf8StringRef::from_der(extension.extn_value.as_bytes()).map_err(RoleError::Malformed)?;
    let role = role.as_str();
    if role.len() > MAX_ROLE {
        return Err(RoleError::TooLong(role.len()));
    }
    Ok(Some(role.to_string()))
}

/// The common name, unescaped, not for messages.
fn common_name(subject: &Name) -> Option<String> {
    let value = &subject.iter().find(|attribute| attribute.oid == COMMON_NAME)?.value;
    let is_text = matches!(value.tag(), Tag::Utf8String | Tag::PrintableString | Tag::Ia5String);
    is_text.then(|| String::from_utf8_lossy(value.value()).into_owned())
}

/// Makes a text printable for the log and the audit: without characters that could imitate another line or field.
pub(super) fn printable(text: &str) -> String {
    let safe = |c: char| {
        if c.is_alphanumeric() || " .-_@:/+".contains(c) {
            c
        } else {
            '?'
        }
    };
    text.chars().take(MAX_NAME).map(safe).collect()
}

fn extension<'a, T>(certificate: &'a TbsCertificate) -> Option<T>
where
    T: Decode<'a> + x509_cert::der::oid::AssociatedOid,
{
    // A repeated or malformed one is refused by who verifies.
    certificate.get_extension::<T>().ok().flatten().map(|(_, value)| value)
}

fn issuer_name(name: &Name) -> String {
    common_name(name).map_or_else(|| printable(&name.to_string()), |common| printable(&common))
}

fn shown(names: &SubjectAltName) -> Vec<String> {
    let shown = |name: &GeneralName| match name {
        GeneralName::DnsName(name) => Some(printable(name.as_str())),
        GeneralName::IpAddress(bytes) => match <[u8; 4]>::try_from(bytes.as_bytes()) {
            Ok(v4) => Some(std::net::Ipv4Addr::from(v4).to_string()),
            Err(_) => <[u8; 16]>::try_from(bytes.as_bytes())
                .ok()
                .map(|v6| std::net::Ipv6Addr::from(v6).to_string()),
        },
        _ => None,
    };
    names.0.iter().filter_map(shown).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const BOOLEAN: u8 = 0x01;
    const INTEGER: u8 = 0x02;
    const BITS: u8 = 0x03;
    const OCTETS: u8 = 0x04;
    const OID: u8 = 0x06;
    const UTF8: u8 = 0x0C;
    const PRINTABLE: u8 = 0x13;
    const IA5: u8 = 0x16;
    const UTC_TIME: u8 = 0x17;
    const GENERALIZED_TIME: u8 = 0x18;
    const SEQUENCE: u8 = 0x30;
    const SET: u8 = 0x31;
    const VERSION: u8 = 0xA0;
    const EXTENSIONS: u8 = 0xA3;

    fn element(tag: u8, content: &[u8]) -> Vec<u8> {
        let length = content.len();
        let head = match length {
            0..0x80 => vec![tag, length as u8],
            0x80..0x100 => vec![tag, 0x81, length as u8],
            _ => vec![tag, 0x82, (length >> 8) as u8, length as u8],
        };
        [head, content.to_vec()].concat()
    }

    fn sequence(parts: &[Vec<u8>]) -> Vec<u8> {
        element(SEQUENCE, &parts.concat())
    }

    fn certificate(subject: &[u8], extensions: &[Vec<u8>]) -> Vec<u8> {
        let validity = sequence(&[
            element(UTC_TIME, b"260101000000Z"),
            element(GENERALIZED_TIME, b"20520229120000Z"),
        ]);
        // ecdsa-with-SHA256; the key and the signature are empty.
        let algorithm = sequence(&[element(OID, &[0x2A, 0x86, 0x48, 0xCE, 0x3D, 4, 3, 2])]);
        let mut fields = vec![
            element(VERSION, &element(INTEGER, &[2])),
            element(INTEGER, &[0x0A, 0xBC]),
            algorithm.clone(),
            sequence(&[]),
            validity,
            subject.to_vec(),
            sequence(&[algorithm.clone(), element(BITS, &[0])]),
        ];
        if !extensions.is_empty() {
            fields.push(element(EXTENSIONS, &sequence(extensions)));
        }
        sequence(&[sequence(&fields), algorithm, element(BITS, &[0])])
    }

    fn name(tag: u8, text: &[u8]) -> Vec<u8> {
        let attribute =
            |oid: &[u8], tag, text: &[u8]| element(SET, &sequence(&[element(OID, oid), element(tag, text)]));
        sequence(&[
            attribute(&[0x55, 4, 10], UTF8, b"Works"),
            attribute(COMMON_NAME.as_bytes(), tag, text),
        ])
    }

    fn role(value: &[u8]) -> Vec<u8> {
        sequence(&[element(OID, ROLE.as_bytes()), element(OCTETS, value)])
    }

    fn role_of(extensions: &[Vec<u8>]) -> Result<Option<String>, RoleError> {
        read(&certificate(&name(PRINTABLE, b"x"), extensions)).unwrap().role
    }

    #[test]
    fn subject_validity_and_role() {
        let usage = sequence(&[
            element(OID, &[0x55, 0x1D, 0x0F]),
            element(BOOLEAN, &[0xFF]),
            element(OCTETS, &[3]),
        ]);
        let operator = role(&element(UTF8, b"operator"));
        let summary = read(&certificate(&name(UTF8, "hmi 1".as_bytes()), &[usage, operator])).unwrap();
        assert_eq!(summary.name, "hmi 1");
        assert_eq!(summary.role, Ok(Some("operator".to_string())));
        // `date -u -d 2026-01-01 +%s`, `date -u -d '2052-02-29 12:00' +%s`
        assert_eq!((summary.not_before, summary.not_after), (1_767_225_600, 2_592_820_800));
        assert_eq!(role_of(&[]), Ok(None));
    }

    #[test]
    fn a_role_is_one_utf8_string() {
        let operator = element(UTF8, b"operator");
        for value in [
            &b"operator"[..],
            &[],
            &element(PRINTABLE, b"operator"),
            &element(IA5, b"operator"),
            &element(OCTETS, b"operator"),
            &element(UTF8, &[0xFF]),
            // The length is too long, not minimal, or indefinite.
            &[UTF8, 9, b'o', b'p'],
            &[&[UTF8, 0x81, 8][..], b"operator"].concat(),
            &[&[UTF8, 0x80][..], b"operator", &[0, 0]].concat(),
            // Another byte, or a second role, follows the role.
            &[&operator[..], &[0]].concat(),
            &[&operator[..], &operator[..]].concat(),
            &sequence(&[operator.clone(), element(UTF8, b"viewer")]),
        ] {
            let role = role_of(&[role(value)]);
            assert!(matches!(role, Err(RoleError::Malformed(_))), "{value:02X?}: {role:?}");
        }
    }

    #[test]
    fn several_role_extensions_are_refused_even_when_they_agree() {
        let [operator, viewer] = [&b"operator"[..], b"viewer"].map(|text| role(&element(UTF8, text)));
        for extensions in [
            [operator.clone(), viewer.clone()],
            [viewer, operator.clone()],
            [operator.clone(), operator],
        ] {
            assert_eq!(role_of(&extensions), Err(RoleError::Repeated));
        }
    }

    #[test]
    fn long_roles() {
        let of = |length: usize| role_of(&[role(&element(UTF8, &vec![b'r'; length]))]);
        assert_eq!(of(MAX_ROLE), Ok(Some("r".repeat(MAX_ROLE))));
        assert_eq!(of(MAX_ROLE + 1), Err(RoleError::TooLong(MAX_ROLE + 1)));
        assert_eq!(of(60_000), Err(RoleError::TooLong(60_000)));
    }

    #[test]
    fn a_certificate_is_complete_and_nothing_follows() {
        let whole = certificate(&name(UTF8, b"hmi"), &[role(&element(UTF8, b"operator"))]);
        assert!(read(&whole).is_ok());
        for length in 0..whole.len() {
            assert!(read(&whole[..length]).is_err(), "{length} bytes");
        }
        assert!(read(&[whole, vec![0]].concat()).is_err());
    }

    #[test]
    fn names_cannot_forge_log_lines() {
        let long = "x".repeat(500);
        for (text, shown) in [
            ("a\nb\" who=root", "a?b? who?root"),
            ("Müller", "Müller"),
            (&long, &long[..MAX_NAME]),
        ] {
            assert_eq!(
                read(&certificate(&name(UTF8, text.as_bytes()), &[])).unwrap().name,
                shown
            );
        }
        let nameless = read(&certificate(&sequence(&[]), &[])).unwrap();
        assert_eq!(nameless.name, "serial 0abc");
    }

    proptest! {
        #[test]
        fn any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let _ = read(&bytes);
        }

        #[test]
        fn a_bad_byte(place in 0usize..400, byte: u8) {
            let mut der = certificate(&name(UTF8, b"hmi"), &[role(&element(UTF8, b"operator"))]);
            let place = place % der.len();
            der[place] = byte;
            let _ = read(&der);
        }
    }
}
