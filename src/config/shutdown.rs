//! How long the stops of a bus take when the gateway stops. Pure.

use std::time::Duration;

use super::BusSettings;
use crate::cache::{Access, DriveSpec, OnShutdown};
use crate::codec::{RequestPdu, Table};
use crate::drive::plan::WireTime;

/// What the service manager gives the gateway to stop: `TimeoutStopSec` of `systemd/drivegate.service`.
pub const UNIT_STOP_TIME: Duration = Duration::from_secs(90);
/// What of it the servers, the broker and the ports may take beside the stops of drives.
pub const OTHER_STOP_TIME: Duration = Duration::from_secs(10);

/// How long the stops of one bus take, one after the other, counted from the end of the exchange that is on the line.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ShutdownTime {
    /// Drives that are to be stopped.
    pub drives: usize,
    /// Every one of them answers, after its turnaround.
    pub answered: Duration,
    /// None of them answers any more: each costs `response_timeout` and wire time for every try.
    pub unanswered: Duration,
}

impl ShutdownTime {
    /// What to tell of that bus where the service manager may end the gateway before every drive had its stop.
    pub fn beyond_unit(&self, bus: &str) -> Option<String> {
        let wanted = self.unanswered + OTHER_STOP_TIME;
        let seconds = |time: Duration| time.as_secs_f64().ceil();
        (self.drives > 0 && wanted > UNIT_STOP_TIME).then(|| {
            format!(
                "stopping {} of bus `{bus}` with the gateway takes {:.1} s, and {:.0} s where they do not answer, longer \
                 than TimeoutStopSec={}s of drivegate.service leaves for it; raise it to {:.0}s or more in the unit \
                 (stop_grace_period in compose.yaml), lower response_timeout or retries, or split the bus",
                if self.drives == 1 { "1 drive".to_string() } else { format!("{} drives", self.drives) },
                self.answered.as_secs_f64(),
                seconds(self.unanswered),
                UNIT_STOP_TIME.as_secs(),
                seconds(wanted),
            )
        })
    }
}

impl BusSettings {
    /// How long the stops take that `on_shutdown = "stop"` asks for. A stop is one write; where the run command is a bit of
    /// a word, the word may have to be read first. Of a drive that does not answer the read is not repeated, the
    /// write is.
    pub fn shutdown_time(&self) -> ShutdownTime {
        let mut time = ShutdownTime::default();
        for drive in self.drives.iter().filter(|drive| is_stopped(drive)) {
            let Some((read, write)) = stop_of(drive) else { continue };
            let tries = self.options.retries.saturating_add(1);
            let timeout = self.options.response_timeout;
            let exchange = |pdu: &RequestPdu, turnaround| self.exchange(pdu, turnaround);
            let reading = |turnaround| read.as_ref().map_or(Duration::ZERO, |read| exchange(read, turnaround));
            time.drives += 1;
            time.answered += reading(drive.turnaround) + exchange(&write, drive.turnaround);
            time.unanswered += reading(timeout) + exchange(&write, timeout).saturating_mul(tries);
        }
        time
    }

    /// A whole exchange whose reply begins after `turnaround`.
    fn exchange(&self, pdu: &RequestPdu, turnaround: Duration) -> Duration {
        let (protocol, format) = (self.spec.protocol, &self.spec.format);
        let silence = protocol.silence(self.options.silence, format);
        WireTime::of(protocol, format, pdu).total(turnaround, silence)
    }
}

/// Whether the drive gets a stop at the end of the gateway.
fn is_stopped(drive: &DriveSpec) -> bool {
    drive.access == Access::Control && drive.on_shutdown == OnShutdown::Stop
}

/// The requests of a stop: the read of the control word, where there is one, and the write.
fn stop_of(drive: &DriveSpec) -> Option<(Option<RequestPdu>, RequestPdu)> {
    let (raw, _, invert) = drive.profile.run_bit()?;
    let (table, address) = (raw.table, raw.address);
    Some(match table {
        Table::Coil | Table::DiscreteInput => (None, RequestPdu::WriteCoil { address, on: invert }),
        Table::Input | Table::Holding => {
            let (start, count) = (address, 1);
            let read = RequestPdu::Read { table, start, count };
            (Some(read), RequestPdu::WriteRegister { address, value: 0 })
        }
    })
}

#[cfg(test)]
mod tests;
