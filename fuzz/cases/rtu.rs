//! RTU frames, from both ends: what a drive may answer to a request, and what a slave may hear.
//!
//! Input: length and bytes of a request PDU, then what comes from the line. The last bit of the length has the check
//! code of the frame put right, or the fuzzer would hardly get past it.

use drivegate::codec::rtu::{
    LONGEST, decode_reply, decode_request, encode_frame, encode_request, open_frame, request_len,
};
use drivegate::codec::{Decoded, Request, RequestPdu};

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
                // A frame is the same whatever follows it.
                assert_eq!(decode_reply(&request, &line[..used]), decode_reply(&request, line));
            }
            Decoded::Incomplete => assert!(line.len() < LONGEST, "nothing is that long"),
            _ => {}
        }
    }
}
