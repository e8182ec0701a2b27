//! Writes TOML as YAML that YAML 1.1 and 1.2 parse alike: strings are always quoted, and numbers have the notation that
//! both versions parse as a number.

use std::fmt::Write;

use toml::{Table, Value};

/// Words that YAML 1.1 parses as something other than a string.
const WORDS: [&str; 9] = ["y", "n", "yes", "no", "on", "off", "true", "false", "null"];

/// The value, a table, as a document.
pub(super) fn document(value: &Value) -> String {
    let mut text = String::new();
    block(&mut text, value, 0);
    text
}

/// Lines of `value`, each `depth` levels in.
fn block(text: &mut String, value: &Value, depth: usize) {
    let indent = "  ".repeat(depth);
    match value {
        Value::Table(table) if !table.is_empty() => mapping(text, table, depth),
        Value::Array(items) if !is_inline(value) => {
            for item in items {
                let mut lines = String::new();
                block(&mut lines, item, depth + 1);
                // The first line begins with `- `; the other lines are indented by two columns instead.
                let first = lines.get(indent.len() + 2..).unwrap_or_default();
                text.push_str(&indent);
                text.push_str("- ");
                text.push_str(first);
            }
        }
        // Writing to a String cannot fail.
        inline => drop(writeln!(text, "{indent}{}", flow(inline))),
    }
}

fn mapping(text: &mut String, table: &Table, depth: usize) {
    let indent = "  ".repeat(depth);
    for (name, value) in table {
        // Writing to a String cannot fail.
        let _ = write!(text, "{indent}{}:", key(name));
        if is_inline(value) {
            let _ = writeln!(text, " {}", flow(value));
        } else {
            text.push('\n');
            block(text, value, depth + 1);
        }
    }
}

/// Whether the value is written on the line of its key: all except non-empty lists and tables, but including lists
/// of scalars.
fn is_inline(value: &Value) -> bool {
    match value {
        Value::Table(table) => table.is_empty(),
        Value::Array(items) => !items
            .iter()
            .any(|item| matches!(item, Value::Table(_) | Value::Array(_))),
        _ => true,
    }
}

fn flow(value: &Value) -> String {
    match value {
        Value::String(text) => quoted(text),
        Value::Integer(number) => number.to_string(),
        Value::Float(number) => float(*number),
        Value::Boolean(on) => on.to_string(),
        Value::Datetime(time) => quoted(&time.to_string()),
        Value::Array(items) => format!("[{}]", items.iter().map(flow).collect::<Vec<_>>().join(", ")),
        Value::Table(_) => "{}".to_string(),
    }
}

/// A point and a sign of the exponent are what makes it a number in YAML 1.1.
fn float(number: f64) -> String {
    if number.is_nan() {
        return ".nan".to_string();
    }
    if number.is_infinite() {
        return if number > 0.0 { ".inf" } else { "-.inf" }.to_string();
    }
    let text = format!("{number:?}");
    let Some((mantissa, exponent)) = text.split_once('e') else {
        return text;
    };
    let point = if mantissa.contains('.') { "" } else { ".0" };
    let sign = if exponent.starts_with('-') { "" } else { "+" };
    format!("{mantissa}{point}e{sign}{exponent}")
}

fn key(name: &str) -> String {
    let plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "_-".contains(c);
    let begins = name.starts_with(|c: char| c.is_ascii_lowercase());
    match begins && name.chars().all(plain) && !WORDS.contains(&name) {
        true => name.to_string(),
        false => quoted(name),
    }
}

fn quoted(text: &str) -> String {
    let mut out = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => out.extend(['\\', c]),
            '\n' => out.push_str("\\n"),
            c if matches!(c, ' '..='~') || c.is_alphanumeric() => out.push(c),
            // Writing to a String cannot fail.
            c => drop(write!(out, "\\U{:08X}", u32::from(c))),
        }
    }
    out.push('"');
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_document() {
        let toml = "[gateway]\nname = \"off\"\nnone = []\nempty = {}\n[[bus]]\nrate = 1e16\nsmall = 2.5e-7\nhalf = 0.5\nwhole = 3.0\n\
            [[bus.drive]]\nlimits = { on = [[0, 100], [1.5, 2.0]], 1 = true }\nshown = [\"yes\", \"a\\\"b\\\\\\n\\u001b\\u2028ä\"]\n\
            [[bus.drive]]\nname = \"x\"\n";
        let expected = "gateway:\n  name: \"off\"\n  none: []\n  empty: {}\nbus:\n  - rate: 1.0e+16\n    small: 2.5e-7\n    half: 0.5\n    whole: 3.0\n    drive:\n      \
            - limits:\n          \"on\":\n            - [0, 100]\n            - [1.5, 2.0]\n          \"1\": true\n        \
            shown: [\"yes\", \"a\\\"b\\\\\\n\\U0000001B\\U00002028ä\"]\n      - name: \"x\"\n";
        assert_eq!(document(&Value::Table(toml.parse().unwrap())), expected);
    }
}
