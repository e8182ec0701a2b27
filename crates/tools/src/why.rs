//! `drivegate why`: why a drive does not run.

use std::fmt::Write;
use std::time::Duration;

use super::client::GatewayRequest;
use super::drive_access::{Needs, OneDrive, Target};
use super::failure::Outcome;
use super::{printable, report};
use drivegate_http::messages::Why;

/// Shows why a drive does not run: each cause with evidence, age and remedy.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate why --config drivegate.toml pump-1
  drivegate why --config drivegate.toml pump-1 --json

A running gateway is asked through its local socket, and knows who commanded the drive last; without one the command
opens the port itself and reads the drive.")]
pub(super) struct Args {
    #[command(flatten)]
    drive: OneDrive,
    /// JSON instead of text.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Outcome {
    let why = why(&args.drive.target()?)?;
    Ok(report::print(&if args.json {
        serde_json::to_string_pretty(&why).unwrap_or_default() + "\n"
    } else {
        text(&args.drive.name, &why)
    }))
}

fn why(target: &Target) -> Result<Why, String> {
    let asked = GatewayRequest::get(target.path("why"));
    let (reply, _) = target.ask(&asked, Needs::All)?;
    Ok(reply.accepted(&asked)?)
}

fn text(drive: &str, why: &Why) -> String {
    let explanation = &why.explanation;
    let mut text = match explanation.runs {
        Some(true) => format!("{drive} runs\n"),
        Some(false) => format!("{drive} does not run\n"),
        None => format!("it is unknown whether {drive} runs\n"),
    };
    for cause in &explanation.causes {
        let age = cause.age_ms.map_or(String::new(), |ms| {
            format!(" ({} ago)", seconds(Duration::from_millis(ms)))
        });
        let evidence = printable::line(&cause.evidence);
        // Writing to a String cannot fail.
        let _ = write!(text, "\n  {}: {evidence}{age}\n      {}\n", cause.cause, cause.remedy);
    }
    if explanation.runs != Some(true) && !explanation.not_told.is_empty() {
        let _ = write!(
            text,
            "\n  not reported by this drive, so not ruled out: {}\n",
            explanation.not_told.join(", ")
        );
    }
    if !why.profile_verified {
        let _ = write!(
            text,
            "\n  the profile {} is not verified on hardware: its reading of the drive's state may be wrong\n",
            printable::line(&why.profile)
        );
    }
    text
}

/// A duration as text.
fn seconds(age: Duration) -> String {
    match age.as_secs() {
        0..120 => format!("{:.1} s", age.as_secs_f64()),
        120..7200 => format!("{} min", age.as_secs() / 60),
        _ => format!("{} h", age.as_secs() / 3600),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_model::drive::why::{Cause, Explanation};

    #[test]
    fn each_cause_has_its_evidence_its_age_and_a_remedy() {
        let cause = Cause {
            cause: "interlocked".to_string(),
            evidence: "interlocked is on".to_string(),
            age_ms: Some(140),
            remedy: "close it".to_string(),
            ..Cause::default()
        };
        let explanation = Explanation {
            runs: Some(false),
            causes: vec![cause],
            not_told: vec!["enable input".to_string()],
        };
        let expected = "fan-1 does not run\n\n  interlocked: interlocked is on (0.1 s ago)\n      close it\n\n  \
                        not reported by this drive, so not ruled out: enable input\n";
        let of = |explanation: &Explanation, profile: &str, profile_verified| Why {
            explanation: explanation.clone(),
            profile: profile.to_string(),
            profile_verified,
        };
        assert_eq!(text("fan-1", &of(&explanation, "vacon-nx", true)), expected);
        let doubt = text("fan-1", &of(&explanation, "yaskawa-v1000", false));
        assert!(doubt.starts_with(expected) && doubt.contains("yaskawa-v1000 is not verified on hardware"));
        let runs = Explanation {
            runs: Some(true),
            ..Explanation::default()
        };
        assert_eq!(text("fan-1", &of(&runs, "vacon-nx", true)), "fan-1 runs\n");
    }
}
