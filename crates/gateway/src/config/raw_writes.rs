//! Reads `raw_writes` of `[[bus.drive]]`.

use std::ops::RangeInclusive;

use super::keys::DRIVE;
use drivegate_model::document::{Finding, Node, Raw, Reader};
use drivegate_model::drive::{Profile, RawWrites};

/// Registers that raw writes may set in addition to writable points; none if the key is absent or invalid.
pub(super) fn read(reader: &Reader<'_>, profile: Option<&Profile>) -> RawWrites {
    let key = DRIVE.raw_writes.name;
    let parsed = reader.raw(key).map(|node| parse(&node.value, profile));
    let accepted = parsed.and_then(|parsed| reader.accept(key, parsed));
    accepted.unwrap_or_default()
}

fn parse(value: &Raw, profile: Option<&Profile>) -> Result<RawWrites, Finding> {
    match value {
        Raw::Bool(true) => Ok(RawWrites::All),
        Raw::Bool(false) => Ok(RawWrites::Points),
        Raw::Env(text) if text == "true" => Ok(RawWrites::All),
        Raw::Env(text) if text == "false" => Ok(RawWrites::Points),
        Raw::Array(pairs) => {
            let ranges = pairs.iter().map(|pair| range(pair, profile));
            Ok(RawWrites::Ranges(ranges.collect::<Result<_, _>>()?))
        }
        Raw::Env(text) | Raw::Text(text) => Err(wrong(format!("`{text}` is not a rule for raw writes"))),
        other => Err(wrong(format!("wrong type: {}", other.kind()))),
    }
}

fn wrong(what: String) -> Finding {
    Finding::new(what, format!("write {}", DRIVE.raw_writes.form.range()))
}

fn range(pair: &Node, profile: Option<&Profile>) -> Result<RangeInclusive<u16>, Finding> {
    let address = |node: &Node| match node.value {
        Raw::Integer(number) => u16::try_from(number).ok(),
        _ => None,
    };
    let range = match &pair.value {
        Raw::Array(pair) => match pair.as_slice() {
            [first, last] => address(first).zip(address(last)),
            _ => None,
        },
        _ => None,
    };
    let range = range.filter(|(first, last)| first <= last);
    let (first, last) = range.ok_or_else(|| {
        let what = "an item is not a pair of PDU addresses, the lower one first, 0 to 65535".to_string();
        wrong(what)
    })?;
    let takes = |profile: &Profile| {
        let mut ranges = profile.ranges.iter().filter(|range| range.write > 0);
        ranges.any(|range| *range.addresses.start() <= last && first <= *range.addresses.end())
    };
    match profile.filter(|profile| !takes(profile)) {
        None => Ok(first..=last),
        Some(profile) => Err(Finding::new(
            format!("profile `{}` allows no writes from {first} to {last}", profile.name),
            "leave the range out; `drivegate map` lists what can be written",
        )),
    }
}
