//! Which settings of the line a search tries, and in which order. Pure.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::wishes::{Wish, parse_wish};
use crate::addresses::{Addresses, parse_addresses};
use crate::report;
use drivegate_gateway::config;
use drivegate_model::document::Finding;
use drivegate_proto::wire::{searched_bauds, usual_bauds};
use drivegate_proto::{LineFormat, Protocol};

/// The settings of Modbus RTU that drives most often have as delivered, the likeliest first; the other usual ones follow.
const LIKELY: [(u32, &str); 7] = [
    (9600, "8N1"),
    (19_200, "8E1"),
    (9600, "8E1"),
    (19_200, "8N1"),
    (115_200, "8N1"),
    (9600, "8N2"),
    (38_400, "8N1"),
];
/// Bauds of Modbus ASCII tried by default: all that the switches of the TECO 7300PA can set, the factory setting first.
const ASCII_BAUDS: [u32; 4] = [19_200, 9600, 4800, 2400];
/// Baud rate assumed for a raw device server, which sets up its line itself: the highest usual one, because a reply
/// later than the wire needs is accepted, and an earlier one is not.
const ASSUMED_BAUD: u32 = 38_400;
/// Addresses that are tried first with all settings: most lines have a drive among them.
const LIKELY_ADDRESSES: u8 = 10;
/// Up to this number of addresses are tried in one pass.
const FEW_ADDRESSES: usize = 32;

/// What is to be tried.
#[derive(Debug, clap::Args)]
pub(crate) struct Options {
    /// Protocols: modbus-rtu, modbus-ascii, n2, or all.
    #[arg(long, value_name = "LIST", default_value = "all", value_delimiter = ',')]
    pub(super) protocol: Vec<String>,
    /// Bits a second, or all [default: the usual ones].
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub(super) baud: Vec<String>,
    /// Data bits, parity and stop bits, or all [default: the usual ones of the protocol].
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub(super) format: Vec<String>,
    /// Addresses to try; N2 has addresses up to 255.
    #[arg(long, value_name = "LIST", default_value = "1-247", value_parser = parse_addresses)]
    pub(super) addresses: Addresses,
    /// Timeout for the first byte of a reply [default: that of the protocol].
    #[arg(long, value_name = "TIME", value_parser = report::duration)]
    pub(super) timeout: Option<Duration>,
    /// Attempts per address.
    #[arg(long, value_name = "COUNT", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=10))]
    pub(super) tries: u32,
    /// Include the profiles (*.toml) of this directory; may be repeated.
    #[arg(long, value_name = "DIR")]
    pub(super) profile_dir: Vec<PathBuf>,
    /// Profile of the drives whose family no read shows, or ADDRESSES=NAME of the drives at those addresses; may be repeated.
    #[arg(long, value_name = "NAME", value_parser = parse_wish)]
    pub(super) profile: Vec<Wish>,
}

/// Protocol and format of the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Setting {
    pub(crate) protocol: Protocol,
    pub(crate) format: LineFormat,
}

impl fmt::Display for Setting {
    /// `modbus-rtu 38400 8N1`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.protocol.name(), self.format)
    }
}

/// Addresses that are tried with one setting.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Part {
    pub(super) setting: Setting,
    pub(super) addresses: Vec<u8>,
}

/// The likely addresses with all settings, then the others. `exhaustive`: with each setting all addresses.
pub(super) fn parts(options: &Options, settings: &[Setting], exhaustive: bool) -> Vec<Part> {
    let likely = |address: &u8| *address <= LIKELY_ADDRESSES;
    let part = |setting: &Setting, wanted: &dyn Fn(&u8) -> bool| Part {
        setting: *setting,
        addresses: addresses(options, *setting).filter(wanted).collect(),
    };
    let mut parts: Vec<Part> = if exhaustive || options.addresses.0.len() <= FEW_ADDRESSES {
        settings.iter().map(|setting| part(setting, &|_| true)).collect()
    } else {
        let first = settings.iter().map(|setting| part(setting, &likely));
        let then = settings
            .iter()
            .map(|setting| part(setting, &|address| !likely(address)));
        first.chain(then).collect()
    };
    parts.retain(|part| !part.addresses.is_empty());
    parts
}

/// The settings to try, in order.
pub(super) fn settings(args: &Options, port: &str) -> Result<Vec<Setting>, String> {
    if port.starts_with("modbus-tcp://") {
        return network_settings(args);
    }
    let protocols = if port.starts_with("udp://") {
        vec![Protocol::ModbusRtu]
    } else {
        protocols(&args.protocol)?
    };
    let by_server = ["tcp://", "udp://"].iter().any(|scheme| port.starts_with(scheme));
    let mut settings: Vec<Setting> = Vec::new();
    for protocol in protocols {
        for baud in bauds(protocol, &args.baud, by_server)? {
            for text in formats(protocol, &args.format, by_server) {
                let format = LineFormat::new(baud, &text).map_err(|error| format!("{error}; --format"))?;
                let setting = Setting { protocol, format };
                if protocol.allows(&format) && !settings.contains(&setting) {
                    settings.push(setting);
                }
            }
        }
    }
    if args.baud.is_empty() && args.format.is_empty() {
        // A stable sort: the protocols keep their order, and so do the settings that are not among the likely ones.
        settings.sort_by_key(likelihood);
    }
    check_addresses(args, &settings)?;
    if settings.is_empty() {
        return Err(
            "no protocol supports these baud rates and formats; --baud, --format; N2 is always 9600 8N1, Modbus RTU \
             has 8 data bits"
                .to_string(),
        );
    }
    Ok(settings)
}

/// Rank of a setting among the usual ones of its protocol.
fn likelihood(setting: &Setting) -> (usize, usize) {
    let protocol = Protocol::ALL.iter().position(|one| *one == setting.protocol);
    let is = |(baud, format): &(u32, &str)| setting.format.baud == *baud && setting.format.characters() == *format;
    let rank = LIKELY
        .iter()
        .position(is)
        .filter(|_| setting.protocol == Protocol::ModbusRtu);
    (protocol.unwrap_or_default(), rank.unwrap_or(LIKELY.len()))
}

/// The only setting behind Modbus TCP, where there is no line whose settings could be wrong.
fn network_settings(args: &Options) -> Result<Vec<Setting>, String> {
    if !args.baud.is_empty() || !args.format.is_empty() {
        return Err(
            "behind modbus-tcp:// there is no baud rate and no format; leave --baud and --format out".to_string(),
        );
    }
    let setting = Setting {
        protocol: Protocol::ModbusRtu,
        format: LineFormat::NETWORK,
    };
    check_addresses(args, &[setting])?;
    Ok(vec![setting])
}

/// The port as in a configuration, relative to the working directory.
pub(crate) fn parse_port(text: &str) -> Result<String, Finding> {
    if text.starts_with("tcp-listen://") {
        return Err(Finding::new(
            "a device that dials in comes when it wants to, so it cannot be searched for",
            "write the bus into a configuration and start the gateway with it",
        ));
    }
    config::check_port(text, Path::new(""))
}

/// Refuses addresses that no protocol of the scan has.
fn check_addresses(args: &Options, settings: &[Setting]) -> Result<(), String> {
    let has = |setting: &Setting, address: &u8| config::addresses(setting.protocol).contains(address);
    let nowhere = |address: &&u8| !settings.iter().any(|setting| has(setting, address));
    let Some(address) = args.addresses.0.iter().find(nowhere).filter(|_| !settings.is_empty()) else {
        return Ok(());
    };
    let protocols: BTreeMap<&str, u8> = settings
        .iter()
        .map(|setting| (setting.protocol.name(), *config::addresses(setting.protocol).end()))
        .collect();
    let known: Vec<String> = protocols
        .iter()
        .map(|(name, most)| format!("{name} has 1 to {most}"))
        .collect();
    Err(format!(
        "no drive can have address {address}; --addresses; {}",
        known.join(", ")
    ))
}

/// The protocols with these names; `all` means all protocols.
pub(crate) fn protocols(names: &[String]) -> Result<Vec<Protocol>, String> {
    if names.iter().any(|name| name == "all") {
        return Ok(Protocol::ALL.to_vec());
    }
    let one = |name: &String| {
        Protocol::from_name(name).ok_or_else(|| {
            let known: Vec<&str> = Protocol::ALL.iter().map(|p| p.name()).collect();
            format!(
                "unknown protocol `{name}`; --protocol; write {} or all",
                known.join(", ")
            )
        })
    };
    names.iter().map(one).collect()
}

fn bauds(protocol: Protocol, wanted: &[String], by_server: bool) -> Result<Vec<u32>, String> {
    if wanted.iter().any(|text| text == "all") {
        return Ok(searched_bauds().collect());
    }
    if wanted.is_empty() {
        return Ok(match protocol {
            Protocol::N2 => vec![9600],
            _ if by_server => vec![ASSUMED_BAUD],
            Protocol::ModbusAscii => ASCII_BAUDS.to_vec(),
            Protocol::ModbusRtu => usual_bauds().collect(),
        });
    }
    let one = |text: &String| {
        let baud = text.parse::<u32>().ok().filter(|baud| (300..=4_000_000).contains(baud));
        baud.ok_or_else(|| format!("`{text}` is not a baud rate; --baud; write 300 to 4000000, or all"))
    };
    wanted.iter().map(one).collect()
}

/// The usual formats: the factory settings of the drives, then those with parity. For a raw device server, which
/// sets up its line itself, one is enough.
fn formats(protocol: Protocol, wanted: &[String], by_server: bool) -> Vec<String> {
    let named = |texts: &[&str]| texts.iter().map(ToString::to_string).collect();
    match protocol {
        _ if !wanted.is_empty() && !wanted.iter().any(|text| text == "all") => wanted.to_vec(),
        _ if !wanted.is_empty() => named(&[
            "8N1", "8E1", "8O1", "8N2", "7E1", "7O1", "7N2", "8E2", "8O2", "7E2", "7O2",
        ]),
        _ if by_server => named(&[config::default_format(protocol)]),
        Protocol::ModbusRtu => named(&["8N1", "8E1", "8N2"]),
        Protocol::ModbusAscii => named(&["7N2", "7E1", "7O1"]),
        Protocol::N2 => named(&["8N1"]),
    }
}

/// The addresses to try with that setting.
pub(super) fn addresses(options: &Options, setting: Setting) -> impl Iterator<Item = u8> {
    let allowed = config::addresses(setting.protocol);
    let wanted = options.addresses.0.iter().copied();
    wanted.filter(move |address| allowed.contains(address))
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Command {
        #[arg(long, value_parser = parse_port)]
        port: String,
        #[command(flatten)]
        args: Options,
    }

    fn args(words: &str) -> Result<Command, String> {
        let port = if words.contains("--port") { "" } else { "--port /dev/x " };
        let words = format!("scan {port}{words}");
        let parsed = Command::try_parse_from(words.split_whitespace());
        parsed.map_err(|e| e.to_string())
    }

    fn settings_of(words: &str) -> Result<Vec<String>, String> {
        let args = args(words)?;
        let settings = settings(&args.args, &args.port)?;
        Ok(settings.iter().map(ToString::to_string).collect())
    }

    #[test]
    fn what_is_tried() {
        let usual = settings_of("").unwrap();
        assert_eq!(usual.first().unwrap(), "modbus-rtu 9600 8N1");
        assert_eq!(usual.last().unwrap(), "n2 9600 8N1");
        assert_eq!(usual.len(), 5 * 3 + 4 * 3 + 1);
        // As delivered: ABB ACS580, Altivar and WEG, then Danfoss, then the Optidrive Eco.
        let likely = [
            "19200 8E1",
            "9600 8E1",
            "19200 8N1",
            "115200 8N1",
            "9600 8N2",
            "38400 8N1",
        ];
        for (place, setting) in likely.iter().enumerate() {
            assert_eq!(usual[place + 1], format!("modbus-rtu {setting}"));
        }
        for (baud, format) in usual_bauds().flat_map(|baud| ["8N1", "8E1", "8N2"].map(|format| (baud, format))) {
            let setting = format!("modbus-rtu {baud} {format}");
            assert_eq!(usual.iter().filter(|one| **one == setting).count(), 1, "{setting}");
        }
        // Named settings are tried in the order of the command line.
        assert_eq!(
            settings_of("--protocol modbus-rtu --baud 38400,9600 --format 8N2,8N1").unwrap(),
            [
                "modbus-rtu 38400 8N2",
                "modbus-rtu 38400 8N1",
                "modbus-rtu 9600 8N2",
                "modbus-rtu 9600 8N1"
            ]
        );
        // What the switches of a TECO card can set, and nothing else.
        let ascii: Vec<&String> = usual.iter().filter(|one| one.starts_with("modbus-ascii")).collect();
        assert_eq!(ascii[0], "modbus-ascii 19200 7N2");
        assert_eq!(ascii[11], "modbus-ascii 2400 7O1");
        assert!(ascii.iter().all(|one| !one.contains("38400")), "{ascii:?}");
        assert_eq!(settings_of("--protocol n2").unwrap(), ["n2 9600 8N1"]);
        assert_eq!(
            settings_of("--protocol modbus-ascii --baud 19200 --format 7O1,8N1").unwrap(),
            ["modbus-ascii 19200 7O1", "modbus-ascii 19200 8N1"]
        );
        assert!(
            settings_of("--protocol modbus-rtu --format all")
                .unwrap()
                .iter()
                .all(|s| s.contains(" 8"))
        );
        assert_eq!(
            settings_of("--baud all --format 8N1 --protocol all").unwrap().len(),
            10 + 10 + 1
        );
    }

    #[test]
    fn each_protocol_is_tried_with_the_addresses_that_it_has() {
        let args = args("--addresses 246-255").unwrap();
        let tried = settings(&args.args, &args.port).unwrap();
        for (protocol, most) in [
            (Protocol::ModbusRtu, 247),
            (Protocol::ModbusAscii, 247),
            (Protocol::N2, 255),
        ] {
            let setting = tried.iter().find(|setting| setting.protocol == protocol).unwrap();
            let wanted: Vec<u8> = (246..=most).collect();
            assert_eq!(
                addresses(&args.args, *setting).collect::<Vec<_>>(),
                wanted,
                "{protocol:?}"
            );
        }
        assert!(settings_of("--protocol n2 --addresses 1-255").is_ok());
    }

    #[test]
    fn a_raw_device_server_has_its_own_settings() {
        let tried = settings_of("--port tcp://server:4001").unwrap();
        assert_eq!(tried, ["modbus-rtu 38400 8N1", "modbus-ascii 38400 7N2", "n2 9600 8N1"]);
        let tried = settings_of("--port rfc2217://server:4001").unwrap();
        assert_eq!(tried, settings_of("").unwrap());
        let tried = settings_of("--port tcp://server:4001 --baud 9600,19200 --protocol modbus-rtu").unwrap();
        assert_eq!(tried, ["modbus-rtu 9600 8N1", "modbus-rtu 19200 8N1"]);
    }

    #[test]
    fn likely_addresses_come_first() {
        let command = args("").unwrap();
        let settings = settings(&command.args, &command.port).unwrap();
        let parts = parts(&command.args, &settings, false);
        assert_eq!(parts.len(), 2 * settings.len());
        let (first, then) = parts.split_at(settings.len());
        assert!(first.iter().all(|part| part.addresses == (1..=10).collect::<Vec<u8>>()));
        assert!(
            then.iter()
                .all(|part| part.addresses == (11..=247).collect::<Vec<u8>>())
        );
        assert_eq!(super::parts(&command.args, &settings, true).len(), settings.len());
        let far = args("--addresses 20-30").unwrap();
        assert_eq!(super::parts(&far.args, &settings, false).len(), settings.len());
    }

    #[test]
    fn bad_wishes() {
        for (words, wanted) in [
            ("--protocol n3", "--protocol"),
            ("--baud fast", "--baud"),
            ("--format 9N1", "--format"),
            ("--protocol modbus-rtu --format 7E1", "--format"),
            ("--protocol n2 --baud 19200", "--baud"),
            ("--addresses 0-9", "addresses"),
            ("--addresses 256", "1 to 255"),
            ("--protocol modbus-rtu --addresses 250", "modbus-rtu has 1 to 247"),
            (
                "--protocol modbus-rtu,modbus-ascii --addresses 1-255",
                "no drive can have address 248; --addresses; modbus-ascii has 1 to 247, modbus-rtu has 1 to 247",
            ),
            ("--port tcp://foo", "write \"tcp://host:port\""),
            ("--port tcp-listen://0.0.0.0:5020", "start the gateway with it"),
            (
                "--port modbus-tcp://foo:502 --baud 9600",
                "leave --baud and --format out",
            ),
            (
                "--port http://foo:1",
                "write the path of a serial device, or \"tcp://host:port\"",
            ),
            (
                "--timeout 5",
                "write a number with its unit, such as 10ms, 1.5s or 2min",
            ),
            ("--tries 0", "tries"),
        ] {
            let error = settings_of(words).unwrap_err();
            assert!(error.contains(wanted), "{words}: {error}");
        }
    }
}
