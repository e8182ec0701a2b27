//! `drivegate listen`: analyses the traffic of a line that another master owns, without sending a byte.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use super::adapters::persistent_name;
use super::failure::{Failure, Outcome};
use super::report;
use super::scan::{self, Found, Setting, Snippet, absolute};
use drivegate_bus::Mode;
use drivegate_bus::listener::guess::Guess;
use drivegate_bus::listener::n2_survey::N2Survey;
use drivegate_bus::listener::survey::Survey;
use drivegate_bus::listener::{Decoder, Traffic};
use drivegate_line::{Lost, Receiver, Woken};
use drivegate_model::drive::profile::Profiles;
use drivegate_proto::wire::searched_bauds;
use drivegate_proto::{LineFormat, Protocol};

/// Time for each setting while the right one is looked for.
const DWELL: Duration = Duration::from_secs(3);
/// Rounds of listening over all settings.
const ROUNDS: u32 = 2;
/// Longest single wait for bytes.
const LOOK: Duration = Duration::from_millis(20);
/// Formats that are tried by default; Modbus ASCII with 7 data bits is seen through 8N1.
const FORMATS: [&str; 3] = ["8N1", "8E1", "8O1"];

/// Listens to a line that another master owns: finds protocol and format, lists what is polled and how often, prints a
/// configuration.
///
/// Never sends.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate listen --port /dev/ttyUSB0
  drivegate listen --port /dev/ttyUSB0 --baud 9600 --protocol n2 --seconds 600 --n2-report

The configuration goes to standard output, everything else to standard error.
Exit codes: 0 when requests were received, 1 when not, 2 wrong command line.")]
pub(super) struct Args {
    /// Serial device, or rfc2217://host:port or tcp://host:port of a device server.
    #[arg(long, value_name = "PORT", value_parser = scan::parse_port)]
    port: String,
    /// Time to listen once the settings are known.
    #[arg(long, value_name = "N", default_value_t = 30, value_parser = clap::value_parser!(u64).range(1..=86_400))]
    seconds: u64,
    /// Report what confirms or contradicts the assumptions about N2.
    #[arg(long)]
    n2_report: bool,
    /// Protocols: modbus-rtu, modbus-ascii, n2, or all.
    #[arg(long, value_name = "LIST", default_value = "all", value_delimiter = ',')]
    protocol: Vec<String>,
    /// Bits a second [default: all usual ones].
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    baud: Vec<u32>,
    /// Data bits, parity and stop bits [default: 8N1, 8E1, 8O1; Modbus ASCII with 7 data bits is found by 8N1].
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    format: Vec<String>,
    /// Include the profiles (*.toml) of this directory; may be repeated.
    #[arg(long, value_name = "DIR")]
    profile_dir: Vec<PathBuf>,
}

pub(super) fn run(args: &Args) -> Outcome {
    let (protocols, formats) = settings(args).map_err(Failure::Misused)?;
    let profiles = super::profiles_of(&args.profile_dir)?;
    let stop = Arc::new(AtomicBool::new(false));
    scan::stop_on_signal(stop.clone());
    let ear = Ear { args, stop };
    ear.listen(&protocols, &formats, &profiles)
}

/// Protocols and formats to try, in order.
fn settings(args: &Args) -> Result<(Vec<Protocol>, Vec<LineFormat>), String> {
    if let Some((scheme @ ("modbus-tcp" | "udp"), _)) = args.port.split_once("://") {
        return Err(format!(
            "a {scheme}:// port carries only the gateway's own requests and their replies; --port; write a serial port or tcp://"
        ));
    }
    let protocols = scan::protocols(&args.protocol)?;
    let bauds = if args.baud.is_empty() {
        searched_bauds().collect()
    } else {
        args.baud.clone()
    };
    let usual = FORMATS.map(ToString::to_string).to_vec();
    let texts = if args.format.is_empty() {
        usual
    } else {
        args.format.clone()
    };
    let mut formats = Vec::new();
    for text in &texts {
        for baud in &bauds {
            if !(300..=4_000_000).contains(baud) {
                return Err(format!("{baud} is not a baud rate; --baud; write 300 to 4000000"));
            }
            let format = LineFormat::new(*baud, text).map_err(|error| format!("{error}; --format"))?;
            if protocols.iter().any(|protocol| protocol.allows(&format)) {
                formats.push(format);
            }
        }
    }
    if formats.is_empty() {
        return Err(
            "no protocol supports these baud rates and formats; --baud, --format; N2 is always 9600 8N1, Modbus RTU \
             has 8 data bits"
                .to_string(),
        );
    }
    Ok((protocols, formats))
}

/// A listener at one port.
struct Ear<'a> {
    args: &'a Args,
    stop: Arc<AtomicBool>,
}

impl Ear<'_> {
    fn listen(&self, protocols: &[Protocol], formats: &[LineFormat], profiles: &Profiles) -> Outcome {
        let mut bytes = 0;
        let Some((protocol, format)) = self.find(protocols, formats, &mut bytes)? else {
            return Err(nothing(bytes, &self.args.port).into());
        };
        report::note(&format!(
            "{} {format}; listening for {} s",
            protocol.name(),
            self.args.seconds
        ));
        let (survey, n2) = self.survey(protocol, &format)?;
        report::lines_to_stderr(&words(&survey, profiles, protocol));
        if self.args.n2_report {
            report::lines_to_stderr(&format!(
                "\nAssumptions about N2, and what was seen of them\n{}",
                n2.report()
            ));
        }
        let addresses = survey.addresses.iter().filter(|(_, seen)| seen.answered > 0);
        let found: Vec<Found> = addresses
            .map(|(address, seen)| Found {
                setting: Setting { protocol, format },
                address: *address,
                profiles: seen.fitting(profiles, protocol),
                chosen: false,
                nameplate: String::new(),
                unanswered: 0,
                turnaround: None,
            })
            .collect();
        if found.is_empty() {
            return Err(format!(
                "no drive answers the other master; {}; check that both wires of the line reach this port",
                self.args.port
            )
            .into());
        }
        let directory = |dir: &PathBuf| std::path::absolute(dir).unwrap_or_else(|_| dir.clone());
        let snippet = Snippet {
            port: &persistent_name(&absolute(&self.args.port)),
            found: &found,
            profiles,
            profile_dirs: self.args.profile_dir.iter().map(directory).collect(),
            timeout: None,
            mode: Mode::Listen,
        };
        Ok(report::print(&snippet.text()))
    }

    /// Protocol and format of the line; nothing where no requests were received with any setting.
    fn find(
        &self,
        protocols: &[Protocol],
        formats: &[LineFormat],
        bytes: &mut u64,
    ) -> Result<Option<(Protocol, LineFormat)>, String> {
        for _ in 0..ROUNDS {
            for format in formats {
                let mut guess = Guess::new(*format, protocols);
                self.hear(format, DWELL, |bytes, now| {
                    guess.on_bytes(bytes, now);
                    guess.found().is_some()
                })?;
                *bytes += guess.bytes();
                if let Some((protocol, format)) = guess.found() {
                    return Ok(Some((protocol, format)));
                }
                if self.stop.load(Ordering::Relaxed) {
                    return Ok(None);
                }
            }
        }
        Ok(None)
    }

    fn survey(&self, protocol: Protocol, format: &LineFormat) -> Result<(Survey, N2Survey), String> {
        let (mut survey, mut n2) = (Survey::default(), N2Survey::default());
        let mut decoder = Decoder::new(protocol, *format, BTreeMap::new());
        let mut heard: Vec<Traffic> = Vec::new();
        self.hear(format, Duration::from_secs(self.args.seconds), |bytes, now| {
            if bytes.is_empty() {
                decoder.on_time(now, &mut heard);
            } else {
                decoder.on_bytes(bytes, now, &mut heard);
            }
            for one in heard.drain(..) {
                survey.add(protocol, &one);
                if protocol == Protocol::N2 {
                    n2.add(&one);
                }
            }
            false
        })?;
        Ok((survey, n2))
    }

    /// Passes received bytes to `take`, until that has enough or the time has ended.
    fn hear(
        &self,
        format: &LineFormat,
        time: Duration,
        mut take: impl FnMut(&[u8], Instant) -> bool,
    ) -> Result<(), String> {
        let (line, _) = Receiver::open(&self.args.port, format).map_err(|error| error.to_string())?;
        let lost = |lost: Lost| format!("{lost}; {}", self.args.port);
        let end = Instant::now() + time;
        let mut buffer = [0u8; 512];
        while Instant::now() < end && !self.stop.load(Ordering::Relaxed) {
            let woken = line.wait(end.min(Instant::now() + LOOK), None).map_err(lost)?;
            let count = match woken {
                Woken::Readable => line.receive(&mut buffer).map_err(lost)?,
                Woken::Command | Woken::Time => 0,
            };
            if take(buffer.get(..count).unwrap_or_default(), Instant::now()) {
                break;
            }
        }
        Ok(())
    }
}

fn nothing(bytes: u64, port: &str) -> String {
    match bytes {
        0 => format!(
            "no byte was received; {port}; check that the other master polls, that A and B reach this port, and that \
             the adapter \
             receives"
        ),
        bytes => format!(
            "{bytes} bytes were received, but no valid request with any setting; {port}; check A and B, name --baud \
             and --format, or the line uses another protocol"
        ),
    }
}

fn seconds(time: Option<Duration>) -> String {
    time.map_or("-".to_string(), |time| format!("{:.1}", time.as_secs_f64() * 1e3))
}

/// The requests on the line: to which address, how often, with which result.
fn words(survey: &Survey, profiles: &Profiles, protocol: Protocol) -> String {
    let mut text = String::new();
    let mut table = report::table(["address", "request", "seen", "answered", "refused", "cycle ms"]);
    for (address, seen) in &survey.addresses {
        for asked in seen.requests.values() {
            table.add_row([
                address.to_string(),
                asked.what.clone(),
                asked.count.to_string(),
                asked.answered.to_string(),
                asked.refused.to_string(),
                seconds(asked.cycle()),
            ]);
        }
    }
    (2..6).for_each(|column| table.align_right(column));
    text += &report::lines(&table);
    text.push('\n');
    for (address, seen) in survey.addresses.iter().filter(|(address, _)| **address > 0) {
        let profiles = seen.fitting(profiles, protocol);
        let profile = match profiles.as_slice() {
            [] => "no profile fits what is read".to_string(),
            some => format!("what is read fits {}", some.join(" or ")),
        };
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "address {address}: {} answered, {} unanswered, {} doubtful; turnaround {} ms; {profile}",
            seen.answered,
            seen.silent,
            seen.doubtful,
            seconds(seen.turnaround()),
        );
    }
    let _ = writeln!(
        text,
        "{} requests in {:.1} s, cycle of the other master {} ms, {} bytes outside frames",
        survey.requests,
        survey.time().as_secs_f64(),
        seconds(survey.cycle()),
        survey.stray,
    );
    text
}
