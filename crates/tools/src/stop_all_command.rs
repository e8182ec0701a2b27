//! `drivegate stop-all`: stops all drives.

use super::client::{Gateway, GatewayRequest};
use super::failure::{Outcome, documented, negative};
use super::{printable, report};
use drivegate_core::stop_all::{StopReport, Stopped};
use drivegate_http::messages::StopBody;

/// Stops every controlled drive through the running gateway, and waits up to 10 s for them to stop.
///
/// Prints each drive; the exit code is 1 if one is not proven to have stopped. This is not an emergency stop.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate stop-all --config drivegate.toml
  drivegate stop-all --config drivegate.toml --bus line-1
  drivegate stop-all --config drivegate.toml --group pumps")]
pub(super) struct Args {
    #[command(flatten)]
    gateway: Gateway,
    /// Only the drives on this bus.
    #[arg(long, value_name = "BUS")]
    bus: Option<String>,
    /// Only the drives with this `group`.
    #[arg(long, value_name = "GROUP", conflicts_with = "bus")]
    group: Option<String>,
    /// JSON instead of text.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Outcome {
    let outcome = super::block_on(async {
        let stopped = stop_all(args).await?;
        let printed = if args.json {
            report::json(&stopped)
        } else {
            report::print(&shown(&stopped))
        };
        if stopped.ok { Ok(printed) } else { negative() }
    });
    documented(args.json, outcome)
}

async fn stop_all(args: &Args) -> Result<StopReport, String> {
    let scope = StopBody {
        bus: args.bus.clone(),
        group: args.group.clone(),
        wait_s: None,
    };
    let asked =
        GatewayRequest::post("/api/v1/stop", &scope).if_lost("it is unknown whether the drives stopped: check them");
    let reply = args.gateway.client()?.ask(&asked).await?;
    match reply.parsed() {
        // Replies of success and of failure both carry the report.
        Some(stopped) => Ok(stopped),
        None => Err(reply.refusal(&asked).to_string()),
    }
}

/// One line of text for each drive; drives that are not proven to stand come first.
fn shown(stopped: &StopReport) -> String {
    let (standing, others): (Vec<_>, Vec<_>) = stopped
        .drives
        .iter()
        .partition(|drive| drive.outcome == Stopped::Standing);
    let line = |drive: &&drivegate_core::stop_all::StoppedDrive| {
        let name = printable::line(&drive.drive);
        let reason = drive.reason.as_deref().unwrap_or_default();
        match drive.outcome {
            Stopped::Standing => format!("{name}: standing\n"),
            Stopped::Stopping => format!("{name}: NOT PROVEN STOPPED, stopping: {}\n", printable::line(reason)),
            Stopped::Unproven => format!("{name}: NOT PROVEN STOPPED, unproven: {}\n", printable::line(reason)),
        }
    };
    others.iter().chain(&standing).map(line).collect()
}
