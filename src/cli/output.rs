//! What commands print. A reader that closes the pipe early ends the output, not the program.

use std::io::{self, Write};

use comfy_table::{ContentArrangement, Table, TableComponent, presets};

use super::Failure;
use crate::document::Problem;

/// Prints `text` to stdout.
pub(super) fn print(text: &str) -> Result<(), Failure> {
    let mut stdout = io::stdout().lock();
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Ok(()) => Ok(()),
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        Err(error) => Err(Failure::Work(format!(
            "cannot write the output: {error}; stdout; give it a place that can take it"
        ))),
    }
}

/// Prints one line to stderr.
pub(super) fn note(line: &str) {
    // There is nowhere left to tell that stderr is gone.
    let _ = writeln!(io::stderr().lock(), "{line}");
}

/// Prints problems to stderr, each as `kind: what; where; what to do`.
pub(super) fn problems(kind: &str, problems: &[Problem]) {
    for problem in problems {
        note(&format!("{kind}: {problem}"));
    }
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
