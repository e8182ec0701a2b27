//! Reads address and format of a value: `at` and the keys of its form; keys that change the interpretation are read
//! in `meaning`.

use super::super::control::ControlItem;
use super::super::profile::{AddressRange, Form, MOST_REGISTERS, Order, Raw, Source};
use super::interpretation;
use super::ranges::{Offsets, read_table};
use crate::document::{Finding, Reader};
use drivegate_proto::Table;

/// Keys of a point that has `at`.
pub(super) const KEYS: [&str; 12] = [
    "type",
    "byte",
    "words",
    "order",
    "invert",
    "scale",
    "offset",
    "mask",
    "equals",
    "invalid",
    "scale_from",
    "factor_from",
];

/// A PDU address, decimal or hexadecimal as in some manuals (0x0023).
pub(super) fn parse_address(text: &str) -> Option<u16> {
    match text.strip_prefix("0x") {
        Some(hex) => u16::from_str_radix(hex, 16).ok(),
        None => text.parse().ok(),
    }
}

/// `holding 2100`: table and PDU address.
pub(super) fn parse_place(text: &str) -> Option<ControlItem> {
    let (table, address) = text.split_once(' ')?;
    Some(ControlItem {
        table: Table::from_name(table)?,
        address: parse_address(address)?,
    })
}

/// `holding 2100.3`: table, PDU address, bit.
pub(super) fn read_raw(
    reader: &Reader<'_>,
    names: &[String],
    ranges: &[AddressRange],
    offsets: &Offsets,
) -> Option<Source> {
    // The keys belong to a point with an address, even if that has an error.
    for key in KEYS {
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
    let raw = interpretation::apply(
        reader,
        names,
        Raw {
            order: read_order(reader, form),
            scale: reader.or("scale", 1.0),
            offset: reader.or("offset", 0.0),
            ..Raw::plain(table, address, form)
        },
        invert,
    );
    if reader.has("invert") && !raw.is_bool() {
        reader.problem("invert", "only a bit or `equals` can be inverted", "leave the key out");
    }
    if reader.has("byte") && !matches!(raw.form, Form::I8 { .. }) {
        reader.problem(
            "byte",
            format!("{} is not one byte of a register", raw.form.name()),
            "leave the key out, or write type = \"i8\"",
        );
    }
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
    match (table.is_bits(), bits, kind.as_deref()) {
        (true, None, None) => Some(Form::Bit { bit: 0, invert }),
        (false, Some((bit, 1)), None) => Some(Form::Bit { bit, invert }),
        (false, Some((first, count)), None) => Some(Form::Bits { first, count }),
        (false, None, Some(text)) => form_of(reader, text),
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

/// Whether an `i8` is the high byte of its register.
fn is_high_byte(reader: &Reader<'_>) -> bool {
    let byte = reader.parsed("byte", |text| match text {
        "high" => Ok(true),
        "low" => Ok(false),
        other => Err(Finding::new(
            format!("a register has no byte `{other}`"),
            "write \"high\" or \"low\"",
        )),
    });
    byte.unwrap_or(false)
}

fn form_of(reader: &Reader<'_>, kind: &str) -> Option<Form> {
    if let Some(form) = Form::NAMED.into_iter().find(|form| form.name() == kind) {
        return Some(match form {
            Form::I8 { .. } => Form::I8 {
                high: is_high_byte(reader),
            },
            form => form,
        });
    }
    let length = kind.strip_prefix("string:");
    if let Some(length) = length {
        let registers = length.parse().ok().filter(|n| (1..=MOST_REGISTERS).contains(n));
        if let Some(registers) = registers.and_then(|n| u8::try_from(n).ok()) {
            return Some(Form::Text { registers });
        }
        reader.problem(
            "type",
            format!("a text of `{length}` registers is not possible"),
            format!("write string:1 to string:{MOST_REGISTERS}"),
        );
        return None;
    }
    let known: Vec<&str> = Form::NAMED.iter().map(|form| form.name()).collect();
    reader.problem(
        "type",
        format!("unknown type `{kind}`"),
        format!("known: {}, string:N", known.join(", ")),
    );
    None
}

/// Reads `order`, or `words` for two registers.
fn read_order(reader: &Reader<'_>, form: Form) -> Order {
    let order = reader.parsed("order", |text| {
        let known = Order::ALL.into_iter().find(|order| order.name() == text);
        known.ok_or_else(|| {
            Finding::new(
                format!("unknown order `{text}`"),
                "write ABCD, CDAB, BADC or DCBA; A is the most significant byte",
            )
        })
    });
    let words = match reader.optional::<String>("words").as_deref() {
        None => None,
        Some("high-first") => Some(Order::Abcd),
        Some("low-first") => Some(Order::Cdab),
        Some(other) => {
            reader.problem(
                "words",
                format!("unknown word order `{other}`"),
                "write high-first or low-first",
            );
            None
        }
    };
    let bits = matches!(form, Form::Bit { .. } | Form::Bits { .. });
    if bits && reader.has("order") {
        reader.problem("order", "bits of one register have no order", "leave the key out");
    }
    if form.items() == 1 && reader.has("words") {
        let what = if bits {
            "bits of one register have no word order".to_string()
        } else {
            format!("a {} is one register and has no word order", form.name())
        };
        reader.problem("words", what, "leave the key out");
    }
    if order.is_some() && words.is_some() {
        reader.problem("words", "`order` says it already", "leave `words` out");
    }
    order.or(words).unwrap_or_default()
}
