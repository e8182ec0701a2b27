//! The modules of `core` need each other in one direction only.

use std::collections::{BTreeMap, BTreeSet};

use super::documents::{files, read};
use crate::support::tools::root;

/// The modules that a source names by `crate::`, apart from its tests and comments.
fn named(text: &str) -> BTreeSet<String> {
    let code = text.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default();
    let lines = code.lines().filter(|line| !line.trim_start().starts_with("//"));
    let names = lines.flat_map(|line| line.split("crate::").skip(1));
    let name = |rest: &str| rest.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
    names.map(name).collect()
}

#[test]
fn no_modules_of_core_need_each_other() {
    let source = root().join("crates/core/src");
    let mut needs: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for path in files(&source, "rs") {
        let own = path.strip_prefix(&source).unwrap();
        let parts: Vec<String> = own.iter().map(|part| part.to_string_lossy().into_owned()).collect();
        if parts.iter().any(|part| part == "tests" || part == "tests.rs") || parts == ["lib.rs"] {
            continue;
        }
        let module = parts[0].trim_end_matches(".rs").to_string();
        needs.entry(module).or_default().extend(named(&read(&path)));
    }
    let modules: BTreeSet<String> = needs.keys().cloned().collect();
    assert!(modules.contains("permit") && modules.contains("plant"), "{modules:?}");
    for (module, needed) in &mut needs {
        needed.retain(|other| other != module && modules.contains(other));
    }
    // Modules that need none of the remaining ones are removed; the rest is part of a cycle.
    loop {
        let done: Vec<String> = needs
            .iter()
            .filter(|(_, needed)| needed.is_empty())
            .map(|(module, _)| module.clone())
            .collect();
        if done.is_empty() {
            break;
        }
        for module in done {
            needs.remove(&module);
            needs.values_mut().for_each(|needed| {
                needed.remove(&module);
            });
        }
    }
    assert!(needs.is_empty(), "these modules of core need each other: {needs:?}");
}
