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
    let reads_scripts = !OTHERS.iter().any(|linker| flags.contains(linker));
    let wanted = !is("DRIVEGATE_FUNCTION_ORDER", "none");
    if wanted && is("PROFILE", "release") && is("CARGO_CFG_TARGET_OS", "linux") && reads_scripts {
        let root = env::var("CARGO_MANIFEST_DIR").unwrap_or_default();
        println!("cargo::rustc-link-arg-bins=-Wl,-T,{root}/{ORDER}");
    }
}
