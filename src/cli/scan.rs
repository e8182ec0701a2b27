//! `drivegate scan`: finds the drives of a line and prints a configuration for them. Only reads.

mod progress;
pub(super) mod snippet;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use self::progress::Progress;
use self::snippet::Found;
use super::{EXIT_CONFIG, EXIT_FAILED, EXIT_USAGE, report};
use crate::bus::Mode;
use crate::bus::prober::Prober;
use crate::bus::transaction::Ended;
use crate::codec::n2::Session;
use crate::codec::{LineFormat, Protocol, Reply, Request, RequestPdu, Silence, Table};
use crate::config;
use crate::document::Finding;
use crate::drive::profile::Profiles;
use crate::drive::{Probe, identify};
use crate::line::{Line, LineOptions};

/// Bauds tried by default: the factory settings of the drives of the built-in profiles.
const USUAL_BAUDS: [u32; 3] = [9600, 19_200, 38_400];
/// All bauds of the built-in profiles and those of faster devices.
const ALL_BAUDS: [u32; 10] = [9600, 19_200, 38_400, 57_600, 115_200, 4800, 2400, 1200, 600, 300];

/// Finds the drives of a line and prints a configuration for them; only reads.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate scan --port /dev/ttyUSB0
  drivegate scan --port /dev/ttyUSB0 --protocol modbus-rtu --baud all --format 8N1,8E1 --addresses 1-31

Once a drive has answered, no other settings are tried, unless --exhaustive.
The configuration goes to standard output, everything else to standard error.")]
pub(super) struct Args {
    /// Serial device, or rfc2217://host:port or tcp://host:port of a device server.
    #[arg(long, value_name = "PORT", value_parser = parse_port)]
    port: String,
    /// Protocols: modbus-rtu, modbus-ascii, n2, or all.
    #[arg(long, value_name = "LIST", default_value = "all", value_delimiter = ',')]
    protocol: Vec<String>,
    /// Bits a second, or all [default: the usual ones].
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    baud: Vec<String>,
    /// Data bits, parity and stop bits, or all [default: the usual ones of the protocol].
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    format: Vec<String>,
    /// Addresses to try; N2 has addresses up to 255.
    #[arg(long, value_name = "LIST", default_value = "1-247", value_parser = super::addresses::parse_addresses)]
    addresses: super::addresses::Addresses,
    /// Time for the first byte of a reply [default: that of the protocol].
    #[arg(long, value_name = "TIME", value_parser = report::duration)]
    timeout: Option<Duration>,
    /// Tries for each address.
    #[arg(long, value_name = "COUNT", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=10))]
    tries: u32,
    /// Go on with other settings after a drive has answered.
    #[arg(long)]
    exhaustive: bool,
    /// Include the profiles (*.toml) of this directory; may be repeated.
    #[arg(long, value_name = "DIR")]
    profile_dir: Vec<PathBuf>,
}

/// Protocol and format of the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Setting {
    protocol: Protocol,
    format: LineFormat,
}

/// The settings to try, in order.
fn settings(args: &Args) -> Result<Vec<Setting>, String> {
    let protocols = protocols(&args.protocol)?;
    let mut settings: Vec<Setting> = Vec::new();
    for protocol in protocols {
        for baud in bauds(protocol, &args.baud)? {
            for text in formats(protocol, &args.format) {
                let format = LineFormat::new(baud, &text).map_err(|error| format!("{error}; --format"))?;
                let setting = Setting { protocol, format };
                if protocol.allows(&format) && !settings.contains(&setting) {
                    settings.push(setting);
                }
            }
        }
    }
    check_addresses(args, &settings)?;
    if settings.is_empty() {
        return Err(
            "no protocol supports these bauds and formats; --baud, --format; N2 is always 9600 8N1, Modbus \
                    RTU has 8 data bits"
                .to_string(),
        );
    }
    Ok(settings)
}

/// The port as in a configuration, relative to the working directory.
pub(super) fn parse_port(text: &str) -> Result<String, Finding> {
    config::check_port(text, Path::new(""))
}

/// Refuses addresses that no protocol of the scan has.
fn check_addresses(args: &Args, settings: &[Setting]) -> Result<(), String> {
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

pub(super) fn protocols(names: &[String]) -> Result<Vec<Protocol>, String> {
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

fn bauds(protocol: Protocol, wanted: &[String]) -> Result<Vec<u32>, String> {
    if wanted.iter().any(|text| text == "all") {
        return Ok(ALL_BAUDS.to_vec());
    }
    if wanted.is_empty() {
        return Ok(match protocol {
            Protocol::N2 => vec![9600],
            _ => USUAL_BAUDS.to_vec(),
        });
    }
    let one = |text: &String| {
        let baud = text.parse::<u32>().ok().filter(|baud| (300..=4_000_000).contains(baud));
        baud.ok_or_else(|| format!("`{text}` is not a baud rate; --baud; write 300 to 4000000, or all"))
    };
    wanted.iter().map(one).collect()
}

/// The usual formats: the factory settings of the drives, then those with parity.
fn formats(protocol: Protocol, wanted: &[String]) -> Vec<String> {
    let named = |texts: &[&str]| texts.iter().map(ToString::to_string).collect();
    match protocol {
        _ if !wanted.is_empty() && !wanted.iter().any(|text| text == "all") => wanted.to_vec(),
        _ if !wanted.is_empty() => named(&[
            "8N1", "8E1", "8O1", "8N2", "7E1", "7O1", "7N2", "8E2", "8O2", "7E2", "7O2",
        ]),
        Protocol::ModbusRtu => named(&["8N1", "8E1"]),
        Protocol::ModbusAscii => named(&["7N2", "7E1"]),
        Protocol::N2 => named(&["8N1"]),
    }
}

pub(super) fn run(args: &Args) -> ExitCode {
    let settings = match settings(args) {
        Ok(settings) => settings,
        Err(message) => {
            report::error(&message);
            return ExitCode::from(EXIT_USAGE);
        }
    };
    let mut profiles = Profiles::built_in();
    let problems: Vec<_> = args.profile_dir.iter().flat_map(|dir| profiles.load(dir)).collect();
    if !problems.is_empty() {
        report::errors(&problems);
        return ExitCode::from(EXIT_CONFIG);
    }
    let stop = Arc::new(AtomicBool::new(false));
    stop_on_signal(stop.clone());
    let mut scan = Scan {
        args,
        profiles,
        found: Vec::new(),
        garbage: Vec::new(),
        progress: Progress::new(settings.iter().map(|s| addresses(args, *s).count()).sum(), stop.clone()),
        stop,
    };
    let outcome = scan.all(&settings);
    scan.progress.end();
    scan.finish(outcome)
}

/// The addresses to try with that setting.
fn addresses(args: &Args, setting: Setting) -> impl Iterator<Item = u8> {
    let allowed = config::addresses(setting.protocol);
    args.addresses
        .0
        .iter()
        .copied()
        .filter(move |address| allowed.contains(address))
}

/// Ctrl-C ends the scan; what was found is still printed.
pub(super) fn stop_on_signal(stop: Arc<AtomicBool>) {
    std::thread::spawn(move || {
        let Ok(runtime) = super::runtime() else { return };
        // Without a handler Ctrl-C ends the process, which is harmless: nothing was written.
        if runtime.block_on(tokio::signal::ctrl_c()).is_ok() {
            stop.store(true, Ordering::Relaxed);
        }
    });
}

struct Scan<'a> {
    args: &'a Args,
    profiles: Profiles,
    found: Vec<Found>,
    /// Settings and addresses that were answered with invalid frames.
    garbage: Vec<(Setting, u8)>,
    progress: Progress,
    stop: Arc<AtomicBool>,
}

impl Scan<'_> {
    fn all(&mut self, settings: &[Setting]) -> Result<(), String> {
        for setting in settings {
            let before = self.found.len();
            self.one(*setting)?;
            let stopped = self.stop.load(Ordering::Relaxed);
            if stopped || (self.found.len() > before && !self.args.exhaustive) {
                break;
            }
        }
        Ok(())
    }

    fn one(&mut self, setting: Setting) -> Result<(), String> {
        let Setting { protocol, format } = setting;
        let (line, _) =
            Line::open(&self.args.port, &format, &LineOptions::default()).map_err(|error| error.to_string())?;
        let silence = protocol.silence(Silence::Spec, &format);
        let timeout = self.args.timeout.unwrap_or(protocol.usual_timeout());
        let mut prober = Prober::new(&line, protocol, format, silence, timeout);
        let args = self.args;
        for address in addresses(args, setting) {
            if self.stop.load(Ordering::Relaxed) {
                return Ok(());
            }
            let at = format!("{} {format}, address {address}", protocol.name());
            let hello = hello(protocol, address);
            self.progress.show(&at, prober.patience(&hello) * args.tries);
            let answered = self.tries(&mut prober, &hello, setting)?;
            self.progress.step();
            if answered {
                let found = self.look_closer(&mut prober, setting, address)?;
                self.progress.print_line(&format!("found {at}: {}", found.title()));
                self.found.push(found);
            }
        }
        Ok(())
    }

    /// Whether a drive answers.
    fn tries(&mut self, prober: &mut Prober<'_>, hello: &Request, setting: Setting) -> Result<bool, String> {
        for _ in 0..self.args.tries {
            match self.ask(prober, hello)? {
                Ended::Reply(_) => return Ok(true),
                Ended::Silent => {}
                Ended::Corrupt(_) => {
                    // Once more: it may have been noise.
                    if matches!(self.ask(prober, hello)?, Ended::Reply(_)) {
                        return Ok(true);
                    }
                    self.garbage.push((setting, hello.address));
                }
            }
        }
        Ok(false)
    }

    fn ask(&self, prober: &mut Prober<'_>, request: &Request) -> Result<Ended, String> {
        prober
            .ask(request)
            .map_err(|lost| format!("{lost}; {}; plug the adapter in and try again", self.args.port))
    }

    fn look_closer(&mut self, prober: &mut Prober<'_>, setting: Setting, address: u8) -> Result<Found, String> {
        let mut outcomes: BTreeMap<Probe, bool> = BTreeMap::new();
        for one in identify::probes(&self.profiles, setting.protocol) {
            let request = Request::new(address, one.pdu());
            for _ in 0..2 {
                match self.ask(prober, &request)? {
                    Ended::Reply(Reply::Exception(_)) => {
                        outcomes.insert(one, false);
                    }
                    Ended::Reply(_) => {
                        outcomes.insert(one, true);
                    }
                    Ended::Silent | Ended::Corrupt(_) => continue,
                }
                break;
            }
        }
        let fitting = identify::fitting(&self.profiles, setting.protocol, &outcomes);
        Ok(Found {
            protocol: setting.protocol,
            format: setting.format,
            address,
            profiles: fitting
                .iter()
                .filter(|profile| profile.addresses.contains(&address))
                .map(|profile| profile.name.clone())
                .collect(),
        })
    }

    fn finish(&self, outcome: Result<(), String>) -> ExitCode {
        let printed = if self.found.is_empty() {
            ExitCode::from(EXIT_FAILED)
        } else {
            report::print(&snippet::snippet(&self.args.port, &self.found, Mode::Master))
        };
        if let Err(message) = outcome {
            report::error(&message);
            return ExitCode::from(EXIT_FAILED);
        }
        if let Some((setting, address)) = self.garbage.first() {
            report::note(&format!(
                "received invalid frames {} times, first at {} {}, address {address}: the line may have another baud, \
                 format or protocol, or two drives the same address",
                self.garbage.len(),
                setting.protocol.name(),
                setting.format
            ));
        }
        if self.found.is_empty() {
            report::error(&format!(
                "no drive answered; {}; check power, wiring (swap - and +) and termination, and try --baud all \
                 --format all",
                self.args.port
            ));
        }
        printed
    }
}

/// A read that every drive answers, if only with an exception.
fn hello(protocol: Protocol, address: u8) -> Request {
    let read = RequestPdu::Read {
        table: Table::Holding,
        start: 0,
        count: 1,
    };
    let pdu = match protocol {
        Protocol::ModbusRtu | Protocol::ModbusAscii => read,
        Protocol::N2 => RequestPdu::N2(Session::Identify),
    };
    Request::new(address, pdu)
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Command {
        #[command(flatten)]
        args: Args,
    }

    fn args(words: &str) -> Result<Args, String> {
        let port = if words.contains("--port") { "" } else { "--port /dev/x " };
        let words = format!("scan {port}{words}");
        let parsed = Command::try_parse_from(words.split_whitespace());
        Ok(parsed.map_err(|e| e.to_string())?.args)
    }

    fn settings_of(words: &str) -> Result<Vec<String>, String> {
        let args = args(words)?;
        let one = |s: &Setting| format!("{} {}", s.protocol.name(), s.format);
        Ok(settings(&args)?.iter().map(one).collect())
    }

    #[test]
    fn what_is_tried() {
        let usual = settings_of("").unwrap();
        assert_eq!(usual.first().unwrap(), "modbus-rtu 9600 8N1");
        assert_eq!(usual.last().unwrap(), "n2 9600 8N1");
        assert_eq!(usual.len(), 3 * 2 + 3 * 2 + 1);
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
        let tried = settings(&args).unwrap();
        for (protocol, most) in [
            (Protocol::ModbusRtu, 247),
            (Protocol::ModbusAscii, 247),
            (Protocol::N2, 255),
        ] {
            let setting = tried.iter().find(|setting| setting.protocol == protocol).unwrap();
            let wanted: Vec<u8> = (246..=most).collect();
            assert_eq!(addresses(&args, *setting).collect::<Vec<_>>(), wanted, "{protocol:?}");
        }
        assert!(settings_of("--protocol n2 --addresses 1-255").is_ok());
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
            (
                "--port udp://foo:1",
                "write the path of a serial device, \"tcp://host:port\" or \"rfc2217://host:port\"",
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
