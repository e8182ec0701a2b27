use proptest::prelude::*;

use super::*;

/// Frames that are nearly right.
fn nearly() -> impl Strategy<Value = Vec<u8>> {
    let service = prop_oneof![
        Just(5u8),
        Just(12),
        Just(14),
        Just(15),
        Just(16),
        Just(17),
        Just(28),
        any::<u8>()
    ];
    let content = prop_oneof![
        prop::collection::vec(any::<u8>(), 0..80),
        Just(read(SPEED, PV)),
        Just(write(RUN, Some(8), |w| {
            w.enumerated(1);
        })),
        Just(written(|w| {
            w.context_object(0, SPEED).open(1).context_unsigned(0, 8).close(1);
        })),
    ];
    (any::<u8>(), service, content, any::<u8>(), any::<bool>(), any::<u16>()).prop_map(
        |(invoke, service, mut content, noise, mangled, at)| {
            if mangled && !content.is_empty() {
                let at = usize::from(at) % content.len();
                content[at] = noise;
            }
            let apdu = [&[0x02, 0x05, invoke, service][..], &content].concat();
            let to = Some((NETWORK, Mac::new(&[1]).unwrap()));
            bvlc::unicast(&npdu::encode(to, None, true, Payload::Application(&apdu)))
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn nothing_panics_and_what_comes_out_is_sound(frames in prop::collection::vec(
        prop_oneof![nearly(), prop::collection::vec(any::<u8>(), 0..60)], 1..60)) {
        let mut bench = Bench::of(2, 3);
        for frame in frames {
            bench.datagram(5, &frame);
            while let Some(job) = bench.server.take_job() {
                bench.server.written(job.token, Ok(()), &bench.plant, bench.now);
            }
            for (_, bytes) in std::iter::from_fn(|| bench.server.transmit()) {
                prop_assert!(bvlc::decode(&bytes).is_some());
                prop_assert!(bytes.len() <= 1497);
            }
        }
        bench.later(Duration::from_secs(1));
    }
}
