//! A line that is only listened to: this type has no way to send.

use std::os::fd::BorrowedFd;
use std::time::Instant;

use super::{Level, Line, LineOptions, Lost, Names, OpenError, Rs485, Spin, Woken};
use drivegate_proto::LineFormat;

/// Settings of such a port: the kernel switches no direction, and RTS, which enables the driver of many adapters,
/// is lowered. Linux raises RTS and DTR when a port is opened; they stay raised until these settings are applied.
const OPTIONS: LineOptions = LineOptions {
    rs485: Rs485::Off,
    rts_before_send: std::time::Duration::ZERO,
    rts_after_send: std::time::Duration::ZERO,
    rx_during_tx: false,
    termination: false,
    rts: Level::Off,
    dtr: Level::Driver,
    spin: Spin::Off,
    receives_only: true,
};

/// An open line that cannot send.
#[derive(Debug)]
pub struct Receiver(Line);

impl Receiver {
    /// Opens the port exclusively; the texts are warnings.
    ///
    /// # Errors
    /// If the port cannot be opened; see [`Line::open`].
    pub fn open(port: &str, format: &LineFormat) -> Result<(Receiver, Vec<String>), OpenError> {
        Receiver::open_by(&mut Names::default(), port, format, &|| true)
    }

    /// Opens a receiver like [`Line::open_by`].
    ///
    /// # Errors
    /// If the port cannot be opened; see [`Line::open`].
    pub fn open_by(
        names: &mut Names,
        port: &str,
        format: &LineFormat,
        go_on: &dyn Fn() -> bool,
    ) -> Result<(Receiver, Vec<String>), OpenError> {
        let (line, warnings) = Line::open_by(names, port, format, &OPTIONS, go_on)?;
        Ok((Receiver(line), warnings))
    }

    /// Reads the available bytes without waiting; returns 0 if there are none.
    ///
    /// # Errors
    /// When the port is lost.
    pub fn receive(&self, buffer: &mut [u8]) -> Result<usize, Lost> {
        self.0.receive(buffer)
    }

    /// Waits for bytes, for `wake`, or for the time.
    ///
    /// # Errors
    /// If the system reports an error while waiting.
    pub fn wait(&self, until: Instant, wake: Option<BorrowedFd<'_>>) -> Result<Woken, Lost> {
        self.0.wait(until, wake, false)
    }
}
