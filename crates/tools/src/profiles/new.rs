//! `drivegate profiles new`: the beginning of a profile.

use drivegate_model::drive::model::Kind;
use drivegate_model::drive::{ModelPoint, Point, Profile};

/// The text of a profile based on another one, with possible changes as remarks.
pub(super) fn over(name: &str, base: &Profile) -> String {
    let mut text = format!(
        "# {}\n# Only what differs from `{}`; `drivegate profiles show {}` has all of it.\nname = \"{name}\"\nbase = \"{}\"\n",
        base.title, base.name, base.name, base.name
    );
    if !base.verified {
        text += "# Once it is confirmed on hardware (docs/verifying.md):\n# verified = true\n";
    }
    text += "\n# One key of a point:\n";
    let figures = [
        ModelPoint::OutputFrequency,
        ModelPoint::MotorCurrent,
        ModelPoint::MotorSpeed,
    ];
    let figure = figures.into_iter().find(|point| base.model_index(*point).is_some());
    let figure = figure.map(|point| point.name());
    let is_figure = |point: &&Point| !point.hidden && point.raw().is_some() && point.kind() == Kind::Number;
    let first = base.points.iter().find(is_figure).map(|point| point.name.as_str());
    let figure = figure.or(first).unwrap_or_default();
    text +=
        &format!("# points.{figure}.scale = 0.1\n# A point that the drive does not have:\n# remove = [\"{figure}\"]\n");
    let address = base.ranges.first().map_or(0, |range| *range.addresses.start());
    let table = base.ranges.first().map_or("holding", |range| range.table.name());
    text += &format!(
        "\n# Another point; its address must be in a [[range]].\n# [[point]]\n# name = \"our_value\"\n# at = \"{table} {address}\"\n\
         # scale = 0.1\n# unit = \"%\"\n"
    );
    text
}

/// The frame of a profile that is based on no other.
pub(super) fn frame(name: &str) -> String {
    FRAME.replace("NAME", name)
}

const FRAME: &str = r#"# Every address is a PDU address, from 0: the manual's 40257 is holding 256, 30001 is input 0.
name = "NAME"
title = ""
source = ""                   # the manual and its tables
protocols = ["modbus-rtu"]    # "modbus-ascii"; "n2" has a profile of its own
verified = false              # true once it is confirmed on hardware, see docs/verifying.md

# Addresses that may be read together, with the limits of the manual.
[[range]]
table = "holding"
first = 0
last = 9
read = 1
write = 1

# How the drive is commanded: its control word, and which words run, stop and reset. Leave it out for a meter.
# [control]
# at = "holding 0"
# run = { bit = 0 }           # or { mask = 0x0F, value = 0x02 }, { forward_bit = 0, reverse_bit = 1 }, { steps = [..] }
# stop = { bit = 0, is = 0 }
# always = { clear = [3] }    # bits of every word
# also_stop = [{ bit = 3, is = 1 }]    # coast or quick stop, as another master may write it
# reverse = { bit = 1 }
# fault_reset = { bit = 2, hold = "100ms" }

# Names of the common model (docs/drives.md) have their meaning and unit: running, fault, output_frequency, ..
[[point]]
name = "output_frequency"
at = "holding 3"
scale = 0.01
class = "fast"
"#;

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_model::drive::profile::Profiles;

    /// The printed text is a valid profile, also with its commented lines enabled.
    #[test]
    fn every_beginning_is_a_profile() {
        let read = |text: &str| Profile::parse("p.toml", text, false);
        let bare = |text: &str| {
            text.replace("\n# verified", "\nverified")
                .replace("\n# points.", "\npoints.")
        };
        assert_eq!(read(&frame("our-drive")).unwrap().name, "our-drive");
        let commands = FRAME.replace("\n# [control]", "\n[control]");
        let commands = ["at", "run", "stop", "always", "also_stop", "reverse", "fault_reset"]
            .iter()
            .fold(commands, |text, key| {
                text.replace(&format!("\n# {key} = "), &format!("\n{key} = "))
            });
        assert!(read(&commands.replace("NAME", "x")).unwrap().control.is_some());
        for base in Profiles::built_in().iter() {
            let text = over("our-drive", base);
            let profile = read(&text).unwrap_or_else(|why| panic!("{}: {why:?}", base.name));
            assert_eq!(
                (profile.points.len(), &profile.ranges),
                (base.points.len(), &base.ranges)
            );
            let changed = read(&bare(&text)).unwrap_or_else(|why| panic!("{}: {why:?}", base.name));
            assert!(changed.verified);
        }
    }
}
