//! `drivegate scan`: finds the drives of a line and prints a configuration for them. Only reads.

mod found;
mod progress;
mod search;
mod settings;
mod snippet;
mod values;
pub(super) mod verdict;
mod wishes;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use serde_json::{Value as Json, json};

pub(super) use self::found::Found;
pub(super) use self::search::{Extent, Search, StrayBytes};
pub(super) use self::settings::{Options, Setting, parse_port, protocols};
pub(super) use self::snippet::{Snippet, absolute};
pub(super) use self::values::figure;
pub(super) use self::wishes::can_be;
use super::adapters::persistent_name;
use super::failure::{Failure, Outcome, documented, negative};
use super::{port_users, report};
use drivegate_bus::Mode;
use drivegate_model::drive::profile::Profiles;
use drivegate_proto::LineFormat;

/// Finds the drives on a line and prints a configuration for them; only reads.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate scan --port /dev/ttyUSB0
  drivegate scan --port /dev/ttyUSB0 --protocol modbus-rtu --baud all --format 8N1,8E1 --addresses 1-31
  drivegate scan --port /dev/ttyUSB0 --profile weg-cfw

Addresses 1 to 10 are tried first with all settings. Once a drive has answered, no other settings are tried, unless
--exhaustive. The configuration goes to standard output, everything else to standard error.")]
pub(super) struct Args {
    /// Serial device, or tcp://, rfc2217://, modbus-tcp:// or udp:// with host:port.
    #[arg(long, value_name = "PORT", value_parser = parse_port)]
    port: String,
    #[command(flatten)]
    options: Options,
    /// Continue with other settings after a drive has replied.
    #[arg(long)]
    exhaustive: bool,
    /// What was found as JSON instead of a configuration.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Outcome {
    let prepared = match prepare(&args.options, &args.port) {
        Ok(prepared) => prepared,
        Err(failure) => return documented(args.json, Err(failure)),
    };
    let (settings, profiles) = prepared;
    let stop = Arc::new(AtomicBool::new(false));
    stop_on_signal(stop.clone());
    let mut search = Search::new(&args.port, &args.options, profiles, stop);
    let extent = if args.exhaustive {
        Extent::Exhaustive
    } else {
        Extent::OneSetting
    };
    let outcome = search.run(&settings, extent);
    finish(args, &settings, &search, outcome)
}

/// The settings to try, and all profiles.
pub(super) fn prepare(options: &Options, port: &str) -> Result<(Vec<Setting>, Profiles), Failure> {
    let settings = settings::settings(options, port).map_err(Failure::Misused)?;
    let profiles = super::profiles_of(&options.profile_dir)?;
    wishes::check(&options.profile, &profiles).map_err(Failure::Misused)?;
    Ok((settings, profiles))
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

/// The configuration for the drives that were found.
pub(super) fn configuration(port: &str, options: &Options, search: &Search<'_>) -> String {
    let directory = |dir: &PathBuf| std::path::absolute(dir).unwrap_or_else(|_| dir.clone());
    let snippet = Snippet {
        port: &persistent_name(&absolute(port)),
        found: &search.found,
        profiles: &search.profiles,
        profile_dirs: options.profile_dir.iter().map(directory).collect(),
        timeout: options.timeout,
        mode: Mode::Master,
    };
    snippet.text()
}

/// Reports why probably no drive answered.
pub(super) fn nobody_answers(search: &Search<'_>, port: &str, tried: &[Setting]) {
    if let Some(why) = port_users::takes_replies(port) {
        report::error(&why);
        return;
    }
    report::error(&verdict::nobody_answers(&search.heard, port));
    report::lines_to_stderr(&verdict::at_silent_drives(&search.heard, tried, &search.profiles));
}

/// The drives found, as JSON; `error`: what ended the scan early.
fn document(args: &Args, search: &Search<'_>, error: Option<&String>) -> Json {
    let drive = |found: &Found| {
        json!({
            "address": found.address,
            "protocol": found.setting.protocol.name(),
            "baud": (found.setting.format != LineFormat::NETWORK).then_some(found.setting.format.baud),
            "format": (found.setting.format != LineFormat::NETWORK).then(|| found.setting.format.characters()),
            "profiles": found.profiles,
            "nameplate": (!found.nameplate.is_empty()).then_some(&found.nameplate),
            "turnaround_ms": found.turnaround.map(|time| time.as_secs_f64() * 1000.0),
        })
    };
    let mut document = json!({
        "port": args.port,
        "drives": search.found.iter().map(drive).collect::<Vec<_>>(),
    });
    if let Some((object, error)) = document.as_object_mut().zip(error) {
        object.insert("error".to_string(), json!(error));
    }
    document
}

fn finish(args: &Args, tried: &[Setting], search: &Search<'_>, outcome: Result<(), String>) -> Outcome {
    let printed = if args.json {
        let printed = report::json(&document(args, search, outcome.as_ref().err()));
        if search.found.is_empty() {
            negative()
        } else {
            Ok(printed)
        }
    } else if search.found.is_empty() {
        negative()
    } else {
        Ok(report::print(&configuration(&args.port, &args.options, search)))
    };
    outcome?;
    if search.found.is_empty() {
        nobody_answers(search, &args.port, tried);
        return printed;
    }
    if let Some(told) = verdict::beside_answers(&search.heard) {
        report::note(&told);
    }
    report::lines_to_stderr(&verdict::before_commands(&search.found, &search.profiles));
    printed
}
