//! `drivegate hold`: who holds a drive, and taking, renewing, releasing and breaking that.

use serde::Deserialize;
use serde_json::Value as Json;

use super::client::{Gateway, GatewayRequest, encoded};
use super::failure::{Outcome, documented};
use super::{printable, report};
use drivegate_http::messages::HoldAct;

/// Prints who holds a drive: holder, rank and seconds left; or takes, renews, releases or breaks the hold.
///
/// Over the local socket it acts as the calling user, who has the first rank unless a principal names that user.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate hold --config drivegate.toml pump-1
  drivegate hold --config drivegate.toml pump-1 take")]
pub(super) struct Args {
    #[command(flatten)]
    gateway: Gateway,
    /// Name of the drive.
    drive: String,
    /// What to do; by default only the holder is printed.
    #[arg(value_parser = ["take", "renew", "release", "break"])]
    action: Option<String>,
    /// JSON instead of text.
    #[arg(long)]
    json: bool,
}

/// The gateway's reply.
#[derive(Debug, Deserialize)]
struct HoldDocument {
    #[serde(default)]
    error: Option<Reason>,
    hold: String,
    holder: Option<String>,
    holder_rank: Option<String>,
    hold_left_s: Option<u64>,
}

#[derive(Debug, Deserialize)]
struct Reason {
    message: String,
}

pub(super) fn run(args: &Args) -> Outcome {
    super::block_on(async {
        let (hold, document) = match hold(args).await {
            Ok(hold) => hold,
            Err(why) => return documented(args.json, Err(why.into())),
        };
        let printed = if args.json {
            report::json(&document)
        } else {
            report::print(&line(&hold))
        };
        match hold.error {
            None => Ok(printed),
            Some(reason) => Err(reason.message.into()),
        }
    })
}

/// The gateway's reply: parsed, and as it was sent.
async fn hold(args: &Args) -> Result<(HoldDocument, Json), String> {
    let path = format!("/api/v1/drives/{}/hold", encoded(&args.drive));
    let asked = match &args.action {
        None => GatewayRequest::get(path),
        Some(action) => {
            let lost = "it is unknown whether the hold changed: run it again without an action";
            GatewayRequest::post(path, &HoldAct { action: action.clone() }).if_lost(lost)
        }
    };
    let reply = args.gateway.client()?.ask(&asked).await?;
    match reply.parsed().zip(reply.parsed()) {
        // Replies of success and of refusal both carry the state of the hold.
        Some(hold) => Ok(hold),
        None => Err(reply.refusal(&asked).to_string()),
    }
}

/// One line of text: holder, rank and seconds left.
fn line(hold: &HoldDocument) -> String {
    let HoldDocument {
        hold,
        holder,
        holder_rank,
        hold_left_s,
        ..
    } = hold;
    let (Some(holder), Some(rank)) = (holder, holder_rank) else {
        return format!("{}\n", printable::line(hold));
    };
    let (holder, rank) = (printable::line(holder), printable::line(rank));
    match (hold.as_str(), hold_left_s) {
        ("reserved", Some(left)) => format!("{holder} ({rank}) stopped it, reserved for {left} s\n"),
        (_, Some(left)) => format!("{holder} ({rank}), {left} s left\n"),
        (_, None) => format!("{holder}\n"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_line() {
        let said = |json: &str| line(&serde_json::from_str(json).unwrap());
        let held = r#"{"drive": "p", "hold": "held", "holder": "plc", "holder_rank": "automation", "hold_left_s": 24}"#;
        assert_eq!(said(held), "plc (automation), 24 s left\n");
        let stopped = held.replace("held\"", "reserved\"");
        assert_eq!(said(&stopped), "plc (automation) stopped it, reserved for 24 s\n");
        let free = r#"{"hold": "free", "holder": null, "holder_rank": null, "hold_left_s": 0}"#;
        assert_eq!(said(free), "free\n");
        let local = r#"{"hold": "local", "holder": "local", "holder_rank": "local", "hold_left_s": null}"#;
        assert_eq!(said(local), "local\n");
    }
}
