//! The common part of token and user files: one entry per line, each with a unique name.

use std::str::FromStr;

/// A token or a user. Its `Display` form is its line in the file.
pub trait Credential: FromStr<Err = CredentialError> + std::fmt::Display {
    /// Kind of credential: `token` or `user`.
    const KIND: &'static str;
    /// Maximum number of entries of a file, more than any plant needs.
    const MOST_ENTRIES: usize;

    /// Name of the credential, unique in the file.
    fn name(&self) -> &str;
}

/// Why a line is not a valid token or user, or why none can be created.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CredentialError {
    /// The words do not have the required form.
    #[error("not `{0}`")]
    Form(&'static str),
    /// A name of other characters, or a long one.
    #[error("`{0}` is not a name of at most 64 letters, digits, `-`, `_` and `.`")]
    Name(String),
    /// The name is also used by another line.
    #[error("there are two {0}s named `{1}`")]
    Repeated(&'static str, String),
    /// The scope does not exist.
    #[error("`{0}` is not a scope; use read, metrics or control")]
    Scope(String),
    /// The hash is not of the kind in the text.
    #[error("the hash is not {0}")]
    Hash(&'static str),
    /// The file has more lines than any plant needs.
    #[error("there are more than {1} {0}s")]
    Many(&'static str, usize),
    /// A password that is easily guessed, or no text.
    #[error(
        "a password must have at least {} characters, at most {} bytes and no control characters",
        super::MIN_PASSWORD,
        super::MAX_PASSWORD
    )]
    Password,
    /// The system does not provide random bytes.
    #[error("the system provides no random numbers")]
    Random,
}

/// The tokens or users of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Credentials<C>(pub(super) Vec<C>);

impl<C> Default for Credentials<C> {
    fn default() -> Credentials<C> {
        Credentials(Vec::new())
    }
}

impl<C: Credential> Credentials<C> {
    /// Reads the text of a file; empty lines and lines that begin with `#` are ignored.
    ///
    /// # Errors
    /// If a line is invalid: contains the number of the first such line, counted from 1, and the reason.
    pub fn parse(text: &str) -> Result<Credentials<C>, (usize, CredentialError)> {
        let mut all = Credentials(Vec::new());
        let lines = (1..).zip(text.lines().map(str::trim));
        for (line, text) in lines.filter(|(_, text)| !text.is_empty() && !text.starts_with('#')) {
            let one: C = text.parse().map_err(|error| (line, error))?;
            if all.named(one.name()).is_some() {
                return Err((line, CredentialError::Repeated(C::KIND, one.name().to_string())));
            }
            if all.0.len() >= C::MOST_ENTRIES {
                return Err((line, CredentialError::Many(C::KIND, C::MOST_ENTRIES)));
            }
            all.0.push(one);
        }
        Ok(all)
    }

    /// All tokens or users, in the order of the file.
    pub fn list(&self) -> &[C] {
        &self.0
    }

    pub fn named(&self, name: &str) -> Option<&C> {
        self.0.iter().find(|one| one.name() == name)
    }
}

/// A name that a token or a user can have.
pub(super) fn checked_name(name: &str) -> Result<String, CredentialError> {
    let sound = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
    if !name.is_empty() && name.len() <= 64 && name.chars().all(sound) {
        Ok(name.to_string())
    } else {
        Err(CredentialError::Name(name.chars().take(64).collect()))
    }
}
