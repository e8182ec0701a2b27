//! Log lines: for the journal under systemd, coloured on a terminal, else JSON.

use std::fmt;
use std::io::IsTerminal;
use std::sync::atomic::{AtomicUsize, Ordering};

use tracing::{Event, Level, Subscriber};
use tracing_appender::non_blocking::{ErrorCounter, NonBlockingBuilder, WorkerGuard};
use tracing_subscriber::filter::LevelFilter;
use tracing_subscriber::fmt::format::Writer;
use tracing_subscriber::fmt::writer::BoxMakeWriter;
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::registry::LookupSpan;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer, Registry, reload};

use crate::config::{LogFormat, LogSettings};

/// Where commands are logged (`command::AuditRecord`), and the level of their lines.
const AUDIT: &str = "audit";
const AUDIT_LINES: Level = Level::INFO;

/// Lines buffered for a slow reader of the log; further ones are dropped and counted.
const WAITING: usize = 8192;

/// The log of a running program; buffered lines are written when it is dropped.
#[derive(Debug)]
pub(super) struct LogHandle {
    filter: reload::Handle<EnvFilter, Registry>,
    lost: ErrorCounter,
    reported: AtomicUsize,
    _writer: WorkerGuard,
}

impl LogHandle {
    /// Sets the level; a format change needs a restart.
    pub(super) fn set_level(&self, level: &str) {
        if let Err(error) = self.filter.reload(filter(level)) {
            tracing::error!("cannot set the log level, keeping the current one: {error}");
        }
    }

    /// Reports how many lines were dropped since the last report, if any.
    pub(super) fn report_lost(&self) {
        let lost = self.lost.dropped_lines();
        let more = lost.saturating_sub(self.reported.swap(lost, Ordering::Relaxed));
        if more > 0 {
            tracing::warn!("dropped {more} log lines: the reader of the log is too slow or has stopped");
        }
    }
}

/// Starts logging to standard error, on a thread of its own: a reader that stalls (a full pipe, a hanging collector) must
/// not delay a stop.
pub(super) fn start(settings: &LogSettings) -> LogHandle {
    let (writer, guard) = NonBlockingBuilder::default()
        .buffered_lines_limit(WAITING)
        .lossy(true)
        .thread_name("log")
        .finish(std::io::stderr());
    let lost = writer.error_counter();
    LogHandle {
        filter: subscribe(settings, BoxMakeWriter::new(writer)),
        lost,
        reported: AtomicUsize::new(0),
        _writer: guard,
    }
}

/// Starts logging for a one-shot command: synchronously, so that log lines and output keep their order.
pub(super) fn start_in_order(settings: &LogSettings) {
    subscribe(settings, BoxMakeWriter::new(std::io::stderr));
}

fn subscribe(settings: &LogSettings, writer: BoxMakeWriter) -> reload::Handle<EnvFilter, Registry> {
    let (filter, handle) = reload::Layer::new(filter(&settings.level));
    let terminal = std::io::stderr().is_terminal();
    let format = match settings.format {
        LogFormat::Auto if std::env::var_os("JOURNAL_STREAM").is_some() => LogFormat::Journal,
        LogFormat::Auto if terminal => LogFormat::Text,
        LogFormat::Auto => LogFormat::Json,
        other => other,
    };
    let lines = tracing_subscriber::fmt::layer().with_writer(writer);
    let lines = match format {
        LogFormat::Journal => lines.with_ansi(false).event_format(JournalLine).boxed(),
        LogFormat::Text => lines.with_ansi(terminal).with_target(true).boxed(),
        LogFormat::Json | LogFormat::Auto => lines.json().flatten_event(true).boxed(),
    };
    // A second start in one process keeps the first subscriber.
    if tracing_subscriber::registry()
        .with(filter)
        .with(lines)
        .try_init()
        .is_err()
    {
        tracing::debug!("logging was started before");
    }
    handle
}

/// The filter of a valid `level`. Audit lines pass at any level but `off`, of everything or of the audit itself.
fn filter(level: &str) -> EnvFilter {
    // The last one of a target wins, as in the filter itself.
    let last = |wanted: Option<&str>| {
        let mut parts = level.split(',').map(|part| match part.split_once('=') {
            Some((target, level)) => (Some(target), level),
            None => (None, part),
        });
        let (_, found) = parts.rfind(|(target, _)| *target == wanted)?;
        found.parse::<LevelFilter>().ok()
    };
    let own = last(Some(AUDIT));
    let silent = own.or(last(None)) == Some(LevelFilter::OFF);
    if silent || own.is_some_and(|own| own >= AUDIT_LINES) {
        return EnvFilter::new(level);
    }
    EnvFilter::new(format!("{level},{AUDIT}={AUDIT_LINES}"))
}

/// A line with its priority in front, as systemd reads it; the journal adds the time.
struct JournalLine;

impl<S, N> FormatEvent<S, N> for JournalLine
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
{
    fn format_event(&self, context: &FmtContext<'_, S, N>, mut writer: Writer<'_>, event: &Event<'_>) -> fmt::Result {
        let priority = match *event.metadata().level() {
            Level::ERROR => 3,
            Level::WARN => 4,
            Level::INFO => 6,
            Level::DEBUG | Level::TRACE => 7,
        };
        write!(writer, "<{priority}>{}: ", event.metadata().target())?;
        context.format_fields(writer.by_ref(), event)?;
        writeln!(writer)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_are_logged_at_any_level_that_says_anything() {
        for (level, commands, others) in [
            ("info", true, true),
            ("warn", true, false),
            ("error", true, false),
            ("debug", true, true),
            ("off", false, false),
            ("warn,drivegate::bus=debug", true, false),
            ("drivegate::bus=debug", true, false),
            ("warn,aud=off", true, false),
            ("warn,audit=warn", true, false),
            ("audit=debug,warn", true, false),
            ("info,audit=off", false, true),
            ("audit=off,audit=info,off", true, false),
            ("off,audit=info", true, false),
            ("off,drivegate=warn", false, false),
            ("off,warn", true, false),
        ] {
            let log = Registry::default().with(filter(level));
            let seen = tracing::subscriber::with_default(log, || {
                (
                    tracing::enabled!(target: "audit", Level::INFO),
                    tracing::enabled!(target: "drivegate::plant", Level::INFO),
                )
            });
            assert_eq!(seen, (commands, others), "{level}");
        }
    }
}
