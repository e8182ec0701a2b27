//! Files that the gateway writes while it runs: lines that are appended, and small files that are replaced.
//!
//! - [`rotated`]: a file of lines with its older files, bounded together.
//! - [`Keeper`]: the thread that writes some of these files.
//! - [`names`]: the names of the gateway's files.
//! - [`State`]: the content of a small file that outlives the process, and how it is read and written.
//! - [`replace`]: writes new content completely or not at all.

mod keeper;
pub mod names;
pub mod rotated;
pub mod state;

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;

pub use keeper::Keeper;
pub use rotated::Rotated;
pub use state::{State, Words};

/// Ending of a file that is not completely written.
pub const PARTIAL: &str = "partial";

/// Replaces the content of a file: after a power failure the file has the old content or the new one. Creates the
/// directory if necessary.
///
/// # Errors
/// If the file cannot be written; the old content is left.
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let dir = path.parent();
    if let Some(dir) = dir {
        fs::create_dir_all(dir)?;
    }
    let aside = path.with_extension(PARTIAL);
    let write = || {
        let mut file = File::create(&aside)?;
        file.write_all(bytes)?;
        file.sync_all()
    };
    if let Err(error) = write().and_then(|()| fs::rename(&aside, path)) {
        // The partial file may not exist, so an error is ignored.
        let _ = fs::remove_file(&aside);
        return Err(error);
    }
    // The rename is on disk when the directory is; without that only the newest content is at stake.
    let _ = dir.map(|dir| File::open(dir).and_then(|dir| dir.sync_all()));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_written_leaves_what_was() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("state/counters.json");
        replace(&path, b"1").unwrap();
        replace(&path, b"2").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"2");
        std::os::unix::fs::symlink("/dev/full", path.with_extension(PARTIAL)).unwrap();
        assert_eq!(replace(&path, b"3").unwrap_err().kind(), io::ErrorKind::StorageFull);
        assert_eq!(fs::read(&path).unwrap(), b"2");
        assert_eq!(
            fs::read_dir(path.parent().unwrap()).unwrap().count(),
            1,
            "nothing is left aside"
        );
        let blocked = dir.path().join("file");
        fs::write(&blocked, "").unwrap();
        assert!(replace(&blocked.join("counters.json"), b"1").is_err());
    }
}
