//! `drivegate man`: manual pages of the command line.

use std::fs;
use std::path::PathBuf;
use std::process::ExitCode;

use super::failure::Outcome;
use super::{command_line, report};

/// Writes a manual page for each command into a directory.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  drivegate man ~/.local/share/man/man1")]
pub(super) struct Args {
    /// Directory, which is created if it is missing.
    dir: PathBuf,
}

pub(super) fn run(args: &Args) -> Outcome {
    let dir = &args.dir;
    let written = fs::create_dir_all(dir).and_then(|()| clap_mangen::generate_to(command_line(), dir));
    written.map_err(|error| {
        format!(
            "cannot write the pages: {error}; {}; name another directory",
            dir.display()
        )
    })?;
    report::note(&format!("the pages are in {}", dir.display()));
    Ok(ExitCode::SUCCESS)
}
