//! The gate is the only place where orders are refused because of the state of their drive: such refusals are built
//! in `core/permit` only.

use std::path::Path;

use super::documents::{files, read};
use crate::support::tools::root;

/// Refusals which mean that an order may not move a motor now (`docs/decisions/commands.md`).
const OF_THE_GATE: [&str; 4] = ["HeldByOther", "NeedsTake", "Guarded", "Interlocked"];

/// The lines of code outside of tests.
fn code(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let lines = text.lines().enumerate();
    lines.take_while(|(_, line)| !line.starts_with("#[cfg(test)]"))
}

/// Whether a line builds such a refusal with content. Patterns only name it, and lists of all codes contain empty ones.
fn builds(line: &str) -> bool {
    let is_pattern = ["=>", "matches!", "if let ", "let "]
        .iter()
        .any(|word| line.contains(word));
    let empty = ["_)", "String::new()", "Box::default()", "Box::<Holder>::default()"];
    OF_THE_GATE.iter().any(|variant| {
        let variant = format!("Refusal::{variant}(");
        let mut uses = line
            .match_indices(&variant)
            .map(|(at, found)| &line[at + found.len()..]);
        uses.any(|rest| !is_pattern && !empty.iter().any(|empty| rest.starts_with(empty)))
    })
}

#[test]
fn refusals_of_the_gate_are_built_in_one_place() {
    assert!(builds("return Err(Refusal::Guarded(Box::new(guarded)));"));
    assert!(builds("    Refusal::NeedsTake(holder)"));
    assert!(!builds("    | Refusal::HeldByOther(_)"));
    let gate = root().join("crates/core/src/permit");
    let is_test = |path: &Path| {
        let mut parts = path
            .components()
            .map(|part| part.as_os_str().to_string_lossy().into_owned());
        parts.any(|part| part == "tests" || part == "tests.rs")
    };
    let mut found = Vec::new();
    for path in files(&root().join("crates"), "rs") {
        let own = path.strip_prefix(root()).unwrap();
        if path.starts_with(&gate) || is_test(own) {
            continue;
        }
        let text = read(&path);
        let here = code(&text).filter(|(_, line)| builds(line));
        found.extend(here.map(|(number, line)| format!("{}:{}: {}", own.display(), number + 1, line.trim())));
    }
    assert_eq!(
        found,
        Vec::<String>::new(),
        "a rule for orders belongs into core/permit"
    );
}
