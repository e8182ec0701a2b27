//! `base`: a profile that changes a few keys of another one.
//!
//! The trees of a file and its base are merged before anything is read, so that every check sees the whole profile.
//! Problems of parts from the base name the base instead of a line.

use super::place;
use crate::document::{Document, Entry, Finding, Node, Place, Raw, nearest};

/// Keys that belong to a derived point.
const DERIVATION: [&str; 7] = ["derive", "of", "to", "within", "minimum", "maximum", "weights"];
/// Keys of a value that a bit has, too.
const OF_BITS: [&str; 2] = ["invert", "invalid"];

/// Name and base of a file that is not read yet.
pub(super) fn peek(document: &Document) -> (Option<String>, Option<String>) {
    let text = |key: &str| match document.root().entry(key).map(|node| &node.value) {
        Some(Raw::Text(text)) => Some(text.clone()),
        _ => None,
    };
    (text("name"), text("base"))
}

/// Merges the document into the tree of its base, which is the profile `name`.
pub(super) fn lay_over(document: &mut Document, base: &Node, name: &str) {
    let mut merged = base.with_source(&format!("profile {name}"));
    let own = document.root().clone();
    if let Raw::Table(entries) = &mut merged.value {
        // The name is never taken from the base.
        entries.retain(|(key, ..)| key != "name");
    }
    if let (Raw::Table(into), Raw::Table(from)) = (&mut merged.value, own.value) {
        for entry in from {
            match (entry.0.as_str(), into.iter_mut().find(|(key, ..)| *key == entry.0)) {
                ("point", Some(old)) => merge_points(old, entry),
                ("range", Some(old)) => merge_ranges(old, entry),
                (_, Some(old)) => replace(old, entry),
                (_, None) => into.push(entry),
            }
        }
    }
    document.set_root(merged);
}

/// An invalid change of a point: key, line, and the problem with its remedy.
type Mistake = (String, Option<usize>, Finding);

/// Applies `points.NAME.key` and `remove` to the list `point`; names of unknown points are reported.
pub(super) fn change_points(document: &mut Document) {
    let mut root = document.root().clone();
    let Raw::Table(entries) = &mut root.value else { return };
    let changes = take(entries, "points");
    let removed = take(entries, "remove");
    if changes.is_none() && removed.is_none() {
        return;
    }
    let mut nothing = Vec::new();
    let list = entries.iter_mut().find(|(key, ..)| key == "point");
    let points = match list.map(|(_, _, node)| &mut node.value) {
        Some(Raw::Array(points)) => points,
        _ => &mut nothing,
    };
    let mut mistakes = Vec::new();
    if let Some((_, line, node)) = changes {
        change(points, line, node.value, &mut mistakes);
    }
    if let Some((_, line, node)) = removed {
        let names: Vec<String> = texts(&node.value).map(str::to_string).collect();
        remove(points, line, node.value, &mut mistakes);
        // Entries in the base's `on_fault` are removed with the point.
        if let Some((.., on_fault)) = entries.iter_mut().find(|(key, ..)| key == "on_fault")
            && let Raw::Array(list) = &mut on_fault.value
        {
            list.retain(|node| !matches!(&node.value, Raw::Text(name) if names.contains(name)));
        }
    }
    document.set_root(root);
    for (key, line, Finding { what, remedy }) in mistakes {
        document.problem(&Place { line, env: None, key }, what, remedy);
    }
}

fn change(points: &mut [Node], line: Option<usize>, changes: Raw, mistakes: &mut Vec<Mistake>) {
    let not_a_table = |name: &str| Finding::new("not a table", format!("write points.{name}.KEY = VALUE"));
    let Raw::Table(changes) = changes else {
        mistakes.push(("points".to_string(), line, not_a_table("NAME")));
        return;
    };
    for (name, line, node) in changes {
        let point = points.iter().position(|p| name_of(p) == Some(&name));
        let mistake = match (point.and_then(|i| points.get_mut(i)), &node.value) {
            (Some(point), Raw::Table(own)) => {
                merge_point(point, own.clone());
                point.move_to(&node);
                continue;
            }
            (Some(_), _) => not_a_table(&name),
            (None, _) => unknown(&name, points),
        };
        mistakes.push((format!("points.{name}"), line, mistake));
    }
}

fn remove(points: &mut Vec<Node>, line: Option<usize>, names: Raw, mistakes: &mut Vec<Mistake>) {
    let key = || "remove".to_string();
    let Raw::Array(names) = names else {
        mistakes.push((key(), line, Finding::new("not a list", "write remove = [\"NAME\"]")));
        return;
    };
    for node in names {
        let name = match &node.value {
            Raw::Text(name) => name.as_str(),
            _ => "",
        };
        let before = points.len();
        points.retain(|p| name_of(p) != Some(name));
        if points.len() == before {
            mistakes.push((key(), node.line().or(line), unknown(name, points)));
        }
    }
}

/// The texts in a list.
fn texts(list: &Raw) -> impl Iterator<Item = &str> {
    let nodes = match list {
        Raw::Array(nodes) => nodes.as_slice(),
        _ => &[],
    };
    nodes.iter().filter_map(|node| match &node.value {
        Raw::Text(text) => Some(text.as_str()),
        _ => None,
    })
}

fn unknown(name: &str, points: &[Node]) -> Finding {
    let near = nearest(name, points.iter().filter_map(name_of)).map(|near| format!("did you mean `{near}`?"));
    Finding::new(
        format!("there is no point `{name}`"),
        near.unwrap_or_else(|| "name a point of the profile".to_string()),
    )
}

fn take(entries: &mut Vec<Entry>, key: &str) -> Option<Entry> {
    let place = entries.iter().position(|(k, ..)| k == key)?;
    Some(entries.remove(place))
}

fn name_of(point: &Node) -> Option<&str> {
    match point.entry("name").map(|node| &node.value) {
        Some(Raw::Text(name)) => Some(name),
        _ => None,
    }
}

/// Tables are merged key by key, anything else is replaced.
fn replace(old: &mut Entry, new: Entry) {
    match (&mut old.2.value, new) {
        (Raw::Table(into), (_, _, node)) if matches!(node.value, Raw::Table(_)) => {
            if let Raw::Table(from) = &node.value {
                merge_keys(into, from.clone());
            }
            old.2.move_to(&node);
        }
        (_, new) => *old = new,
    }
}

fn merge_keys(into: &mut Vec<Entry>, from: Vec<Entry>) {
    for entry in from {
        match into.iter_mut().find(|(key, ..)| *key == entry.0) {
            Some(old) => replace(old, entry),
            None => into.push(entry),
        }
    }
}

fn merge_points(old: &mut Entry, new: Entry) {
    let (Raw::Array(into), Raw::Array(from)) = (&mut old.2.value, &new.2.value) else {
        *old = new;
        return;
    };
    for point in from {
        let known = name_of(point).and_then(|name| into.iter().position(|p| name_of(p) == Some(name)));
        match (known.and_then(|i| into.get_mut(i)), &point.value) {
            (Some(mine), Raw::Table(own)) => {
                merge_point(mine, own.clone());
                mine.move_to(point);
            }
            _ => into.push(point.clone()),
        }
    }
}

/// Merges a point; a point with a new source loses the keys of its previous source.
fn merge_point(point: &mut Node, own: Vec<Entry>) {
    let Raw::Table(into) = &mut point.value else { return };
    let text = |wanted: &str| {
        own.iter()
            .find(|(key, ..)| key == wanted)
            .map(|(_, _, node)| match &node.value {
                Raw::Text(text) => text.clone(),
                _ => String::new(),
            })
    };
    if text("derive").is_some() {
        let is_read = |key: &str| matches!(key, "at" | "class") || place::KEYS.contains(&key);
        into.retain(|(key, ..)| !is_read(key) && !DERIVATION.contains(&key.as_str()));
    }
    if let Some(at) = text("at") {
        into.retain(|(key, ..)| !DERIVATION.contains(&key.as_str()));
        if at.contains('.') || at.starts_with("coil") || at.starts_with("discrete") {
            let of_registers = |key: &str| place::KEYS.contains(&key) && !OF_BITS.contains(&key);
            into.retain(|(key, ..)| !of_registers(key));
        }
    }
    merge_keys(into, own);
}

/// A range that starts like a range of the base changes that one; other ranges are put first, so that they take
/// precedence if both contain an address.
fn merge_ranges(old: &mut Entry, new: Entry) {
    let (Raw::Array(into), Raw::Array(from)) = (&mut old.2.value, &new.2.value) else {
        *old = new;
        return;
    };
    let start = |range: &Node| match (
        range.entry("table").map(|n| &n.value),
        range.entry("first").map(|n| &n.value),
    ) {
        (Some(Raw::Text(table)), Some(Raw::Integer(first))) => Some((table.clone(), *first)),
        _ => None,
    };
    let mut first = Vec::new();
    for range in from {
        let known = into.iter_mut().find(|r| start(r).is_some() && start(r) == start(range));
        match (known, &range.value) {
            (Some(mine), Raw::Table(own)) => {
                if let Raw::Table(keys) = &mut mine.value {
                    merge_keys(keys, own.clone());
                }
                mine.move_to(range);
            }
            _ => first.push(range.clone()),
        }
    }
    into.splice(0..0, first);
}
