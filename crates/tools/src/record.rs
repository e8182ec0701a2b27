//! `drivegate record`: makes the running gateway record a drive.

use std::process::ExitCode;

use super::client::Asked;
use super::drive_access::{OneDrive, Target};
use super::report;
use crate::north::http::messages::Recorded;

/// Makes the running gateway record a drive: the time just before and after.
///
/// Prints the id of the recording. The times are `before` and `after` of [recordings].
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:
  drivegate record --config drivegate.toml pump-1
  drivegate recordings --config drivegate.toml show 20260302T074012.118Z-pump-1")]
pub(super) struct Args {
    #[command(flatten)]
    drive: OneDrive,
}

pub(super) fn run(args: &Args) -> ExitCode {
    args.drive.with(record)
}

fn record(target: &Target) -> ExitCode {
    let asked = Asked::post(target.path("recordings"), &serde_json::json!({}));
    let asked = asked.if_refused("set max_count of [recordings] above 0 and reload");
    let reply = target.ask_gateway(&asked);
    match reply.and_then(|reply| Ok(reply.accepted::<Recorded>(&asked)?)) {
        Ok(record) => {
            report::note(&format!("it will be complete in {:.0} s", record.after_s));
            report::print(&format!("{}\n", record.id))
        }
        Err(message) => report::failed(&message),
    }
}
