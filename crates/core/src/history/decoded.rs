//! What the frames of a recording say, in the words of `drivegate trace`. Pure.

use super::recording::Frame;
use crate::process_image::Verdict;
use drivegate_proto::describe::{self, Kind};
use drivegate_proto::n2::{self, Command};
use drivegate_proto::{Protocol, Request, RequestPdu};

/// Decodes the frames of a line in their order: a reply is read against the request before it.
#[derive(Debug)]
pub(super) struct Decoder<'r> {
    protocol: Option<Protocol>,
    /// The last request and its frame.
    asked: Option<(Request, &'r [u8])>,
}

impl<'r> Decoder<'r> {
    /// A decoder for a line with this protocol, which a later version may have written.
    pub(super) fn new(protocol: &str) -> Decoder<'r> {
        Decoder {
            protocol: Protocol::from_name(protocol),
            asked: None,
        }
    }

    /// The meaning of the next frame; empty for a timeout, which has no bytes.
    pub(super) fn next(&mut self, frame: &'r Frame) -> String {
        let bytes = &frame.bytes[..];
        let Some(protocol) = self.protocol.filter(|_| !bytes.is_empty()) else {
            return String::new();
        };
        // Without the prefix `foreign`: only the verdict of the frame says whether it was requested.
        let stray = || {
            describe::stray(protocol, bytes)
                .trim_start_matches("foreign: ")
                .to_string()
        };
        if frame.verdict == Verdict::Sent {
            self.asked = request(protocol, bytes).map(|request| (request, bytes));
            let said = |(request, _): &(Request, _)| describe::request_on(protocol, &request.pdu);
            return self.asked.as_ref().map_or_else(stray, said);
        }
        match &self.asked {
            Some((asked, sent)) if frame.verdict != Verdict::Foreign => {
                let answered = matches!(frame.verdict, Verdict::Ok | Verdict::Exception);
                let parts = describe::parts(protocol, asked, sent, bytes, answered);
                let own = parts.into_iter().rfind(|part| part.kind == Kind::Reply);
                let own = own.and_then(|part| bytes.get(part.range)).unwrap_or(bytes);
                describe::reply(protocol, asked, own)
            }
            _ => stray(),
        }
    }
}

/// The request in a frame of the gateway.
fn request(protocol: Protocol, frame: &[u8]) -> Option<Request> {
    if protocol == Protocol::N2 {
        let (address, command) = Command::decode(frame)?;
        return Some(Request::new(address, n2::pdu_of(&command.ok()?)?));
    }
    let (address, pdu) = protocol.open_frame(frame)?;
    Some(Request::new(address, RequestPdu::decode(&pdu).ok()?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_proto::RequestPdu::Read;
    use drivegate_proto::Table;

    fn frame(verdict: Verdict, bytes: &[u8]) -> Frame {
        Frame {
            t: 0.0,
            drive: Some(0),
            verdict,
            bytes: bytes.into(),
        }
    }

    fn said(protocol: Protocol, frames: &[Frame]) -> Vec<String> {
        let mut decoder = Decoder::new(protocol.name());
        frames.iter().map(|frame| decoder.next(frame)).collect()
    }

    #[test]
    fn frames_are_said_as_the_trace_says_them() {
        let (table, start, count) = (Table::Holding, 2100, 1);
        let asked = Request::new(1, Read { table, start, count });
        for protocol in [Protocol::ModbusRtu, Protocol::ModbusAscii] {
            let (mut sent, mut reply, mut refusal) = (Vec::new(), Vec::new(), Vec::new());
            protocol.encode(&asked, &mut sent);
            protocol.encode_frame(1, &[3, 2, 0x12, 0x34], &mut reply);
            protocol.encode_frame(1, &[0x83, 2], &mut refusal);
            let frames = [
                frame(Verdict::Ok, &reply),
                frame(Verdict::Sent, &sent),
                frame(Verdict::Ok, &reply),
                frame(Verdict::Sent, &sent),
                frame(Verdict::Timeout, &[]),
                // An adapter that sends the request back.
                frame(Verdict::Exception, &[&sent[..], &refusal].concat()),
                frame(Verdict::Foreign, &reply),
            ];
            assert_eq!(
                said(protocol, &frames),
                [
                    "address 1, function 3, 1 register",
                    "read holding 2100",
                    "1 register: 1234",
                    "read holding 2100",
                    "",
                    "exception 02 (illegal data address)",
                    "address 1, function 3, 1 register"
                ]
            );
        }
    }

    #[test]
    fn commands_of_n2_are_said_too() {
        let object = Read {
            table: Table::Input,
            start: 0,
            count: 2,
        };
        let mut sent = Vec::new();
        Protocol::N2.encode(&Request::new(3, object), &mut sent);
        assert_eq!(said(Protocol::N2, &[frame(Verdict::Sent, &sent)]), ["read AI 1 value"]);
    }
}
