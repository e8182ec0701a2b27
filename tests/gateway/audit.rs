//! The audit: for a client that may not write, on disk, and with text from outside in the log.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpStream};
use std::process::Output;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use serde_json::Value;

use crate::support::process::{PATIENCE, Running, drivegate, get, until, write_registers};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, MQTT, Site, controlled};

const SPEED_REFERENCE: u16 = 0x8101;
const AUDIT: &str = "[audit]\nfile = \"audit.jsonl\"\n";

/// A site that keeps its audit in a separate folder.
fn site(parts: &[&str]) -> Site {
    let line1 = LINE1.replace("name = \"test\"\n", "name = \"test\"\nstate_dir = \"state\"\n");
    Site::of(&[&[line1.as_str(), &controlled("pump", 1, ""), AUDIT], parts].concat())
}

/// Writes to unit 1 from an address that may not write, as fast as the gateway answers, until `stop`; counts the refusals.
fn flood(port: u16, stop: &AtomicBool, refused: &AtomicU64) {
    let socket = rustix::net::socket(rustix::net::AddressFamily::INET, rustix::net::SocketType::STREAM, None).unwrap();
    rustix::net::bind(&socket, &SocketAddr::from(([127, 0, 0, 9], 0))).unwrap();
    rustix::net::connect(&socket, &SocketAddr::from((Ipv4Addr::LOCALHOST, port))).unwrap();
    let mut stream = TcpStream::from(socket);
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let burst = [0, 1, 0, 0, 0, 6, 1, 6, 0x81, 0x00, 0, 1].repeat(50);
    let mut answers = [0; 9 * 50];
    while !stop.load(Ordering::Relaxed) {
        stream.write_all(&burst).unwrap();
        stream.read_exact(&mut answers).unwrap();
        assert!(answers.chunks(9).all(|answer| answer.ends_with(&[0x86, 1])));
        refused.fetch_add(50, Ordering::Relaxed);
    }
}

fn entries(site: &Site) -> Vec<Value> {
    let text = std::fs::read_to_string(site.file("state/audit.jsonl")).unwrap_or_default();
    let lines = text.split_inclusive('\n').filter(|line| line.ends_with('\n'));
    lines.map(|line| serde_json::from_str(line).unwrap()).collect()
}

fn verify(site: &Site, more: &[&str]) -> Output {
    let file = site.path("state/audit.jsonl");
    drivegate(&[&["audit", "verify", &file], more].concat())
        .output()
        .unwrap()
}

/// Sum of the records' counts.
fn sum<'r>(records: impl IntoIterator<Item = &'r Value>) -> u64 {
    records
        .into_iter()
        .map(|record| record["count"].as_u64().unwrap())
        .sum()
}

#[test]
fn a_client_that_may_not_write_destroys_nothing() {
    let site = site(&[MODBUS_TCP, HTTP, "[log]\nformat = \"json\"\n"]);
    let _line = site.line(&[1]);
    let mut gateway = site.run_ready();
    let (stop, refused) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
    let flooding = std::thread::spawn({
        let (port, stop, refused) = (site.modbus, stop.clone(), refused.clone());
        move || flood(port, &stop, &refused)
    });
    until("a flood", || (refused.load(Ordering::Relaxed) >= 5_000).then_some(()));
    let orders: Vec<u16> = (0..40).map(|n| 1000 + n).collect();
    orders
        .iter()
        .for_each(|value| write_registers(site.modbus, 1, SPEED_REFERENCE, &[*value]));
    stop.store(true, Ordering::Relaxed);
    flooding.join().unwrap();
    let flooded = refused.load(Ordering::Relaxed);

    let is_flood = |record: &&Value| {
        record["client"]
            .as_str()
            .is_some_and(|client| client.starts_with("127.0.0.9"))
    };
    let has_all = |records: &[Value]| {
        let wanted = |value: &u16| {
            let command = format!("speed_reference={}", f64::from(*value) / 100.0);
            records
                .iter()
                .filter(|r| r["command"] == command.as_str() && !is_flood(r))
                .count()
                >= 1
        };
        orders.iter().all(wanted) && sum(records.iter().filter(is_flood)) == flooded
    };
    until("all orders in the API", || has_all(&site.audit()).then_some(()));
    until("all orders in the file", || has_all(&entries(&site)).then_some(()));
    let lines = |text: &str| -> Vec<Value> {
        text.lines()
            .filter_map(|line| serde_json::from_str(line).ok())
            .collect()
    };
    let logged = until("all orders in the log", || {
        let mut audit = lines(&gateway.output());
        audit.retain(|line| line["target"] == "audit" && line.get("command").is_some());
        let count = |line: &mut Value| {
            let count = line.get("count").cloned().unwrap_or(1.into());
            line["count"] = count;
        };
        audit.iter_mut().for_each(count);
        has_all(&audit).then_some(audit)
    });
    assert!(
        logged.len() < 200,
        "{} audit lines for {flooded} refusals",
        logged.len()
    );
    let metrics = get(site.http, "/metrics").unwrap().1;
    assert!(
        metrics.contains("drivegate_audit_lost_total{kind=\"sent\"} 0"),
        "{metrics}"
    );

    gateway.signal("TERM");
    assert!(gateway.ended().success());
    let whole = verify(&site, &[]);
    assert!(whole.status.success(), "{whole:?}");
    let hash = gateway
        .until_printed("last line of the audit file")
        .lines()
        .rfind(|line| line.contains("last line of the audit file"))
        .map(|line| {
            let line: Value = serde_json::from_str(line).unwrap();
            line["hash"].as_str().unwrap().to_string()
        });
    let hash = hash.expect("the hash is logged at the end");
    assert!(String::from_utf8_lossy(&whole.stdout).contains(&hash), "{whole:?}");
    let path = site.file("state/audit.jsonl");
    let text = std::fs::read_to_string(&path).unwrap();
    let failing = |text: &str, more: &[&str], expected: &str| {
        std::fs::write(&path, text).unwrap();
        let output = verify(&site, more);
        let printed = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{output:?}");
        assert!(printed.contains(expected), "{printed}");
    };
    let lines: Vec<&str> = text.split_inclusive('\n').collect();
    let forged = lines[4].replace("127.0.0", "127.9.9");
    assert_ne!(forged, lines[4]);
    failing(
        &[&lines[..4], &[&forged], &lines[5..]].concat().concat(),
        &[],
        "audit.jsonl:5;",
    );
    failing(
        &[&lines[..4], &lines[7..]].concat().concat(),
        &[],
        "entries 5 to 7 before this line are missing",
    );
    let cut = lines[..lines.len() - 1].concat();
    failing(&cut, &["--last", &hash], "the end was cut");
    std::fs::write(&path, &cut).unwrap();
    assert!(
        verify(&site, &[]).status.success(),
        "a cut end does not show without the hash"
    );
    failing(&cut[..cut.len() - 9], &[], "the line is incomplete");
    // The gateway reports at its start what a crash left, and continues the chain.
    let mut again = site.run_ready();
    write_registers(site.modbus, 1, SPEED_REFERENCE, &[3000]);
    until("the order", || entries_after_crash(&site).then_some(()));
    again.signal("TERM");
    assert!(again.ended().success());
    let repaired = verify(&site, &[]);
    assert!(repaired.status.success(), "{repaired:?}");
}

fn entries_after_crash(site: &Site) -> bool {
    let text = std::fs::read_to_string(site.file("state/audit.jsonl")).unwrap();
    text.contains("\"entry\":\"fragment\"") && text.contains("speed_reference=30\"")
}

#[test]
fn a_missing_disk_delays_no_order_and_is_logged_once() {
    let site = site(&[MODBUS_TCP, HTTP, "[log]\nformat = \"json\"\n"]);
    site.write("state", "a file where the directory should be");
    let _line = site.line(&[1]);
    let gateway = site.run_ready();
    (0..5).for_each(|value| write_registers(site.modbus, 1, SPEED_REFERENCE, &[value]));
    gateway.until_printed("audit file: cannot write");
    std::fs::remove_file(site.file("state")).unwrap();
    gateway.until_printed("audit file: writing to ");
    until("all orders in the file", || (entries(&site).len() >= 5).then_some(()));
    assert_eq!(gateway.output().matches("audit file: cannot write").count(), 1);
    assert!(verify(&site, &[]).status.success());
}

fn is_plain(text: &str) -> bool {
    !text.contains(|c: char| (c.is_control() && c != '\n' && c != '\t') || ('\u{202a}'..='\u{202e}').contains(&c))
}

#[test]
fn text_from_outside_forges_no_line_and_commands_no_terminal() {
    for format in ["json", "text", "journal"] {
        let log = format!("[log]\nformat = \"{format}\"\nlevel = \"info\"\n");
        let site = site(&[MQTT, MODBUS_TCP, HTTP, &log]);
        site.change("profile = \"vacon-nx\"", "profile = \"evil\"");
        let evil = "base = \"vacon-nx\"\nname = \"evil\"\ntitle = \"x\\u001b[2J\\u202e\\nerror: forged\"\n";
        site.write("evil.toml", evil);
        let _line = site.line(&[1]);
        let _broker = site.broker();
        let gateway: Running = site.run_ready();
        site.until_connected(true);
        let forged = "\n<3>forged: nothing\u{1b}[2J\u{9b}31m\u{202e}";
        let payload = serde_json::json!({format!("speed_reference{forged}"): 5}).to_string();
        site.publish(&["-t", "drivegate/test/drive/pump/set", "-m", &payload]);
        let topic = "drivegate/test/drive/nobody\u{202e}/set";
        site.publish(&["-t", topic, "-m", &payload]);
        let output = gateway.until_printed("unknown_drive");
        gateway.until_printed("not_writable");
        assert!(is_plain(&output), "{output:?}");
        assert!(!output.lines().any(|line| line.starts_with("<3>forged")), "{output}");
        let (config, url) = (site.config(), format!("http://127.0.0.1:{}", site.http));
        for arguments in [
            &["watch", "--once", "--url", &url][..],
            &["profiles", "--config", &config],
            &["profiles", "show", "evil", "--config", &config],
            &["profiles", "show", "evil", "--toml", "--config", &config],
            &["map", "--config", &config],
            &["check", "--config", &config],
            &["read", "--config", &config, "pump"],
            &["write", "--config", &config, "pump", &format!("speed{forged}=5")],
        ] {
            let output = drivegate(arguments).output().unwrap();
            let printed = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
            assert!(!printed.is_empty() && is_plain(&printed), "{arguments:?}: {printed:?}");
            assert!(
                !printed.lines().any(|line| line.starts_with("error: forged")),
                "{arguments:?}: {printed}"
            );
        }
        let trace = drivegate(&["trace", "--url", &url, "--count", "3"]).output().unwrap();
        assert!(is_plain(&String::from_utf8_lossy(&trace.stdout)), "{trace:?}");
    }
}
