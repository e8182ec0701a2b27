//! Replies that were changed, cut or repeated by faults: only the true reply is accepted.

use super::ascii::{in_ascii, start_ascii};
use super::*;
use proptest::prelude::*;

/// A reply that a fault has changed on the line.
fn mutated() -> impl Strategy<Value = Vec<u8>> {
    let truth = reply(0x4711);
    let len = truth.len();
    let other = |address: u8, pdu: Vec<u8>| {
        let mut frame = Vec::new();
        rtu::encode_frame(address, &pdu, &mut frame);
        frame
    };
    let (cut, flipped, whole) = (truth.clone(), truth.clone(), truth.clone());
    prop_oneof![
        Just(whole),
        (0..len).prop_map(move |keep| cut[..keep].to_vec()),
        (0..len * 8).prop_map(move |bit| {
            let mut frame = flipped.clone();
            frame[bit / 8] ^= 1 << (bit % 8);
            frame
        }),
        proptest::collection::vec(any::<u8>(), 0..6),
        (any::<u8>(), any::<u16>()).prop_filter_map("the drive's own", move |(address, value)| {
            let [high, low] = value.to_be_bytes();
            (address != 1).then(|| other(address, vec![3, 2, high, low]))
        }),
        any::<u32>().prop_map(move |value| {
            let mut pdu = vec![3, 4];
            pdu.extend(value.to_be_bytes());
            other(1, pdu)
        }),
        any::<u16>().prop_map(move |value| {
            let [high, low] = value.to_be_bytes();
            other(1, vec![4, 2, high, low])
        }),
    ]
}

/// How the transaction ends if the bytes arrive in pieces of `chunk` bytes, `gap_us` apart.
fn fed(
    mut transaction: Transaction,
    begun: Instant,
    deadline: Instant,
    bytes: &[u8],
    (chunk, gap_us): (usize, u64),
) -> Result<Ended, TestCaseError> {
    let mut now = begun;
    let mut step = transaction.on_time(now);
    for piece in bytes.chunks(chunk) {
        now += Duration::from_micros(gap_us);
        let Step::Wait(until) = step else { break };
        prop_assert!(until <= deadline);
        step = if now >= until {
            transaction.on_time(until)
        } else {
            transaction.on_bytes(now, piece)
        };
    }
    if let Step::Wait(until) = step {
        prop_assert!(until <= deadline);
        step = transaction.on_time(until);
    }
    match step {
        Step::Done(ended) => Ok(ended),
        _ => Err(TestCaseError::fail("it waits beyond what it said")),
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn only_the_truth_is_believed_and_the_deadline_holds(
        pieces in proptest::collection::vec(mutated(), 0..5),
        chunk in 1usize..20,
        gap_us in 0u64..8000,
    ) {
        let (request, frame) = request();
        let begun = Instant::now();
        let deadline = begun + Duration::from_millis(105);
        let transaction = start(&request, &frame, begun);
        let ended = fed(transaction, begun, deadline, &pieces.concat(), (chunk, gap_us))?;
        match ended {
            Ended::Reply(reply) => prop_assert_eq!(reply, Reply::Registers(vec![0x4711])),
            Ended::Silent | Ended::Corrupt(_) => {}
        }
    }

    #[test]
    fn only_the_truth_is_believed_in_ascii_too(
        pieces in proptest::collection::vec(prop_oneof![
            Just(b":01030400050000F3\r\n".to_vec()),
            (0usize..19).prop_map(|keep| b":01030400050000F3\r\n"[..keep].to_vec()),
            (0usize..19, any::<u8>()).prop_map(|(at, character)| {
                let mut frame = b":01030400050000F3\r\n".to_vec();
                frame[at] = character;
                frame
            }),
            (2u8..=247, any::<[u8; 4]>()).prop_map(|(address, [a, b, c, d])| {
                let mut frame = Vec::new();
                drivegate_proto::ascii::encode_frame(address, &[3, 4, a, b, c, d], &mut frame);
                frame
            }),
            proptest::collection::vec(any::<u8>(), 0..6),
            proptest::collection::vec(
                prop_oneof![Just(b':'), Just(b'\n'), Just(b'\r'), b'0'..=b'9', any::<u8>()], 0..30),
        ], 0..6),
        chunk in 1usize..20,
        gap_us in 0u64..8000,
    ) {
        let (request, frame, _) = in_ascii();
        let begun = Instant::now();
        let deadline = begun + Duration::from_millis(119);
        let transaction = start_ascii(&request, &frame, begun, false);
        let ended = fed(transaction, begun, deadline, &pieces.concat(), (chunk, gap_us))?;
        match ended {
            Ended::Reply(reply) => prop_assert_eq!(reply, Reply::Registers(vec![5, 0])),
            Ended::Silent | Ended::Corrupt(_) => {}
        }
    }

    #[test]
    fn a_true_reply_in_time_behind_foreign_frames_is_found(
        strangers in proptest::collection::vec((2u8..=247, any::<u16>()), 0..4),
        noise in proptest::collection::vec(any::<u8>(), 0..4),
        chunk in 1usize..20,
    ) {
        let (request, frame) = request();
        let now = Instant::now();
        let mut bytes = Vec::new();
        let strange = strangers.len() as u32;
        for (address, value) in strangers {
            let [high, low] = value.to_be_bytes();
            rtu::encode_frame(address, &[3, 2, high, low], &mut bytes);
        }
        bytes.extend(noise);
        bytes.extend(reply(0x4711));
        let mut transaction = start(&request, &frame, now);
        let mut step = transaction.on_time(now);
        for piece in bytes.chunks(chunk) {
            if matches!(step, Step::Done(_)) {
                break;
            }
            step = transaction.on_bytes(now, piece);
        }
        // In about one of ten thousand cases, noise and the first bytes of the reply form a valid frame of another address.
        prop_assert!(step == done(0x4711) || transaction.foreign() > strange, "{:?}", step);
    }
}
