//! What was commanded: one record a command, the last 1,000 kept.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, SystemTime};

use serde::{Serialize, Serializer};
use tokio::sync::broadcast;

use crate::drive::Value;

/// Records kept.
pub const AUDIT_KEPT: usize = 1000;
/// Records that one client may have among them once there are that many: a flood pushes out its own.
pub const AUDIT_SHARE: usize = AUDIT_KEPT / 2;

/// One value that a command sets.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Change {
    /// Point, or table and address of a raw write.
    pub point: String,
    /// The last good value before, if there was one.
    #[serde(serialize_with = "bare_or_null")]
    pub old: Option<Value>,
    /// The value asked for.
    #[serde(serialize_with = "bare")]
    pub new: Value,
}

/// One command and what became of it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AuditRecord {
    /// When the outcome was known.
    #[serde(serialize_with = "crate::event::rfc3339")]
    pub time: SystemTime,
    /// Kind of the source.
    pub source: &'static str,
    /// Address, name in the certificate, or topic.
    pub client: String,
    /// Drive.
    pub drive: String,
    /// The command in one line.
    pub command: String,
    /// What it sets, with the values before; empty when it was refused before it was understood.
    pub points: Vec<Change>,
    /// Result code; `confirmed` is an acknowledged command whose effect was read back.
    pub result: &'static str,
    /// The outcome for people.
    pub text: String,
    /// From acceptance to answer, ms.
    #[serde(rename = "latency_ms", serialize_with = "milliseconds")]
    pub latency: Duration,
    /// From acceptance to the read that showed the effect, ms.
    #[serde(rename = "confirmed_ms", serialize_with = "milliseconds_or_null")]
    pub confirmed: Option<Duration>,
    /// The client among others: see [`super::Origin::client`].
    #[serde(skip)]
    pub(super) share: Arc<str>,
}

fn bare<S: Serializer>(value: &Value, serializer: S) -> Result<S::Ok, S::Error> {
    crate::process_image::value_or_null(Some(*value)).serialize(serializer)
}

fn bare_or_null<S: Serializer>(value: &Option<Value>, serializer: S) -> Result<S::Ok, S::Error> {
    crate::process_image::value_or_null(*value).serialize(serializer)
}

fn milliseconds<S: Serializer>(time: &Duration, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_f64((time.as_secs_f64() * 1e6).round() / 1e3)
}

fn milliseconds_or_null<S: Serializer>(time: &Option<Duration>, serializer: S) -> Result<S::Ok, S::Error> {
    match time {
        Some(time) => milliseconds(time, serializer),
        None => serializer.serialize_none(),
    }
}

impl AuditRecord {
    /// Writes it to the log under target `audit`, one structured line.
    pub(super) fn log(&self) {
        let points: Vec<String> = self
            .points
            .iter()
            .map(|c| match c.old {
                Some(old) => format!("{}:{old}->{}", c.point, c.new),
                None => format!("{}:?->{}", c.point, c.new),
            })
            .collect();
        tracing::info!(
            target: "audit",
            source = self.source,
            client = %self.client,
            drive = %self.drive,
            command = %self.command,
            points = %points.join(" "),
            result = self.result,
            latency_us = self.latency.as_micros() as u64,
            confirmed_us = self.confirmed.map(|c| c.as_micros() as u64),
            "{}", self.text
        );
    }
}

/// The last records.
#[derive(Debug, Default)]
pub struct Audit {
    kept: Mutex<VecDeque<Arc<AuditRecord>>>,
    /// For whoever wants each record as it comes.
    sender: OnceLock<broadcast::Sender<Arc<AuditRecord>>>,
}

/// Records that a listener may be behind.
const IN_FLIGHT: usize = 4096;

impl Audit {
    /// Keeps a record. When 1,000 are kept, it takes the place of the oldest of its own client if that has half of
    /// them, else of the oldest of the client that has most.
    pub(super) fn keep(&self, record: AuditRecord) {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        if kept.len() >= AUDIT_KEPT {
            let own = kept.iter().filter(|r| r.share == record.share).count();
            let from = if own >= AUDIT_SHARE {
                Some(record.share.clone())
            } else {
                largest_share(&kept)
            };
            let oldest = kept.iter().position(|r| Some(&r.share) == from.as_ref());
            kept.remove(oldest.unwrap_or(0));
        }
        let record = Arc::new(record);
        kept.push_back(record.clone());
        if let Some(sender) = self.sender.get() {
            // The last listener may have gone.
            let _ = sender.send(record);
        }
    }

    /// Hears all records from now on; a listener that is 4,096 behind loses the oldest.
    pub fn subscribe(&self) -> broadcast::Receiver<Arc<AuditRecord>> {
        self.sender.get_or_init(|| broadcast::channel(IN_FLIGHT).0).subscribe()
    }

    /// All that are kept, oldest first.
    pub fn recent(&self) -> Vec<Arc<AuditRecord>> {
        self.kept
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .iter()
            .cloned()
            .collect()
    }
}

/// The client that has most of the records.
fn largest_share(kept: &VecDeque<Arc<AuditRecord>>) -> Option<Arc<str>> {
    let mut shares: BTreeMap<&Arc<str>, usize> = BTreeMap::new();
    for record in kept {
        *shares.entry(&record.share).or_default() += 1;
    }
    let largest = shares.into_iter().max_by_key(|(_, records)| *records);
    largest.map(|(share, _)| share.clone())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(share: &str, command: usize) -> AuditRecord {
        AuditRecord {
            time: SystemTime::UNIX_EPOCH,
            source: "mqtt",
            client: share.to_string(),
            drive: "d".to_string(),
            command: command.to_string(),
            points: vec![Change {
                point: "run".to_string(),
                old: None,
                new: Value::Bool(true),
            }],
            result: "acknowledged",
            text: String::new(),
            latency: Duration::from_micros(1500),
            confirmed: None,
            share: share.into(),
        }
    }

    #[test]
    fn a_flood_pushes_out_its_own() {
        let audit = Audit::default();
        for i in 0..AUDIT_SHARE {
            audit.keep(record("quiet", i));
        }
        for i in 0..10_000 {
            audit.keep(record("flood", i));
        }
        let kept = audit.recent();
        assert_eq!(kept.len(), AUDIT_KEPT);
        assert_eq!(kept.iter().filter(|r| r.client == "quiet").count(), AUDIT_SHARE);
        assert_eq!(kept.last().unwrap().command, "9999", "the newest comes last");
    }

    #[test]
    fn a_quiet_client_among_a_flood_loses_nothing() {
        let audit = Audit::default();
        for i in 0..20_000 {
            audit.keep(record("flood", i));
            if i % 1000 == 0 {
                audit.keep(record("quiet", i));
            }
        }
        let quiet = audit.recent().iter().filter(|r| r.client == "quiet").count();
        assert_eq!(quiet, 20);
    }

    #[test]
    fn the_shape_that_clients_see() {
        let json = serde_json::to_value(record("t", 7)).unwrap();
        assert_eq!(
            json["points"][0],
            serde_json::json!({"point": "run", "old": null, "new": true})
        );
        assert_eq!(
            (&json["latency_ms"], &json["confirmed_ms"]),
            (&1.5.into(), &serde_json::Value::Null)
        );
        assert_eq!(json["time"], "1970-01-01T00:00:00.000Z");
        assert!(json.get("share").is_none());
    }
}
