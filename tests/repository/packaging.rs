//! Files that ship with the binary: service unit, image, compose file, dashboard, alert rules.

use std::collections::BTreeSet;
use std::fs;
use std::net::TcpStream;
use std::process::Command;

use crate::support::process::{Running, until};
use crate::support::site::Site;
use crate::support::tools::{python, root, run_well, tool};
use serde_json::Value;
use tempfile::TempDir;

/// The metrics of the public contract, on whose names dashboards and alerts of users depend.
const METRICS: [&str; 53] = [
    "drivegate_listener_up",
    "drivegate_parameters_changed_total",
    "drivegate_drive_starts_total",
    "drivegate_drive_running_seconds_total",
    "drivegate_line_diagnosis",
    "drivegate_slot_requests_total",
    "drivegate_drive_blocked",
    "drivegate_drive_fault_info",
    "drivegate_drive_unsupervised",
    "drivegate_mqtt_configured",
    "drivegate_recordings_total",
    "drivegate_supervision_actions_total",
    "drivegate_supervision_failed_total",
    "drivegate_drive_up",
    "drivegate_drive_state",
    "drivegate_drive_sample_age_seconds",
    "drivegate_drive_output_frequency_hertz",
    "drivegate_drive_motor_speed_rpm",
    "drivegate_drive_motor_current_amperes",
    "drivegate_drive_motor_torque_percent",
    "drivegate_drive_motor_power_percent",
    "drivegate_drive_motor_voltage_volts",
    "drivegate_drive_dc_link_voltage_volts",
    "drivegate_drive_heatsink_temperature_celsius",
    "drivegate_drive_energy_kilowatthours",
    "drivegate_drive_operating_hours",
    "drivegate_drive_fault_code",
    "drivegate_drive_ready",
    "drivegate_drive_running",
    "drivegate_drive_reversed",
    "drivegate_drive_fault",
    "drivegate_drive_warning",
    "drivegate_drive_at_reference",
    "drivegate_drive_speed_reference_percent",
    "drivegate_drive_actual_speed_percent",
    "drivegate_point_value",
    "drivegate_drive_transactions_total",
    "drivegate_drive_turnaround_seconds",
    "drivegate_bus_up",
    "drivegate_bus_load_ratio",
    "drivegate_bus_queue_depth",
    "drivegate_writes_total",
    "drivegate_modbus_tcp_connections",
    "drivegate_modbus_tcp_requests_total",
    "drivegate_mqtt_connected",
    "drivegate_mqtt_published_total",
    "drivegate_mqtt_buffered_messages",
    "drivegate_build_info",
    "drivegate_config_last_reload_successful",
    "drivegate_config_last_reload_timestamp_seconds",
    "drivegate_bus_cycle_seconds_bucket",
    "drivegate_bus_transaction_seconds_bucket",
    "drivegate_write_seconds_bucket",
];

/// Metrics that the dashboard must show.
const SHOWN: [&str; 15] = [
    "drivegate_drive_up",
    "drivegate_drive_state",
    "drivegate_drive_actual_speed_percent",
    "drivegate_drive_motor_current_amperes",
    "drivegate_drive_motor_torque_percent",
    "drivegate_drive_motor_power_percent",
    "drivegate_drive_dc_link_voltage_volts",
    "drivegate_drive_heatsink_temperature_celsius",
    "drivegate_bus_up",
    "drivegate_bus_load_ratio",
    "drivegate_bus_cycle_seconds_bucket",
    "drivegate_drive_transactions_total",
    "drivegate_writes_total",
    "drivegate_modbus_tcp_requests_total",
    "drivegate_mqtt_connected",
];

const DASHBOARDS: [&str; 4] = ["fleet", "gateway", "line", "drive"];
const ALERTS: &str = "deploy/compose/prometheus/alerts.yml";
const RECORDING: &str = "deploy/compose/prometheus/recording.yml";

fn read(path: &str) -> String {
    fs::read_to_string(root().join(path)).unwrap_or_else(|error| panic!("{path}: {error}"))
}

/// The shipped unit with the path of the binary under test.
fn unit(dir: &TempDir) -> String {
    let text = read("systemd/drivegate.service");
    let start = "ExecStart=/usr/bin/drivegate run";
    assert!(text.contains(start), "the unit starts something else");
    let text = text.replace("/usr/bin/drivegate", env!("CARGO_BIN_EXE_drivegate"));
    let path = dir.path().join("drivegate.service");
    fs::write(&path, text).unwrap();
    path.display().to_string()
}

#[test]
fn the_unit_is_clean() {
    let dir = TempDir::new().unwrap();
    let analyze = tool("systemd-analyze");
    let printed = run_well(&analyze, &["verify", "--man=no", "--recursive-errors=no", &unit(&dir)]);
    let complaints: Vec<&str> = printed.lines().filter(|line| line.contains("drivegate")).collect();
    assert!(complaints.is_empty(), "{complaints:#?}");
}

/// Exposure 0 is locked up entirely, 100 not at all; the remaining exposure is the network, the serial ports and their
/// group, and the real time of the line's thread.
#[test]
fn the_unit_is_sandboxed() {
    let dir = TempDir::new().unwrap();
    let arguments = [
        "security",
        "--offline=true",
        "--no-pager",
        "--threshold=15",
        &unit(&dir),
    ];
    run_well(&tool("systemd-analyze"), &arguments);
}

#[test]
fn nothing_that_ships_fills_the_machine() {
    let unit = read("systemd/drivegate.service");
    for wanted in [
        "MemoryMax=",
        "TasksMax=",
        "LogRateLimitBurst=",
        "PrivateMounts=yes",
        "#IPAddressDeny=any",
    ] {
        assert!(unit.lines().any(|line| line.starts_with(wanted)), "{wanted}");
    }
    for (name, service) in yaml("deploy/compose.yaml")["services"].as_object().unwrap() {
        let logging = &service["logging"];
        assert!(
            logging["options"]["max-size"].is_string(),
            "{name}: its log grows without end"
        );
        assert!(logging["options"]["max-file"].is_string(), "{name}");
        assert!(
            service["mem_limit"].is_string() && service["pids_limit"].is_number(),
            "{name} has no limits"
        );
    }
}

#[test]
fn prometheus_takes_its_configuration_and_the_rules_do_what_they_say() {
    let promtool = tool("promtool");
    run_well(
        &promtool,
        &["check", "config", "deploy/compose/prometheus/prometheus.yml"],
    );
    run_well(&promtool, &["check", "rules", ALERTS, RECORDING]);
    run_well(
        &tool("amtool"),
        &["check-config", "deploy/compose/alertmanager/alertmanager.yml"],
    );
    for rules in [ALERTS, RECORDING] {
        run_well(&promtool, &["test", "rules", &rules.replace(".yml", "_test.yml")]);
    }
}

/// Metrics of the gateway and series that rules record.
fn metrics_in(text: &str) -> BTreeSet<String> {
    let word = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == ':';
    text.split(|c| !word(c))
        .filter(|w| w.starts_with("drivegate_") || w.starts_with("instance:"))
        .map(str::to_string)
        .collect()
}

fn dashboard_path(name: &str) -> String {
    format!("deploy/compose/grafana/dashboards/{name}.json")
}

fn dashboards() -> Vec<Value> {
    let read = |name| serde_json::from_str(&read(&dashboard_path(name))).unwrap();
    DASHBOARDS.into_iter().map(read).collect()
}

/// The queries of panels and annotations.
fn expressions(dashboard: &Value) -> Vec<String> {
    let panels = dashboard["panels"].as_array().unwrap();
    let targets = panels.iter().filter_map(|panel| panel["targets"].as_array()).flatten();
    targets
        .chain(dashboard["annotations"]["list"].as_array().unwrap())
        .map(|target| target["expr"].as_str().unwrap().to_string())
        .collect()
}

#[test]
fn dashboards_and_alerts_use_metrics_that_exist() {
    let mut known: BTreeSet<String> = METRICS.iter().map(ToString::to_string).collect();
    // A rule may use a series that an earlier rule records.
    for rule in rules_of(RECORDING) {
        let unknown: Vec<_> = metrics_in(&rule["expr"].to_string())
            .into_iter()
            .filter(|m| !known.contains(m))
            .collect();
        assert!(unknown.is_empty(), "{RECORDING}: {unknown:?}");
        known.insert(rule["record"].as_str().unwrap().to_string());
    }
    let mut queries = Vec::new();
    for dashboard in dashboards() {
        queries.extend(expressions(&dashboard));
        for variable in dashboard["templating"]["list"].as_array().unwrap() {
            queries.push(variable["query"].to_string());
        }
    }
    let shown = metrics_in(&queries.join("\n"));
    let unknown: Vec<_> = shown.difference(&known).collect();
    assert!(unknown.is_empty(), "dashboards: {unknown:?}");
    let missing: Vec<_> = SHOWN.iter().filter(|metric| !shown.contains(**metric)).collect();
    assert!(missing.is_empty(), "the dashboards do not show {missing:?}");

    // Label values such as a file name may begin like a metric, so only expressions are checked.
    let expressions: Vec<String> = rules_of(ALERTS).iter().map(|rule| rule["expr"].to_string()).collect();
    let unknown: Vec<_> = metrics_in(&expressions.join("\n"))
        .into_iter()
        .filter(|m| !known.contains(m))
        .collect();
    assert!(unknown.is_empty(), "{ALERTS}: {unknown:?}");
}

fn rules_of(path: &str) -> Vec<Value> {
    let file = yaml(path);
    let groups = file["groups"].as_array().unwrap().iter();
    groups
        .flat_map(|group| group["rules"].as_array().unwrap().clone())
        .collect()
}

#[test]
fn every_alert_is_documented() {
    let page = read("docs/http.md");
    for rule in rules_of(ALERTS) {
        let name = rule["alert"].as_str().unwrap();
        assert!(page.contains(&format!("| `{name}` |")), "{name}");
    }
}

#[test]
fn the_dashboards_are_those_of_their_script() {
    run_well(&python(), &["deploy/compose/grafana/make_dashboards.py", "--check"]);
}

/// The types of Grafana itself detect keys that Grafana would ignore and values that it does not know.
#[test]
fn grafana_knows_all_of_the_dashboards() {
    let check = |files: &[String]| {
        Command::new(tool("node"))
            .arg("tests/tools/node/check_dashboards.js")
            .args(files)
            .current_dir(root())
            .env("NODE_PATH", root().join(".tools/node/node_modules"))
            .output()
            .unwrap()
    };
    let checked = check(&DASHBOARDS.map(dashboard_path));
    assert!(checked.status.success(), "{}", String::from_utf8_lossy(&checked.stderr));
    // The check itself must detect a value that Grafana does not know.
    let dir = TempDir::new().unwrap();
    let wrong = dir.path().join("wrong.json");
    let text = read(&dashboard_path("drive"));
    fs::write(
        &wrong,
        text.replacen("\"drawStyle\": \"line\"", "\"drawStyle\": \"curve\"", 1),
    )
    .unwrap();
    let checked = check(&[wrong.display().to_string()]);
    let said = String::from_utf8_lossy(&checked.stderr);
    assert!(!checked.status.success() && said.contains("drawStyle"), "{said}");
}

#[test]
fn links_between_dashboards_lead_somewhere() {
    let dashboards = dashboards();
    let uids: BTreeSet<&str> = dashboards.iter().map(|one| one["uid"].as_str().unwrap()).collect();
    assert_eq!(uids.len(), DASHBOARDS.len());
    for dashboard in &dashboards {
        let text = dashboard.to_string();
        let linked = text.match_indices("\"/d/").map(|(at, found)| {
            let rest = &text[at + found.len()..];
            rest.split(['?', '"']).next().unwrap()
        });
        let linked: BTreeSet<&str> = linked.collect();
        assert!(linked.is_subset(&uids), "{linked:?}");
        assert!(linked.len() >= 3, "{}: links to {linked:?} only", dashboard["uid"]);
    }
}

#[test]
fn the_expressions_of_the_dashboards_are_sound() {
    let mut rules = Vec::new();
    for dashboard in dashboards() {
        let panels = dashboard["panels"].as_array().unwrap();
        let ids: BTreeSet<i64> = panels.iter().map(|panel| panel["id"].as_i64().unwrap()).collect();
        assert_eq!(ids.len(), panels.len(), "two panels have the same id");
        for expression in expressions(&dashboard) {
            let plain = expression.replace("$__rate_interval", "1m");
            rules.push(serde_json::json!({ "record": format!("expression:{}", rules.len()), "expr": plain }));
        }
    }
    assert!(rules.len() > 50, "only {} expressions", rules.len());
    let dir = TempDir::new().unwrap();
    let file = dir.path().join("rules.yml");
    // JSON is YAML.
    let text = serde_json::json!({ "groups": [{ "name": "dashboards", "rules": rules }] }).to_string();
    fs::write(&file, text).unwrap();
    run_well(&tool("promtool"), &["check", "rules", &file.display().to_string()]);
}

fn yaml(path: &str) -> Value {
    let script = "import json, sys, yaml; json.dump(yaml.safe_load(open(sys.argv[1])), sys.stdout)";
    let printed = run_well(&python(), &["-c", script, path]);
    serde_json::from_str(&printed).unwrap_or_else(|error| panic!("{path}: {error}: {printed}"))
}

#[test]
fn what_compose_mounts_and_publishes_is_there() {
    let compose = yaml("deploy/compose.yaml");
    let image = read("deploy/Dockerfile");
    let exposed = image.lines().find_map(|line| line.strip_prefix("EXPOSE ")).unwrap();
    for (name, service) in compose["services"].as_object().unwrap() {
        for volume in service["volumes"].as_array().unwrap() {
            let source = volume.as_str().unwrap().split(':').next().unwrap();
            if source.starts_with("./") {
                let path = root().join("deploy").join(source);
                assert!(
                    path.is_dir(),
                    "{name}: {source}: mount folders: an editor replaces a file"
                );
            } else if !source.starts_with('/') {
                assert!(compose["volumes"].get(source).is_some(), "{name}: no volume {source}");
            }
        }
        for port in service["ports"].as_array().unwrap() {
            let port = port.as_str().unwrap();
            assert!(port.starts_with("${BIND:-127.0.0.1}:"), "{name}: {port} is open to all");
            let inside = port.rsplit(':').next().unwrap();
            assert!(
                name != "drivegate" || exposed.contains(inside),
                "the image does not expose {inside}"
            );
        }
    }
    let config: toml::Table = read("deploy/compose/drivegate/drivegate.toml").parse().unwrap();
    for listen in [&config["modbus_tcp"]["listen"][0], &config["http"]["listen"]] {
        let port = listen.as_str().unwrap().rsplit(':').next().unwrap();
        assert!(exposed.contains(port), "the image does not expose {port}");
    }
}

#[test]
fn grafana_finds_its_datasource_and_dashboards() {
    let datasource = yaml("deploy/compose/grafana/provisioning/datasources/prometheus.yaml");
    assert_eq!(datasource["datasources"][0]["url"], "http://prometheus:9090");
    let provider = yaml("deploy/compose/grafana/provisioning/dashboards/drivegate.yaml");
    let path = provider["providers"][0]["options"]["path"]
        .as_str()
        .unwrap()
        .to_string();
    let compose = yaml("deploy/compose.yaml");
    let mounts = compose["services"]["grafana"]["volumes"].to_string();
    assert!(mounts.contains(&format!("./compose/grafana/dashboards:{path}:ro")));
    let home = compose["services"]["grafana"]["environment"]["GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH"].as_str();
    assert_eq!(home, Some(format!("{path}/gateway.json").as_str()));
}

/// Installs into a folder, again over an edited configuration, and removes all but that.
#[test]
fn make_install_keeps_the_configuration_and_uninstall_removes_the_rest() {
    let folder = TempDir::new().unwrap();
    let make = |target: &str| {
        let destination = format!("DESTDIR={}", folder.path().display());
        let program = format!("PROGRAM={}", env!("CARGO_BIN_EXE_drivegate"));
        let directory = root().display().to_string();
        run_well(
            tool("make").as_ref(),
            &["-C", &directory, target, &destination, &program],
        )
    };
    make("install");
    let configuration = folder.path().join("etc/drivegate/drivegate.toml");
    let read = |file: &str| fs::read_to_string(folder.path().join(file)).unwrap_or_default();
    let unit = fs::read_to_string(root().join("systemd/drivegate.service")).unwrap();
    assert_eq!(read("etc/systemd/system/drivegate.service"), unit);
    assert!(read("usr/share/man/man1/drivegate.1").contains("drivegate"));
    for completions in [
        "bash-completion/completions/drivegate",
        "zsh/vendor-completions/_drivegate",
        "fish/vendor_completions.d/drivegate.fish",
    ] {
        assert!(
            read(&format!("usr/share/{completions}")).contains("stop-all"),
            "{completions}"
        );
    }
    let program = folder.path().join("usr/bin/drivegate");
    run_well(&program, &["check", "--config", &configuration.display().to_string()]);
    fs::write(&configuration, "# edited\n").unwrap();
    make("install");
    assert_eq!(fs::read_to_string(&configuration).unwrap(), "# edited\n");
    make("uninstall");
    let mut left = Vec::new();
    let mut open = vec![folder.path().to_path_buf()];
    while let Some(directory) = open.pop() {
        for entry in fs::read_dir(directory).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path)
            } else {
                left.push(path)
            }
        }
    }
    assert_eq!(left, [configuration]);
}

#[test]
fn the_image_is_small_and_not_root() {
    let text = read("deploy/Dockerfile");
    let last = text.rsplit("\nFROM ").next().unwrap();
    assert!(last.starts_with("scratch\n"), "the image ends in {last}");
    let user = last.lines().find_map(|line| line.strip_prefix("USER ")).unwrap();
    assert_ne!(user.split(':').next().unwrap().parse(), Ok(0), "a number, and not root");
    assert!(last.contains("CMD [\"run\", \"--config\", \"/etc/drivegate/drivegate.toml\"]"));
    // Files that the build needs are not ignored.
    let ignored = read(".dockerignore");
    for needed in [
        "Cargo.toml",
        "Cargo.lock",
        "crates",
        "src",
        "profiles",
        "docs",
        "deploy/package",
    ] {
        assert!(ignored.lines().any(|line| line == format!("!{needed}")), "{needed}");
    }
}

#[test]
fn the_local_socket_has_its_directory() {
    assert!(read("systemd/drivegate.service").contains("\nRuntimeDirectory=drivegate\n"));
    let image = read("deploy/Dockerfile");
    assert!(image.contains("\nCOPY --from=build --chown=65532:65532 /tree/owned/ /\n"));
    let tree = read("deploy/package/image-tree.sh");
    assert!(tree.contains("\"$folder\"/owned/{var/lib,run}/drivegate\n"));
    let service = &yaml("deploy/compose.yaml")["services"]["drivegate"];
    assert_eq!(service["read_only"], true);
    let writable = service["tmpfs"][0].as_str().unwrap();
    assert!(writable.starts_with("/run/drivegate:uid=65532,"), "{writable}");
}

#[test]
fn mosquitto_takes_its_configuration() {
    let site = Site::new();
    let config = read("deploy/compose/mosquitto/mosquitto.conf")
        .replace("listener 1883", &format!("listener {} 127.0.0.1", site.mqtt))
        .replace("/mosquitto/data", &site.folder.path().display().to_string());
    site.write("mosquitto.conf", &config);
    let mut broker = Running::start(&tool("mosquitto"), &["-c", &site.path("mosquitto.conf")]);
    until("the broker", || {
        assert!(broker.runs(), "{}", broker.output());
        TcpStream::connect(("127.0.0.1", site.mqtt)).ok()
    });
}
