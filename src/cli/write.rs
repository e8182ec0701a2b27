//! `drivegate write`: one command to one drive.

use std::process::ExitCode;

use super::oneshot::alone::Alone;
use super::oneshot::remote::{Failure, Remote, refusal};
use super::oneshot::{Target, reason, shown, target};
use super::read::{quiet, runtime};
use super::{EXIT_FAILED, EXIT_USAGE, report};
use crate::codec::Exception;
use crate::command::{Refusal, sets_twice};
use crate::drive::model::Kind;
use crate::drive::{Point, Profile, Source, Value};

/// Commands a drive once, through the running gateway or alone.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate write --config drivegate.toml pump-1 speed_reference=50 run=true
  drivegate write --config drivegate.toml pump-1 run=false
  drivegate write --config drivegate.toml pump-1 fault_reset=true

Several points are one command, in the order that is safe. The drive must have access = \"control\"; limits hold.
Nobody supervises what a command without a gateway has started.")]
pub(super) struct Args {
    #[command(flatten)]
    config: super::ConfigFile,
    /// The drive.
    drive: String,
    /// What is set.
    #[arg(required = true, value_name = "POINT=VALUE")]
    values: Vec<String>,
}

pub(super) fn run(args: &Args) -> ExitCode {
    let target = match target(&args.config.path, &args.drive) {
        Ok(target) => target,
        Err(code) => return code,
    };
    let values: Result<Vec<(usize, Value)>, String> = args.values.iter().map(|text| parse(&target, text)).collect();
    let values = match values {
        Ok(values) => values,
        Err(message) => {
            report::error(&message);
            return ExitCode::from(EXIT_USAGE);
        }
    };
    match command(&target, values) {
        Ok(text) => report::print(&text),
        Err(message) => {
            report::error(&message);
            ExitCode::from(EXIT_FAILED)
        }
    }
}

/// `speed_reference=50`, `run=true`, `mode=auto`.
fn parse(target: &Target, text: &str) -> Result<(usize, Value), String> {
    let (name, value) = text
        .split_once('=')
        .ok_or_else(|| format!("`{text}` sets nothing; command line; write POINT=VALUE, such as speed_reference=50"))?;
    let index = target.point(name.trim())?;
    let point = target.spec.profile.points.get(index);
    let point = point.ok_or_else(|| format!("there is no point `{name}`; command line; name another"))?;
    Ok((index, value_of(point, value.trim())?))
}

fn value_of(point: &Point, text: &str) -> Result<Value, String> {
    let bad = |wanted: &str| {
        format!(
            "`{text}` is no value for `{}`; command line; write {wanted}",
            point.name
        )
    };
    let meaning = point.texts.iter().find(|(_, meaning)| meaning.as_str() == text);
    match (point.kind(), text.to_ascii_lowercase().as_str()) {
        (Kind::Bool, "true" | "on" | "yes" | "1") => Ok(Value::Bool(true)),
        (Kind::Bool, "false" | "off" | "no" | "0") => Ok(Value::Bool(false)),
        (Kind::Bool, _) => Err(bad("true or false, on or off, yes or no, 1 or 0")),
        _ if meaning.is_some() => Ok(Value::Integer(meaning.map_or(0, |(code, _)| *code))),
        (Kind::Integer, _) => text.parse().map(Value::Integer).map_err(|_| bad("a whole number")),
        (Kind::Number, _) => {
            let number = text.parse::<f64>().ok().filter(|n| n.is_finite());
            number.map(Value::Number).ok_or_else(|| bad("a number"))
        }
    }
}

fn command(target: &Target, values: Vec<(usize, Value)>) -> Result<String, String> {
    let what = described(target, &values);
    if let Some(refusal) = contradiction(&target.spec.profile, &values) {
        return Err(format!("{what}: {refusal} ({})", refusal.code()));
    }
    if let Some(mut remote) = Remote::find(target)? {
        return match remote.write(&target.spec, &values) {
            Ok(()) => Ok(format!(
                "{what}: acknowledged, through the gateway at {}\n",
                remote.address()
            )),
            Err(Failure::Told(why)) => Err(why),
            Err(Failure::Refused { code, partly }) => Err(refused(target, &remote, &what, code, partly)),
        };
    }
    quiet();
    runtime()?.block_on(async {
        let alone = Alone::start(target).await?;
        let (answer, confirmed) = alone.write(values).await;
        alone.stop().await;
        if !answer.outcome.is_ok() {
            return Err(format!("{what}: {} ({})", answer.outcome, answer.outcome.code()));
        }
        let seen = match confirmed {
            Some(after) => format!("seen {:.0} ms after it was given", after.as_secs_f64() * 1000.0),
            None => "no read has shown it yet".to_string(),
        };
        let latency = answer.latency.as_secs_f64() * 1000.0;
        Ok(format!("{what}: acknowledged within {latency:.0} ms, {seen}\n"))
    })
}

/// Why the command cannot be meant, whichever way it would go: two values for one point of the drive.
fn contradiction(profile: &Profile, values: &[(usize, Value)]) -> Option<Refusal> {
    let mut set = Vec::with_capacity(values.len());
    for (index, _) in values {
        let index = written_to(profile, *index);
        if set.contains(&index) {
            return profile.points.get(index).map(|point| sets_twice(&point.name));
        }
        set.push(index);
    }
    None
}

/// The point that takes what is written to this one.
fn written_to(profile: &Profile, index: usize) -> usize {
    let next = |index: usize| {
        let point = profile.points.get(index)?;
        let base = match &point.source {
            Source::Derived(derived) => derived.band().map(|(of, ..)| of),
            Source::Raw(_) => None,
        };
        point.write_to.or(base).filter(|next| *next != index)
    };
    // A profile has no circles, and no way is longer than its points.
    let ways = std::iter::successors(Some(index), |index| next(*index));
    ways.take(profile.points.len()).last().unwrap_or(index)
}

/// What to tell of a command that the gateway has refused: its own words where they can be had, else what the exception
/// mostly means.
fn refused(target: &Target, remote: &Remote, what: &str, code: Exception, partly: bool) -> String {
    let why = reason::exact(target, remote).unwrap_or_else(|| format!("the gateway refused it with {}", refusal(code)));
    let rest = if partly {
        "; other values of this command were written before"
    } else {
        ""
    };
    format!("{what}: {why}; through the gateway at {}{rest}", remote.address())
}

fn described(target: &Target, values: &[(usize, Value)]) -> String {
    let one = |(index, value): &(usize, Value)| {
        let point = target.spec.profile.points.get(*index)?;
        Some(
            format!("{}={} {}", point.name, shown(point, *value), point.unit)
                .trim_end()
                .to_string(),
        )
    };
    let all: Vec<String> = values.iter().filter_map(one).collect();
    format!("{} {}", target.spec.name, all.join(" "))
}
