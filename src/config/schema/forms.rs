//! The forms of properties: tables, lists, texts, numbers, words, durations.

use std::ops::RangeInclusive;
use std::time::Duration;

use serde_json::{Map, Value, json};

use crate::config::values;
use crate::document::format_duration;

/// A number and a unit, as [`crate::document::parse_duration`] reads it.
pub(super) const DURATION: &str = r"^\s*(\d+\.?\d*|\.\d+)\s*(us|µs|ms|s|min|h)\s*$";
/// As [`crate::document::parse_size`] reads it.
pub(super) const SIZE: &str = r"^\s*\d+\s*(B|KiB|MiB|GiB)\s*$";

pub(super) fn table<const N: usize>(description: &str, required: &[&str], properties: [(&str, Value); N]) -> Value {
    let properties: Map<String, Value> = properties
        .into_iter()
        .map(|(key, value)| (key.to_string(), value))
        .collect();
    json!({
        "type": "object",
        "description": description,
        "properties": properties,
        "required": required,
        "additionalProperties": false,
    })
}

pub(super) fn tables(description: &str, item: Value) -> Value {
    json!({ "type": "array", "description": description, "items": item })
}

pub(super) fn list(description: &str, item: Value) -> Value {
    json!({ "type": "array", "description": description, "items": item })
}

pub(super) fn nonempty(mut list: Value) -> Value {
    if let Value::Object(list) = &mut list {
        list.insert("minItems".into(), 1.into());
    }
    list
}

pub(super) fn text(description: &str) -> Value {
    json!({ "type": "string", "description": description })
}

pub(super) fn flag(description: &str) -> Value {
    json!({ "type": "boolean", "description": description })
}

pub(super) fn pattern(description: &str, pattern: &str) -> Value {
    json!({ "type": "string", "description": description, "pattern": pattern })
}

pub(super) fn name(description: &str, joints: &str) -> Value {
    let most = values::NAME_LENGTH;
    // A hyphen stands last in the class, where it means itself.
    let joints: String = joints.chars().rev().collect();
    pattern(description, &format!("^[a-z0-9][a-z0-9{joints}]{{0,{}}}$", most - 1))
}

pub(super) fn words<'a>(description: &str, words: impl Iterator<Item = &'a str>) -> Value {
    json!({ "description": description, "enum": words.collect::<Vec<_>>() })
}

pub(super) fn number<T: Copy + Into<Value>>(description: &str, bounds: &RangeInclusive<T>) -> Value {
    let (least, most): (Value, Value) = ((*bounds.start()).into(), (*bounds.end()).into());
    json!({ "type": "integer", "description": description, "minimum": least, "maximum": most })
}

pub(super) fn duration(description: &str, default: Option<Duration>) -> Value {
    let duration = pattern(description, DURATION);
    match default {
        Some(default) => with_default(duration, format_duration(default)),
        None => duration,
    }
}

pub(super) fn with_default(mut property: Value, default: impl serde::Serialize) -> Value {
    if let Value::Object(property) = &mut property {
        property.insert("default".into(), json!(default));
    }
    property
}
