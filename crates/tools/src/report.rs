//! Output of commands. A pipe that is closed early ends the output without an error.

use std::io::{self, Write};
use std::process::ExitCode;
use std::time::Duration;

use comfy_table::{CellAlignment, ContentArrangement, Table, TableComponent, presets};
use serde::Serialize;

use super::{EXIT_FAILED, log, printable};
use drivegate_gateway::config::Loaded;
use drivegate_model::document::{Finding, Problem, parse_duration};

/// Prints the lines of `text`, harmless for a terminal, to stdout.
pub(super) fn print(text: &str) -> ExitCode {
    print_bytes(printable::lines(text).as_bytes())
}

/// Prints one JSON document to stdout.
pub(super) fn json(document: &impl Serialize) -> ExitCode {
    // Strings, numbers and maps with names: this cannot fail.
    let text = serde_json::to_string_pretty(document).unwrap_or_default();
    print_bytes((text + "\n").as_bytes())
}

/// Writes `bytes` to stdout unchanged.
pub(super) fn print_bytes(bytes: &[u8]) -> ExitCode {
    let mut stdout = io::stdout().lock();
    match stdout.write_all(bytes).and_then(|()| stdout.flush()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => ExitCode::SUCCESS,
        Err(why) => failed(&format!(
            "cannot write the output: {why}; stdout; free space, or redirect it"
        )),
    }
}

/// Parses a duration of the command line.
pub(super) fn duration(text: &str) -> Result<Duration, Finding> {
    Ok(parse_duration(text)?)
}

/// Prints `error: what; where; what to do` to stderr.
pub(super) fn error(message: &str) {
    line("error", message);
}

/// Prints a failure and returns its exit code.
pub(super) fn failed(message: &str) -> ExitCode {
    error(message);
    ExitCode::from(EXIT_FAILED)
}

/// Prints a warning to stderr.
pub(super) fn warning(message: &str) {
    line("warning", message);
}

/// Prints a note to stderr.
pub(super) fn note(message: &str) {
    line("note", message);
}

/// Prints the lines of `text`, harmless for a terminal, to stderr.
pub(super) fn lines_to_stderr(text: &str) {
    // If stderr is closed, this error cannot be reported anywhere.
    let _ = io::stderr().lock().write_all(printable::lines(text).as_bytes());
}

/// Prints errors to stderr.
pub(super) fn errors(problems: &[Problem]) {
    for problem in problems {
        error(&problem.to_string());
    }
}

/// Prints errors and warnings of a configuration to stderr, the errors first: they are what the reader waits for.
pub(super) fn problems(loaded: &Loaded) {
    errors(&loaded.errors);
    for problem in &loaded.warnings {
        warning(&problem.to_string());
    }
}

fn line(kind: &str, message: &str) {
    // Priorities of syslog: error, warning, notice.
    let priority = match kind {
        _ if !log::reads_stderr() => "",
        "error" => "<3>",
        "warning" => "<4>",
        _ => "<5>",
    };
    // If stderr is closed, this error cannot be reported anywhere.
    let _ = writeln!(io::stderr().lock(), "{priority}{kind}: {}", printable::line(message));
}

/// Width of a terminal that does not report its width, in columns.
const USUAL_WIDTH: u16 = 80;

/// A table without a frame, as wide as the terminal at most.
pub(super) fn table<T: AsRef<str>>(header: impl IntoIterator<Item = T>) -> TextTable {
    let mut table = Table::new();
    table.load_preset(presets::NOTHING);
    table.set_style(TableComponent::HeaderLines, '─');
    table.set_content_arrangement(ContentArrangement::Dynamic);
    // Serial consoles, and terminals whose size was never set, report zero columns.
    if table.width() == Some(0) {
        table.set_width(USUAL_WIDTH);
    }
    table.set_header(header.into_iter().map(|cell| printable::line(cell.as_ref())));
    TextTable(table)
}

/// A table whose header and cells are each one line of text.
pub(super) struct TextTable(Table);

impl TextTable {
    /// Adds a row to the table.
    pub(super) fn add_row<T: AsRef<str>>(&mut self, cells: impl IntoIterator<Item = T>) {
        self.0
            .add_row(cells.into_iter().map(|cell| printable::line(cell.as_ref())));
    }

    /// Aligns a column to the right, as figures are.
    pub(super) fn align_right(&mut self, column: usize) {
        if let Some(column) = self.0.column_mut(column) {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
}

/// The table's lines, without the blanks that fill up the last column.
pub(super) fn lines(table: &TextTable) -> String {
    table.0.lines().map(|line| format!("{}\n", line.trim_end())).collect()
}
