//! The number of the session (bdSeq), which connects the death of a node to its birth, kept over restarts. Blocking: it
//! writes a file.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use crate::files::names::SPARKPLUG;

/// Gives each connection its number, 0 to 255 in a circle.
#[derive(Debug, Clone)]
pub(super) struct BdSeq {
    path: PathBuf,
    number: u8,
    /// Whether a broker has accepted a connection with the number.
    used: bool,
    /// Whether the number is in the file.
    kept: bool,
}

impl BdSeq {
    /// Goes on behind the number in the file, which was used last; begins with 0 without one, or if it cannot be read.
    pub(super) fn open(dir: &Path) -> BdSeq {
        let path = dir.join(SPARKPLUG);
        let text = fs::read_to_string(&path).unwrap_or_default();
        let last: Option<u8> = text.trim().parse().ok();
        BdSeq {
            path,
            number: last.map_or(0, |last| last.wrapping_add(1)),
            used: false,
            kept: false,
        }
    }

    /// The number of the next connection; the file has it when this returns. A connection that no broker accepted leaves
    /// its number to the next one.
    ///
    /// # Errors
    /// The file cannot be written; the number is valid all the same.
    pub(super) fn next(&mut self) -> (u8, io::Result<()>) {
        if self.kept && !self.used {
            return (self.number, Ok(()));
        }
        self.unkept();
        let written = self.write();
        self.kept = written.is_ok();
        (self.number, written)
    }

    /// The same without the file, which must be written later.
    pub(super) fn unkept(&mut self) -> u8 {
        if std::mem::take(&mut self.used) {
            self.number = self.number.wrapping_add(1);
        }
        self.kept = false;
        self.number
    }

    /// A broker accepted a connection with the number.
    pub(super) fn accepted(&mut self) {
        self.used = true;
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    fn write(&self) -> io::Result<()> {
        if let Some(dir) = self.path.parent() {
            fs::create_dir_all(dir)?;
        }
        let new = self.path.with_extension("new");
        let mut file = File::create(&new)?;
        writeln!(file, "{}", self.number)?;
        file.sync_data()?;
        fs::rename(&new, &self.path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn next(bd_seq: &mut BdSeq) -> u8 {
        let (number, written) = bd_seq.next();
        written.unwrap();
        number
    }

    #[test]
    fn numbers_go_on_over_restarts() {
        let dir = tempfile::tempdir().unwrap();
        let state = dir.path().join("state");
        let mut bd_seq = BdSeq::open(&state);
        assert_eq!(
            (next(&mut bd_seq), next(&mut bd_seq)),
            (0, 0),
            "no broker took the first"
        );
        for expected in 1..=255 {
            bd_seq.accepted();
            assert_eq!(next(&mut bd_seq), expected);
        }
        bd_seq.accepted();
        assert_eq!(next(&mut bd_seq), 0);
        // Killed before or after the broker accepted the connection: the next run cannot know.
        assert_eq!(next(&mut BdSeq::open(&state)), 1);
        assert_eq!(next(&mut BdSeq::open(&state)), 2);
        fs::write(state.join(SPARKPLUG), "damaged").unwrap();
        assert_eq!(next(&mut BdSeq::open(&state)), 0);
    }

    #[test]
    fn without_a_directory_the_numbers_begin_anew() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("file");
        fs::write(&file, "").unwrap();
        let mut bd_seq = BdSeq::open(&file);
        for expected in 0..3 {
            let (number, written) = bd_seq.next();
            assert_eq!((number, written.is_err()), (expected, true));
            bd_seq.accepted();
        }
    }
}
