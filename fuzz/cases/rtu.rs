//! RTU frames in both directions: answers that a drive may send to a request, and frames that a slave may receive.
//!
//! Input: length and bytes of a request PDU, then the bytes from the line. The last bit of the length corrects the
//! check code of the frame, since the fuzzer would hardly find it by chance.

use drivegate_proto::rtu::{
    LONGEST, decode_reply, decode_request, encode_frame, encode_request, open_frame, request_len,
};
use drivegate_proto::{Decoded, Request, RequestPdu};

pub(crate) fn run(data: &[u8]) {
    let Some((head, rest)) = data.split_first() else { return };
    let (pdu, line) = rest.split_at(usize::from(head >> 1).min(rest.len()));
    let mut framed = Vec::new();
    let line = match line.split_first() {
        Some((address, pdu)) if head & 1 == 1 => {
            encode_frame(*address, pdu, &mut framed);
            framed.as_slice()
        }
        _ => line,
    };
    if let Some(length) = request_len(line) {
        assert!(length >= 4, "no frame is shorter than {length}");
    }
    if let Some((address, Ok(request))) = decode_request(line) {
        let mut again = Vec::new();
        let request = Request::new(address, request);
        encode_request(&request, &mut again);
        assert_eq!(decode_request(&again), Some((address, Ok(request.pdu))));
        assert!(open_frame(line).is_some());
    }
    if let Ok(pdu) = RequestPdu::decode(pdu) {
        let request = Request::new(1, pdu);
        match decode_reply(&request, line) {
            Decoded::Reply { used, .. } | Decoded::Foreign { used } => {
                assert!((4..=line.len()).contains(&used));
                // A frame is decoded alike whatever follows it.
                assert_eq!(decode_reply(&request, &line[..used]), decode_reply(&request, line));
            }
            Decoded::Incomplete => assert!(line.len() < LONGEST, "nothing is that long"),
            _ => {}
        }
    }
}
