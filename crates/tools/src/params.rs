//! `drivegate params`: parameters of drives read, compared, restored, listed and shown.

mod restore;
mod stored;

use std::io::{IsTerminal, Write as _};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use super::client::Gateway;
use super::drive_access::target;
use super::failure::{Failure, Outcome, documented, negative};
use super::report;
use drivegate_core::files;
use drivegate_core::parameters::{Names, ParameterFile, differences, read as read_file};
use drivegate_http::messages::{ParameterReading, ReadParameters};

/// Reads, compares, restores and shows the parameters of drives.
///
/// Parameters are read at the lowest priority, through a running gateway alongside its process data; without one the
/// command opens the port itself. A drive is named as in the configuration, a file by its path.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate params read pump-1 -o pump-1.params
  drivegate params diff pump-1.params pump-1
  drivegate params restore pump-1.params pump-1 --dry-run
  drivegate params list
  drivegate params show pump-1")]
pub(super) struct Args {
    #[command(flatten)]
    gateway: Gateway,
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, clap::Subcommand)]
enum Action {
    /// Reads all parameters of a drive.
    #[command(after_help = "Examples:
  drivegate params read pump-1 -o pump-1.params
  drivegate params read fan-1 --names vacon-cx.csv --afresh")]
    Read(ReadArgs),
    /// Shows what differs between two drives or files.
    #[command(after_help = "Examples:
  drivegate params diff pump-1.params pump-1
  drivegate params diff pump-1 pump-2

Exit code 0: nothing differs; 1: something does, or it could not be found out.")]
    Diff {
        /// Path of a file, or name of a drive to read.
        before: String,
        /// Likewise.
        after: String,
    },
    /// Writes the parameters that differ from a file to a drive, while its motor is stopped.
    #[command(after_help = "Examples:
  drivegate params restore pump-1.params pump-1
  drivegate params restore pump-1.params pump-1 --only 102 --yes
  drivegate params restore --resume pump-1

Shows the plan first, and asks. The drive needs access = \"control\" and params = \"write\". While parameters are written
the drive accepts only stops; after an interrupted restore it does so until that is resumed, undone or released. A running gateway
continues the restore if the command is interrupted.")]
    Restore(restore::RestoreArgs),
    /// Copies the parameters of a drive to another of the same kind.
    #[command(after_help = "Example:\n  drivegate params clone pump-1 pump-2 --dry-run")]
    Clone {
        /// Name of the drive to read.
        from: String,
        /// Name of the drive to write.
        to: String,
        #[command(flatten)]
        how: restore::How,
    },
    /// Lists the stored readings, oldest first.
    ///
    /// Reads the files of the configuration, or with --url asks the gateway there.
    #[command(after_help = "Examples:
  drivegate params list pump-1
  drivegate params list --json --url http://gateway:9488")]
    List {
        /// Name of a drive [default: all].
        drive: Option<String>,
        /// JSON instead of a table.
        #[arg(long)]
        json: bool,
    },
    /// Shows a file, or the last stored reading of a drive.
    ///
    /// Reads the files of the configuration, or with --url asks the gateway there.
    #[command(after_help = "Examples:
  drivegate params show pump-1
  drivegate params show pump-1.params --names vacon-nx.csv")]
    Show {
        /// Path of a file, or name of a drive.
        of: String,
        /// Your own list of names: CSV with id, name, unit, scale.
        #[arg(long, value_name = "FILE")]
        names: Option<PathBuf>,
    },
}

#[derive(Debug, clap::Args)]
struct ReadArgs {
    /// Name of the drive.
    drive: String,
    /// File to write [default: standard output].
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Reads every address, regardless of what earlier readings found.
    #[arg(long)]
    afresh: bool,
    /// Takes up to 18 % of a busy line from process data, instead of 1.5 %.
    #[arg(long)]
    brisk: bool,
    /// Your own list of names: CSV with id, name, unit, scale.
    #[arg(long, value_name = "FILE")]
    names: Option<PathBuf>,
}

pub(super) fn run(args: &Args) -> Outcome {
    let gateway = &args.gateway;
    match &args.action {
        Action::Read(read) => read_drive(gateway, read),
        Action::Diff { before, after } => diff(gateway, before, after),
        Action::Restore(args_of_it) => restore::restore(gateway, args_of_it),
        Action::Clone { from, to, how } => restore::clone(gateway, from, to, how),
        Action::List { drive, json } => documented(*json, stored::list(gateway, drive.as_deref(), *json)),
        Action::Show { of, names } => stored::show(gateway, of, names.as_deref()),
    }
}

fn read_drive(gateway: &Gateway, args: &ReadArgs) -> Outcome {
    let names = names(args.names.as_deref())?;
    let (file, profile) = read_from_drive(gateway, &args.drive, args.how())?;
    let file = match names {
        Some(names) => file.named(&profile, &names),
        None => file,
    };
    if file.missing() > 0 {
        report::warning(&format!(
            "{} parameters were not read; the file says why",
            file.missing()
        ));
    }
    let Some(output) = &args.output else {
        return Ok(report::print(&file.text()));
    };
    files::replace(output, file.text().as_bytes()).map_err(|error| {
        format!(
            "cannot write the file: {error}; {}; name another place",
            output.display()
        )
    })?;
    report::note(&format!(
        "{} of {} are in {}",
        file.application(),
        args.drive,
        output.display()
    ));
    Ok(ExitCode::SUCCESS)
}

impl ReadArgs {
    fn how(&self) -> ReadParameters {
        ReadParameters {
            afresh: self.afresh,
            brisk: self.brisk,
        }
    }
}

type Found = (ParameterFile, std::sync::Arc<drivegate_model::drive::Profile>);

fn read_from_drive(gateway: &Gateway, drive: &str, how: ReadParameters) -> Result<Found, Failure> {
    let target = target(gateway, drive)?;
    let mut line = StatusLine::default();
    let mut begun = false;
    let text = target.read_parameters(how, |outcome| {
        if outcome.total > 0 {
            if !std::mem::replace(&mut begun, true) {
                report::note(&format!(
                    "reading {} addresses of {drive}: first those of the parameters that its profile names",
                    outcome.total
                ));
            }
            line.show(&reading_in_words(outcome));
        }
    });
    line.end();
    let file = ParameterFile::parse(&text?).map_err(|why| format!("the gateway's file is invalid: {why}"))?;
    let profile = match target.profile() {
        Some(profile) => profile.clone(),
        None => built_in(&file.family)?,
    };
    Ok((file, profile))
}

fn built_in(family: &str) -> Result<std::sync::Arc<drivegate_model::drive::Profile>, Failure> {
    let profile = drivegate_model::drive::profile::Profiles::built_in()
        .get(family)
        .cloned();
    Ok(profile.ok_or_else(|| format!("profile `{family}` is not built in; --names; name the list in [params]"))?)
}

/// Interval of progress lines when the output is not a terminal.
const SAID_EVERY: Duration = Duration::from_secs(60);

/// A status line on a terminal, kept up to date; elsewhere a line once a minute.
#[derive(Debug, Default)]
struct StatusLine {
    shown: bool,
    /// When the status line started, or last printed a line, off a terminal.
    said: Option<Instant>,
}

impl StatusLine {
    fn show(&mut self, text: &str) {
        let mut stderr = std::io::stderr();
        if !stderr.is_terminal() {
            if self.is_due(Instant::now()) {
                report::note(text);
            }
            return;
        }
        self.shown = true;
        // If the terminal no longer exists, the error is ignored.
        let _ = write!(stderr, "\r\x1b[K{text}");
    }

    /// Whether a progress line is due when output is not a terminal: work that ends within a minute needs none.
    fn is_due(&mut self, now: Instant) -> bool {
        let said = *self.said.get_or_insert(now);
        let due = now.saturating_duration_since(said) >= SAID_EVERY;
        if due {
            self.said = Some(now);
        }
        due
    }

    fn end(&self) {
        if self.shown {
            let _ = write!(std::io::stderr(), "\r\x1b[K");
        }
    }
}

fn reading_in_words(outcome: &ParameterReading) -> String {
    let left = outcome
        .remaining_s
        .map(|seconds| format!("about {} left", seconds_in_words(seconds)));
    let rest = match &outcome.waits {
        Some(why) => vec![format!("waits: {why}")],
        None => left.into_iter().chain(outcome.now.clone()).collect(),
    };
    let counted = format!("{} of {} addresses", outcome.done, outcome.total);
    [vec![counted], rest].concat().join(", ")
}

fn seconds_in_words(seconds: f64) -> String {
    match seconds {
        s if s < 90.0 => format!("{s:.0} s"),
        s if s < 5400.0 => format!("{:.0} min", s / 60.0),
        s => format!("{:.1} h", s / 3600.0),
    }
}

/// Reads a parameter file.
fn read_written(path: &Path) -> Result<ParameterFile, Failure> {
    Ok(read_file(path).map_err(|why| format!("{why}; name a file that `params read` wrote"))?)
}

/// A parameter file if one exists at this path, otherwise the parameters read from the drive with this name.
fn file_or_drive(gateway: &Gateway, of: &str) -> Result<ParameterFile, Failure> {
    if Path::new(of).is_file() {
        read_written(Path::new(of))
    } else {
        Ok(read_from_drive(gateway, of, ReadParameters::default())?.0)
    }
}

fn diff(gateway: &Gateway, before: &str, after: &str) -> Outcome {
    let (before, after) = (file_or_drive(gateway, before)?, file_or_drive(gateway, after)?);
    if before.family != after.family {
        return Err(Failure::Misused(format!(
            "`{}` is of family {}, `{}` of {}; command line; compare drives of one family",
            before.drive, before.family, after.drive, after.family
        )));
    }
    let found = differences(&before, &after);
    let text: String = found.iter().map(|difference| difference.line() + "\n").collect();
    let printed = report::print(&text);
    if found.is_empty() { Ok(printed) } else { negative() }
}

fn names(path: Option<&Path>) -> Result<Option<Names>, Failure> {
    let Some(path) = path else { return Ok(None) };
    let shown = path.display();
    let text = std::fs::read_to_string(path)
        .map_err(|error| format!("cannot read the names: {error}; {shown}; name a CSV file"))?;
    let names =
        Names::parse(&text).map_err(|why| format!("{why}; {shown}; write id, name, unit, scale in each row"))?;
    Ok(Some(names))
}
