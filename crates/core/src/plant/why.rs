//! Collects the state of a drive apart from its points, to explain why it does not run.

use std::time::Duration;

use crate::order::{AuditRecord, CommandLog, Guarded, Origin, Reason, SourceKind};
use crate::process_image::{Access, BusImage, Link, Reading, RestoreLock};
use drivegate_model::drive::why::{self, Cause, Contact, Explanation, Giver, RunOrder, RunWish, Situation};

/// Whether the drive of `reading`, on this bus, runs, and if not, why.
pub fn explain(reading: &Reading<'_>, bus: &BusImage, command_log: &CommandLog) -> Explanation {
    let spec = reading.spec;
    let order = || {
        let (record, ended) = command_log.audit().last_run(&spec.name)?;
        run_order(&record, reading.now.saturating_duration_since(ended))
    };
    let situation = Situation {
        now: reading.now,
        contact: contact(reading, bus),
        read_at: reading.snapshot.fast_at,
        is_commandable: spec.access == Access::Control,
        held: reading
            .restore_lock
            .and_then(RestoreLock::reason)
            .map(|why| why.to_string()),
        order: &order,
    };
    why::explain(&spec.profile, &|point| reading.sample(point), &situation)
}

/// Converts a guard's reason against a start into a cause.
pub(super) fn guarded(hindrance: &Guarded) -> Cause {
    let (cause, remedy) = match hindrance.reason {
        Reason::Interlock => ("interlocked", "satisfy the interlock, then send run again"),
        _ => ("guarded", "send run again at that time, or with `\"wait\": true`"),
    };
    Cause {
        cause: cause.to_string(),
        evidence: hindrance.why.clone(),
        remedy: remedy.to_string(),
        retry_after_ms: Some(hindrance.retry_after_ms()),
        ..Cause::default()
    }
}

fn contact(reading: &Reading<'_>, bus: &BusImage) -> Contact {
    match reading.snapshot.link {
        _ if !bus.is_up() => Contact::BusDown(bus.health().reason),
        Link::Untried => Contact::Untried,
        Link::Offline(_) => Contact::Silent,
        Link::Online(_) if reading.is_stale() => Contact::Stale,
        Link::Online(_) => Contact::Fresh,
    }
}

fn run_order(record: &AuditRecord, age: Duration) -> Option<RunOrder> {
    let by = match record.source {
        source if source == SourceKind::Supervision.name() => {
            if &*record.client == Origin::LOCAL {
                Giver::LocalControl
            } else {
                Giver::Supervision
            }
        }
        source if source == SourceKind::Shutdown.name() => Giver::Shutdown,
        source if source == SourceKind::Interlock.name() => Giver::Interlock,
        _ => Giver::Client,
    };
    Some(RunOrder {
        run: match record.run() {
            Some(true) => RunWish::Run,
            Some(false) => RunWish::Stop,
            None if record.resets() => RunWish::Reset,
            None => return None,
        },
        fate: record.fate,
        by,
        who: format!("{} {}", record.source, record.client),
        text: record.text.clone(),
        result: record.result.to_string(),
        age,
    })
}
