//! The files of a journal: their names, their lock, and file errors.

use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, flock};

use super::{DAMAGED, QUARANTINED, SEGMENT, SUFFIX};

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
pub(super) fn segments(dir: &Path, name: &str) -> io::Result<Vec<(u64, PathBuf)>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(dir)? {
        let path = entry?.path();
        let text = path.file_name().and_then(|file| file.to_str()).unwrap_or_default();
        let number = text.strip_prefix(name).and_then(|rest| rest.strip_prefix('-'));
        let number = number.and_then(|rest| rest.strip_suffix(SUFFIX)?.parse().ok());
        found.extend(number.map(|number| (number, path.clone())));
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
