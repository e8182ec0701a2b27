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
use std::os::unix::fs::{MetadataExt, fchown, lchown};
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
        create_dir(dir)?;
    }
    let aside = path.with_extension(PARTIAL);
    let write = || {
        let mut file = File::create(&aside)?;
        file.write_all(bytes)?;
        give_to_owner(&file, &aside);
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

/// Gives a file that root has opened to the owner of its directory: a service that runs as this user must be able to use
/// it after a command of root. Where the system refuses that, as in some containers, the file stays with root.
pub fn give_to_owner(file: &File, path: &Path) {
    let Some((user, group)) = owner_of_parent(path) else {
        return;
    };
    let (Ok(opened), Ok(there)) = (file.metadata(), fs::symlink_metadata(path)) else {
        return;
    };
    // A link that this user made to a file elsewhere is not followed.
    let is_own = (opened.dev(), opened.ino()) == (there.dev(), there.ino()) && opened.nlink() == 1;
    if opened.is_file() && is_own && opened.uid() != user {
        let _ = fchown(file, Some(user), Some(group));
    }
}

/// Creates a directory with its parents; new ones go to the owner of theirs as in [`give_to_owner`].
///
/// # Errors
/// If there is no such directory afterwards.
pub fn create_dir(dir: &Path) -> io::Result<()> {
    if dir.as_os_str().is_empty() || dir.is_dir() {
        return Ok(());
    }
    if let Some(parent) = dir.parent() {
        create_dir(parent)?;
    }
    match fs::create_dir(dir) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists || !dir.is_dir() => return Err(error),
        Err(_) => {}
        Ok(()) => {
            let _ = owner_of_parent(dir).map(|(user, group)| lchown(dir, Some(user), Some(group)));
        }
    }
    Ok(())
}

/// User and group that own the directory of `path`, if this process is root and the user is another one.
fn owner_of_parent(path: &Path) -> Option<(u32, u32)> {
    if !rustix::process::geteuid().is_root() {
        return None;
    }
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    let owner = fs::metadata(parent.unwrap_or(Path::new("."))).ok()?;
    (owner.uid() != 0).then(|| (owner.uid(), owner.gid()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_root_writes_belongs_to_the_user_of_the_directory() {
        const SERVICE: u32 = 4711;
        if !rustix::process::geteuid().is_root() {
            return;
        }
        let folder = tempfile::tempdir().unwrap();
        let (dir, root) = (folder.path().join("state"), folder.path().join("root"));
        fs::create_dir(&dir).unwrap();
        std::os::unix::fs::chown(&dir, Some(SERVICE), Some(SERVICE)).unwrap();
        replace(&dir.join("params/pump-1/now.params"), b"1").unwrap();
        for made in ["params", "params/pump-1", "params/pump-1/now.params"] {
            assert_eq!(fs::metadata(dir.join(made)).unwrap().uid(), SERVICE, "{made}");
        }
        // What a link leads to stays with its owner.
        replace(&root, b"1").unwrap();
        std::os::unix::fs::symlink(&root, dir.join("counters.partial")).unwrap();
        let _ = replace(&dir.join("counters.json"), b"2");
        fs::hard_link(&root, dir.join("starts.partial")).unwrap();
        let _ = replace(&dir.join("starts.json"), b"2");
        assert_eq!(fs::metadata(&root).unwrap().uid(), 0);
    }

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
