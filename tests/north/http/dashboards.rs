//! Every query of the dashboards and alerts, run in a real Prometheus that scrapes two equal gateways; and the
//! route of an alert to its receiver.

use std::collections::BTreeSet;
use std::fmt::Write;

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpListener;

use super::metrics::{Prometheus, everything};
use super::plant::{self, Server};
use crate::support::process::{PATIENCE, Running, free_port};
use crate::support::tools::{root, tool};

/// The queries of all panels and annotations, with the variables set to everything.
fn panels() -> Vec<String> {
    let mut queries = Vec::new();
    let directory = root().join("deploy/compose/grafana/dashboards");
    for file in std::fs::read_dir(directory).unwrap() {
        let text = std::fs::read_to_string(file.unwrap().path()).unwrap();
        let dashboard: serde_json::Value = serde_json::from_str(&text).unwrap();
        let panels = dashboard["panels"].as_array().unwrap().iter();
        let targets = panels.filter_map(|panel| panel["targets"].as_array()).flatten();
        let annotations = dashboard["annotations"]["list"].as_array().unwrap();
        let expressions = targets
            .chain(annotations)
            .map(|target| target["expr"].as_str().unwrap());
        queries.extend(expressions.map(str::to_string));
    }
    let everything = |query: &String| {
        let query = ["$instance", "$bus", "$drive"]
            .into_iter()
            .fold(query.clone(), |query, variable| query.replace(variable, ".+"));
        without_comparisons(&query.replace("$__rate_interval", "1m"))
    };
    let queries: BTreeSet<String> = queries.iter().map(everything).collect();
    queries.into_iter().collect()
}

/// Whether a query adds all gateways up, as only the fleet does.
fn is_total(query: &str) -> bool {
    ["sum(", "count(", "count by (version"]
        .iter()
        .any(|start| query.starts_with(start))
}

/// The expressions of all alerts without their comparisons: a plant without faults has values for them as well.
fn alerts() -> Vec<String> {
    let text = std::fs::read_to_string(root().join("deploy/compose/prometheus/alerts.yml")).unwrap();
    let mut alerts: Vec<String> = Vec::new();
    let mut is_block = false;
    for line in text.lines() {
        match line.trim().strip_prefix("expr:") {
            Some(rest) => {
                is_block = rest.trim() == "|";
                alerts.push(if is_block {
                    String::new()
                } else {
                    rest.trim().to_string()
                });
            }
            None if is_block && line.starts_with("          ") => {
                let alert = alerts.last_mut().unwrap();
                alert.push_str(line.trim());
                alert.push(' ');
            }
            None => is_block = false,
        }
    }
    alerts.iter().map(|alert| without_comparisons(alert)).collect()
}

fn without_comparisons(query: &str) -> String {
    let mut words = query.split_whitespace();
    let mut kept = Vec::new();
    while let Some(word) = words.next() {
        match word {
            // The number after the comparison is skipped as well.
            "==" | ">" | "<" => {
                words.next();
            }
            word => kept.push(word),
        }
    }
    kept.join(" ")
}

fn encoded(query: &str) -> String {
    let mut encoded = String::new();
    for byte in query.bytes() {
        let _ = match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' => write!(encoded, "{}", char::from(byte)),
            other => write!(encoded, "%{other:02X}"),
        };
    }
    encoded
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_query_tells_two_gateways_with_equal_buses_apart() {
    let (one, other) = (everything().await, everything().await);
    let gateways = BTreeSet::from([one.address.to_string(), other.address.to_string()]);
    let rules = root().join("deploy/compose/prometheus/recording.yml");
    let more = format!("rule_files: [\"{}\"]\n", rules.display());
    let prometheus = Prometheus::with(&[one.address, other.address], &more);
    let (panels, alerts) = (panels(), alerts());
    assert!(
        panels.len() >= 50 && alerts.len() >= 13,
        "{} {}",
        panels.len(),
        alerts.len()
    );
    assert_eq!(panels.iter().filter(|query| is_total(query)).count(), 8, "{panels:#?}");
    for query in panels.iter().chain(&alerts) {
        let of_both = |found: &[serde_json::Value]| {
            if is_total(query) {
                return found.len() == 1 && found[0]["metric"]["instance"].is_null();
            }
            let instances = found
                .iter()
                .map(|series| series["metric"]["instance"].as_str().unwrap_or("none"));
            instances.map(str::to_string).collect::<BTreeSet<String>>() == gateways
        };
        prometheus.find(&encoded(query), of_both).await;
    }
}

/// The body of one HTTP request, which is answered.
async fn received(listener: &TcpListener) -> String {
    let (mut stream, _) = listener.accept().await.unwrap();
    let mut text = Vec::new();
    let mut piece = [0; 4096];
    loop {
        let count = stream.read(&mut piece).await.unwrap();
        text.extend_from_slice(&piece[..count]);
        let request = String::from_utf8_lossy(&text);
        let body = request.split_once("\r\n\r\n").map(|(_, body)| body);
        // Alertmanager sends JSON, in one piece or several.
        if count == 0 || body.is_some_and(|body| serde_json::from_str::<serde_json::Value>(body).is_ok()) {
            let _ = stream.write_all(b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\n\r\n").await;
            return body.unwrap_or_default().to_string();
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_fault_reaches_its_receiver_with_its_text() {
    let server = Server::of(plant::mixed()).await;
    let receiver = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
    let directory = tempfile::tempdir().unwrap();
    let shipped = std::fs::read_to_string(root().join("deploy/compose/alertmanager/alertmanager.yml")).unwrap();
    let hook = format!(
        "  - name: electricians\n    webhook_configs: [{{ url: 'http://{}/' }}]\n",
        receiver.local_addr().unwrap()
    );
    let settings = shipped
        .replace("  - name: electricians\n", &hook)
        .replace("group_wait: 10s", "group_wait: 1s");
    assert!(
        settings.contains(&hook) && settings.contains("group_wait: 1s"),
        "{settings}"
    );
    let file = directory.path().join("alertmanager.yml");
    std::fs::write(&file, settings).unwrap();
    let port = free_port();
    let _alertmanager = Running::start(
        &tool("prometheus-alertmanager"),
        &[
            &format!("--config.file={}", file.display()),
            &format!("--storage.path={}", directory.path().display()),
            &format!("--web.listen-address=127.0.0.1:{port}"),
            "--cluster.listen-address=",
        ],
    );
    let rules = root().join("deploy/compose/prometheus/alerts.yml");
    let more = format!(
        "rule_files: [\"{}\"]\nalerting:\n  alertmanagers:\n  - static_configs: [{{ targets: [\"127.0.0.1:{port}\"] }}]\n",
        rules.display()
    );
    let _prometheus = Prometheus::with(&[server.address], &more);
    let told = tokio::time::timeout(PATIENCE, async {
        let mut all = String::new();
        while !all.contains("DrivegateDriveFault") {
            all += &received(&receiver).await;
        }
        all
    });
    let told = told.await.expect("a message");
    let faulted = "Drive saw-4 on bus line2 has a fault: ";
    assert!(told.contains(faulted), "{faulted} is missing in {told}");
}
