//! The requests of a case of a proof, as data; they become text only in a counterexample.

use std::fmt;

use drivegate_core::order::written;
use drivegate_proto::{Exception, RequestPdu};

/// What happens to a request of the proof.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Fate {
    RequestLost,
    ReplyLost,
    Refused(Exception),
    /// The request arrives twice.
    Repeated,
}

/// A request, or an event in between.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Frame {
    Request(RequestPdu, Option<Fate>),
    /// A stop, given as a separate command.
    Stop,
}

impl Frame {
    pub(super) fn is_read(&self) -> bool {
        matches!(self, Frame::Request(RequestPdu::Read { .. }, _))
    }

    pub(super) fn is_write(&self) -> bool {
        matches!(self, Frame::Request(pdu, _) if pdu.is_write())
    }
}

impl fmt::Display for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Frame::Request(pdu, fate) = self else {
            return f.write_str("(a stop comes in)");
        };
        f.write_str(&in_words(pdu))?;
        match fate {
            None => Ok(()),
            Some(Fate::RequestLost) => f.write_str(" (lost)"),
            Some(Fate::ReplyLost) => f.write_str(" (its reply is lost)"),
            Some(Fate::Repeated) => f.write_str(" (arrives twice)"),
            Some(Fate::Refused(code)) => write!(f, " (refused: {code})"),
        }
    }
}

/// The requests at which events are tried; of a state that is read repeatedly, only the first and the last read.
pub(super) fn different(frames: &[Frame]) -> Vec<usize> {
    let other = |one: usize, by: Option<usize>| by.and_then(|by| frames.get(by)) != frames.get(one);
    let all = 0..frames.len();
    all.filter(|number| other(*number, number.checked_sub(1)) || other(*number, Some(number + 1)))
        .collect()
}

/// `holding 8501 = 0x000f`, or `read holding 3201`.
pub(super) fn in_words(pdu: &RequestPdu) -> String {
    if let RequestPdu::Read { table, start, .. } = pdu {
        return format!("read {table} {start}");
    }
    let Some((table, items)) = written(pdu) else {
        return "another request".to_string();
    };
    let items = items
        .iter()
        .map(|(address, word)| format!("{table} {address} = {word:#06x}"));
    items.collect::<Vec<_>>().join(", ")
}
