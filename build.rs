//! Lays out the functions that a running gateway executes one after the other: docs/development.md, The order of functions.
//! An optimised build knows its commit, which `--version` and the log state.

use std::env;
use std::path::Path;
use std::process::Command;

const ORDER: &str = "deploy/function_order/order.ld";
/// Linkers that do not read linker scripts.
const OTHERS: [&str; 3] = ["gold", "mold", "wild"];

const COMMIT: &str = "DRIVEGATE_COMMIT";
/// Changes with each commit and checkout.
const HEAD_LOG: &str = ".git/logs/HEAD";

fn main() {
    order();
    if env::var("PROFILE").is_ok_and(|profile| profile == "release") {
        commit();
    }
}

/// The commit of the checkout, unless the caller says which it is.
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

fn order() {
    println!("cargo::rerun-if-changed={ORDER}");
    println!("cargo::rerun-if-env-changed=DRIVEGATE_FUNCTION_ORDER");
    let is = |name: &str, value: &str| env::var(name).is_ok_and(|found| found == value);
    let flags = env::var("CARGO_ENCODED_RUSTFLAGS").unwrap_or_default();
    let other = OTHERS
        .iter()
        .any(|name| flags.contains(&format!("fuse-ld={name}")) || flags.contains(&format!("linker={name}")));
    let wanted = !is("DRIVEGATE_FUNCTION_ORDER", "none") && !other;
    let root = env::var("CARGO_MANIFEST_DIR").unwrap_or_default();
    // `-Wl,` parts its words at commas.
    if wanted && is("PROFILE", "release") && is("CARGO_CFG_TARGET_OS", "linux") && !root.contains(',') {
        println!("cargo::rustc-link-arg-bins=-Wl,-T,{root}/{ORDER}");
    }
}
