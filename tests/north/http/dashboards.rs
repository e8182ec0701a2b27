//! Every query of the dashboards and alerts, asked of a real Prometheus that scrapes two gateways alike.

use std::collections::BTreeSet;
use std::fmt::Write;

use super::metrics::{Prometheus, everything};
use crate::support::tools::root;

/// The queries of all panels, with the variables set to everything.
fn panels() -> Vec<String> {
    let mut queries = Vec::new();
    let directory = root().join("deploy/compose/grafana/dashboards");
    for file in std::fs::read_dir(directory).unwrap() {
        let text = std::fs::read_to_string(file.unwrap().path()).unwrap();
        let dashboard: serde_json::Value = serde_json::from_str(&text).unwrap();
        collect(&dashboard["panels"], &mut queries);
    }
    let everything = |query: &String| {
        let query = ["$instance", "$bus", "$drive"]
            .into_iter()
            .fold(query.clone(), |query, variable| query.replace(variable, ".+"));
        query.replace("$__rate_interval", "1m")
    };
    queries.iter().map(everything).collect()
}

fn collect(panels: &serde_json::Value, queries: &mut Vec<String>) {
    for panel in panels.as_array().into_iter().flatten() {
        let targets = panel["targets"].as_array().into_iter().flatten();
        queries.extend(targets.filter_map(|target| target["expr"].as_str()).map(str::to_string));
        collect(&panel["panels"], queries);
    }
}

/// The expressions of all alerts without what they compare with: what a sound plant has, too.
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
            // The figure behind it goes with it.
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
    let prometheus = Prometheus::scraping(&[one.address, other.address]);
    let (panels, alerts) = (panels(), alerts());
    assert!(
        panels.len() >= 35 && alerts.len() >= 8,
        "{} {}",
        panels.len(),
        alerts.len()
    );
    for query in panels.iter().chain(&alerts) {
        let of_both = |found: &[serde_json::Value]| {
            let instances = found
                .iter()
                .map(|series| series["metric"]["instance"].as_str().unwrap_or("none"));
            instances.map(str::to_string).collect::<BTreeSet<String>>() == gateways
        };
        prometheus.find(&encoded(query), of_both).await;
    }
}
