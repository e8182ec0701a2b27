//! Tests of the program itself: exit codes, output, help.

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::support::process::PATIENCE;
use crate::support::tools::{python, run_well};

const BINARY: &str = env!("CARGO_BIN_EXE_drivegate");
const ROOT: &str = env!("CARGO_MANIFEST_DIR");

/// Two drives at 38400 8N1 with 0.5 ms turnaround.
const SOUND: &str = r#"
[gateway]
name = "pump-house"
[[bus]]
name = "line1"
port = "/dev/ttyUSB9"
baud = 38400
cycle = "50ms"
silence = "chars"
[[bus.drive]]
name = "pump-1"
address = 1
profile = "vacon-nx"
turnaround = "0.5ms"
[[bus.drive]]
name = "pump-2"
address = 2
profile = "vacon-nx"
turnaround = "0.5ms"
[modbus_tcp]
"#;

fn drivegate(args: &[&str]) -> Command {
    let mut command = Command::new(BINARY);
    command.args(args).current_dir(ROOT).env_remove("COLUMNS");
    command
}

struct Ran {
    code: Option<i32>,
    out: String,
    err: String,
}

fn ran(command: &mut Command) -> Ran {
    let Output { status, stdout, stderr } = command.output().unwrap();
    Ran {
        code: status.code(),
        out: String::from_utf8(stdout).unwrap(),
        err: String::from_utf8(stderr).unwrap(),
    }
}

fn run(args: &[&str]) -> Ran {
    ran(&mut drivegate(args))
}

/// A directory with `SOUND` as `drivegate.toml`.
fn sound() -> (tempfile::TempDir, String) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("drivegate.toml");
    fs::write(&path, SOUND).unwrap();
    (dir, path.display().to_string())
}

#[test]
fn exit_codes() {
    let (_dir, path) = sound();
    for (args, code) in [
        (vec!["check", "--config", &path], 0),
        (vec!["check", "--config", "tests/doubtful/empty.toml"], 0),
        (vec!["check", "--config", "tests/bad/twice.toml"], 78),
        (vec!["check", "--config", "tests/bad/no-such.toml"], 78),
        (vec!["check", "--json", "--config", "tests/bad/no-such.toml"], 78),
        (vec!["check", "--konfig", &path], 2),
        (vec!["profiles"], 0),
        (vec!["profiles", "show", "vacon-nx"], 0),
        (vec!["profiles", "show", "vacon"], 2),
        (vec!["profiles", "--config", "tests/bad/twice.toml"], 78),
        (vec!["profiles", "--profile-dir", "tests/bad/broken-profiles"], 78),
        (vec!["profiles", "--profile-dir", "tests/bad/no-such"], 78),
        (vec!["map", "--config", &path], 0),
        (vec!["map", "--config", "tests/bad/twice.toml"], 78),
        (vec!["inventory", &path], 0),
        (vec!["inventory", "tests/bad/twice.toml"], 78),
        (vec!["schema"], 0),
        (vec!["--version"], 0),
        (vec!["--help"], 0),
        (vec!["fly"], 2),
        (vec![], 2),
    ] {
        let ran = run(&args);
        assert_eq!(ran.code, Some(code), "{args:?}\n{}{}", ran.out, ran.err);
        let silent = code != 0 && !args.contains(&"--json");
        assert_eq!(ran.out.is_empty(), silent, "{args:?} on stdout");
    }
}

#[test]
fn errors_and_warnings_go_to_stderr_in_the_form_of_the_contract() {
    let bad = run(&["check", "--config", "tests/bad/twice.toml"]);
    let expected = fs::read_to_string(Path::new(ROOT).join("tests/bad/twice.expected")).unwrap();
    let (mut reported, mut wanted): (Vec<_>, Vec<_>) = (bad.err.lines().collect(), expected.lines().collect());
    reported.sort_unstable();
    wanted.sort_unstable();
    assert_eq!(reported, wanted);
    let nothing = run(&["check", "--config", "tests/bad/no-such.toml"]);
    assert_eq!(
        nothing.err,
        "error: cannot read the file: No such file or directory (os error 2); tests/bad/no-such.toml; check the path and its permissions\n"
    );
    let unknown = run(&["profiles", "show", "vacon-xn"]);
    assert_eq!(
        unknown.err,
        format!(
            "error: unknown profile `vacon-xn`; command line, NAME; did you mean `vacon-nx`? known profiles: {}\n",
            drivegate_model::drive::profile::Profiles::built_in()
                .names()
                .collect::<Vec<_>>()
                .join(", ")
        )
    );
    let (_dir, path) = sound();
    assert_eq!(run(&["check", "--config", &path]).err, "");
}

#[test]
fn a_file_that_is_no_text_is_told_as_such() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("plant.toml");
    let path = file.to_str().unwrap();
    let wanted = |byte: &str, line: usize, column: usize| {
        format!(
            "error: the file is not text: byte 0x{byte} at line {line}, column {column}; {path}:{line}; \
             save it as UTF-8 text, or name the intended file\n"
        )
    };
    fs::write(&file, b"[gateway]\nname = \"a\" # 20 \xB0C\n").unwrap();
    for command in ["check", "run"] {
        let latin = run(&[command, "--config", path]);
        assert_eq!((latin.code, latin.err), (Some(78), wanted("B0", 2, 17)), "{command}");
    }
    fs::copy(BINARY, &file).unwrap();
    let program = run(&["check", "--config", path]);
    assert_eq!((program.code, program.err), (Some(78), wanted("00", 1, 8)));
}

fn keys(value: &Value) -> Vec<&str> {
    value.as_object().unwrap().keys().map(String::as_str).collect()
}

fn json(ran: &Ran) -> Value {
    assert_eq!(ran.err, "", "nothing beside the report");
    serde_json::from_str(&ran.out).unwrap()
}

#[test]
fn the_report_of_a_sound_configuration() {
    let (_dir, path) = sound();
    let report = json(&run(&["check", "--json", "--config", &path]));
    assert_eq!(keys(&report), ["buses", "errors", "memory_bytes", "ok", "warnings"]);
    assert_eq!(
        (&report["ok"], &report["errors"], &report["warnings"]),
        (&true.into(), &Value::Array(vec![]), &Value::Array(vec![]))
    );
    let memory = report["memory_bytes"].as_u64().unwrap();
    let past: u64 = ["recorder_bytes", "trend_bytes"]
        .iter()
        .map(|key| report["buses"][0][key].as_u64().unwrap())
        .sum();
    assert!((past..64 << 20).contains(&memory), "{memory}");
    let bus = &report["buses"][0];
    assert_eq!(
        keys(bus),
        [
            "fast_cycle_ms",
            "load_ratio",
            "name",
            "raw_writes_refused",
            "recorder_bytes",
            "requests",
            "shutdown_ms",
            "shutdown_worst_ms",
            "slow_cycle_ms",
            "trend_bytes"
        ]
    );
    assert_eq!(
        (&bus["name"], &bus["fast_cycle_ms"], &bus["slow_cycle_ms"]),
        (&"line1".into(), &50.0.into(), &1000.0.into())
    );
    let requests = bus["requests"].as_array().unwrap();
    let first = &requests[0];
    assert_eq!(
        keys(first),
        ["address", "class", "count", "drive", "function", "wire_ms"]
    );
    assert_eq!((&first["drive"], &first["class"]), (&"pump-1".into(), &"fast".into()));
    assert_eq!(
        (&first["function"], &first["address"], &first["count"]),
        (&3.into(), &2100.into(), &11.into())
    );
    // Request of 8 characters, 3.5 of silence that mark its end, turnaround, reply of 27, silence of 3.5; 10 bits a
    // character.
    let wire = (8.0 + 3.5 + 27.0 + 3.5) * 10.0 / 38.4 + 0.5;
    assert!((first["wire_ms"].as_f64().unwrap() - wire).abs() < 1e-4, "{first}");
    let share = |class: &str, cycle: f64| {
        let wires = requests
            .iter()
            .filter(|r| r["class"] == class)
            .map(|r| r["wire_ms"].as_f64().unwrap());
        wires.sum::<f64>() / cycle
    };
    let load = share("fast", 50.0) + share("slow", 1000.0);
    assert!((bus["load_ratio"].as_f64().unwrap() - load).abs() < 1e-6, "{bus}");
    assert_eq!(
        requests.iter().filter(|r| r["drive"] == "pump-2").count(),
        requests.len() / 2
    );
}

#[test]
fn what_raw_writes_may_not_set_is_listed() {
    let drive = |name: &str, address: u8, keys: &str| {
        format!("[[bus.drive]]\nname = \"{name}\"\naddress = {address}\nprofile = \"vacon-nx\"\n{keys}\n")
    };
    let control = "access = \"control\"\nsupervision = { timeout = \"5s\" }\n";
    let text = "[gateway]\nname = \"raw\"\n[modbus_tcp]\nwrite = [\"127.0.0.1/32\"]\n[[bus]]\nname = \"line1\"\nport = \"/dev/null\"\ncycle = \"1s\"\nslow_cycle = \"10s\"\n"
        .to_string()
        + &drive("closed-1", 1, control)
        + &drive("closed-2", 2, control)
        + &drive("partly", 3, &format!("{control}raw_writes = [[100, 731], [2001, 2001]]"))
        + &drive("open", 4, &format!("{control}raw_writes = true"))
        + &drive("monitored", 5, "");
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("raw.toml");
    fs::write(&path, text).unwrap();
    let path = path.display().to_string();
    let checked = run(&["check", "--config", &path]);
    assert_eq!(checked.code, Some(0), "{}", checked.err);
    let listed: Vec<&str> = checked.out.lines().filter(|line| line.contains("raw writes")).collect();
    let wanted = [
        "  raw writes  closed-1, closed-2: refused for holding 100 to 731, 734 to 1998, 2001 (see `raw_writes`)",
        "  raw writes  partly: refused for holding 734 to 1998 (see `raw_writes`)",
    ];
    assert_eq!(listed, wanted);
    let report = json(&run(&["check", "--json", "--config", &path]));
    let refused = report["buses"][0]["raw_writes_refused"].as_array().unwrap();
    assert_eq!(refused.len(), 3 + 3 + 1);
    let last = serde_json::json!({ "drive": "partly", "table": "holding", "first": 734, "last": 1998 });
    assert_eq!(refused[6], last);
    let map = run(&["map", "--csv", "--config", &path]).out;
    let access = |unit: u8, address: u16| {
        let row = map.lines().find(|row| {
            let is_raw = row.contains(&format!(",raw,\"holding, input\",{address},"));
            is_raw && row.starts_with(&format!("{unit},"))
        });
        row.unwrap().contains("\"read, write\"")
    };
    // Expected points: control word, general control word, minimum frequency, response to a silent master.
    assert_eq!(
        [2000, 2001, 100, 732].map(|at| access(1, at)),
        [true, false, false, true]
    );
    assert_eq!([2000, 2001, 100, 732].map(|at| access(3, at)), [true, true, true, true]);
    assert_eq!([2000, 2001, 100, 732].map(|at| access(5, at)), [false; 4]);
    assert!(
        map.contains("written raw only in one request with the control word"),
        "{map}"
    );
}

#[test]
fn the_reports_of_bad_configurations() {
    let mut seen = 0;
    for entry in fs::read_dir(Path::new(ROOT).join("tests/bad")).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|e| e != "toml") {
            continue;
        }
        let ran = run(&["check", "--json", "--config", path.to_str().unwrap()]);
        let report = json(&ran);
        assert_eq!(
            (ran.code, &report["ok"], &report["buses"]),
            (Some(78), &false.into(), &Value::Array(vec![]))
        );
        let expected = fs::read_to_string(path.with_extension("expected")).unwrap();
        let lines = |kind: &str| expected.lines().filter(|line| line.starts_with(kind)).count();
        for (list, kind) in [("errors", "error: "), ("warnings", "warning: ")] {
            let problems = report[list].as_array().unwrap();
            assert_eq!(problems.len(), lines(kind), "{}", path.display());
            assert!(problems.iter().all(|p| keys(p) == ["file", "key", "line", "message"]));
        }
        seen += 1;
    }
    assert!(seen > 10);
}

#[test]
fn the_journal_gets_the_priority_of_each_report() {
    let folder = tempfile::tempdir().unwrap();
    let (config, printed) = (folder.path().join("drivegate.toml"), folder.path().join("printed"));
    fs::write(&config, "[gatway]\n").unwrap();
    let stderr = fs::File::create(&printed).unwrap();
    let metadata = stderr.metadata().unwrap();
    let status = Command::new(BINARY)
        .args(["run", "--config", config.to_str().unwrap()])
        .env("JOURNAL_STREAM", format!("{}:{}", metadata.dev(), metadata.ino()))
        .stderr(stderr)
        .status();
    assert_eq!(status.unwrap().code(), Some(78));
    let text = fs::read_to_string(&printed).unwrap();
    let starts: BTreeSet<&str> = text.lines().filter_map(|line| line.split(' ').next()).collect();
    assert_eq!(starts, ["<3>error:", "<4>warning:"].into(), "{text}");
}

#[test]
fn the_tables_name_every_request() {
    let (_dir, path) = sound();
    let ran = run(&["check", "--config", &path]);
    let wanted = [
        "Bus line1: /dev/ttyUSB9 (not present), modbus-rtu, 38400 8N1, silence 0.91 ms",
        " pump-1  fast   03 read holding     2100     11    11.44",
        " pump-2  slow   03 read holding      100      2",
        " pump-2  once   03 read holding      102      2",
        "  fast cycle  50.0 ms (target 50.0 ms)",
        "  line load   ",
        "drivegate.toml: ok, 1 bus, 2 drives, no warnings",
    ];
    for wanted in wanted {
        assert!(ran.out.contains(wanted), "{wanted}\nis not in\n{}", ran.out);
    }
}

#[test]
fn what_home_assistant_is_told_is_announced() {
    let (_dir, path) = sound();
    assert!(!run(&["check", "--config", &path]).out.contains("Home Assistant"));
    let source = fs::read_to_string(&path).unwrap() + "\n[mqtt.home_assistant]\n";
    fs::write(&path, source).unwrap();
    let told = "Home Assistant: 2 drives announced below homeassistant/device\n";
    let ran = run(&["check", "--config", &path]);
    assert!(ran.out.contains(told), "{}", ran.out);
}

#[test]
fn stops_at_shutdown_are_told_with_their_time() {
    let (_dir, path) = sound();
    assert!(
        !run(&["check", "--config", &path]).out.contains("shutdown"),
        "no drive is stopped"
    );
    let path = "tests/doubtful/shutdown.toml";
    let ran = run(&["check", "--config", path]);
    let wanted = "  shutdown    3 drives stopped in 0.28 s, 112.26 s if none replies\n";
    assert!(ran.out.contains(wanted), "{}", ran.out);
    let bus = &json(&run(&["check", "--json", "--config", path]))["buses"][0];
    let seconds = |key: &str| bus[key].as_f64().unwrap() / 1e3;
    assert!((seconds("shutdown_ms") - 0.277).abs() < 0.01, "{bus}");
    assert!((seconds("shutdown_worst_ms") - 112.26).abs() < 0.01, "{bus}");
}

#[test]
fn the_environment_overrides_the_file() {
    let (_dir, path) = sound();
    let args = ["check", "--config", &path, "--json"];
    let report = json(&ran(drivegate(&args).env("DRIVEGATE__BUS__0__CYCLE", "20ms")));
    assert_eq!(report["warnings"][0]["key"], "bus[0].cycle");
    assert_eq!(report["warnings"][0]["file"], "DRIVEGATE__BUS__0__CYCLE");
    let bad = ran(drivegate(&["check", "--config", &path]).env("DRIVEGATE__BUS__0__CYCLE", "soon"));
    assert_eq!(bad.code, Some(78));
    assert!(
        bad.err.contains("; DRIVEGATE__BUS__0__CYCLE, bus[0].cycle; "),
        "{}",
        bad.err
    );
    let bytes: &std::ffi::OsStr = std::os::unix::ffi::OsStrExt::from_bytes(b"\xff");
    let bad = ran(drivegate(&["check", "--config", &path]).env("DRIVEGATE__MQTT__PASSWORD", bytes));
    assert_eq!(
        (bad.code, bad.err.as_str()),
        (
            Some(78),
            "error: the variable is not UTF-8 text; DRIVEGATE__MQTT__PASSWORD; set it again\n"
        )
    );
}

#[test]
fn profiles_are_listed_and_shown() {
    let all = run(&["profiles", "--profile-dir", "tests/bad/profiles"]).out;
    assert!(all.contains("vacon-nx") && all.contains("built in"), "{all}");
    assert!(all.contains("small") && all.contains("your own"), "{all}");
    let (dir, path) = sound();
    fs::write(
        &path,
        SOUND.replace("[gateway]", "[gateway]\nprofile_dirs = [\"families\"]"),
    )
    .unwrap();
    fs::create_dir(dir.path().join("families")).unwrap();
    fs::copy(
        Path::new(ROOT).join("tests/bad/profiles/small.toml"),
        dir.path().join("families/small.toml"),
    )
    .unwrap();
    let small = run(&["profiles", "show", "small", "--config", &path]).out;
    assert!(
        small.contains("set_point  holding 1  u16   0.1    bar   slow   read, write         yes"),
        "{small}"
    );

    let shown = run(&["profiles", "show", "vacon-nx"]).out;
    let line = |name: &str| {
        shown
            .lines()
            .find(|line| line.starts_with(&format!(" {name} ")))
            .unwrap()
            .to_string()
    };
    assert!(line("heatsink_temperature").contains("not verified"));
    assert!(!line("motor_current").contains("not verified"));
    assert!(line("speed_reference").contains("-100 to 100") && line("speed_reference").contains("0.01"));
    assert!(line("fault_reset").contains("read, pulse"));
    assert!(line("ready").contains("holding 2100.0"));
    assert!(line("53").contains("fieldbus fault") && line("53").contains("yes"));
    assert!(line("1").contains("overcurrent") && line("1").contains("not verified"));
    assert!(shown.contains("source        [V]"));
}

#[test]
fn the_map_names_every_unit() {
    let (_dir, path) = sound();
    let text = run(&["map", "--config", &path]).out;
    assert!(
        text.contains("Modbus TCP register map of pump-house") && text.contains("units 1, 2"),
        "{text}"
    );
    let csv = run(&["map", "--config", &path, "--csv"]).out;
    assert!(
        csv.starts_with("unit,drive,") && csv.contains("\n2,pump-2,common,"),
        "{csv}"
    );
}

#[test]
fn the_schema_is_json() {
    let schema: Value = serde_json::from_str(&run(&["schema"]).out).unwrap();
    assert_eq!(schema["$schema"], "https://json-schema.org/draft/2020-12/schema");
    assert_eq!(
        schema["properties"]["bus"]["items"]["properties"]["baud"]["default"],
        9600
    );
}

/// Output of `check --json` for the file, without the name of the file.
fn checked(path: &Path) -> String {
    let path = path.display().to_string();
    run(&["check", "--json", "--config", &path]).out.replace(&path, "FILE")
}

/// The configuration in an inventory as PyYAML reads it, and the host of the inventory.
fn from_inventory(inventory: &Path) -> (String, toml::Table) {
    let script = "import json, sys, yaml\n(host, variables), = yaml.safe_load(open(sys.argv[1]))['drivegate']['hosts'].items()\n\
        print(json.dumps([host, variables['drivegate_configuration']]))";
    let printed = run_well(&python(), &["-c", script, &inventory.display().to_string()]);
    serde_json::from_str(&printed).unwrap()
}

#[test]
fn an_inventory_is_the_configuration_again() {
    let dir = tempfile::tempdir().unwrap();
    let inventory = dir.path().join("inventory.yml");
    let again = dir.path().join("drivegate.toml");
    fs::write(dir.path().join("password"), "x").unwrap();
    let odd = format!(
        "{SOUND}[mqtt]\nusername = \"no \\\"\\\\ \u{e4}: #\"\nclient_id = \"12:30\"\npassword_file = \"password\"\nhome_assistant = false\n"
    )
    .replace(
        "turnaround = \"0.5ms\"\n[[",
        "access = \"control\"\nlimits = { speed_reference = [2.5, 1e2] }\n[[",
    );
    let shipped = [
        "deploy/drivegate.toml",
        "tests/doubtful/lease.toml",
        "tests/doubtful/slots.toml",
    ];
    let read = |path| fs::read_to_string(Path::new(ROOT).join(path)).unwrap();
    for source in shipped.map(read).into_iter().chain([odd]) {
        fs::write(&again, &source).unwrap();
        let (path, before) = (again.display().to_string(), checked(&again));
        let made = run(&["inventory", &path]);
        assert_eq!(made.code, Some(0), "{}", made.err);
        fs::write(&inventory, &made.out).unwrap();
        let (host, configuration) = from_inventory(&inventory);
        let written: toml::Table = source.parse().unwrap();
        assert_eq!(
            (host.as_str(), &configuration),
            (written["gateway"]["name"].as_str().unwrap(), &written)
        );
        fs::write(&again, toml::to_string(&configuration).unwrap()).unwrap();
        // Warnings name lines, which are others now.
        let ok = |report: &str| {
            let mut report: Value = serde_json::from_str(report).unwrap();
            for warning in report["warnings"].as_array_mut().unwrap() {
                warning.as_object_mut().unwrap().remove("line");
            }
            report
        };
        assert_eq!(ok(&checked(&again)), ok(&before));
    }
}

#[test]
fn an_inventory_has_no_secrets() {
    let (_dir, path) = sound();
    fs::write(
        &path,
        format!("{SOUND}[mqtt]\nusername = \"u\"\npassword = \"hush-hush\"\n"),
    )
    .unwrap();
    let ran = run(&["inventory", "--config", &path]);
    assert_eq!((ran.code, ran.out.as_str()), (Some(78), ""));
    assert!(
        ran.err.contains("mqtt.password") && ran.err.contains("password_file"),
        "{}",
        ran.err
    );
    assert!(!ran.err.contains("hush-hush"), "{}", ran.err);
}

/// The commands that a help text lists.
fn commands(help: &str) -> Vec<String> {
    let list = help.lines().skip_while(|line| *line != "Commands:").skip(1);
    list.take_while(|line| !line.is_empty())
        .filter_map(|line| line.strip_prefix("  ").filter(|l| !l.starts_with(' ')))
        .filter_map(|line| line.split_whitespace().next().map(str::to_string))
        .filter(|name| name != "help")
        .collect()
}

#[test]
fn every_help_text_has_an_example() {
    let mut seen = 0;
    let mut paths: Vec<Vec<String>> = vec![vec![]];
    while let Some(path) = paths.pop() {
        let mut args: Vec<&str> = path.iter().map(String::as_str).collect();
        args.push("--help");
        let ran = run(&args);
        assert_eq!(ran.code, Some(0));
        let example = format!("  drivegate {}", path.join(" "));
        let after = ran.out.split_once("Example").map_or("", |(_, after)| after);
        assert!(
            after.contains(example.trim_end()),
            "no example in the help of {path:?}:\n{}",
            ran.out
        );
        paths.extend(
            commands(&ran.out)
                .into_iter()
                .map(|name| [path.clone(), vec![name]].concat()),
        );
        seen += 1;
    }
    assert!(seen >= 5, "{seen}");
}

#[test]
fn a_closed_pipe_ends_the_output_quietly() {
    let (_dir, path) = sound();
    for args in [
        vec!["check", "--config", &path],
        vec!["check", "--config", &path, "--json"],
        vec!["profiles", "show", "vacon-nx"],
        vec!["profiles"],
        vec!["map", "--config", &path],
        vec!["schema"],
        vec!["--help"],
    ] {
        let (reader, writer) = io::pipe().unwrap();
        drop(reader);
        let Output { status, stderr, .. } = drivegate(&args).stdout(writer).output().unwrap();
        assert_eq!((status.code(), stderr.as_slice()), (Some(0), &b""[..]), "{args:?}");
    }
    // Not even errors can be printed, so only the exit code reports the failure.
    let (reader, writer) = io::pipe().unwrap();
    drop(reader);
    let bad = drivegate(&["check", "--config", "tests/bad/twice.toml"])
        .stderr(writer)
        .output()
        .unwrap();
    assert_eq!(bad.status.code(), Some(78));
}

#[test]
fn a_bad_log_level_of_the_demo_is_a_wrong_command_line() {
    for (level, wanted) in [
        (
            "verbose",
            "unknown word `verbose`; write \"off\", \"error\", \"warn\", \"info\", \"debug\" or \"trace\"",
        ),
        ("nonsense=1", "unknown word `1`; write \"off\", \"error\""),
        ("inof", "did you mean \"info\"?"),
    ] {
        // A demo that was started by mistake would never end by itself.
        let mut child = drivegate(&["demo", "--log", level])
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let began = Instant::now();
        while child.try_wait().unwrap().is_none() && began.elapsed() < PATIENCE {
            std::thread::sleep(Duration::from_millis(20));
        }
        let _ = child.kill();
        let Output { status, stderr, .. } = child.wait_with_output().unwrap();
        let reported = String::from_utf8(stderr).unwrap();
        assert_eq!(status.code(), Some(2), "{level}: {reported}");
        assert!(reported.contains(wanted), "{level}: {reported}");
    }
}

#[test]
fn what_is_wrong_on_a_command_line_is_told_in_its_own_words() {
    for (args, wanted) in [
        (
            &["scan", "--port", "tcp://foo"][..],
            "`tcp://foo` is not the address of a device server; write \"tcp://host:port\"",
        ),
        (
            &["scan", "--port", "/dev/x", "--timeout", "5"],
            "`5` is not a duration; write a number with its unit, such as 10ms, 1.5s or 2min",
        ),
        (
            &["simulate", "--turnaround", "5"],
            "`5` is not a duration; write a number with its unit, such as 10ms, 1.5s or 2min",
        ),
        (
            &["simulate", "--listen", "foo"],
            "`foo` is not an address to listen on; write host:port, such as 127.0.0.1:4001",
        ),
        (
            &["simulate", "--addresses", "250"],
            "`vacon-nx` has no address 250; in --addresses; its drives have 1 to 247",
        ),
    ] {
        let ran = run(args);
        assert_eq!(ran.code, Some(2), "{args:?}: {}", ran.err);
        assert!(ran.err.contains(wanted), "{args:?}: {}", ran.err);
    }
}

#[test]
fn a_simulation_tells_the_bus_whose_port_it_cannot_be() {
    let (dir, path) = sound();
    let occupied = dir.path().join("line1");
    fs::write(&occupied, "").unwrap();
    fs::write(&path, SOUND.replace("/dev/ttyUSB9", occupied.to_str().unwrap())).unwrap();
    let ran = run(&["simulate", "--config", &path]);
    assert_eq!(ran.code, Some(1), "{}", ran.err);
    let wanted = format!(
        "error: cannot simulate bus `line1` at its `port` in {path}: {} exists and is not a symbolic link to a pseudo-terminal; ",
        occupied.display()
    );
    assert!(ran.err.contains(&wanted), "{}", ran.err);
    assert!(occupied.exists());
}
