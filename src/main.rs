//! The program: everything is in the library.

use std::process::ExitCode;

fn main() -> ExitCode {
    drivegate::version::set_commit(option_env!("DRIVEGATE_COMMIT"));
    drivegate::cli::main()
}
