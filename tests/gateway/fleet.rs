//! The collection of deploy/fleet as far as it can be tested without Ansible, which `make fleet-rollout` uses.

use std::fs;

use crate::support::tools::{python, root, run, run_well};

#[test]
fn the_parts_of_the_collection_do_their_work() {
    let script = root().join("tests/fleet/collection.py");
    run_well(&python(), &[&script.display().to_string()]);
}

#[test]
fn an_inventory_becomes_the_configuration_that_it_came_from() {
    let script = root().join("tests/fleet/collection.py");
    let dir = tempfile::tempdir().unwrap();
    let written = dir.path().join("inventory.yml");
    for name in ["deploy/drivegate.toml", "deploy/compose/demo/drivegate.toml"] {
        let configuration = root().join(name).display().to_string();
        let program = std::path::Path::new(env!("CARGO_BIN_EXE_drivegate"));
        let printed = run(program, &["inventory", &configuration]);
        assert!(printed.status.success(), "{printed:?}");
        fs::write(&written, printed.stdout).unwrap();
        let inventory = written.display().to_string();
        run_well(&python(), &[&script.display().to_string(), &inventory, &configuration]);
    }
}
