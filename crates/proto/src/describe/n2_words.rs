//! Commands and answers of N2 in terms of its objects.

use crate::n2::{self, Command, Region};
use crate::{Exception, Reply, RequestPdu};

/// A command of N2: `read AI 2 value`, `override AO 1 = 50`, `identify`.
pub(super) fn command(pdu: &RequestPdu) -> Option<String> {
    Some(match n2::command_of(pdu)? {
        Command::Identify => "identify".to_string(),
        Command::Poll { again: false } => "poll for changes".to_string(),
        Command::Poll { again: true } => "poll for changes, acknowledged".to_string(),
        Command::Read { object, .. } => match object.region {
            Region::Bi | Region::Bo => format!("read {object} state"),
            _ => format!("read {object} value"),
        },
        Command::Override { object, data } => match data.as_slice() {
            [a, b, c, d] => format!("override {object} = {}", f32::from_be_bytes([*a, *b, *c, *d])),
            [byte] => format!("override {object} = {byte}"),
            _ => format!("override {object}"),
        },
        Command::Release { object } => format!("release {object}"),
        _ => return None,
    })
}

/// A reply of N2 in terms of its object: `25`, `on`, `acknowledged`, `N11 (…)`.
pub(super) fn answer(asked: &RequestPdu, reply: &Reply) -> String {
    match reply {
        Reply::Bits(bits) => if bits.first() == Some(&true) { "on" } else { "off" }.to_string(),
        Reply::Registers(words) => match words.as_slice() {
            [high, low] => f32::from_bits(u32::from(*high) << 16 | u32::from(*low)).to_string(),
            [word] => (*word as i16).to_string(),
            _ => super::answer(reply),
        },
        Reply::Written => "acknowledged".to_string(),
        Reply::Exception(exception @ Exception::N2(code)) => format!("N{code:02X}: {}", exception.meaning()),
        // The reply is valid but its status byte marks the value as unreliable, so no exception of the drive is reported.
        Reply::Exception(_) if matches!(asked, RequestPdu::Read { .. }) => "unreliable".to_string(),
        _ => super::answer(reply),
    }
}

/// An unrequested line: a request of another master, or a late reply.
pub(super) fn stray(bytes: &[u8]) -> String {
    if let Some((address, Ok(_))) = Command::decode(bytes) {
        return format!("foreign: a request to address {address}");
    }
    if is_answer(bytes) {
        return "foreign: an unsolicited or late reply".to_string();
    }
    super::no_frame(bytes)
}

/// Whether the bytes are one valid N2 reply.
pub(super) fn is_answer(bytes: &[u8]) -> bool {
    bytes
        .strip_suffix(b"\r")
        .is_some_and(|line| n2::Answer::decode(line).is_ok())
}
