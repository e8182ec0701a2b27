//! Writes a log line as one line of plain text, whatever its fields contain; warnings of libraries are limited.

use std::collections::BTreeMap;
use std::fmt::{self, Write};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use tracing::{Event, Level, Metadata, Subscriber};
use tracing_log::NormalizeEvent;
use tracing_subscriber::fmt::format::{Format, Json, Writer};
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields};
use tracing_subscriber::registry::LookupSpan;

use super::{AUDIT, journald};
use crate::printable;

/// Shortest time between two lines of one kind that a library logs.
const INTERVAL: Duration = Duration::from_secs(60);
/// Maximum number of kinds of lines that are distinguished; they are places in the source code, so this is never reached.
const KINDS: usize = 1024;
/// Bytes that hold a usual line, so that its text need not grow step by step.
const USUAL: usize = 512;
/// Start of the targets of our own log lines.
const OWN: &str = "drivegate";

/// The format of a log line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Form {
    /// An entry of the journal, with fields.
    Entry,
    /// A line that begins with the priority, which the journal reads.
    Priority,
    /// Lines are plain text.
    Text,
    /// A JSON object.
    Json,
}

/// Formats log lines.
pub(super) struct LogLine {
    form: Form,
    json: Format<Json>,
    libraries: Mutex<Libraries>,
}

impl LogLine {
    pub(super) fn new(form: Form) -> LogLine {
        LogLine {
            form,
            json: Format::default().json().flatten_event(true),
            libraries: Mutex::default(),
        }
    }
}

impl<S, N> FormatEvent<S, N> for LogLine
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
{
    fn format_event(&self, context: &FmtContext<'_, S, N>, mut writer: Writer<'_>, event: &Event<'_>) -> fmt::Result {
        // Records of the `log` crate have their target and source position in fields.
        let normalized = event.normalized_metadata();
        let metadata = normalized.as_ref().unwrap_or_else(|| event.metadata());
        let mut libraries = self.libraries.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(left_out) = libraries.permit(metadata, Instant::now()) else {
            return Ok(());
        };
        drop(libraries);
        let mut text = String::with_capacity(USUAL);
        match self.form {
            Form::Json => {
                self.json.format_event(context, Writer::new(&mut text), event)?;
                if left_out > 0 {
                    let end = text.trim_end().trim_end_matches('}').len();
                    text.insert_str(end, &format!(",\"left_out\":{left_out}"));
                }
            }
            Form::Entry | Form::Priority | Form::Text => {
                context.format_fields(Writer::new(&mut text), event)?;
                if left_out > 0 {
                    write!(text, " left_out={left_out}")?;
                }
            }
        }
        match self.form {
            Form::Entry => {
                let target = metadata.target();
                let message = format!("{target}: {text}");
                return writer.write_str(&journald::entry(priority(*metadata.level()), target, &message, event));
            }
            Form::Priority | Form::Text => self.head(metadata, &mut writer)?,
            Form::Json => {}
        }
        writeln!(writer, "{}", printable::line(text.trim_end_matches('\n')))
    }
}

impl LogLine {
    /// Writes the part before the fields: for the journal the priority, which it reads, and no time, which it adds.
    fn head(&self, metadata: &Metadata<'_>, writer: &mut Writer<'_>) -> fmt::Result {
        let colour = match *metadata.level() {
            Level::ERROR => 31,
            Level::WARN => 33,
            Level::INFO => 32,
            Level::DEBUG => 34,
            Level::TRACE => 35,
        };
        let (level, target) = (metadata.level(), metadata.target());
        if self.form == Form::Priority {
            return write!(writer, "<{}>{target}: ", priority(*level));
        }
        let time = humantime::format_rfc3339_micros(SystemTime::now());
        if writer.has_ansi_escapes() {
            write!(
                writer,
                "\x1b[2m{time}\x1b[0m \x1b[{colour}m{level:>5}\x1b[0m \x1b[2m{target}:\x1b[0m "
            )
        } else {
            write!(writer, "{time} {level:>5} {target}: ")
        }
    }
}

/// Priority of the level in the journal.
fn priority(level: Level) -> u8 {
    match level {
        Level::ERROR => 3,
        Level::WARN => 4,
        Level::INFO => 6,
        Level::DEBUG | Level::TRACE => 7,
    }
}

/// A line in the source of a library: target and line number.
type Kind = (String, Option<u32>);

/// Messages of libraries seen recently: how often libraries log is outside the gateway's control.
#[derive(Debug, Default)]
struct Libraries(BTreeMap<Kind, (Instant, u64)>);

impl Libraries {
    /// The number of lines of this kind left out before this one; `None` if this line must be left out too.
    fn permit(&mut self, metadata: &Metadata<'_>, now: Instant) -> Option<u64> {
        let target = metadata.target();
        if target.starts_with(OWN) || target == AUDIT || *metadata.level() > Level::WARN {
            return Some(0);
        }
        let kind = (target.to_string(), metadata.line());
        let is_full = self.0.len() >= KINDS;
        match self.0.get_mut(&kind) {
            Some((last, left_out)) if now.saturating_duration_since(*last) < INTERVAL => {
                *left_out += 1;
                None
            }
            Some((last, left_out)) => {
                *last = now;
                Some(std::mem::take(left_out))
            }
            None if is_full => None,
            None => {
                self.0.insert(kind, (now, 0));
                Some(0)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io;
    use std::sync::Arc;

    use tracing_subscriber::Registry;
    use tracing_subscriber::fmt::MakeWriter;
    use tracing_subscriber::layer::SubscriberExt;

    use super::*;

    #[derive(Clone, Default)]
    struct Written(Arc<Mutex<Vec<u8>>>);

    impl io::Write for Written {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().unwrap().extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl<'w> MakeWriter<'w> for Written {
        type Writer = Written;

        fn make_writer(&'w self) -> Written {
            self.clone()
        }
    }

    fn logged(format: Form, events: impl FnOnce()) -> String {
        let written = Written::default();
        let lines = tracing_subscriber::fmt::layer()
            .with_writer(written.clone())
            .with_ansi(false);
        match format {
            Form::Json => {
                let lines = lines.json().event_format(LogLine::new(format));
                tracing::subscriber::with_default(Registry::default().with(lines), events);
            }
            _ => {
                let lines = lines.event_format(LogLine::new(format));
                tracing::subscriber::with_default(Registry::default().with(lines), events);
            }
        }
        String::from_utf8(written.0.lock().unwrap().clone()).unwrap()
    }

    #[test]
    fn no_field_makes_a_line_or_commands_a_terminal() {
        let bad = "x\n<3>forged: \x1b[2J\u{202e}y\u{9b}";
        for (format, head) in [
            (Form::Priority, "<4>drivegate"),
            (Form::Text, "20"),
            (Form::Json, "{\""),
        ] {
            let text = logged(
                format,
                || tracing::warn!(field = bad, debug = ?bad, shown = %bad, "{bad}"),
            );
            assert_eq!(text.lines().count(), 1, "{text}");
            let one = text.strip_suffix('\n').unwrap();
            assert!(one.starts_with(head) && one.matches("forged").count() == 4, "{one}");
            assert!(!one.chars().any(|c| c.is_control() || c == '\u{202e}'), "{one:?}");
            if format == Form::Json {
                let json: serde_json::Value = serde_json::from_str(one).unwrap();
                assert_eq!((&json["message"], &json["shown"]), (&bad.into(), &bad.into()));
            }
        }
    }

    #[test]
    fn an_entry_of_the_journal_has_a_field_for_each_value() {
        let bad = "a\nPRIORITY=0";
        let text = logged(Form::Entry, || {
            tracing::warn!(target: "audit", drive = "pump-1", bus = %"line1", count = 3, who = bad, priority = 9, "{bad}");
        });
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(
            lines[..3],
            ["PRIORITY=4", "SYSLOG_IDENTIFIER=drivegate", "TARGET=audit"]
        );
        assert!(
            lines[3].starts_with("MESSAGE=audit: a") && lines[3].contains("drive=\"pump-1\""),
            "{text}"
        );
        assert_eq!(lines[4..7], ["DRIVE=pump-1", "BUS=line1", "COUNT=3"]);
        assert!(lines[7].starts_with("WHO=a") && lines.len() == 8, "{text}");
    }

    #[test]
    fn libraries_are_limited_and_own_lines_are_not() {
        for (format, lines) in [(Form::Priority, 14), (Form::Json, 14)] {
            let text = logged(format, || {
                for n in 0..10 {
                    tracing::warn!(target: "rustls::conn", "bad record {n}");
                    tracing::warn!(target: "rumqttc::state", "again {n}");
                    tracing::warn!(target: "drivegate::bus", "own {n}");
                }
                tracing::warn!(target: "rustls::conn", "another place");
                tracing::warn!(target: "audit", "a command");
            });
            assert_eq!(text.lines().count(), lines, "{text}");
        }
        let mut libraries = Libraries::default();
        let start = Instant::now();
        let text = logged(Form::Text, || ());
        assert_eq!(text, "");
        tracing::subscriber::with_default(Registry::default(), || {
            let metadata = tracing::debug_span!(target: "rustls", "x").metadata();
            assert!(
                metadata.is_some_and(|m| libraries.permit(m, start) == Some(0)),
                "only warnings are limited"
            );
            let span = tracing::warn_span!(target: "rustls", "x");
            let metadata = span.metadata().unwrap();
            assert_eq!(libraries.permit(metadata, start), Some(0));
            assert_eq!(libraries.permit(metadata, start + INTERVAL / 2), None);
            assert_eq!(libraries.permit(metadata, start + INTERVAL / 2), None);
            assert_eq!(libraries.permit(metadata, start + INTERVAL), Some(2));
        });
    }
}
