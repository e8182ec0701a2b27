//! The bytes received in a transaction, split into their parts: echo, reply, foreign frames, garbage.

use std::ops::Range;

use super::n2_words;
use crate::{Decoded, Protocol, Reply, Request, RequestPdu};

/// The kind of a part of a transaction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// The request, echoed by the adapter.
    Echo,
    /// The reply to the request, perhaps an exception.
    Reply,
    /// A valid frame of another device.
    Foreign,
    /// Bytes that form no valid frame.
    Garbage,
}

/// A part of the bytes received in a transaction.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Part {
    /// Kind of this part.
    pub kind: Kind,
    /// Range of the part within the bytes.
    pub range: Range<usize>,
}

/// Splits the bytes received after `request`, whose frame was `frame`, into parts in the order of arrival.
/// `answered` means that the transaction ended with a reply, which distinguishes the reply to a write from its
/// echo.
pub fn parts(protocol: Protocol, request: &Request, frame: &[u8], bytes: &[u8], answered: bool) -> Vec<Part> {
    let mut parts = Vec::new();
    let mut at = 0;
    let mut echo_seen = false;
    while let Some(rest) = bytes.get(at..).filter(|rest| !rest.is_empty()) {
        let noise = protocol.noise(rest);
        let (kind, used) = match protocol.decode(request, rest) {
            _ if noise > 0 => (Kind::Garbage, noise),
            _ if !echo_seen && is_echo(protocol, request, frame, rest, answered) => (Kind::Echo, frame.len()),
            Decoded::Reply { used, .. } => (Kind::Reply, used),
            Decoded::Foreign { used } => (Kind::Foreign, used),
            Decoded::Incomplete | Decoded::Corrupt(_) => {
                (Kind::Garbage, garbage_len(protocol, request, rest, answered))
            }
        };
        echo_seen |= kind == Kind::Echo;
        // A part is never empty, so the loop ends.
        let end = (at + used.max(1)).min(bytes.len());
        parts.push(Part { kind, range: at..end });
        at = end;
        if kind == Kind::Reply {
            break;
        }
    }
    if at < bytes.len() {
        parts.push(Part {
            kind: behind(protocol, bytes.get(at..).unwrap_or_default()),
            range: at..bytes.len(),
        });
    }
    parts
}

/// Whether a frame is the echo of the request. Most requests cannot be answered by their own frame; the write of
/// one register can, so there only a second frame, or the lack of an answer, shows an echo.
fn is_echo(protocol: Protocol, request: &Request, frame: &[u8], rest: &[u8], answered: bool) -> bool {
    let Some(more) = rest.strip_prefix(frame).filter(|_| !frame.is_empty()) else {
        return false;
    };
    let like_its_reply = matches!(protocol.decode(request, frame), Decoded::Reply { .. });
    !like_its_reply || !answered || more.starts_with(frame)
}

/// Number of garbage bytes before the accepted reply, or all bytes if there is none. After garbage, exceptions and
/// acknowledgements are not accepted.
fn garbage_len(protocol: Protocol, request: &Request, rest: &[u8], answered: bool) -> usize {
    let is_reply = |at: &usize| {
        let behind = rest.get(*at..).unwrap_or_default();
        let begins = |&first: &u8| protocol.may_begin_behind_garbage(request.address, first);
        if !behind.first().is_some_and(begins) {
            return false;
        }
        match protocol.decode(request, behind) {
            Decoded::Reply { reply, .. } => !matches!(reply, Reply::Exception(_)),
            _ => false,
        }
    };
    let believed = answered && matches!(request.pdu, RequestPdu::Read { .. });
    let at = (1..rest.len()).find(is_reply).filter(|_| believed);
    at.unwrap_or(rest.len())
}

fn behind(protocol: Protocol, bytes: &[u8]) -> Kind {
    match protocol.open_frame(bytes) {
        Some(_) => Kind::Foreign,
        None if protocol == Protocol::N2 && n2_words::is_answer(bytes) => Kind::Foreign,
        None => Kind::Garbage,
    }
}
