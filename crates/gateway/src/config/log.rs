//! `[log]` and `[audit]`.

use std::path::Path;

use super::keys::{AUDIT, LOG};
use super::values;
use crate::command::AuditFileOptions;
use crate::document::{Finding, Reader};
use crate::files::names;

/// Format of log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LogFormat {
    /// The journal's under systemd, coloured on a terminal, else JSON lines.
    #[default]
    Auto,
    /// Lines with a priority for the journal, without time.
    Journal,
    /// Lines as text, coloured on a terminal.
    Text,
    /// One JSON object per line.
    Json,
}

/// The settings of the log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogSettings {
    /// Level, also per target: `info,drivegate::bus=debug`. Checked: every part is a level or
    /// `target=level`. Commands (target `audit`) are logged at any level but `off`.
    pub level: String,
    /// Format of the lines.
    pub format: LogFormat,
}

/// Words of a level.
const LEVELS: [&str; 6] = ["off", "error", "warn", "info", "debug", "trace"];
/// What [`parse_level`] accepts, as a regular expression.
pub(super) const PATTERN: &str = concat!(
    r"^\s*([A-Za-z0-9_:-]+=)?(off|error|warn|info|debug|trace)\s*",
    r"(,\s*([A-Za-z0-9_:-]+=)?(off|error|warn|info|debug|trace)\s*)*$"
);

/// `[audit]`; in `state_dir` and in `buffer`, that of MQTT, the gateway has other files.
pub(super) fn read_audit(reader: &Reader<'_>, state_dir: &Path, buffer: Option<&Path>) -> AuditFileOptions {
    let path = values::resolved(state_dir, AUDIT.file.get(reader));
    let own = [Some(state_dir), buffer].into_iter().flatten();
    if let Some(name) = own
        .filter_map(|dir| first_below(dir, &path))
        .find(|name| names::is_own(name))
    {
        reader.problem(
            AUDIT.file.name,
            format!("the gateway uses `{name}` for something else"),
            "give the audit file another name, such as \"audit.jsonl\"",
        );
    }
    let options = AuditFileOptions {
        path,
        max_bytes: AUDIT.max_bytes.get(reader),
    };
    reader.finish();
    options
}

pub(super) fn read(reader: &Reader<'_>) -> LogSettings {
    let settings = LogSettings {
        level: LOG.level.get(reader),
        format: LOG.format.get(reader),
    };
    reader.finish();
    settings
}

/// The file or directory in `dir` that `path` is, or is in.
fn first_below(dir: &Path, path: &Path) -> Option<String> {
    let real = |path: &Path| path.canonicalize().or_else(|_| std::path::absolute(path)).ok();
    let path = match path.canonicalize() {
        Ok(path) => path,
        // There is no such file yet.
        Err(_) => real(path.parent()?)?.join(path.file_name()?),
    };
    let first = path.strip_prefix(real(dir)?).ok()?.components().next()?;
    Some(first.as_os_str().to_string_lossy().into_owned())
}

/// `level` or `target=level`, joined by commas, as `tracing` reads them.
///
/// # Errors
/// A part is neither.
pub fn parse_level(text: &str) -> Result<String, Finding> {
    for part in text.split(',') {
        let part = part.trim();
        let (target, level) = match part.split_once('=') {
            Some((target, level)) => (Some(target), level),
            None => (None, part),
        };
        if !LEVELS.contains(&level) {
            return Err(values::unknown_word(level, LEVELS.into_iter()));
        }
        let sound = |t: &str| {
            !t.is_empty()
                && t.chars()
                    .all(|c| c.is_ascii_alphanumeric() || matches!(c, '_' | ':' | '-'))
        };
        if target.is_some_and(|target| !sound(target)) {
            return Err(Finding::new(
                format!("`{part}` has no valid target"),
                "write for example \"info,drivegate::bus=debug\"",
            ));
        }
    }
    Ok(text.replace(' ', ""))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels() {
        for good in ["info", "off", "info,drivegate::bus=debug", "warn, audit=info"] {
            let level = parse_level(good).unwrap();
            tracing_subscriber::EnvFilter::builder().parse(&level).unwrap();
        }
        for bad in [
            "",
            "inof",
            "INFO",
            "info,",
            "drivegate=",
            "=debug",
            "a b=info",
            "drivegate::bus",
        ] {
            assert!(parse_level(bad).is_err(), "{bad}");
        }
        assert_eq!(
            parse_level("debgu").unwrap_err().to_string(),
            "unknown word `debgu`; did you mean \"debug\"?"
        );
    }
}
