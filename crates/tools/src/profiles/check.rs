//! `drivegate profiles check`: whether a profile is valid and its commands are safe.

use std::path::Path;
use std::time::Instant;

use super::super::failure::{Failure, Outcome};
use super::super::{EXIT_CONFIG, report};
use drivegate_bus::proof;
use drivegate_model::document;
use drivegate_model::drive::Profile;
use drivegate_model::drive::profile::Profiles;

pub(super) fn run(file: &Path, known: &Profiles) -> Outcome {
    let name = file.display().to_string();
    let read = document::read_file(file).map_err(|problem| vec![problem]);
    let profile = read.and_then(|text| Profile::parse_over(&name, &text, false, known));
    let profile = profile.map_err(Failure::Invalid)?;
    for warning in &profile.warnings {
        report::warning(&warning.to_string());
    }
    let began = Instant::now();
    match proof::prove(&profile) {
        Ok(proof) => Ok(report::print(&text(&name, &profile, proof, began))),
        Err(counterexample) => {
            report::error(&format!(
                "commands of profile `{}` are not safe: {}; {name}; correct its [control]",
                profile.name, counterexample.what
            ));
            report::note(&format!("drive: {}", counterexample.state));
            report::note(&format!("command: {}", counterexample.command));
            for frame in &counterexample.frames {
                report::note(&format!("frame: {frame}"));
            }
            Err(Failure::Reported(EXIT_CONFIG))
        }
    }
}

fn text(file: &str, profile: &Profile, proof: proof::Proof, began: Instant) -> String {
    let points = profile.points.iter().filter(|point| !point.hidden).count();
    let commands = match proof.commands {
        0 => "no [control], so there are no commands to prove".to_string(),
        count => format!(
            "commands proved: {count} cases with {} requests in {} ms: every state, each request lost, refused or repeated, a stop in \
             between",
            proof.frames,
            began.elapsed().as_millis()
        ),
    };
    format!("{file}: ok, profile {}, {points} points\n{commands}\n", profile.name)
}
