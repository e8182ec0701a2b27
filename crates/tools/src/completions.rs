//! `drivegate completions`: completions of the command line for a shell.

use clap::ValueEnum;
use clap_complete::Shell;

use super::failure::Outcome;
use super::{command_line, report};

/// Prints the completions of the command line for a shell.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate completions bash > /etc/bash_completion.d/drivegate
  drivegate completions fish > ~/.config/fish/completions/drivegate.fish")]
pub(super) struct Args {
    /// The shell.
    shell: Name,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Name {
    Bash,
    Zsh,
    Fish,
}

pub(super) fn run(args: &Args) -> Outcome {
    let shell = match args.shell {
        Name::Bash => Shell::Bash,
        Name::Zsh => Shell::Zsh,
        Name::Fish => Shell::Fish,
    };
    let mut text = Vec::new();
    clap_complete::generate(shell, &mut command_line(), "drivegate", &mut text);
    Ok(report::print_bytes(&text))
}
