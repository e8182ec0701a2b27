//! `drivegate reload`: the running gateway reads its configuration anew.

use std::process::ExitCode;

use super::local_client::{NotAsked, ask_gateway};
use super::{ConfigFile, EXIT_CONFIG, EXIT_FAILED, report};
use crate::north::local::protocol::{Outcome, ReloadOutcome, Request};

/// Lets the running gateway reload its configuration, and waits for the outcome.
///
/// Prints what changed. If the gateway refuses the configuration, its errors are printed, the exit code is 78, and
/// the gateway goes on with the former one.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  drivegate reload --config /etc/drivegate/drivegate.toml")]
pub(super) struct Args {
    #[command(flatten)]
    config: ConfigFile,
}

pub(super) fn run(args: &Args) -> ExitCode {
    super::block_on(async {
        let why = match ask_gateway(&args.config.path, Request::Reload).await {
            Ok(Outcome::Reload(outcome)) => return reported(&outcome),
            Ok(outcome) => outcome.not_asked_for(),
            Err(NotAsked::Because(why)) => why,
            Err(NotAsked::Off) => format!(
                "`socket` of [gateway] is off, so the running gateway cannot be asked; {}; use `systemctl reload drivegate`, \
                 which does not report the outcome",
                args.config.path.display()
            ),
        };
        report::error(&why);
        ExitCode::from(EXIT_FAILED)
    })
}

fn reported(outcome: &ReloadOutcome) -> ExitCode {
    outcome.warnings.iter().for_each(|warning| report::warning(warning));
    outcome.errors.iter().for_each(|error| report::error(error));
    if !outcome.errors.is_empty() {
        report::note("the gateway keeps the former configuration");
        return ExitCode::from(EXIT_CONFIG);
    }
    report::print(&match outcome.changes.as_slice() {
        [] => "reloaded, nothing changed\n".to_string(),
        changes => changes.iter().map(|change| format!("{change}\n")).collect(),
    })
}
