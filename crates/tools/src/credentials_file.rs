//! The files of tokens and users: one line for each entry, which begins with its name.

use std::fs::{File, Metadata, OpenOptions, Permissions, TryLockError, metadata, read_to_string, remove_file, rename};
use std::io::{self, Write};
use std::marker::PhantomData;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt, fchown};
use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::{Duration, Instant};

use super::check::group_remedy;
use drivegate_http::{Credential, Credentials};

/// Time that another program may take to change the file.
const PATIENCE: Duration = Duration::from_secs(10);
/// Interval of checks whether another program has finished its change.
const AGAIN: Duration = Duration::from_millis(20);

/// A kind of credential that is kept in a file.
pub(super) trait Filed: Credential + Send + Sync + 'static {
    /// Kind of the file, for messages.
    const FILE: &'static str;
    /// Permissions of a new file; an existing file keeps its permissions.
    const MODE: u32;
}

/// The option that names a file of tokens or users.
#[derive(Debug, clap::Args)]
pub(super) struct CredentialsFile<C: Filed> {
    #[arg(long = "file", value_name = "FILE", help = format!("The {} file", C::FILE))]
    pub(super) path: PathBuf,
    #[arg(skip)]
    of: PhantomData<C>,
}

impl<C: Filed> CredentialsFile<C> {
    /// The credentials file at this path.
    pub(super) fn open(path: &Path) -> CredentialsFile<C> {
        CredentialsFile {
            path: path.to_path_buf(),
            of: PhantomData,
        }
    }

    /// What to do with a new file, in one line: the user of the service does not own it.
    pub(super) fn remedy(&self) -> String {
        let path = std::path::absolute(&self.path).unwrap_or_else(|_| self.path.clone());
        format!("for the service to read it, {}\n", group_remedy(&path, "g+r"))
    }

    /// Reads the text of the file.
    ///
    /// # Errors
    /// If the file cannot be read: contains the message.
    fn read(&self) -> Result<String, String> {
        let (what, shown) = (C::FILE, self.path.display());
        read_to_string(&self.path)
            .map_err(|error| format!("cannot read the {what} file: {error}; {shown}; check the path"))
    }

    /// Reads the credentials in the file.
    ///
    /// # Errors
    /// If the file cannot be read or is invalid: contains the message.
    pub(super) fn list(&self) -> Result<Credentials<C>, String> {
        parsed(&self.path, &self.read()?)
    }

    /// Adds a credential. An existing one with this name is replaced if `may_replace`. Returns whether one existed.
    ///
    /// # Errors
    /// If the name exists and may not be replaced, or the file cannot be read or written.
    pub(super) fn put(&self, new: &C, may_replace: bool) -> Result<bool, String> {
        let (mut is_known, line) = (false, new.to_string());
        self.change(|text| {
            is_known = parsed::<C>(&self.path, text)?.named(new.name()).is_some();
            let text = if is_known && may_replace {
                replaced(text, new.name(), Some(&line))
            } else {
                with_line(text, &line)
            };
            let remedy = if is_known { "choose another name" } else { "remove one" };
            match Credentials::<C>::parse(&text) {
                Ok(_) => Ok(text),
                Err((_, error)) => Err(format!("{error}; {}; {remedy}", self.path.display())),
            }
        })?;
        Ok(is_known)
    }

    /// Removes the entry with this name.
    ///
    /// # Errors
    /// If the name does not exist, or the file is invalid.
    pub(super) fn remove(&self, name: &str) -> Result<(), String> {
        let (shown, kind) = (self.path.display(), C::KIND);
        self.change(|text| match parsed::<C>(&self.path, text)?.named(name) {
            Some(_) => Ok(replaced(text, name, None)),
            None => Err(format!(
                "there is no {kind} `{name}`; {shown}; `drivegate {kind} list` shows them"
            )),
        })
    }

    /// Changes the text of the file; a missing file has empty text. Other programs that change it wait meanwhile,
    /// so that no change is lost.
    ///
    /// # Errors
    /// The error of `change` or of the system: then the file is unchanged.
    fn change(&self, change: impl FnOnce(&str) -> Result<String, String>) -> Result<(), String> {
        // A symbolic link is kept: the file that it points to is changed.
        let file = self.path.canonicalize().unwrap_or_else(|_| self.path.clone());
        let _lock = self.lock(&file)?;
        let text = if self.path.exists() {
            self.read()?
        } else {
            String::new()
        };
        self.write(&file, &change(&text)?)
    }

    /// Locks the directory of the file, because the file itself is replaced at each change.
    fn lock(&self, file: &Path) -> Result<File, String> {
        let (what, shown) = (C::FILE, self.path.display());
        let failed = |error: io::Error| format!("cannot lock the {what} file: {error}; {shown}; check the directory");
        let dir = match file.parent() {
            Some(dir) if !dir.as_os_str().is_empty() => dir,
            _ => Path::new("."),
        };
        let dir = File::open(dir).map_err(failed)?;
        let until = Instant::now() + PATIENCE;
        loop {
            match dir.try_lock() {
                Ok(()) => return Ok(dir),
                Err(TryLockError::WouldBlock) if Instant::now() < until => sleep(AGAIN),
                Err(TryLockError::WouldBlock) => {
                    return Err(format!(
                        "another program is changing the {what} file; {shown}; try again later"
                    ));
                }
                Err(TryLockError::Error(error)) => return Err(failed(error)),
            }
        }
    }

    /// Replaces the file as a whole, so that a gateway that reloads at this moment reads the old or the new one.
    /// Owner, group and permissions are kept, so that the gateway can still read it.
    fn write(&self, path: &Path, text: &str) -> Result<(), String> {
        let (what, shown) = (C::FILE, self.path.display());
        let failed = |error: io::Error| format!("cannot write the {what} file: {error}; {shown}; check the directory");
        let mut name = path.as_os_str().to_owned();
        name.push(".new");
        let new = PathBuf::from(name);
        // Removes the new file of a change that was killed.
        let _ = remove_file(&new);
        let old = metadata(path).ok();
        let mut options = OpenOptions::new();
        let file = options
            .write(true)
            .create_new(true)
            .mode(if old.is_some() { 0o600 } else { C::MODE })
            .open(&new)
            .map_err(failed)?;
        let owned = old.map_or(Ok(()), |old| {
            like(&file, &old).map_err(|error| {
                format!(
                    "cannot restore the owner {}:{} of the {what} file: {error}; {shown}; run this as root",
                    old.uid(),
                    old.gid()
                )
            })
        });
        let written = owned.and_then(|()| {
            { &file }
                .write_all(text.as_bytes())
                .and_then(|()| file.sync_all())
                .and_then(|()| rename(&new, path))
                .map_err(failed)
        });
        if written.is_err() {
            let _ = remove_file(&new);
        }
        written
    }
}

/// Gives a file the owner, group and permissions of the old one.
fn like(file: &File, old: &Metadata) -> io::Result<()> {
    let new = file.metadata()?;
    if (new.uid(), new.gid()) != (old.uid(), old.gid()) {
        fchown(file, Some(old.uid()), Some(old.gid()))?;
    }
    file.set_permissions(Permissions::from_mode(old.mode() & 0o777))
}

/// Reads the credentials from the text of a file.
fn parsed<C: Credential>(path: &Path, text: &str) -> Result<Credentials<C>, String> {
    Credentials::parse(text).map_err(|(line, error)| format!("{error}; {}:{line}; remove the line", path.display()))
}

/// The text with another line added.
fn with_line(text: &str, line: &str) -> String {
    let end = if text.is_empty() || text.ends_with('\n') {
        ""
    } else {
        "\n"
    };
    format!("{text}{end}{line}\n")
}

/// The text with the line of this name replaced by another line, or removed.
fn replaced(text: &str, name: &str, by: Option<&str>) -> String {
    let line = |line| {
        if str::split_whitespace(line).next() == Some(name) {
            by
        } else {
            Some(line)
        }
    };
    text.lines().filter_map(line).flat_map(|line| [line, "\n"]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_http::Token;

    fn file(path: &Path) -> CredentialsFile<Token> {
        CredentialsFile {
            path: path.to_path_buf(),
            of: PhantomData,
        }
    }

    #[test]
    fn changes_at_a_time_are_all_made() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tokens");
        std::fs::write(folder.path().join("tokens.new"), "left behind").unwrap();
        std::thread::scope(|scope| {
            for n in 0..16 {
                let path = &path;
                scope.spawn(move || {
                    file(path)
                        .change(|text| Ok(with_line(text, &format!("n{n} x"))))
                        .unwrap()
                });
            }
        });
        let text = file(&path).read().unwrap();
        assert_eq!(text.lines().count(), 16, "{text}");
        file(&path).change(|text| Ok(replaced(text, "n7", None))).unwrap();
        assert_eq!(file(&path).read().unwrap().lines().count(), 15);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn the_service_gets_a_new_file_through_a_group() {
        let remedy = file(Path::new("/etc/drivegate/tokens")).remedy();
        assert!(
            remedy.contains("chgrp GROUP /etc/drivegate/tokens && chmod g+r"),
            "{remedy}"
        );
    }

    #[test]
    fn a_link_stays_one() {
        let folder = tempfile::tempdir().unwrap();
        let (real, link) = (folder.path().join("real"), folder.path().join("link"));
        std::fs::write(&real, "a x\n").unwrap();
        std::os::unix::fs::symlink("real", &link).unwrap();
        file(&link).change(|text| Ok(with_line(text, "b x"))).unwrap();
        assert_eq!(file(&real).read().unwrap(), "a x\nb x\n");
        assert!(link.is_symlink());
    }

    #[test]
    fn what_cannot_be_changed_is_as_it_was() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tokens");
        std::fs::write(&path, "a x\n").unwrap();
        let refused = file(&path).change(|_| Err("no".to_string()));
        assert_eq!(refused, Err("no".to_string()));
        assert_eq!(file(&path).read().unwrap(), "a x\n");
        let nowhere = folder.path().join("none/tokens");
        assert!(
            file(&nowhere)
                .change(|_| Ok(String::new()))
                .unwrap_err()
                .contains("check the directory")
        );
    }

    /// A group other than that of new files, which this process may assign.
    fn other_group() -> Option<u32> {
        let own = rustix::process::getegid().as_raw();
        if rustix::process::geteuid().is_root() {
            return Some(own + 1);
        }
        let groups = rustix::process::getgroups().unwrap();
        groups
            .into_iter()
            .map(|group| group.as_raw())
            .find(|group| *group != own)
    }

    #[test]
    fn owner_group_and_permissions_stay() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tokens");
        file(&path).change(|_| Ok("a x\n".to_string())).unwrap();
        let group = other_group();
        let opened = File::open(&path).unwrap();
        fchown(&opened, None, group).unwrap();
        opened.set_permissions(Permissions::from_mode(0o664)).unwrap();
        let owned = |metadata: Metadata| (metadata.uid(), metadata.gid(), metadata.mode());
        let before = owned(metadata(&path).unwrap());
        assert!(group.is_none_or(|group| group == before.1));
        file(&path).change(|text| Ok(with_line(text, "b x"))).unwrap();
        assert_eq!(owned(metadata(&path).unwrap()), before);
    }
}
