//! `drivegate read`: points of one drive, once.

use std::process::ExitCode;

use super::oneshot::alone::Alone;
use super::oneshot::remote::Remote;
use super::oneshot::{Row, Target, target};
use super::{EXIT_FAILED, EXIT_USAGE, report};
use crate::cache::public_points;
use crate::config::{LogFormat, LogSettings};
use crate::drive::{PollClass, Source};

/// Reads points of a drive once, through the running gateway or alone.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate read --config drivegate.toml pump-1
  drivegate read --config drivegate.toml pump-1 output_frequency motor_current

Without points: all that are polled. A running gateway is asked by Modbus TCP; without one the port is opened.")]
pub(super) struct Args {
    #[command(flatten)]
    config: super::ConfigFile,
    /// The drive.
    drive: String,
    /// Points by name.
    points: Vec<String>,
    /// JSON instead of a table.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> ExitCode {
    let target = match target(&args.config.path, &args.drive) {
        Ok(target) => target,
        Err(code) => return code,
    };
    let points = match points(&target, &args.points) {
        Ok(points) => points,
        Err(message) => {
            report::error(&message);
            return ExitCode::from(EXIT_USAGE);
        }
    };
    match rows(target, points) {
        Ok(rows) => {
            let all = rows.iter().all(Row::is_good);
            let none = !rows.iter().any(Row::is_good);
            if let Some(why) = only_reason(&rows).filter(|_| !args.json) {
                report::error(&format!("no point of `{}` has a value: {why}", args.drive));
                return ExitCode::from(EXIT_FAILED);
            }
            let printed = report::print(&if args.json { json(&rows) } else { table(&rows) });
            // What was asked for by name must be there.
            if none || (!all && !args.points.is_empty()) {
                return ExitCode::from(EXIT_FAILED);
            }
            printed
        }
        Err(message) => {
            report::error(&message);
            ExitCode::from(EXIT_FAILED)
        }
    }
}

fn points(target: &Target, names: &[String]) -> Result<Vec<usize>, String> {
    if !names.is_empty() {
        return names.iter().map(|name| target.point(name)).collect();
    }
    let profile = &target.spec.profile;
    let told = |index: &usize| {
        let point = profile.points.get(*index);
        point.is_some_and(|p| matches!(p.source, Source::Derived(_)) || p.class != PollClass::Never)
    };
    Ok(public_points(profile)
        .into_iter()
        .map(|(index, _)| index)
        .filter(told)
        .collect())
}

fn rows(target: Target, points: Vec<usize>) -> Result<Vec<Row>, String> {
    if let Some(mut remote) = Remote::find(&target)? {
        return remote.read(&target.spec, &points);
    }
    quiet();
    runtime()?.block_on(async {
        let alone = Alone::start(&target).await?;
        let rows = alone.read(&points).await;
        alone.stop().await;
        Ok(rows)
    })
}

/// Why none of several points has a value, where that is one reason for all: once is enough.
fn only_reason(rows: &[Row]) -> Option<&str> {
    let (first, others) = rows.split_first().filter(|(_, others)| !others.is_empty())?;
    let same = |row: &Row| !row.is_good() && row.why == first.why;
    first
        .why
        .as_deref()
        .filter(|_| !first.is_good() && others.iter().all(same))
}

/// A command says what happens itself; of the log only the audit is left.
pub(super) fn quiet() {
    super::log::start_in_order(&LogSettings {
        level: "off,audit=info".to_string(),
        format: LogFormat::Auto,
    });
}

/// The runtime of a command that works alone.
pub(super) fn runtime() -> Result<tokio::runtime::Runtime, String> {
    let built = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build();
    built.map_err(|why| format!("cannot start: {why}; the runtime; free memory, threads or file descriptors"))
}

fn json(rows: &[Row]) -> String {
    serde_json::to_string_pretty(rows).unwrap_or_default() + "\n"
}

fn table(rows: &[Row]) -> String {
    let mut table = report::table(["point", "value", "unit", "quality", ""]);
    for row in rows {
        let value = match (&row.value, &row.text) {
            (serde_json::Value::Null, _) => String::new(),
            (value, Some(text)) => format!("{value} ({text})"),
            (value, None) => value.to_string(),
        };
        table.add_row([
            row.point.clone(),
            value,
            row.unit.clone(),
            row.quality.clone(),
            row.why.clone().unwrap_or_default(),
        ]);
    }
    report::lines(&table)
}
