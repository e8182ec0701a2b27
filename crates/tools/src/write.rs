//! `drivegate write`: one command to one drive.

use std::process::ExitCode;

use super::drive_access::{Target, Way, target};
use super::{EXIT_FAILED, EXIT_USAGE, printable, report};
use crate::drive::model::Kind;
use crate::drive::{Point, RESTART_COMMUNICATION, Value};
use crate::north::local::protocol::{Outcome, Request, Setting, WriteOutcome, WriteRequest};
use crate::process_image::value_or_null;

/// Commands a drive once, through the running gateway or directly.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate write --config drivegate.toml pump-1 speed_reference=50 run=true
  drivegate write --config drivegate.toml pump-1 run=false
  drivegate write --config drivegate.toml pump-1 fault_reset=true

Several points are sent as one command, in a safe order. The drive must have access = \"control\"; limits hold.
Without a gateway nothing supervises a motor that the command has started.")]
pub(super) struct Args {
    #[command(flatten)]
    config: super::ConfigFile,
    /// Name of the drive.
    drive: String,
    /// What to set.
    #[arg(required = true, value_name = "POINT=VALUE")]
    values: Vec<String>,
}

pub(super) fn run(args: &Args) -> ExitCode {
    let target = match target(&args.config.path, &args.drive) {
        Ok(target) => target,
        Err(code) => return code,
    };
    let settings: Result<Vec<(Setting, String)>, String> =
        args.values.iter().map(|text| parse(&target, text)).collect();
    let settings = match settings {
        Ok(settings) => settings,
        Err(message) => {
            report::error(&message);
            return ExitCode::from(EXIT_USAGE);
        }
    };
    match command(&target, settings) {
        Ok(text) => report::print(&text),
        Err(message) => {
            report::error(&message);
            ExitCode::from(EXIT_FAILED)
        }
    }
}

/// `speed_reference=50`, `run=true`, `mode=auto`: what is set, and how it is shown.
fn parse(target: &Target, text: &str) -> Result<(Setting, String), String> {
    let (name, text) = text.split_once('=').ok_or_else(|| {
        format!("expected POINT=VALUE, got `{text}`; command line; write for example speed_reference=50")
    })?;
    let profile = &target.spec.profile;
    if name.trim() == RESTART_COMMUNICATION && profile.counts_messages {
        return match text.trim() {
            "true" => Ok((
                Setting {
                    point: RESTART_COMMUNICATION.to_string(),
                    value: true.into(),
                },
                format!("{RESTART_COMMUNICATION}=true"),
            )),
            other => Err(format!(
                "`{other}` is not a value of `{RESTART_COMMUNICATION}`; write true"
            )),
        };
    }
    let index = target.point(name.trim())?;
    let point = target.spec.profile.points.get(index);
    let point = point.ok_or_else(|| format!("there is no point `{name}`; command line; name another"))?;
    let value = value_of(point, text.trim())?;
    let meaning = point
        .text_of(value)
        .map(|meaning| format!(" ({meaning})"))
        .unwrap_or_default();
    let shown = format!("{}={value}{meaning} {}", point.name, point.unit);
    // The text of an enumeration is left to the gateway: its profile says which code that is.
    let is_meaning = point.kind() != Kind::Bool && point.texts.values().any(|meaning| meaning == text.trim());
    let setting = Setting {
        point: point.name.clone(),
        value: if is_meaning {
            text.trim().into()
        } else {
            value_or_null(Some(value))
        },
    };
    Ok((setting, shown.trim_end().to_string()))
}

fn value_of(point: &Point, text: &str) -> Result<Value, String> {
    let bad = |wanted: &str| {
        let name = &point.name;
        format!("`{text}` is not a value of `{name}`; command line; write {wanted}")
    };
    let meaning = point.code_of(text);
    match (point.kind(), text.to_ascii_lowercase().as_str()) {
        (Kind::Bool, "true" | "on" | "yes" | "1") => Ok(Value::Bool(true)),
        (Kind::Bool, "false" | "off" | "no" | "0") => Ok(Value::Bool(false)),
        (Kind::Bool, _) => Err(bad("true or false, on or off, yes or no, 1 or 0")),
        _ if meaning.is_some() => Ok(Value::Integer(meaning.unwrap_or_default())),
        (Kind::Integer, _) => text.parse().map(Value::Integer).map_err(|_| bad("a whole number")),
        (Kind::Text, _) => Err(bad("another point: this one is a text, which is only read")),
        (Kind::Number, _) => {
            let number = text.parse::<f64>().ok().filter(|n| n.is_finite());
            number.map(Value::Number).ok_or_else(|| bad("a number"))
        }
    }
}

fn command(target: &Target, settings: Vec<(Setting, String)>) -> Result<String, String> {
    let (points, shown): (Vec<Setting>, Vec<String>) = settings.into_iter().unzip();
    let what = format!("{} {}", target.spec.name, shown.join(" "));
    let request = Request::Write(WriteRequest {
        drive: target.spec.name.clone(),
        expect: Some(target.expected()),
        points,
    });
    match target.ask(&request)? {
        (Outcome::Write(write), way) if write.ok => Ok(acknowledged(&what, &write, way)),
        (Outcome::Write(write), _) => Err(format!("{what}: {} ({})", write.message, write.result)),
        (other, _) => Err(other.not_asked_for()),
    }
}

fn acknowledged(what: &str, write: &WriteOutcome, way: Way) -> String {
    let confirmed = match write.confirmed_ms {
        Some(after) => format!("confirmed after {after:.0} ms"),
        None => match &write.known {
            Some(known) => format!("not confirmed by a read: {}", printable::line(known)),
            None => "not confirmed by a read".to_string(),
        },
    };
    let way = match way {
        Way::Gateway => ", through the gateway",
        Way::Direct => "",
    };
    format!(
        "{}: acknowledged after {:.0} ms, {confirmed}{way}\n",
        printable::line(what),
        write.latency_ms
    )
}
