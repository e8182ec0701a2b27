//! What the line is likely to lack when no drive answered, by what was heard. Pure.

use std::time::Duration;

use super::{Heard, Setting};
use crate::diagnosis::Cause;

/// Bytes that come of switching the port on, or are single disturbances.
const FEW_BYTES: usize = 8;

/// What to do if bytes came before anything was sent.
pub(crate) fn somebody_speaks(heard: &Heard, port: &str, listened: Duration) -> Option<String> {
    (heard.unasked >= FEW_BYTES).then(|| {
        format!(
            "{} bytes came within {listened:?} before anything was sent, so nothing was sent: another master speaks on this \
             line, or it is not terminated and picks up noise; {port}; stop the other master (PLC, gateway, tool), or \
             terminate the line; `drivegate scan` sends all the same",
            heard.unasked
        )
    })
}

/// Why no drive may have answered, and what to do.
pub(crate) fn nobody_answers(heard: &Heard, port: &str) -> String {
    let requests = heard.requests;
    if let Some(told) = told_by_shape(heard) {
        return format!("no drive answered, but {told}; {port}");
    }
    if heard.no_way > 0 {
        return format!(
            "no drive answered: the gateway at the port did, {} times for {requests} requests, and says by exception 0A or 0B \
             that it reaches nobody at these addresses; {port}; check baud, format and wiring of the line behind that gateway, \
             and the power of its drives",
            heard.no_way
        );
    }
    if let Some((setting, count)) = most_garbage(heard) {
        return format!(
            "no drive answered, but {} bytes came that are no valid reply, most of them at {setting} ({count} times): \
             something is connected and answers, so the wiring carries data; {port}; try the baud and format shown on the \
             drive's panel, or --baud all --format all; two drives with one address look the same",
            heard.bytes
        );
    }
    if heard.bytes > 0 || heard.unasked >= FEW_BYTES {
        return format!(
            "no drive answered, but {} bytes came that belong to no request: another master speaks on this line, or it picks \
             up noise; {port}; stop the other master, check termination and the reference conductor, and try again",
            heard.bytes + heard.unasked
        );
    }
    if heard.echoes > 0 {
        return format!(
            "no drive answered: {} of {requests} requests came back as the adapter's own echo and nothing else was heard, so \
             the adapter sends, and the drives are silent; {port}; check power, wiring (swap - and +) and that the bus is \
             enabled at the drive; then try --baud all --format all",
            heard.echoes
        );
    }
    format!(
        "no drive answered: after {requests} requests not one byte was heard; {port}; a drive is silent at wrong settings as \
         well as on a dead line, so first check power, wiring (swap - and +), termination and that the bus is enabled at the \
         drive, and whether the transmit light blinks; then try --baud all --format all"
    )
}

/// What the shape of the bytes says, where it says something.
fn told_by_shape(heard: &Heard) -> Option<String> {
    let Heard {
        start_lost,
        cut_echoes,
        stray_before,
        requests,
        ..
    } = heard;
    let told = [
        (
            *start_lost,
            format!("{start_lost} replies came that are sound once their first bytes are put back"),
            Cause::ReplyStartLost,
        ),
        (
            *cut_echoes,
            format!("{cut_echoes} of {requests} requests came back as the adapter's own echo without their end"),
            Cause::RequestEndLost,
        ),
        (
            *stray_before,
            format!("{stray_before} replies came with stray bytes before them"),
            Cause::Bias,
        ),
    ];
    let (count, seen, cause) = told.into_iter().max_by_key(|(count, ..)| *count)?;
    (count >= 2).then(|| format!("{seen}: {}; {}", cause.meaning(), cause.remedy()))
}

/// What is to be said of a line on which drives answered, too.
pub(crate) fn beside_answers(heard: &Heard) -> Option<String> {
    if let Some(told) = told_by_shape(heard) {
        return Some(told);
    }
    let (setting, address) = heard.garbage.first()?;
    Some(format!(
        "received invalid frames {} times, first at {setting}, address {address}: the line may have another baud, format or \
         protocol, or two drives the same address",
        heard.garbage.len(),
    ))
}

/// The setting with most invalid replies, and how many.
fn most_garbage(heard: &Heard) -> Option<(Setting, usize)> {
    let count = |setting: &Setting| heard.garbage.iter().filter(|(other, _)| other == setting).count();
    let settings = heard.garbage.iter().map(|(setting, _)| *setting);
    settings
        .map(|setting| (setting, count(&setting)))
        .max_by_key(|(_, count)| *count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec::{LineFormat, Protocol};

    fn at(baud: u32) -> Setting {
        Setting {
            protocol: Protocol::ModbusRtu,
            format: LineFormat::new(baud, "8N1").unwrap(),
        }
    }

    #[test]
    fn what_was_heard_decides() {
        let silent = Heard {
            requests: 30,
            ..Heard::default()
        };
        let echo = Heard {
            requests: 30,
            echoes: 30,
            ..Heard::default()
        };
        let wrong = Heard {
            requests: 30,
            bytes: 90,
            garbage: vec![(at(9600), 1), (at(19_200), 1), (at(19_200), 2)],
            ..Heard::default()
        };
        let noise = Heard {
            requests: 30,
            bytes: 5,
            ..Heard::default()
        };
        let late = Heard {
            requests: 30,
            bytes: 60,
            start_lost: 4,
            ..Heard::default()
        };
        let early = Heard {
            requests: 30,
            bytes: 60,
            cut_echoes: 30,
            garbage: vec![(at(9600), 1)],
            ..Heard::default()
        };
        for (heard, wanted) in [
            (
                late,
                "4 replies came that are sound once their first bytes are put back: the beginning of replies is lost; ",
            ),
            (
                early,
                "30 of 30 requests came back as the adapter's own echo without their end",
            ),
            (silent, "after 30 requests not one byte was heard; /dev/x; "),
            (echo, "30 of 30 requests came back as the adapter's own echo"),
            (
                wrong,
                "90 bytes came that are no valid reply, most of them at modbus-rtu 19200 8N1 (2 times)",
            ),
            (noise, "5 bytes came that belong to no request"),
        ] {
            let told = nobody_answers(&heard, "/dev/x");
            assert!(told.contains(wanted), "{told}");
        }
    }

    #[test]
    fn another_master_is_not_disturbed() {
        let heard = |unasked| Heard {
            unasked,
            ..Heard::default()
        };
        let second = Duration::from_secs(1);
        assert_eq!(somebody_speaks(&heard(3), "/dev/x", second), None);
        let told = somebody_speaks(&heard(64), "/dev/x", second).unwrap();
        assert!(
            told.starts_with("64 bytes came within 1s before anything was sent"),
            "{told}"
        );
    }
}
