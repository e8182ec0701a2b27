//! `drivegate record`: makes the running gateway record a drive.

use super::client::GatewayRequest;
use super::drive_access::OneDrive;
use super::failure::Outcome;
use super::report;
use drivegate_http::messages::Recorded;

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

pub(super) fn run(args: &Args) -> Outcome {
    let target = args.drive.target()?;
    let asked = GatewayRequest::post(target.path("recordings"), &serde_json::json!({}));
    let asked = asked.if_refused("set max_count of [recordings] above 0 and reload");
    let record: Recorded = target.ask_gateway(&asked)?.accepted(&asked)?;
    report::note(&format!("it will be complete in {:.0} s", record.after_s));
    Ok(report::print(&format!("{}\n", record.id)))
}
