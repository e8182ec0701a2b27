//! Writes the manual pages and the completions for bash, zsh and fish into a folder:
//! `cargo run --example manual -- FOLDER`.

mod pages;

use std::path::PathBuf;
use std::process::ExitCode;

fn main() -> ExitCode {
    let Some(folder) = std::env::args_os().nth(1).map(PathBuf::from) else {
        eprintln!("error: no folder given; run `cargo run --example manual -- FOLDER`");
        return ExitCode::from(2);
    };
    match pages::write(&folder) {
        Ok(()) => ExitCode::SUCCESS,
        Err(why) => {
            eprintln!(
                "error: cannot write to {}: {why}; check free space and permissions",
                folder.display()
            );
            ExitCode::FAILURE
        }
    }
}
