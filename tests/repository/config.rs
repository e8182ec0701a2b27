//! Configurations with faults against the messages they must give, and every TOML that ships.

use std::fs;
use std::path::{Path, PathBuf};

use drivegate_gateway::config::{Loaded, Settings};
use drivegate_model::drive::Profile;
use drivegate_mqtt::{Password, Secret};

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

fn load(path: &Path) -> Loaded {
    Settings::load(path, std::iter::empty())
}

/// Errors and warnings as the program prints them, without the directory of the project.
fn reported(loaded: &Loaded) -> String {
    let errors = loaded.errors.iter().map(|problem| format!("error: {problem}\n"));
    let warnings = loaded.warnings.iter().map(|problem| format!("warning: {problem}\n"));
    let all: String = errors.chain(warnings).collect();
    all.replace(&format!("{ROOT}/"), "")
}

/// Files of `directory` with this extension.
fn files(directory: &str, extension: &str) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = fs::read_dir(Path::new(ROOT).join(directory))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|e| e == extension))
        .collect();
    files.sort();
    assert!(!files.is_empty());
    files
}

/// Holds each file of `directory` against `NAME.expected`. `BLESS=1` writes the present messages.
fn golden(directory: &str, sound: bool) {
    let mut wrong = Vec::new();
    for path in files(directory, "toml") {
        let loaded = load(&path);
        assert_eq!(loaded.settings.is_some(), sound, "{}", path.display());
        assert_eq!(loaded.errors.is_empty(), sound, "{}", path.display());
        let expected = path.with_extension("expected");
        let reported = reported(&loaded);
        if std::env::var_os("BLESS").is_some() {
            fs::write(&expected, &reported).unwrap();
        }
        let wanted = fs::read_to_string(&expected).unwrap_or_default();
        if reported != wanted {
            wrong.push(format!(
                "{}\n-- reported\n{reported}-- expected\n{wanted}",
                path.display()
            ));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn every_fault_is_told_in_one_run() {
    golden("tests/bad", false);
}

#[test]
fn doubtful_configurations_run_with_warnings() {
    golden("tests/doubtful", true);
}

/// A configuration with two buses on these ports.
fn two_ports(one: &Path, other: &Path) -> String {
    let bus = |name: &str, port: &Path, unit: u8| {
        format!(
            "[[bus]]\nname = \"{name}\"\nport = \"{}\"\ncycle = \"1s\"\n\
             [[bus.drive]]\nname = \"{name}\"\naddress = 1\nunit = {unit}\nprofile = \"vacon-nx\"\n",
            port.display()
        )
    };
    format!(
        "[gateway]\nname = \"g\"\n{}{}[http]\n",
        bus("a", one, 1),
        bus("b", other, 2)
    )
}

#[test]
fn one_device_under_two_names_is_one_port() {
    let dir = tempfile::tempdir().unwrap();
    let (device, by_id) = (dir.path().join("ttyS0"), dir.path().join("usb-adapter"));
    std::os::unix::fs::symlink(&device, &by_id).unwrap();
    let parse = || {
        Settings::parse(
            dir.path().join("t.toml"),
            &two_ports(&device, &by_id),
            std::iter::empty(),
        )
    };
    assert_eq!(reported(&parse()), "", "a link that leads nowhere yet is no fault");
    fs::write(&device, "").unwrap();
    let reported = reported(&parse());
    assert!(
        reported.contains("usb-adapter already belongs to bus `a`, as"),
        "{reported}"
    );
}

#[test]
fn the_password_file_gives_its_line() {
    let dir = tempfile::tempdir().unwrap();
    let parse = |password: &str, env: &[(&str, &str)]| {
        fs::write(dir.path().join("secret"), password).unwrap();
        let source = "[gateway]\nname = \"g\"\n[mqtt]\nusername = \"me\"\npassword_file = \"secret\"\n";
        let env: Vec<_> = env.iter().map(|(k, v)| (k.to_string(), v.to_string())).collect();
        Settings::parse(dir.path().join("t.toml"), source, env.into_iter())
    };
    let password = |loaded: Loaded| loaded.settings.unwrap().mqtt.unwrap().password.unwrap();
    // The file is read for each connection.
    assert_eq!(
        password(parse("open sesame\n", &[])),
        Password::File(dir.path().join("secret"))
    );
    let env = [("DRIVEGATE__MQTT__PASSWORD", "12345")];
    assert_eq!(
        password(parse("open sesame", &env)),
        Password::Fixed(Secret("12345".to_string())),
        "the environment overrides the file"
    );
    for bad in ["", "\n", "two\nlines\n"] {
        let reported = reported(&parse(bad, &[]));
        assert!(
            reported.starts_with("error: ") && reported.contains("t.toml:5, mqtt.password_file"),
            "{bad:?}: {reported}"
        );
    }
}

/// All files that belong to the project.
fn project_files() -> Vec<PathBuf> {
    let mut files = Vec::new();
    let mut directories = vec![PathBuf::from(ROOT)];
    while let Some(directory) = directories.pop() {
        for entry in fs::read_dir(&directory).unwrap() {
            let entry = entry.unwrap();
            let name = entry.file_name().to_string_lossy().into_owned();
            let kind = entry.file_type().unwrap();
            if kind.is_dir() && !name.starts_with('.') && name != "target" && name != "tests" {
                directories.push(entry.path());
            } else if kind.is_file() {
                files.push(entry.path());
            }
        }
    }
    files.sort();
    files
}

fn ends_with(path: &Path, extension: &str) -> bool {
    path.extension().is_some_and(|e| e == extension)
}

/// The TOML blocks of a document.
fn fenced(text: &str) -> Vec<String> {
    let mut blocks = Vec::new();
    let mut block: Option<String> = None;
    for line in text.lines() {
        match (&mut block, line.trim()) {
            (None, "```toml") => block = Some(String::new()),
            (Some(_), "```") => blocks.extend(block.take()),
            (Some(block), _) => *block += &format!("{line}\n"),
            (None, _) => {}
        }
    }
    blocks
}

/// Errors to fix in a shipped configuration. Secrets, certificates and profile directories exist only on the
/// machine it is made for.
fn faults(path: &Path, source: &str) -> Vec<String> {
    let elsewhere = [
        ".password_file",
        ".ca",
        ".certificate",
        ".key",
        ".users_file",
        ".profile_dirs",
    ];
    Settings::parse(path, source, std::iter::empty())
        .errors
        .iter()
        .filter(|p| !(p.finding.what.starts_with("cannot read ") && elsewhere.iter().any(|key| p.key.ends_with(key))))
        .map(ToString::to_string)
        .collect()
}

#[test]
fn every_configuration_that_ships_is_sound() {
    let mut found = Vec::new();
    for path in project_files() {
        if ends_with(&path, "toml") {
            let source = fs::read_to_string(&path).unwrap();
            if source.contains("[gateway]") {
                found.extend(faults(&path, &source));
            }
        } else if ends_with(&path, "md") {
            let text = fs::read_to_string(&path).unwrap();
            let configurations = fenced(&text).into_iter().filter(|block| block.contains("[gateway]"));
            found.extend(configurations.flat_map(|block| faults(&path, &block)));
        }
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn every_profile_that_ships_is_sound() {
    let mut count = 0;
    for path in files("profiles", "toml") {
        let source = fs::read_to_string(&path).unwrap();
        let profile = Profile::parse(&path.display().to_string(), &source, true).unwrap();
        assert_eq!(
            Some(profile.name.as_str()),
            path.file_stem().and_then(|stem| stem.to_str())
        );
        count += 1;
    }
    assert_eq!(
        count,
        drivegate_model::drive::profile::Profiles::built_in().iter().count(),
        "all are embedded"
    );
}

#[test]
fn fences_are_found() {
    let text = "a\n```toml\n[gateway]\nname = 1\n```\n```sh\nx\n```\n  ```toml\nb = 1\n  ```\n";
    assert_eq!(fenced(text), ["[gateway]\nname = 1\n", "b = 1\n"]);
    assert_eq!(faults(Path::new("x.md"), "[gateway]\nnmae = \"x\"\n").len(), 2);
}
