//! `drivegate reload`: the running gateway reads its configuration again.

use std::path::Path;

use hyper::StatusCode;

use super::client::{Client, GatewayRequest};
use super::failure::{Failure, Outcome};
use super::{ConfigFile, EXIT_CONFIG, report};
use drivegate_gateway::config::{Settings, environment};
use drivegate_http::local::SocketPath;
use drivegate_http::messages::ReloadOutcome;

/// Makes the running gateway reload its configuration, and waits for the result.
///
/// Prints what changed. If the gateway refuses the configuration, its errors are printed, the exit code is 78, and the
/// gateway keeps the previous one.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  drivegate reload --config /etc/drivegate/drivegate.toml")]
pub(super) struct Args {
    #[command(flatten)]
    config: ConfigFile,
}

pub(super) fn run(args: &Args) -> Outcome {
    super::block_on(async { reported(&reload(&args.config.path).await?) })
}

async fn reload(config: &Path) -> Result<ReloadOutcome, String> {
    if Settings::socket_of(config, environment()) == SocketPath::Off {
        return Err(format!(
            "`socket` of [gateway] is off, so the running gateway cannot be asked; {}; use `systemctl reload drivegate`, \
             which does not report the outcome",
            config.display()
        ));
    }
    let asked = GatewayRequest::post("/api/v1/reload", &serde_json::json!({})).if_lost("check its log");
    let reply = Client::of_configuration(config)?.ask(&asked).await?;
    match reply.status {
        StatusCode::OK | StatusCode::UNPROCESSABLE_ENTITY => Ok(reply.document()?),
        _ => Err(reply.refusal(&asked).to_string()),
    }
}

fn reported(outcome: &ReloadOutcome) -> Outcome {
    outcome.warnings.iter().for_each(|warning| report::warning(warning));
    outcome.errors.iter().for_each(|error| report::error(error));
    if !outcome.errors.is_empty() {
        report::note("the gateway keeps the previous configuration");
        return Err(Failure::Reported(EXIT_CONFIG));
    }
    Ok(report::print(&match outcome.changes.as_slice() {
        [] => "reloaded, nothing changed\n".to_string(),
        changes => changes.iter().map(|change| format!("{change}\n")).collect(),
    }))
}
