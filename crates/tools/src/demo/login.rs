//! The login of the demo: a user of its page whose password is created at each start and is only valid on this machine.

use std::path::{Path, PathBuf};

use super::super::credentials_file::CredentialsFile;
use drivegate_http::{Scope, Token, User};

/// Number of characters of the password.
const LENGTH: usize = 12;

/// The user who may command the drives of the demo from its page.
#[derive(Debug)]
pub(super) struct Login {
    /// The password of the login.
    pub(super) password: String,
    /// The users file with a hash of the password.
    pub(super) file: PathBuf,
}

impl Login {
    /// Name of the user.
    pub(super) const USER: &'static str = "operator";

    /// Writes the user with a new password into the users file of that directory, which is created; other users stay.
    ///
    /// # Errors
    /// If the directory or the file cannot be written, or the system has no random numbers.
    pub(super) fn new(directory: &Path) -> Result<Login, String> {
        let failed = |why: String| format!("cannot make the login of the demo: {why}");
        std::fs::create_dir_all(directory).map_err(|why| failed(why.to_string()))?;
        // A token is random, and its characters can be typed.
        let (_, secret) = Token::generate(Login::USER, vec![Scope::Read]).map_err(|why| failed(why.to_string()))?;
        let password: String = secret.chars().rev().take(LENGTH).collect();
        let user = User::new(Login::USER, &password).map_err(|why| failed(why.to_string()))?;
        let file = directory.join("users");
        CredentialsFile::open(&file).put(&user, true).map_err(failed)?;
        Ok(Login { password, file })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_start_has_another_password_and_keeps_other_users() {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().join("demo");
        let first = Login::new(&place).unwrap();
        let alice = User::new("alice", "a long password").unwrap();
        CredentialsFile::open(&first.file).put(&alice, true).unwrap();
        let second = Login::new(&place).unwrap();
        assert_ne!(first.password, second.password);
        assert_eq!(second.password.chars().count(), LENGTH);
        let users = std::fs::read_to_string(&second.file).unwrap();
        assert!(users.contains("alice") && users.contains(Login::USER));
        assert!(!users.contains(&second.password), "only a hash of it");
    }
}
