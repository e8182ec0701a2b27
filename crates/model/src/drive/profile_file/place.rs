//! Address and format of a value: `at`, `type`, `words`, `invert`, `scale`, `offset`.

use super::super::profile::{AddressRange, Form, Raw, Source, WordOrder};
use super::ranges::{Offsets, read_table};
use crate::codec::Table;
use crate::document::{Finding, Reader};

/// A PDU address, decimal or hexadecimal as in some manuals (0x0023).
pub(super) fn parse_address(text: &str) -> Option<u16> {
    match text.strip_prefix("0x") {
        Some(hex) => u16::from_str_radix(hex, 16).ok(),
        None => text.parse().ok(),
    }
}

/// `holding 2100.3`: table, PDU address, bit.
pub(super) fn read_raw(reader: &Reader<'_>, ranges: &[AddressRange], offsets: &Offsets) -> Option<Source> {
    // They are keys of a point with an address, whatever is wrong with that.
    for key in ["type", "words", "invert", "scale", "offset"] {
        reader.raw(key);
    }
    let at: String = reader.required("at")?;
    let bad = || match of_reference(&at) {
        Some((table, address)) => Finding::new(
            format!("`{at}` is a reference number, which counts from 1"),
            format!("write table and PDU address: \"{table} {address}\""),
        ),
        None => Finding::new(
            format!("`{at}` is not an address"),
            "write table and PDU address, such as \"holding 2103\" or \"holding 2100.3\"",
        ),
    };
    let Some((table, place)) = at.split_once(' ') else {
        reader.finding("at", bad());
        return None;
    };
    let table = read_table(reader, "at", table)?;
    let (address, bits) = match place.split_once('.') {
        Some((address, bits)) => (parse_address(address), parse_bits(bits).map(Some)),
        None => (parse_address(place), Some(None)),
    };
    let (Some(address), Some(bits)) = (address, bits) else {
        reader.finding("at", bad());
        return None;
    };
    let address = offsets.applied(reader, "at", table, address)?;
    let invert = reader.or("invert", false);
    let form = read_form(reader, table, bits, invert)?;
    if reader.has("invert") && !matches!(form, Form::Bit { .. }) {
        reader.problem("invert", "only a bit can be inverted", "leave the key out");
    }
    let raw = Raw {
        table,
        address,
        form,
        scale: reader.or("scale", 1.0),
        offset: reader.or("offset", 0.0),
    };
    if raw.scale == 0.0 {
        reader.problem(
            "scale",
            "a scale of 0 loses every value",
            "write the engineering value of one count",
        );
    }
    check_place(reader, &raw, ranges);
    Some(Source::Raw(raw))
}

/// The table and PDU address of a reference number of five or six digits, as manuals print it: 40003 is holding 2.
fn of_reference(text: &str) -> Option<(Table, u16)> {
    let digits = text.bytes().all(|byte| byte.is_ascii_digit()) && matches!(text.len(), 5 | 6);
    let (table, number) = text.split_at_checked(1).filter(|_| digits)?;
    let table = match table {
        "0" => Table::Coil,
        "1" => Table::DiscreteInput,
        "3" => Table::Input,
        "4" => Table::Holding,
        _ => return None,
    };
    let address = number.parse::<u32>().ok()?.checked_sub(1)?;
    Some((table, u16::try_from(address).ok()?))
}

/// `3` is one bit, `4-7` a field: the first bit and how many.
fn parse_bits(text: &str) -> Option<(u8, u8)> {
    let (first, last) = text.split_once('-').unwrap_or((text, text));
    let (first, last): (u8, u8) = (first.parse().ok()?, last.parse().ok()?);
    (first <= last && last < 16).then(|| (first, last - first + 1))
}

fn check_place(reader: &Reader<'_>, raw: &Raw, ranges: &[AddressRange]) {
    let Raw {
        table, address, form, ..
    } = raw;
    let range = ranges
        .iter()
        .find(|r| r.table == *table && r.addresses.contains(address));
    let Some(range) = range else {
        reader.problem(
            "at",
            format!("{table} {address} is not in any [[range]] of the profile"),
            "add the range",
        );
        return;
    };
    let items = form.items();
    if raw.addresses().count() != usize::from(items) || raw.addresses().any(|a| !range.addresses.contains(&a)) {
        reader.problem(
            "at",
            format!("{table} {address} takes {items} registers and exceeds its [[range]]"),
            "extend the range",
        );
    } else if items > range.read {
        reader.problem(
            "type",
            format!("the value takes {items} registers, its [[range]] reads {}", range.read),
            "raise `read` there",
        );
    }
}

fn read_form(reader: &Reader<'_>, table: Table, bits: Option<(u8, u8)>, invert: bool) -> Option<Form> {
    let kind: Option<String> = reader.optional("type");
    let words = match reader.optional::<String>("words").as_deref() {
        None | Some("high-first") => WordOrder::HighFirst,
        Some("low-first") => WordOrder::LowFirst,
        Some(other) => {
            reader.problem(
                "words",
                format!("unknown word order `{other}`"),
                "write high-first or low-first",
            );
            WordOrder::HighFirst
        }
    };
    match (table.is_bits(), bits, kind.as_deref()) {
        (true, None, None) => Some(Form::Bit { bit: 0, invert }),
        (false, Some((bit, 1)), None) => Some(Form::Bit { bit, invert }),
        (false, Some((first, count)), None) => Some(Form::Bits { first, count }),
        (false, None, Some(text)) => form_of(reader, text, words),
        (false, None, None) => Some(Form::U16),
        (true, _, _) => {
            reader.problem(
                "at",
                "an item of a bit table has neither bit number nor type",
                "leave them out",
            );
            None
        }
        (false, Some(_), Some(_)) => {
            reader.problem("type", "a bit has no type", "leave the key out");
            None
        }
    }
}

fn form_of(reader: &Reader<'_>, kind: &str, words: WordOrder) -> Option<Form> {
    let form = match kind {
        "u16" => Form::U16,
        "i16" => Form::I16,
        "u32" => Form::U32(words),
        "i32" => Form::I32(words),
        "f32" => Form::F32(words),
        other => {
            reader.problem(
                "type",
                format!("unknown type `{other}`"),
                "known: u16, i16, u32, i32, f32",
            );
            return None;
        }
    };
    if form.items() == 1 && reader.has("words") {
        reader.problem(
            "words",
            format!("a {kind} is one register and has no word order"),
            "leave the key out",
        );
    }
    Some(form)
}
