//! Access tokens of the HTTP server: the token file, and checking tokens.
//!
//! A token is 256 random bits, so its SHA-256 can be neither inverted nor guessed, and the file contains no secret.
//! Argon2 and similar functions are for passwords, which people choose.

use std::fmt;
use std::str::FromStr;

use ring::digest::{SHA256, digest};
use ring::rand::{SecureRandom, SystemRandom};
use subtle::ConstantTimeEq;

use super::credentials::{Credential, CredentialError, Credentials, checked_name};
use drivegate_core::hex;

/// Length of a token and of its hash, bytes.
const BYTES: usize = 32;
/// Prefix of a hash in the file.
const ALGORITHM: &str = "sha256:";
/// The fields of a line, for error messages.
const FORM: CredentialError = CredentialError::Form("name scopes hash");
const NOT_A_HASH: CredentialError = CredentialError::Hash("`sha256:` and 64 hexadecimal digits");

/// A permission of a token.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scope {
    /// The status page and the JSON interface.
    Read,
    /// Access to `/metrics`.
    Metrics,
    /// Grants nothing at present: only users can give commands, because they have names.
    Control,
}

impl Scope {
    pub const ALL: [Scope; 3] = [Scope::Read, Scope::Metrics, Scope::Control];

    /// Name of the scope in the file.
    pub fn name(self) -> &'static str {
        match self {
            Scope::Read => "read",
            Scope::Metrics => "metrics",
            Scope::Control => "control",
        }
    }
}

impl FromStr for Scope {
    type Err = CredentialError;

    fn from_str(text: &str) -> Result<Scope, CredentialError> {
        let known = Scope::ALL.into_iter().find(|scope| scope.name() == text);
        known.ok_or_else(|| CredentialError::Scope(text.to_string()))
    }
}

/// A line of the file. Displayed as that line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Token {
    /// Name of the token, unique in the file.
    pub name: String,
    /// Scopes of the token, at least one.
    pub scopes: Vec<Scope>,
    hash: [u8; BYTES],
}

impl Token {
    /// A new token, and the secret that its bearer sends: 64 hexadecimal digits, stored nowhere.
    ///
    /// # Errors
    /// If the name is not valid, or the system has no random numbers.
    pub fn generate(name: &str, scopes: Vec<Scope>) -> Result<(Token, String), CredentialError> {
        let mut bytes = [0; BYTES];
        SystemRandom::new()
            .fill(&mut bytes)
            .map_err(|_| CredentialError::Random)?;
        let secret = hex::encode(&bytes);
        let token = Token {
            name: checked_name(name)?,
            scopes,
            hash: hash(&secret),
        };
        Ok((token, secret))
    }
}

impl fmt::Display for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let scopes: Vec<&str> = self.scopes.iter().map(|scope| scope.name()).collect();
        write!(
            f,
            "{} {} {ALGORITHM}{}",
            self.name,
            scopes.join(","),
            hex::encode(&self.hash)
        )
    }
}

impl FromStr for Token {
    type Err = CredentialError;

    fn from_str(line: &str) -> Result<Token, CredentialError> {
        let mut words = line.split_whitespace();
        let (Some(name), Some(scopes), Some(hash), None) = (words.next(), words.next(), words.next(), words.next())
        else {
            return Err(FORM);
        };
        let hash = hash.strip_prefix(ALGORITHM).and_then(hex::decode);
        let hash = hash.and_then(|bytes| bytes.try_into().ok());
        Ok(Token {
            name: checked_name(name)?,
            scopes: scopes.split(',').map(str::parse).collect::<Result<_, _>>()?,
            hash: hash.ok_or(NOT_A_HASH)?,
        })
    }
}

impl Credential for Token {
    const KIND: &'static str = "token";
    const MOST_ENTRIES: usize = 1000;

    fn name(&self) -> &str {
        &self.name
    }
}

/// All tokens of a file.
pub type Tokens = Credentials<Token>;

impl Tokens {
    /// The token with this secret. The time of the search depends only on the number of tokens.
    pub(super) fn find(&self, secret: &str) -> Option<&Token> {
        let hash = hash(secret);
        let mut found = None;
        for token in &self.0 {
            if bool::from(token.hash.ct_eq(&hash)) {
                found = Some(token);
            }
        }
        found
    }
}

/// The SHA-256 of a secret.
pub(super) fn hash(secret: &str) -> [u8; BYTES] {
    let digest = digest(&SHA256, secret.as_bytes());
    // The conversion cannot fail: digest and hash both have the length of a SHA-256.
    digest.as_ref().try_into().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_hash_is_that_of_other_programs() {
        // printf %s open-sesame | sha256sum
        let line = "op read sha256:d7ecdf25eaf3deba0f2628771dbdd22d4138ab6cf38f91ed02a2ca0dec7c8ab7";
        let tokens = Tokens::parse(line).unwrap();
        assert_eq!(tokens.find("open-sesame").map(|token| token.name.as_str()), Some("op"));
        for wrong in ["open-sesam", "open-sesame ", "Open-sesame", "", line] {
            assert_eq!(tokens.find(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn a_generated_token_is_found_again() {
        let (one, secret) = Token::generate("grafana", vec![Scope::Metrics, Scope::Read]).unwrap();
        let (two, other) = Token::generate("hmi", vec![Scope::Read]).unwrap();
        assert!(secret != other && secret.len() == 64);
        let text = format!("# tokens\n\n{one}\r\n  {two}\n");
        assert!(!text.contains(&secret), "the file holds no secret");
        let tokens = Tokens::parse(&text).unwrap();
        assert_eq!(tokens.list(), [one, two.clone()]);
        assert_eq!(tokens.find(&other), Some(&two));
        assert!(Token::generate("a b", vec![]).is_err());
    }

    #[test]
    fn bad_lines() {
        let hash = format!("sha256:{}", "0".repeat(64));
        for (text, line, error) in [
            ("a read".to_string(), 1, FORM),
            (format!("a read {hash} x"), 1, FORM),
            (format!("a read write {hash}"), 1, FORM),
            (
                format!("#\na/b read {hash}"),
                2,
                CredentialError::Name("a/b".to_string()),
            ),
            (
                format!("a write {hash}"),
                1,
                CredentialError::Scope("write".to_string()),
            ),
            (format!("a read, {hash}"), 1, CredentialError::Scope(String::new())),
            (format!("a read {}", &hash[7..]), 1, NOT_A_HASH),
            (format!("a read {hash}0"), 1, NOT_A_HASH),
            (format!("a read sha256:{}", "ä".repeat(32)), 1, NOT_A_HASH),
            (
                format!("a read {hash}\na metrics {hash}"),
                2,
                CredentialError::Repeated("token", "a".to_string()),
            ),
        ] {
            assert_eq!(Tokens::parse(&text), Err((line, error)), "{text}");
        }
        const MOST_ENTRIES: usize = Token::MOST_ENTRIES;
        let many: String = (0..=MOST_ENTRIES).map(|i| format!("t{i} read {hash}\n")).collect();
        assert_eq!(
            Tokens::parse(&many),
            Err((MOST_ENTRIES + 1, CredentialError::Many("token", MOST_ENTRIES)))
        );
    }

    proptest! {
        #[test]
        fn any_text(text in "\\PC{0,200}") {
            let _ = Tokens::parse(&text);
        }
    }
}
