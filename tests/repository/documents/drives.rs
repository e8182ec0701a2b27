//! The tables of docs/drives.md, generated from the built-in profiles.

use std::fmt::Write;

use drivegate_model::drive::profile::{Form, Profile, Profiles};
use drivegate_model::drive::{Bound, Derived, ModelPoint, Point, PointIndex, PollClass, Source, Value};
use drivegate_proto::{N2Options, Protocol, Table, n2};

/// The Modbus families.
const MODBUS: [&str; 5] = ["vacon-nx", "eaton-svx", "eaton-hvx", "vacon-cx", "teco-7300pa"];
/// Profiles for one application, each based on another profile.
const APPLICATIONS: [&str; 6] = [
    "vacon-nx-multipurpose",
    "vacon-nx-pid",
    "vacon-nx-pump-fan",
    "eaton-svx-multipurpose",
    "eaton-svx-pid",
    "eaton-svx-pump-fan",
];
const N2: [&str; 3] = ["vacon-nx-n2", "eaton-hvx-n2", "teco-7300pa-n2"];

pub(crate) fn tables() -> String {
    let profiles = Profiles::built_in();
    let mut text = String::from("\n## The common model on Modbus\n\n");
    text += &model(&profiles, &MODBUS);
    text += "\n## The common model on Metasys N2\n\n";
    text += &model(&profiles, &N2);
    for name in MODBUS.iter().chain(&N2) {
        if let Some(profile) = profiles.get(name) {
            text += &family(profile);
            text += &faults(&profiles, profile);
        }
    }
    text += &applications(&profiles);
    let unverified = unverified(&profiles);
    text += &unverified.0;
    text += &assumptions();
    text.push('\n');
    assert_eq!(
        profiles.iter().count(),
        MODBUS.len() + N2.len() + APPLICATIONS.len() + unverified.1,
        "a family is missing here"
    );
    text
}

/// Facts that public sources contradict or do not state.
const LEFT_OUT: &str = "\nLeft out until a source or a drive settles it: currents of Danfoss (16-14, one or two words), Mitsubishi (201) and \
    Yaskawa (0042H, unit by size), Fuji (080BH) and Toshiba (FE03H, percent of an unread rating); alarm bits of Danfoss (16-90); \
    INVT 3002H (1 or 0.1 V by series); parameters of ACS580 (two words), Invertek (P2 and E2 differ), and where no source has \
    them.\n";

/// The families that are not confirmed on hardware, and their number.
fn unverified(profiles: &Profiles) -> (String, usize) {
    let mut text = String::from(
        "\n## Families not verified on hardware\n\nMade from manuals and reports, not confirmed ([how to](verifying.md)); \
         `drivegate profiles show NAME` has points and settings. Faults: texts with cause and remedy; *none*: no source of \
         the codes; -: no code. Parameters: [named](parameters.md#in-a-profile).\n\n\
         |profile|drives|sources|faults|parameters|\n|---|---|---|---|---|\n",
    );
    let all: Vec<&std::sync::Arc<Profile>> = profiles.iter().filter(|profile| !profile.verified).collect();
    for profile in &all {
        let faults = match (profile.faults.len(), profile.model_point(ModelPoint::FaultCode)) {
            (0, None) => "-".to_string(),
            (0, Some(_)) => "*none*".to_string(),
            (known, _) => known.to_string(),
        };
        let parameters = match profile.parameters.named.len() {
            0 => "-".to_string(),
            known => known.to_string(),
        };
        let _ = writeln!(
            text,
            "|`{}`|{}|{}|{faults}|{parameters}|",
            profile.name, profile.title, profile.source
        );
    }
    text += LEFT_OUT;
    text += &common_points(&all);
    (text, all.len())
}

/// The points of the common model and the commands that these profiles have.
fn common_points(profiles: &[&std::sync::Arc<Profile>]) -> String {
    let names: Vec<&str> = profiles.iter().map(|profile| profile.name.as_str()).collect();
    let mut text = format!(
        "\n### Common points and commands of these families\n\n**?**: not confirmed; -: none; *sign*: by a negative \
         reference.\n\n|point|`{}`|\n|---|{}\n",
        names.join("`|`"),
        "---|".repeat(names.len())
    );
    for point in ModelPoint::ALL {
        let cells: Vec<&str> = profiles.iter().map(|profile| has(profile, *point)).collect();
        let _ = writeln!(text, "|`{}`|{}|", point.name(), cells.join("|"));
    }
    text
}

fn has(profile: &Profile, point: ModelPoint) -> &'static str {
    let signed = || {
        let reference = profile.model_point(ModelPoint::SpeedReference);
        let range = reference.and_then(|reference| reference.range.as_ref());
        range.is_some_and(|range| *range.start() < 0.0)
    };
    match profile.model_point(point) {
        Some(found) if found.verified => "yes",
        Some(_) => "**?**",
        None if point == ModelPoint::Reverse && signed() => "*sign*",
        None => "-",
    }
}

fn model(profiles: &Profiles, names: &[&str]) -> String {
    let mut text = format!(
        "|point|unit|`{}`|\n|---|---|{}\n",
        names.join("`|`"),
        "---|".repeat(names.len())
    );
    for point in ModelPoint::ALL {
        let cells: Vec<String> = names
            .iter()
            .map(|name| {
                let profile = profiles.get(name).unwrap();
                profile
                    .model_point(*point)
                    .map_or_else(|| "-".to_string(), |p| cell(profile, p))
            })
            .collect();
        let _ = writeln!(text, "|`{}`|{}|{}|", point.name(), point.unit(), cells.join("|"));
    }
    text
}

/// Address, scale and class of a point, and whether it is verified.
fn cell(profile: &Profile, point: &Point) -> String {
    let place = place(profile, point);
    let class = if point.raw().is_some() {
        format!(", {}", point.class.name())
    } else {
        String::new()
    };
    let doubt = if point.verified { "" } else { " **?**" };
    let target = target(profile, point)
        .map(|t| format!("; commands: {t}"))
        .unwrap_or_default();
    format!("{place}{class}{target}{doubt}")
}

fn target(profile: &Profile, point: &Point) -> Option<String> {
    let target = profile.points.get(point.write_to?)?;
    Some(place(profile, target))
}

fn place(profile: &Profile, point: &Point) -> String {
    let raw = match &point.source {
        Source::Derived(derived) => return derivation(profile, derived),
        Source::Raw(raw) => raw,
    };
    let n2 = profile.protocols == [Protocol::N2];
    let at = match (raw.table, n2) {
        (Table::Coil, true) => format!("BO {}", raw.address + 1),
        (Table::DiscreteInput, true) => format!("BI {}", raw.address + 1),
        (Table::Input, true) if raw.address >= 0x4000 => format!("ADI {}", raw.address - 0x4000 + 1),
        (Table::Input, true) => format!("AI {}", raw.address / 2 + 1),
        (Table::Holding, true) => format!("AO {}", raw.address / 2 + 1),
        (table, false) => {
            let short = match table {
                Table::Coil => "CO",
                Table::DiscreteInput => "DI",
                Table::Input => "IR",
                Table::Holding => "HR",
            };
            // The manual of TECO numbers its registers in hexadecimal.
            if profile.protocols == [Protocol::ModbusAscii] {
                format!("{short} {:04X}H", raw.address)
            } else {
                format!("{short} {}", raw.address)
            }
        }
    };
    let form = match raw.form {
        Form::Bit { invert, .. } if raw.table.is_bits() => if invert { "!" } else { "" }.to_string(),
        Form::Bit { bit, invert } => format!(".{bit}{}", if invert { "!" } else { "" }),
        Form::Bits { first, count } => format!(".{first}-{}", first + count - 1),
        Form::I16 if !n2 => " ±".to_string(),
        _ => String::new(),
    };
    let scale = if raw.scale == 1.0 {
        String::new()
    } else {
        format!(" × {}", raw.scale)
    };
    format!("{at}{form}{scale}")
}

fn derivation(profile: &Profile, derived: &Derived) -> String {
    let name = |i: &PointIndex| format!("`{}`", profile.points.get(*i).unwrap().name);
    let end = |bound: &Bound| match bound {
        Bound::Point(i) => name(i),
        Bound::Fixed(figure) => figure.to_string(),
        Bound::Configured => "`frequency_range`".to_string(),
    };
    match derived {
        Derived::Band { of, minimum, maximum } => {
            format!("{} of the band {} to {}", name(of), end(minimum), end(maximum))
        }
        Derived::Percent { of, minimum, maximum } => {
            format!(
                "{} as percent of the band {} to {}",
                name(of),
                end(minimum),
                end(maximum)
            )
        }
        Derived::Zero { of, .. } => format!("{} = 0", name(of)),
        Derived::Equal { of, to, .. } => format!("{} = {}", name(of), name(to)),
        Derived::State { any } => format!("{} states", any.len()),
        Derived::All { of } => of.iter().map(name).collect::<Vec<_>>().join(" and "),
        Derived::Sum { of, .. } => of.iter().map(name).collect::<Vec<_>>().join(" + "),
        Derived::LowestBit { of } => format!("lowest bit of {}", name(of)),
    }
}

/// Maximum number of points read on request only for which all are listed.
const MOST_ON_REQUEST: usize = 30;

/// The points of a family beyond the common model.
fn family(profile: &Profile) -> String {
    let doubtful = profile.points.iter().filter(|p| !p.verified).count();
    let mut text = format!(
        "\n## `{}`: {}\n\nSource: {}.",
        profile.name, profile.title, profile.source
    );
    if doubtful > 0 {
        let _ = write!(text, " Not verified: {doubtful} of {} points.", profile.points.len());
    }
    text += "\n\n|point|unit|address|class|commands|note|\n|---|---|---|---|---|---|\n";
    let on_request = |p: &&Point| p.raw().is_some() && p.class == PollClass::Never;
    let many = profile.points.iter().filter(on_request).count();
    let left_out = many > MOST_ON_REQUEST;
    let points = profile.points.iter().filter(|p| p.model.is_none());
    for point in points.filter(|p| !(left_out && on_request(p))) {
        let class = if point.raw().is_some() { point.class.name() } else { "" };
        let range = point.range.as_ref().map(|r| format!("{} to {}", r.start(), r.end()));
        let write = match (point.write, &range) {
            (true, Some(range)) => range.as_str(),
            (true, None) => "yes",
            (false, _) => "",
        };
        let doubt = if point.verified { "" } else { "**?** " };
        let texts: Vec<String> = point
            .texts
            .iter()
            .map(|(value, text)| format!("{value} {text}"))
            .collect();
        let blocks = point.blocks.as_ref().map_or_else(String::new, |blocks| {
            let state = point.text_of(Value::Bool(blocks.when));
            let state = state.unwrap_or(if blocks.when { "on" } else { "off" });
            format!("*blocks* while {state}: `{}`", blocks.cause)
        });
        let mut note = vec![texts.join(", "), blocks, point.note.clone()];
        note.retain(|text| !text.is_empty());
        let _ = writeln!(
            text,
            "|`{}`|{}|{}|{class}|{write}|{doubt}{}|",
            point.name,
            point.unit,
            place(profile, point),
            note.join("; ")
        );
    }
    if left_out {
        let _ = write!(
            text,
            "\nAnd {many} parameters, read on request only: `drivegate profiles show {}`.\n",
            profile.name
        );
    }
    text + &writes(profile)
}

/// When a family takes writes; ranges of one rule are said together.
fn writes(profile: &Profile) -> String {
    let mut rules: Vec<(&str, Vec<&str>)> = Vec::new();
    for range in profile.ranges.iter().filter(|range| !range.write_when.is_empty()) {
        let what = if range.note.is_empty() {
            "registers"
        } else {
            range.note.as_str()
        };
        match rules.iter_mut().find(|(when, _)| *when == range.write_when) {
            Some((_, ranges)) => ranges.push(what),
            None => rules.push((&range.write_when, vec![what])),
        }
    }
    let rules: Vec<String> = rules
        .iter()
        .map(|(when, ranges)| format!("{}: {when}", ranges.join(", ")))
        .collect();
    if rules.is_empty() {
        String::new()
    } else {
        format!("\nWrites: {}.\n", rules.join("; "))
    }
}

/// The fault texts of a family, or the name of another family that has these texts.
fn faults(profiles: &Profiles, profile: &Profile) -> String {
    let earlier = MODBUS.iter().chain(&N2).take_while(|name| **name != profile.name);
    let same = earlier
        .filter_map(|name| profiles.get(name))
        .find(|one| one.faults == profile.faults);
    if let Some(same) = same {
        return format!("\nFault texts: as `{}`.\n", same.name);
    }
    let mut text = String::new();
    let mut verified: Vec<String> = Vec::new();
    let mut unverified: Vec<String> = Vec::new();
    for (code, fault) in &profile.faults {
        let panel = match fault.panel.as_str() {
            "" => String::new(),
            panel => format!(" (panel: {panel})"),
        };
        let text = format!("{code} {}{panel}", fault.text);
        if fault.verified {
            verified.push(text)
        } else {
            unverified.push(text)
        }
    }
    if !verified.is_empty() {
        let _ = write!(text, "\nFault texts: {}.\n", verified.join(", "));
    }
    if !unverified.is_empty() {
        let _ = write!(text, "\nUnverified fault texts: {}.\n", unverified.join(", "));
    }
    text
}

/// The points by which application profiles differ from the profiles on which they are based.
fn applications(profiles: &Profiles) -> String {
    let mut text = String::from(
        "\n## Profiles of one application\n\nWhat process data in means depends on the application, and no read shows which one \
         a drive has: choose the profile. It is its base without `process_data_in_1` to `process_data_in_8`, and with\n\n\
         |point|unit|address|profiles|\n|---|---|---|---|\n",
    );
    let mut rows: Vec<(String, Vec<&str>)> = Vec::new();
    for name in APPLICATIONS {
        let profile = profiles.get(name).unwrap();
        let base = profiles.get(profile.base.as_deref().unwrap()).unwrap();
        let same = |point: &&Point| base.points.iter().any(|other| other.name == point.name);
        for point in profile.points.iter().filter(|point| !same(point)) {
            let row = format!("|`{}`|{}|{}|", point.name, point.unit, place(profile, point));
            match rows.iter_mut().find(|(known, _)| *known == row) {
                Some((_, names)) => names.push(name),
                None => rows.push((row, vec![name])),
            }
        }
    }
    for (row, names) in rows {
        let _ = writeln!(text, "{row}`{}`|", names.join("`, `"));
    }
    text
}

/// N2 details that no manual specifies.
fn assumptions() -> String {
    let mut text = String::from(
        "\n## Assumptions about Metasys N2\n\nNone of these has been verified on hardware. Those with a key can be changed \
         in `[n2]` of a profile.\n\n|key|value|assumption|basis|\n|---|---|---|---|\n",
    );
    for one in n2::ASSUMPTIONS {
        let key = one.key.map(|key| format!("`{key}`")).unwrap_or_default();
        let value = one.value(&N2Options::DEFAULT);
        let _ = writeln!(text, "|{key}|{value}|{}|{}|", one.what, one.why);
    }
    text
}
