use super::*;

const WHO_IS: [u8; 2] = [0x10, 8];

fn who_is(to: Option<(u16, Mac)>, from: Option<(u16, Mac)>, range: Option<(u64, u64)>) -> Vec<u8> {
    let mut apdu = WHO_IS.to_vec();
    if let Some((low, high)) = range {
        apdu.extend(written(|w| {
            w.context_unsigned(0, low).context_unsigned(1, high);
        }));
    }
    npdu::encode(to, from, false, Payload::Application(&apdu))
}

/// Instances of the devices that announce themselves, with where and how.
fn present(out: &[Out]) -> Vec<(u32, To, Option<u8>)> {
    out.iter()
        .filter(|(.., apdu)| apdu.starts_with(&[0x10, 0]))
        .map(|(to, _, station, apdu)| match Reader::new(&apdu[2..]).data() {
            Ok(Some(Data::Object(id))) => (id.instance, *to, *station),
            other => panic!("{other:?}"),
        })
        .collect()
}

#[test]
fn who_is_concerns_those_that_it_is_for() {
    let mut rig = ServerWithClients::new();
    let all = Some((npdu::GLOBAL, Mac::ALL));
    let network = Some((NETWORK, Mac::ALL));
    type Case<'c> = (Option<(u16, Mac)>, Option<(u64, u64)>, &'c [u32]);
    let cases: [Case<'_>; 7] = [
        (None, None, &[100]),
        (all, None, &[100, 101, 102, 103]),
        (network, None, &[101, 102, 103]),
        (all, Some((102, 103)), &[102, 103]),
        (Some((NETWORK, Mac::new(&[2]).unwrap())), None, &[102]),
        (Some((NETWORK, Mac::new(&[9]).unwrap())), None, &[]),
        (network, Some((0, 4_194_303)), &[101, 102, 103]),
    ];
    for (to, range, wanted) in cases {
        rig.datagram(5, &bvlc::broadcast(&who_is(to, None, range)));
        let heard = present(&rig.out());
        assert_eq!(
            heard.iter().map(|(instance, ..)| *instance).collect::<Vec<_>>(),
            wanted,
            "{to:?} {range:?}"
        );
        assert!(heard.iter().all(|(instance, to, station)| *to == To::Broadcast
            && station.map_or(100, |unit| 100 + u32::from(unit)) == *instance));
        rig.later(Duration::from_secs(1));
    }
    rig.plant.silent.borrow_mut().insert(102);
    rig.datagram(5, &bvlc::unicast(&who_is(all, None, None)));
    let heard = present(&rig.out());
    assert_eq!(heard.len(), 3, "one that is away says nothing");
    assert!(
        heard
            .iter()
            .all(|(_, to, _)| *to == To::Host(ServerWithClients::client(5))),
        "to the asker"
    );
}

#[test]
fn a_question_from_behind_a_router_is_answered_there() {
    let mut rig = ServerWithClients::new();
    let from = Some((7, Mac::new(&[0x0A]).unwrap()));
    rig.datagram(
        5,
        &bvlc::unicast(&who_is(Some((NETWORK, Mac::ALL)), from, Some((101, 101)))),
    );
    let (to, remote, station, _) = rig.out().remove(0);
    assert_eq!((to, station), (To::Host(ServerWithClients::client(5)), Some(1)));
    assert_eq!(remote, Some((7, Mac::new(&[0x0A]).unwrap(), 255)));
    rig.datagram(
        5,
        &bvlc::broadcast(&who_is(Some((npdu::GLOBAL, Mac::ALL)), from, Some((101, 101)))),
    );
    let (to, remote, ..) = rig.out().remove(0);
    assert_eq!((to, remote), (To::Broadcast, Some((7, Mac::ALL, 255))));
    // A source network equal to the virtual network is forged and gets no answer.
    let forged = Some((NETWORK, Mac::new(&[1]).unwrap()));
    rig.datagram(5, &bvlc::unicast(&who_is(None, forged, None)));
    assert!(rig.out().is_empty());
}

#[test]
fn routers_ask_and_are_refused_other_networks() {
    let mut rig = ServerWithClients::new();
    let message =
        |kind: u8, content: &[u8]| bvlc::unicast(&npdu::encode(None, None, false, Payload::Network(kind, content)));
    for asked in [&[][..], &NETWORK.to_be_bytes()] {
        rig.datagram(5, &message(0, asked));
        assert_eq!(rig.out()[0].3, [0xFF, 1, 3, 0xE9]);
    }
    rig.datagram(5, &message(0, &[0, 9]));
    assert!(rig.out().is_empty());
    rig.datagram(5, &message(6, &[0]));
    assert_eq!(rig.out()[0].3, [0xFF, 7, 1, 3, 0xE9, 1, 0]);
    let to_other = npdu::encode(Some((77, Mac::ALL)), None, true, Payload::Application(&WHO_IS));
    rig.datagram(5, &bvlc::unicast(&to_other));
    assert_eq!(rig.out()[0].3, [0xFF, 3, 1, 0, 77]);
    rig.datagram(5, &bvlc::broadcast(&to_other));
    assert!(rig.out().is_empty(), "a broadcast is not refused");
    let mut tired = who_is(Some((NETWORK, Mac::ALL)), None, None);
    let hops = tired.iter().rposition(|octet| *octet == 255).unwrap();
    tired[hops] = 0;
    rig.datagram(5, &bvlc::unicast(&tired));
    assert!(rig.out().is_empty(), "the hops end at 0");
}

#[test]
fn who_has_by_number_and_by_name() {
    let mut rig = ServerWithClients::new();
    let sought = |write: &dyn Fn(&mut Writer)| {
        let apdu = [vec![0x10, 7], written(|w| write(w))].concat();
        bvlc::unicast(&npdu::encode(
            Some((NETWORK, Mac::ALL)),
            None,
            false,
            Payload::Application(&apdu),
        ))
    };
    rig.datagram(
        5,
        &sought(&|w| {
            w.context_object(2, RUN);
        }),
    );
    assert_eq!(rig.out().len(), 3);
    let name = |text: &'static str| {
        sought(&move |w| {
            w.context_octets(3, &[&[0], text.as_bytes()].concat());
        })
    };
    rig.datagram(5, &name("speed"));
    let out = rig.out();
    assert!(
        out.len() == 3
            && out
                .iter()
                .all(|(.., apdu)| apdu.starts_with(&[0x10, 1]) && apdu.ends_with(b"speed"))
    );
    rig.datagram(5, &name("device-102"));
    assert_eq!(rig.out().len(), 1);
    rig.datagram(5, &name("nothing"));
    assert!(rig.out().is_empty());
}

#[test]
fn bbmd_requests_are_refused_and_those_not_allowed_hear_nothing() {
    let mut rig = ServerWithClients::new();
    for (request, code) in [
        (bvlc::register(60), 0x30),
        (vec![0x81, 2, 0, 4], 0x20),
        (vec![0x81, 1, 0, 4], 0x10),
    ] {
        rig.datagram(5, &request);
        assert_eq!(rig.server.transmit().unwrap().1, bvlc::result(code));
    }
    // A broadcast of the server that it receives itself is not counted as received.
    let before = rig.server.counters();
    let own = rig.server.options.address;
    rig.server.receive(own, &bvlc::broadcast(&[1, 0]), &rig.plant, rig.now);
    assert_eq!(rig.server.counters(), before);
    let stranger = "192.0.2.9:47808".parse().unwrap();
    let all = who_is(Some((npdu::GLOBAL, Mac::ALL)), None, None);
    let mut forwarded = vec![0x81, 4];
    forwarded.extend(u16::try_from(all.len() + 10).unwrap().to_be_bytes());
    let heard = |rig: &mut ServerWithClients, from: SocketAddrV4, origin: [u8; 4]| {
        let datagram = [&forwarded[..], &origin, &[0xBA, 0xC0], &all].concat();
        rig.server.receive(from, &datagram, &rig.plant, rig.now);
        let heard = rig.out().len();
        rig.later(Duration::from_secs(1));
        heard
    };
    rig.server.receive(stranger, &bvlc::unicast(&all), &rig.plant, rig.now);
    rig.server.receive(stranger, &bvlc::register(1), &rig.plant, rig.now);
    assert!(rig.out().is_empty());
    assert_eq!(
        heard(&mut rig, ServerWithClients::client(5), [10, 9, 9, 9]),
        4,
        "a BBMD of this subnet"
    );
    assert_eq!(
        heard(&mut rig, ServerWithClients::client(5), [192, 0, 2, 1]),
        0,
        "the originator is not allowed"
    );
    let far = "10.9.0.1:47808".parse().unwrap();
    assert_eq!(heard(&mut rig, far, [10, 9, 9, 9]), 0, "of another subnet");
    rig.server.set_bbmd(Some(far), rig.now);
    rig.later(Duration::from_millis(100));
    assert_eq!(rig.server.transmit(), Some((To::Host(far), bvlc::register(60))));
    rig.server.receive(far, &bvlc::result(0), &rig.plant, rig.now);
    assert_eq!(rig.server.registration(), Registration::Registered);
    assert_eq!(rig.server.registration(), Registration::Registered);
    let datagram = [&forwarded[..], &[10, 9, 9, 9], &[0xBA, 0xC0], &all].concat();
    rig.server.receive(far, &datagram, &rig.plant, rig.now);
    let out: Vec<(To, Vec<u8>)> = std::iter::from_fn(|| rig.server.transmit()).collect();
    let to_bbmd = out
        .iter()
        .filter(|(to, bytes)| *to == To::Host(far) && bytes[1] == 9)
        .count();
    assert_eq!(
        (out.len(), to_bbmd),
        (8, 4),
        "answers are broadcast here and by the BBMD"
    );
}

/// The router to the virtual network uses up the last hop of a message.
#[test]
fn a_message_with_one_hop_left_is_not_delivered_further() {
    let mut rig = ServerWithClients::new();
    for (to, hops, wanted) in [
        (npdu::GLOBAL, 2, &[100, 101, 102, 103][..]),
        (npdu::GLOBAL, 1, &[100]),
        (npdu::GLOBAL, 0, &[]),
        (NETWORK, 2, &[101, 102, 103]),
        (NETWORK, 1, &[]),
    ] {
        let mut bytes = who_is(Some((to, Mac::ALL)), None, None);
        // The hop count is directly before the APDU.
        let place = bytes.len() - WHO_IS.len() - 1;
        bytes[place] = hops;
        rig.datagram(5, &bvlc::broadcast(&bytes));
        let heard: Vec<u32> = present(&rig.out()).into_iter().map(|(instance, ..)| instance).collect();
        assert_eq!(heard, wanted, "{to} {hops}");
        rig.later(Duration::from_secs(1));
    }
}

#[test]
fn messages_between_routers_that_are_not_known_are_rejected() {
    let mut rig = ServerWithClients::new();
    for kind in [0x80, 0xFF, 0x14] {
        let message = npdu::encode(None, None, false, Payload::Network(kind, &[0, 0]));
        rig.datagram(5, &bvlc::unicast(&message));
        let out: Vec<Vec<u8>> = rig.out().into_iter().map(|(.., content)| content).collect();
        assert_eq!(out, [vec![0xFF, npdu::message::REJECT, 3, 0, 0]], "{kind:#x}");
        rig.datagram(5, &bvlc::broadcast(&message));
        assert!(rig.out().is_empty(), "none by broadcast");
    }
}

/// The datagrams that the server sends, each with its destination.
fn raw(rig: &mut ServerWithClients) -> Vec<(To, Vec<u8>)> {
    std::iter::from_fn(|| rig.server.transmit()).collect()
}

#[test]
fn foreign_devices_have_what_is_broadcast_on_both_sides() {
    let mut rig = ServerWithClients::new();
    rig.server.options.foreign_devices = 2;
    rig.server.foreign_devices = ForeignDevices::new(2);
    let host = ServerWithClients::client;
    let result = |code: u16| bvlc::result(code);
    let npdu = who_is(Some((npdu::GLOBAL, Mac::ALL)), None, Some((102, 102)));
    // Only a registered foreign device has its messages broadcast.
    rig.datagram(7, &bvlc::distribute(&npdu));
    assert_eq!(raw(&mut rig), [(To::Host(host(7)), result(0x60))]);
    for (who, code) in [(7, 0), (8, 0), (9, 0x30)] {
        rig.datagram(who, &bvlc::register(60));
        assert_eq!(raw(&mut rig), [(To::Host(host(who)), result(code))], "{who}");
    }
    // A broadcast by a host of this network reaches the foreign devices, and so does the answer.
    rig.datagram(5, &bvlc::broadcast(&npdu));
    let out = raw(&mut rig);
    for foreign in [7, 8] {
        let came = bvlc::forwarded(host(5), &npdu);
        assert!(out.contains(&(To::Host(host(foreign)), came)), "{out:?}");
        let answers = out
            .iter()
            .filter(|(to, bytes)| *to == To::Host(host(foreign)) && bytes.ends_with(&[0x91, 1, 0x21, 0]));
        assert_eq!(answers.count(), 1, "{out:?}");
    }
    // A message of a foreign device reaches this network and the other foreign devices.
    rig.later(Duration::from_secs(1));
    rig.datagram(7, &bvlc::distribute(&npdu));
    let out = raw(&mut rig);
    let came = bvlc::forwarded(host(7), &npdu);
    assert!(out.contains(&(To::Broadcast, came.clone())) && out.contains(&(To::Host(host(8)), came.clone())));
    assert!(!out.contains(&(To::Host(host(7)), came)), "not to itself");
    rig.datagram(5, &[0x81, 6, 0, 4]);
    let [(To::Host(_), table)] = &raw(&mut rig)[..] else {
        panic!()
    };
    assert_eq!((table[1], table.len()), (7, 4 + 2 * 10));
    let deletion = [
        &[0x81, 8, 0, 10, 10][..],
        &host(8).ip().octets()[1..],
        &host(8).port().to_be_bytes(),
    ]
    .concat();
    for code in [0, 0x50] {
        rig.datagram(5, &deletion);
        assert_eq!(raw(&mut rig), [(To::Host(host(5)), result(code))]);
    }
}
