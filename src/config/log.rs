//! `[log]`.

use super::values;
use crate::document::Reader;

/// How log lines look.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LogFormat {
    /// The journal's under systemd, coloured on a terminal, else JSON lines.
    Auto,
    /// Lines with a priority for the journal, without time.
    Journal,
    /// Lines for people, coloured on a terminal.
    Text,
    /// One JSON object a line.
    Json,
}

/// What is logged, and how.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogSettings {
    /// Level, also for each target: `info,drivegate::bus=debug`. Checked: every part is a level or
    /// `target=level`. Commands (target `audit`) are logged at any level but `off`.
    pub level: String,
    /// How lines look.
    pub format: LogFormat,
}

/// Words of `format`.
pub(super) const FORMATS: [(&str, LogFormat); 4] = [
    ("auto", LogFormat::Auto),
    ("journal", LogFormat::Journal),
    ("text", LogFormat::Text),
    ("json", LogFormat::Json),
];
/// Words of a level.
pub(super) const LEVELS: [&str; 6] = ["off", "error", "warn", "info", "debug", "trace"];
pub(super) const DEFAULT_LEVEL: &str = "info";

impl Default for LogSettings {
    fn default() -> Self {
        LogSettings {
            level: DEFAULT_LEVEL.to_string(),
            format: LogFormat::Auto,
        }
    }
}

pub(super) fn read(reader: &Reader<'_>) -> LogSettings {
    let default = LogSettings::default();
    let level = reader.parsed("level", parse_level).unwrap_or(default.level);
    let format = values::choice(reader, "format", default.format, &FORMATS);
    reader.finish();
    LogSettings { level, format }
}

/// `level` or `target=level`, joined by commas, as `tracing` understands them.
///
/// # Errors
/// What is wrong and what to write.
pub(crate) fn parse_level(text: &str) -> Result<String, String> {
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
            return Err(format!(
                "`{part}` names no target; write for example \"info,drivegate::bus=debug\""
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
            parse_level("debgu"),
            Err("unknown word `debgu`; did you mean \"debug\"?".into())
        );
    }
}
