//! Gives an optimised build its commit, which `--version`, the log and the metrics show.

use std::env;
use std::path::Path;
use std::process::Command;

const COMMIT: &str = "DRIVEGATE_COMMIT";
/// Git log that changes with each commit and checkout.
const HEAD_LOG: &str = ".git/logs/HEAD";

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    if env::var("PROFILE").is_ok_and(|profile| profile == "release") {
        commit();
    }
}

/// The commit of the checkout, unless the caller sets it.
fn commit() {
    println!("cargo::rerun-if-env-changed={COMMIT}");
    if env::var_os(COMMIT).is_some() || !Path::new(HEAD_LOG).exists() {
        return;
    }
    println!("cargo::rerun-if-changed={HEAD_LOG}");
    let asked = Command::new("git").args(["rev-parse", "--short=12", "HEAD"]).output();
    if let Ok(output) = asked
        && output.status.success()
    {
        println!(
            "cargo::rustc-env={COMMIT}={}",
            String::from_utf8_lossy(&output.stdout).trim()
        );
    }
}
