//! A file of lines that only grows, until it is full and becomes the newest of the older files.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, flock};

/// The current file; the names of older ones end with `.1`, `.2` and so on.
#[derive(Debug)]
pub struct Rotated {
    path: PathBuf,
    /// Maximum size of one file, bytes.
    most: u64,
    /// Maximum number of files.
    files: u64,
    open: Option<Open>,
}

#[derive(Debug)]
struct Open {
    file: File,
    bytes: u64,
    /// Whether data was written that may not be on disk yet.
    unsynced: bool,
}

impl Rotated {
    /// A file that shares `max_bytes` with its older files, `files` in all. No file is opened yet.
    pub fn new(path: PathBuf, max_bytes: u64, files: u64) -> Rotated {
        Rotated {
            path,
            most: max_bytes / files.max(1),
            files,
            open: None,
        }
    }

    /// The current file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Path of an older file; the greater the number, the older the file.
    pub fn older(&self, number: u64) -> PathBuf {
        let mut name = self.path.clone().into_os_string();
        name.push(format!(".{number}"));
        name.into()
    }

    /// Paths of all files that may exist, oldest first.
    pub fn all(&self) -> Vec<PathBuf> {
        let older = (1..self.files).rev().map(|number| self.older(number));
        older.chain([self.path.clone()]).collect()
    }

    /// Whether the file is open.
    pub fn is_open(&self) -> bool {
        self.open.is_some()
    }

    /// Opens the file with an exclusive lock and creates its directory; returns the size of the file in bytes.
    ///
    /// # Errors
    /// If the file cannot be opened, or another process has it open.
    pub fn open(&mut self) -> io::Result<(&mut File, u64)> {
        self.open = None;
        if let Some(dir) = self.path.parent() {
            super::create_dir(dir)?;
        }
        let file = OpenOptions::new()
            .read(true)
            .append(true)
            .create(true)
            .mode(0o640)
            .open(&self.path)?;
        super::give_to_owner(&file, &self.path);
        flock(&file, FlockOperation::NonBlockingLockExclusive)
            .map_err(|_| io::Error::other("another process is writing to it; give each gateway its own"))?;
        let bytes = file.metadata()?.len();
        let open = self.open.insert(Open {
            file,
            bytes,
            unsynced: false,
        });
        Ok((&mut open.file, bytes))
    }

    /// Closes the file; a later write opens it again.
    pub fn close(&mut self) {
        self.open = None;
    }

    /// Whether the file is too large to receive `more` bytes.
    pub fn is_full(&self, more: usize) -> bool {
        let bytes = self.open.as_ref().map_or(0, |open| open.bytes);
        bytes > 0 && bytes + more as u64 > self.most
    }

    /// Appends bytes, whole or not at all.
    ///
    /// # Errors
    /// If the bytes cannot be written, or the file is not open. A part that was written is removed, as far as that is
    /// possible.
    pub fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        let open = self.open.as_mut().ok_or_else(|| io::Error::other("it is not open"))?;
        if let Err(error) = open.file.write_all(bytes) {
            let _ = open.file.set_len(open.bytes);
            return Err(error);
        }
        open.bytes += bytes.len() as u64;
        open.unsynced = true;
        Ok(())
    }

    /// Flushes the appended bytes to disk, so that they survive a power failure.
    ///
    /// # Errors
    /// If the disk does not accept the data.
    pub fn sync(&mut self) -> io::Result<()> {
        if let Some(open) = self.open.as_mut().filter(|open| open.unsynced) {
            open.file.sync_data()?;
            open.unsynced = false;
        }
        Ok(())
    }

    /// Makes the current file the first of the older ones and removes the oldest one; the current file is then closed.
    ///
    /// # Errors
    /// If a file cannot be renamed, or the current file cannot be synchronised to disk.
    pub(crate) fn rotate(&mut self) -> io::Result<()> {
        self.sync()?;
        self.open = None;
        for number in (1..self.files.saturating_sub(1)).rev() {
            ignore_missing(fs::rename(self.older(number), self.older(number + 1)))?;
        }
        ignore_missing(fs::rename(&self.path, self.older(1)))
    }

    /// Whether the file that is open was moved, removed or replaced by another.
    pub fn is_replaced(&self) -> bool {
        let Some(open) = &self.open else { return false };
        let same = |there: fs::Metadata| {
            let own = open.file.metadata().ok()?;
            Some((own.dev(), own.ino()) == (there.dev(), there.ino()))
        };
        fs::metadata(&self.path).ok().and_then(same) != Some(true)
    }
}

fn ignore_missing(done: io::Result<()>) -> io::Result<()> {
    match done {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        done => done,
    }
}
