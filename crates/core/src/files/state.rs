//! A small state that outlives the process in a file of its own: JSON, with its version, replaced as a whole.
//!
//! An object has its version in a key of its own. A list has no place for one, so that of a later version will be in an
//! object; a file without a version is of the first one. What the disk refuses to return is not replaced, what it refuses
//! to take is offered again.

use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Duration;
use std::{fs, io};

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::replace;

/// Time after which a file that the disk refused to return, or to take, is tried again.
pub const AGAIN: Duration = Duration::from_secs(1);

/// The content of a state file.
pub trait State: Serialize + DeserializeOwned + Send + 'static {
    /// The parts of its messages.
    const WORDS: Words;
    /// Key of the version in the file.
    const VERSION_KEY: &'static str;
    /// Version that is written, and the newest that can be read.
    const VERSION: u32 = 1;
    /// Largest file that is read, bytes: the gateway writes no larger one.
    const LONGEST: u64;

    /// Checks what the types of the fields do not show.
    ///
    /// # Errors
    /// If the gateway cannot have written this: contains the reason.
    fn check(&self) -> Result<(), String> {
        Ok(())
    }

    /// Name for a file at `path` that cannot be used.
    fn aside(path: &Path) -> PathBuf {
        path.with_extension("damaged")
    }

    /// The content of the file.
    ///
    /// # Errors
    /// If JSON has no form for the state.
    fn to_json(&self) -> io::Result<Vec<u8>> {
        let mut state = serde_json::to_value(self)?;
        if let Some(fields) = state.as_object_mut() {
            fields.insert(Self::VERSION_KEY.to_string(), Self::VERSION.into());
        }
        Ok(serde_json::to_vec_pretty(&state)?)
    }

    /// Parses the content of a file.
    ///
    /// # Errors
    /// If it is not a state of this kind and version: contains the reason.
    fn from_json(bytes: &[u8]) -> Result<Self, String> {
        let state: serde_json::Value = serde_json::from_slice(bytes).map_err(|error| error.to_string())?;
        if let Some(version) = state.get(Self::VERSION_KEY).filter(|found| **found != Self::VERSION) {
            return Err(format!(
                "it has version {version}, this gateway knows {}",
                Self::VERSION
            ));
        }
        let state: Self = serde_json::from_value(state).map_err(|error| error.to_string())?;
        state.check()?;
        Ok(state)
    }

    /// Reads a file; `None` if there is none.
    ///
    /// # Errors
    /// If the disk does not return it, or its content is of no use.
    fn load(path: &Path) -> Result<Option<Self>, NotLoaded> {
        let length = match fs::metadata(path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            metadata => metadata.map_err(NotLoaded::Disk)?.len(),
        };
        if length > Self::LONGEST {
            let why = format!("it has {length} bytes, more than {}", Self::LONGEST);
            return Err(NotLoaded::Content(why));
        }
        let bytes = fs::read(path).map_err(NotLoaded::Disk)?;
        Self::from_json(&bytes).map(Some).map_err(NotLoaded::Content)
    }

    /// Reads a file as [`State::load`] does, but renames one whose content is of no use: the gateway goes on without it.
    ///
    /// # Errors
    /// If the disk does not return the file, which stays as it is.
    fn take_up(path: &Path) -> io::Result<Option<Self>> {
        let why = match Self::load(path) {
            Ok(found) => return Ok(found),
            Err(NotLoaded::Disk(error)) => return Err(error),
            Err(NotLoaded::Content(why)) => why,
        };
        let (Words { what, lost, .. }, kept) = (Self::WORDS, set_aside(path, &Self::aside(path)));
        tracing::error!(target: TARGET, "cannot use {what} in {}: {why}; {kept}, and {lost}", path.display());
        Ok(None)
    }

    /// Reads a file as [`State::take_up`] does, and again while the disk refuses, as long as `goes_on`, which learns the
    /// reason and waits.
    fn insist(path: &Path, mut goes_on: impl FnMut(&io::Error) -> bool) -> Option<Option<Self>> {
        let mut failing = false;
        loop {
            let error = match Self::take_up(path) {
                Ok(found) => return Some(found),
                Err(error) => error,
            };
            if !std::mem::replace(&mut failing, true) {
                Self::WORDS.not_read(path, &error);
            }
            if !goes_on(&error) {
                return None;
            }
        }
    }

    /// Replaces a file.
    ///
    /// # Errors
    /// If the disk does not take it; names the file, which has its old content.
    fn save(&self, path: &Path) -> Result<(), String> {
        let written = self.to_json().and_then(|text| replace(path, &text));
        written.map_err(|error| format!("{}: {error}", path.display()))
    }
}

/// The parts of the messages about a state file.
#[derive(Debug, Clone, Copy)]
pub struct Words {
    /// The content, as `the starts`.
    pub what: &'static str,
    /// What the gateway does until the file is read.
    pub unread: &'static str,
    /// What follows while the file cannot be written.
    pub unsaved: &'static str,
    /// What follows without the content.
    pub lost: &'static str,
}

const TARGET: &str = "drivegate::state";

impl Words {
    /// Logs that the disk has not returned the file, or not in time.
    pub fn not_read(&self, path: &Path, why: &dyn fmt::Display) {
        let Words { what, unread, .. } = self;
        let path = path.display();
        tracing::error!(
            target: TARGET,
            "cannot read {what} in {path}: {why}; {unread} until it is read; check state_dir of [gateway] and the disk"
        );
    }

    /// Logs the first failed write, and the first one after failed ones.
    pub fn report(&self, done: &Result<(), String>, failing: &mut bool) {
        let Words { what, unsaved, .. } = self;
        match done {
            Ok(()) if std::mem::take(failing) => tracing::warn!(target: TARGET, "{what} are saved again"),
            Err(why) if !std::mem::replace(failing, true) => tracing::error!(
                target: TARGET,
                "cannot save {what}: {why}; {unsaved} until that works; retrying; check state_dir of [gateway] and the disk"
            ),
            _ => {}
        }
    }
}

/// Renames a file that cannot be used, and returns the result as text for the log.
fn set_aside(path: &Path, aside: &Path) -> String {
    match fs::rename(path, aside) {
        Ok(()) => format!("it is kept as {}", aside.display()),
        Err(error) => format!("it cannot be renamed ({error})"),
    }
}

/// Why a state file was not loaded.
#[derive(Debug, thiserror::Error)]
pub enum NotLoaded {
    /// The disk did not return the file; it may do so later.
    #[error("{0}")]
    Disk(io::Error),
    /// The content is of no use.
    #[error("{0}")]
    Content(String),
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use serde::Deserialize;

    use super::*;

    const WORDS: Words = Words {
        what: "the marks",
        unread: "nothing is marked",
        unsaved: "marks end with the process",
        lost: "earlier marks are unknown",
    };

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct Marks {
        marks: BTreeMap<String, u32>,
    }

    impl State for Marks {
        const WORDS: Words = WORDS;
        const VERSION_KEY: &'static str = "drivegate_marks";
        const VERSION: u32 = 2;
        const LONGEST: u64 = 1 << 16;

        fn check(&self) -> Result<(), String> {
            match self.marks.len() {
                0..3 => Ok(()),
                many => Err(format!("{many} marks")),
            }
        }
    }

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    #[serde(transparent)]
    struct Names(Vec<String>);

    impl State for Names {
        const WORDS: Words = WORDS;
        const VERSION_KEY: &'static str = "drivegate_names";
        const LONGEST: u64 = 1 << 16;
    }

    fn marks(count: u32) -> Marks {
        Marks {
            marks: (0..count).map(|mark| (format!("mark-{mark}"), mark)).collect(),
        }
    }

    #[test]
    fn an_object_has_its_version_and_a_list_needs_none() {
        let text = String::from_utf8(marks(2).to_json().unwrap()).unwrap();
        assert!(text.contains("\"drivegate_marks\": 2"), "{text}");
        assert_eq!(Marks::from_json(text.as_bytes()), Ok(marks(2)));
        let names = Names(vec!["a".to_string()]);
        let text = names.to_json().unwrap();
        assert_eq!(serde_json::from_slice::<Vec<String>>(&text).unwrap(), names.0);
        assert_eq!(Names::from_json(&text), Ok(names));
    }

    #[test]
    fn what_the_gateway_cannot_have_written_is_refused_with_a_reason() {
        for (text, why) in [
            ("", "EOF"),
            (
                "{\"drivegate_marks\": 3, \"marks\": {}}",
                "version 3, this gateway knows 2",
            ),
            ("{\"drivegate_marks\": \"2\", \"marks\": {}}", "version \"2\""),
            ("{\"drivegate_marks\": 2}", "missing field `marks`"),
            ("{\"marks\": {\"a\": 1, \"b\": 2, \"c\": 3}}", "3 marks"),
        ] {
            let error = Marks::from_json(text.as_bytes()).unwrap_err();
            assert!(error.contains(why), "{text}: {error}");
        }
        let later = Names::from_json(b"{\"drivegate_names\": 2, \"names\": []}").unwrap_err();
        assert!(later.contains("version 2, this gateway knows 1"), "{later}");
    }

    #[test]
    fn what_is_of_no_use_is_renamed_and_what_the_disk_refuses_stays() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("state/marks.json");
        assert!(matches!(Marks::load(&path), Ok(None)));
        marks(1).save(&path).unwrap();
        assert_eq!(Marks::load(&path).unwrap(), Some(marks(1)));
        fs::write(&path, vec![b' '; (1 << 16) + 1]).unwrap();
        let error = Marks::load(&path).unwrap_err();
        assert_eq!(error.to_string(), "it has 65537 bytes, more than 65536");
        assert!(path.exists(), "to look at a file renames nothing");
        assert_eq!(Marks::take_up(&path).unwrap(), None);
        assert!(!path.exists() && path.with_extension("damaged").exists());
        // A folder of this name cannot be read as a file.
        fs::create_dir(&path).unwrap();
        assert!(Marks::take_up(&path).is_err() && path.is_dir());
        let failed = marks(1).save(&path).unwrap_err();
        assert!(failed.contains("marks.json: "), "{failed}");
    }

    #[test]
    fn a_disk_that_refuses_is_asked_again_until_it_returns_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("marks.json");
        fs::create_dir(&path).unwrap();
        assert_eq!(Marks::insist(&path, |_| false), None);
        let mut asked = 0;
        let found = Marks::insist(&path, |_| {
            asked += 1;
            if asked == 3 {
                fs::remove_dir(&path).unwrap();
                marks(2).save(&path).unwrap();
            }
            true
        });
        assert_eq!((found, asked), (Some(Some(marks(2))), 3));
    }

    #[test]
    fn a_failure_lasts_until_a_write_succeeds() {
        let mut failing = false;
        let full = || Err("marks.json: no space".to_string());
        for (done, fails) in [(Ok(()), false), (full(), true), (full(), true), (Ok(()), false)] {
            WORDS.report(&done, &mut failing);
            assert_eq!(failing, fails);
        }
    }
}
