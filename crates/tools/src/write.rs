//! `drivegate write`: one command to one drive.

use serde::{Deserialize, Serialize, Serializer};
use serde_json::Value as Json;

use super::client::GatewayRequest;
use super::drive_access::{Needs, OneDrive, RequestRoute, Target, point};
use super::failure::{Failure, Outcome, documented};
use super::{printable, report};
use drivegate_core::process_image::value_or_null;
use drivegate_model::drive::model::Kind;
use drivegate_model::drive::{ModelPoint, Point, Profile, RESTART_COMMUNICATION, Value};

/// Commands a drive once, through the running gateway or directly.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate write --config drivegate.toml pump-1 speed_reference=50 run=true
  drivegate write --config drivegate.toml pump-1 run=false
  drivegate write --config drivegate.toml pump-1 fault_reset=true

Several points are sent as one command, in a safe order. The drive must have access = \"control\"; limits hold.
Without a gateway the command opens the port itself, and nothing supervises a motor that it has started. Guards, and
BACnet locks and reservations that the gateway left in state_dir, refuse starts as with it.")]
pub(super) struct Args {
    #[command(flatten)]
    drive: OneDrive,
    /// What to set.
    #[arg(required = true, value_name = "POINT=VALUE")]
    values: Vec<String>,
    /// The reply of the gateway as JSON.
    #[arg(long)]
    json: bool,
}

/// A value of a command, and how it is shown.
#[derive(Debug)]
struct Setting {
    point: String,
    value: Json,
    shown: String,
}

/// The body of a command, with all that was given: what is given twice is for the gateway to refuse.
struct Body<'s>(&'s [Setting]);

impl Serialize for Body<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.iter().map(|setting| (&setting.point, &setting.value)))
    }
}

/// How the write of a command ended.
#[derive(Debug, Deserialize)]
struct Written {
    ok: bool,
    result: String,
    latency_ms: f64,
    confirmed_ms: Option<f64>,
    error: Option<WriteError>,
    /// Note on the result, where no read shows the effect.
    note: Option<String>,
}

#[derive(Debug, Deserialize)]
struct WriteError {
    message: String,
}

pub(super) fn run(args: &Args) -> Outcome {
    let mut printed = false;
    let outcome = write(args, &mut printed);
    documented(args.json && !printed, outcome)
}

/// Sends the command; `printed` is set when a document was printed.
fn write(args: &Args, printed: &mut bool) -> Outcome {
    let target = args.drive.target()?;
    let setting = |text: &String| parse(target.profile().map(|profile| &**profile), text);
    let (mut settings, mut mistake) = (Vec::new(), None);
    for parsed in args.values.iter().map(setting) {
        match parsed {
            Ok(setting) => settings.push(setting),
            Err(why) => mistake = mistake.or(Some(why)),
        }
    }
    let mut send = |settings: &[Setting]| -> Outcome {
        let (document, told) = command(&target, settings)?;
        if args.json {
            *printed = true;
            let shown = report::json(&document);
            return told.map(|_| shown).map_err(Failure::from);
        }
        Ok(report::print(&told?))
    };
    let Some(mistake) = mistake else {
        return send(&settings);
    };
    // A stop is carried out even if other settings are invalid.
    settings.retain(|setting| setting.point == ModelPoint::Run.name());
    if !settings.is_empty() && settings.iter().all(|setting| setting.value == false) {
        send(&settings)?;
    }
    Err(Failure::Misused(mistake))
}

/// `speed_reference=50`, `run=true`, `mode=auto`.
fn parse(profile: Option<&Profile>, text: &str) -> Result<Setting, String> {
    let (name, value) = text.split_once('=').ok_or_else(|| {
        format!("expected POINT=VALUE, got `{text}`; command line; write for example speed_reference=50")
    })?;
    let (name, value) = (name.trim(), value.trim());
    match profile {
        // Without a profile here, the gateway checks the point, but a stop is written in the same words as with one.
        None => Ok(Setting {
            point: name.to_string(),
            value: match ModelPoint::ALL.iter().find(|point| point.name() == name) {
                Some(point) if point.kind() == Kind::Bool => switched(name, value)?.into(),
                _ => serde_json::from_str(value)
                    .ok()
                    .filter(|value: &Json| value.is_boolean() || value.is_number())
                    .unwrap_or_else(|| value.into()),
            },
            shown: format!("{name}={value}"),
        }),
        Some(profile) if name == RESTART_COMMUNICATION && profile.counts_messages => match value {
            "true" => Ok(Setting {
                point: name.to_string(),
                value: true.into(),
                shown: format!("{name}=true"),
            }),
            other => Err(format!("`{other}` is not a value of `{name}`; write true")),
        },
        Some(profile) => of_profile(profile, name, value),
    }
}

fn of_profile(profile: &Profile, name: &str, text: &str) -> Result<Setting, String> {
    let point = profile.points.get(point(profile, name)?);
    let point = point.ok_or_else(|| format!("there is no point `{name}`; command line; name another"))?;
    let value = value_of(point, text)?;
    let meaning = point
        .text_of(value)
        .map(|meaning| format!(" ({meaning})"))
        .unwrap_or_default();
    let shown = format!("{}={value}{meaning} {}", point.name, point.unit);
    // The text of an enumeration is passed to the gateway, whose profile knows its code.
    let is_meaning = point.kind() != Kind::Bool && point.texts.values().any(|meaning| meaning == text);
    Ok(Setting {
        point: point.name.clone(),
        value: if is_meaning {
            text.into()
        } else {
            value_or_null(Some(value))
        },
        shown: shown.trim_end().to_string(),
    })
}

fn value_of(point: &Point, text: &str) -> Result<Value, String> {
    let bad = |wanted: &str| not_a_value(&point.name, text, wanted);
    let meaning = point.code_of(text);
    match point.kind() {
        Kind::Bool => switched(&point.name, text).map(Value::Bool),
        _ if meaning.is_some() => Ok(Value::Integer(meaning.unwrap_or_default())),
        Kind::Integer => text.parse().map(Value::Integer).map_err(|_| bad("a whole number")),
        Kind::Text => Err(bad("another point: this one is a read-only text")),
        Kind::Number => {
            let number = text.parse::<f64>().ok().filter(|n| n.is_finite());
            number.map(Value::Number).ok_or_else(|| bad(&wanted_number(text)))
        }
    }
}

/// The value of a switch.
fn switched(name: &str, text: &str) -> Result<bool, String> {
    match text.to_ascii_lowercase().as_str() {
        "true" | "on" | "yes" | "1" => Ok(true),
        "false" | "off" | "no" | "0" => Ok(false),
        _ => Err(not_a_value(name, text, "true or false, on or off, yes or no, 1 or 0")),
    }
}

fn not_a_value(name: &str, text: &str, wanted: &str) -> String {
    format!("`{text}` is not a value of `{name}`; command line; write {wanted}")
}

/// The number that was probably meant by a text with a decimal comma or a unit.
fn wanted_number(text: &str) -> String {
    let digits = text.trim_end_matches(|c: char| !c.is_ascii_digit()).replace(',', ".");
    match digits.parse::<f64>() {
        Ok(_) => format!("the number alone, with a decimal point: {digits}"),
        Err(_) => "a number".to_string(),
    }
}

/// The reply as the gateway sent it, and as text: what was acknowledged, or why the command failed.
///
/// # Errors
/// If there is no reply, or the reply does not belong to a command.
fn command(target: &Target, settings: &[Setting]) -> Result<(Json, Result<String, String>), String> {
    let shown: Vec<&str> = settings.iter().map(|setting| setting.shown.as_str()).collect();
    let what = format!("{} {}", target.drive, shown.join(" "));
    let names: Vec<String> = settings.iter().map(|setting| setting.point.clone()).collect();
    let asked = GatewayRequest::post(target.path("commands"), &Body(settings))
        .if_lost("it is unknown whether the drive executed the command: read before you repeat it");
    let (reply, way) = target.ask(&asked, Needs::Commands(&names))?;
    let Some((written, document)) = reply.parsed::<Written>().zip(reply.parsed()) else {
        return Err(reply.refusal(&asked).to_string());
    };
    let told = match &written.error {
        None if written.ok => Ok(acknowledged(&what, &written, way)),
        error => {
            let message = error.as_ref().map_or("", |error| error.message.as_str());
            let note = written.note.as_ref().map_or(String::new(), |note| format!("; {note}"));
            Err(format!("{what}: {message}{note} ({})", written.result))
        }
    };
    Ok((document, told))
}

fn acknowledged(what: &str, write: &Written, way: RequestRoute) -> String {
    let confirmed = match write.confirmed_ms {
        Some(after) => format!("confirmed after {after:.0} ms"),
        None => match &write.note {
            Some(known) => printable::line(known),
            None => "not confirmed by a read".to_string(),
        },
    };
    let way = match way {
        RequestRoute::Gateway => ", through the gateway",
        RequestRoute::Direct => "",
    };
    format!(
        "{}: acknowledged after {:.0} ms, {confirmed}{way}\n",
        printable::line(what),
        write.latency_ms
    )
}

#[cfg(test)]
mod tests {
    use drivegate_model::drive::profile::Profiles;

    use super::*;

    #[test]
    fn a_stop_has_the_same_words_with_and_without_the_profile() {
        let profiles = Profiles::built_in();
        let profile = profiles.get("vacon-nx").unwrap();
        for profile in [None, Some(&**profile)] {
            for (text, value) in [
                ("run=false", false),
                ("run=OFF", false),
                (" run = no", false),
                ("run=0", false),
                ("run=on", true),
                ("reverse=1", true),
                ("fault_reset=yes", true),
            ] {
                assert_eq!(parse(profile, text).unwrap().value, value, "{text}");
            }
            let wanted =
                "`maybe` is not a value of `run`; command line; write true or false, on or off, yes or no, 1 or 0";
            assert_eq!(parse(profile, "run=maybe").unwrap_err(), wanted);
            let wanted = "expected POINT=VALUE, got `run`; ";
            assert!(parse(profile, "run").unwrap_err().starts_with(wanted));
        }
        // The gateway knows the values of other points.
        assert_eq!(parse(None, "speed_reference=50").unwrap().value, 50);
        assert_eq!(parse(None, "mode=off").unwrap().value, "off");
    }

    #[test]
    fn a_decimal_comma_or_a_unit_is_named() {
        for (text, wanted) in [
            ("20,5", "the number alone, with a decimal point: 20.5"),
            ("20%", "the number alone, with a decimal point: 20"),
            ("-7,25 Hz", "the number alone, with a decimal point: -7.25"),
            ("fast", "a number"),
            ("", "a number"),
        ] {
            assert_eq!(wanted_number(text), wanted, "{text}");
        }
    }
}
