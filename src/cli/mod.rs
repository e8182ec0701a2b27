//! The command line, one file a command.
//!
//! A command is a module with `Args` (its options, its help, an example) and `run(Args)`, and a line in
//! `commands!` below.

mod check;
pub mod map;
mod output;
mod profiles;
mod schema;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;

use crate::config::{ENVIRONMENT, Settings};
use crate::document::Problem;

/// Exit code of a bad configuration (sysexits EX_CONFIG).
const BAD_CONFIGURATION: u8 = 78;
/// Exit code of a wrong command line, the same as clap's.
const WRONG_COMMAND_LINE: u8 = 2;
/// Exit code of what failed while working.
const FAILED: u8 = 1;

/// Puts RS-485 drives (frequency converters) on Modbus TCP, MQTT and Prometheus.
#[derive(Debug, Parser)]
#[command(name = "drivegate", version, max_term_width = 100)]
#[command(
    after_help = "Example:\n  drivegate check --config /etc/drivegate/drivegate.toml\n\n\
    Exit codes: 0 done, 1 failed while working, 2 wrong command line, 78 bad configuration."
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

macro_rules! commands {
    ($($variant:ident => $module:ident,)*) => {
        #[derive(Debug, clap::Subcommand)]
        enum Command {
            $($variant($module::Args),)*
        }

        impl Command {
            fn run(self) -> Result<(), Failure> {
                match self {
                    $(Command::$variant(args) => $module::run(args),)*
                }
            }
        }
    };
}

// In the order of the help.
commands! {
    Check => check,
    Profiles => profiles,
    Schema => schema,
}

/// The option that names the configuration.
#[derive(Debug, clap::Args)]
struct ConfigFile {
    /// The configuration.
    #[arg(
        long = "config",
        value_name = "FILE",
        default_value = "/etc/drivegate/drivegate.toml"
    )]
    path: PathBuf,
}

/// Why a command did not do what it should.
#[derive(Debug)]
enum Failure {
    /// Errors of the configuration or of a profile.
    Configuration(Vec<Problem>),
    /// A bad configuration that the command has told in its own way.
    ConfigurationTold,
    /// An argument that names nothing.
    CommandLine(Problem),
    /// Something failed while working: what; where; what to do.
    Work(String),
}

impl Failure {
    fn tell(&self) -> ExitCode {
        match self {
            Failure::Configuration(problems) => {
                output::problems("error", problems);
                ExitCode::from(BAD_CONFIGURATION)
            }
            Failure::ConfigurationTold => ExitCode::from(BAD_CONFIGURATION),
            Failure::CommandLine(problem) => {
                output::problems("error", std::slice::from_ref(problem));
                ExitCode::from(WRONG_COMMAND_LINE)
            }
            Failure::Work(message) => {
                output::note(&format!("error: {message}"));
                ExitCode::from(FAILED)
            }
        }
    }
}

/// Reads the command line, does what it says and returns the exit code.
pub fn main() -> ExitCode {
    match Cli::parse().command.run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => failure.tell(),
    }
}

/// The settings in `path` and the environment; warnings go to stderr.
fn settings(path: &Path) -> Result<Settings, Failure> {
    let loaded = Settings::load(path, environment()?.into_iter());
    output::problems("warning", &loaded.warnings);
    loaded.settings.ok_or(Failure::Configuration(loaded.errors))
}

/// The variables that override the configuration.
fn environment() -> Result<Vec<(String, String)>, Failure> {
    let mut variables = Vec::new();
    let mut problems = Vec::new();
    for (name, value) in std::env::vars_os() {
        let Some(name) = name.into_string().ok().filter(|name| name.starts_with(ENVIRONMENT)) else {
            continue;
        };
        match value.into_string() {
            Ok(value) => variables.push((name, value)),
            Err(_) => problems.push(Problem {
                file: name,
                line: None,
                key: String::new(),
                message: "the variable is no UTF-8 text; set it again".to_string(),
            }),
        }
    }
    match problems.is_empty() {
        true => Ok(variables),
        false => Err(Failure::Configuration(problems)),
    }
}
