//! The table of docs/command-line.md, generated from the command line's own description.

use std::fmt::Write;

use clap::{Arg, ArgAction, Command};

pub(crate) fn table() -> String {
    let mut text = String::from("\n|command|does|\n|---|---|\n");
    let root = drivegate_tools::command_line();
    for command in root.get_subcommands().filter(|command| !command.is_hide_set()) {
        rows(&mut text, "drivegate", command);
    }
    text.push('\n');
    text
}

/// Adds a row for the command, or one row for each of its subcommands.
fn rows(text: &mut String, path: &str, command: &Command) {
    let path = format!("{path} {}", command.get_name());
    let about = command.get_about().map(ToString::to_string).unwrap_or_default();
    assert!(!about.is_empty(), "{path} has no description");
    if command.has_subcommands() {
        for below in command.get_subcommands().filter(|below| below.get_name() != "help") {
            rows(text, &path, below);
        }
    }
    if !command.is_subcommand_required_set() {
        let usage: Vec<String> = command.get_arguments().filter_map(argument).collect();
        let usage = format!("{path} {}", usage.join(" "));
        let cell = |text: &str| text.replace('|', "\\|");
        let _ = writeln!(text, "|`{}`|{}|", cell(usage.trim_end()), cell(&about));
    }
}

/// A positional argument, in brackets if optional, or a required option; `--help` has the others.
fn argument(arg: &Arg) -> Option<String> {
    if arg.is_hide_set() || (arg.get_long().is_some() && !arg.is_required_set()) {
        return None;
    }
    let names = arg.get_value_names().unwrap_or_default();
    let names: Vec<String> = names.iter().map(ToString::to_string).collect();
    let several =
        arg.get_num_args().is_some_and(|range| range.max_values() > 1) || matches!(arg.get_action(), ArgAction::Append);
    let value = format!("{}{}", names.join(" "), if several { "…" } else { "" });
    let shown = arg.get_long().map_or(value.clone(), |long| format!("--{long} {value}"));
    Some(if arg.is_required_set() {
        shown
    } else {
        format!("[{shown}]")
    })
}
