//! The gate is the only place where orders are refused because of the state of their drive: such refusals are built
//! in `core/permit` only. What else builds a refusal that the rules have is listed here with its reason.

use std::path::Path;

use super::documents::{files, read};
use super::words::{closing, is_test};
use crate::support::tools::root;

/// The outcomes of the rules (`docs/decisions/commands.md`), to which every refusal belongs.
const OUTCOMES_OF_THE_GATE: [&str; 2] = ["Expired", "Purged"];

/// Files outside of the gate that may build these refusals, and why.
const ELSEWHERE: [(&str, &[&str], &str); 24] = [
    (
        "crates/bus/src/command_run/ending.rs",
        &["Expired", "Purged"],
        "passes on the verdict of a rule, or of a stop, about a command in progress",
    ),
    (
        "crates/bus/src/command_run/next.rs",
        &["Expired"],
        "a command in progress has a time limit of its own, so that it still ends its pulse",
    ),
    (
        "crates/bus/src/command_run/parameter.rs",
        &["OtherValue"],
        "a restore compares the value in the drive, which is no rule of the gate",
    ),
    (
        "crates/bus/src/command_run/steps.rs",
        &["BadValue", "NotWritable"],
        "an admitted command can be encoded; if not, it must not end as if the drive had accepted it",
    ),
    (
        "crates/bus/src/listener/core.rs",
        &["NotAllowed"],
        "a bus that only listens closes its queue; `admit` refuses orders to it before",
    ),
    (
        "crates/bus/src/master/background.rs",
        &["Expired"],
        "reads for tools wait outside of the queue and write nothing",
    ),
    (
        "crates/core/src/plant.rs",
        &["UnknownDrive"],
        "without a drive there is nothing to judge",
    ),
    (
        "crates/core/src/plant/hold.rs",
        &["NotAllowed"],
        "taking and breaking a hold are no orders",
    ),
    (
        "crates/core/src/plant/orders.rs",
        &["Expired", "NotWritable"],
        "an order of the gateway needs the point in the profile; a read writes nothing",
    ),
    (
        "crates/core/src/queue/age.rs",
        &["Expired"],
        "an order whose time is over leaves the queue without waiting for its turn",
    ),
    (
        "crates/core/src/queue/passed_on.rs",
        &["Purged"],
        "a stop removes forwarded requests that were put back",
    ),
    (
        "crates/core/src/queue/stops.rs",
        &["Purged"],
        "an accepted stop removes the waiting orders of its drive at once",
    ),
    (
        "crates/http/src/operating/commands.rs",
        &["NotAllowed"],
        "a repeated `id` is known to its way in only",
    ),
    (
        "crates/http/src/operating/restart.rs",
        &["NotAllowed"],
        "the restart of communication is no order",
    ),
    (
        "crates/mqtt/src/commands.rs",
        &["BadValue", "NotAllowed"],
        "retained and repeated messages, and what cannot be understood, never become an order",
    ),
    (
        "crates/mqtt/src/request.rs",
        &["BadValue", "NotAllowed"],
        "retained messages, and what cannot be understood, never become an order",
    ),
    (
        "crates/mqtt/src/sparkplug/orders.rs",
        &["BadValue", "NotAllowed", "NotWritable"],
        "retained and repeated messages, and what cannot be understood, never become an order",
    ),
    (
        "crates/north/src/bacnet/view.rs",
        &["NotAllowed"],
        "the address may not write by [bacnet]: the request ends in its server",
    ),
    (
        "crates/north/src/bacnet/writes.rs",
        &["NotAllowed"],
        "priority 6 is not for clients, by the standard",
    ),
    (
        "crates/north/src/command_json/request.rs",
        &["BadValue", "NotWritable"],
        "what cannot be understood never becomes an order",
    ),
    (
        "crates/north/src/command_json/stop_all.rs",
        &["BadValue", "NotAllowed"],
        "a stop of drives that are unknown or only monitored has nothing to stop",
    ),
    (
        "crates/north/src/modbus_tcp/session/request.rs",
        &["BadValue", "NotWritable"],
        "a block that cannot be completed from readings never becomes an order",
    ),
    (
        "crates/north/src/register_map/command.rs",
        &["BadValue", "NotWritable"],
        "registers that mean no command never become an order",
    ),
    (
        "crates/north/src/slot/terms.rs",
        &["NotAllowed"],
        "`access` of a slot decides which requests become an order",
    ),
];

/// The tokens of code with their lines: without comments, contents of literals and modules of tests.
fn tokens(code: &str) -> Vec<(usize, &str)> {
    let code = code.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
    let (mut rest, mut line, mut found) = (code, 1, Vec::new());
    while let Some(c) = rest.chars().next() {
        let is_char = |length: usize| rest.get(1 + length..).is_some_and(|behind| behind.starts_with('\''));
        let word = rest
            .find(|c: char| !c.is_alphanumeric() && c != '_')
            .unwrap_or(rest.len());
        let pair = ["=>", "==", "!=", "<=", ">=", "::"];
        let (length, is_token) = match c {
            _ if rest.starts_with("//") => (rest.find('\n').unwrap_or(rest.len()), false),
            '"' => (closing(&rest[1..]) + 2, true),
            '\'' if rest[1..].starts_with('\\') && is_char(2) => (4, true),
            '\'' if is_char(1) => (3, true),
            _ if word > 0 => (word, true),
            _ if pair.iter().any(|pair| rest.starts_with(pair)) => (2, true),
            c => (c.len_utf8(), !c.is_whitespace()),
        };
        let (token, behind) = rest.split_at(length.min(rest.len()));
        if is_token {
            found.push((line, token));
        }
        line += token.matches('\n').count();
        rest = behind;
    }
    found
}

/// The change of depth by a token.
fn depth(token: &str) -> i32 {
    match token {
        "(" | "[" | "{" => 1,
        ")" | "]" | "}" => -1,
        _ => 0,
    }
}

/// The brackets that are open before `at`, the innermost first, up to the block; each with its index.
fn open_brackets(tokens: &[(usize, &str)], at: usize) -> Vec<usize> {
    let (mut level, mut found) = (0, Vec::new());
    for index in (0..at).rev() {
        level += depth(tokens[index].1);
        if level > 0 {
            found.push(index);
            level = 0;
            if tokens[index].1 == "{" {
                break;
            }
        }
    }
    found
}

/// Indices behind `begin` and before `end` that are in no bracket of their own, in order.
fn outermost<'t>(tokens: &'t [(usize, &str)], begin: usize, end: usize) -> impl Iterator<Item = usize> + 't {
    let mut level = 0;
    (begin + 1..end).filter(move |index| {
        level += depth(tokens[*index].1);
        level == 0
    })
}

/// Whether the name at that index is only compared, or stands in a pattern.
fn is_named_only(tokens: &[(usize, &str)], at: usize) -> bool {
    let text = |index: usize| tokens.get(index).map_or("", |token| token.1);
    let open = open_brackets(tokens, at);
    let in_matches = open.iter().any(|bracket| {
        let is_call = *bracket >= 2 && text(bracket - 1) == "!" && text(bracket - 2) == "matches";
        is_call && outermost(tokens, *bracket, at).any(|index| text(index) == ",")
    });
    let block = open.iter().copied().find(|bracket| text(*bracket) == "{").unwrap_or(0);
    // The statement, or the arm of a `match`, in which the name stands.
    let outer: Vec<usize> = outermost(tokens, block, at).collect();
    let begin = outer
        .iter()
        .rev()
        .find(|index| [";", ",", "}"].contains(&text(**index)));
    let begin = begin.copied().unwrap_or(block);
    let before = |word: &str| (begin + 1..at).rev().find(|index| text(*index) == word);
    let in_let = before("let").is_some_and(|of| !(of..at).any(|index| text(index) == "="));
    let is_compared = (at.saturating_sub(2)..at).any(|index| ["==", "!="].contains(&text(index)));
    in_matches || in_let || is_compared || (before("=>").is_none() && is_followed_by_arrow(tokens, at, open.len() > 1))
}

/// Whether an arm of a `match` begins with what contains the index.
fn is_followed_by_arrow(tokens: &[(usize, &str)], at: usize, in_brackets: bool) -> bool {
    let mut level = 0;
    for (_, token) in &tokens[at..] {
        level += depth(token);
        match *token {
            "=>" => return level <= 0,
            "{" if level <= 1 => return false,
            "}" | ";" => return false,
            "," if level == 0 && !in_brackets => return false,
            _ => {}
        }
    }
    false
}

/// The refusals and outcomes of the rules that the code builds, with their lines; imports that would hide one count, too.
fn built(code: &str) -> Vec<(usize, String)> {
    let tokens = tokens(code);
    let mut found = Vec::new();
    for (at, window) in tokens.windows(3).enumerate() {
        let [(line, of @ ("Refusal" | "Outcome")), (_, join), (_, name)] = window else {
            continue;
        };
        // Constants and functions of the type are not variants.
        let is_variant = name.starts_with(char::is_uppercase) && name.contains(char::is_lowercase);
        let has_rule = is_variant && (*of == "Refusal" || OUTCOMES_OF_THE_GATE.contains(name));
        let mut of_import = tokens[..at].iter().rev().take_while(|(_, token)| *token != ";");
        let is_renamed = *join == "as" && of_import.any(|(_, token)| *token == "order");
        let is_hidden = is_renamed || (*join == "::" && ["{", "*"].contains(name));
        let is_of_gate = *join == "::" && has_rule && !is_named_only(&tokens, at);
        if is_hidden || is_of_gate {
            found.push((*line, (*name).to_string()));
        }
    }
    found
}

#[test]
fn refusals_are_seen_in_every_form() {
    for (code, expected) in [
        ("fn f() { return Err(Refusal::Guarded(Box::new(guarded))); }", "Guarded"),
        (
            "fn f() { let why = Refusal::NotAllowed(\"=>\".to_string()); }",
            "NotAllowed",
        ),
        ("fn f() -> Refusal { Refusal::NeedsTake(holder) }", "NeedsTake"),
        (
            "fn f() { match x { 1 => Outcome::Expired, _ => y(Outcome::Purged, 2) } }",
            "Expired Purged",
        ),
        ("fn f() { g(&Outcome::Expired, |r| r.at <= now); }", "Expired"),
        ("fn f() { x.map(Refusal::BadValue) }", "BadValue"),
        ("use crate::order::Outcome::{Expired};", "{"),
        ("use crate::order::Outcome as Ended;", "Ended"),
        (
            "fn f() { match x { | Refusal::HeldByOther(_) | Refusal::NeedsTake(_) => 1, Err(Refusal::NotKnown(_)) if a => 2 } }",
            "",
        ),
        ("fn f() { if let Outcome::Refused(Refusal::NotKnown(why)) = x { } }", ""),
        ("fn f() { let Some(Outcome::Expired) = x else { return }; }", ""),
        (
            "fn f() { matches!(x, Outcome::Expired | Outcome::Purged) && x == Outcome::Expired }",
            "",
        ),
        (
            "// Outcome::Expired\nfn f() { \"Outcome::Expired\" }\n#[cfg(test)]\nmod tests { fn f() { Outcome::Expired } }",
            "",
        ),
        ("fn f() { ConnectionRefusal::NotAllowed }", ""),
    ] {
        let names: Vec<String> = built(code).into_iter().map(|(_, name)| name).collect();
        assert_eq!(names.join(" "), expected, "{code}");
    }
}

#[test]
fn refusals_of_the_gate_are_built_in_one_place() {
    let gate = root().join("crates/core/src/permit");
    let (mut found, mut used) = (Vec::new(), Vec::new());
    for path in ["crates", "src"]
        .iter()
        .flat_map(|folder| files(&root().join(folder), "rs"))
    {
        if path.starts_with(&gate) || is_test(&path) {
            continue;
        }
        let own = path.strip_prefix(root()).unwrap();
        let allowed = |name: &str| {
            let of_file = |(file, names, _): &&(&str, &[&str], &str)| Path::new(file) == own && names.contains(&name);
            ELSEWHERE.iter().find(of_file)
        };
        for (line, name) in built(&read(&path)) {
            match allowed(&name) {
                Some((file, ..)) => used.push((*file, name)),
                None => found.push(format!("{}:{line}: {name}", own.display())),
            }
        }
    }
    assert_eq!(
        found,
        Vec::<String>::new(),
        "a rule for orders belongs into core/permit"
    );
    for (file, names, why) in ELSEWHERE {
        for name in names {
            assert!(
                used.contains(&(file, (*name).to_string())),
                "{file} builds no {name}: {why}"
            );
        }
    }
}
