//! Files that the scripts of the tests and packages install and leave.

use std::fs;
use std::process::{Command, Stdio};

use crate::support::process::until;
use crate::support::tools::{python, root, run, run_well};

fn needs(arguments: &[&str]) -> String {
    let script = root().join("deploy/package/tools.sh");
    run_well(&script, &[&["--print"], arguments].concat())
}

#[test]
fn a_package_needs_the_tools_of_its_architecture_only() {
    let foreign = ["aarch64", "armv7", "arm64", "armhf", "gcc-", "qemu"];
    for purpose in ["deb", "image", "release", "test-static", "test-image", "test-package"] {
        let own = needs(&[purpose, "amd64"]);
        assert!(own.contains("x86_64-unknown-linux-gnu"), "{own}");
        if cfg!(target_arch = "x86_64") {
            assert!(!foreign.iter().any(|word| own.contains(word)), "{purpose}: {own}");
        }
    }
    let deb = needs(&["deb", "amd64"]);
    for word in ["buildah", "debootstrap", "runc", "lintian", "cyclonedx"] {
        assert!(!deb.contains(word), "{deb}");
    }
    let all = needs(&["all"]);
    for word in [
        "gcc-aarch64-linux-gnu",
        "gcc-arm-linux-gnueabihf",
        "buildah",
        "debootstrap",
        "runc",
        "jq",
        "lintian",
        "cargo-deb",
    ] {
        assert!(all.contains(word), "{word} is not in {all}");
    }
    let arm = needs(&["image", "arm64"]);
    assert!(
        arm.contains("gcc-aarch64-linux-gnu") && !arm.contains("gcc-arm"),
        "{arm}"
    );
}

#[test]
fn temporary_files_of_the_tests_go_with_their_run() {
    let base = tempfile::tempdir().unwrap();
    let script = root().join("tests/tools/in_own_tmp.sh");
    let with = |command: &str| {
        let mut run = Command::new(&script);
        run.args(["bash", "-c", command]).env("TMPDIR", base.path());
        run
    };
    let left = || fs::read_dir(base.path()).unwrap().count();
    let status = with("touch \"$TMPDIR/file\" && mktemp -d >/dev/null; exit 3").status();
    assert_eq!(
        (status.unwrap().code(), left()),
        (Some(3), 0),
        "removed, and the result is that of the command"
    );

    // A run that is killed leaves its directory to the next one.
    let mut killed = with("touch \"$TMPDIR/file\"; exec cat")
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    until("its directory", || (left() == 1).then_some(()));
    killed.kill().unwrap();
    killed.wait().unwrap();
    assert_eq!(left(), 1);
    assert!(with("true").status().unwrap().success());
    assert_eq!(left(), 0);
}

/// The functions that the faults of the world change are found, each once.
#[test]
fn every_fault_of_the_world_fits_the_core() {
    let script = root().join("tests/world/mutants.py");
    run_well(&python(), &[script.to_str().unwrap(), "--check"]);
    let finder = root().join("tests/world/rust_functions.py");
    run_well(&python(), &["-m", "doctest", finder.to_str().unwrap()]);
}

#[test]
fn a_fault_that_fits_no_function_is_named_with_what_may_be_meant() {
    let folder = tempfile::tempdir().unwrap();
    let faults = folder.path().join("mutants.toml");
    let edits = [
        (
            "gone",
            "fn = 'Pending::pusch'\nreturns = '()'",
            "0 functions have this name",
        ),
        (
            "elsewhere",
            "fn = 'Waiting::push_stop'\nreturns = '()'",
            "core::queue::stops::Pending::push_stop in",
        ),
        (
            "twice",
            "fn = 'pulse'\nreturns = 'Ok(())'",
            "2 functions have this name",
        ),
        (
            "renamed",
            "fn = 'Pending::push'\ngiven.commando = 'command'",
            "no parameter commando",
        ),
        (
            "both",
            "fn = 'Pending::push'\nbefore = ''\nreturns = '()'",
            "one of given, before, returns, result",
        ),
        (
            "quoted",
            "fn = 'Pending::push'\nold = ''\nreturns = '()'",
            "unknown: old",
        ),
    ];
    let text = |(name, edit, _): &(&str, &str, &str)| {
        format!("[[mutant]]\nname = '{name}'\npromise = 'one'\n[[mutant.edit]]\n{edit}\n")
    };
    fs::write(&faults, edits.iter().map(text).collect::<String>()).unwrap();
    let script = root().join("tests/world/mutants.py");
    let check = ["--check", "--faults", faults.to_str().unwrap()];
    let output = run(&python(), &[&[script.to_str().unwrap()], &check[..]].concat());
    assert!(!output.status.success());
    let said = String::from_utf8(output.stderr).unwrap();
    for (name, _, why) in edits {
        let line = said.lines().find(|line| line.starts_with(&format!("{name}: ")));
        assert!(line.is_some_and(|line| line.contains(why)), "{name}: {said}");
    }
}
