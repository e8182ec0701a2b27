//! `drivegate stop-all`: stops all drives.

use std::process::ExitCode;

use super::local_client::{NotAsked, ask_gateway};
use super::{ConfigFile, EXIT_FAILED, printable, report};
use crate::north::local::protocol::{OfGateway, Outcome, Request, StopAllRequest};
use crate::stop_all::{StopReport, Stopped};

/// Stops every controlled drive through the running gateway, and waits up to 10 s for them to stand.
///
/// Prints each drive; the exit code is 1 if one is not proven to stand. This is no emergency stop.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate stop-all --config drivegate.toml
  drivegate stop-all --config drivegate.toml --bus line-1
  drivegate stop-all --config drivegate.toml --group pumps")]
pub(super) struct Args {
    #[command(flatten)]
    config: ConfigFile,
    /// Only the drives of this bus.
    #[arg(long, value_name = "BUS")]
    bus: Option<String>,
    /// Only the drives with this `group`.
    #[arg(long, value_name = "GROUP", conflicts_with = "bus")]
    group: Option<String>,
}

pub(super) fn run(args: &Args) -> ExitCode {
    let request = |of: OfGateway| {
        Request::StopAll(StopAllRequest {
            config: of.config,
            bus: args.bus.clone(),
            group: args.group.clone(),
        })
    };
    super::block_on(async {
        let why = match ask_gateway(&args.config.path, request).await {
            Ok(Outcome::StopAll(stopped)) => {
                report::print(&shown(&stopped));
                return match stopped.ok {
                    true => ExitCode::SUCCESS,
                    false => ExitCode::from(EXIT_FAILED),
                };
            }
            Ok(outcome) => outcome.not_asked_for(),
            Err(NotAsked::Because(why)) => why,
            Err(NotAsked::Off) => format!(
                "`socket` of [gateway] is off, so the running gateway cannot be asked; {}; use POST /api/v1/stop",
                args.config.path.display()
            ),
        };
        report::error(&why);
        ExitCode::from(EXIT_FAILED)
    })
}

/// A line for each drive, those that are not proven to stand first.
fn shown(stopped: &StopReport) -> String {
    let (standing, others): (Vec<_>, Vec<_>) = stopped
        .drives
        .iter()
        .partition(|drive| drive.outcome == Stopped::Standing);
    let line = |drive: &&crate::stop_all::StoppedDrive| {
        let name = printable::line(&drive.drive);
        let reason = drive.reason.as_deref().unwrap_or_default();
        match drive.outcome {
            Stopped::Standing => format!("{name}: standing\n"),
            Stopped::Stopping => format!("{name}: NOT PROVEN TO STAND, stopping: {}\n", printable::line(reason)),
            Stopped::Unproven => format!("{name}: NOT PROVEN TO STAND, unproven: {}\n", printable::line(reason)),
        }
    };
    others.iter().chain(&standing).map(line).collect()
}
