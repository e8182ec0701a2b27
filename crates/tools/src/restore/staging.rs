//! Where a backup is unpacked before it is put in place: a directory next to each destination, which is always removed.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, chown, symlink};
use std::path::{Component, Path, PathBuf};

use crate::archive::Root;

/// First part of the name of the temporary directory.
pub(crate) const UNPACKED: &str = ".restore-";

/// The unpacked files.
#[derive(Debug)]
pub(super) struct Staging {
    config: Destination,
    state: Destination,
    /// The files in the order of the archive; the configuration is the first.
    files: Vec<(Root, PathBuf)>,
    /// Directories of the archive, below the directory of the configuration.
    directories: Vec<PathBuf>,
}

#[derive(Debug)]
struct Destination {
    /// Path of the destination.
    to: PathBuf,
    /// Directory in which the archive is unpacked: inside the destination, or inside the existing part of its path.
    aside: PathBuf,
    /// Whether the destination did not exist before.
    is_new: bool,
}

impl Destination {
    fn new(to: &Path) -> Result<Destination, String> {
        let made = |dir: &Path, mode| fs::DirBuilder::new().mode(mode).recursive(true).create(dir);
        let failed = |dir: &Path, error: io::Error| format!("cannot write to {}: {error}", dir.display());
        let is_new = !to.exists();
        made(to, 0o755).map_err(|error| failed(to, error))?;
        let aside = to.join(format!("{UNPACKED}{}", std::process::id()));
        fs::DirBuilder::new()
            .mode(0o700)
            .create(&aside)
            .map_err(|error| failed(&aside, error))?;
        Ok(Destination {
            to: to.to_path_buf(),
            aside,
            is_new,
        })
    }
}

impl Drop for Destination {
    fn drop(&mut self) {
        // An error is ignored: the name of the remaining directory shows its origin.
        let _ = fs::remove_dir_all(&self.aside);
        if self.is_new {
            // A new directory is removed only if it is empty, that is, if nothing was put in place.
            let _ = fs::remove_dir(&self.to);
        }
    }
}

impl Staging {
    /// A staging area for these destinations, which are created if necessary.
    ///
    /// # Errors
    /// If the directories cannot be written to.
    pub(super) fn new(config: &Path, state: &Path) -> Result<Staging, String> {
        Ok(Staging {
            config: Destination::new(config)?,
            state: Destination::new(state)?,
            files: Vec::new(),
            directories: Vec::new(),
        })
    }

    fn place_of(&self, root: Root) -> &Destination {
        match root {
            Root::Config => &self.config,
            Root::State => &self.state,
        }
    }

    /// The directory in which the files of `root` are unpacked.
    pub(super) fn of(&self, root: Root) -> &Path {
        &self.place_of(root).aside
    }

    /// Unpacks a file. `path` has normal components only.
    pub(super) fn unpack(&mut self, root: Root, path: &Path, mode: u32, content: &mut dyn Read) -> io::Result<()> {
        let to = self.of(root).join(path);
        if let Some(dir) = to.parent() {
            fs::create_dir_all(dir)?;
        }
        let mut file = OpenOptions::new()
            .write(true)
            .create_new(true)
            .mode(mode & 0o777)
            .open(&to)?;
        io::copy(content, &mut file)?;
        file.sync_all()?;
        self.files.push((root, path.to_path_buf()));
        Ok(())
    }

    /// Makes a directory for the configuration. `path` has normal components only.
    ///
    /// # Errors
    /// If the directory cannot be created.
    pub(super) fn make_directory(&mut self, path: &Path) -> Result<(), String> {
        let to = self.config.aside.join(path);
        let failed = |error: io::Error| format!("cannot create {}: {error}", to.display());
        fs::create_dir_all(&to).map_err(failed)?;
        self.directories.push(path.to_path_buf());
        Ok(())
    }

    /// Makes a file that already exists at `path` available to the unpacked configuration, for the check.
    ///
    /// # Errors
    /// If the link cannot be created.
    pub(super) fn borrow(&self, below: &Path, path: &Path) -> Result<(), String> {
        let link = self.of(Root::Config).join(below);
        let normal = below.components().all(|part| matches!(part, Component::Normal(_)));
        let Ok(path) = path.canonicalize() else { return Ok(()) };
        if !normal || fs::symlink_metadata(&link).is_ok() {
            return Ok(());
        }
        let made = link
            .parent()
            .map_or(Ok(()), fs::create_dir_all)
            .and_then(|()| symlink(&path, &link));
        made.map_err(|error| format!("cannot read {}: {error}", path.display()))
    }

    /// Destination files that exist already.
    pub(super) fn existing(&self) -> Vec<PathBuf> {
        let all = self.files.iter().map(|(root, path)| self.place_of(*root).to.join(path));
        all.filter(|path| fs::symlink_metadata(path).is_ok()).collect()
    }

    /// Puts everything in place, the configuration last; the files get the owner of their directory. Returns the
    /// files that are in place.
    ///
    /// # Errors
    /// If a file cannot be put in place: contains its name, and the files already in place.
    pub(super) fn place(&self) -> Result<Vec<PathBuf>, String> {
        for path in &self.directories {
            let failed = |error: io::Error| format!("cannot create {}: {error}", path.display());
            // This call creates the directory that would contain such a file.
            directory_of(&self.config.to, &path.join("file")).map_err(failed)?;
        }
        let mut placed = Vec::new();
        for (root, path) in self.files.iter().skip(1).chain(self.files.first()) {
            let Destination { to, aside, .. } = self.place_of(*root);
            let failed = |error: io::Error| {
                let done = placed.iter().map(|path: &PathBuf| path.display().to_string());
                let done: Vec<String> = done.collect();
                format!(
                    "cannot put {} in place: {error}; in place are: {}",
                    path.display(),
                    done.join(", ")
                )
            };
            let directory = directory_of(to, path).map_err(failed)?;
            let (from, to) = (aside.join(path), to.join(path));
            give(&from, &directory).map_err(failed)?;
            fs::rename(&from, &to).map_err(failed)?;
            let _ = File::open(&directory).and_then(|dir| dir.sync_all());
            placed.push(to);
        }
        Ok(placed)
    }
}

/// Gives a file or directory the owner of the directory in which it will be placed.
fn give(path: &Path, directory: &Path) -> io::Result<()> {
    let owner = fs::metadata(directory)?;
    // Only root may change the owner; without root all files belong to the user anyway, so an error is ignored.
    let _ = chown(path, Some(owner.uid()), Some(owner.gid()));
    Ok(())
}

/// The directory of the file `path` below `root`, created if necessary with the owner of its parent. A symbolic
/// link on the way is not followed.
fn directory_of(root: &Path, path: &Path) -> io::Result<PathBuf> {
    let mut directory = root.to_path_buf();
    for part in path.parent().into_iter().flat_map(Path::components) {
        let above = directory.clone();
        directory.push(part);
        match fs::symlink_metadata(&directory) {
            Ok(found) if found.is_dir() => {}
            Ok(_) => {
                let what = format!("{} is not a directory", directory.display());
                return Err(io::Error::new(io::ErrorKind::NotADirectory, what));
            }
            Err(_) => {
                fs::create_dir(&directory)?;
                give(&directory, &above)?;
            }
        }
    }
    Ok(directory)
}
