//! Prometheus metrics: frozen names, values, lint, and a real Prometheus.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use drivegate_testkit::rows;

use super::client::{get, request};
use super::plant::{self, STALE_AFTER, Server};
use crate::support::process::{PATIENCE, Running, free_port};
use crate::support::tools::{feed, tool};

/// Every metric with its type and labels. Dashboards and alerts depend on these: a new metric is added here, and
/// none may be renamed, retyped or removed.
const FROZEN: [&str; 64] = [
    "drivegate_build_info gauge commit,gateway,version",
    "drivegate_bus_cycle_seconds histogram bus,class",
    "drivegate_bus_load_ratio gauge bus",
    "drivegate_bus_queue_depth gauge bus",
    "drivegate_bus_transaction_seconds histogram bus",
    "drivegate_bus_up gauge bus",
    "drivegate_config_last_reload_successful gauge ",
    "drivegate_config_last_reload_timestamp_seconds gauge ",
    "drivegate_drive_actual_speed_percent gauge bus,drive",
    "drivegate_drive_at_reference gauge bus,drive",
    "drivegate_drive_blocked gauge bus,drive,reason",
    "drivegate_drive_dc_link_voltage_volts gauge bus,drive",
    "drivegate_drive_energy_kilowatthours gauge bus,drive",
    "drivegate_drive_fault gauge bus,drive",
    "drivegate_drive_fault_code gauge bus,drive",
    "drivegate_drive_fault_info gauge bus,drive,text",
    "drivegate_drive_heatsink_temperature_celsius gauge bus,drive",
    "drivegate_drive_motor_current_amperes gauge bus,drive",
    "drivegate_drive_motor_power_percent gauge bus,drive",
    "drivegate_drive_motor_speed_rpm gauge bus,drive",
    "drivegate_drive_motor_torque_percent gauge bus,drive",
    "drivegate_drive_motor_voltage_volts gauge bus,drive",
    "drivegate_drive_operating_hours gauge bus,drive",
    "drivegate_drive_output_frequency_hertz gauge bus,drive",
    "drivegate_drive_ready gauge bus,drive",
    "drivegate_drive_reversed gauge bus,drive",
    "drivegate_drive_running gauge bus,drive",
    "drivegate_drive_sample_age_seconds gauge bus,drive",
    "drivegate_drive_speed_reference_percent gauge bus,drive",
    "drivegate_drive_running_seconds_total counter bus,drive",
    "drivegate_drive_starts_total counter bus,drive",
    "drivegate_drive_state gauge bus,drive,state",
    "drivegate_drive_transactions_total counter bus,drive,outcome",
    "drivegate_drive_turnaround_seconds gauge bus,drive",
    "drivegate_drive_unsupervised gauge bus,drive",
    "drivegate_drive_up gauge bus,drive",
    "drivegate_drive_warning gauge bus,drive",
    "drivegate_line_diagnosis gauge bus,drive,verdict",
    "drivegate_listener_up gauge server",
    "drivegate_modbus_tcp_connections gauge ",
    "drivegate_modbus_tcp_requests_total counter function,outcome",
    "drivegate_port_reconnects_total counter bus",
    "drivegate_slot_requests_total counter bus,outcome",
    "drivegate_mqtt_buffered_messages gauge ",
    "drivegate_mqtt_configured gauge ",
    "drivegate_mqtt_lost_total counter kind",
    "drivegate_mqtt_connected gauge ",
    "drivegate_mqtt_published_total counter ",
    "drivegate_paused_seconds_total counter ",
    "drivegate_pauses_total counter ",
    "drivegate_point_value gauge bus,drive,point,unit",
    "drivegate_supervision_actions_total counter bus,drive",
    "drivegate_supervision_failed_total counter bus,drive",
    "drivegate_write_seconds histogram ",
    "drivegate_parameters_changed_total counter bus,drive",
    "drivegate_recordings_total counter trigger",
    "drivegate_writes_total counter result,source",
    "process_cpu_seconds_total counter ",
    "process_max_fds gauge ",
    "process_open_fds gauge ",
    "process_resident_memory_bytes gauge ",
    "process_start_time_seconds gauge ",
    "process_threads gauge ",
    "process_virtual_memory_bytes gauge ",
];

/// A series: name, labels in alphabetical order, value.
#[derive(Debug, Clone, PartialEq)]
struct Series {
    name: String,
    labels: BTreeMap<String, String>,
    value: f64,
}

fn series(text: &str) -> Vec<Series> {
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    lines
        .map(|line| {
            let (series, value) = line.rsplit_once(' ').expect("a value");
            let (name, labels) = series.split_once('{').unwrap_or((series, ""));
            let labels = labels.trim_end_matches('}').split(',').filter(|l| !l.is_empty());
            let labels = labels.map(|label| {
                let (key, value) = label.split_once('=').expect("a label");
                (key.to_string(), value.trim_matches('"').to_string())
            });
            Series {
                name: name.to_string(),
                labels: labels.collect(),
                value: value.parse().expect("a number"),
            }
        })
        .collect()
}

/// The families of a text: name, type and label names.
fn families(text: &str) -> BTreeSet<String> {
    let kinds: BTreeMap<&str, &str> = text
        .lines()
        .filter_map(|line| line.strip_prefix("# TYPE ")?.split_once(' '))
        .collect();
    let family = |one: &Series| {
        let histogram = ["_bucket", "_sum", "_count"].iter().find_map(|suffix| {
            one.name
                .strip_suffix(suffix)
                .filter(|base| kinds.get(base) == Some(&"histogram"))
        });
        let name = histogram.unwrap_or(&one.name);
        let labels: Vec<&str> = one.labels.keys().map(String::as_str).filter(|l| *l != "le").collect();
        format!("{name} {} {}", kinds.get(name).unwrap_or(&"untyped"), labels.join(","))
    };
    series(text).iter().map(family).collect()
}

async fn scrape(server: &Server) -> String {
    let reply = get(server.address, "/metrics").await;
    assert_eq!(
        reply.header("content-type"),
        Some("text/plain; version=0.0.4; charset=utf-8")
    );
    reply.body
}

/// The value of a series; `labels` as `a=b,c=d` in any order.
fn value(text: &str, name: &str, labels: &str) -> Option<f64> {
    let labels: BTreeMap<String, String> = labels
        .split(',')
        .filter_map(|l| l.split_once('='))
        .map(|(k, v)| (k.to_string(), v.to_string()))
        .collect();
    let found: Vec<f64> = series(text)
        .into_iter()
        .filter(|s| s.name == name && s.labels == labels)
        .map(|s| s.value)
        .collect();
    assert!(found.len() < 2, "{name} {labels:?} occurs more than once");
    found.first().copied()
}

/// A plant with a drive that has every point, and one that was never read.
pub(super) async fn everything() -> Server {
    let image = plant::supervised("line1", "all", 1, &plant::everything());
    plant::answer(&image, Instant::now(), |address| if address == 41 { 50 } else { 1 });
    let untried = plant::drive("line1", "untried", 2, &plant::everything());
    let bus = plant::bus("line1", vec![image, untried]);
    plant::open(&bus);
    plant::diagnose(&bus);
    let plant = plant::plant(vec![bus]);
    plant::count_a_write(&plant);
    Server::of(plant).await
}

#[tokio::test]
async fn names_types_and_labels_are_frozen() {
    let server = everything().await;
    let found = families(&scrape(&server).await);
    let frozen: BTreeSet<String> = FROZEN.iter().map(ToString::to_string).collect();
    let missing: Vec<_> = frozen.difference(&found).collect();
    let added: Vec<_> = found.difference(&frozen).collect();
    assert!(
        missing.is_empty() && added.is_empty(),
        "missing: {missing:#?}\nnot in the contract: {added:#?}"
    );
}

#[test]
fn every_metric_is_documented() {
    let page = include_str!("../../../docs/http.md");
    for line in FROZEN {
        let name = line.split(' ').next().expect("a name");
        let short = name.trim_start_matches("drivegate_drive");
        assert!(
            page.contains(&format!("`{name}`")) || page.contains(&format!("`{short}`")),
            "{name}"
        );
    }
}

#[tokio::test]
async fn points_without_a_metric_of_their_own() {
    let server = everything().await;
    let text = scrape(&server).await;
    let all = series(&text);
    let points: BTreeSet<(&str, &str)> = all
        .iter()
        .filter(|s| s.name == "drivegate_point_value")
        .map(|s| (s.labels["point"].as_str(), s.labels["unit"].as_str()))
        .collect();
    let expected = [
        ("fault_reset", ""),
        ("frequency_reference", "Hz"),
        ("maximum_frequency", "Hz"),
        ("minimum_frequency", "Hz"),
        ("remote", ""),
        ("reverse", ""),
        ("run", ""),
        ("zero_speed", ""),
    ];
    assert_eq!(points, BTreeSet::from(expected));
    assert_eq!(
        value(&text, "drivegate_point_value", "bus=line1,drive=all,point=run,unit="),
        Some(1.0)
    );
    assert_eq!(
        value(
            &text,
            "drivegate_point_value",
            "bus=line1,drive=all,point=maximum_frequency,unit=Hz"
        ),
        Some(50.0)
    );
}

/// Series, labels and value in the plant in which everything occurs.
const VALUES: &str = "\
drivegate_drive_up                      | bus=line1,drive=pump-1                | 1
drivegate_drive_up                      | bus=line1,drive=fan-2                 | 0
drivegate_drive_up                      | bus=line1,drive=mixer-3               | 0
drivegate_drive_state                   | bus=line1,drive=pump-1,state=running  | 1
drivegate_drive_state                   | bus=line1,drive=pump-1,state=ready    | 0
drivegate_drive_state                   | bus=line1,drive=fan-2,state=offline   | 1
drivegate_drive_state                   | bus=line2,drive=saw-4,state=fault     | 1
drivegate_drive_output_frequency_hertz  | bus=line1,drive=pump-1                | 25
drivegate_drive_motor_current_amperes   | bus=line1,drive=pump-1                | 4.2
drivegate_drive_running                 | bus=line1,drive=pump-1                | 1
drivegate_drive_fault_code              | bus=line2,drive=saw-4                 | 7
drivegate_drive_turnaround_seconds      | bus=line1,drive=pump-1                | 0.0019
drivegate_drive_transactions_total      | bus=line1,drive=fan-2,outcome=timeout | 1
drivegate_drive_transactions_total      | bus=line1,drive=fan-2,outcome=corrupt | 0
drivegate_bus_up                        | bus=line1                             | 1
drivegate_bus_load_ratio                | bus=line1                             | 0.4375
drivegate_bus_queue_depth               | bus=line1                             | 0
drivegate_bus_cycle_seconds_bucket      | bus=line1,class=fast,le=0.01          | 0
drivegate_bus_cycle_seconds_bucket      | bus=line1,class=fast,le=0.0125        | 1
drivegate_bus_cycle_seconds_bucket      | bus=line1,class=fast,le=+Inf          | 1
drivegate_bus_cycle_seconds_sum         | bus=line1,class=fast                  | 0.0125
drivegate_bus_cycle_seconds_count       | bus=line1,class=slow                  | 1
drivegate_bus_transaction_seconds_count | bus=line2                             | 1
drivegate_writes_total                  | source=mqtt,result=timeout            | 1
drivegate_write_seconds_count           |                                       | 1
drivegate_modbus_tcp_connections        |                                       | 1
drivegate_modbus_tcp_requests_total     | function=3,outcome=ok                 | 1
drivegate_modbus_tcp_requests_total     | function=6,outcome=illegal_function   | 1
drivegate_slot_requests_total           | bus=line1,outcome=answered            | 1
drivegate_mqtt_connected                |                                       | 1
drivegate_mqtt_published_total          |                                       | 17
drivegate_mqtt_buffered_messages        |                                       | 2";

#[tokio::test]
async fn values() {
    let plant = plant::mixed();
    plant::count_a_write(&plant);
    let server = Server::of(plant).await;
    let text = scrape(&server).await;
    for [name, labels, expected] in rows(VALUES) {
        let expected: f64 = expected.parse().unwrap();
        assert_eq!(value(&text, name, labels), Some(expected), "{name} {labels}");
    }
    let info = series(&text)
        .into_iter()
        .find(|s| s.name == "drivegate_build_info")
        .expect("build info");
    assert_eq!(
        (info.labels["version"].as_str(), info.labels["gateway"].as_str()),
        (env!("CARGO_PKG_VERSION"), "pump-house")
    );
    assert!(!info.labels["commit"].is_empty());
}

#[tokio::test]
async fn what_is_not_good_has_no_sample() {
    let server = Server::of(plant::mixed()).await;
    let names = async |drive: &str| -> BTreeSet<String> {
        let all = series(&scrape(&server).await);
        all.into_iter()
            .filter(|s| s.labels.get("drive").is_some_and(|d| d == drive))
            .map(|s| s.name)
            .collect()
    };
    let known = [
        "drivegate_supervision_actions_total",
        "drivegate_supervision_failed_total",
        "drivegate_parameters_changed_total",
        "drivegate_drive_up",
        "drivegate_drive_state",
        "drivegate_drive_transactions_total",
        // Counters are kept while the drive is offline.
        "drivegate_drive_starts_total",
        "drivegate_drive_running_seconds_total",
        // Being offline is a cause.
        "drivegate_drive_blocked",
    ];
    let never: BTreeSet<String> = known.map(String::from).into();
    let mut stale = never.clone();
    stale.extend(
        [
            "drivegate_drive_sample_age_seconds",
            "drivegate_drive_turnaround_seconds",
        ]
        .map(String::from),
    );
    assert_eq!(names("mixer-3").await, never);
    assert_eq!(names("fan-2").await, stale);
    assert!(names("pump-1").await.contains("drivegate_drive_motor_speed_rpm"));
    // The drive is online, but its process data is too old.
    let image = server.image("pump-1");
    plant::answer(&image, Instant::now() - 2 * STALE_AFTER, plant::nx_running);
    let mut old = names("pump-1").await;
    // Parameters are read once and stay good while the drive answers.
    old.remove("drivegate_point_value");
    assert_eq!(old, stale);
    let text = scrape(&server).await;
    let age = value(&text, "drivegate_drive_sample_age_seconds", "bus=line1,drive=pump-1").expect("an age");
    assert!((2.0 * STALE_AFTER.as_secs_f64()..1000.0).contains(&age), "{age}");
    assert_eq!(value(&text, "drivegate_drive_up", "bus=line1,drive=pump-1"), Some(1.0));
    assert_eq!(
        value(&text, "drivegate_drive_state", "bus=line1,drive=pump-1,state=offline"),
        Some(1.0)
    );
}

#[tokio::test]
async fn a_state_that_is_not_known_has_no_sample() {
    let server = Server::of(plant::plant(vec![plant::bus("line1", vec![plant::secretive()])])).await;
    let text = scrape(&server).await;
    assert!(!text.contains("drivegate_drive_state{"), "{text}");
    assert_eq!(value(&text, "drivegate_drive_up", "bus=line1,drive=fan-1"), Some(1.0));
    assert_eq!(
        value(&text, "drivegate_drive_ready", "bus=line1,drive=fan-1"),
        Some(1.0)
    );
    assert_eq!(value(&text, "drivegate_drive_running", "bus=line1,drive=fan-1"), None);
}

#[tokio::test]
async fn open_metrics_for_those_that_ask() {
    let server = everything().await;
    let reply = request(
        server.address,
        "GET",
        "/metrics",
        "Accept: application/openmetrics-text; version=1.0.0\r\n",
    )
    .await;
    assert_eq!(
        reply.header("content-type"),
        Some("application/openmetrics-text; version=1.0.0; charset=utf-8")
    );
    assert!(reply.body.ends_with("\n# EOF\n"));
    assert!(
        reply
            .body
            .contains("# TYPE drivegate_writes counter\ndrivegate_writes_total{"),
        "{}",
        reply.body
    );
    let plain = scrape(&server).await;
    assert!(
        plain.contains("# TYPE drivegate_writes_total counter\ndrivegate_writes_total{"),
        "{plain}"
    );
    assert!(!plain.contains("# EOF"));
    let names = |text: &str| -> BTreeSet<String> { series(text).into_iter().map(|s| s.name).collect() };
    assert_eq!(names(&plain), names(&reply.body), "the same series in both formats");
}

fn promtool(text: &str) -> (bool, String) {
    let output = feed(&tool("promtool"), &["check", "metrics"], text);
    let reported = [output.stdout, output.stderr].concat();
    (output.status.success(), String::from_utf8(reported).expect("text"))
}

#[tokio::test]
async fn promtool_has_no_complaint() {
    let plant = plant::mixed();
    plant::count_a_write(&plant);
    let server = Server::of(plant).await;
    assert_eq!(promtool(&scrape(&server).await), (true, String::new()));
    // The only name of the contract to which the linter objects; it comes from families that count hours.
    let (_, reported) = promtool(&scrape(&everything().await).await);
    assert_eq!(
        reported,
        "drivegate_drive_operating_hours use base unit \"seconds\" instead of \"hours\"\n"
    );
}

pub(super) struct Prometheus {
    program: Running,
    port: u16,
    _directory: tempfile::TempDir,
}

impl Prometheus {
    pub(super) fn scraping(targets: &[SocketAddr]) -> Prometheus {
        Prometheus::with(targets, "")
    }

    /// Starts Prometheus with more settings than the targets.
    pub(super) fn with(targets: &[SocketAddr], more: &str) -> Prometheus {
        let directory = tempfile::tempdir().unwrap();
        let port = free_port();
        let place = |name: &str| directory.path().join(name).display().to_string();
        let targets: Vec<String> = targets.iter().map(|target| format!("\"{target}\"")).collect();
        let targets = targets.join(", ");
        let settings = format!(
            "global: {{ scrape_interval: 1s, evaluation_interval: 1s }}\nscrape_configs:\n- job_name: drivegate\n  static_configs: [{{ targets: [{targets}] }}]\n{more}"
        );
        fs::write(place("prometheus.yml"), settings).unwrap();
        let arguments = [
            format!("--config.file={}", place("prometheus.yml")),
            format!("--storage.tsdb.path={}", place("data")),
            format!("--web.listen-address=127.0.0.1:{port}"),
        ];
        Prometheus {
            program: Running::start(&tool("prometheus"), &arguments.each_ref().map(String::as_str)),
            port,
            _directory: directory,
        }
    }

    /// Value of the only series that a query finds; waits until the series exists.
    async fn ask(&self, query: &str) -> String {
        let found = self.find(query, |found| !found.is_empty()).await;
        found[0]["value"][1].as_str().expect("a value").to_string()
    }

    /// The series found by a query (as part of a URL), as soon as they are as wanted.
    pub(super) async fn find(
        &self,
        query: &str,
        wanted: impl Fn(&[serde_json::Value]) -> bool,
    ) -> Vec<serde_json::Value> {
        let address = SocketAddr::from(([127, 0, 0, 1], self.port));
        let path = format!("/api/v1/query?query={query}");
        let deadline = Instant::now() + PATIENCE;
        let mut last = String::new();
        while Instant::now() < deadline {
            if tokio::net::TcpStream::connect(address).await.is_ok() {
                last = get(address, &path).await.body;
                let answer: serde_json::Value = serde_json::from_str(&last).unwrap_or_default();
                if let Some(found) = answer["data"]["result"].as_array().filter(|found| wanted(found)) {
                    return found.clone();
                }
            }
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
        panic!("Prometheus answers {query} with {last}\n{}", self.program.output());
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_real_prometheus_scrapes_it() {
    let plant = plant::mixed();
    plant::count_a_write(&plant);
    let server = Server::of(plant).await;
    let prometheus = Prometheus::scraping(&[server.address]);
    assert_eq!(
        prometheus
            .ask("drivegate_drive_output_frequency_hertz%7Bdrive=%22pump-1%22%7D")
            .await,
        "25"
    );
    assert_eq!(prometheus.ask("up").await, "1");
    assert_eq!(
        prometheus.ask("drivegate_writes_total%7Bresult=%22timeout%22%7D").await,
        "1"
    );
    assert_eq!(
        prometheus
            .ask("drivegate_bus_cycle_seconds_count%7Bbus=%22line1%22,class=%22fast%22%7D")
            .await,
        "1"
    );
    assert_eq!(prometheus.ask("count(drivegate_drive_up)").await, "4");
    assert_eq!(
        prometheus.ask("count(drivegate_drive_output_frequency_hertz)").await,
        "2",
        "only good ones"
    );
}
