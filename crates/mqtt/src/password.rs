//! The password of the client: a fixed one, or that of a file, which is read for each connection, so that a token that
//! another program renews is used without a restart.

use std::fmt;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

/// Maximum number of bytes of a secret: a longer file cannot be a password.
const LONGEST: u64 = 16 << 10;

/// A secret that is not printed in logs.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret(pub String);

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("(secret)")
    }
}

/// Source of the password.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Password {
    /// The password from the configuration.
    Fixed(Secret),
    /// The only line of this file is the password.
    File(PathBuf),
}

/// Why a file contains no usable secret.
#[derive(Debug, thiserror::Error)]
pub enum SecretFault {
    /// The file cannot be read.
    #[error("it cannot be read: {0}")]
    Unreadable(#[from] io::Error),
    /// The file has no text.
    #[error("it is empty")]
    Empty,
    /// The file has more than one line.
    #[error("it is not a password: it has several lines")]
    Lines,
}

impl Secret {
    /// Reads the only line of a file.
    ///
    /// # Errors
    /// If the file cannot be read, is empty, or has several lines.
    pub fn read(path: &Path) -> Result<Secret, SecretFault> {
        let mut text = String::new();
        File::open(path)?.take(LONGEST).read_to_string(&mut text)?;
        let line = text.lines().next().unwrap_or_default();
        if line.is_empty() {
            return Err(SecretFault::Empty);
        }
        if text.trim_end_matches(['\r', '\n']).contains('\n') || text.len() as u64 == LONGEST {
            return Err(SecretFault::Lines);
        }
        Ok(Secret(line.to_string()))
    }
}

impl Password {
    /// The present password.
    ///
    /// # Errors
    /// If the password file contains no usable secret; contains the reason with the path of the file.
    pub(super) fn read(&self) -> Result<Secret, String> {
        match self {
            Password::Fixed(secret) => Ok(secret.clone()),
            Password::File(path) => {
                Secret::read(path).map_err(|why| format!("password_file {}: {why}", path.display()))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_text_that_the_file_has_now() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("token");
        let password = Password::File(path.clone());
        assert!(password.read().unwrap_err().contains("token: it cannot be read"));
        for (text, expected) in [
            ("one\n", Ok("one")),
            ("two", Ok("two")),
            ("", Err("it is empty")),
            ("a\nb\n", Err("several lines")),
        ] {
            std::fs::write(&path, text).unwrap();
            match (password.read(), expected) {
                (Ok(secret), Ok(expected)) => assert_eq!(secret.0, expected),
                (Err(why), Err(expected)) => assert!(why.contains(expected), "{why}"),
                (found, expected) => panic!("{found:?}, {expected:?}"),
            }
        }
        assert_eq!(format!("{:?}", Password::Fixed(Secret("x".into()))), "Fixed((secret))");
    }
}
