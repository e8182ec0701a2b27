//! N2 frames in both directions: answers that a drive may send to a request, and frames that a board may receive.
//!
//! Input: the request, options, then the bytes from the line. The last bit of the options corrects the checksum of
//! the line, since the fuzzer would hardly find it by chance.

use drivegate_proto::n2::{Command, RegionWidth, Session, command::checksum, decode_reply, encode_request, reply_chars};
use drivegate_proto::{Decoded, Reply, Request, RequestPdu, Table};

fn asked(kind: u8, start: u16) -> RequestPdu {
    let read = |table, count| RequestPdu::Read { table, start, count };
    match kind % 9 {
        0 => read(Table::Coil, 1),
        1 => read(Table::DiscreteInput, 1),
        2 => read(Table::Input, 2),
        3 => read(Table::Input, 1),
        4 => read(Table::Holding, 2),
        5 => RequestPdu::WriteCoil { address: start, on: true },
        6 => RequestPdu::WriteRegisters { start, values: vec![0x4248, start] },
        7 => RequestPdu::N2(Session::Identify),
        _ => RequestPdu::N2(Session::Poll { again: true }),
    }
}

pub(crate) fn run(data: &[u8]) {
    let [kind, options, high, low, line @ ..] = data else { return };
    let mut request = Request::new(1, asked(*kind, u16::from_be_bytes([*high, *low])));
    request.n2.state_bit = options >> 1 & 7;
    request.n2.unreliable_bit = (options & 0x80 != 0).then_some(7);
    if options & 0x10 != 0 {
        request.n2.region_width = RegionWidth::One;
    }
    let mut sealed = line.to_vec();
    if options & 1 == 1 {
        let text = line.split_first().map_or(line, |(_, text)| text);
        sealed.extend(format!("{:02X}\r", checksum(text)).into_bytes());
    }
    if let Some((address, Ok(command))) = Command::decode(&sealed)
        && command != Command::Other
        && command != Command::SyncTime
        && command != Command::ReadMemory
    {
        let mut again = Vec::new();
        command.encode(address, request.n2.region_width, &mut again);
        assert_eq!(Command::decode(&again), Some((address, Ok(command))));
    }
    match decode_reply(&request, &sealed) {
        Decoded::Reply { used, reply } => {
            assert!((2..=sealed.len()).contains(&used));
            // A frame is decoded alike whatever follows it.
            assert_eq!(
                decode_reply(&request, &sealed[..used]),
                Decoded::Reply { used, reply: reply.clone() }
            );
            let words = reply.words().map_or(0, |words| words.len());
            match &request.pdu {
                RequestPdu::Read { count, .. } => {
                    assert!(words == usize::from(*count) || matches!(reply, Reply::Exception(_)));
                }
                _ => assert_eq!(words, 0),
            }
            let _ = reply_chars(&request.pdu);
        }
        Decoded::Foreign { used } => assert!((1..=sealed.len()).contains(&used)),
        Decoded::Incomplete => assert!(sealed.len() <= 2 * 256, "nothing is that long"),
        Decoded::Corrupt(_) => {}
    }
    let mut frame = Vec::new();
    encode_request(&request, &mut frame);
    // The echo of a request is not an answer.
    if !frame.is_empty() {
        assert_eq!(decode_reply(&request, &frame), Decoded::Foreign { used: frame.len() });
    }
}
