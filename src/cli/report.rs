//! What commands print. A pipe that is closed early ends the output without an error.

use std::io::{self, Write};
use std::process::ExitCode;
use std::time::Duration;

use comfy_table::{ContentArrangement, Table, TableComponent, presets};

use super::EXIT_FAILED;
use crate::config::Loaded;
use crate::document::{Finding, Problem, parse_duration};

/// Prints `text` to stdout.
pub(super) fn print(text: &str) -> ExitCode {
    print_bytes(text.as_bytes())
}

/// Writes `bytes` to stdout.
pub(super) fn print_bytes(bytes: &[u8]) -> ExitCode {
    let mut stdout = io::stdout().lock();
    match stdout.write_all(bytes).and_then(|()| stdout.flush()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => ExitCode::SUCCESS,
        Err(why) => {
            error(&format!(
                "cannot write the output: {why}; stdout; free space, or redirect it"
            ));
            ExitCode::from(EXIT_FAILED)
        }
    }
}

/// A duration of the command line.
pub(super) fn duration(text: &str) -> Result<Duration, Finding> {
    Ok(parse_duration(text)?)
}

/// Prints `error: what; where; what to do` to stderr.
pub(super) fn error(message: &str) {
    line("error", message);
}

/// Prints a note to stderr.
pub(super) fn note(message: &str) {
    line("note", message);
}

/// Prints errors to stderr.
pub(super) fn errors(problems: &[Problem]) {
    for problem in problems {
        error(&problem.to_string());
    }
}

/// Prints warnings and errors of a configuration to stderr, the errors last.
pub(super) fn problems(loaded: &Loaded) {
    for problem in &loaded.warnings {
        line("warning", &problem.to_string());
    }
    errors(&loaded.errors);
}

fn line(kind: &str, message: &str) {
    // With stderr gone there is nowhere left to report that.
    let _ = writeln!(io::stderr().lock(), "{kind}: {message}");
}

/// A table without a frame, as wide as the terminal at most.
pub(super) fn table<const N: usize>(header: [&str; N]) -> Table {
    let mut table = Table::new();
    table.load_preset(presets::NOTHING);
    table.set_style(TableComponent::HeaderLines, '─');
    table.set_content_arrangement(ContentArrangement::Dynamic);
    table.set_header(header);
    table
}

/// The table's lines, without the blanks that fill up the last column.
pub(super) fn lines(table: &Table) -> String {
    table.lines().map(|line| format!("{}\n", line.trim_end())).collect()
}
