//! The packages and the image, as far as they can be checked without a build; `make test-package`, `make
//! test-static` and `make test-image` do the rest.

#[path = "../../deploy/package/manual/pages.rs"]
mod pages;

use std::fs;
use std::path::{Path, PathBuf};

use crate::support::tools::{root, run_well, tool};
use tempfile::TempDir;

fn read(path: impl AsRef<Path>) -> String {
    let path = root().join(path);
    fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

fn deb() -> toml::Table {
    let manifest: toml::Table = read("Cargo.toml").parse().unwrap();
    manifest["package"]["metadata"]["deb"].as_table().unwrap().clone()
}

/// Source and destination of each file of the Debian package.
fn assets() -> Vec<(String, String)> {
    let text = |value: &toml::Value| value.as_str().unwrap().to_string();
    let deb = deb();
    let assets = deb["assets"].as_array().unwrap();
    assets.iter().map(|asset| (text(&asset[0]), text(&asset[1]))).collect()
}

/// Collects every subcommand of `command`, as the name of its manual page.
fn names(command: &clap::Command, page: &str, found: &mut Vec<String>) {
    found.push(page.to_string());
    for inner in command.get_subcommands().filter(|inner| !inner.is_hide_set()) {
        names(inner, &format!("{page}-{}", inner.get_name()), found);
    }
}

#[test]
fn every_command_has_a_manual_page_and_completions() {
    let folder = TempDir::new().unwrap();
    pages::write(folder.path()).unwrap();
    let written = |name: &str| fs::read_to_string(folder.path().join(name)).unwrap();

    let command = drivegate_tools::command_line();
    let mut wanted = Vec::new();
    names(&command, "drivegate", &mut wanted);
    assert!(wanted.len() > 15, "{wanted:?}");
    for name in &wanted {
        let page = written(&format!("man1/{name}.1"));
        assert!(page.contains(".SH SYNOPSIS"), "{name}: {page}");
    }
    for shell in ["drivegate.bash", "_drivegate", "drivegate.fish"] {
        let text = written(shell);
        for inner in command.get_subcommands() {
            assert!(
                text.contains(inner.get_name()),
                "{shell} does not know {}",
                inner.get_name()
            );
        }
    }
    run_well(
        &tool("bash"),
        &["-n", &folder.path().join("drivegate.bash").display().to_string()],
    );
}

#[test]
fn what_the_package_names_is_there() {
    let staged = "target/package/stage/";
    let script = read("deploy/package/deb.sh");
    for (source, _) in assets() {
        if let Some(name) = source.strip_prefix(staged) {
            let pages = ["man1/*", "drivegate.bash", "_drivegate", "drivegate.fish"];
            assert!(
                pages.contains(&name) || script.contains(&format!("\"$stage/{name}\"")),
                "nothing makes {source}"
            );
            continue;
        }
        let path = PathBuf::from(source.trim_end_matches('*'));
        assert!(root().join(&path).exists(), "{source} is missing");
    }
    for script in ["preinst", "postinst", "prerm", "postrm"] {
        let folder = deb()["maintainer-scripts"].as_str().unwrap().to_string();
        assert!(read(Path::new(&folder).join(script)).starts_with("#!/bin/sh\n"));
    }
}

/// The systemd unit uses the paths of program, configuration and page at which the package installs them.
#[test]
fn the_package_puts_files_where_the_unit_looks_for_them() {
    let unit = read("systemd/drivegate.service");
    let places: Vec<String> = assets().into_iter().map(|(_, place)| format!("/{place}")).collect();
    for needed in ["/usr/bin/drivegate", "/etc/drivegate/drivegate.toml"] {
        assert!(unit.contains(needed), "the unit does not name {needed}");
        assert!(places.iter().any(|place| place == needed), "the package lacks {needed}");
    }
    assert!(unit.contains("file:///usr/share/doc/drivegate/installation.md"));
    assert!(
        assets()
            .iter()
            .any(|(source, place)| source == "docs/*" && place == "usr/share/doc/drivegate/"),
        "the pages are elsewhere"
    );
}

#[test]
fn every_script_parses() {
    let folder = root().join("deploy/package");
    let mut scripts = 0;
    for folder in [folder.clone(), folder.join("test"), folder.join("debian")] {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if !path.is_file() {
                continue;
            }
            let shell = match fs::read_to_string(&path).unwrap().lines().next() {
                Some("#!/bin/sh") => "sh",
                Some("#!/bin/bash" | "#!/usr/bin/env bash") => "bash",
                _ => continue,
            };
            run_well(&tool(shell), &["-n", &path.display().to_string()]);
            scripts += 1;
        }
    }
    assert!(scripts > 12, "only {scripts} scripts found");
}

#[test]
fn the_image_says_what_it_is_and_whether_it_is_well() {
    let text = read("deploy/Dockerfile");
    let image = text.rsplit("\nFROM ").next().unwrap();
    for label in ["title", "description", "licenses", "version", "revision", "source"] {
        assert!(image.contains(&format!("org.opencontainers.image.{label}=")), "{label}");
    }
    assert!(image.contains("\nHEALTHCHECK "));
    assert!(image.contains("CMD [\"/drivegate\", \"health\", \"--config\", \"/etc/drivegate/drivegate.toml\"]"));
    // The base image of the build can be given by its digest, and the compiler runs on the builder's own processor.
    assert!(text.contains("\nARG RUST_IMAGE="));
    assert!(text.contains("\nFROM --platform=$BUILDPLATFORM $RUST_IMAGE AS build\n"));
    let compose = read("deploy/compose.yaml");
    assert!(compose.contains("DRIVEGATE_COMMIT: ${DRIVEGATE_COMMIT:-unknown}"));
    let version = format!("VERSION: \"{}\"\n", env!("CARGO_PKG_VERSION"));
    assert!(compose.contains(&version), "{version}");
}

#[test]
fn unit_and_image_keep_memory_in_the_same_way() {
    let unit = read("systemd/drivegate.service");
    let environment = unit.lines().filter_map(|line| line.strip_prefix("Environment="));
    let wanted: Vec<_> = environment.flat_map(str::split_ascii_whitespace).collect();
    assert!(wanted.len() > 1, "{wanted:?}");
    let image = read("deploy/Dockerfile").replace("\\\n", " ");
    let own = image.lines().find_map(|line| line.strip_prefix("ENV ")).unwrap();
    assert_eq!(own.split_ascii_whitespace().collect::<Vec<_>>(), wanted);
}

/// Serial drivers of the unit with a fixed device number, which a container is given: Linux, Documentation/admin-guide/devices.txt,
/// and the sources of the drivers of WCH, Exar and Moxa (mxser).
const MAJORS: [(&str, u32); 14] = [
    ("ttyS", 4),
    ("ttyACM", 166),
    ("ttyCH341USB", 168),
    ("ttyCH9344USB", 168),
    ("ttyCH343USB", 170),
    ("ttyMI", 174),
    ("ttyUSB", 188),
    ("ttyAMA", 204),
    ("ttySC", 204),
    ("ttySAC", 204),
    ("ttyUL", 204),
    ("ttyMAX", 204),
    ("ttymxc", 207),
    ("ttyXRUSB", 266),
];
/// Drivers whose major number is assigned when they are loaded.
const WITHOUT_MAJOR: [&str; 9] = [
    "ttyLP", "ttySTM", "ttyO", "ttyPS", "ttyAML", "ttyTHS", "ttyMSM", "ttyMUE", "ttyMXUSB",
];

#[test]
fn the_container_may_open_the_ports_that_the_service_may() {
    let unit = read("systemd/drivegate.service");
    let compose = read("deploy/compose.yaml");
    for (driver, major) in MAJORS {
        assert!(unit.contains(&format!("\nDeviceAllow=char-{driver} rw\n")), "{driver}");
        assert!(
            compose.contains(&format!("- \"c {major}:* rw\"\n")),
            "{driver}: {major}"
        );
    }
    let allowed = unit
        .lines()
        .filter_map(|line| line.strip_prefix("DeviceAllow=char-tty"));
    for name in allowed.filter_map(|rest| rest.strip_suffix(" rw")) {
        let driver = format!("tty{name}");
        let is_known = MAJORS.iter().any(|(known, _)| *known == driver) || WITHOUT_MAJOR.contains(&driver.as_str());
        assert!(is_known, "does {driver} have a fixed number?");
    }
}
