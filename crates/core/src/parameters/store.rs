//! Readings kept on disk: `DIR/DRIVE/20260302T074012Z.params`. The names are in the order in which the readings were made: one
//! whose time is not after the newest, as after the clock was set back, has the name of that with a number,
//! `20260302T074012Z-000002.params`.

use std::fs::{self, File};
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};

use super::file::{MOST_BYTES, ParameterFile};
use crate::files;

/// Maximum number of readings kept for one drive.
const KEPT: usize = 100;
/// The end of the name of a file.
const EXTENSION: &str = "params";

/// A directory of parameter readings.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Store {
    dir: PathBuf,
}

/// A parameter reading on disk.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredFile {
    /// Name of the drive.
    pub drive: String,
    /// Path of the file.
    pub path: PathBuf,
}

impl Store {
    /// A store in this directory, which need not exist.
    pub fn new(dir: PathBuf) -> Store {
        Store { dir }
    }

    /// The directory of the store.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Stores a reading. Of consecutive readings with the same values, the first and the last are kept; at most a
    /// hundred readings are kept in all.
    ///
    /// # Errors
    /// If the disk reports an error.
    pub fn keep(&self, file: &ParameterFile) -> io::Result<PathBuf> {
        let dir = self.dir.join(&file.drive);
        let name: String = file.time.chars().filter(|c| c.is_ascii_alphanumeric()).collect();
        let kept = self.of(&file.drive)?;
        let newest = kept.last().and_then(|path| path.file_stem()).unwrap_or_default();
        let name = name_after(&newest.to_string_lossy(), name);
        let path = dir.join(format!("{name}.{EXTENSION}"));
        files::replace(&path, file.text().as_bytes())?;
        let mut kept = self.of(&file.drive)?;
        let checksum = file.checksum();
        let same = |path: &PathBuf| read(path).is_ok_and(|other| other.checksum() == checksum);
        if let [.., before, last, _] = kept.as_slice()
            && same(before)
            && same(last)
        {
            fs::remove_file(last)?;
        }
        kept = self.of(&file.drive)?;
        let too_many = kept.len().saturating_sub(KEPT);
        for old in kept.iter().take(too_many) {
            fs::remove_file(old)?;
        }
        Ok(path)
    }

    /// The readings of a drive, oldest first.
    fn of(&self, drive: &str) -> io::Result<Vec<PathBuf>> {
        let entries = match fs::read_dir(self.dir.join(drive)) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            entries => entries?,
        };
        let paths = entries.map(|entry| entry.map(|entry| entry.path()));
        let mut paths: Vec<PathBuf> = paths.collect::<io::Result<_>>()?;
        paths.retain(|path| path.extension().is_some_and(|end| end == EXTENSION));
        paths.sort_by(|a, b| a.file_stem().cmp(&b.file_stem()));
        Ok(paths)
    }

    /// The last stored reading of a drive.
    ///
    /// # Errors
    /// If the file cannot be read; names the file and the reason.
    pub fn latest(&self, drive: &str) -> Result<Option<ParameterFile>, String> {
        let all = self
            .of(drive)
            .map_err(|error| format!("cannot read {}: {error}", self.dir.join(drive).display()))?;
        all.last().map(|path| read(path)).transpose()
    }

    /// All readings, sorted by drive and then by age, oldest first.
    ///
    /// # Errors
    /// If the directory of readings cannot be read.
    pub fn list(&self) -> io::Result<Vec<StoredFile>> {
        let entries = match fs::read_dir(&self.dir) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            entries => entries?,
        };
        let mut drives: Vec<String> = Vec::new();
        for entry in entries {
            let entry = entry?;
            if entry.file_type()?.is_dir() {
                drives.extend(entry.file_name().into_string());
            }
        }
        drives.sort();
        let mut all = Vec::new();
        for drive in drives {
            let paths = self.of(&drive)?;
            all.extend(paths.into_iter().map(|path| StoredFile {
                drive: drive.clone(),
                path,
            }));
        }
        Ok(all)
    }
}

/// The name of a reading made after the one named `newest`: `own` if that sorts after it, otherwise the number
/// after `newest`.
fn name_after(newest: &str, own: String) -> String {
    if own.as_str() > newest {
        return own;
    }
    let numbered = newest.rsplit_once('-');
    let numbered = numbered.and_then(|(name, number)| Some((name, number.parse().ok()?)));
    let (name, number): (&str, u32) = numbered.unwrap_or((newest, 1));
    format!("{name}-{:06}", number.saturating_add(1))
}

/// Parses a parameter file from disk.
///
/// # Errors
/// If the file cannot be read or is invalid: contains the path and the fault.
pub fn read(path: &Path) -> Result<ParameterFile, String> {
    let shown = path.display();
    let mut text = String::new();
    let opened = File::open(path).map_err(|error| format!("cannot open {shown}: {error}"))?;
    let taken = opened.take(MOST_BYTES + 1).read_to_string(&mut text);
    taken.map_err(|error| format!("cannot read {shown}: {error}"))?;
    if text.len() as u64 > MOST_BYTES {
        return Err(format!(
            "{shown} is larger than {MOST_BYTES} bytes, too large for a parameter file"
        ));
    }
    ParameterFile::parse(&text).map_err(|error| format!("{shown}: {error}"))
}

#[cfg(test)]
mod tests {
    use super::super::file::{Entry, Id};
    use super::*;
    use drivegate_model::drive::parameters::RawValue;

    fn file(minute: u32, value: u16) -> ParameterFile {
        let entry = Entry {
            value: Ok(RawValue::Word(value)),
            note: String::new(),
        };
        ParameterFile {
            drive: "pump-1".to_string(),
            family: "vacon-nx".to_string(),
            time: format!("2026-03-02T{:02}:{:02}:12Z", minute / 60, minute % 60),
            values: [(Id::new("102"), entry)].into(),
            ..ParameterFile::default()
        }
    }

    #[test]
    fn after_the_clock_was_set_back_the_last_reading_is_still_the_latest() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::new(folder.path().join("params"));
        let keep = |minute, value| {
            let path = store.keep(&file(minute, value)).unwrap();
            assert_eq!(store.latest("pump-1"), Ok(Some(file(minute, value))));
            path.file_name().unwrap().to_string_lossy().into_owned()
        };
        for minute in 10..10 + KEPT as u32 {
            keep(minute, minute as u16);
        }
        assert_eq!(keep(110, 7), "20260302T015012Z.params");
        assert_eq!(keep(50, 8), "20260302T015012Z-000002.params");
        for minute in 51..59 {
            keep(minute, minute as u16);
        }
        assert_eq!(keep(50, 9), "20260302T015012Z-000011.params");
        assert_eq!(keep(110, 10), "20260302T015012Z-000012.params");
        assert_eq!(keep(111, 11), "20260302T015112Z.params", "the clock has caught up");
        assert_eq!(store.list().unwrap().len(), KEPT);
    }

    #[test]
    fn the_first_and_the_last_of_readings_alike_are_kept_and_a_hundred_in_all() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::new(folder.path().join("params"));
        assert_eq!((store.list().unwrap(), store.latest("pump-1")), (Vec::new(), Ok(None)));
        for (minute, value) in [(1, 7), (2, 7), (3, 7), (4, 8), (5, 7)] {
            store.keep(&file(minute, value)).unwrap();
        }
        let times: Vec<String> = store
            .of("pump-1")
            .unwrap()
            .iter()
            .map(|path| read(path).unwrap().time)
            .collect();
        let minutes: Vec<&str> = times.iter().map(|time| &time[14..16]).collect();
        assert_eq!(minutes, ["01", "03", "04", "05"]);
        assert_eq!(store.latest("pump-1").unwrap().unwrap(), file(5, 7));
        for minute in 10..200 {
            store.keep(&file(minute, minute as u16)).unwrap();
        }
        assert_eq!(store.list().unwrap().len(), KEPT);
        std::fs::write(folder.path().join("params/pump-1/99999999.params"), "x").unwrap();
        assert!(
            store
                .latest("pump-1")
                .unwrap_err()
                .contains("99999999.params: it is not a parameter file")
        );
    }
}
