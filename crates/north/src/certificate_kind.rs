//! The properties that decide whether a certificate is accepted, in addition to its signature: version, key, names,
//! usages. For checks before a connection and messages after failed ones.

use rustls_pki_types::{IpAddr, ServerName};
use x509_cert::certificate::{Certificate, TbsCertificate, Version};
use x509_cert::der::asn1::{AnyRef, ObjectIdentifier, UintRef};
use x509_cert::der::{self, Decode, Reader, SliceReader};
use x509_cert::ext::pkix::name::GeneralName;
use x509_cert::ext::pkix::{BasicConstraints, ExtendedKeyUsage, SubjectAltName};
use x509_cert::name::Name;
use x509_cert::spki::SubjectPublicKeyInfoOwned;

use super::certificate::{common_name, printable, subject_name};

/// Sizes of RSA keys, in bits: keys with which signatures are verified, and keys with which the gateway can sign.
const RSA_VERIFY: std::ops::RangeInclusive<usize> = 2048..=8192;
const RSA_SIGN: std::ops::RangeInclusive<usize> = 2048..=4096;
/// Supported kinds of keys, for messages.
pub(super) const SUPPORTED_KEYS: &str = "P-256, P-384, Ed25519 or RSA with 2048 to 4096 bits";
const SERVER_AUTH: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.3.6.1.5.5.7.3.1");
const ANY_USAGE: ObjectIdentifier = ObjectIdentifier::new_unwrap("2.5.29.37.0");
const EC_KEY: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.2.840.10045.2.1");
const RSA_KEY: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.2.840.113549.1.1.1");

/// Names of keys and signatures, by object identifier, and whether such a key is supported.
const ALGORITHMS: [(&str, &str, bool); 17] = [
    ("1.2.840.10045.3.1.7", "P-256", true),
    ("1.3.132.0.34", "P-384", true),
    ("1.3.132.0.35", "P-521", false),
    ("1.3.132.0.33", "P-224", false),
    ("1.3.132.0.10", "secp256k1", false),
    ("1.3.36.3.3.2.8.1.1.7", "brainpoolP256r1", false),
    ("1.3.36.3.3.2.8.1.1.11", "brainpoolP384r1", false),
    ("1.3.36.3.3.2.8.1.1.13", "brainpoolP512r1", false),
    ("1.3.101.112", "Ed25519", true),
    ("1.3.101.113", "Ed448", false),
    ("1.2.840.10040.4.1", "DSA", false),
    ("1.2.840.113549.1.1.4", "RSA with MD5", false),
    ("1.2.840.113549.1.1.5", "RSA with SHA-1", false),
    ("1.2.840.10045.4.1", "ECDSA with SHA-1", false),
    ("1.2.840.10045.4.3.1", "ECDSA with SHA-224", false),
    ("1.2.840.10045.4.3.4", "ECDSA with SHA-512", false),
    ("1.2.840.113549.1.1.1", "RSA", true),
];

/// The kind of a certificate.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Kind {
    /// Subject of the certificate, for messages.
    pub(super) name: String,
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

/// The kind and strength of a public key.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct KeyKind {
    /// Name of the key type, such as `P-521`, `RSA with 1024 bits`.
    pub(super) name: String,
    /// Whether the gateway can verify a peer with such a key.
    pub(super) verifies: bool,
    /// Whether the gateway can use a key of this kind as its own.
    pub(super) signs: bool,
}

impl Kind {
    /// Reads a certificate; `None` if the bytes are not a certificate.
    pub(super) fn of(certificate: &[u8]) -> Option<Kind> {
        let certificate = Certificate::from_der(certificate).ok()?;
        let content = certificate.tbs_certificate();
        let constraints = extension::<BasicConstraints>(content);
        let usages = extension::<ExtendedKeyUsage>(content);
        Some(Kind {
            name: subject_name(&certificate),
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

impl KeyKind {
    fn of(key: &SubjectPublicKeyInfoOwned) -> KeyKind {
        let algorithm = key.algorithm.oid;
        if algorithm == RSA_KEY {
            let bits = key.subject_public_key.as_bytes().and_then(modulus_bits).unwrap_or(0);
            return KeyKind {
                name: format!("RSA with {bits} bits"),
                verifies: RSA_VERIFY.contains(&bits),
                signs: RSA_SIGN.contains(&bits),
            };
        }
        let curve = || key.algorithm.parameters.as_ref()?.decode_as::<ObjectIdentifier>().ok();
        let is_curve = algorithm == EC_KEY;
        let told = if is_curve {
            curve().unwrap_or(algorithm)
        } else {
            algorithm
        };
        let (name, known) = describe(told);
        KeyKind {
            name,
            verifies: known,
            signs: known,
        }
    }
}

/// Name of the signature or key algorithm with this identifier.
pub(super) fn algorithm(identifier: &[u8]) -> String {
    let read = |reader: &mut SliceReader<'_>| {
        let first = ObjectIdentifier::decode(reader)?;
        // The parameters of a key on a curve are that curve.
        let second = ObjectIdentifier::decode(reader).ok();
        Ok::<_, der::Error>(second.filter(|_| first == EC_KEY).unwrap_or(first))
    };
    let told = SliceReader::new(identifier).and_then(|mut reader| read(&mut reader));
    told.map_or_else(|_| "an unknown algorithm".to_string(), |told| describe(told).0)
}

fn describe(identifier: ObjectIdentifier) -> (String, bool) {
    let dotted = identifier.to_string();
    let known = ALGORITHMS.iter().find(|(id, ..)| *id == dotted);
    known.map_or((dotted, false), |(_, name, supported)| (name.to_string(), *supported))
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

fn modulus_bits(key: &[u8]) -> Option<usize> {
    let mut reader = SliceReader::new(key).ok()?;
    let bits = reader.sequence(|inner| {
        let modulus = UintRef::decode(inner)?;
        AnyRef::decode(inner)?;
        let bytes = modulus.as_bytes();
        let zeros = bytes.first().map_or(0, |first| first.leading_zeros() as usize);
        Ok::<_, der::Error>((bytes.len() * 8).saturating_sub(zeros))
    });
    bits.ok()
}
