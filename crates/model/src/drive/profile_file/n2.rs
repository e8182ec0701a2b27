//! `[n2]` of a profile file: where the family's N2 differs from [`drivegate_proto::n2::ASSUMPTIONS`].

use std::ops::RangeInclusive;
use std::time::Duration;

use crate::document::Reader;
use crate::drive::profile::Point;
use drivegate_proto::n2::RegionWidth;
use drivegate_proto::{N2Options, Protocol};

/// Time between two polls: drives assume that the master has failed after about 10 minutes without a poll.
const POLLS: RangeInclusive<Duration> = Duration::from_secs(1)..=Duration::from_secs(480);

pub(super) fn read_n2(reader: &Reader<'_>, protocols: &[Protocol]) -> N2Options {
    let default = N2Options::DEFAULT;
    let Some(table) = reader.table("n2") else {
        return default;
    };
    if !protocols.contains(&Protocol::N2) {
        reader.problem(
            "n2",
            "the profile is not for n2",
            "remove the section or add \"n2\" to `protocols`",
        );
    }
    let region_width = match table.or("region_width", default.region_width.digits()) {
        1 => RegionWidth::One,
        2 => RegionWidth::Two,
        other => {
            table.problem(
                "region_width",
                format!("{other} is not a valid width of the region"),
                "write 1 or 2",
            );
            default.region_width
        }
    };
    let first_object = table.or("first_object", default.first_object);
    if first_object > 1 {
        table.problem(
            "first_object",
            format!("{first_object} is not the number of a first object"),
            "write 0 or 1",
        );
    }
    let poll = table.or("poll", default.poll);
    if !POLLS.contains(&poll) {
        table.problem(
            "poll",
            "the time between two polls is out of range",
            "write \"1s\" to \"8min\": drives assume that the master is gone after 10 min",
        );
    }
    let options = N2Options {
        state_bit: read_bit(&table, "state_bit").unwrap_or(default.state_bit),
        unreliable_bit: read_bit(&table, "unreliable_bit"),
        region_width,
        first_object: first_object.min(1),
        identify: table.or("identify", default.identify),
        device_type: table.or("device_type", default.device_type),
        release: table.or("release", default.release),
        poll,
    };
    if options.unreliable_bit == Some(options.state_bit) {
        table.problem(
            "unreliable_bit",
            "the bit is already used for the state",
            "write another one or leave the key out",
        );
    }
    table.finish();
    options
}

fn read_bit(table: &Reader<'_>, key: &str) -> Option<u8> {
    let bit: u8 = table.optional(key)?;
    if bit > 7 {
        table.problem(key, format!("a status byte has no bit {bit}"), "write 0 to 7");
    }
    (bit <= 7).then_some(bit)
}

/// N2 outputs are stored in EEPROM with limited write cycles: unless a point has its own `on_change`, they are
/// written on change only. Pulses are always written.
pub(super) fn write_on_change(tables: &[Reader<'_>], points: &mut [Point]) {
    for (table, point) in tables.iter().zip(points) {
        if point.write && !point.pulse && point.raw().is_some() && !table.has("on_change") {
            point.on_change = true;
        }
    }
}
