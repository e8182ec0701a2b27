//! The interpretation of a raw value: `mask`, `equals`, `invalid`, `scale_from`.

use super::super::profile::{Equals, Form, Raw};
use super::derived::point_of;
use crate::document::{Raw as Node, Reader};

/// The raw value with these keys applied.
pub(super) fn apply(reader: &Reader<'_>, names: &[String], raw: Raw, invert: bool) -> Raw {
    let raw = read_mask(reader, raw);
    let raw = read_equals(reader, raw, invert);
    let raw = read_invalid(reader, raw);
    let raw = read_scale_from(reader, names, raw);
    read_factor_from(reader, names, raw)
}

/// Replaces a mask of neighbouring bits of one register by the equivalent `at` with these bits.
fn read_mask(reader: &Reader<'_>, mut raw: Raw) -> Raw {
    let Some(mask) = reader.optional::<i64>("mask") else {
        return raw;
    };
    if !raw.form.takes_mask() || raw.table.is_bits() {
        reader.problem(
            "mask",
            format!("a mask applies to u16, u32 or u64, not to {}", raw.form.name()),
            "leave the key out, or write such a type",
        );
        return raw;
    }
    let width = raw.form.width();
    let mask = match u64::try_from(mask) {
        Ok(mask) if mask != 0 && (width >= 64 || mask >> width == 0) => mask,
        _ => {
            reader.problem(
                "mask",
                format!("{mask:#x} selects no bits of {} registers", raw.form.items()),
                format!("write a number of at most {width} bits that is not 0"),
            );
            return raw;
        }
    };
    let (first, count) = (mask.trailing_zeros(), mask.count_ones());
    let joint = mask.checked_shr(first + count).unwrap_or(0) == 0;
    match (raw.form, u8::try_from(first), u8::try_from(count)) {
        (Form::U16, Ok(first), Ok(count)) if joint && raw.order == Default::default() => {
            raw.form = Form::Bits { first, count };
        }
        _ => raw.mask = Some(mask),
    }
    raw
}

fn read_equals(reader: &Reader<'_>, mut raw: Raw, invert: bool) -> Raw {
    let Some(count) = reader.optional::<i64>("equals") else {
        return raw;
    };
    let whole = !matches!(raw.form, Form::Bit { .. } | Form::F32 | Form::F64 | Form::Text { .. });
    if !whole {
        reader.problem(
            "equals",
            format!("{} is not compared with a whole number", raw.form.name()),
            "leave the key out, or name a register with a whole number",
        );
        return raw;
    }
    let (least, most) = raw.counts();
    if !(least..=most).contains(&i128::from(count)) {
        reader.problem(
            "equals",
            format!("{count} is never reached: the value is {least} to {most}"),
            "write a value of that range",
        );
    }
    for key in ["scale", "offset", "scale_from", "factor_from"]
        .into_iter()
        .filter(|key| reader.has(key))
    {
        reader.problem(
            key,
            "`equals` compares the number in the register, without conversion",
            "leave the key out",
        );
    }
    raw.equals = Some(Equals { count, invert });
    raw
}

fn read_invalid(reader: &Reader<'_>, mut raw: Raw) -> Raw {
    let Some(counts) = reader.optional::<Vec<i64>>("invalid") else {
        return raw;
    };
    if raw.table.is_bits() || matches!(raw.form, Form::Text { .. }) {
        reader.problem(
            "invalid",
            "only a numeric register has values that mean \"not available\"",
            "leave the key out",
        );
        return raw;
    }
    let width = raw.form.width();
    for count in counts {
        let least = i64::MIN >> (64 - width);
        let fits = count >= least && (width >= 64 || count < 1 << width);
        if !fits {
            reader.problem(
                "invalid",
                format!("{count} is more than {} registers hold", raw.form.items()),
                format!("write what the registers hold, {width} bits, such as 0x7FFF"),
            );
            continue;
        }
        let all = u64::MAX >> (64 - width);
        raw.invalid.push(count as u64 & all);
    }
    raw
}

fn read_scale_from(reader: &Reader<'_>, names: &[String], mut raw: Raw) -> Raw {
    let Some(name) = reader.optional::<String>("scale_from") else {
        return raw;
    };
    for key in ["scale", "offset"].into_iter().filter(|key| reader.has(key)) {
        reader.problem(key, "`scale_from` gives the scale", "leave one of them out");
    }
    if matches!(raw.form, Form::Bit { .. } | Form::Bits { .. } | Form::Text { .. }) {
        reader.problem(
            "scale_from",
            format!("{} has no scale", raw.form.name()),
            "leave the key out, or name a register with a number",
        );
        return raw;
    }
    raw.scale_from = point_of(reader, "scale_from", &name, names);
    raw
}

/// Reads `factor_from`: one or several points by whose values the value is multiplied.
fn read_factor_from(reader: &Reader<'_>, names: &[String], mut raw: Raw) -> Raw {
    let Some(node) = reader.raw("factor_from") else {
        return raw;
    };
    let factors: Vec<String> = match &node.value {
        Node::Text(_) => reader.optional::<String>("factor_from").into_iter().collect(),
        _ => reader.optional("factor_from").unwrap_or_default(),
    };
    if matches!(raw.form, Form::Bit { .. } | Form::Bits { .. } | Form::Text { .. }) {
        reader.problem(
            "factor_from",
            format!("{} is not multiplied", raw.form.name()),
            "leave the key out, or name a register with a number",
        );
        return raw;
    }
    let points = factors
        .iter()
        .filter_map(|name| point_of(reader, "factor_from", name, names));
    raw.factor_from = points.collect();
    raw
}
