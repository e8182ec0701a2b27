//! The file with the retained topics of this run: the next run clears those that it does not publish.

use std::fs;
use std::path::{Path, PathBuf};

use drivegate_core::files::{self, names::MQTT_TOPICS};

/// Topics in a file of their own, one in each line, which every version of the gateway reads.
#[derive(Debug)]
pub(super) struct TopicsFile {
    path: PathBuf,
    /// The topics to be kept for the next run.
    topics: Vec<String>,
    /// Whether the disk did not take them the last time; logged once.
    refused: bool,
}

impl TopicsFile {
    pub(super) fn in_dir(dir: &Path) -> TopicsFile {
        TopicsFile {
            path: dir.join(MQTT_TOPICS),
            topics: Vec::new(),
            refused: false,
        }
    }

    /// The topics of the last run.
    pub(super) fn read(&self) -> Vec<String> {
        let text = fs::read_to_string(&self.path).unwrap_or_default();
        text.lines().map(str::to_string).collect()
    }

    /// Replaces the topics.
    pub(super) fn keep(&mut self, topics: Vec<String>) {
        self.topics = topics;
        self.write();
    }

    /// Writes the topics again after somebody deleted the files.
    pub(super) fn restore(&mut self) {
        if !self.topics.is_empty() {
            self.write();
        }
    }

    /// Offers the topics again if the disk did not take them.
    pub(super) fn retry(&mut self) {
        if self.refused {
            self.write();
        }
    }

    fn write(&mut self) {
        let written = files::replace(&self.path, self.topics.join("\n").as_bytes());
        let file = self.path.display();
        match written {
            Ok(()) if std::mem::take(&mut self.refused) => {
                tracing::info!(target: "drivegate::north::mqtt", "{file} is saved again");
            }
            Err(error) if !std::mem::replace(&mut self.refused, true) => {
                tracing::warn!(
                    target: "drivegate::north::mqtt",
                    "{file}: {error}; topics removed before the next start are not cleared until that works; retrying"
                );
            }
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_that_the_disk_refuses_are_offered_again() {
        let folder = tempfile::tempdir().unwrap();
        let mut file = TopicsFile::in_dir(folder.path());
        assert!(file.read().is_empty());
        // No file can replace a folder.
        let path = folder.path().join(MQTT_TOPICS);
        fs::create_dir(&path).unwrap();
        file.keep(vec!["a/b".to_string(), "c".to_string()]);
        file.retry();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "nothing is left aside");
        fs::remove_dir(&path).unwrap();
        file.retry();
        assert_eq!(file.read(), ["a/b", "c"]);
        fs::remove_file(&path).unwrap();
        file.retry();
        assert!(!path.exists(), "there was nothing to repeat");
        file.restore();
        assert_eq!(TopicsFile::in_dir(folder.path()).read(), ["a/b", "c"]);
    }

    #[test]
    fn the_form_of_the_first_version_is_read_and_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(MQTT_TOPICS);
        fs::write(&path, "drivegate/hall/status\ndrivegate/hall/bus/line1").unwrap();
        let mut file = TopicsFile::in_dir(folder.path());
        let topics = file.read();
        assert_eq!(topics, ["drivegate/hall/status", "drivegate/hall/bus/line1"]);
        file.keep(topics);
        assert_eq!(
            fs::read_to_string(&path).unwrap(),
            "drivegate/hall/status\ndrivegate/hall/bus/line1"
        );
    }
}
