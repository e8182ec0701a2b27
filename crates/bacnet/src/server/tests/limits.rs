use super::*;

#[test]
fn a_flood_of_who_is_is_answered_within_bounds() {
    let mut rig = ServerWithClients::of(250, 0);
    let all = npdu::encode(
        Some((npdu::GLOBAL, Mac::ALL)),
        None,
        false,
        Payload::Application(&[0x10, 8]),
    );
    let mut left = 0;
    for _ in 0..100 {
        for _ in 0..100 {
            rig.datagram(5, &bvlc::broadcast(&all));
        }
        rig.later(Duration::from_millis(100));
        left += rig.out().len();
    }
    assert!((900..=1200).contains(&left), "{left} broadcasts in 10 s");
    let asked = bvlc::unicast(&all);
    let (mut came, mut left) = (0, 0);
    for _ in 0..1000 {
        came += asked.len();
        rig.datagram(6, &asked);
        left += std::iter::from_fn(|| rig.server.transmit())
            .map(|(_, bytes)| bytes.len())
            .sum::<usize>();
    }
    assert!(left <= 8 * came + 16 * 1024, "{left} for {came}");
}

#[test]
fn a_long_answer_is_not_bought_with_a_short_question() {
    let mut rig = ServerWithClients::of(1, 60);
    let own = ObjectId::new(ObjectType::DEVICE, 101);
    let asked = written(|w| {
        w.context_object(0, own)
            .open(1)
            .context_property(0, PropertyId::ALL)
            .close(1);
    });
    let mut left = 0;
    for n in 0..1000 {
        rig.ask(5, Some(1), n as u8, c::READ_PROPERTY_MULTIPLE, &asked)
            .iter()
            .for_each(|apdu| left += apdu.len());
    }
    assert!(left <= 8 * 1000 * 40 + 16 * 1024, "{left}");
}
