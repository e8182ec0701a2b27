//! `[[bus]]`: the line and its drives.

use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::drive::{self, Surroundings};
use super::{BusSettings, values};
use crate::bus::BusOptions;
use crate::cache::{BusSpec, DriveSpec};
use crate::codec::wire::Silence;
use crate::codec::{LineFormat, Protocol, n2};
use crate::document::{Place, Reader, format_duration};
use crate::drive::profile::Profiles;
use crate::line::Rs485;

/// Words of `rs485`.
pub(super) const RS485: [(&str, Rs485); 3] = [
    ("off", Rs485::Off),
    ("kernel", Rs485::Kernel),
    ("kernel-inverted", Rs485::KernelInverted),
];
/// Bits a second that a line can have.
pub(super) const BAUDS: RangeInclusive<u32> = 300..=4_000_000;
/// Tries after the first.
pub(super) const RETRIES: RangeInclusive<u32> = 0..=10;
/// Times that a cadence or a timeout can be.
pub(super) const TIMES: RangeInclusive<Duration> = Duration::from_millis(1)..=Duration::from_secs(3600);
/// Longest fixed silence.
const MOST_SILENCE: Duration = Duration::from_secs(1);

pub(super) const DEFAULT_PROTOCOL: Protocol = Protocol::ModbusRtu;
pub(super) const DEFAULT_BAUD: u32 = 9600;
/// Of Modbus RTU and N2.
pub(super) const DEFAULT_FORMAT: &str = "8N1";
/// Of Modbus ASCII: what TECO's card has with all switches off (drives.md 2).
pub(super) const DEFAULT_ASCII_FORMAT: &str = "7N2";
pub(super) const DEFAULT_CYCLE: Duration = Duration::from_millis(10);
pub(super) const DEFAULT_SLOW_CYCLE: Duration = Duration::from_secs(1);
pub(super) const DEFAULT_RESPONSE_TIMEOUT: Duration = Duration::from_millis(100);
pub(super) const DEFAULT_RETRIES: u32 = 1;

/// What is known of a bus even when a part of it is wrong.
pub(super) struct Found {
    pub(super) name: Option<(String, Place)>,
    pub(super) port: Option<(String, Place)>,
    pub(super) drives: Vec<drive::Found>,
    pub(super) settings: Option<BusSettings>,
    /// Places of `cycle` and `slow_cycle`.
    pub(super) cadence: (Place, Place),
}

pub(super) fn read(reader: &Reader<'_>, base: &Path, profiles: &Profiles, profiles_broken: bool) -> Found {
    let name = values::name(reader, "-_");
    let port = read_port(reader, base);
    let protocol = read_protocol(reader);
    let format = read_format(reader, protocol.unwrap_or(DEFAULT_PROTOCOL));
    let (cycle, slow_cycle) = read_cadence(reader);
    let options = read_options(
        reader,
        protocol.unwrap_or(DEFAULT_PROTOCOL),
        format.as_ref(),
        port.as_deref(),
    );
    let around = Surroundings {
        bus: name.as_ref().map_or("", |(name, _)| name),
        protocol: protocol.unwrap_or(DEFAULT_PROTOCOL),
        profiles,
        profiles_broken,
    };
    let tables = reader.tables("drive");
    if !reader.has("drive") {
        reader.warning("drive", "the bus has no drive; write [[bus.drive]] for each");
    }
    let drives: Vec<drive::Found> = tables.iter().map(|table| drive::read(table, &around)).collect();
    reader.finish();
    let specs: Option<Vec<DriveSpec>> = drives.iter().map(|d| d.spec.clone()).collect();
    let settings = match (&name, &port, protocol, format, specs) {
        (Some((name, _)), Some(port), Some(protocol), Some(format), Some(drives)) => {
            check_fit(reader, &format, &options, &drives);
            let spec = BusSpec {
                name: name.clone(),
                port: port.clone(),
                protocol,
                format,
                cycle,
                slow_cycle,
            };
            Some(BusSettings { spec, options, drives })
        }
        _ => None,
    };
    Found {
        port: port.map(|port| (port, reader.place_of("port"))),
        cadence: (reader.place_of("cycle"), reader.place_of("slow_cycle")),
        name,
        drives,
        settings,
    }
}

fn read_port(reader: &Reader<'_>, base: &Path) -> Option<String> {
    let text: String = reader.required("port")?;
    match check_port(&text, base) {
        Ok(port) => Some(port),
        Err(message) => {
            reader.problem("port", message);
            None
        }
    }
}

fn read_cadence(reader: &Reader<'_>) -> (Duration, Duration) {
    let cycle = values::duration(reader, "cycle", DEFAULT_CYCLE, &TIMES);
    let slow_cycle = values::duration(reader, "slow_cycle", DEFAULT_SLOW_CYCLE, &TIMES);
    if slow_cycle < cycle {
        reader.warning(
            "slow_cycle",
            format!(
                "slow_cycle = {} is shorter than cycle = {}; swap them or raise slow_cycle",
                format_duration(slow_cycle),
                format_duration(cycle)
            ),
        );
    }
    (cycle, slow_cycle)
}

fn read_options(
    reader: &Reader<'_>,
    protocol: Protocol,
    format: Option<&LineFormat>,
    port: Option<&str>,
) -> BusOptions {
    let options = BusOptions {
        response_timeout: values::duration(reader, "response_timeout", protocol.usual_timeout(), &TIMES),
        retries: values::number(reader, "retries", default_retries(protocol), &RETRIES),
        silence: read_silence(reader, protocol, format),
        rs485: values::choice(reader, "rs485", Rs485::Off, &RS485),
    };
    let device_server = port.is_some_and(|p| p.starts_with("tcp://"));
    if device_server && options.rs485 != Rs485::Off {
        reader.warning(
            "rs485",
            "a tcp:// line switches its own direction; write \"off\" or leave the key out",
        );
    }
    options
}

/// Path of a device, seen from the directory of the file, or `tcp://host:port`.
///
/// # Errors
/// What is wrong and what to write.
pub(crate) fn check_port(text: &str, base: &Path) -> Result<String, String> {
    match text.split_once("://") {
        Some(("tcp", server)) => match values::host_port(server, None) {
            Some(_) => Ok(text.to_string()),
            None => Err(format!("`{text}` is no device server; write \"tcp://host:port\"")),
        },
        Some((scheme, _)) => Err(format!(
            "`{scheme}://` is no kind of port; write the path of a serial device or \"tcp://host:port\""
        )),
        None if text.is_empty() || text.contains('\0') => {
            Err("the port has no path; write for example \"/dev/serial/by-id/usb-…\"".to_string())
        }
        None => Ok(values::resolved(base, PathBuf::from(text)).display().to_string()),
    }
}

fn read_protocol(reader: &Reader<'_>) -> Option<Protocol> {
    if !reader.has("protocol") {
        return Some(DEFAULT_PROTOCOL);
    }
    reader.parsed("protocol", |text| match Protocol::from_name(text) {
        Some(protocol) => Ok(protocol),
        None => Err(values::unknown_word(text, Protocol::ALL.iter().map(|p| p.name()))),
    })
}

fn read_format(reader: &Reader<'_>, protocol: Protocol) -> Option<LineFormat> {
    let baud = match reader.has("baud") {
        true => values::optional_number(reader, "baud", &BAUDS),
        false => Some(DEFAULT_BAUD),
    };
    let text = match reader.has("format") {
        true => reader.optional::<String>("format"),
        false => Some(default_format(protocol).to_string()),
    };
    let format = match LineFormat::new(baud.unwrap_or(DEFAULT_BAUD), &text?) {
        Ok(format) => format,
        Err(error) => {
            reader.problem("format", error.to_string());
            return None;
        }
    };
    if protocol == Protocol::N2 && !protocol.allows(&format) {
        let key = if format.baud == n2::BAUD { "format" } else { "baud" };
        reader.problem(
            key,
            format!(
                "N2 is {} {} always, not {format}; leave `baud` and `format` out",
                n2::BAUD,
                n2::FORMAT
            ),
        );
    }
    if protocol == Protocol::ModbusRtu && format.data_bits != 8 {
        reader.problem(
            "format",
            "Modbus RTU sends bytes of 8 bits; write for example \"8N1\" or \"8E1\"",
        );
    }
    if protocol == Protocol::ModbusAscii && format.bits_per_char() < 10 {
        reader.warning(
            "format",
            "characters of 9 bits: Modbus ASCII drives have 10, two stop bits where there is no parity; write \"7N2\"",
        );
    }
    baud.map(|_| format)
}

/// N2 tries three times (n2.md 4).
fn default_retries(protocol: Protocol) -> u32 {
    match protocol {
        Protocol::ModbusRtu | Protocol::ModbusAscii => DEFAULT_RETRIES,
        Protocol::N2 => n2::RETRIES,
    }
}

/// Character format of a bus or a line where none is named.
pub(crate) fn default_format(protocol: Protocol) -> &'static str {
    match protocol {
        Protocol::ModbusAscii => DEFAULT_ASCII_FORMAT,
        Protocol::ModbusRtu | Protocol::N2 => DEFAULT_FORMAT,
    }
}

fn read_silence(reader: &Reader<'_>, protocol: Protocol, format: Option<&LineFormat>) -> Silence {
    let silence = reader.parsed("silence", |text| {
        match text
            .parse::<Silence>()
            .map_err(|_| format!("`{text}` is no silence; write \"spec\", \"chars\" or a duration such as \"2ms\""))?
        {
            Silence::Fixed(time) if time > MOST_SILENCE => Err(format!(
                "{} of silence is out of range; write \"{}\" at most",
                format_duration(time),
                format_duration(MOST_SILENCE)
            )),
            silence => Ok(silence),
        }
    });
    if let (Protocol::ModbusRtu, Some(Silence::Fixed(time)), Some(format)) = (protocol, silence, format)
        && time < format.silence_chars()
    {
        reader.warning(
            "silence",
            format!(
                "{} is less than 3.5 characters at {format}, so drives may take two frames for one; write \
                 \"chars\" or {} and more",
                format_duration(time),
                format_duration(format.silence_chars())
            ),
        );
    }
    silence.unwrap_or(Silence::Spec)
}

/// What can be configured but fits the drives badly.
fn check_fit(reader: &Reader<'_>, format: &LineFormat, options: &BusOptions, drives: &[DriveSpec]) {
    let mut told: Vec<&str> = Vec::new();
    for drive in drives {
        let profile = &drive.profile;
        let listed = profile.bauds.is_empty() || profile.bauds.contains(&format.baud);
        if !listed && !told.contains(&profile.name.as_str()) {
            told.push(&profile.name);
            let bauds: Vec<String> = profile.bauds.iter().map(u32::to_string).collect();
            reader.warning(
                "baud",
                format!(
                    "profile `{}` knows no {} baud; check the drives, known are {}",
                    profile.name,
                    format.baud,
                    bauds.join(", ")
                ),
            );
        }
        if drive.turnaround >= options.response_timeout {
            reader.warning(
                "response_timeout",
                format!(
                    "drive `{}` takes {} to begin its answer, response_timeout is {}; raise response_timeout",
                    drive.name,
                    format_duration(drive.turnaround),
                    format_duration(options.response_timeout)
                ),
            );
        }
    }
}
