//! How long one transaction may keep the line from a stop. Pure.

use std::time::Duration;

use super::BusOptions;
use drivegate_core::process_image::{BusSpec, DriveSpec};
use drivegate_model::drive::plan::WireTime;
use drivegate_proto::{Protocol, RequestPdu, Table};

/// Longest transaction on a line with these drives: the drive with the longest times answers the longest read at the end
/// of its `response_timeout`.
pub fn longest_transaction<'d>(
    spec: &BusSpec,
    options: &BusOptions,
    drives: impl Iterator<Item = &'d DriveSpec>,
) -> Duration {
    let (protocol, format) = (spec.protocol, &spec.format);
    let longest = match protocol {
        Protocol::ModbusRtu | Protocol::ModbusAscii => RequestPdu::read(Table::Holding, 0, Table::Holding.max_read()),
        Protocol::N2 => RequestPdu::Other(Vec::new()),
    };
    let wire = WireTime::of(protocol, format, &longest);
    let silence = protocol.silence(options.silence, format);
    let time = |drive: &DriveSpec| {
        let timeout = drive.timing.response_timeout.unwrap_or(options.response_timeout);
        wire.total(timeout, drive.timing.silence_around(silence))
    };
    drives.map(time).max().unwrap_or_default()
}

/// Time of one stop to each of these drives, if all answer at once.
pub(crate) fn stops_of_all<'d>(
    spec: &BusSpec,
    options: &BusOptions,
    drives: impl Iterator<Item = &'d DriveSpec>,
) -> Duration {
    let (protocol, format) = (spec.protocol, &spec.format);
    let wire = WireTime::of(protocol, format, &RequestPdu::write_register(0, 0));
    let silence = protocol.silence(options.silence, format);
    drives
        .map(|drive| wire.total(drive.turnaround, drive.timing.silence_around(silence)))
        .sum()
}
