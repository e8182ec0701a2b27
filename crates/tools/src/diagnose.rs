//! `drivegate diagnose`: shows the verdicts about a line.

use std::fmt::Write;

use serde::Deserialize;

use super::client::{Gateway, encoded};
use super::failure::Outcome;
use super::port_users::{self, BusAt, PortUser};
use super::{printable, report};
use drivegate_core::diagnosis::{Counted, Verdict};

/// Shows what is wrong with a line: each verdict with evidence, certainty and remedy.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate diagnose
  drivegate diagnose line1 --url http://10.0.0.5:9488
  drivegate diagnose --json

Asks a running gateway, which monitors its lines continuously. Verdicts are based on the last minute: one takes half a
minute to appear and a minute to clear. Exit code 0 whatever is found.")]
pub(super) struct Args {
    #[command(flatten)]
    gateway: Gateway,
    /// Name of the bus [default: all].
    bus: Option<String>,
    /// JSON instead of text.
    #[arg(long)]
    json: bool,
}

/// The diagnosis of a bus, from the gateway.
#[derive(Debug, Deserialize)]
struct Diagnosis {
    bus: String,
    time: Option<String>,
    verdicts: Vec<Verdict>,
    drives: Vec<Counted>,
}

pub(super) fn run(args: &Args) -> Outcome {
    super::block_on(async { Ok(report::print(&diagnose(args).await?)) })
}

async fn diagnose(args: &Args) -> Result<String, String> {
    let client = args.gateway.viewer()?;
    let buses: Vec<BusAt> = client.view("/api/v1/buses").await?;
    let names: Vec<&str> = match &args.bus {
        Some(name) => vec![name],
        None => buses.iter().map(|bus| bus.name.as_str()).collect(),
    };
    let mut all = Vec::new();
    for name in names {
        all.push(
            client
                .view(&format!("/api/v1/buses/{}/diagnosis", encoded(name)))
                .await?,
        );
    }
    if args.json {
        return Ok(serde_json::to_string_pretty(&all).unwrap_or_default() + "\n");
    }
    let text = |value: serde_json::Value| {
        let diagnosis: Diagnosis = serde_json::from_value(value).map_err(|error| {
            format!(
                "unexpected reply from the gateway ({error}); the gateway; use the same \
                version"
            )
        })?;
        // A port of another machine has a name that means nothing here.
        let here = buses
            .iter()
            .filter(|bus| bus.name == diagnosis.bus && args.gateway.network().is_none());
        let users = here.flat_map(|bus| shared(&bus.port, &port_users::strangers(&bus.port)));
        Ok(text(&diagnosis) + &users.collect::<String>())
    };
    all.into_iter()
        .map(text)
        .collect::<Result<Vec<String>, String>>()
        .map(|texts| texts.join("\n"))
}

/// The other programs that read the port of a bus: they take a part of the replies.
fn shared(port: &str, users: &[PortUser]) -> Option<String> {
    (!users.is_empty()).then(|| {
        format!(
            "\n  {} has the port of this bus open, too, and takes replies from it\n      do: end that program; {}\n",
            printable::line(&port_users::listed(users)),
            printable::line(port)
        )
    })
}

/// The drives that have answered nothing so far, in words.
fn mute(drives: &[Counted]) -> Option<String> {
    let mute = drives.iter().filter(|one| one.answered == 0 && one.silent > 0);
    let names: Vec<_> = mute.map(|one| printable::line(&one.drive).to_string()).collect();
    match names.len() {
        0 => None,
        count if count == drives.len() => Some("no drive has answered in the last minute".to_string()),
        _ => Some(format!("no answer in the last minute from {}", names.join(", "))),
    }
}

fn text(diagnosis: &Diagnosis) -> String {
    let mut text = format!("{}:", printable::line(&diagnosis.bus));
    text += &match (&diagnosis.time, diagnosis.verdicts.as_slice()) {
        (None, _) => " not available yet; try again in a few seconds\n".to_string(),
        (_, []) => match mute(&diagnosis.drives) {
            None => " no problems detected in the last minute\n".to_string(),
            Some(mute) => format!(" {mute}; the cause is known within half a minute of requests\n"),
        },
        _ => "\n".to_string(),
    };
    for verdict in &diagnosis.verdicts {
        let about = verdict
            .drive
            .as_deref()
            .map_or(String::new(), |drive| format!(" {}", printable::line(drive)));
        let (evidence, remedy) = (printable::line(&verdict.evidence), printable::line(&verdict.remedy));
        // Writing to a String cannot fail.
        let _ = write!(
            text,
            "\n  {}{about}: {} ({})\n      seen: {evidence}\n      do: {remedy}\n",
            verdict.verdict.name(),
            printable::line(&verdict.meaning),
            verdict.certainty.name()
        );
        if !verdict.steps.is_empty() {
            text += "      at the drives; `drivegate profiles show NAME` has all steps:\n";
        }
        for step in &verdict.steps {
            let _ = writeln!(text, "        - {}", printable::line(step));
        }
    }
    let bad = |one: &&Counted| one.silent + one.damaged + one.late + one.second + one.stray_before > 0;
    let bad: Vec<&Counted> = diagnosis.drives.iter().filter(bad).collect();
    if !bad.is_empty() {
        text += "\n  in the last minute     answered  no reply  damaged  late  second  stray before  slowest\n";
    }
    for one in bad {
        let _ = writeln!(
            text,
            "  {:<22} {:>8}  {:>8}  {:>7}  {:>4}  {:>6}  {:>12}  {:>4.1} ms",
            printable::line(&one.drive),
            one.answered,
            one.silent,
            one.damaged,
            one.late,
            one.second,
            one.stray_before,
            one.slowest_ms
        );
        if let Some(by_drive) = &one.by_drive {
            let _ = writeln!(
                text,
                "    counted by the drive: {} valid and {} damaged messages on the line, {} to it, {} of them \
                 unanswered, {} exceptions",
                by_drive.messages, by_drive.damaged, by_drive.own, by_drive.unanswered, by_drive.exceptions
            );
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_core::diagnosis::{Cause, Certainty};

    #[test]
    fn a_verdict_is_told_with_evidence_and_remedy() {
        let mut diagnosis = Diagnosis {
            bus: "line1".to_string(),
            time: None,
            verdicts: Vec::new(),
            drives: vec![Counted {
                by_drive: None,
                drive: "pump-1".to_string(),
                ..Counted::default()
            }],
        };
        assert_eq!(
            text(&diagnosis),
            "line1: not available yet; try again in a few seconds\n"
        );
        diagnosis.time = Some("2026-03-02T06:11:09.480Z".to_string());
        assert_eq!(text(&diagnosis), "line1: no problems detected in the last minute\n");
        diagnosis.drives[0].silent = 7;
        let begin = "line1: no drive has answered in the last minute; the cause is known within half a minute";
        assert!(text(&diagnosis).starts_with(begin), "{}", text(&diagnosis));
        let other = Counted {
            drive: "fan-2".to_string(),
            answered: 9,
            ..Counted::default()
        };
        diagnosis.drives.push(other);
        let begin = "line1: no answer in the last minute from pump-1; ";
        assert!(text(&diagnosis).starts_with(begin), "{}", text(&diagnosis));
        diagnosis.verdicts.push(Verdict {
            verdict: Cause::OneDrive,
            drive: Some("pump-1".to_string()),
            certainty: Certainty::Likely,
            meaning: "one is bad".to_string(),
            evidence: "7 of 9".to_string(),
            remedy: "look".to_string(),
            steps: vec!["vacon-nx: green LED steady".to_string()],
            since: String::new(),
        });
        diagnosis.drives[0].silent = 7;
        let expected = "line1:\n\n  one_drive pump-1: one is bad (likely)\n      seen: 7 of 9\n      do: look\n      at the drives; `drivegate profiles show NAME` has all steps:\n        - vacon-nx: green LED steady\n\n  in the last minute";
        assert!(text(&diagnosis).starts_with(expected), "{}", text(&diagnosis));
    }
}
