//! `drivegate why`: why a drive does not run.

use std::fmt::Write;
use std::process::ExitCode;
use std::time::Duration;

use super::drive_access::target;
use super::{EXIT_FAILED, printable, report};
use crate::drive::Profile;
use crate::drive::why::Explanation;
use crate::north::local::protocol::{Outcome, Request, WhyRequest};

/// Says why a drive does not run: each cause with its evidence, its age and what to do.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate why --config drivegate.toml pump-1
  drivegate why --config drivegate.toml pump-1 --json

A running gateway is asked through its local socket, and knows who commanded the drive last; without one the command
opens the port itself and reads the drive.")]
pub(super) struct Args {
    #[command(flatten)]
    config: super::ConfigFile,
    /// Name of the drive.
    drive: String,
    /// JSON instead of text.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> ExitCode {
    let target = match target(&args.config.path, &args.drive) {
        Ok(target) => target,
        Err(code) => return code,
    };
    let request = Request::Why(WhyRequest {
        drive: target.spec.name.clone(),
        expect: Some(target.expected()),
    });
    let outcome = target.ask(&request).and_then(|(outcome, _)| match outcome {
        Outcome::Why(explanation) => Ok(explanation),
        other => Err(other.not_asked_for()),
    });
    match outcome {
        Ok(explanation) if args.json => {
            report::print(&(serde_json::to_string_pretty(&explanation).unwrap_or_default() + "\n"))
        }
        Ok(explanation) => report::print(&text(&args.drive, &explanation, &target.spec.profile)),
        Err(message) => {
            report::error(&message);
            ExitCode::from(EXIT_FAILED)
        }
    }
}

fn text(drive: &str, explanation: &Explanation, profile: &Profile) -> String {
    let mut text = match explanation.runs {
        Some(true) => format!("{drive} runs\n"),
        Some(false) => format!("{drive} does not run\n"),
        None => format!("whether {drive} runs is not known\n"),
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
            "\n  not known, because the drive does not tell: {}\n",
            explanation.not_told.join(", ")
        );
    }
    if !profile.verified {
        let _ = write!(
            text,
            "\n  the profile {} is not verified on hardware: what it takes the drive's state for may be wrong\n",
            profile.name
        );
    }
    text
}

/// A time for people.
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
    use crate::drive::profile::Profiles;
    use crate::drive::why::Cause;

    #[test]
    fn each_cause_has_its_evidence_its_age_and_a_remedy() {
        let cause = Cause {
            cause: "interlocked".to_string(),
            evidence: "interlocked is on".to_string(),
            age_ms: Some(140),
            remedy: "close it".to_string(),
        };
        let explanation = Explanation {
            runs: Some(false),
            causes: vec![cause],
            not_told: vec!["enable input".to_string()],
        };
        let expected = "fan-1 does not run\n\n  interlocked: interlocked is on (0.1 s ago)\n      close it\n\n  \
                        not known, because the drive does not tell: enable input\n";
        let profiles = Profiles::built_in();
        let [known, doubtful] = ["vacon-nx", "yaskawa-v1000"].map(|name| profiles.get(name).unwrap());
        assert_eq!(text("fan-1", &explanation, known), expected);
        let doubt = text("fan-1", &explanation, doubtful);
        assert!(doubt.starts_with(expected) && doubt.contains("yaskawa-v1000 is not verified on hardware"));
        let runs = Explanation {
            runs: Some(true),
            ..Explanation::default()
        };
        assert_eq!(text("fan-1", &runs, known), "fan-1 runs\n");
    }
}
