//! The users who may command over HTTP: the users file, and the check of passwords.
//!
//! Passwords are chosen by people, so the file contains Argon2id hashes: each guess costs time and memory.

use std::fmt;
use std::str::FromStr;

use argon2::password_hash::{self, Output, PasswordHash, PasswordHasher, SaltString};
use argon2::{Algorithm, Argon2, Block, Params, Version};
use ring::rand::{SecureRandom, SystemRandom};

use super::credentials::{Credential, CredentialError, Credentials, checked_name};

/// Memory of a hash, KiB: even a small board has 12 MiB, and one hash is computed at a time.
const MEMORY: u32 = 12 * 1024;
/// Passes of Argon2id over its memory. With this memory, three is the least that OWASP recommends.
const PASSES: u32 = 3;
/// Maximum cost of a hash in the file: memory in KiB, passes and lanes. A higher cost would let a file stall the gateway.
const MOST_COST: (u32, u32, u32) = (64 * 1024, 16, 4);
/// Length of a salt in bytes.
const SALT: usize = 16;
/// Beginning of the hash of a new user.
const COST: &str = "$argon2id$v=19$m=12288,t=3,p=1$";
/// Salt and hash verified for unknown users, so timing reveals nothing.
const NOBODY: &str = "bm9ib2R5bm9ib2R5bm9ibw$0000000000000000000000000000000000000000000";
/// Minimum number of characters of a password.
pub const MIN_PASSWORD: usize = 10;
/// Maximum number of bytes of a password.
pub const MAX_PASSWORD: usize = 256;
/// The fields of a line, for error messages.
const FORM: CredentialError = CredentialError::Form("name hash");
const NOT_A_HASH: CredentialError = CredentialError::Hash("one of Argon2id with at most 64 MiB, 16 passes and 4 lanes");

/// A line of the file. Displayed as that line.
#[derive(Clone, PartialEq, Eq)]
pub struct User {
    /// Name of the user, unique in the file.
    pub name: String,
    /// The password hash in PHC string format, with salt and parameters.
    hash: String,
}

impl User {
    /// A user with that password, whose hash has a new salt.
    ///
    /// # Errors
    /// If the name is not valid, the password is too short or too long, or the system has no random numbers.
    pub fn new(name: &str, password: &str) -> Result<User, CredentialError> {
        let long_enough = password.chars().count() >= MIN_PASSWORD && password.len() <= MAX_PASSWORD;
        if !long_enough || password.chars().any(char::is_control) {
            return Err(CredentialError::Password);
        }
        let mut salt = [0; SALT];
        SystemRandom::new()
            .fill(&mut salt)
            .map_err(|_| CredentialError::Random)?;
        let salt = SaltString::encode_b64(&salt).map_err(|_| NOT_A_HASH)?;
        let params = Params::new(MEMORY, PASSES, 1, None).map_err(|_| NOT_A_HASH)?;
        let argon2 = Argon2::new(Algorithm::Argon2id, Version::V0x13, params);
        let hash = argon2.hash_password(password.as_bytes(), &salt);
        Ok(User {
            name: checked_name(name)?,
            hash: hash.map_err(|_| NOT_A_HASH)?.to_string(),
        })
    }

    /// The hash string, which also contains function, version, parameters and salt.
    pub(super) fn hash(&self) -> &str {
        &self.hash
    }
}

/// The memory in which passwords are compared one after the other. It is allocated once, because the allocator
/// would keep each freed block.
#[derive(Debug, Default)]
pub(super) struct Workspace(Vec<Block>);

impl Workspace {
    /// Whether the password matches this hash. Takes the same time for any password.
    pub(super) fn is_password(&mut self, hash: &str, password: &str) -> bool {
        let found = PasswordHash::new(hash).and_then(|hash| self.compute(&hash, password).map(|own| hash.hash == own));
        found.unwrap_or(false)
    }

    /// Computes `hash` for this password; `None` if the hash is incomplete.
    fn compute(&mut self, hash: &PasswordHash<'_>, password: &str) -> password_hash::Result<Option<Output>> {
        let (Some(salt), Some(length)) = (hash.salt, hash.hash.map(|own| own.len())) else {
            return Err(password_hash::Error::PhcStringField);
        };
        let (algorithm, params) = (Algorithm::try_from(hash.algorithm)?, Params::try_from(hash)?);
        let version = hash.version.map_or(Ok(Version::V0x13), Version::try_from)?;
        let mut bytes = [0; 64];
        let salt = salt.decode_b64(&mut bytes)?;
        let blocks = params.block_count();
        if self.0.len() < blocks {
            self.0 = vec![Block::default(); blocks];
        }
        let memory = self.0.get_mut(..blocks).unwrap_or_default();
        let argon2 = Argon2::new(algorithm, version, params);
        Output::init_with(length, |out| {
            Ok(argon2.hash_password_into_with_memory(password.as_bytes(), salt, out, memory)?)
        })
        .map(Some)
    }
}

/// The part of a hash that determines the cost of computing it: name, version and parameters of the function.
fn cost(hash: &str) -> &str {
    let end = hash.match_indices('$').nth(3).map(|(at, _)| at);
    end.and_then(|end| hash.get(..=end)).unwrap_or_default()
}

/// Whether the gateway can afford to compute this hash.
fn is_affordable(hash: &str) -> bool {
    let Ok(hash) = PasswordHash::new(hash) else {
        return false;
    };
    let (memory, passes, lanes) = MOST_COST;
    let fits = |p: Params| p.m_cost() <= memory && p.t_cost() <= passes && p.p_cost() <= lanes;
    let complete = hash.salt.is_some() && hash.hash.is_some();
    complete && hash.algorithm == Algorithm::Argon2id.ident() && Params::try_from(&hash).is_ok_and(fits)
}

impl fmt::Debug for User {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("User").field(&self.name).finish()
    }
}

impl fmt::Display for User {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.name, self.hash)
    }
}

impl FromStr for User {
    type Err = CredentialError;

    fn from_str(line: &str) -> Result<User, CredentialError> {
        let mut words = line.split_whitespace();
        let (Some(name), Some(hash), None) = (words.next(), words.next(), words.next()) else {
            return Err(FORM);
        };
        if is_affordable(hash) {
            Ok(User {
                name: checked_name(name)?,
                hash: hash.to_string(),
            })
        } else {
            Err(NOT_A_HASH)
        }
    }
}

impl Credential for User {
    const KIND: &'static str = "user";
    const MOST_ENTRIES: usize = 100;

    fn name(&self) -> &str {
        &self.name
    }
}

/// All users of a file.
pub type Users = Credentials<User>;

impl Users {
    /// The hash that the password of this user must match, if there is such a user, and hashes of unknown
    /// passwords: in total one for each cost that occurs in the file. So the comparison takes the same time for
    /// every name, known or unknown.
    pub(super) fn hashes(&self, name: &str) -> (Option<&str>, Vec<String>) {
        let own = self.named(name).map(User::hash);
        let mut costs: Vec<&str> = self.0.iter().map(|user| cost(user.hash())).collect();
        if costs.is_empty() {
            costs.push(COST);
        }
        costs.sort_unstable();
        costs.dedup();
        costs.retain(|other| own.is_none_or(|own| cost(own) != *other));
        (own, costs.into_iter().map(|cost| format!("{cost}{NOBODY}")).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn is_password(hash: &str, password: &str) -> bool {
        Workspace::default().is_password(hash, password)
    }

    /// The test vector of the reference implementation: Argon2id, 64 MiB, 2 passes, "password", "somesalt".
    const FOREIGN: &str = "$argon2id$v=19$m=65536,t=2,p=1$c29tZXNhbHQ$CTFhFdXPJO1aFaMaO6Mm5c8y7cJHAph8ArZWb2GRPPc";

    #[test]
    fn the_hash_is_that_of_other_programs() {
        let users = Users::parse(&format!("# users\n\nalice {FOREIGN}\r\n")).unwrap();
        let alice = users.named("alice").unwrap();
        assert!(is_password(alice.hash(), "password"));
        assert!(!is_password(alice.hash(), "Password") && !is_password(alice.hash(), ""));
    }

    #[test]
    fn a_new_user_is_found_again_and_the_file_has_no_password() {
        let one = User::new("alice", "correct horse").unwrap();
        let two = User::new("bob", "correct horse").unwrap();
        assert_ne!(one.hash(), two.hash(), "each has a salt of its own");
        let text = format!("{one}\n{two}\n");
        assert!(!text.contains("horse") && text.contains("$argon2id$v=19$m=12288,t=3,p=1$"));
        assert!(!format!("{one:?}").contains("argon2"), "hashes do not get into logs");
        let users = Users::parse(&text).unwrap();
        assert!(is_password(users.named("bob").unwrap().hash(), "correct horse"));
        assert!(!is_password(users.named("bob").unwrap().hash(), "correct horse "));
        assert!(users.named("carol").is_none());
        for (name, password, error) in [
            ("alice", "too short", CredentialError::Password),
            ("alice", "ten\ncharacters", CredentialError::Password),
            ("alice", &*"x".repeat(MAX_PASSWORD + 1), CredentialError::Password),
            ("a b", "correct horse", CredentialError::Name("a b".to_string())),
        ] {
            assert_eq!(User::new(name, password), Err(error), "{name} {password}");
        }
    }

    #[test]
    fn every_name_costs_the_same() {
        let with = |parameters: &str| FOREIGN.replace("m=65536,t=2,p=1", parameters);
        let [cheap, other] = ["m=64,t=1,p=1", "m=128,t=2,p=1"].map(with);
        let text = format!("alice {FOREIGN}\nbob {cheap}\ncarol {other}\ndave {cheap}\n");
        let users = Users::parse(&text).unwrap();
        let costs = |name: &str| {
            let (own, others) = users.hashes(name);
            assert!(
                others
                    .iter()
                    .all(|hash| is_affordable(hash) && !is_password(hash, "password"))
            );
            let all = own.into_iter().chain(others.iter().map(String::as_str));
            let mut costs: Vec<String> = all.map(|hash| cost(hash).to_string()).collect();
            costs.sort();
            costs
        };
        let nobody = costs("nobody");
        assert_eq!(nobody.len(), 3, "one of each: {nobody:?}");
        for known in ["alice", "bob", "carol", "dave"] {
            assert_eq!(costs(known), nobody, "{known}");
            assert!(is_password(users.hashes(known).0.unwrap(), "password") == (known == "alice"));
        }
        let none = Users::default();
        let (own, others) = none.hashes("nobody");
        let [only] = &others[..] else { panic!("{others:?}") };
        let new = User::new("alice", "correct horse").unwrap();
        assert_eq!(
            (own, cost(only)),
            (None, cost(new.hash())),
            "also while there is no user"
        );
    }

    #[test]
    fn bad_lines() {
        let with = |parameters: &str| FOREIGN.replace("m=65536,t=2,p=1", parameters);
        for (text, line, error) in [
            ("alice".to_string(), 1, FORM),
            (format!("alice {FOREIGN} x"), 1, FORM),
            (format!("#\na/b {FOREIGN}"), 2, CredentialError::Name("a/b".to_string())),
            (format!("alice {}", &FOREIGN[1..]), 1, NOT_A_HASH),
            (
                format!("alice {}", FOREIGN.replace("argon2id", "argon2i")),
                1,
                NOT_A_HASH,
            ),
            (format!("alice {}", FOREIGN.rsplit_once('$').unwrap().0), 1, NOT_A_HASH),
            (format!("alice {}", with("m=65537,t=2,p=1")), 1, NOT_A_HASH),
            (format!("alice {}", with("m=4294967295,t=2,p=1")), 1, NOT_A_HASH),
            (format!("alice {}", with("m=64,t=17,p=1")), 1, NOT_A_HASH),
            (format!("alice {}", with("m=64,t=1,p=5")), 1, NOT_A_HASH),
            ("alice password".to_string(), 1, NOT_A_HASH),
            (
                format!("alice {FOREIGN}\nalice {FOREIGN}"),
                2,
                CredentialError::Repeated("user", "alice".to_string()),
            ),
        ] {
            assert_eq!(Users::parse(&text), Err((line, error)), "{text}");
        }
        const MOST_ENTRIES: usize = User::MOST_ENTRIES;
        let many: String = (0..=MOST_ENTRIES).map(|i| format!("u{i} {FOREIGN}\n")).collect();
        assert_eq!(
            Users::parse(&many),
            Err((MOST_ENTRIES + 1, CredentialError::Many("user", MOST_ENTRIES)))
        );
    }

    proptest! {
        #[test]
        fn any_text(text in "\\PC{0,200}") {
            let _ = Users::parse(&text);
        }
    }
}
