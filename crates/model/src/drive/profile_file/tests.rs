//! Errors of profile files with their places, and the meaning of valid files.

use tempfile::TempDir;

use super::super::derive::{Bound, Derived};
use super::super::profile::{Form, PollClass, Source};
use super::*;
use crate::drive::Value;
use crate::drive::model::Kind;

mod stops;
mod values;

/// The start of a valid profile file.
const HEAD: &str = r#"
name = "meter"
protocols = ["modbus-rtu"]
[[range]]
table = "holding"
first = 0
last = 99
read = 10
write = 10
"#;

fn mistakes(file: &str, source: &str) -> String {
    let found = Profile::parse(file, source, false).err().unwrap_or_default();
    found.iter().map(|p| format!("{p}\n")).collect()
}

#[test]
fn built_in_profiles_are_valid() {
    for (file, source) in BUILT_IN {
        let found = Profile::parse(file, source, true).err().unwrap_or_default();
        let text: Vec<String> = found.iter().map(Problem::to_string).collect();
        assert!(found.is_empty(), "{}", text.join("\n"));
    }
    assert_eq!(Profiles::built_in().iter().count(), BUILT_IN.len());
    for profile in Profiles::built_in().iter() {
        let base = profile
            .base
            .as_deref()
            .map(|base| Profiles::built_in().get(base).cloned());
        let is_sound = |base: Option<std::sync::Arc<Profile>>| base.is_some_and(|base| base.base.is_none());
        assert!(base.is_none_or(is_sound), "{}", profile.name);
    }
}

/// A profile based on a built-in one that has a base inherits from both.
#[test]
fn a_base_may_have_a_base() {
    let source = "name = \"p\"\nbase = \"vacon-nx-pid\"\npoints.pid_setpoint.class = \"never\"\n";
    let ours = Profile::parse("p", source, false).unwrap();
    let pid = Profiles::built_in().get("vacon-nx-pid").cloned().unwrap();
    assert_eq!(ours.points.len(), pid.points.len());
    assert_eq!(ours.simulator, pid.simulator);
    assert_eq!(ours.faults, pid.faults);
}

#[test]
fn every_mistake_is_reported() {
    let source = r#"
name = "My Meter"
protocols = ["modbus-rut"]
[[range]]
table = "holding"
first = 10
last = 5
[[point]]
name = "ready"
at = "holding 10.16"
[[point]]
name = "a"
at = "holding 900"
scael = 2
[[point]]
name = "a"
at = "holding 7"
type = "f16"
unit = "V"
[faults]
x = "y"
"#;
    let all = mistakes("meter.toml", source);
    for wanted in [
        "meter.toml:2, name",
        "meter.toml:3, protocols; known: modbus-rtu, modbus-ascii, n2",
        "meter.toml:7, range[0].last",
        "meter.toml:10, point[0].at",
        "meter.toml:13, point[1].at; add the range",
        "meter.toml:14, point[1].scael; did you mean `scale`?",
        "meter.toml:16, point[2].name",
        "meter.toml:18, point[2].type; known: i8, u16, i16, u32, i32, u64",
        "meter.toml:21, faults.x",
    ] {
        assert!(all.contains(wanted), "{wanted} is missing in\n{all}");
    }
}

/// Rows with one mistake each: the keys of a point named `a` in line 11, and the problem.
const POINT_MISTAKES: &str = r#"
at = "holding"                                           -> m:12, point[0].at; write table and PDU address
at = "holding 70000"                                     -> m:12, point[0].at; write table
at = "holding 1.8-4"                                     -> m:12, point[0].at; write table
at = "register 1"                                        -> unknown table `register`; m:12
at = "input 1"                                           -> is not in any [[range]] of the profile; m:12
at = "holding 99" / type = "u32"                         -> exceeds its [[range]]; m:12, point[0].at; extend the range
at = "holding 1.3" / type = "u16"                        -> a bit has no type; m:13, point[0].type
at = "holding 1" / words = "low-first" / type = "i16"    -> has no word order; m:13, point[0].words
at = "holding 1" / type = "u32" / words = "little"       -> unknown word order `little`; m:14
at = "holding 1" / invert = true                         -> only a bit or `equals` can be inverted; m:13, point[0].invert
at = "holding 1" / scale = 0                             -> a scale of 0 loses every value; m:13, point[0].scale
at = "holding 1" / scale = nan                           -> NaN is not a finite number; m:13, point[0].scale
at = "holding 1" / offset = inf                          -> inf is not a finite number; m:13, point[0].offset
at = "holding 1.3" / scale = 2                           -> has no scale; m:13, point[0].scale; leave the key out
at = "holding 1" / offset = 2 / [point.texts] / 1 = "on" -> has no scale; m:13, point[0].offset
at = "holding 1" / class = "quick"                       -> unknown poll class `quick`; m:13, point[0].class
at = "holding 1" / range = [5, 1]                        -> expected two values, the lower one first; m:13
at = "holding 1" / pulse = true / write = true           -> only a bit can be a pulse; m:13
at = "holding 1.1" / pulse = true                        -> only a writable point can be a pulse; m:13
at = "holding 1" / on_change = true                      -> only a writable point is written on change; m:13, point[0].on_change
at = "holding 1" / write_to = "b"                        -> there is no point `b`; m:13, point[0].write_to
at = "holding 1" / write = true / write_to = "a"         -> does not accept commands itself; m:14
at = "holding 1" / [point.texts] / on = "on"             -> `on` is not a whole number; m:14, point[0].texts.on
derive = "product"                                       -> unknown derivation `product`; m:12, point[0].derive; known: band, percent
derive = "sum"                                           -> `of` is missing; m:10
derive = "zero"                                          -> `of` is missing; m:10
derive = "zero" / of = "b"                               -> there is no point `b`; m:13, point[0].of
derive = "zero" / of = "a"                               -> `a` is derived itself; m:12, point[0].derive
derive = "band" / of = "a"                               -> `maximum` is missing; m:10"#;

/// The lines of a profile to the left of `->`, separated by ` / `, and the expected problem to the right.
fn mistakes_of(table: &'static str) -> impl Iterator<Item = (String, &'static str)> {
    let rows = table.trim_start().lines();
    let sides = rows.map(|row| row.split_once(" -> ").unwrap());
    sides.map(|(lines, wanted)| (lines.trim_end().replace(" / ", "\n"), wanted))
}

#[test]
fn each_mistake_of_a_point() {
    for (lines, wanted) in mistakes_of(POINT_MISTAKES) {
        let all = mistakes("m", &format!("{HEAD}[[point]]\nname = \"a\"\n{lines}\n"));
        assert!(all.contains(wanted), "{lines}\n{wanted} is missing in\n{all}");
        assert_eq!(all.lines().count(), 1, "{lines}\n{all}");
    }
}

/// Rows with one mistake each: the line above the name, and the problem.
const TOP_MISTAKES: &str = r#"
base = "vacon"                    -> there is no valid profile `vacon`; m:2, base
addresses = [0, 5]                -> the first address is 0 or above the last; m:2, addresses
addresses = [1]                   -> expected two values, the lower one first; m:2, addresses
turnaround = "5"                  -> m:2, turnaround
address_offset = { holding = 2 }  -> 2 is out of range; m:2, address_offset.holding
address_offset = { hold = 1 }     -> unknown key `hold`; m:2, address_offset.hold
address_offset = { holding = -1 } -> holding 0 shifted by -1 is not an address; m:7, range[0].first
remove = ["b"]                    -> there is no point `b`; m:2, remove
remove = "a"                      -> not a list; m:2, remove
points.b.scale = 2                -> there is no point `b`; m:2, points.b
points.a.scael = 2                -> unknown key `scael`; m:2, point[0].scael; did you mean `scale`?
speed_reference.signed = true     -> no register for a reference in percent; m:2, speed_reference"#;

#[test]
fn each_mistake_of_the_whole() {
    let point = "[[point]]\nname = \"a\"\nat = \"holding 1\"\n";
    let range = |more: &str| format!("[[range]]\ntable = \"holding\"\nfirst = 200\nlast = 299\n{more}\n{point}");
    let top = |line: &str| HEAD.replacen("name", &format!("{line}\nname"), 1) + point;
    let cases = [
        (HEAD.to_string(), "the profile has no point; m, point"),
        (
            HEAD.to_string() + &range("read = 0"),
            "0 is out of range; m:14, range[1].read",
        ),
        (
            HEAD.to_string() + &range("read = 126"),
            "126 is out of range; m:14, range[1].read",
        ),
        (
            HEAD.to_string() + &range("write = 200"),
            "200 is out of range; m:14, range[1].write",
        ),
        (
            HEAD.to_string() + &range("").replace("200", "50"),
            "the range overlaps the one from 0 to 99; m:12, range[1].first",
        ),
        (
            top("").replace("[\"modbus-rtu\"]", "[\"modbus-rtu\", \"n2\"]"),
            "n2 cannot share a profile with another protocol; m:4, protocols",
        ),
        (
            top("").replace("[\"modbus-rtu\"]", "[]"),
            "the list is empty; m:4, protocols",
        ),
        (
            top("").replace("modbus-rtu", "n2"),
            "AI and AO of N2 are floats at even addresses, number n at 2(n-1); m:13, point[0].at",
        ),
        (
            HEAD.to_string() + point + "type = \"i32\"\n[[point]]\nname = \"run\"\nat = \"holding 5\"\nwrite = true",
            "`run` is true or false; m:16, point[1].at; name a bit",
        ),
        (
            HEAD.to_string() + point + "[[point]]\nname = \"motor_current\"\nat = \"holding 5.1\"",
            "`motor_current` is a number, not a bit; m:15, point[1].at",
        ),
        (
            HEAD.to_string() + point + "class = \"never\"\n[[point]]\nname = \"b\"\nderive = \"zero\"\nof = \"a\"",
            "`a` is never read; m:16, point[1].derive",
        ),
        (
            HEAD.to_string() + point + "[point.texts]\n1 = \"x\"\n[[point]]\nname = \"a_text\"\nat = \"holding 5\"",
            "the text of `a` is shown as `a_text`, which is also a point; m:11, point[0].name",
        ),
    ];
    let tops = mistakes_of(TOP_MISTAKES).map(|(line, wanted)| (top(&line), wanted));
    for (source, wanted) in tops.chain(cases) {
        let all = mistakes("m", &source);
        assert!(all.contains(wanted), "{source}\n{wanted} is missing in\n{all}");
    }
}

#[test]
fn a_profile_over_another() {
    let source = r#"
name = "our-hvx"
base = "eaton-hvx"
remove = ["sensor_feedback", "pid_setpoint"]
points.output_frequency.scale = 0.1
points.interlocked.invert = false
[[range]]
table = "holding"
first = 100
read = 8
[[range]]
table = "holding"
first = 500
last = 509
read = 4
[[point]]
name = "zero_speed"
at = "holding 2100.9"
class = "fast"
[[point]]
name = "room_temperature"
at = "holding 500"
scale = 0.1
unit = "°C"
[faults]
7 = "short circuit"
"#;
    let ours = Profile::parse("ours.toml", source, false).unwrap();
    let hvx = Profiles::built_in().get("eaton-hvx").unwrap().clone();
    let point = |name: &str| ours.points.get(ours.point_index(name).unwrap()).unwrap();
    assert_eq!(ours.name, "our-hvx");
    assert_eq!(ours.simulator, hvx.simulator);
    assert_eq!(ours.points.len(), hvx.points.len() - 1);
    assert_eq!(point("output_frequency").raw().unwrap().scale, 0.1);
    assert_eq!(point("output_frequency").raw().unwrap().form, Form::I16);
    assert_eq!(
        point("interlocked").raw().unwrap().form,
        Form::Bit { bit: 8, invert: false }
    );
    assert_eq!(
        point("zero_speed").raw().unwrap().form,
        Form::Bit { bit: 9, invert: false }
    );
    assert_eq!(ours.range(drivegate_proto::Table::Holding, 101).unwrap().read, 8);
    assert_eq!(ours.range(drivegate_proto::Table::Holding, 505).unwrap().read, 4);
    assert_eq!(ours.range(drivegate_proto::Table::Holding, 511).unwrap().read, 8);
    assert_eq!(ours.fault_text(7), "short circuit");
    assert_eq!(ours.fault_text(53), "fieldbus fault");
    let wrong = source.replace("scale = 0.1\nunit", "scale = 0.1\nuint");
    assert!(
        mistakes("m", &wrong).contains("unknown key `uint`; m:"),
        "{}",
        mistakes("m", &wrong)
    );
    // Problems in the part that comes from the base name the base.
    let wrong = source.replace("\"sensor_feedback\", \"pid_setpoint\"", "\"maximum_frequency\"");
    let all = mistakes("m", &wrong);
    assert!(
        all.contains("there is no point `maximum_frequency`; profile eaton-hvx, point["),
        "{all}"
    );
}

#[test]
fn choices_of_the_reference() {
    let read = |base: &str, lines: &str| {
        let source = format!("name = \"x\"\nbase = \"{base}\"\n{lines}\n");
        Profile::parse("x.toml", &source, false).unwrap_or_else(|found| panic!("{}", found[0]))
    };
    let of = |profile: &Profile, name: &str| profile.points.get(profile.point_index(name).unwrap()).unwrap().clone();
    let nx = read("vacon-nx", "speed_reference = { signed = false, base = \"max\" }");
    assert_eq!(of(&nx, "speed_reference").raw().unwrap().form, Form::U16);
    assert_eq!(of(&nx, "speed_reference").range, Some(0.0..=100.0));
    let least = |profile: &Profile| match of(profile, "frequency_reference").source {
        Source::Derived(Derived::Band { minimum, .. }) => minimum,
        other => panic!("{other:?}"),
    };
    assert_eq!(least(&nx), Bound::Fixed(0.0));
    let hvx = read("eaton-hvx", "speed_reference = { signed = true, base = \"min_max\" }");
    assert_eq!(of(&hvx, "speed_reference").raw().unwrap().form, Form::I16);
    assert_eq!(least(&hvx), Bound::Point(hvx.point_index("minimum_frequency").unwrap()));
    let hertz = read("eaton-svx", "speed_reference.unit = \"hz\"");
    let raw = of(&hertz, "frequency_reference");
    assert_eq!((raw.raw().unwrap().address, raw.raw().unwrap().scale), (2002, 0.01));
    assert!(matches!(
        of(&hertz, "speed_reference").source,
        Source::Derived(Derived::Percent { .. })
    ));
    let cx = read("vacon-cx", "address_offset = { holding = 1, discrete-input = 1 }");
    assert_eq!(of(&cx, "frequency_reference").raw().unwrap().address, 1);
    assert_eq!(of(&cx, "running").raw().unwrap().address, 3);
    assert_eq!(of(&cx, "output_frequency").raw().unwrap().address, 0);
    assert_eq!(cx.ranges.last().unwrap().addresses, 9901..=9999);
}

/// Points that convert commands are polled, whatever their class is.
#[test]
fn ends_of_a_band_are_polled() {
    let source = HEAD.to_string()
        + "[[point]]\nname = \"speed_reference\"\nat = \"holding 1\"\n\
           [[point]]\nname = \"frequency_reference\"\nderive = \"band\"\nof = \"speed_reference\"\n\
           minimum = \"least\"\nmaximum = \"most\"\n\
           [[point]]\nname = \"least\"\nat = \"holding 2\"\nclass = \"fast\"\n\
           [[point]]\nname = \"most\"\nat = \"holding 3\"\nclass = \"once\"\n\
           [[point]]\nname = \"other\"\nat = \"holding 4\"\nclass = \"once\"\n";
    let profile = Profile::parse("m", &source, false).unwrap();
    let class = |profile: &Profile, name: &str| profile.points.get(profile.point_index(name).unwrap()).unwrap().class;
    let of = |name| class(&profile, name);
    assert_eq!(
        (of("least"), of("most"), of("other")),
        (PollClass::Fast, PollClass::Slow, PollClass::Once)
    );
    let source = "name = \"x\"\nbase = \"eaton-hvx\"\nspeed_reference = { signed = true, base = \"min_max\" }\n";
    let hvx = Profile::parse("x", source, false).unwrap();
    assert_eq!(class(&hvx, "minimum_frequency"), PollClass::Slow, "it counts here");
}

#[test]
fn files_with_bases_in_any_order() {
    let dir = TempDir::new().unwrap();
    let write = |file: &str, text: &str| std::fs::write(dir.path().join(file), text).unwrap();
    write("a.toml", "name = \"a\"\nbase = \"b\"\ntitle = \"A\"\n");
    write("b.toml", "name = \"b\"\nbase = \"vacon-cx\"\nturnaround = \"9ms\"\n");
    write(
        "c.toml",
        "name = \"vacon-cx\"\nbase = \"vacon-cx\"\nconfirm_within = \"7s\"\n",
    );
    let mut profiles = Profiles::built_in();
    assert_eq!(profiles.load(dir.path()), []);
    let a = profiles.get("a").unwrap();
    assert_eq!(a.turnaround, Duration::from_millis(9));
    assert_eq!(a.confirm_within, Duration::from_secs(7));
    assert!(!profiles.get("vacon-cx").unwrap().built_in);
    assert_eq!(a.text, "name = \"a\"\nbase = \"b\"\ntitle = \"A\"\n");
    write("b.toml", "name = \"b\"\nbase = \"a\"\n");
    let found = Profiles::built_in().load(dir.path());
    let text: Vec<String> = found.iter().map(Problem::to_string).collect();
    assert_eq!(found.len(), 2, "{text:?}");
    assert!(text[0].contains("`b` is itself based on this profile;"), "{text:?}");
}

#[test]
fn enumerations_have_texts() {
    let source = HEAD.to_string()
        + "[[point]]\nname = \"mode\"\nat = \"holding 1.4-6\"\n[point.texts]\n3 = \"auto\"\n\
           [[point]]\nname = \"on\"\nat = \"holding 1.0\"\n[point.texts]\n0 = \"off\"\n1 = \"on\"\n";
    let profile = Profile::parse("m", &source, false).unwrap();
    let mode = &profile.points[0];
    let value = mode.raw().unwrap().decode(&[0x0030], mode.kind());
    assert_eq!((value, mode.kind()), (Some(Value::Integer(3)), Kind::Integer));
    assert_eq!(mode.text_of(Value::Integer(3)), Some("auto"));
    assert_eq!(mode.text_of(Value::Integer(4)), None);
    assert_eq!(profile.points[1].text_of(Value::Bool(true)), Some("on"));
}

/// The page lists every key that the loader knows, and no other.
#[test]
fn the_page_names_every_key() {
    let page = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/profiles.md")).unwrap();
    let meter = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/energy-meter.toml")).unwrap();
    let choices = "[speed_reference]\nsigned = true\n[n2]\nstate_bit = 6\n[[point]]\nname = \"t\"\nderive = \"sum\"\n";
    let mut known = std::collections::BTreeSet::new();
    let all = BUILT_IN.iter();
    for source in all.map(|(_, source)| *source).chain([meter.as_str(), choices]) {
        let document = Document::parse("p", source);
        let _ = read_profile(&document.reader(), true, &Profiles::default());
        known.extend(document.known_keys());
    }
    // Codes and tables are not keys. Keys that are merged beforehand are not read here.
    known.retain(|key| {
        ![
            "faults.",
            "faults_unverified.",
            "fault_panel.",
            "fault_causes.",
            "fault_remedies.",
            "address_offset.",
        ]
        .iter()
        .any(|p| key.starts_with(p))
    });
    known.retain(|key| !key.contains("texts.") && !key.contains(".always.") && !key.contains(".until."));
    // One table has the keys of all forms of commands.
    const FORMS: [&str; 5] = ["run", "stop", "also_stop[]", "reverse", "fault_reset"];
    let form = |key: String| {
        let of = FORMS.iter().find_map(|of| key.strip_prefix(&format!("control.{of}.")));
        of.map_or(key.clone(), |key| {
            format!("form.{}", key.trim_start_matches("steps[]."))
        })
    };
    let mut known: std::collections::BTreeSet<String> = known.into_iter().map(form).collect();
    known.extend(["remove".to_string(), "points".to_string()]);
    let section = |heading: &str| {
        let (_, rest) = page.split_once(heading).unwrap();
        let rows = rest.split("\n#").next().unwrap().lines();
        let keys = rows.filter_map(|row| row.strip_prefix("| `")?.split('`').next().map(str::to_string));
        keys.collect::<Vec<_>>()
    };
    let mut named = section("\n## Keys of a profile\n");
    for (heading, path) in [
        ("\n### `[control]`\n", "control."),
        ("\n### Forms of a command\n", "form."),
        ("\n### `[[state]]`\n", "state[]."),
        ("\n### `[ranges]`\n", "ranges."),
        ("\n### `[speed_reference]`\n", "speed_reference."),
        ("\n### `[[identify]]`\n", "identify[]."),
        ("\n### `[n2]`\n", "n2."),
        ("\n### `[commissioning]`\n", "commissioning."),
        ("\n### `[parameters]`\n", "parameters."),
        ("\n### `[parameters.lock]`\n", "parameters.lock."),
        ("\n### `[[range]]`\n", "range[]."),
        ("\n### `[[point]]`\n", "point[]."),
    ] {
        named.extend(section(heading).into_iter().map(|key| format!("{path}{key}")));
    }
    named.sort();
    assert_eq!(named, known.into_iter().collect::<Vec<_>>());
}

#[test]
fn mistakes_of_identify() {
    let text = "name = \"p\"\nprotocols = [\"modbus-rtu\"]\n[[identify]]\nread = \"holding x\"\nanswer = \"yes\"\n\
        [[identify]]\nanswer = \"values\"\n[[range]]\ntable = \"holding\"\nfirst = 0\nlast = 9\n\
        [[point]]\nname = \"a\"\nat = \"holding 0\"\n";
    let found = Profile::parse("p.toml", text, false).unwrap_err();
    let all: Vec<String> = found.iter().map(ToString::to_string).collect();
    let all = all.join("\n");
    for wanted in [
        "p.toml:4, identify[0].read",
        "p.toml:5, identify[0].answer",
        "identify[1].read",
    ] {
        assert!(all.contains(wanted), "{wanted} is missing in\n{all}");
    }
}

#[test]
fn points_for_faults_are_read_by_their_registers() {
    let source = |names: &str| format!("name = \"p\"\nbase = \"vacon-nx\"\non_fault = [{names}]\n");
    let profile = Profile::parse("p", &source("\"fault_code_id99\", \"heatsink_temperature\""), false).unwrap();
    let names: Vec<&str> = profile
        .on_fault
        .iter()
        .map(|i| profile.points.get(*i).unwrap().name.as_str())
        .collect();
    assert_eq!(names, ["fault_code_id99", "heatsink_temperature"]);
    // A point that is polled anyway, or is compared with process data, needs no separate read.
    let plan = crate::drive::Plan::of(&profile);
    assert_eq!(plan.on_fault, []);
    let monitors: Vec<_> = plan.monitors.iter().map(|read| (read.start, read.count)).collect();
    assert_eq!(monitors, [(0, 2), (3, 4), (44, 1), (98, 1)]);
    // A derived point is read through its sources; a removed point is not read.
    let derived = Profile::parse("p", &source("\"frequency_reference\""), false).unwrap();
    let names: Vec<&str> = derived
        .on_fault
        .iter()
        .map(|i| derived.points.get(*i).unwrap().name.as_str())
        .collect();
    assert!(names.contains(&"speed_reference"), "{names:?}");
    let removed = "name = \"p\"\nbase = \"vacon-nx\"\nremove = [\"motor_temperature\"]\n";
    let names = |profile: &Profile| profile.on_fault.len();
    let nx = Profiles::built_in();
    let all = names(nx.get("vacon-nx").unwrap());
    assert_eq!(names(&Profile::parse("p", removed, false).unwrap()), all - 1);
    let all = mistakes("p", &source("\"fault_code_id9\""));
    assert!(all.contains("p:3, on_fault; did you mean `fault_code_id99`?"), "{all}");
}

#[test]
fn a_wrong_place_or_type_makes_no_other_key_unknown() {
    for (at, kind, wanted) in [
        ("holding 1", "u17", "unknown type `u17`"),
        ("holdng 1", "u16", "unknown table `holdng`"),
        ("40003", "u16", "write table and PDU address: \"holding 2\""),
        ("300010", "u16", "write table and PDU address: \"input 9\""),
        ("70003", "u16", "`70003` is not an address"),
    ] {
        let point =
            format!("{HEAD}[[point]]\nname = \"a\"\nat = \"{at}\"\ntype = \"{kind}\"\nscale = 0.1\noffset = 1\n");
        let found = mistakes("m.toml", &point);
        assert!(found.contains(wanted) && found.lines().count() == 1, "{found}");
    }
}

#[test]
fn a_slip_in_the_name_of_a_model_point_is_a_warning() {
    let warnings = |name: &str| {
        let source = format!("{HEAD}[[point]]\nname = \"{name}\"\nat = \"holding 1\"\n");
        let profile = Profile::parse("m.toml", &source, false).unwrap();
        profile.warnings.iter().map(Problem::to_string).collect::<Vec<_>>()
    };
    let found = warnings("output_freqency");
    assert!(
        found.len() == 1 && found[0].contains("write `output_frequency`"),
        "{found:?}"
    );
    assert_eq!(warnings("output_frequency"), Vec::<String>::new());
    assert_eq!(warnings("output_frequency_2"), Vec::<String>::new());
    assert!(Profiles::built_in().warnings().next().is_none());
}

#[test]
fn a_range_ends_within_its_register() {
    let range = |range: &str| {
        let point = "[[point]]\nname = \"a\"\nat = \"holding 1\"\nscale = 0.01\nwrite = true\n";
        mistakes("m.toml", &format!("{HEAD}{point}range = {range}\n"))
    };
    assert_eq!(range("[0, 655.35]"), "");
    assert!(
        range("[0, 5000]").contains("holds 0 to 655.35"),
        "{}",
        range("[0, 5000]")
    );
}
