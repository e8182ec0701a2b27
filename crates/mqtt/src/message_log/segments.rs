//! The files of a journal: their names, their lock, and file errors.

use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, flock};

use super::{QUARANTINED, SEGMENT};

pub(super) const SUFFIX: &str = ".log";
pub(super) const DAMAGED: &str = ".damaged";

/// Number of a segment, ascending from 1, in the names of its files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct SegmentNumber(u64);

impl SegmentNumber {
    pub(super) const FIRST: SegmentNumber = SegmentNumber(1);

    pub(super) fn next(self) -> SegmentNumber {
        SegmentNumber(self.0.saturating_add(1))
    }

    /// Name of the segment's file in the journal with this name.
    pub(super) fn file(self, journal: &str) -> String {
        format!("{journal}-{:012}{SUFFIX}", self.0)
    }

    /// Name of a file with the damaged bytes that the segment has at this offset.
    pub(super) fn damaged(self, journal: &str, offset: u64) -> String {
        format!("{journal}-{:012}-{offset}{DAMAGED}", self.0)
    }

    /// The segment whose file has this name.
    fn of_file(file: &str, journal: &str) -> Option<SegmentNumber> {
        let number = file.strip_prefix(journal)?.strip_prefix('-')?;
        number.strip_suffix(SUFFIX)?.parse().ok().map(SegmentNumber)
    }
}

/// Locks the directory for this process.
pub(super) fn lock(dir: &Path, name: &str) -> io::Result<File> {
    let lock = OpenOptions::new()
        .create(true)
        .truncate(false)
        .write(true)
        .open(dir.join(format!("{name}.lock")))?;
    flock(&lock, FlockOperation::NonBlockingLockExclusive).map_err(|_| {
        let text = "another process uses this directory; give each gateway its own";
        io::Error::new(ErrorKind::WouldBlock, text)
    })?;
    Ok(lock)
}

/// Whether the name of an open file was deleted.
pub(super) fn is_deleted(file: &File) -> bool {
    file.metadata().is_ok_and(|metadata| metadata.nlink() == 0)
}

pub(super) fn segment_size(max_bytes: u64) -> u64 {
    (max_bytes / 64).clamp(SEGMENT.0, SEGMENT.1)
}

pub(super) fn is_full(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge
    )
}

/// The segments in `dir`, oldest first.
pub(super) fn segments(dir: &Path, name: &str) -> io::Result<Vec<(SegmentNumber, PathBuf)>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(dir)? {
        let path = entry?.path();
        let text = path.file_name().and_then(|file| file.to_str()).unwrap_or_default();
        found.extend(SegmentNumber::of_file(text, name).map(|number| (number, path.clone())));
    }
    found.sort();
    Ok(found)
}

/// Makes room for one more file with damaged records.
pub(super) fn remove_old_quarantine(dir: &Path, name: &str) -> io::Result<()> {
    let mut found: Vec<PathBuf> = Vec::new();
    for entry in fs::read_dir(dir)? {
        let path = entry?.path();
        let text = path.file_name().and_then(|file| file.to_str()).unwrap_or_default();
        if text.starts_with(name) && text.ends_with(DAMAGED) {
            found.push(path);
        }
    }
    found.sort();
    let surplus = (found.len() + 1).saturating_sub(QUARANTINED);
    found.iter().take(surplus).try_for_each(fs::remove_file)
}
