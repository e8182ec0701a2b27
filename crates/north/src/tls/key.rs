//! The kind and strength of public keys, and the names of their algorithms.

use x509_cert::der::asn1::{AnyRef, ObjectIdentifier, UintRef};
use x509_cert::der::{self, Decode, Reader, SliceReader};
use x509_cert::spki::SubjectPublicKeyInfoOwned;

/// Sizes of RSA keys, in bits: keys with which signatures are verified, and keys with which the gateway can sign.
const RSA_VERIFY: std::ops::RangeInclusive<usize> = 2048..=8192;
const RSA_SIGN: std::ops::RangeInclusive<usize> = 2048..=4096;
/// Supported kinds of keys, for messages.
pub(super) const SUPPORTED_KEYS: &str = "P-256, P-384, Ed25519 or RSA with 2048 to 4096 bits";
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

impl KeyKind {
    pub(super) fn of(key: &SubjectPublicKeyInfoOwned) -> KeyKind {
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
