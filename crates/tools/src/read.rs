//! `drivegate read`: points of one drive, once.

use super::client::{GatewayRequest, encoded};
use super::drive_access::{Needs, OneDrive, Target, point};
use super::failure::{Failure, Outcome, negative};
use super::report;
use drivegate_http::messages::{NO_REPLY, PointValue, Word};

/// Reads points of a drive once, through the running gateway or directly.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate read --config drivegate.toml pump-1
  drivegate read --config drivegate.toml pump-1 output_frequency motor_current
  drivegate read --config drivegate.toml pump-1 state fault_text

Without points: all that are polled. state and fault_text are derived from points. A running gateway is asked through its local socket; without one the command
opens the port itself, and no server: nobody else reads or commands the drive through it.")]
pub(super) struct Args {
    #[command(flatten)]
    drive: OneDrive,
    /// Names of points.
    points: Vec<String>,
    /// JSON instead of a table.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Outcome {
    let target = args.drive.target()?;
    let unknown = |name: &String| {
        let unknown = point(target.profile()?, name).err();
        unknown.filter(|_| Word::of(name).is_none())
    };
    if let Some(message) = args.points.iter().find_map(unknown) {
        return Err(Failure::Misused(message));
    }
    print(args, &target, &rows(&target, &args.points)?)
}

pub(super) fn rows(target: &Target, points: &[String]) -> Result<Vec<PointValue>, String> {
    let names = match points {
        [] => String::new(),
        names => format!("?names={}", encoded(&names.join(","))),
    };
    let asked = GatewayRequest::get(target.path("points") + &names);
    let (reply, _) = target.ask(&asked, Needs::Points(points))?;
    Ok(reply.accepted(&asked)?)
}

fn print(args: &Args, target: &Target, rows: &[PointValue]) -> Outcome {
    let all = rows.iter().all(PointValue::is_good);
    let none = !rows.iter().any(PointValue::is_good);
    if let Some(why) = only_reason(rows).filter(|_| !args.json) {
        let remedy = match why {
            NO_REPLY => format!("; {}", target.remedy_for_silence()),
            _ => String::new(),
        };
        return Err(format!("no point of `{}` has a value: {why}{remedy}", args.drive.name).into());
    }
    let printed = report::print(&if args.json { json(rows) } else { table(rows) });
    // Points requested by name must have a value.
    if none || (!all && !args.points.is_empty()) {
        return negative();
    }
    Ok(printed)
}

/// The reason why no point has a value, if several points all share it: it is then printed once.
fn only_reason(rows: &[PointValue]) -> Option<&str> {
    let (first, others) = rows.split_first().filter(|(_, others)| !others.is_empty())?;
    let same = |row: &PointValue| !row.is_good() && row.why == first.why;
    first
        .why
        .as_deref()
        .filter(|_| !first.is_good() && others.iter().all(same))
}

fn json(rows: &[PointValue]) -> String {
    serde_json::to_string_pretty(rows).unwrap_or_default() + "\n"
}

fn table(rows: &[PointValue]) -> String {
    let mut table = report::table(["point", "value", "unit", "quality", ""]);
    for row in rows {
        let value = match (&row.value, &row.text) {
            (serde_json::Value::Null, _) => String::new(),
            (serde_json::Value::String(word), _) => word.clone(),
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
