//! `[control]` of a profile as text.

use super::name_of;
use drivegate_model::document::format_duration;
use drivegate_model::drive::Profile;
use drivegate_model::drive::control::{Control, ControlItem, Mask, OwnWord, Run, Setting, Step, Until};

/// A line for each command, with the words of the command in hexadecimal.
pub(super) fn lines(profile: &Profile, control: &Control) -> Vec<(&'static str, String)> {
    let own = match control.own_word {
        OwnWord::Read | OwnWord::Kept => "",
        OwnWord::Shadow => ", which does not read back as written",
    };
    let mut lines = vec![("control word", format!("{}{own}", place(control.at)))];
    if control.always != Default::default() {
        let always = control.always;
        lines.push((
            "in every word",
            format!("{:#06x} set, {:#06x} clear", always.set, always.clear),
        ));
    }
    match &control.run {
        Run::One(run) => lines.push(("run", setting(run))),
        Run::Pair { forward, reverse } => {
            lines.push(("forward", setting(forward)));
            lines.push(("reverse", setting(reverse)));
        }
        Run::Steps(steps) => {
            let steps: Vec<String> = steps.iter().map(|one| step(profile, one)).collect();
            lines.push(("run", steps.join("; then ")));
        }
    }
    lines.push(("stop", setting(&control.stop)));
    if !control.also_stop.is_empty() {
        let stops: Vec<String> = control.also_stop.iter().map(setting).collect();
        lines.push(("stops, too", stops.join("; ")));
    }
    lines.extend(control.reverse.as_ref().map(|reverse| ("reverse", setting(reverse))));
    if let Some(reset) = &control.fault_reset {
        let hold = format_duration(reset.pulse);
        lines.push(("fault reset", format!("{}, for {hold}", setting(&reset.setting))));
    }
    lines.push(("own timeout", refresh(profile, control)));
    if control.restarts_on_reset {
        lines.push((
            "caution",
            "a reset while a run command is set starts the motor".to_string(),
        ));
    }
    lines
}

/// The value that a refresh writes again, and whether refresh is on by default.
fn refresh(profile: &Profile, control: &Control) -> String {
    let repeats = match profile.repeats() {
        Ok(repeats) => repeats,
        Err(why) => return format!("nothing is written again (`refresh`): {why}"),
    };
    let what = match (repeats.word, repeats.reference, control.refresh_with_reference) {
        (true, true, true) => "the reference, or the control word where none was ordered",
        (true, true, false) => "reference and control word",
        (true, false, _) => "the control word",
        (false, ..) => "the reference",
    };
    match control.refresh {
        Some(every) => format!(
            "counts only writes: {what} every {} with `supervision`",
            format_duration(every)
        ),
        None => format!("`refresh` writes {what}; off unless it is set"),
    }
}

fn place(place: ControlItem) -> String {
    format!("{} {}", place.table, place.address)
}

fn setting(setting: &Setting) -> String {
    let bits = match setting.mask {
        u16::MAX => format!("{:#06x}", setting.value),
        mask => format!("{:#06x} in the bits {mask:#06x}", setting.value),
    };
    let at = setting.place.map(|at| format!(" at {}", place(at))).unwrap_or_default();
    let once = if setting.once { ", acts when written" } else { "" };
    format!("{bits}{at}{once}")
}

fn step(profile: &Profile, step: &Step) -> String {
    let until = match &step.until {
        Until::Written => return setting(&step.write),
        Until::Time(time) => format!("for {}", format_duration(*time)),
        Until::State(Mask { point, mask, is }) => {
            format!("until {} has {is:#06x} in {mask:#06x}", name_of(profile, *point))
        }
    };
    let timeout = format_duration(step.timeout);
    format!("{} {until}, {timeout} at most", setting(&step.write))
}
