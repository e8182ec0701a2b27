//! The audit: commands and their results, in the log, in memory and, if configured, in a file.
//!
//! Commands that were sent to a drive have separate memory and queues everywhere, so nothing else can displace
//! them. Refusals are limited per client.

pub mod chain;
mod file;

use std::borrow::Cow;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use arc_swap::ArcSwapOption;
use serde::{Deserialize, Serialize, Serializer};
use tokio::sync::broadcast;

use crate::event::{FairRing, RefusalLimit, in_order};
use drivegate_model::drive::Value;
use drivegate_model::drive::why::Fate;

pub use file::{AuditFile, AuditFileOptions};

/// Records of commands that were sent to a drive, kept in memory.
pub const AUDIT_KEPT: usize = 1000;
/// Records of commands that were not sent, kept in addition.
const UNSENT_KEPT: usize = 500;
/// Name of the log events for commands that were sent: the log treats them separately.
pub const SENT: &str = "sent command";

/// A point that a command sets, with its values.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
#[schema(as = AuditChange)]
pub struct Change {
    /// Point, or table and address of a raw write.
    pub point: String,
    /// The last good value before, if there was one.
    #[serde(serialize_with = "bare_or_null")]
    #[schema(value_type = serde_json::Value)]
    pub old: Option<Value>,
    /// The requested value.
    #[serde(serialize_with = "bare")]
    #[schema(value_type = serde_json::Value)]
    pub new: Value,
    /// Effect on the run command: run or stop, if any.
    #[serde(skip)]
    pub run: Option<bool>,
    /// Whether the value is a fault reset.
    #[serde(skip)]
    pub resets: bool,
}

/// A command and its result.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
pub struct AuditRecord {
    /// When the outcome was known.
    #[serde(serialize_with = "crate::event::rfc3339")]
    #[schema(value_type = String)]
    pub time: SystemTime,
    /// Kind of the source.
    pub source: &'static str,
    /// Address, name in the certificate, or topic.
    pub client: String,
    /// Name of the drive.
    pub drive: String,
    /// The command as one line of text.
    pub command: String,
    /// The points that the command sets, with their previous values; empty if it was refused before it was parsed.
    pub points: Vec<Change>,
    /// Result code; `confirmed` is an acknowledged command whose effect was read back.
    pub result: &'static str,
    /// The outcome of the command as text.
    pub text: String,
    /// Time from acceptance to result.
    #[serde(rename = "latency_ms", serialize_with = "milliseconds")]
    #[schema(value_type = f64)]
    pub latency: Duration,
    /// Time from acceptance to the read that showed the effect, ms.
    #[serde(rename = "confirmed_ms", serialize_with = "milliseconds_or_null")]
    #[schema(value_type = Option<f64>)]
    pub confirmed: Option<Duration>,
    /// Number of commands covered: refusals of one client are counted.
    pub count: u64,
    /// The name under which the client shares limits with others; see [`super::Origin::client`].
    #[serde(skip)]
    pub(super) share: Arc<str>,
    /// What became of the command.
    #[serde(skip)]
    pub(crate) fate: Fate,
}

fn bare<S: Serializer>(value: &Value, serializer: S) -> Result<S::Ok, S::Error> {
    crate::process_image::value_or_null(Some(*value)).serialize(serializer)
}

fn bare_or_null<S: Serializer>(value: &Option<Value>, serializer: S) -> Result<S::Ok, S::Error> {
    crate::process_image::value_or_null(*value).serialize(serializer)
}

/// Serializes a time as milliseconds with three decimals.
pub fn milliseconds<S: Serializer>(time: &Duration, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_f64((time.as_secs_f64() * 1e6).round() / 1e3)
}

/// Writes a time in milliseconds, `null` without a time.
pub fn milliseconds_or_null<S: Serializer>(time: &Option<Duration>, serializer: S) -> Result<S::Ok, S::Error> {
    match time {
        Some(time) => milliseconds(time, serializer),
        None => serializer.serialize_none(),
    }
}

/// How far a command got towards the drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Reach {
    /// The command was sent to the drive, or started.
    Sent,
    /// The command was in the queue and was not sent.
    Queued,
    /// The command was refused.
    Refused,
}

impl AuditRecord {
    /// Effect on the run command: run or stop, if any.
    pub(crate) fn run(&self) -> Option<bool> {
        self.points.iter().rev().find_map(|change| change.run)
    }

    /// Whether the command resets a fault.
    pub(crate) fn resets(&self) -> bool {
        self.points.iter().any(|change| change.resets)
    }

    /// Writes the record to the log under target `audit`, as one structured line.
    fn log(&self, sent: bool) {
        let points: Vec<String> = self
            .points
            .iter()
            .map(|c| match c.old {
                Some(old) => format!("{}:{old}->{}", c.point, c.new),
                None => format!("{}:?->{}", c.point, c.new),
            })
            .collect();
        macro_rules! line {
            ($name:expr) => {
                tracing::info!(
                    name: $name,
                    target: "audit",
                    source = self.source,
                    client = %self.client,
                    drive = %self.drive,
                    command = %self.command,
                    points = %points.join(" "),
                    result = self.result,
                    latency_us = self.latency.as_micros() as u64,
                    confirmed_us = self.confirmed.map(|c| c.as_micros() as u64),
                    count = (self.count > 1).then_some(self.count),
                    "{}", self.text
                )
            };
        }
        if sent { line!(SENT) } else { line!("unsent command") }
    }
}

/// The audit: the latest records, and where new ones go.
#[derive(Debug, Default)]
pub struct Audit {
    records: Mutex<Records>,
    file: ArcSwapOption<AuditFile>,
    /// Sends each new record to subscribers.
    sender: OnceLock<broadcast::Sender<Arc<AuditRecord>>>,
}

/// A command to run or to stop that was sent to a drive.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunOrdered {
    /// Whether the order was to run; otherwise to stop.
    pub run: bool,
    /// Source and client of the order, as text.
    pub who: String,
    /// When the result of the order arrived, or the wait was given up.
    pub at: Instant,
}

/// Number of records by which a listener may lag behind.
const IN_FLIGHT: usize = 4096;

#[derive(Debug)]
struct Records {
    number: u64,
    /// Lines of JSON: a record that is kept takes one block of memory instead of eight, between which holes would stay.
    sent: FairRing<Arc<str>, Arc<str>>,
    unsent: FairRing<Arc<str>, Arc<str>>,
    /// For each drive, the last command that concerns its run command or reset its fault, and when the command
    /// ended. As many entries as drives.
    runs: HashMap<String, (Arc<AuditRecord>, Instant)>,
    /// For each drive, the last order to run or to stop that was sent. At most as many entries as drives.
    ordered: HashMap<String, RunOrdered>,
    refusals: RefusalLimit<AuditRecord>,
}

impl Default for Records {
    fn default() -> Records {
        Records {
            number: 0,
            sent: FairRing::new(AUDIT_KEPT),
            unsent: FairRing::new(UNSENT_KEPT),
            runs: HashMap::new(),
            ordered: HashMap::new(),
            refusals: RefusalLimit::default(),
        }
    }
}

impl Audit {
    fn records(&self) -> MutexGuard<'_, Records> {
        self.records.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Also writes the records to `file` from now on; with `None` to no file.
    pub fn write_to(&self, file: Option<Arc<AuditFile>>) {
        self.file.store(file);
    }

    /// The audit file, if there is one.
    pub fn file(&self) -> Option<Arc<AuditFile>> {
        self.file.load_full()
    }

    /// Receives all records from now on. A listener that lags more than 4,096 records behind loses the oldest ones.
    pub fn subscribe(&self) -> broadcast::Receiver<Arc<AuditRecord>> {
        self.sender.get_or_init(|| broadcast::channel(IN_FLIGHT).0).subscribe()
    }

    /// Adds the record of a command that ended at `now`. After the first refusal of a kind, further refusals of one
    /// client are counted, and reported within about a second ([`Audit::record_due`]).
    pub(super) fn record(&self, record: AuditRecord, reach: Reach, now: Instant) {
        let mut records = self.records();
        if reach != Reach::Refused {
            return self.keep(&mut records, record, reach == Reach::Sent, now);
        }
        // Names of drives that do not exist are invented by the client.
        let drive = (record.result != super::Refusal::UNKNOWN_DRIVE).then(|| record.drive.clone());
        let (share, result) = (record.share.clone(), record.result);
        let passed = records.refusals.admit(&share, result, drive.as_deref(), record, now);
        passed
            .into_iter()
            .for_each(|passed| self.keep_counted(&mut records, passed, now));
    }

    /// Records an act of a client on a drive that was no command, with the result of the act.
    pub fn note(
        &self,
        who: &super::Origin,
        (drive, what): (&str, &str),
        (result, text): (&'static str, &str),
        now: Instant,
    ) {
        let record = AuditRecord {
            time: SystemTime::now(),
            source: who.kind.name(),
            client: who.who.clone(),
            drive: drive.to_string(),
            command: what.to_string(),
            points: Vec::new(),
            result,
            text: text.to_string(),
            latency: Duration::ZERO,
            confirmed: None,
            count: 1,
            share: who.client().clone(),
            fate: Fate::Taken,
        };
        self.record(record, Reach::Sent, now);
    }

    /// Records the refusals that waited long enough for their count.
    pub(crate) fn record_due(&self, now: Instant) {
        let mut records = self.records();
        let due = records.refusals.due(now);
        due.into_iter()
            .for_each(|passed| self.keep_counted(&mut records, passed, now));
    }

    fn keep_counted(&self, records: &mut Records, (mut record, count): (AuditRecord, u64), now: Instant) {
        record.count = count;
        if count > 1 {
            record.text = format!("{} ({count} commands of this client were refused)", record.text);
        }
        self.keep(records, record, false, now);
    }

    fn keep(&self, records: &mut Records, record: AuditRecord, sent: bool, now: Instant) {
        record.log(sent);
        let record = Arc::new(record);
        let concerns_run = record.run().is_some() || (sent && record.resets());
        if concerns_run && record.result != super::Refusal::UNKNOWN_DRIVE {
            records.runs.insert(record.drive.clone(), (record.clone(), now));
        }
        records.number += 1;
        let number = records.number;
        let ring = if sent { &mut records.sent } else { &mut records.unsent };
        // A time before 1970 or after 9999 cannot be written as a line.
        if let Ok(line) = serde_json::to_string(&*record) {
            ring.push(record.share.clone(), number, line.into());
        }
        if let Some(sender) = self.sender.get() {
            // The last listener may have disconnected, so an error is ignored.
            let _ = sender.send(record.clone());
        }
        if let Some(file) = &*self.file.load() {
            file.push(record, sent);
        }
    }

    /// Notes a command that was sent to a drive, before it is known whether the drive carries it out.
    pub(super) fn ordered(&self, drive: &str, ordered: RunOrdered) {
        self.records().ordered.insert(drive.to_string(), ordered);
    }

    /// The last order to run or to stop that was sent to a drive.
    pub fn last_ordered(&self, drive: &str) -> Option<RunOrdered> {
        self.records().ordered.get(drive).cloned()
    }

    /// The last command to this drive that concerns its run command or was sent to reset its fault, and when it ended.
    pub(crate) fn last_run(&self, drive: &str) -> Option<(Arc<AuditRecord>, Instant)> {
        self.records().runs.get(drive).cloned()
    }

    /// Forgets the last orders of all names for which `is_same` does not hold: after a reload these names belong to
    /// other drives.
    pub fn keep_orders_of(&self, is_same: impl Fn(&str) -> bool) {
        let records = &mut *self.records();
        records.runs.retain(|drive, _| is_same(drive));
        records.ordered.retain(|drive, _| is_same(drive));
    }

    /// All kept records, oldest first, each as JSON; with `drive` only those of that drive.
    pub fn recent(&self, drive: Option<&str>) -> Vec<Arc<str>> {
        #[derive(Deserialize)]
        struct Addressed<'l> {
            #[serde(borrow)]
            drive: Cow<'l, str>,
        }
        let is_of = |line: &str, drive| serde_json::from_str(line).is_ok_and(|line: Addressed<'_>| line.drive == drive);
        let all = {
            let records = self.records();
            in_order(&records.sent, &records.unsent)
        };
        let lines = all.into_iter().map(|(_, line)| line);
        lines
            .filter(|line| drive.is_none_or(|drive| is_of(line, drive)))
            .collect()
    }

    /// All kept records, oldest first.
    #[cfg(test)]
    pub(crate) fn parsed(&self) -> Vec<serde_json::Value> {
        let lines = self.recent(None);
        lines
            .iter()
            .map(|line| serde_json::from_str(line).expect("JSON"))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(super) fn record(share: &str, command: usize) -> AuditRecord {
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
                run: Some(true),
                resets: false,
            }],
            result: "acknowledged",
            text: String::new(),
            latency: Duration::from_micros(1500),
            confirmed: None,
            count: 1,
            share: share.into(),
            fate: Fate::Taken,
        }
    }

    #[test]
    fn nothing_that_was_not_sent_pushes_out_what_was() {
        let (audit, now) = (Audit::default(), Instant::now());
        for i in 0..AUDIT_KEPT {
            audit.record(record("operator", i), Reach::Sent, now);
        }
        for i in 0..50_000 {
            audit.record(
                record("flood", i),
                Reach::Refused,
                now + Duration::from_millis(i as u64),
            );
            audit.record(record("flood", i), Reach::Queued, now);
        }
        let kept = audit.parsed();
        assert_eq!(kept.len(), AUDIT_KEPT + UNSENT_KEPT);
        assert_eq!(kept.iter().filter(|r| r["client"] == "operator").count(), AUDIT_KEPT);
        assert_eq!(kept.last().unwrap()["command"], "49999", "the newest comes last");
    }

    #[test]
    fn refusals_are_counted_and_none_is_lost() {
        let (audit, now) = (Audit::default(), Instant::now());
        for i in 0..1000 {
            audit.record(record("a", i), Reach::Refused, now);
            let unknown = AuditRecord {
                result: "unknown_drive",
                drive: format!("invented-{i}"),
                ..record("b", i)
            };
            audit.record(unknown, Reach::Refused, now);
        }
        assert_eq!(audit.recent(None).len(), 2, "the first of a kind");
        assert_eq!(audit.recent(Some("invented-0")).len(), 1);
        audit.record_due(now + Duration::from_secs(1));
        let kept = audit.parsed();
        let counts = |kept: &[serde_json::Value]| kept.iter().filter_map(|r| r["count"].as_u64()).collect::<Vec<_>>();
        assert_eq!(counts(&kept), [1, 1, 999, 999]);
        assert_eq!(kept[2]["command"], "999", "the last of them is shown");
        let text = kept[2]["text"].as_str().unwrap();
        assert!(text.contains("999 commands of this client were refused"));
        audit.record(record("a", 7), Reach::Refused, now + Duration::from_secs(1));
        audit.record_due(now + Duration::from_secs(2));
        assert_eq!(counts(&audit.parsed()).iter().sum::<u64>(), 2001);
    }

    #[test]
    fn the_shape_that_clients_see() {
        let json = serde_json::to_value(record("t", 7)).unwrap();
        assert_eq!(
            json["points"][0],
            serde_json::json!({"point": "run", "old": null, "new": true})
        );
        assert_eq!(
            (&json["latency_ms"], &json["confirmed_ms"], &json["count"]),
            (&1.5.into(), &serde_json::Value::Null, &1.into())
        );
        assert_eq!(json["time"], "1970-01-01T00:00:00.000Z");
        assert!(json.get("share").is_none());
    }
}
