//! Where the journal of a drive is kept on disk.

use std::fs::{self, File};
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};

use super::super::file::MOST_BYTES;
use super::{NAME, Owner, RELEASED};
use crate::files;

/// Path of the journal of one drive.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JournalFile {
    dir: PathBuf,
}

impl JournalFile {
    /// The journal of this drive below the directory of parameter readings.
    pub fn new(params: &Path, drive: &str) -> JournalFile {
        JournalFile {
            dir: params.join(drive),
        }
    }

    /// All journals below the directory, in the order of their names.
    ///
    /// # Errors
    /// If the directory cannot be read.
    pub fn all(params: &Path) -> io::Result<Vec<JournalFile>> {
        let entries = match fs::read_dir(params) {
            Err(error) if is_absent(&error) => return Ok(Vec::new()),
            entries => entries?,
        };
        let mut all = Vec::new();
        for entry in entries {
            let file = JournalFile { dir: entry?.path() };
            // A path that cannot be examined may be a journal, so it counts as one.
            if file.path().try_exists().unwrap_or(true) && file.dir.is_dir() {
                all.push(file);
            }
        }
        all.sort_by(|a, b| a.dir.cmp(&b.dir));
        Ok(all)
    }

    /// Name of the journal's directory: that of the drive when the restore began.
    pub fn drive(&self) -> String {
        let name = self.dir.file_name().unwrap_or_default();
        name.to_string_lossy().into_owned()
    }

    /// Checks that an existing journal does not belong to another machine than `of`. A journal of an earlier
    /// version names no machine: it belongs to the drive with its name, which adds its machine when it resumes the
    /// restore.
    fn is_free(&self, of: &Owner) -> io::Result<()> {
        let there = self.read()?.and_then(|text| Owner::parse(&text).ok());
        let is_same = |there: &Owner| match &there.machine {
            Some(_) => there.machine == of.machine,
            None => (&there.drive, &there.family) == (&of.drive, &of.family),
        };
        match there.filter(|there| !is_same(there)) {
            None => Ok(()),
            Some(there) => Err(io::Error::other(format!(
                "a restore of {} was interrupted; resume or undo it, or set its journal aside with `drivegate params \
                 restore --release {}`",
                there.place(),
                self.drive()
            ))),
        }
    }

    pub fn path(&self) -> PathBuf {
        self.dir.join(NAME)
    }

    /// Writes a journal so that it survives a power failure; an existing one is either kept whole or replaced. The
    /// journal of another machine is not touched.
    ///
    /// # Errors
    /// If the journal is not certain to be on disk.
    pub fn write(&self, of: &Owner, text: &str) -> io::Result<()> {
        self.is_free(of)?;
        files::replace(&self.path(), text.as_bytes())?;
        // Syncs the directory entry of the file, and the entries of directories that may be new.
        self.dir.ancestors().take(3).try_for_each(sync)
    }

    /// The text of the journal, if one exists.
    ///
    /// # Errors
    /// If it is unknown whether a journal exists, or it cannot be read.
    pub fn read(&self) -> io::Result<Option<String>> {
        let mut bytes = Vec::new();
        match File::open(self.path()) {
            Ok(file) => file.take(MOST_BYTES).read_to_end(&mut bytes)?,
            Err(error) if is_absent(&error) => return Ok(None),
            Err(error) => return Err(error),
        };
        Ok(Some(String::from_utf8_lossy(&bytes).into_owned()))
    }

    /// Removes the journal of a restore that has ended. The journal of another machine is left.
    ///
    /// # Errors
    /// If the journal could not be removed; it may still exist.
    pub fn remove(&self, of: &Owner) -> io::Result<()> {
        if self.is_free(of).is_err() {
            return Ok(());
        }
        match fs::remove_file(self.path()) {
            Err(error) if is_absent(&error) => Ok(()),
            Err(error) => Err(error),
            Ok(()) => sync(&self.dir),
        }
    }

    /// Renames the journal so that it no longer blocks the drive, and keeps the former values in it; returns the new path.
    ///
    /// # Errors
    /// If the journal could not be renamed; it is unchanged.
    pub fn release(&self) -> io::Result<PathBuf> {
        let aside = self.dir.join(RELEASED);
        fs::rename(self.path(), &aside)?;
        sync(&self.dir)?;
        Ok(aside)
    }
}

fn sync(dir: &Path) -> io::Result<()> {
    // A relative path of a single part is in the working directory.
    let dir = if dir.as_os_str().is_empty() {
        Path::new(".")
    } else {
        dir
    };
    File::open(dir)?.sync_all()
}

fn is_absent(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory)
}
