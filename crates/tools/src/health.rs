//! `drivegate health`: whether a running gateway is ready, as an exit code.

use hyper::StatusCode;

use super::client::{Gateway, GatewayRequest};
use super::failure::{Outcome, negative};
use super::report;
use drivegate_http::messages::Health;

/// Reports whether the running gateway is ready, for containers and scripts.
///
/// Exit code 0 if every bus is open, each drive was polled and every server listens, as with `/readyz`; else 1 with the
/// reasons. Uses the local socket; with `socket = ""` or --url, HTTP.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  drivegate health --config /etc/drivegate/drivegate.toml\n  \
    drivegate health --url http://127.0.0.1:9488"
)]
pub(super) struct Args {
    #[command(flatten)]
    gateway: Gateway,
    /// JSON instead of text.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Outcome {
    super::block_on(async {
        let reasons = unready(&args.gateway).await.unwrap_or_else(|why| vec![why]);
        if args.json {
            let ready = reasons.is_empty();
            let printed = report::json(&Health { ready, reasons });
            return if ready { Ok(printed) } else { negative() };
        }
        if reasons.is_empty() {
            return Ok(report::print("ready\n"));
        }
        reasons.iter().for_each(|reason| report::error(reason));
        negative()
    })
}

/// Why the gateway is not ready; empty if it is ready.
async fn unready(gateway: &Gateway) -> Result<Vec<String>, String> {
    // The path `/readyz` needs no token.
    let asked = GatewayRequest::view("/readyz");
    let reply = gateway.client()?.ask(&asked).await?;
    match (reply.status, reply.text()) {
        (StatusCode::OK, _) => Ok(Vec::new()),
        (StatusCode::SERVICE_UNAVAILABLE, text) if text.starts_with("not ready\n") => {
            Ok(text.lines().skip(1).map(str::to_string).collect())
        }
        _ => Err(reply.refusal(&asked).to_string()),
    }
}
