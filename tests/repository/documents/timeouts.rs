//! The texts of docs/safety.md about the timeout of each family, generated from the built-in profiles.

use std::fmt::Write;

use drivegate_model::drive::Step;
use drivegate_model::drive::profile::Profiles;

/// Text of a profile whose timeout counts unknown requests, which the page states only once.
const UNKNOWN: &str = "; which requests count is not known";

/// A row for each timeout, with the families that have it and are not based on another of these families.
pub(crate) fn table() -> String {
    let mut rows: Vec<(Vec<String>, String)> = Vec::new();
    for profile in Profiles::built_in().iter().filter(|profile| profile.base.is_none()) {
        let lines = profile.commissioning.lines(Step::Timeout);
        assert!(!lines.is_empty(), "{} says nothing of its own timeout", profile.name);
        let needs = profile
            .control
            .as_ref()
            .is_some_and(|control| control.refresh.is_some());
        let text = lines.join("; ").replace(UNKNOWN, "");
        assert_eq!(needs, text.contains("`refresh` writes"), "{}", profile.name);
        let name = format!("`{}`", profile.name);
        match rows.iter_mut().find(|(_, known)| *known == text) {
            Some((names, _)) => names.push(name),
            None => rows.push((vec![name], text)),
        }
    }
    let mut text = "|profile|own timeout|\n|---|---|\n".to_string();
    for (names, line) in rows {
        // Writing to a String cannot fail.
        let _ = writeln!(text, "|{}|{line}|", names.join(", "));
    }
    text
}
