//! `[[bus]]` and `[[bus.drive]]`.

use serde_json::{Value, json};

use super::forms::{DURATION, duration, flag, name, number, pattern, table, tables, text, with_default, words};
use crate::codec::Protocol;
use crate::config::{bus, drive};
use crate::drive::ModelPoint;

/// A line and its drives.
pub(super) fn bus() -> Value {
    table(
        "One line with its drives.",
        &["name", "port"],
        [
            ("name", name("Name of the bus, unique.", "-_")),
            (
                "port",
                text(
                    "Path of the serial device, best under /dev/serial/by-id, or tcp://host:port (raw serial \
                     over TCP).",
                ),
            ),
            (
                "protocol",
                with_default(
                    words("What the drives speak.", Protocol::ALL.iter().map(|p| p.name())),
                    bus::DEFAULT_PROTOCOL.name(),
                ),
            ),
            (
                "baud",
                with_default(number("Bits a second.", &bus::BAUDS), bus::DEFAULT_BAUD),
            ),
            (
                "format",
                pattern(
                    &format!(
                        "Data bits, parity, stop bits; without it {}, with modbus-ascii {}.",
                        bus::DEFAULT_FORMAT,
                        bus::DEFAULT_ASCII_FORMAT
                    ),
                    "^[78][NEOneo][12]$",
                ),
            ),
            (
                "rs485",
                with_default(
                    words(
                        "Who switches the direction: the adapter itself (off) or the kernel by RTS.",
                        bus::RS485.iter().map(|(w, _)| *w),
                    ),
                    "off",
                ),
            ),
            (
                "cycle",
                duration(
                    "Cadence aimed at for process data (poll class fast).",
                    Some(bus::DEFAULT_CYCLE),
                ),
            ),
            (
                "slow_cycle",
                duration(
                    "Cadence aimed at for the poll class slow.",
                    Some(bus::DEFAULT_SLOW_CYCLE),
                ),
            ),
            (
                "response_timeout",
                duration(
                    "Time for the first byte of a reply; wire time is added.",
                    Some(bus::DEFAULT_RESPONSE_TIMEOUT),
                ),
            ),
            (
                "retries",
                with_default(number("Tries after the first.", &bus::RETRIES), bus::DEFAULT_RETRIES),
            ),
            (
                "silence",
                json!({
                    "description": "Silence before each request: spec is 3.5 characters, 1.75 ms above 19200 baud; chars is 3.5 characters at any baud; a duration is for slow drives.",
                    "anyOf": [{ "enum": ["spec", "chars"] }, { "type": "string", "pattern": DURATION }],
                    "default": "spec",
                }),
            ),
            ("drive", tables("The drives on the line.", drive())),
        ],
    )
}

fn drive() -> Value {
    let writable = json!({
        "type": "array", "items": { "type": "number" }, "minItems": 2, "maxItems": 2,
        "description": "Lowest and highest value in the point's unit; what lies outside is refused.",
    });
    table(
        "One drive.",
        &["name", "address", "profile"],
        [
            ("name", name("Name of the drive, unique in the gateway.", "-_")),
            (
                "address",
                number("Address on the bus; 247 at most on Modbus.", &drive::N2_ADDRESSES),
            ),
            (
                "profile",
                pattern(
                    "Family of the drive; `drivegate profiles` lists them.",
                    "^[a-z][a-z0-9-]*$",
                ),
            ),
            (
                "unit",
                number(
                    "Modbus TCP unit id, unique in the gateway; without it the address.",
                    &drive::UNITS,
                ),
            ),
            (
                "access",
                with_default(
                    words(
                        "monitor: every write is refused. control: writes are passed on.",
                        drive::ACCESS.iter().map(|(w, _)| *w),
                    ),
                    "monitor",
                ),
            ),
            (
                "limits",
                json!({
                    "type": "object",
                    "description": format!("Limits of commands by point, such as {}.", ModelPoint::SpeedReference.name()),
                    "additionalProperties": writable,
                }),
            ),
            ("supervision", supervision()),
            (
                "on_shutdown",
                with_default(
                    words(
                        "What is done with the drive when the gateway stops.",
                        drive::ON_SHUTDOWN.iter().map(|(w, _)| *w),
                    ),
                    "hold",
                ),
            ),
            (
                "turnaround",
                duration(
                    "Time the drive takes to begin its answer, for the prediction only; without it the profile's.",
                    None,
                ),
            ),
            (
                "frequency_range",
                json!({
                    "type": "array", "minItems": 2, "maxItems": 2,
                    "items": { "type": "number", "minimum": 0, "maximum": drive::MOST_HERTZ },
                    "description": "Minimum and maximum frequency in Hz, for drives whose own parameters cannot be read.",
                }),
            ),
        ],
    )
}

fn supervision() -> Value {
    let reference = table(
        "Go to this speed reference.",
        &["speed_reference"],
        [(
            "speed_reference",
            json!({ "type": "number", "description": "Percent." }),
        )],
    );
    let words = words(
        "stop: stop the drive. hold: only tell.",
        drive::ACTIONS.iter().map(|(w, _)| *w),
    );
    table(
        "Lease of the drive: when no commanding client is heard of in time, the action is taken once. Not a \
         safety function.",
        &["timeout"],
        [
            (
                "timeout",
                duration("Time without any accepted write or heartbeat.", None),
            ),
            (
                "action",
                json!({ "anyOf": [words, reference], "default": "stop", "description": "What is done then, while the drive runs." }),
            ),
            (
                "adopt",
                with_default(
                    flag(
                        "A drive that runs when the gateway starts gets its lease started: the clock only, nothing is written.",
                    ),
                    false,
                ),
            ),
        ],
    )
}
