//! `base`: a profile that is another one but for a few keys.
//!
//! The trees of both files are merged before anything is read, so that every check sees the whole. What comes from the
//! base is told by the base's name instead of a line.

use crate::document::{Document, Entry, Node, Raw};

/// Keys by which a derived point is made.
const DERIVATION: [&str; 6] = ["derive", "of", "to", "within", "minimum", "maximum"];
/// Keys by which a point is taken from registers.
const PLACE: [&str; 7] = ["at", "type", "words", "invert", "scale", "offset", "class"];
/// Of these, the ones that a bit does not have.
const REGISTER: [&str; 4] = ["type", "words", "scale", "offset"];

/// What the file says before it is read: its name and the one it rests on.
pub(super) fn peek(document: &Document) -> (Option<String>, Option<String>) {
    let text = |key: &str| match document.root().entry(key).map(|node| &node.value) {
        Some(Raw::Text(text)) => Some(text.clone()),
        _ => None,
    };
    (text("name"), text("base"))
}

/// Lays the document over the tree of its base, which is called `name`.
pub(super) fn lay_over(document: &mut Document, base: &Node, name: &str) {
    let mut merged = base.told_as(&format!("profile {name}"));
    let own = document.root().clone();
    if let Raw::Table(entries) = &mut merged.value {
        // The name is the file's own.
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

/// `points.NAME.key` and `remove`, which change points of the list `point`; what names no point is told.
pub(super) fn change_points(document: &mut Document) {
    let mut root = document.root().clone();
    let Raw::Table(entries) = &mut root.value else { return };
    let changes = take(entries, "points");
    let removed = take(entries, "remove");
    if changes.is_none() && removed.is_none() {
        return;
    }
    let mut problems: Vec<(String, Option<usize>, String)> = Vec::new();
    let mut nothing = Vec::new();
    let points = match entries
        .iter_mut()
        .find(|(key, ..)| key == "point")
        .map(|(_, _, node)| &mut node.value)
    {
        Some(Raw::Array(points)) => points,
        _ => &mut nothing,
    };
    match changes.map(|(_, line, node)| (line, node.value)) {
        Some((_, Raw::Table(changes))) => {
            for (name, line, node) in changes {
                let key = format!("points.{name}");
                match (points.iter_mut().find(|p| name_of(p) == Some(&name)), &node.value) {
                    (None, _) => problems.push((key, line, unknown(&name, points))),
                    (Some(point), Raw::Table(own)) => {
                        merge_point(point, own.clone());
                        point.stand_where(&node);
                    }
                    (Some(_), _) => {
                        problems.push((key, line, format!("that is no table; write points.{name}.KEY = VALUE")));
                    }
                }
            }
        }
        Some((line, _)) => problems.push((
            "points".to_string(),
            line,
            "that is no table; write points.NAME.KEY = VALUE".to_string(),
        )),
        None => {}
    }
    match removed.map(|(_, line, node)| (line, node.value)) {
        Some((line, Raw::Array(names))) => {
            for node in names {
                let name = match &node.value {
                    Raw::Text(name) => name.as_str(),
                    _ => "",
                };
                if points.iter().any(|p| name_of(p) == Some(name)) {
                    points.retain(|p| name_of(p) != Some(name));
                } else {
                    problems.push(("remove".to_string(), node.line().or(line), unknown(name, points)));
                }
            }
        }
        Some((line, _)) => problems.push((
            "remove".to_string(),
            line,
            "that is no list; write remove = [\"NAME\"]".to_string(),
        )),
        None => {}
    }
    document.set_root(root);
    for (key, line, message) in problems {
        document.problem(&crate::document::Place { line, env: None, key }, message);
    }
}

fn unknown(name: &str, points: &[Node]) -> String {
    let near = crate::document::nearest(name, points.iter().filter_map(name_of));
    let remedy = near.map_or_else(
        || "name a point of the profile".to_string(),
        |near| format!("did you mean `{near}`?"),
    );
    format!("there is no point `{name}`; {remedy}")
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
            old.2.stand_where(&node);
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
                mine.stand_where(point);
            }
            _ => into.push(point.clone()),
        }
    }
}

/// A point that is taken from elsewhere loses what said where it was taken from before.
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
        into.retain(|(key, ..)| !PLACE.contains(&key.as_str()) && !DERIVATION.contains(&key.as_str()));
    }
    if let Some(at) = text("at") {
        into.retain(|(key, ..)| !DERIVATION.contains(&key.as_str()));
        if at.contains('.') || at.starts_with("coil") || at.starts_with("discrete") {
            into.retain(|(key, ..)| !REGISTER.contains(&key.as_str()));
        }
    }
    merge_keys(into, own);
}

/// A range that begins where one of the base does changes that one; another comes first, so that it counts where
/// both hold an address.
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
                mine.stand_where(range);
            }
            _ => first.push(range.clone()),
        }
    }
    into.splice(0..0, first);
}
