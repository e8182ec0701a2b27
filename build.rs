//! Lays out the functions that a running gateway executes one after the other: docs/development.md, The order of functions.

use std::env;

const ORDER: &str = "deploy/function_order/order.ld";
/// Linkers that do not read linker scripts.
const OTHERS: [&str; 3] = ["gold", "mold", "wild"];

fn main() {
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
