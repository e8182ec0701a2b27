//! Entries of the journal with fields of their own: `journalctl -u drivegate DRIVE=pump-1`. The native protocol of
//! systemd-journald: one datagram an entry, one `NAME=value` a line.

use std::fmt::{self, Debug, Write as _};
use std::io::{self, Write};
use std::os::unix::fs::MetadataExt;
use std::os::unix::net::UnixDatagram;
use std::sync::Arc;

use tracing::Event;
use tracing::field::{Field, Visit};

use crate::printable;

const SOCKET: &str = "/run/systemd/journal/socket";
/// Fields that journald provides under names of its own.
const OWN_FIELDS: [&str; 4] = ["MESSAGE", "PRIORITY", "SYSLOG_IDENTIFIER", "TARGET"];
/// Longest entry, bytes; a datagram cannot exceed the send buffer of its socket, 200 KiB.
const LONGEST: usize = 64 << 10;

/// The socket of the journal.
#[derive(Debug, Clone)]
pub(super) struct Journald(Arc<UnixDatagram>);

impl Journald {
    /// The journal, if standard error is connected to it, which `JOURNAL_STREAM` shows.
    pub(super) fn of_stderr() -> Option<Journald> {
        if !reads_stderr() {
            return None;
        }
        let socket = UnixDatagram::unbound().ok()?;
        socket.connect(SOCKET).ok()?;
        Some(Journald(Arc::new(socket)))
    }
}

/// Whether journald reads standard error; then it takes a priority from `<3>` at the beginning of a line.
pub(crate) fn reads_stderr() -> bool {
    let stderr = std::fs::metadata("/proc/self/fd/2");
    let stream = std::env::var("JOURNAL_STREAM");
    matches!((stderr, stream), (Ok(stderr), Ok(stream)) if stream == format!("{}:{}", stderr.dev(), stderr.ino()))
}

impl Write for Journald {
    /// Sends one entry. While journald is being restarted, the entry goes to standard error, which journald reads later.
    fn write(&mut self, entry: &[u8]) -> io::Result<usize> {
        let sent = self.0.send(entry).or_else(|_| {
            self.0.connect(SOCKET)?;
            self.0.send(entry)
        });
        if sent.is_err() {
            io::stderr().write_all(&as_line(entry))?;
        }
        Ok(entry.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// The message of an entry as a line.
fn as_line(entry: &[u8]) -> Vec<u8> {
    let lines = entry.split_inclusive(|byte| *byte == b'\n');
    let message = lines.filter_map(|line| line.strip_prefix(b"MESSAGE=")).next();
    message.unwrap_or_default().to_vec()
}

/// The entry of an event whose line is `message`.
pub(super) fn entry(priority: u8, target: &str, message: &str, event: &Event<'_>) -> String {
    let mut fields = Fields(format!(
        "PRIORITY={priority}\nSYSLOG_IDENTIFIER=drivegate\nTARGET={target}\nMESSAGE={}\n",
        printable::line(cut(message, LONGEST / 2))
    ));
    event.record(&mut fields);
    fields.0
}

fn cut(text: &str, longest: usize) -> &str {
    let mut end = longest.min(text.len());
    while !text.is_char_boundary(end) {
        end -= 1;
    }
    text.get(..end).unwrap_or_default()
}

struct Fields(String);

impl Fields {
    fn add(&mut self, field: &Field, value: &str) {
        let legal = |c: char| match c.to_ascii_uppercase() {
            upper if upper.is_ascii_uppercase() || c.is_ascii_digit() => upper,
            _ => '_',
        };
        let name: String = field.name().chars().map(legal).collect();
        let name = name.trim_start_matches('_');
        let room = LONGEST.saturating_sub(self.0.len() + name.len() + 2);
        if name.is_empty() || value.len() > room || OWN_FIELDS.contains(&name) {
            return;
        }
        // Writing to a string cannot fail.
        let _ = writeln!(self.0, "{name}={}", printable::line(value));
    }
}

impl Visit for Fields {
    fn record_str(&mut self, field: &Field, value: &str) {
        self.add(field, value);
    }

    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        self.add(field, &fmt::format(format_args!("{value:?}")));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_entry_that_journald_does_not_take_is_a_line() {
        let entry = b"PRIORITY=4\nMESSAGE=drivegate::bus: lost bus=\"a\"\nBUS=a\n";
        assert_eq!(as_line(entry), b"drivegate::bus: lost bus=\"a\"\n");
        assert_eq!(as_line(b""), b"");
        assert_eq!(cut("\u{fc}\u{fc}", 3), "\u{fc}");
    }
}
