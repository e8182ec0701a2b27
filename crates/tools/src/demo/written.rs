//! The directory of `demo --write-config`: a configuration of the running demo, and the ports of its lines.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Beginning of a file that a demo wrote, which another demo may replace.
const MARK: &str = "# Written by `drivegate demo --write-config`";

/// The directory of a written demo.
#[derive(Debug)]
pub(super) struct Written {
    dir: PathBuf,
}

impl Written {
    /// Creates the directory; only files of another demo are replaced in it.
    ///
    /// # Errors
    /// If the directory cannot be made, or contains a configuration that is not a demo's.
    pub(super) fn prepare(dir: &Path) -> Result<Written, String> {
        let absolute = std::path::absolute(dir).unwrap_or_else(|_| dir.to_path_buf());
        let written = Written { dir: absolute };
        std::fs::create_dir_all(&written.dir).map_err(|why| {
            format!(
                "cannot create the directory {}: {why}; --write-config; choose another",
                dir.display()
            )
        })?;
        let config = written.config();
        match std::fs::read_to_string(&config) {
            Ok(text) if text.starts_with(MARK) => Ok(written),
            Err(why) if why.kind() == ErrorKind::NotFound => Ok(written),
            _ => Err(format!(
                "{} exists and does not belong to a demo, so it is left as it is; --write-config; choose another \
                 directory",
                config.display()
            )),
        }
    }

    /// Path of the configuration.
    pub(super) fn config(&self) -> PathBuf {
        self.dir.join("drivegate.toml")
    }

    /// The port of a line.
    pub(super) fn port(&self, line: &str) -> PathBuf {
        self.dir.join(line)
    }

    pub(super) fn socket(&self) -> PathBuf {
        self.dir.join("drivegate.sock")
    }

    /// The path of the directory.
    pub(super) fn dir(&self) -> &Path {
        &self.dir
    }

    pub(super) fn state_dir(&self) -> PathBuf {
        self.dir.join("state")
    }

    /// Writes the configuration.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub(super) fn write(&self, text: &str) -> Result<(), String> {
        let config = self.config();
        std::fs::write(
            &config,
            format!("{MARK}: its ports exist while that demo runs.\n\n{text}"),
        )
        .map_err(|why| {
            format!(
                "cannot write {}: {why}; --write-config; choose another directory",
                config.display()
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_a_demo_wrote_is_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let place = dir.path().join("new/demo");
        let written = Written::prepare(&place).unwrap();
        written.write("[gateway]\n").unwrap();
        assert!(Written::prepare(&place).is_ok());
        std::fs::write(written.config(), "[gateway]\n").unwrap();
        assert!(
            Written::prepare(&place)
                .unwrap_err()
                .contains("does not belong to a demo")
        );
    }
}
