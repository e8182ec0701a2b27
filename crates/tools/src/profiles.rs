//! `drivegate profiles`: the drive families and their points.

mod check;
mod commands;
mod import;
mod new;

use std::fmt::Write;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde_json::{Value as Json, json};

use super::failure::{Failure, Outcome};
use super::{printable, report};
use drivegate_gateway::config::unknown_profile;
use drivegate_model::document::{Finding, Problem, format_duration};
use drivegate_model::drive::control::Mask;
use drivegate_model::drive::profile::{AddressRange, Form, Profiles};
use drivegate_model::drive::{Bound, Derived, Point, PointIndex, Profile, Source, Step};
use drivegate_proto::Protocol;
use drivegate_proto::n2::ASSUMPTIONS;

/// Mark of a point, fault text or address that no manual confirms.
const NOT_VERIFIED: &str = "not verified";

/// Lists the profiles, or shows the points of one.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  drivegate profiles\n  drivegate profiles show vacon-nx\n  \
    drivegate profiles --profile-dir /etc/drivegate/profiles"
)]
pub(super) struct Args {
    #[command(subcommand)]
    what: Option<What>,
    /// The list as JSON instead of a table.
    #[arg(long)]
    json: bool,
    /// Include the profile_dirs of this configuration.
    #[arg(long, value_name = "FILE", global = true)]
    config: Option<PathBuf>,
    /// Include the profiles (*.toml) of this directory; may be repeated.
    #[arg(long, value_name = "DIR", global = true)]
    profile_dir: Vec<PathBuf>,
}

#[derive(Debug, clap::Subcommand)]
enum What {
    /// Shows the addresses, scales and notes of a profile's points.
    #[command(after_help = "Examples:\n  drivegate profiles show vacon-nx\n  \
            drivegate profiles show vacon-nx --toml > /etc/drivegate/profiles/our-nx.toml")]
    Show {
        /// Name of the profile.
        name: String,
        /// Print the profile file, as a template for your own.
        #[arg(long)]
        toml: bool,
    },
    /// Prints a new profile to fill in, from a template or based on another profile.
    #[command(after_help = "Examples:\n  drivegate profiles new our-drive > our-drive.toml\n  \
            drivegate profiles new our-pump --base danfoss-fc > /etc/drivegate/profiles/our-pump.toml")]
    New {
        /// Name of the new profile.
        name: String,
        /// The profile it is based on.
        #[arg(long, value_name = "FAMILY")]
        base: Option<String>,
    },
    /// Checks a profile file and proves its commands; exits with 78 and a counterexample if one fails.
    #[command(after_help = "Examples:\n  drivegate profiles check our-drive.toml")]
    Check {
        /// The profile file.
        #[arg(value_name = "FILE")]
        file: PathBuf,
    },
    /// Converts a register list (CSV) to a profile; the columns are in docs/profiles.md.
    #[command(after_help = "Examples:\n  drivegate profiles import our-meter.csv > our-meter.toml")]
    Import {
        /// The list, with a header line.
        #[arg(value_name = "FILE")]
        file: PathBuf,
    },
}

pub(super) fn run(args: &Args) -> Outcome {
    let mut profiles = match &args.config {
        None => Profiles::built_in(),
        Some(path) => super::settings(path)?.profiles,
    };
    super::add_profiles(&mut profiles, &args.profile_dir)?;
    let text = match &args.what {
        None if args.json => return Ok(report::json(&listed(&profiles))),
        None => list(&profiles),
        Some(What::Show { name, toml }) => match profiles.get(name) {
            Some(profile) if *toml => profile.text.to_string(),
            Some(profile) => show(profile),
            None => return Err(unknown(name, "NAME", &profiles)),
        },
        Some(What::New { name, base }) => begin(name, base.as_deref(), &profiles)?,
        Some(What::Check { file }) => return check::run(file, &profiles),
        Some(What::Import { file }) => read_list(file)
            .and_then(|text| import::profile(file, &text))
            .map_err(Failure::Invalid)?,
    };
    Ok(report::print(&text))
}

fn misused(key: &str, why: Finding) -> Failure {
    Failure::Misused(Problem::of_file("command line", key, why).to_string())
}

fn unknown(name: &str, key: &str, profiles: &Profiles) -> Failure {
    misused(key, unknown_profile(name, profiles))
}

fn begin(name: &str, base: Option<&str>, profiles: &Profiles) -> Result<String, Failure> {
    let text = match base.map(|base| (base, profiles.get(base))) {
        None => new::frame(name),
        Some((_, Some(base))) => new::over(name, base),
        Some((base, None)) => return Err(unknown(base, "--base", profiles)),
    };
    let is_valid = name.starts_with(|c: char| c.is_ascii_lowercase())
        && name
            .chars()
            .all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-');
    if is_valid {
        return Ok(text);
    }
    let invalid = Finding::new(
        format!("`{}` is not a valid name", printable::line(name)),
        "write a-z, 0-9 and -, starting with a letter",
    );
    Err(misused("NAME", invalid))
}

/// Longest list that is read, bytes.
const MOST_BYTES: u64 = 16 << 20;

fn read_list(file: &Path) -> Result<String, Vec<Problem>> {
    let problem = |what: String, remedy: &str| {
        let finding = Finding::new(what, remedy);
        vec![Problem::of_file(file.display().to_string(), "", finding)]
    };
    let mut text = String::new();
    let read = File::open(file).and_then(|open| open.take(MOST_BYTES + 1).read_to_string(&mut text));
    match read {
        Ok(_) if text.len() as u64 > MOST_BYTES => {
            Err(problem("the list is longer than 16 MiB".to_string(), "split it"))
        }
        Ok(_) => Ok(text),
        Err(error) => Err(problem(
            format!("cannot read the list: {error}"),
            "check its path and its permissions; it must be UTF-8",
        )),
    }
}

fn list(profiles: &Profiles) -> String {
    let mut table = report::table(["profile", "points", "protocols", "origin", "drives"]);
    for profile in profiles.iter() {
        table.add_row([
            profile.name.clone(),
            profile.points.len().to_string(),
            protocols(profile),
            origin(profile).to_string(),
            profile.described().into_owned(),
        ]);
    }
    report::lines(&table)
}

/// The list as JSON.
fn listed(profiles: &Profiles) -> Vec<Json> {
    let one = |profile: &Arc<Profile>| {
        json!({
            "name": profile.name,
            "points": profile.points.len(),
            "protocols": profile.protocols.iter().map(|protocol| protocol.name()).collect::<Vec<_>>(),
            "built_in": profile.built_in,
            "verified": profile.verified,
            "drives": profile.described(),
        })
    };
    profiles.iter().map(one).collect()
}

fn protocols(profile: &Profile) -> String {
    let names: Vec<&str> = profile.protocols.iter().map(|p| p.name()).collect();
    names.join(", ")
}

fn origin(profile: &Profile) -> &'static str {
    if profile.built_in { "built in" } else { "your own" }
}

fn show(profile: &Profile) -> String {
    let bauds: Vec<String> = profile.bauds.iter().map(u32::to_string).collect();
    let bauds = if bauds.is_empty() {
        "any".to_string()
    } else {
        bauds.join(", ")
    };
    let mut text = format!("{}: {}\n\n", profile.name, printable::line(&profile.described()));
    for (what, value) in [
        ("origin", origin(profile).to_string()),
        ("verified", unverified(profile).to_string()),
        ("based on", profile.base.clone().unwrap_or_default()),
        ("source", profile.source.clone()),
        ("protocols", protocols(profile)),
        ("baud rates", bauds),
        ("formats", formats_of(profile)),
        (
            "addresses",
            format!("{} to {}", profile.addresses.start(), profile.addresses.end()),
        ),
        ("writes", profile.functions.notes().join("; ")),
        (
            "turnaround",
            format!("{}, for the prediction only", format_duration(profile.turnaround)),
        ),
        (
            "update period",
            format!(
                "{}; a reset pulse is held for two",
                format_duration(profile.update_period)
            ),
        ),
        (
            "confirmation",
            format!(
                "within {} of the acknowledgement, or an event `not_confirmed`",
                format_duration(profile.confirm_within)
            ),
        ),
        (
            "scan says",
            if profile.identify.is_empty() {
                String::new()
            } else {
                profile.identified.clone()
            },
        ),
        (
            "simulator",
            profile.simulator.clone().unwrap_or_else(|| "none".to_string()),
        ),
        (
            "on a fault",
            match on_fault(profile) {
                names if names.is_empty() => String::new(),
                names => format!("{} are read for the recording", names.join(", ")),
            },
        ),
    ]
    .into_iter()
    .filter(|(_, value)| !value.is_empty())
    {
        // Writing to a String cannot fail.
        let _ = writeln!(text, "  {what:<14}{}", printable::line(&value));
    }
    if profile.input_is_holding {
        text += "  input registers read the same as holding registers\n";
    }
    if !profile.commissioning.is_empty() {
        text += "\nCommissioning\n";
        text += &commissioning(profile);
    }
    if let Some(control) = profile.control_table() {
        text += "\nCommands\n";
        for (what, words) in commands::lines(profile, control) {
            // Writing to a String cannot fail.
            let _ = writeln!(text, "  {what:<14}{words}");
        }
    }
    text += "\nPoints; addresses are those of the PDU, counted from 0\n\n";
    text += &points(profile);
    text += "\nAddress ranges\n\n";
    text += &ranges(&profile.ranges);
    if !profile.faults.is_empty() {
        text += "\nFault texts\n\n";
        text += &faults(profile);
    }
    if profile.protocols.contains(&Protocol::N2) {
        text += "\nAssumptions about N2, not verified on hardware; those with a key can be changed in [n2] of a profile\n\n";
        text += &assumptions(profile);
    }
    text
}

/// The commissioning lines of each step, as text.
fn commissioning(profile: &Profile) -> String {
    let mut text = String::new();
    for step in Step::ALL {
        let lines = profile.commissioning.lines(step);
        if !lines.is_empty() {
            // Writing to a String cannot fail.
            let _ = writeln!(text, "  {}", step.title());
        }
        for line in lines {
            let _ = writeln!(text, "    - {}", printable::line(line));
        }
    }
    text
}

/// The usual format, followed by the other formats.
fn formats_of(profile: &Profile) -> String {
    match profile.formats.as_slice() {
        [] => "any".to_string(),
        [one] => one.clone(),
        [usual, others @ ..] => format!("{usual}, or {}", others.join(", ")),
    }
}

fn assumptions(profile: &Profile) -> String {
    let mut table = report::table(["key", "value", "what is assumed", "reason"]);
    for assumption in ASSUMPTIONS {
        table.add_row([
            assumption.key.unwrap_or(""),
            &assumption.value(&profile.n2),
            assumption.what,
            assumption.why,
        ]);
    }
    report::lines(&table)
}

/// Points that are read when a drive has a new fault.
fn on_fault(profile: &Profile) -> Vec<&str> {
    let points = profile.on_fault.iter().filter_map(|index| profile.points.get(*index));
    points.map(|point| point.name.as_str()).collect()
}

fn points(profile: &Profile) -> String {
    let mut table = report::table([
        "point", "at", "type", "scale", "unit", "class", "access", "range", "verified", "note",
    ]);
    for point in &profile.points {
        let (at, form, scale) = place(profile, point);
        let (class, note) = match &point.source {
            Source::Raw(_) => (point.class.name(), remarks(profile, point)),
            Source::Derived(derived) => {
                let made = derivation(profile, derived);
                let note = Some(remarks(profile, point)).filter(|note| !note.is_empty());
                ("", note.map_or(made.clone(), |note| format!("{made}; {note}")))
            }
        };
        let range = point.range.as_ref();
        table.add_row([
            point.name.clone(),
            at,
            form,
            scale,
            point.unit.clone(),
            class.to_string(),
            access(point).to_string(),
            range.map_or_else(String::new, |r| format!("{} to {}", r.start(), r.end())),
            verified(point.verified).to_string(),
            note,
        ]);
    }
    report::lines(&table)
}

/// Remarks on a point: where its commands are written, how they are written, its texts, its note.
fn remarks(profile: &Profile, point: &Point) -> String {
    let mut parts = Vec::new();
    if let Some(target) = point.write_to {
        parts.push(format!("commands go to {}", name_of(profile, target)));
    }
    if point.fast_if_carried {
        parts.push("fast if the line can carry it".to_string());
    }
    if point.on_change {
        parts.push("written on change only".to_string());
    }
    if point.hidden {
        parts.push("hidden: for other points only".to_string());
    }
    if let Some(raw) = point.raw().filter(|raw| !raw.invalid.is_empty()) {
        let values: Vec<String> = raw.invalid.iter().map(|value| format!("{value:#06x}")).collect();
        parts.push(format!("{} means not available", values.join(", ")));
    }
    if !point.texts.is_empty() {
        let texts: Vec<String> = point
            .texts
            .iter()
            .map(|(value, text)| format!("{value} {text}"))
            .collect();
        parts.push(texts.join(", "));
    }
    if !point.note.is_empty() {
        parts.push(point.note.clone());
    }
    parts.join("; ")
}

/// The note that the profile is not tested on hardware; empty otherwise.
fn unverified(profile: &Profile) -> &'static str {
    if profile.verified {
        ""
    } else {
        "no: nobody has confirmed it on hardware yet; docs/verifying.md explains how"
    }
}

fn verified(verified: bool) -> &'static str {
    if verified { "yes" } else { NOT_VERIFIED }
}

fn access(point: &Point) -> &'static str {
    match (point.write, point.pulse) {
        (false, _) => "read",
        (true, false) => "read, write",
        (true, true) => "read, pulse",
    }
}

/// Address of a point, form of its raw value, and engineering value of one count.
pub(super) fn place(profile: &Profile, point: &Point) -> (String, String, String) {
    match &point.source {
        Source::Raw(raw) => {
            let at = format!("{} {}", raw.table, raw.address);
            let offset = if raw.offset == 0.0 {
                String::new()
            } else {
                format!(" {:+}", raw.offset)
            };
            let scale = match raw.scale_from {
                Some(power) => format!("10^{}", name_of(profile, power)),
                None => format!("{}{offset}", raw.scale),
            };
            let factors = raw
                .factor_from
                .iter()
                .map(|factor| format!(" × {}", name_of(profile, *factor)));
            let scale = factors.fold(scale, |scale, factor| scale + &factor);
            let form = raw.type_text();
            match raw.form {
                Form::Bit { .. } if raw.table.is_bits() => (at, form, String::new()),
                Form::Bit { bit, invert } => {
                    let form = if invert { "bit, 0 is true".to_string() } else { form };
                    (format!("{at}.{bit}"), form, String::new())
                }
                Form::Bits { first, count } => (
                    format!("{at}.{first}-{}", first.saturating_add(count).saturating_sub(1)),
                    form,
                    scale,
                ),
                _ => (at, form, scale),
            }
        }
        Source::Derived(derived) => {
            let names: Vec<&str> = derived.sources().map(|i| name_of(profile, i)).collect();
            (
                format!("from {}", names.join(", ")),
                "derived".to_string(),
                String::new(),
            )
        }
    }
}

/// Text for the end of a band that only the configuration of a drive states.
const CONFIGURED: &str = "frequency_range of the drive";

/// How a derived point is computed, as text.
fn derivation(profile: &Profile, derived: &Derived) -> String {
    let bound = |bound: &Bound| match bound {
        Bound::Point(point) => name_of(profile, *point).to_string(),
        Bound::Fixed(figure) => figure.to_string(),
        Bound::Configured => CONFIGURED.to_string(),
    };
    match derived {
        Derived::Band { minimum, maximum, .. } => {
            format!("percent of the band between {} and {}", bound(minimum), bound(maximum))
        }
        Derived::Percent { minimum, maximum, .. } => {
            format!(
                "as percent of the band between {} and {}",
                bound(minimum),
                bound(maximum)
            )
        }
        Derived::Zero { within, .. } => format!("true up to {within}"),
        Derived::Equal { within, .. } => format!("true while they differ by at most {within}"),
        Derived::State { any } => {
            let one = |state: &Mask| format!("{:#06x} of {:#06x}", state.is, state.mask);
            any.iter().map(one).collect::<Vec<_>>().join(" or ")
        }
        Derived::All { .. } => "true while all of them are".to_string(),
        Derived::Sum { of, weights } => {
            let parts = of.iter().zip(weights).map(|(of, weight)| match weight {
                1.0 => name_of(profile, *of).to_string(),
                weight => format!("{weight} {}", name_of(profile, *of)),
            });
            parts.collect::<Vec<String>>().join(" + ")
        }
        Derived::LowestBit { .. } => "number of the lowest bit that is set, counted from 1".to_string(),
    }
}

fn name_of(profile: &Profile, point: PointIndex) -> &str {
    profile.points.get(point).map_or("?", |point| point.name.as_str())
}

fn ranges(ranges: &[AddressRange]) -> String {
    let mut table = report::table([
        "table",
        "first",
        "last",
        "per read",
        "per write",
        "written",
        "holes",
        "note",
    ]);
    for range in ranges {
        let write = match range.write {
            0 => "read-only".to_string(),
            items => items.to_string(),
        };
        table.add_row([
            range.table.to_string(),
            range.addresses.start().to_string(),
            range.addresses.end().to_string(),
            range.read.to_string(),
            write,
            range.write_when.clone(),
            if range.holes { "may be read" } else { "no" }.to_string(),
            range.note.clone(),
        ]);
    }
    report::lines(&table)
}

fn faults(profile: &Profile) -> String {
    let mut table = report::table(["code", "text", "verified", "panel", "cause", "remedy"]);
    for (code, fault) in &profile.faults {
        table.add_row([
            code.to_string(),
            fault.text.clone(),
            verified(fault.verified).to_string(),
            fault.panel.clone(),
            fault.cause.clone(),
            fault.remedy.clone(),
        ]);
    }
    report::lines(&table)
}
