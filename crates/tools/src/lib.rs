//! The command line, one file a command.
//!
//! A command is a module with `Args` (its options, its help, an example) and `run(&Args) -> Outcome`, and a line in
//! `commands!` below.

mod adapters;
mod addresses;
mod archive;
mod audit;
mod backup;
mod certificate;
mod check;
mod client;
mod completions;
mod credentials_file;
mod demo;
mod diagnose;
mod drill_command;
mod drive_access;
mod failure;
mod health;
mod hold_command;
mod inventory;
mod listen;
mod loading;
mod log;
mod man;
mod map;
mod params;
mod port_users;
mod printable;
mod profiles;
mod read;
mod record;
mod recordings;
mod reload;
mod replay;
mod report;
mod restore;
mod run;
mod scan;
mod schema;
mod simulate;
mod stop_all_command;
mod token;
mod trace;
mod trial;
mod user;
mod verify;
mod watch;
mod why;
mod write;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::LazyLock;

use clap::Parser;

use self::failure::{Failure, Outcome};
use drivegate_gateway::config::{Settings, environment};
use drivegate_model::drive::profile::Profiles;

/// Exit code of a failure.
pub const EXIT_FAILED: u8 = 1;
/// Exit code for a wrong command line; clap uses this code as well.
pub const EXIT_USAGE: u8 = 2;
/// Exit code for input data that is not valid (sysexits EX_DATAERR).
pub const EXIT_DATA: u8 = 65;
/// Exit code of a bad configuration (sysexits EX_CONFIG).
pub const EXIT_CONFIG: u8 = 78;
/// Default path of the configuration.
pub const DEFAULT_CONFIG: &str = drivegate_gateway::config::DEFAULT_FILE;

/// The variable that names the configuration where `--config` is missing.
const CONFIG_VARIABLE: &str = "DRIVEGATE_CONFIG";

/// The configuration named by [`CONFIG_VARIABLE`].
fn config_of_environment() -> Option<&'static Path> {
    static NAMED: LazyLock<Option<PathBuf>> = LazyLock::new(|| {
        let named = std::env::var_os(CONFIG_VARIABLE).filter(|named| !named.is_empty());
        named.map(PathBuf::from)
    });
    NAMED.as_deref()
}

/// The configuration to use without `--config`.
fn default_config() -> &'static Path {
    config_of_environment().unwrap_or(Path::new(DEFAULT_CONFIG))
}

/// Version and commit of the build.
static VERSION: LazyLock<String> = LazyLock::new(|| match drivegate_core::version::commit() {
    Some(commit) => format!("{} (commit {commit})", drivegate_core::version::VERSION),
    None => drivegate_core::version::VERSION.to_string(),
});

/// Puts RS-485 drives (frequency converters) on Modbus TCP, MQTT and Prometheus.
#[derive(Debug, Parser)]
#[command(name = "drivegate", version = VERSION.as_str(), max_term_width = 100)]
#[command(
    after_help = "Example:\n  drivegate check --config /etc/drivegate/drivegate.toml\n\n\
    Exit codes: 0 success, 1 failure, 2 wrong command line, 78 invalid configuration."
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
            fn run(&self) -> Outcome {
                match self {
                    $(Command::$variant(args) => $module::run(args),)*
                }
            }
        }
    };
}

// The commands are in the order of the help.
commands! {
    Run => run,
    Reload => reload,
    Health => health,
    Demo => demo,
    Try => trial,
    Check => check,
    Scan => scan,
    Listen => listen,
    Read => read,
    Write => write,
    StopAll => stop_all_command,
    Hold => hold_command,
    Drill => drill_command,
    Why => why,
    Diagnose => diagnose,
    Record => record,
    Recordings => recordings,
    Params => params,
    Watch => watch,
    Trace => trace,
    Replay => replay,
    Simulate => simulate,
    Profiles => profiles,
    Verify => verify,
    Map => map,
    Inventory => inventory,
    Audit => audit,
    Token => token,
    User => user,
    Certificate => certificate,
    Backup => backup,
    Restore => restore,
    Schema => schema,
    Completions => completions,
    Man => man,
}

/// The option that names the configuration.
#[derive(Debug, clap::Args)]
struct ConfigFile {
    /// Configuration file.
    #[arg(long = "config", value_name = "FILE", default_value_os_t = default_config().to_path_buf())]
    path: PathBuf,
}

/// The option that names the configuration, or the configuration itself.
#[derive(Debug, clap::Args)]
struct NamedConfig {
    #[command(flatten)]
    config: ConfigFile,
    /// Configuration file, as with --config.
    #[arg(value_name = "FILE", conflicts_with = "path")]
    file: Option<PathBuf>,
}

impl NamedConfig {
    fn path(&self) -> &Path {
        self.file.as_deref().unwrap_or(&self.config.path)
    }
}

/// The whole command line, from which manual pages and completions are made.
#[must_use]
pub fn command_line() -> clap::Command {
    <Cli as clap::CommandFactory>::command()
}

/// Runs the command of the command line and returns its exit code.
pub fn main() -> ExitCode {
    Cli::parse().command.run().unwrap_or_else(Failure::report)
}

/// The runtime of a command that has one thing to do.
fn runtime() -> Result<tokio::runtime::Runtime, String> {
    let built = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build();
    built.map_err(cannot_start)
}

/// Runs `work` on a runtime of its own. A disk that hangs still has a thread then; the result is known all the same.
fn without_waiting_for_threads<T>(work: impl Future<Output = Result<T, String>>) -> Result<T, String> {
    let runtime = runtime()?;
    let done = runtime.block_on(work);
    runtime.shutdown_background();
    done
}

/// Runs `command` on a new runtime.
fn block_on(command: impl Future<Output = Outcome>) -> Outcome {
    let runtime = drivegate_north::reading::watched_runtime();
    runtime.map_err(cannot_start)?.block_on(command)
}

fn cannot_start(why: std::io::Error) -> String {
    format!("cannot start: {why}; free memory, threads or file descriptors")
}

/// Loads the settings of a valid configuration.
fn settings(path: &Path) -> Result<Settings, Failure> {
    let loaded = Settings::load(path, environment());
    loaded.settings.ok_or(Failure::Invalid(loaded.errors))
}

/// The built-in profiles, and the profiles in these directories.
fn profiles_of(dirs: &[PathBuf]) -> Result<Profiles, Failure> {
    let mut profiles = Profiles::built_in();
    add_profiles(&mut profiles, dirs)?;
    Ok(profiles)
}

fn add_profiles(profiles: &mut Profiles, dirs: &[PathBuf]) -> Result<(), Failure> {
    let problems: Vec<_> = dirs.iter().flat_map(|dir| profiles.load(dir)).collect();
    if problems.is_empty() {
        Ok(())
    } else {
        Err(Failure::Invalid(problems))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_result_waits_for_no_thread_that_hangs() {
        let ((free, hangs), (tell, told)) = (channel::<()>(), channel());
        let command = std::thread::spawn(move || {
            let done = without_waiting_for_threads(async {
                let (begun, began) = tokio::sync::oneshot::channel();
                drop(tokio::task::spawn_blocking(move || {
                    let _ = begun.send(());
                    hangs.recv()
                }));
                began.await.map_err(|_| "not begun".to_string())
            });
            tell.send(done)
        });
        let done = told.recv_timeout(Duration::from_secs(30));
        drop(free);
        command.join().unwrap().unwrap();
        assert_eq!(done, Ok(Ok(())));
    }
}
