//! The likely defect of the line when no drive answered, judged by the bytes received. Pure.

use std::collections::BTreeSet;
use std::time::Duration;

use super::{Found, Setting, StrayBytes};
use drivegate_core::diagnosis::Cause;
use drivegate_model::drive::Step;
use drivegate_model::drive::commissioning::{Shared, gather};
use drivegate_model::drive::profile::{Profile, Profiles};

/// Number of bytes that may result from switching the port on, or from single disturbances.
const FEW_BYTES: usize = 8;

/// Error and remedy if bytes arrived before the tool sent anything.
pub(crate) fn somebody_speaks(heard: &StrayBytes, port: &str, listened: Duration) -> Option<String> {
    (heard.unasked >= FEW_BYTES).then(|| {
        format!(
            "{} bytes came within {listened:?} before anything was sent, so nothing was sent: another master sends on \
             this line, or it is not terminated and picks up noise; {port}; stop the other master (PLC, gateway, \
             tool), or terminate the line; `drivegate scan` sends anyway",
            heard.unasked
        )
    })
}

/// The probable reason why no drive answered, and the remedy.
pub(crate) fn nobody_answers(heard: &StrayBytes, port: &str) -> String {
    let requests = heard.requests;
    if let Some(told) = told_by_shape(heard) {
        return format!("no drive answered, but {told}; {port}");
    }
    if heard.no_way > 0 {
        return format!(
            "no drive answered: the gateway at the port did, {} times for {requests} requests, and reports with \
             exception 0A or 0B that it reaches no drive at these addresses; {port}; check baud rate, format and \
             wiring of the line behind that gateway, and the power of its drives",
            heard.no_way
        );
    }
    if let Some((setting, count)) = most_garbage(heard) {
        return format!(
            "no drive answered, but {} bytes came that are not a valid reply, most of them at {setting} ({count} \
             times): something is connected and answers, so the wiring carries data; {port}; try the baud rate and \
             format shown on the drive's panel, or --baud all --format all; two drives with one address look the same",
            heard.bytes
        );
    }
    if heard.bytes > 0 || heard.unasked >= FEW_BYTES {
        return format!(
            "no drive answered, but {} bytes came that belong to no request: another master sends on this line, or it \
             picks up noise; {port}; stop the other master, check termination and the reference conductor, and try \
             again",
            heard.bytes + heard.unasked
        );
    }
    if heard.echoes > 0 {
        return format!(
            "no drive answered: {} of {requests} requests came back as the adapter's own echo and nothing else was \
             received, so the adapter does send, but the drives are silent; {port}; check power, wiring (swap - and \
             +) and that the fieldbus is enabled in the drive; then try --baud all --format all",
            heard.echoes
        );
    }
    format!(
        "no drive answered: after {requests} requests no byte was received; {port}; a drive with other settings is as \
         silent as a dead line, so first check power, wiring (swap - and +), termination and that the fieldbus is \
         enabled in the drive, and whether the transmit light blinks; then try --baud all --format all"
    )
}

/// The fault indicated by the form of the received bytes, if there is one.
fn told_by_shape(heard: &StrayBytes) -> Option<String> {
    let StrayBytes {
        start_lost,
        cut_echoes,
        stray_before,
        requests,
        ..
    } = heard;
    let told = [
        (
            *start_lost,
            format!("{start_lost} replies are valid once their first bytes are restored"),
            Cause::ReplyStartLost,
        ),
        (
            *cut_echoes,
            format!("{cut_echoes} of {requests} requests came back as the adapter's own echo without their last bytes"),
            Cause::RequestEndLost,
        ),
        (
            *stray_before,
            format!("{stray_before} replies had stray bytes before them"),
            Cause::Bias,
        ),
    ];
    let (count, seen, cause) = told.into_iter().max_by_key(|(count, ..)| *count)?;
    (count >= 2).then(|| format!("{seen}: {}; {}", cause.meaning(), cause.remedy()))
}

/// A remark on a line on which drives answered but invalid bytes were received too.
pub(crate) fn beside_answers(heard: &StrayBytes) -> Option<String> {
    if let Some(told) = told_by_shape(heard) {
        return Some(told);
    }
    let (setting, address) = heard.garbage.first()?;
    Some(format!(
        "received invalid frames {} times, first at {setting}, address {address}: the line may have another baud \
         rate, format or protocol, or two drives the same address",
        heard.garbage.len(),
    ))
}

/// What to check at the drives: for the families with manuals whose protocol was tried; all families would fill pages.
pub(crate) fn at_silent_drives(heard: &StrayBytes, tried: &[Setting], profiles: &Profiles) -> String {
    let speaks = |profile: &&Profile| tried.iter().any(|one| profile.protocols.contains(&one.protocol));
    // Profiles with a base have the lines of their base.
    let families = profiles
        .iter()
        .map(AsRef::as_ref)
        .filter(|profile: &&Profile| profile.base.is_none() && profile.verified);
    let families: Vec<&Profile> = families.filter(speaks).collect();
    let (heading, steps) = match most_garbage(heard) {
        Some(_) => ("settings in the drives", [Step::Settings]),
        None => ("what the drives' lamps and panels show", [Step::Lamps]),
    };
    let lines = grouped(&gather(&families, &steps));
    if lines.is_empty() {
        return lines;
    }
    format!(
        "{heading}; `drivegate profiles show NAME` has terminals, termination and settings, of other families too:\n{lines}"
    )
}

/// Steps that the families that answered need before the first command.
pub(crate) fn before_commands(found: &[Found], profiles: &Profiles) -> String {
    let mut seen = BTreeSet::new();
    let names = found
        .iter()
        .flat_map(|one| &one.profiles)
        .filter(|name| seen.insert(*name));
    let families: Vec<&Profile> = names.filter_map(|name| profiles.get(name)).map(AsRef::as_ref).collect();
    let lines = grouped(&gather(&families, &[Step::ControlPlace]));
    if lines.is_empty() {
        return lines;
    }
    format!("before the first command; `drivegate profiles show NAME` has the rest of the commissioning:\n{lines}")
}

/// The lines, each group below the names of the profiles that share it.
fn grouped(lines: &[Shared<'_>]) -> String {
    let mut text = String::new();
    for same in lines.chunk_by(|one, next| one.profiles == next.profiles) {
        let names = same.first().map(|shared| shared.profiles.join(", "));
        text += &format!("  {}\n", names.unwrap_or_default());
        for shared in same {
            text += &format!("    - {}\n", shared.line);
        }
    }
    text
}

/// The setting with most invalid replies, and how many.
fn most_garbage(heard: &StrayBytes) -> Option<(Setting, usize)> {
    let count = |setting: &Setting| heard.garbage.iter().filter(|(other, _)| other == setting).count();
    let settings = heard.garbage.iter().map(|(setting, _)| *setting);
    settings
        .map(|setting| (setting, count(&setting)))
        .max_by_key(|(_, count)| *count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_proto::{LineFormat, Protocol};

    fn at(baud: u32) -> Setting {
        Setting {
            protocol: Protocol::ModbusRtu,
            format: LineFormat::new(baud, "8N1").unwrap(),
        }
    }

    #[test]
    fn what_was_heard_decides() {
        let silent = StrayBytes {
            requests: 30,
            ..StrayBytes::default()
        };
        let echo = StrayBytes {
            requests: 30,
            echoes: 30,
            ..StrayBytes::default()
        };
        let wrong = StrayBytes {
            requests: 30,
            bytes: 90,
            garbage: vec![(at(9600), 1), (at(19_200), 1), (at(19_200), 2)],
            ..StrayBytes::default()
        };
        let noise = StrayBytes {
            requests: 30,
            bytes: 5,
            ..StrayBytes::default()
        };
        let late = StrayBytes {
            requests: 30,
            bytes: 60,
            start_lost: 4,
            ..StrayBytes::default()
        };
        let early = StrayBytes {
            requests: 30,
            bytes: 60,
            cut_echoes: 30,
            garbage: vec![(at(9600), 1)],
            ..StrayBytes::default()
        };
        for (heard, wanted) in [
            (
                late,
                "4 replies are valid once their first bytes are restored: the start of replies is lost; ",
            ),
            (
                early,
                "30 of 30 requests came back as the adapter's own echo without their last bytes",
            ),
            (silent, "after 30 requests no byte was received; /dev/x; "),
            (echo, "30 of 30 requests came back as the adapter's own echo"),
            (
                wrong,
                "90 bytes came that are not a valid reply, most of them at modbus-rtu 19200 8N1 (2 times)",
            ),
            (noise, "5 bytes came that belong to no request"),
        ] {
            let told = nobody_answers(&heard, "/dev/x");
            assert!(told.contains(wanted), "{told}");
        }
    }

    #[test]
    fn another_master_is_not_disturbed() {
        let heard = |unasked| StrayBytes {
            unasked,
            ..StrayBytes::default()
        };
        let second = Duration::from_secs(1);
        assert_eq!(somebody_speaks(&heard(3), "/dev/x", second), None);
        let told = somebody_speaks(&heard(64), "/dev/x", second).unwrap();
        assert!(
            told.starts_with("64 bytes came within 1s before anything was sent"),
            "{told}"
        );
    }

    #[test]
    fn the_steps_are_those_of_the_families_that_were_tried() {
        let profiles = Profiles::built_in();
        let silent = at_silent_drives(&StrayBytes::default(), &[at(9600)], &profiles);
        let wanted = "  eaton-hvx, eaton-svx, vacon-nx\n    - green LED (FS) steady: the board is active and has seen no message yet";
        assert!(silent.contains(wanted), "{silent}");
        assert!(silent.contains("  vacon-cx\n") && !silent.contains("teco"), "{silent}");
        let wrong = StrayBytes {
            garbage: vec![(at(9600), 1)],
            ..StrayBytes::default()
        };
        let ascii = Setting {
            protocol: Protocol::ModbusAscii,
            format: LineFormat::new(9600, "7N2").unwrap(),
        };
        let settings = at_silent_drives(&wrong, &[ascii], &profiles);
        assert!(
            settings.contains("  teco-7300pa\n    - the switches are read at power-on"),
            "{settings}"
        );
        assert!(!settings.contains("LED") && !settings.contains("vacon"), "{settings}");
    }

    #[test]
    fn what_answered_is_told_what_it_needs() {
        let found = |names: &[&str]| Found {
            setting: at(9600),
            address: 1,
            profiles: names.iter().map(ToString::to_string).collect(),
            chosen: false,
            nameplate: String::new(),
            unanswered: 0,
            turnaround: None,
        };
        let profiles = Profiles::built_in();
        let told = before_commands(&[found(&["vacon-cx"]), found(&["vacon-cx"])], &profiles);
        assert_eq!(told.matches("Fieldbus control select = 1").count(), 1, "{told}");
        assert_eq!(before_commands(&[found(&[])], &profiles), "");
    }
}
