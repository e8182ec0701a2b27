//! Manual pages and completions of the command line.

use std::fs;
use std::io;
use std::path::Path;

use clap_complete::Shell;

const SHELLS: [Shell; 3] = [Shell::Bash, Shell::Zsh, Shell::Fish];

/// Writes `man1/drivegate.1`, `man1/drivegate-COMMAND.1` and the completions of each shell into `folder`, which is
/// created if it is missing.
///
/// # Errors
///
/// A folder or file that cannot be written.
pub(crate) fn write(folder: &Path) -> io::Result<()> {
    let pages = folder.join("man1");
    fs::create_dir_all(&pages)?;
    clap_mangen::generate_to(drivegate_tools::command_line(), &pages)?;
    for shell in SHELLS {
        let mut command = drivegate_tools::command_line();
        clap_complete::generate_to(shell, &mut command, "drivegate", folder)?;
    }
    Ok(())
}
