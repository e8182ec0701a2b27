//! Detects a Modbus TCP server at the other end of a raw connection on which no bytes ever arrived. Most of these
//! servers silently drop the frames of a serial line, which looks like a line whose drives are switched off.
//!
//! The check uses a separate connection, closed at once, in a thread: it requests a register, as a Modbus TCP
//! client does. On a line behind a raw port the request means nothing: it begins with an address that no drive may
//! have, and has no check code. The check is made only after long silence, and not again within an hour; once it
//! was answered, before each connection.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Time without a byte after which a connection counts as silent.
const SILENT: Duration = Duration::from_secs(5);
/// Time between two questions to a server.
const AGAIN: Duration = Duration::from_secs(3600);
/// Longest wait for the connection, and for the answer.
const PATIENCE: Duration = Duration::from_millis(500);
/// Transaction id, whose first byte is an address that Modbus reserves.
const TRANSACTION: [u8; 2] = [0xF8, 0x01];

/// Knowledge of the server behind a port, kept while the port is opened repeatedly.
#[derive(Debug, Clone, Default)]
pub(super) struct OtherServer(Arc<Known>);

#[derive(Debug, Default)]
struct Known {
    /// Whether the server responds to Modbus TCP.
    found: AtomicBool,
    /// Unit id used in the check: servers do not answer for all.
    unit: AtomicU8,
    asked: Mutex<Option<Instant>>,
}

impl OtherServer {
    /// A Modbus TCP server was recognised by its reply to a request for the drive `unit`.
    pub(super) fn recognised(&self, unit: u8) {
        self.0.unit.store(unit, Ordering::Relaxed);
        self.0.found.store(true, Ordering::Relaxed);
    }

    /// Whether a Modbus TCP server was recognised.
    pub(super) fn is_found(&self) -> bool {
        self.0.found.load(Ordering::Relaxed)
    }

    /// Whether the recognised server no longer exists: another one may have been set up.
    pub(super) fn is_gone(&self, stream: &TcpStream) -> bool {
        let unit = self.0.unit.load(Ordering::Relaxed);
        let still = stream.peer_addr().is_ok_and(|server| answers(server, unit));
        self.0.found.store(still, Ordering::Relaxed);
        !still
    }

    /// Notes that a request `frame` is about to be sent on `stream`, which has been open since `opened` without
    /// receiving any bytes.
    pub(super) fn nothing_came(&self, stream: &TcpStream, opened: Instant, frame: &[u8]) {
        let unit = frame.first().copied().unwrap_or_default();
        let now = Instant::now();
        // Addresses of RTU; a line of ASCII or N2 begins with a sign.
        let is_rtu =
            (1..=247).contains(&unit) && frame.len() >= 4 && !frame.ends_with(b"\n") && !frame.ends_with(b"\r");
        if !is_rtu || now.saturating_duration_since(opened) < SILENT {
            return;
        }
        let (Ok(server), Ok(silent)) = (stream.peer_addr(), stream.try_clone()) else {
            return;
        };
        self.ask(server, unit, Some(silent), now);
    }

    /// Notes that the server closed a connection at a request for the drive `unit` without ever sending bytes: some
    /// Modbus TCP servers do that when they receive a frame of a line.
    pub(super) fn hung_up(&self, server: SocketAddr, unit: u8) {
        self.ask(server, unit, None, Instant::now());
    }

    /// Checks the server in a thread; a connection that waits without success is ended where the server responds.
    fn ask(&self, server: SocketAddr, unit: u8, silent: Option<TcpStream>, now: Instant) {
        let mut asked = self.0.asked.lock().unwrap_or_else(PoisonError::into_inner);
        if asked.is_some_and(|asked| now.saturating_duration_since(asked) < AGAIN) {
            return;
        }
        *asked = Some(now);
        let known = self.clone();
        let asking = move || {
            if answers(server, unit) {
                known.recognised(unit);
                // The shutdown wakes all waiting callers; the error is then reported when the connection is opened again.
                let ended = silent.map(|silent| silent.shutdown(Shutdown::Both));
                tracing::debug!(target: "drivegate::line", ?ended, "a Modbus TCP server answers instead of a line");
            }
        };
        let started = std::thread::Builder::new()
            .name("other server".to_string())
            .spawn(asking);
        if let Err(error) = started {
            tracing::debug!(target: "drivegate::line", "the server was not probed for Modbus TCP: {error}");
        }
    }
}

/// Whether the server answers a request for a register, sent as by a Modbus TCP client.
fn answers(server: SocketAddr, unit: u8) -> bool {
    let [high, low] = TRANSACTION;
    let question = [high, low, 0, 0, 0, 6, unit, 3, 0, 0, 0, 1];
    let ask = || {
        let mut stream = TcpStream::connect_timeout(&server, PATIENCE)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        stream.set_write_timeout(Some(PATIENCE))?;
        stream.write_all(&question)?;
        let mut head = [0; 9];
        stream.read_exact(&mut head)?;
        Ok::<_, std::io::Error>(head)
    };
    ask().is_ok_and(|head| is_answer(&head, unit))
}

fn is_answer(head: &[u8; 9], unit: u8) -> bool {
    let [high, low] = TRANSACTION;
    // The answer is a register, or an exception.
    matches!(*head, [a, b, 0, 0, 0, length, c, function, next]
        if (a, b, c) == (high, low, unit)
            && matches!((length, function, next), (5, 3, 2) | (3, 0x83, 1..=11)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_is_one_to_the_question() {
        assert!(is_answer(&[0xF8, 1, 0, 0, 0, 5, 7, 3, 2], 7));
        assert!(is_answer(&[0xF8, 1, 0, 0, 0, 3, 7, 0x83, 0x0B], 7));
        for other in [
            [0xF8, 1, 0, 0, 0, 6, 7, 3, 0],
            [0xF8, 1, 0, 0, 0, 5, 8, 3, 2],
            [1, 3, 2, 0, 0, 0xB8, 0x44, 0, 0],
            [0; 9],
        ] {
            assert!(!is_answer(&other, 7), "{other:02X?}");
        }
    }
}
