//! `drivegate verify`: the form by which someone who has the drive confirms its profile.

use std::fmt::Write as _;
use std::time::SystemTime;

use super::drive_access::{OneDrive, Target};
use super::failure::Outcome;
use super::{printable, profiles, read, report};
use drivegate_http::messages::PointValue;
use drivegate_model::drive::{ModelPoint, Profile};

/// Prints a form for confirming a drive's profile on hardware: what the gateway reads, next to what the panel shows.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate verify --config drivegate.toml pump-1 > pump-1.md

Fill it in at the drive and send it in, with the frames: drivegate trace --pcap. It only reads; you send the commands
yourself.")]
pub(super) struct Args {
    #[command(flatten)]
    drive: OneDrive,
}

pub(super) fn run(args: &Args) -> Outcome {
    Ok(report::print(&form(&args.drive.target()?)?))
}

fn form(target: &Target) -> Result<String, String> {
    let profile = target
        .profile()
        .ok_or("the profile is unknown here; --url; name the configuration with --config")?;
    let rows = read::rows(target, &[])?;
    let time = humantime::format_rfc3339_seconds(SystemTime::now()).to_string();
    Ok(text(profile, &rows, &time))
}

/// The form as text. The fields for the user are left empty.
fn text(profile: &Profile, rows: &[PointValue], time: &str) -> String {
    let mut text = format!(
        "# Profile {}\n\n{}; drivegate {}; read at {time}\n\n",
        profile.name,
        profile.described(),
        env!("CARGO_PKG_VERSION")
    );
    text += "- Drive, type and size:\n- Software version:\n- Line: baud, format:\n- Settings that were changed:\n\n";
    text += "## Readings\n\nAt standstill; again at two speeds.\n\n";
    text += "| point | at | drivegate | unit | panel | right |\n|---|---|---|---|---|---|\n";
    for row in rows {
        let point = profile.points.iter().find(|point| point.name == row.point);
        let at = point.map_or(String::new(), |point| profiles::place(profile, point).0);
        let value = match (&row.value, &row.text, &row.why) {
            (serde_json::Value::Null, _, why) => why.clone().unwrap_or_else(|| row.quality.clone()),
            (serde_json::Value::String(word), _, _) => word.clone(),
            (value, Some(text), _) => format!("{value} ({text})"),
            (value, None, _) => value.to_string(),
        };
        let value = printable::line(&value).replace('|', "\\|");
        // Writing to a String cannot fail.
        let _ = writeln!(text, "| {} | {at} | {value} | {} | | |", row.point, row.unit);
    }
    text += "\n## Commands\n\nSmallest reference first, with someone at the emergency stop.\n\n";
    text += "| command | motor | panel |\n|---|---|---|\n";
    let has = |point: ModelPoint| profile.model_point(point).is_some_and(|point| point.write);
    let reference = has(ModelPoint::SpeedReference).then_some("speed_reference=10");
    let orders = [
        (has(ModelPoint::Run), "run=true"),
        (has(ModelPoint::Run), "run=false while it accelerates"),
        (
            has(ModelPoint::Run) && has(ModelPoint::Reverse),
            "run=true reverse=true",
        ),
        (has(ModelPoint::Run) && has(ModelPoint::Reverse), "run=false in reverse"),
        (has(ModelPoint::FaultReset), "fault_reset=true after a fault"),
        (
            has(ModelPoint::FaultReset),
            "fault_reset=true with the fault still present",
        ),
        (
            has(ModelPoint::FaultReset),
            "fault_reset=true with run given at the panel: it must not start",
        ),
        (
            has(ModelPoint::Run),
            "bus cable unplugged while it runs: what it does, after how long",
        ),
    ];
    let orders = orders.iter().filter(|(has, _)| *has).map(|(_, order)| *order);
    for order in reference.into_iter().chain(orders) {
        let _ = writeln!(text, "| {order} | | |");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_model::drive::profile::Profiles;

    #[test]
    fn the_form_has_every_reading_and_the_commands_of_the_family() {
        let profiles = Profiles::built_in();
        let profile = profiles.get("siemens-g120").unwrap();
        let row = |point: &str, value: serde_json::Value, why: Option<&str>| PointValue {
            point: point.to_string(),
            value,
            text: None,
            unit: "Hz".to_string(),
            quality: "good".to_string(),
            why: why.map(str::to_string),
        };
        let rows = [
            row("output_frequency", 12.5.into(), None),
            row("fault_code", serde_json::Value::Null, Some("the drive refused it")),
        ];
        let text = text(profile, &rows, "2026-03-02T07:40:12Z");
        for expected in [
            "not verified on hardware",
            "| 12.5 | Hz | | |",
            "| the drive refused it |",
            "| run=true reverse=true | | |",
            "| fault_reset=true after a fault | | |",
        ] {
            assert!(text.contains(expected), "{expected}: {text}");
        }
        assert!(!super::text(&without_commands(), &rows, "").contains("run=true"));
    }

    /// A profile without commands: its drive is only read.
    fn without_commands() -> Profile {
        let source = "name = \"m\"\nprotocols = [\"modbus-rtu\"]\n[[range]]\ntable = \"holding\"\nfirst = 0\nlast = 9\n\
             [[point]]\nname = \"energy\"\nat = \"holding 1\"\n";
        Profile::parse("m.toml", source, false).unwrap()
    }
}
