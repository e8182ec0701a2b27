//! The files of tokens and users: one line for each, whose first word is its name.

use std::fs::{OpenOptions, metadata, read_to_string, remove_file, rename};
use std::io::Write;
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

/// A file of tokens or users.
#[derive(Debug, Clone, Copy)]
pub(super) struct CredentialsFile<'p> {
    /// What it is, in messages.
    pub(super) what: &'static str,
    pub(super) path: &'p Path,
    /// Permissions of a new one; those of an old one stay.
    pub(super) mode: u32,
}

impl CredentialsFile<'_> {
    /// Its text.
    ///
    /// # Errors
    /// What is wrong with it, for the user.
    pub(super) fn read(&self) -> Result<String, String> {
        let (what, shown) = (self.what, self.path.display());
        read_to_string(self.path)
            .map_err(|error| format!("cannot read the {what} file: {error}; {shown}; check the path"))
    }

    /// Its text with another line; the file need not exist yet.
    ///
    /// # Errors
    /// What is wrong with it, for the user.
    pub(super) fn with_line(&self, line: &str) -> Result<String, String> {
        let text = match self.path.exists() {
            true => self.read()?,
            false => String::new(),
        };
        let separator = if text.is_empty() || text.ends_with('\n') {
            ""
        } else {
            "\n"
        };
        Ok(format!("{text}{separator}{line}\n"))
    }

    /// Removes the lines of that name.
    ///
    /// # Errors
    /// The file cannot be read or written.
    pub(super) fn remove(&self, name: &str) -> Result<(), String> {
        let text = self.read()?;
        let others = text.lines().filter(|line| line.split_whitespace().next() != Some(name));
        let text: String = others.map(|line| format!("{line}\n")).collect();
        self.write(&text)
    }

    /// Replaces the file as a whole, so that a gateway that reloads meanwhile reads the old one or the new one.
    ///
    /// # Errors
    /// What the system reports.
    pub(super) fn write(&self, text: &str) -> Result<(), String> {
        let (what, shown) = (self.what, self.path.display());
        let failed =
            |error: std::io::Error| format!("cannot write the {what} file: {error}; {shown}; check the directory");
        let mut name = self.path.as_os_str().to_owned();
        name.push(".new");
        let new = PathBuf::from(name);
        let mode = metadata(self.path).map_or(self.mode, |metadata| metadata.permissions().mode() & 0o777);
        let mut options = OpenOptions::new();
        let file = options
            .write(true)
            .create_new(true)
            .mode(mode)
            .open(&new)
            .map_err(failed)?;
        let written = { &file }
            .write_all(text.as_bytes())
            .and_then(|()| file.sync_all())
            .and_then(|()| rename(&new, self.path));
        if written.is_err() {
            let _ = remove_file(&new);
        }
        written.map_err(failed)
    }
}
