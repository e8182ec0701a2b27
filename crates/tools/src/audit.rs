//! `drivegate audit verify`: whether an audit file is as the gateway wrote it.

use std::fs::File;
use std::io::{self, BufRead, BufReader};
use std::path::{Path, PathBuf};

use super::failure::{Outcome, negative};
use super::report;
use drivegate_core::order::chain::{Hash, Verifier, seq};

/// Longest line that is read, bytes; any entry is far shorter.
const LONGEST_LINE: u64 = 16 << 20;
/// Maximum number of findings that are printed.
const PRINTED: usize = 20;

/// Checks the file of commands that the gateway writes ([audit])
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  drivegate audit verify /var/lib/drivegate/audit.jsonl")]
pub(super) struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    Verify(Verify),
}

/// Checks that nothing in the file was changed or removed
///
/// Each line has the hash of the line before it, which reveals changed and missing lines. To detect a truncated end,
/// compare with a hash that the gateway logged: once a minute, under target `audit`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  drivegate audit verify audit.jsonl\n  \
    drivegate audit verify audit.jsonl* --last 9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08\n\n\
    Exit codes: 0 the file is intact, 1 it is not or cannot be read.")]
struct Verify {
    /// The audit file, or several in any order to include older ones.
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,
    /// The hash of a line that must be present.
    #[arg(long, value_name = "HASH")]
    last: Option<Hash>,
}

pub(super) fn run(args: &Args) -> Outcome {
    let Command::Verify(verify) = &args.command;
    match verify.run() {
        Ok(text) => Ok(report::print(&text)),
        Err(faults) => {
            faults.iter().take(PRINTED).for_each(|fault| report::error(fault));
            if faults.len() > PRINTED {
                report::note(&format!("{} further findings", faults.len() - PRINTED));
            }
            negative()
        }
    }
}

impl Verify {
    /// Verifies the files. Returns the summary if the files are intact.
    fn run(&self) -> Result<String, Vec<String>> {
        let ordered = in_order(&self.files).map_err(|error| vec![error])?;
        let (mut verifier, mut faults, mut lines) = (Verifier::new(self.last), Vec::new(), 0);
        let mut place = String::new();
        for path in &ordered {
            let mut file = Lines::open(path).map_err(|error| vec![error])?;
            let mut number = 0u64;
            while let Some(line) = file.next().transpose() {
                number += 1;
                let before = std::mem::replace(&mut place, format!("{}:{number}", path.display()));
                match line {
                    Ok(line) => {
                        let found = verifier.line(&line).err();
                        faults
                            .extend(found.map(|found| fault(&found.why, if found.before { &before } else { &place })));
                    }
                    Err(error) => {
                        faults.push(error);
                        return Err(faults);
                    }
                }
            }
            if file.cut {
                faults.push(fault(
                    "the line is incomplete: truncated by a crash or by someone",
                    &place,
                ));
            }
            lines += number;
        }
        if let (Err(why), false) = (
            verifier.finish(),
            faults.iter().any(|fault| fault.contains("truncated")),
        ) {
            faults.push(fault(&why, &place));
        }
        match verifier.chain() {
            _ if !faults.is_empty() => Err(faults),
            Some(chain) => Ok(format!(
                "{lines} lines are whole; the last is entry {} with the hash {}\n",
                chain.seq, chain.last
            )),
            None => Ok("no lines\n".to_string()),
        }
    }
}

fn fault(why: &str, place: &str) -> String {
    format!("{why}; {place}; compare with the log, and with a backup if there is one")
}

/// The files, sorted by the number of their first entry.
fn in_order(files: &[PathBuf]) -> Result<Vec<PathBuf>, String> {
    let mut numbered = Vec::new();
    for path in files {
        let first = Lines::open(path)?.next()?.and_then(|line| seq(&line));
        numbered.push((first, path.clone()));
    }
    numbered.sort();
    Ok(numbered.into_iter().map(|(_, path)| path).collect())
}

/// The lines of a file.
struct Lines {
    path: PathBuf,
    reader: BufReader<File>,
    /// The last line had no end.
    cut: bool,
}

impl Lines {
    fn open(path: &Path) -> Result<Lines, String> {
        let file = File::open(path).map_err(|error| unreadable(path, &error))?;
        Ok(Lines {
            path: path.to_path_buf(),
            reader: BufReader::new(file),
            cut: false,
        })
    }

    /// The next line without its line end.
    fn next(&mut self) -> Result<Option<Vec<u8>>, String> {
        let mut line = Vec::new();
        let read = io::Read::take(&mut self.reader, LONGEST_LINE).read_until(b'\n', &mut line);
        if read.map_err(|error| unreadable(&self.path, &error))? == 0 {
            return Ok(None);
        }
        self.cut = line.pop_if(|last| *last == b'\n').is_none();
        Ok(Some(line))
    }
}

fn unreadable(path: &Path, error: &io::Error) -> String {
    format!(
        "cannot read the audit: {error}; {}; name a file that can be read",
        path.display()
    )
}
