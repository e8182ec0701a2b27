//! How long stopping the drives of a bus takes when the gateway shuts down. Pure.

use std::time::Duration;

use super::settings::BusSettings;
use drivegate_bus::longest_transaction;
use drivegate_bus::stop_of_line::{BROADCAST_PAUSE, stop_of_line};
use drivegate_core::process_image::{Access, DriveSpec, OnShutdown, Timing};
use drivegate_model::document::Finding;
use drivegate_model::drive::control::{ControlItem, OwnWord};
use drivegate_model::drive::plan::WireTime;
use drivegate_proto::{RequestPdu, Table};

/// Time the service manager allows for shutdown: `TimeoutStopSec` of `systemd/drivegate.service`.
pub(crate) const UNIT_STOP_TIME: Duration = Duration::from_secs(90);
/// The part of the stop time that servers, broker and ports may need.
pub(crate) const OTHER_STOP_TIME: Duration = Duration::from_secs(10);

/// How long the stops of one bus take, one after another.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ShutdownTime {
    /// Number of drives to stop.
    pub drives: usize,
    /// Time if every drive answers, after its turnaround, from the end of the current transaction.
    pub answered: Duration,
    /// Time if no drive answers: each try takes `response_timeout` and the time on the wire. The transaction on the line,
    /// which may be one of a slower drive, ends before.
    pub unanswered: Duration,
}

impl ShutdownTime {
    /// The warning about this bus if the service manager may kill the gateway before every drive has its stop.
    pub(crate) fn beyond_unit(&self, bus: &str) -> Option<Finding> {
        let wanted = self.unanswered + OTHER_STOP_TIME;
        let seconds = |time: Duration| time.as_secs_f64().ceil();
        let drives = match self.drives {
            0 => return None,
            1 => "1 drive".to_string(),
            drives => format!("{drives} drives"),
        };
        let what = format!(
            "stopping {drives} of bus `{bus}` with the gateway takes {:.1} s, and {:.0} s if they do not reply, \
             longer than TimeoutStopSec={}s of drivegate.service allows",
            self.answered.as_secs_f64(),
            seconds(self.unanswered),
            UNIT_STOP_TIME.as_secs(),
        );
        let remedy = format!(
            "raise it to {:.0}s or more in the unit (stop_grace_period in compose.yaml), lower response_timeout or \
             retries, or split the bus",
            seconds(wanted)
        );
        (wanted > UNIT_STOP_TIME).then(|| Finding::new(what, remedy))
    }
}

impl BusSettings {
    /// How long the stops of `on_shutdown = "stop"` take. A stop is one write. If the run command is a bit of a
    /// word, the word may have to be read first. If a drive does not answer, the write is repeated but the read is
    /// not.
    pub fn shutdown_time(&self) -> ShutdownTime {
        let mut time = ShutdownTime::default();
        if let Some(stop) = stop_of_line(&self.spec, &self.drives).filter(|_| self.drives.iter().all(is_stopped)) {
            let broadcast = self.exchange(&stop, BROADCAST_PAUSE);
            time.answered += broadcast;
            time.unanswered += broadcast;
        }
        for drive in self.drives.iter().filter(|drive| is_stopped(drive)) {
            let Some((read, write)) = stop_of(drive) else { continue };
            let Timing {
                response_timeout,
                silence,
                retries,
            } = drive.timing;
            let tries = retries.unwrap_or(self.options.retries).saturating_add(1);
            let timeout = response_timeout.unwrap_or(self.options.response_timeout);
            let quiet = silence.unwrap_or_default();
            let exchange = |pdu: &RequestPdu, turnaround| self.exchange(pdu, turnaround) + 2 * quiet;
            let reading = |turnaround| read.as_ref().map_or(Duration::ZERO, |read| exchange(read, turnaround));
            time.drives += 1;
            time.answered += reading(drive.turnaround) + exchange(&write, drive.turnaround);
            time.unanswered += reading(timeout) + exchange(&write, timeout).saturating_mul(tries);
        }
        if time.drives > 0 {
            time.unanswered += longest_transaction(&self.spec, &self.options, self.drives.iter());
        }
        time
    }

    /// A whole transaction whose reply begins after `turnaround`.
    fn exchange(&self, pdu: &RequestPdu, turnaround: Duration) -> Duration {
        let (protocol, format) = (self.spec.protocol, &self.spec.format);
        let silence = protocol.silence(self.options.silence, format);
        WireTime::of(protocol, format, pdu).total(turnaround, silence)
    }
}

/// Whether the drive is stopped when the gateway shuts down.
fn is_stopped(drive: &DriveSpec) -> bool {
    drive.access == Access::Control && drive.on_shutdown == OnShutdown::Stop
}

/// The requests of a stop: the read of the control word, if needed, and the write.
fn stop_of(drive: &DriveSpec) -> Option<(Option<RequestPdu>, RequestPdu)> {
    let control = drive.profile.control.as_ref()?;
    let ControlItem { table, address } = control.stop.place.unwrap_or(control.at);
    let functions = drive.profile.functions;
    let word = control.stop_word(0);
    Some(match table {
        Table::Coil | Table::DiscreteInput => (None, functions.write_coil(address, word != 0)),
        Table::Input | Table::Holding => {
            let (start, count) = (address, 1);
            let read = RequestPdu::Read { table, start, count };
            let is_kept = control.own_word == OwnWord::Kept;
            (is_kept.then_some(read), functions.write_register(address, word))
        }
    })
}

#[cfg(test)]
mod tests;
