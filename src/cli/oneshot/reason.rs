//! Why a running gateway refused a write, in its own words: an exception of Modbus TCP tells the kind of reason only, the
//! audit has the text.

use std::time::{Duration, SystemTime};

use serde::Deserialize;

use super::Target;
use super::remote::{Remote, reachable};
use crate::cli::client::{Url, get_json};
use crate::cli::read::runtime;
use crate::codec::Reply;
use crate::command::{CONFIRMED, Outcome, SourceKind};

/// Time for the audit to come; the refusal is told without it otherwise.
const PATIENCE: Duration = Duration::from_secs(2);
/// The record of an answer is kept a moment after the answer was given.
const TRIES: u32 = 3;
const PAUSE: Duration = Duration::from_millis(50);
/// The audit tells times in milliseconds, and clocks are corrected.
const SLACK: Duration = Duration::from_secs(1);

/// What is looked at in a record of the audit (`docs/http.md`).
#[derive(Debug, Deserialize)]
struct Record {
    time: String,
    source: String,
    client: String,
    drive: String,
    result: String,
    text: String,
}

/// The reason and the result code of the write that was refused on this connection; `None` when the gateway serves no HTTP or its audit
/// does not have it.
pub(in crate::cli) fn exact(target: &Target, remote: &Remote) -> Option<String> {
    let http = target.settings.http.as_ref()?;
    let url: Url = format!("http://{}", reachable(http.listen)).parse().ok()?;
    let client = remote.client()?.to_string();
    let asked = async {
        for _ in 0..TRIES {
            let audit = get_json(&url, "/api/v1/audit").await.ok()?;
            if let Some(record) = own(audit, &client, &target.spec.name, remote.since()) {
                return Some(record);
            }
            tokio::time::sleep(PAUSE).await;
        }
        None
    };
    let record = runtime()
        .ok()?
        .block_on(async { tokio::time::timeout(PATIENCE, asked).await.ok()? })?;
    Some(format!("{} ({})", record.text, record.result))
}

/// The record of the one write that was refused on the connection of `client`, open `since`: nothing was sent behind
/// it, and nobody else had that port in the meantime. Older records may be of others who had it before.
fn own(audit: serde_json::Value, client: &str, drive: &str, since: SystemTime) -> Option<Record> {
    let records: Vec<Record> = serde_json::from_value(audit).ok()?;
    let done = [Outcome::Acknowledged(Reply::Written).code(), CONFIRMED];
    let earliest = since.checked_sub(SLACK)?;
    let is_own = |record: &Record| {
        record.source == SourceKind::ModbusTcp.name()
            && record.client == client
            && record.drive == drive
            && !done.contains(&record.result.as_str())
            && humantime::parse_rfc3339(&record.time).is_ok_and(|time| time >= earliest)
    };
    records.into_iter().rev().find(is_own)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn only_its_own_record_is_believed() {
        let since = humantime::parse_rfc3339("2026-03-02T06:11:09.480Z").unwrap();
        let record = |time: &str, client: &str, drive: &str, result: &str| {
            json!({"time": format!("2026-03-02T06:11:{time}Z"), "source": "modbus_tcp", "client": client, "drive": drive,
                   "command": "run=true", "points": [], "result": result, "text": "because", "latency_ms": 1.0,
                   "confirmed_ms": null})
        };
        let (own_port, other_port) = ("127.0.0.1:40000", "127.0.0.1:40001");
        let others = [
            record("08.000", own_port, "pump-1", "not_allowed"),
            record("10.000", other_port, "pump-1", "not_allowed"),
            record("10.000", own_port, "pump-2", "not_allowed"),
            record("10.000", own_port, "pump-1", "acknowledged"),
            record("10.000", own_port, "pump-1", "confirmed"),
        ];
        let found = |audit: serde_json::Value| own(audit, own_port, "pump-1", since).map(|record| record.result);
        assert_eq!(found(json!(others)), None);
        for at in 0..=others.len() {
            let mut audit = others.to_vec();
            audit.insert(at, record("09.479", own_port, "pump-1", "bad_value"));
            assert_eq!(found(json!(audit)).as_deref(), Some("bad_value"), "{at}");
        }
        let mut by_mqtt = record("10.000", own_port, "pump-1", "bad_value");
        by_mqtt["source"] = "mqtt".into();
        for strange in [
            json!([by_mqtt]),
            json!([{"time": 5}]),
            json!({"error": "no"}),
            json!(null),
        ] {
            assert_eq!(found(strange), None);
        }
    }
}
