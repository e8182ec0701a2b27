//! `[log]` and `[audit]`.

use super::forms::*;

/// Words of a level.
const LEVELS: [&str; 6] = ["off", "error", "warn", "info", "debug", "trace"];
/// The levels that [`parse_level`] accepts, as a regular expression.
const PATTERN: &str = concat!(
    r"^\s*([A-Za-z0-9_:-]+=)?(off|error|warn|info|debug|trace)\s*",
    r"(,\s*([A-Za-z0-9_:-]+=)?(off|error|warn|info|debug|trace)\s*)*$"
);

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
    /// Each line is a JSON object.
    Json,
}

keys! {
    /// What is logged.
    LOG: Log {
        /// Level, also per target: `"info,drivegate::bus=debug"` logs more about the buses. Every command is logged
        /// under target `audit`, even at `"error"`; only `"off"` and `audit=off` disable that.
        level: String = Parsed {
            parse: parse_level, words: &[], pattern: PATTERN,
            range: "\"off\", \"error\", \"warn\", \"info\", \"debug\" or \"trace\"",
        }, default "info";
        /// `"auto"`: journal format under systemd, coloured text on a terminal, otherwise one JSON object per line.
        format: LogFormat = Words(&[
            ("auto", LogFormat::Auto), ("journal", LogFormat::Journal), ("text", LogFormat::Text),
            ("json", LogFormat::Json),
        ]), default "auto";
    }

    /// File of all commands, in which every change shows; see [the audit file](commands.md#the-audit-file).
    AUDIT: AuditTable {
        /// The file, used for nothing else; a relative path is relative to `state_dir` of `[gateway]`.
        file: PathBuf = PATH, default "audit.jsonl";
        /// Total size of the file and the seven older ones; the oldest is deleted.
        max_bytes: u64 = BUFFER_SIZE, default "64MiB";
    }
}

/// Parses `level` or `target=level`, joined by commas, as `tracing` does.
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
