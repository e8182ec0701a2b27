//! Reads the sections `[log]` and `[audit]`.

use std::path::Path;

use super::keys::{AUDIT, LOG, LogFormat};
use super::values;
use drivegate_core::files::names;
use drivegate_core::order::AuditFileOptions;
use drivegate_model::document::Reader;

/// The settings of the log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogSettings {
    /// Level, also per target: `info,drivegate::bus=debug`. Checked: every part is a level or
    /// `target=level`. Commands (target `audit`) are logged at any level but `off`.
    pub level: String,
    /// Format of the log lines.
    pub format: LogFormat,
}

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
        // The file does not exist yet, so its directory is resolved.
        Err(_) => real(path.parent()?)?.join(path.file_name()?),
    };
    let first = path.strip_prefix(real(dir)?).ok()?.components().next()?;
    Some(first.as_os_str().to_string_lossy().into_owned())
}
