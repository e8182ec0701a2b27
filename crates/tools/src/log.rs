//! Log lines: for the journal under systemd, coloured on a terminal, else JSON.

mod journald;
mod line;

use std::io::IsTerminal;
use std::sync::atomic::{AtomicUsize, Ordering};

use tracing::{Level, Metadata};
use tracing_appender::non_blocking::{ErrorCounter, NonBlocking, NonBlockingBuilder, WorkerGuard};
use tracing_subscriber::filter::LevelFilter;
use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::fmt::writer::BoxMakeWriter;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer, Registry, reload};

use self::journald::Journald;
pub(super) use self::journald::reads_stderr;
use self::line::{Form, LogLine};
use drivegate_core::order::SENT;
use drivegate_gateway::config::{LogFormat, LogSettings};

/// Log target of commands (`command::AuditRecord`), and the level of their lines.
const AUDIT: &str = "audit";
const AUDIT_LINES: Level = Level::INFO;

/// Lines buffered for a slow reader of the log, and as many of commands that were sent to a drive; further ones are dropped
/// and counted.
const WAITING: usize = 4096;

/// The log of a running program; buffered lines are written when this handle is dropped.
#[derive(Debug)]
pub(super) struct LogHandle {
    filter: reload::Handle<EnvFilter, Registry>,
    lost: [ErrorCounter; 2],
    reported: AtomicUsize,
    _writers: [WorkerGuard; 2],
}

impl LogHandle {
    /// Sets the level; a format change needs a restart.
    pub(super) fn set_level(&self, level: &str) {
        if let Err(error) = self.filter.reload(filter(level)) {
            tracing::error!(target: "drivegate::cli::log", "cannot set the log level, keeping the current one: {error}");
        }
    }

    /// Reports how many lines were dropped since the last report, if any.
    pub(super) fn report_lost(&self) {
        let lost = self.lost.iter().map(ErrorCounter::dropped_lines).sum::<usize>();
        let more = lost.saturating_sub(self.reported.swap(lost, Ordering::Relaxed));
        if more > 0 {
            tracing::warn!(target: "drivegate::cli::log", "dropped {more} log lines: the reader of the log is too slow or has stopped");
        }
    }
}

/// Two queues to standard error, so that no other line can displace those about commands that were sent to a drive.
struct Ways {
    sent: NonBlocking,
    others: NonBlocking,
}

impl<'w> MakeWriter<'w> for Ways {
    type Writer = NonBlocking;

    fn make_writer(&'w self) -> NonBlocking {
        self.others.clone()
    }

    fn make_writer_for(&'w self, metadata: &Metadata<'_>) -> NonBlocking {
        match metadata.name() {
            SENT => self.sent.clone(),
            _ => self.others.clone(),
        }
    }
}

/// Starts logging to standard error on separate threads: a reader that stalls (a full pipe, a hanging collector)
/// must not delay a stop.
pub(super) fn start(settings: &LogSettings) -> LogHandle {
    let takes_entries = matches!(settings.format, LogFormat::Auto | LogFormat::Journal);
    let journal = Journald::of_stderr().filter(|_| takes_entries);
    let form = match journal {
        Some(_) => Form::Entry,
        None => form(settings.format),
    };
    let way = |name: &str| {
        let way = NonBlockingBuilder::default()
            .buffered_lines_limit(WAITING)
            .lossy(true)
            .thread_name(name);
        match &journal {
            Some(journal) => way.finish(journal.clone()),
            None => way.finish(std::io::stderr()),
        }
    };
    let ((sent, sent_guard), (others, others_guard)) = (way("log-commands"), way("log"));
    let lost = [sent.error_counter(), others.error_counter()];
    LogHandle {
        filter: subscribe(&settings.level, form, BoxMakeWriter::new(Ways { sent, others })),
        lost,
        reported: AtomicUsize::new(0),
        _writers: [sent_guard, others_guard],
    }
}

/// Starts logging for a short-lived command: synchronously, so that log lines and output keep their order.
pub(super) fn start_in_order(settings: &LogSettings) {
    subscribe(
        &settings.level,
        form(settings.format),
        BoxMakeWriter::new(std::io::stderr),
    );
}

/// The form of lines on standard error.
fn form(format: LogFormat) -> Form {
    match format {
        LogFormat::Journal => Form::Priority,
        LogFormat::Auto if std::env::var_os("JOURNAL_STREAM").is_some() => Form::Priority,
        LogFormat::Text => Form::Text,
        LogFormat::Auto if std::io::stderr().is_terminal() => Form::Text,
        LogFormat::Json | LogFormat::Auto => Form::Json,
    }
}

fn subscribe(level: &str, form: Form, writer: BoxMakeWriter) -> reload::Handle<EnvFilter, Registry> {
    let (filter, handle) = reload::Layer::new(filter(level));
    let terminal = std::io::stderr().is_terminal();
    let lines = tracing_subscriber::fmt::layer().with_writer(writer).with_ansi(terminal);
    let line = LogLine::new(form);
    let lines = match form {
        Form::Entry | Form::Priority | Form::Text => lines.event_format(line).boxed(),
        Form::Json => lines.json().event_format(line).boxed(),
    };
    // A second start in one process keeps the first subscriber.
    if tracing_subscriber::registry()
        .with(filter)
        .with(lines)
        .try_init()
        .is_err()
    {
        tracing::debug!(target: "drivegate::cli::log", "logging was started before");
    }
    handle
}

/// The filter for a valid `level`. Audit lines pass at any level except `off`, be it set for everything or for the
/// audit itself.
fn filter(level: &str) -> EnvFilter {
    // The last level for a target is used, as in the filter itself.
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
