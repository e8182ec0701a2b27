//! Commands of another master: reported when they change, so that a master that writes equal words in every cycle
//! fills neither audit nor log. Commands that switch something are reported at once, references at most once a
//! second, the last one in any case. Pure: time is an argument.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::decoder::Exchange;
use crate::transaction::Ended;
use drivegate_core::order::{Change, Outcome, written};
use drivegate_core::process_image::DriveSpec;
use drivegate_model::drive::ModelPoint;
use drivegate_model::drive::model::Kind;
use drivegate_proto::{Protocol, Reply, RequestPdu, Table, describe};

/// Shortest time between two reported references of a drive.
const PAUSE: Duration = Duration::from_secs(1);
/// Registers of one drive whose last written values are known.
const KEPT: usize = 256;

/// A command of the other master that must be reported.
#[derive(Debug, Clone, PartialEq)]
pub struct Commanded {
    /// The command as one line of text.
    pub what: String,
    /// The values that the command changes.
    pub changes: Vec<Change>,
    /// The outcome of the command.
    pub outcome: Outcome,
    /// When the request of the command began on the line.
    pub began: Instant,
    /// When the outcome of the command was known.
    pub at: Instant,
}

/// The other master's writes to one drive.
#[derive(Debug, Default)]
pub struct Commands {
    words: BTreeMap<(Table, u16), u16>,
    /// Code of the last reported outcome.
    outcome: Option<&'static str>,
    told: Option<Instant>,
    waiting: Option<Commanded>,
}

impl Commands {
    /// Processes a write that was received in this exchange; returns the commands to report now.
    pub fn process_write(
        &mut self,
        spec: &DriveSpec,
        protocol: Protocol,
        pdu: &RequestPdu,
        exchange: &Exchange,
    ) -> Option<Commanded> {
        let (began, at) = (exchange.began, exchange.at);
        let outcome = outcome(exchange.ended.as_ref());
        let (table, items) = items(pdu);
        let is_new = |(address, word): &&(u16, u16)| self.words.get(&(table, *address)) != Some(word);
        let fresh: Vec<u16> = items.iter().filter(is_new).map(|(address, _)| *address).collect();
        let is_repeated = fresh.is_empty() && !items.is_empty() && self.outcome == Some(outcome.code());
        if is_repeated {
            return None;
        }
        let (changes, switches) = self.changes(spec, table, &items, &fresh);
        self.outcome = Some(outcome.code());
        for (address, word) in items {
            if self.words.len() < KEPT || self.words.contains_key(&(table, address)) {
                self.words.insert((table, address), word);
            }
        }
        let what = if changes.is_empty() {
            describe::request_on(protocol, pdu)
        } else {
            let one = |change: &Change| format!("{}={}", change.point, change.new);
            changes.iter().map(one).collect::<Vec<_>>().join(" ")
        };
        let commanded = Commanded {
            what,
            changes,
            outcome,
            began,
            at,
        };
        if switches || self.told.is_none_or(|told| at >= told + PAUSE) {
            self.told = Some(at);
            self.waiting = None;
            return Some(commanded);
        }
        self.waiting = Some(commanded);
        None
    }

    /// The pending report, if its time has come.
    pub fn due(&mut self, now: Instant) -> Option<Commanded> {
        let told = self.told.filter(|told| now >= *told + PAUSE)?;
        let waiting = self.waiting.take()?;
        self.told = Some(now.max(told));
        Some(waiting)
    }

    /// When the next report is due.
    pub(crate) fn due_at(&self) -> Option<Instant> {
        self.waiting.as_ref().and(self.told).map(|told| told + PAUSE)
    }

    /// The points that a write changes, and whether it switches something on or off.
    fn changes(&self, spec: &DriveSpec, table: Table, items: &[(u16, u16)], fresh: &[u16]) -> (Vec<Change>, bool) {
        let (mut changes, mut switches) = (Vec::new(), false);
        let written = spec.profile.points.iter().filter(|point| point.write);
        let is = |of: ModelPoint, name: &str| spec.profile.model_point(of).is_some_and(|point| point.name == name);
        for (point, raw) in written.filter_map(|point| Some((point, point.raw()?))) {
            let words = |of: &dyn Fn(u16) -> Option<u16>| raw.addresses().map(of).collect::<Option<Vec<u16>>>();
            let of_write = |address| items.iter().find(|(at, _)| *at == address).map(|(_, word)| *word);
            let touched = raw.table == spec.profile.canonical(table) && raw.addresses().any(|at| fresh.contains(&at));
            let Some(new) = words(&of_write)
                .filter(|_| touched)
                .and_then(|words| raw.decode(&words, point.kind()))
            else {
                continue;
            };
            let of_last = |address| self.words.get(&(table, address)).copied();
            let old = words(&of_last).and_then(|words| raw.decode(&words, point.kind()));
            if old != Some(new) {
                switches |= point.kind() == Kind::Bool;
                let run = is(ModelPoint::Run, &point.name).then(|| new.as_bool());
                let resets = is(ModelPoint::FaultReset, &point.name) && new.as_bool();
                let point = point.name.clone();
                changes.push(Change {
                    point,
                    old,
                    new,
                    run,
                    resets,
                });
            }
        }
        (changes, switches)
    }
}

fn outcome(ended: Option<&Ended>) -> Outcome {
    match ended {
        Some(Ended::Reply(Reply::Exception(code))) => Outcome::of_exception(*code),
        Some(Ended::Reply(reply)) => Outcome::Acknowledged(reply.clone()),
        Some(Ended::Corrupt(_)) => Outcome::Garbled,
        // A broadcast has no reply.
        Some(Ended::Silent) | None => Outcome::TimedOut,
    }
}

/// The registers or coils that a write sets; empty if that depends on the values in the drive.
fn items(pdu: &RequestPdu) -> (Table, Vec<(u16, u16)>) {
    match pdu {
        RequestPdu::ReadWrite {
            write_start, values, ..
        } => {
            let start = *write_start;
            let pdu = RequestPdu::WriteRegisters {
                start,
                values: values.clone(),
            };
            written(&pdu).unwrap_or((Table::Holding, Vec::new()))
        }
        _ => written(pdu).unwrap_or((Table::Holding, Vec::new())),
    }
}
