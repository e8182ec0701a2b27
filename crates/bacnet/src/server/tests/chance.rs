use proptest::prelude::*;

use super::*;

/// Frames that are almost valid.
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
        let mut rig = ServerWithClients::of(2, 3);
        for frame in frames {
            rig.datagram(5, &frame);
            while let Some(job) = rig.server.take_job() {
                rig.server.written(job.token, Ok(()), &rig.plant, rig.now);
            }
            for (_, bytes) in std::iter::from_fn(|| rig.server.transmit()) {
                prop_assert!(bvlc::decode(&bytes).is_some());
                prop_assert!(bytes.len() <= 1497);
            }
        }
        rig.later(Duration::from_secs(1));
    }
}

/// Pseudo-random numbers. Each run of the test gets the same numbers.
struct Dice(u64);

impl Dice {
    fn below(&mut self, end: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 % end.max(1) as u64) as usize
    }

    /// A copy of one of the frames with a few octets changed, removed or added.
    fn mangled(&mut self, frames: &[Vec<u8>]) -> Vec<u8> {
        let mut frame = frames[self.below(frames.len())].clone();
        for _ in 0..self.below(4) {
            let at = self.below(frame.len());
            match self.below(4) {
                0 => frame.truncate(at),
                1 => frame.insert(at.min(frame.len()), self.below(256) as u8),
                2 if !frame.is_empty() => frame[at] ^= 1 << self.below(8),
                _ if !frame.is_empty() => frame[at] = self.below(256) as u8,
                _ => {}
            }
        }
        // The length in the header is usually correct, so that the rest is parsed.
        if frame.len() >= 4 && self.below(8) > 0 {
            let length = (frame.len() as u16).to_be_bytes();
            frame[2..4].copy_from_slice(&length);
        }
        frame
    }
}

/// Requests of every kind, to the gateway and to a drive.
fn requests() -> Vec<Vec<u8>> {
    let subscribe = |confirmed: bool| {
        written(|w| {
            w.context_unsigned(0, 7).context_object(1, SPEED);
            w.context_bool(2, confirmed).context_unsigned(3, 60);
        })
    };
    let property = written(|w| {
        w.raw(&subscribe(true)).open(4).context_unsigned(0, PV.into()).close(4);
        w.context_real(5, 1.0);
    });
    let all = written(|w| {
        w.context_object(0, RUN).open(1).context_unsigned(0, 8).close(1);
        w.context_object(0, SPEED).open(1).context_unsigned(0, 77).close(1);
    });
    let several = written(|w| {
        w.context_object(0, RUN).open(1).context_unsigned(0, PV.into()).open(2);
        w.enumerated(1).close(2).context_unsigned(3, 8).close(1);
    });
    let confirmed: [(u8, Vec<u8>); 8] = [
        (c::READ_PROPERTY, read(RUN, 87)),
        (c::READ_PROPERTY_MULTIPLE, all),
        (
            c::WRITE_PROPERTY,
            write(REFERENCE, Some(8), |w| {
                w.real(1.0);
            }),
        ),
        (
            c::WRITE_PROPERTY,
            write(RUN, Some(8), |w| {
                w.null();
            }),
        ),
        (c::WRITE_PROPERTY_MULTIPLE, several),
        (c::SUBSCRIBE_COV, subscribe(false)),
        (c::SUBSCRIBE_COV_PROPERTY, property),
        (
            c::DEVICE_COMMUNICATION_CONTROL,
            vec![0x09, 1, 0x19, 0, 0x2D, 7, 0, b's', b'e', b'c', b'r', b'e', b't'],
        ),
    ];
    let mut apdus: Vec<Vec<u8>> = (0..)
        .zip(confirmed)
        .map(|(invoke, (service, content))| [&[0x02, 0x75, invoke, service][..], &content].concat())
        .collect();
    apdus.extend([
        vec![0x10, 8],
        vec![0x10, 8, 0x09, 1, 0x1A, 1, 0],
        vec![0x10, 7, 0x3D, 4, 0, b'r', b'u', b'n'],
        apdu::simple_ack(1, 1),
        vec![0x40, 1, 0, 4],
        vec![0x71, 1, 0],
    ]);
    let drive = Some((NETWORK, Mac::new(&[1]).unwrap()));
    let behind = Some((7, Mac::new(&[9]).unwrap()));
    let ways = [
        (None, None),
        (drive, None),
        (drive, behind),
        (Some((npdu::GLOBAL, Mac::ALL)), behind),
    ];
    let mut frames = vec![
        bvlc::unicast(&[1, 0x80, 0]),
        bvlc::unicast(&[1, 0x80, 6, 0]),
        bvlc::register(60),
        bvlc::result(0x30),
        vec![0x81, 4, 0, 12, 10, 0, 0, 9, 0xBA, 0xC0, 1, 0],
    ];
    for apdu in &apdus {
        for (to, from) in ways {
            let npdu = npdu::encode(to, from, true, Payload::Application(apdu));
            frames.push(bvlc::unicast(&npdu));
            if apdu[0] == 0x10 {
                frames.push(bvlc::broadcast(&npdu));
            }
        }
    }
    frames
}

/// `FRAMES=10000000 cargo test --profile world -p drivegate-bacnet --lib frames_by_chance`
#[test]
fn frames_by_chance_harm_nothing() {
    let count: u64 = std::env::var("FRAMES").map_or(30_000, |text| text.parse().unwrap());
    let (frames, mut dice) = (requests(), Dice(0x9E37_79B9_7F4A_7C15));
    let mut rig = ServerWithClients::of(2, 3);
    let (mut came, mut left) = (0, 0);
    for number in 0..count {
        let frame = dice.mangled(&frames);
        came += frame.len();
        rig.datagram(2 + dice.below(4) as u8, &frame);
        while let Some(job) = rig.server.take_job() {
            let result = [Ok(()), Err(Error::TIMEOUT)][dice.below(2)];
            rig.server.written(job.token, result, &rig.plant, rig.now);
        }
        while let Some((to, bytes)) = rig.server.transmit() {
            assert!(bvlc::decode(&bytes).is_some() && bytes.len() <= 1497, "{frame:?}");
            left += if to == To::Broadcast { 0 } else { bytes.len() };
        }
        if number % 50 == 0 {
            rig.shows(101, 0, Datum::Number(number as f64));
            rig.later(Duration::from_millis(100));
        }
    }
    let counters = rig.server.counters();
    assert!(
        counters.done > count / 50 && counters.refused > count / 50,
        "{counters:?}"
    );
    println!("{count} frames, {came} octets came and {left} left: {counters:?}");
}
