//! The schema against the loader, and the loader against any value.

use std::collections::BTreeSet;

use proptest::prelude::*;
use serde_json::Value;

use super::{FULL, load, settings};
use crate::config::schema;

/// Paths of all properties below `node`, in the form of `Document::known_keys`.
fn properties(node: &Value, path: &str, found: &mut BTreeSet<String>) {
    for alternative in node["anyOf"].as_array().into_iter().flatten() {
        properties(alternative, path, found);
    }
    properties_of_table(node, path, found);
    if node["items"].is_object() {
        properties(&node["items"], &format!("{path}[]"), found);
    }
}

fn properties_of_table(node: &Value, path: &str, found: &mut BTreeSet<String>) {
    let join = |key: &str| {
        if path.is_empty() {
            key.to_string()
        } else {
            format!("{path}.{key}")
        }
    };
    for (key, property) in node["properties"].as_object().into_iter().flatten() {
        assert!(property["description"].is_string(), "{} has no description", join(key));
        found.insert(join(key));
        properties(property, &join(key), found);
    }
    match &node["additionalProperties"] {
        Value::Null | Value::Bool(false) => {}
        _ => {
            found.insert(join("*"));
        }
    }
}

#[test]
fn the_schema_has_the_keys_of_the_loader() {
    let mut described = BTreeSet::new();
    properties(&schema(), "", &mut described);
    let (loaded, known) = load(&FULL);
    assert_eq!(loaded.errors, []);
    let known: BTreeSet<String> = known
        .into_iter()
        .map(|key| {
            key.replace("limits.speed_reference", "limits.*")
                .replace("roles.operator", "roles.*")
        })
        .collect();
    assert_eq!(described, known);
}

/// Adds the defaults of the schema to `document` wherever their table exists and the key is missing.
fn fill(document: &mut toml::Table, schema: &Value) {
    for (key, property) in schema["properties"].as_object().into_iter().flatten() {
        match document.get_mut(key) {
            Some(toml::Value::Table(table)) => fill(table, property),
            Some(toml::Value::Array(items)) => {
                for item in items {
                    if let toml::Value::Table(table) = item {
                        fill(table, &property["items"]);
                    }
                }
            }
            Some(_) => {}
            None => {
                if let Some(default) = property.get("default") {
                    document.insert(key.clone(), toml::Value::try_from(default).unwrap());
                }
            }
        }
    }
}

#[test]
fn the_defaults_of_the_schema_are_those_of_the_loader() {
    let mut document: toml::Table = FULL.parse().unwrap();
    fill(&mut document, &schema());
    let filled = toml::to_string(&document).unwrap();
    assert!(
        filled.contains("stale_after") && filled.contains("baud") && filled.contains("max_bytes"),
        "{filled}"
    );
    let mut filled = settings(&filled);
    assert!(
        filled.stale_after.written,
        "a default that is written down holds for slow lines too"
    );
    filled.stale_after.written = false;
    assert!(filled == settings(&FULL), "a default of the schema is not the loader's");
}

/// A value of any kind, valid or not.
fn any_value() -> impl Strategy<Value = String> {
    prop_oneof![
        any::<i64>().prop_map(|n| n.to_string()),
        any::<f64>().prop_map(|n| format!("{n:?}").replace("NaN", "nan")),
        "[a-z0-9:/.]{0,12}".prop_map(|text| format!("{text:?}")),
        "[0-9.]{1,25}(us|ms|s|min|h|MiB)".prop_map(|text| format!("{text:?}")),
        Just("true".to_string()),
        Just("[]".to_string()),
        Just("[1, 0.5]".to_string()),
        Just("{}".to_string()),
        Just("{ speed_reference = [0, 1] }".to_string()),
        Just("2026-11-21".to_string()),
        Just("= 1".to_string()),
    ]
}

proptest! {
    /// Property for any value of any key: there is no panic, and there are settings exactly if there is no error.
    #[test]
    fn any_value_of_any_key_is_judged(which in 0usize..100, value in any_value(), lines in 0usize..40) {
        let mut document: toml::Table = FULL.parse().unwrap();
        fill(&mut document, &schema());
        let filled = toml::to_string(&document).unwrap();
        let keys = filled.lines().filter(|line| line.contains('=')).count();
        let mut key = 0;
        let mut source = String::new();
        for line in filled.lines() {
            match line.split_once('=') {
                Some((name, _)) => {
                    source += &if key == which % keys { format!("{name}= {value}\n") } else { format!("{line}\n") };
                    key += 1;
                }
                None => source += &format!("{line}\n"),
            }
        }
        let (loaded, _) = load(&source);
        prop_assert_eq!(loaded.settings.is_some(), loaded.errors.is_empty());
        let half: Vec<&str> = source.lines().take(lines).collect();
        let (loaded, _) = load(&half.join("\n"));
        prop_assert_eq!(loaded.settings.is_some(), loaded.errors.is_empty());
    }
}
