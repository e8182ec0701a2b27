//! The drives that were found, read and shown until a signal.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use super::dialog::{Keyboard, is_terminal, write_new};
use super::starting::next_steps;
use super::{Args, Stop};
use crate::failure::{Failure, Outcome};
use crate::scan::figure;
use crate::{EXIT_FAILED, demo, report};
use drivegate_core::plant::SharedPlant;
use drivegate_gateway::config::{LogFormat, LogSettings, Settings, StateFiles};
use drivegate_gateway::daemon::Daemon;
use drivegate_http::local::SocketPath;
use drivegate_model::drive::{ModelPoint, State};

/// Preferred port of the status page.
const HTTP: u16 = 9488;
/// Time for the first values of all drives.
const FIRST_VALUES: Duration = Duration::from_secs(10);

/// Reads the drives of the configuration `text` and serves the status page until a signal.
/// `before_commands`: what the drives need first.
pub(super) fn serve(args: &Args, stop: &Stop, keyboard: &Keyboard, text: &str, before_commands: &str) -> Outcome {
    let loaded = Settings::parse("drivegate.toml", text, std::iter::empty());
    report::errors(&loaded.errors);
    let mut settings = loaded.settings.ok_or(Failure::Reported(EXIT_FAILED))?;
    // A trial writes nothing to disk and has no local socket.
    settings.socket = SocketPath::Off;
    settings.recordings.max_count = 0;
    settings.state_files = StateFiles::Unused;
    let _log = crate::log::start(&LogSettings {
        level: "error".to_string(),
        format: LogFormat::Auto,
    });
    let buses = settings.buses.clone();
    let runtime = crate::runtime()?;
    let daemon = runtime.block_on(start(settings))?;
    runtime.block_on(first_values(&daemon.plant(), stop));
    report::print(&values(&daemon.plant()));
    if let Some(address) = daemon.http_address() {
        report::print(&format!(
            "\nStatus page, from this machine only: http://{address}/\nThe drives are only read. Ctrl-C to stop.\n"
        ));
    }
    let next = |file: &Path| next_steps(file, &buses, before_commands);
    let offered = offer(args, stop, keyboard, text, next);
    if offered.is_ok() {
        runtime.block_on(stop.token.cancelled());
    }
    runtime.block_on(daemon.stop());
    offered?;
    Ok(ExitCode::SUCCESS)
}

/// Starts the gateway with its status page at the first free port.
async fn start(mut settings: Settings) -> Result<Daemon, String> {
    let mut port = HTTP;
    loop {
        let address = demo::free_port("the status page", port)?;
        settings.http = Some(drivegate_http::Options::listening_on(address));
        match Daemon::start(settings.clone()).await {
            // Another program has taken the port since it was found free.
            Err(error) if error.address_in_use().is_some() => port = address.port().saturating_add(1),
            started => return started.map_err(|error| error.to_string()),
        }
    }
}

/// Waits until each drive that answers has values.
async fn first_values(plant: &SharedPlant, stop: &Stop) {
    let deadline = Instant::now() + FIRST_VALUES;
    let settled = || {
        plant.load().drives().all(|drive| {
            let link = drive.image.snapshot().link;
            link.is_tried() && (!link.is_online() || drive.reading(Instant::now()).state().is_some())
        })
    };
    while !settled() && !stop.is_wanted() && Instant::now() < deadline {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

fn values(plant: &SharedPlant) -> String {
    let mut table = report::table(["drive", "address", "profile", "state", "Hz", "rpm", "A", "fault"]);
    for drive in plant.load().drives() {
        let (spec, reading) = (&drive.image.spec, drive.reading(Instant::now()));
        table.add_row([
            spec.name.clone(),
            spec.address.to_string(),
            spec.profile.name.clone(),
            reading.state().map_or("unknown", State::name).to_string(),
            figure(&reading, ModelPoint::OutputFrequency, 2),
            figure(&reading, ModelPoint::MotorSpeed, 0),
            figure(&reading, ModelPoint::MotorCurrent, 1),
            reading.fault_text(),
        ]);
    }
    format!("\n{}", report::lines(&table))
}

/// Writes the configuration where that is wanted.
fn offer(
    args: &Args,
    stop: &Stop,
    keyboard: &Keyboard,
    text: &str,
    next: impl Fn(&Path) -> String,
) -> Result<(), String> {
    if let Some(file) = &args.write {
        write_new(file, text)?;
        report::print(&next(file));
        return Ok(());
    }
    if !is_terminal() {
        report::note("no configuration was written; --write FILE writes one");
        return Ok(());
    }
    while !stop.is_wanted() {
        let answer = keyboard.ask(
            "\nSave this as a configuration? Name of a new file, y for drivegate.toml, or Enter for none:",
            stop,
        );
        let Some(file) = answer.and_then(|answer| wanted_file(&answer)) else {
            return Ok(());
        };
        match write_new(&file, text) {
            Ok(()) => {
                report::print(&next(&file));
                return Ok(());
            }
            Err(message) => report::error(&message),
        }
    }
    Ok(())
}

/// The file named in an answer; `None` if no file is wanted. Yes or no is not a file name.
fn wanted_file(answer: &str) -> Option<PathBuf> {
    match answer.to_lowercase().as_str() {
        "" | "n" | "no" | "nein" => None,
        "y" | "yes" | "j" | "ja" | "ok" => Some(PathBuf::from("drivegate.toml")),
        _ => Some(PathBuf::from(answer)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_yes_is_no_name_of_a_file() {
        for (answer, file) in [
            ("", None),
            ("n", None),
            ("No", None),
            ("y", Some("drivegate.toml")),
            ("YES", Some("drivegate.toml")),
            ("Pumps.toml", Some("Pumps.toml")),
            ("yard.toml", Some("yard.toml")),
        ] {
            assert_eq!(wanted_file(answer), file.map(PathBuf::from), "{answer}");
        }
    }
}
