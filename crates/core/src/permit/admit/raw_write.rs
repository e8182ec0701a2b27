//! Decides which raw writes are allowed: checks the addresses, then the control word, then values. Pure.

use super::{checked, related_limits};
use crate::order::{FrequencyRange, Refusal, rests_on, written};
use crate::process_image::Reading;
use drivegate_model::drive::Value;
use drivegate_model::drive::control::ControlItem;
use drivegate_model::drive::model::Kind;
use drivegate_proto::n2::Object;
use drivegate_proto::{Protocol, RequestPdu, Table};

/// The frequency ranges on which a raw write rests.
pub(super) fn raw_write(drive: &Reading<'_>, pdu: &RequestPdu) -> Result<Vec<FrequencyRange>, Refusal> {
    let profile = &drive.spec.profile;
    let Some((table, items)) = written(pdu) else {
        return Err(Refusal::NotAllowed(format!(
            "function {} cannot be passed on to this drive",
            pdu.function()
        )));
    };
    let Some((first, _)) = items.first() else {
        return Err(Refusal::BadValue(
            "the write names no register; nothing was written".to_string(),
        ));
    };
    let range = profile.range(table, *first).filter(|r| r.write > 0).ok_or_else(|| {
        Refusal::NotWritable(format!(
            "{table} {first} of `{}` is read-only or unknown",
            drive.spec.name
        ))
    })?;
    if let Some((beyond, _)) = items.iter().find(|(address, _)| !range.addresses.contains(address)) {
        return Err(Refusal::NotWritable(format!(
            "{table} {beyond} of `{}` is read-only or unknown",
            drive.spec.name
        )));
    }
    raw_rule(drive, table, &items)?;
    control_words(drive, table, &items)?;
    if profile.protocols.contains(&Protocol::N2) {
        one_object(table, *first, items.len())?;
    }
    if items.len() > usize::from(range.write) {
        let (count, most) = (items.len(), range.write);
        return Err(Refusal::BadValue(format!(
            "{count} items in one write, but the drive accepts at most {most}; nothing was written"
        )));
    }
    raw_values(drive, table, &items)
}

/// The registers beyond those of writable points that the drive's configuration does not admit.
fn raw_rule(drive: &Reading<'_>, table: Table, items: &[(u16, u16)]) -> Result<(), Refusal> {
    let spec = drive.spec;
    let addresses = items.iter().map(|(address, _)| *address);
    match spec.raw_writes.refused(&spec.profile, table, addresses) {
        None => Ok(()),
        Some(address) => Err(Refusal::NotWritable(format!(
            "{table} {address} of `{}` belongs to no writable point; add [{address}, {address}] to `raw_writes` of the \
             drive to write it raw",
            spec.name
        ))),
    }
}

/// Refuses a control word that is neither a stop nor clearly a run command, because its effect is unknown.
fn control_words(drive: &Reading<'_>, table: Table, items: &[(u16, u16)]) -> Result<(), Refusal> {
    let Some(control) = &drive.spec.profile.control else {
        return Ok(());
    };
    let refused = |(address, word): &&(u16, u16)| {
        !control.admits(
            ControlItem {
                table,
                address: *address,
            },
            *word,
        )
    };
    match items.iter().find(refused) {
        None => Ok(()),
        Some((address, word)) => Err(Refusal::BadValue(format!(
            "{word:#06x} at {table} {address} of `{}` neither stops nor runs the drive according to its profile; \
             nothing was written",
            drive.spec.name
        ))),
    }
}

/// On N2 a write sets one whole object: an address inside an object, or another length, is refused.
fn one_object(table: Table, first: u16, count: usize) -> Result<(), Refusal> {
    let object = Object::containing(table, first)
        .ok_or_else(|| Refusal::NotWritable(format!("no object starts at {table} {first}; nothing was written")))?;
    let items = object.items();
    if count != usize::from(items) {
        return Err(Refusal::BadValue(format!(
            "{object} must be written with exactly {items} items; nothing was written"
        )));
    }
    Ok(())
}

/// The points that a raw write of `items` sets, each complete and within its limits, and the frequency ranges on
/// which the limits depend.
fn raw_values(drive: &Reading<'_>, table: Table, items: &[(u16, u16)]) -> Result<Vec<FrequencyRange>, Refusal> {
    let mut ranges = Vec::new();
    for (index, point) in drive.spec.profile.points.enumerate() {
        let Some(raw) = point.raw().filter(|raw| raw.table == table) else {
            continue;
        };
        let words: Vec<u16> = raw
            .addresses()
            .filter_map(|address| items.iter().find(|(at, _)| *at == address).map(|(_, word)| *word))
            .collect();
        if words.is_empty() || point.kind() == Kind::Bool {
            continue;
        }
        if words.len() < usize::from(raw.form.items()) {
            return Err(Refusal::BadValue(format!(
                "`{}` takes {} registers; write them together; nothing was written",
                point.name,
                raw.form.items()
            )));
        }
        match raw.decode(&words, Kind::Number) {
            Some(value) => {
                let value = checked(drive, index, point, value)?;
                related_limits(drive, index, index, value)?;
                ranges.extend(rests_on(drive, index, (index, value)));
            }
            None => {
                return Err(Refusal::BadValue(format!(
                    "`{}`: not a number; nothing was written",
                    point.name
                )));
            }
        }
    }
    Ok(ranges)
}

/// The limit that a reference would break which was admitted before, perhaps under other limits. Registers hold rounded
/// values: one that is off by no more than a step keeps its limit. A limit that cannot be checked now is not broken.
pub fn broken_limit(drive: &Reading<'_>, pdu: &RequestPdu) -> Option<Refusal> {
    let (profile, (table, items)) = (&drive.spec.profile, written(pdu)?);
    let word = |address: u16| items.iter().find(|(at, _)| *at == address).map(|(_, word)| *word);
    let mut broken = profile.points.enumerate().filter_map(|(index, point)| {
        let raw = point.raw().filter(|raw| raw.table == table)?;
        if point.kind() == Kind::Bool || !raw.addresses().all(|at| profile.is_repeated_reference(at)) {
            return None;
        }
        let words: Option<Vec<u16>> = raw.addresses().map(word).collect();
        let value = raw.decode(&words?, Kind::Number)?.as_f64();
        let refusal = |value: f64| {
            let value = checked(drive, index, point, Value::Number(value));
            let judged = value.and_then(|value| related_limits(drive, index, index, value));
            judged.err().filter(|refusal| matches!(refusal, Refusal::BadValue(_)))
        };
        let is_near = || refusal(value + raw.scale).is_none() || refusal(value - raw.scale).is_none();
        refusal(value).filter(|_| !is_near())
    });
    broken.next()
}

/// Whether a raw write takes the run command away and does nothing else. A write of several items counts like any
/// other command: its stop was split off before ([`crate::order::Parts`]).
pub(super) fn stops(drive: &Reading<'_>, pdu: &RequestPdu) -> bool {
    let profile = &drive.spec.profile;
    written(pdu).is_some_and(|(table, items)| match items.as_slice() {
        [(address, value)] => profile.is_stop(table, *address, *value),
        _ => false,
    })
}
