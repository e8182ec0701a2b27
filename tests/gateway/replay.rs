//! `drivegate replay` with the captures of `tests/captures`, each `NAME.pcap` or `NAME.pcapng` with `NAME.toml`, and with files that
//! are none.

use std::fs;
use std::path::{Path, PathBuf};

use crate::support::process::drivegate;
use crate::support::tools::root;

fn captures() -> Vec<PathBuf> {
    let files = fs::read_dir(root().join("tests/captures")).unwrap();
    let files = files.map(|entry| entry.unwrap().path());
    let is_capture = |path: &PathBuf| {
        let extension = path.extension().and_then(|extension| extension.to_str());
        extension.is_some_and(|extension| ["pcap", "pcapng"].contains(&extension))
    };
    let mut files: Vec<PathBuf> = files.filter(is_capture).collect();
    files.sort();
    files
}

/// Exit code of the replay, and its output on standard output and standard error.
fn replay(capture: &Path, config: &Path) -> (Option<i32>, String, String) {
    let arguments = [
        "replay",
        capture.to_str().unwrap(),
        "--config",
        config.to_str().unwrap(),
    ];
    let output = drivegate(&arguments).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

/// Value and quality of a point in the table of a replay.
fn shown(printed: &str, point: &str) -> Option<(String, String)> {
    let rows = printed.lines().map(|line| line.split_whitespace().collect::<Vec<_>>());
    rows.filter_map(|row| match row.as_slice() {
        ["drive", name, value, .., quality] if *name == point => Some((value.to_string(), quality.to_string())),
        _ => None,
    })
    .next()
}

/// The worked frames of the manuals with their meaning in the words of the manuals.
const WORKED: [(&str, &[(&str, &str)]); 4] = [
    (
        "nx.pcapng",
        &[
            ("running", "true"),
            ("output_frequency", "25"),
            ("motor_speed", "750"),
            ("motor_current", "1.2"),
            ("dc_link_voltage", "560"),
        ],
    ),
    (
        "cx.pcap",
        &[("running", "true"), ("motor_current", "15.6"), ("fault_code", "1")],
    ),
    ("teco-ascii.pcapng", &[("running", "true"), ("ready", "true")]),
    (
        "n2.pcap",
        &[("running", "true"), ("output_frequency", "60"), ("fault_code", "53")],
    ),
];

#[test]
fn the_worked_frames_show_what_the_manuals_say() {
    for (name, points) in WORKED {
        let capture = root().join("tests/captures").join(name);
        let (code, printed, complaints) = replay(&capture, &capture.with_extension("toml"));
        assert_eq!((code, complaints.as_str()), (Some(0), ""), "{name}");
        for (point, wanted) in points {
            let (value, quality) = shown(&printed, point).unwrap_or_else(|| panic!("{name} {point}: {printed}"));
            let same = value == *wanted || value.parse::<f64>().ok() == wanted.parse().ok();
            assert!(
                same && quality == "good",
                "{name} {point}: {value} {quality}\n{printed}"
            );
        }
        for told in [
            "online: drive drive is online",
            "foreign_command: the other master commands drive",
        ] {
            assert!(printed.contains(told), "{name}: {printed}");
        }
    }
}

#[test]
fn every_capture_is_played() {
    let captures = captures();
    assert!(captures.len() >= WORKED.len(), "{captures:?}");
    for capture in captures {
        let (code, printed, complaints) = replay(&capture, &capture.with_extension("toml"));
        assert_eq!((code, complaints.as_str()), (Some(0), ""), "{}", capture.display());
        assert!(printed.contains(" answered, "), "{}: {printed}", capture.display());
    }
}

#[test]
fn what_is_no_capture_is_refused_with_its_place() {
    let folder = tempfile::tempdir().unwrap();
    let config = root().join("tests/captures/nx.toml");
    let whole = fs::read(root().join("tests/captures/nx.pcapng")).unwrap();
    let mut torn = whole.clone();
    torn[4] = 0xFF;
    for (name, bytes, code, wanted) in [
        ("torn", &torn[..], 65, "at byte 4"),
        (
            "foreign",
            b"id,time\n1,2\n",
            65,
            "is neither pcap nor pcapng, at byte 0",
        ),
    ] {
        let path = folder.path().join(name);
        fs::write(&path, bytes).unwrap();
        let (exit, printed, complaints) = replay(&path, &config);
        assert_eq!((exit, printed.as_str()), (Some(code), ""), "{name}: {complaints}");
        assert!(complaints.contains(wanted), "{name}: {complaints}");
    }
    // A capture that was cut off is read up to the cut.
    let path = folder.path().join("cut");
    fs::write(&path, &whole[..whole.len() - 10]).unwrap();
    let (exit, printed, complaints) = replay(&path, &config);
    assert!(
        exit == Some(0) && printed.contains(" answered, "),
        "{printed}{complaints}"
    );
    assert!(
        complaints.starts_with("warning: ") && complaints.contains("ends in the middle of a block, at byte"),
        "{complaints}"
    );
    let (exit, _, complaints) = replay(&folder.path().join("absent"), &config);
    assert_eq!(exit, Some(1), "{complaints}");
}
