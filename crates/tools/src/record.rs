//! `drivegate record`: makes the running gateway record a drive.

use std::process::ExitCode;

use super::drive_access::target;
use super::{EXIT_FAILED, report};
use crate::north::local::protocol::{Outcome, RecordRequest, Request};

/// Makes the running gateway record a drive: the time before now, and the time after.
///
/// Prints the id of the recording. How long before and after: `before` and `after` of [recordings].
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:
  drivegate record --config drivegate.toml pump-1
  drivegate recordings --config drivegate.toml show 20260302T074012.118Z-pump-1")]
pub(super) struct Args {
    #[command(flatten)]
    config: super::ConfigFile,
    /// Name of the drive.
    drive: String,
}

pub(super) fn run(args: &Args) -> ExitCode {
    let target = match target(&args.config.path, &args.drive) {
        Ok(target) => target,
        Err(code) => return code,
    };
    let request = Request::Record(RecordRequest {
        drive: target.spec.name.clone(),
        expect: Some(target.expected()),
    });
    match target.ask_gateway(&request) {
        Ok(Outcome::Record(record)) => {
            report::note(&format!("it is complete in {:.0} s", record.after_s));
            report::print(&format!("{}\n", record.id))
        }
        Ok(other) => failed(&other.not_asked_for()),
        Err(message) => failed(&message),
    }
}

fn failed(message: &str) -> ExitCode {
    report::error(message);
    ExitCode::from(EXIT_FAILED)
}
