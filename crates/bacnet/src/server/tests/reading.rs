use super::*;

#[test]
fn properties_of_values_and_their_quality() {
    let mut rig = ServerWithClients::new();
    let at = |rig: &mut ServerWithClients, object: ObjectId, property: u32| {
        let answer = rig
            .ask(5, Some(1), 1, c::READ_PROPERTY, &read(object, property))
            .remove(0);
        assert_eq!(answer[..3], [0x30, 1, 12], "{object} {property}");
        value(&answer)
    };
    assert_eq!(at(&mut rig, SPEED, PV), Some(Data::Real(0.0)), "never read");
    assert_eq!(
        at(&mut rig, SPEED, 103),
        Some(Data::Enumerated(12)),
        "communication-failure"
    );
    rig.shows(101, 0, Datum::Number(33.3));
    assert_eq!(at(&mut rig, SPEED, PV), Some(Data::Real(33.3)));
    assert_eq!(at(&mut rig, SPEED, 103), Some(Data::Enumerated(0)));
    assert_eq!(at(&mut rig, SPEED, 117), Some(Data::Enumerated(98)));
    assert_eq!(at(&mut rig, SPEED, 22), Some(Data::Real(0.1)));
    rig.shows(101, 2, Datum::Bool(true));
    assert_eq!(at(&mut rig, RUN, PV), Some(Data::Enumerated(1)));
    assert_eq!(at(&mut rig, RUN, 4), Some(Data::Text("on".to_string())));
    rig.shows(101, 3, Datum::State(2));
    assert_eq!(at(&mut rig, STATE, PV), Some(Data::Unsigned(2)));
    rig.shows(101, 4, Datum::Text("F1 overcurrent".into()));
    assert_eq!(at(&mut rig, TEXT, PV), Some(Data::Text("F1 overcurrent".to_string())));
    let any = ObjectId::new(ObjectType::DEVICE, crate::types::WILDCARD);
    let own = ObjectId::new(ObjectType::DEVICE, 101);
    for id in [any, own] {
        assert_eq!(at(&mut rig, id, 75), Some(Data::Object(own)));
    }
    assert_eq!(at(&mut rig, own, 139), Some(Data::Unsigned(22)));
    assert_eq!(
        at(&mut rig, ObjectId::new(ObjectType::NETWORK_PORT, 1), 427),
        Some(Data::Enumerated(7))
    );
}

#[test]
fn what_is_not_there_is_an_error_and_what_is_no_request_is_rejected() {
    let mut rig = ServerWithClients::new();
    let mut is = |service: u8, content: &[u8], wanted: &[u8]| {
        let answer = rig.ask(5, Some(1), 9, service, content).remove(0);
        assert_eq!(answer, wanted, "{service} {content:?}");
    };
    let error = |error: Error| apdu::error(9, c::READ_PROPERTY, error);
    is(
        c::READ_PROPERTY,
        &read(ObjectId::new(ObjectType::ANALOG_INPUT, 77), PV),
        &error(Error::UNKNOWN_OBJECT),
    );
    is(c::READ_PROPERTY, &read(SPEED, 87), &error(Error::UNKNOWN_PROPERTY));
    let element = |object, property, index: u64| {
        [
            read(object, property),
            written(|w| {
                w.context_unsigned(2, index);
            }),
        ]
        .concat()
    };
    is(c::READ_PROPERTY, &element(SPEED, PV, 1), &error(Error::NOT_AN_ARRAY));
    is(
        c::READ_PROPERTY,
        &element(RUN, 87, 17),
        &error(Error::INVALID_ARRAY_INDEX),
    );
    is(c::READ_PROPERTY, &[], &[0x60, 9, 5]);
    is(c::READ_PROPERTY, &[0x19, 85], &[0x60, 9, 5]);
    is(
        c::READ_PROPERTY,
        &[read(SPEED, PV), vec![0x49, 1]].concat(),
        &[0x60, 9, 7],
    );
    is(99, &[], &[0x60, 9, 9]);
    is(
        c::REINITIALIZE_DEVICE,
        &[0x09, 0],
        &apdu::error(9, 20, Error::SERVICE_REQUEST_DENIED),
    );
    // A request in segments is not taken.
    rig.tell(5, Some(1), &[0x0A, 5, 9, 0, 4, 12, 1, 2]);
    assert_eq!(rig.out()[0].3, [0x71, 9, 4]);
    // A confirmed request that was broadcast is neither carried out nor answered.
    let to = Some((NETWORK, Mac::new(&[1]).unwrap()));
    let request = [&[0, 5, 1, c::READ_PROPERTY][..], &read(SPEED, PV)].concat();
    rig.datagram(
        5,
        &bvlc::broadcast(&npdu::encode(to, None, true, Payload::Application(&request))),
    );
    assert!(rig.out().is_empty());
}

/// ReadPropertyMultiple of one property of each of the objects.
fn multiple(objects: &[ObjectId], property: u32) -> Vec<u8> {
    written(|w| {
        for object in objects {
            w.context_object(0, *object)
                .open(1)
                .context_unsigned(0, property.into())
                .close(1);
        }
    })
}

#[test]
fn all_properties_and_errors_stand_beside_each_other() {
    let mut rig = ServerWithClients::new();
    let asked = multiple(
        &[SPEED, ObjectId::new(ObjectType::ANALOG_INPUT, 77), RUN],
        PropertyId::ALL.0,
    );
    let answer = rig.ask(5, Some(1), 1, c::READ_PROPERTY_MULTIPLE, &asked).remove(0);
    let mut reader = Reader::new(&answer[3..]);
    let mut seen = Vec::new();
    while !reader.is_empty() {
        let object = reader.context_object(0).unwrap();
        reader.open(1).unwrap();
        while !reader.is_close(1) {
            let property = reader.context_u32(2).unwrap();
            reader.optional_u32(3).unwrap();
            let which = if reader.is_open(4) { 4 } else { 5 };
            reader.open(which).unwrap();
            while !reader.is_close(which) {
                reader.data().unwrap();
            }
            reader.close(which).unwrap();
            seen.push((object, property, which == 4));
        }
        reader.close(1).unwrap();
    }
    let of = |object: ObjectId| seen.iter().filter(|(of, ..)| *of == object).collect::<Vec<_>>();
    assert!(of(SPEED).len() > 12 && of(SPEED).iter().all(|(.., ok)| *ok));
    assert!(of(RUN).iter().any(|(_, property, ok)| *property == 87 && *ok));
    assert_eq!(
        of(ObjectId::new(ObjectType::ANALOG_INPUT, 77))
            .iter()
            .map(|(_, p, ok)| (*p, *ok))
            .collect::<Vec<_>>(),
        [(8, false)]
    );
}

#[test]
fn a_long_answer_comes_in_segments_where_the_client_takes_them() {
    let mut rig = ServerWithClients::of(1, 60);
    let own: Vec<ObjectId> = (100..160).map(|n| ObjectId::new(ObjectType::ANALOG_INPUT, n)).collect();
    let asked = multiple(&own, PropertyId::ALL.0);
    let first = rig.ask(5, Some(1), 7, c::READ_PROPERTY_MULTIPLE, &asked);
    assert_eq!(
        (first.len(), &first[0][..5]),
        (1, &[0x3C, 7, 0, 4, 14][..]),
        "one segment, then the window"
    );
    rig.tell(5, Some(1), &[0x40, 7, 0, 4]);
    assert_eq!(rig.out().len(), 4);
    rig.tell(5, Some(1), &[0x70, 7, 0]);
    rig.tell(5, Some(1), &[0x40, 7, 4, 4]);
    assert!(rig.out().is_empty(), "the client ended it");
    let mut no_segments = vec![0x00, 0x05, 7, c::READ_PROPERTY_MULTIPLE];
    no_segments.extend(&asked);
    rig.tell(5, Some(1), &no_segments);
    assert_eq!(rig.out()[0].3, [0x71, 7, 4]);
    let mut two_segments = vec![0x02, 0x15, 7, c::READ_PROPERTY_MULTIPLE];
    two_segments.extend(&asked);
    rig.tell(5, Some(1), &two_segments);
    assert_eq!(rig.out()[0].3, [0x71, 7, 1]);
}

#[test]
fn a_device_is_kept_from_talking_only_with_the_password_and_not_for_long() {
    let mut rig = ServerWithClients::new();
    let control = |wanted: u64, password: &'static str| {
        written(move |w| {
            w.context_unsigned(0, 60).context_unsigned(1, wanted);
            w.context_octets(2, &[&[0], password.as_bytes()].concat());
        })
    };
    let ask = |rig: &mut ServerWithClients, content: &[u8]| {
        rig.ask(5, Some(1), 1, c::DEVICE_COMMUNICATION_CONTROL, content)
            .remove(0)
    };
    assert_eq!(
        ask(&mut rig, &control(2, "guess")),
        apdu::error(1, 17, Error::PASSWORD_FAILURE)
    );
    assert_eq!(ask(&mut rig, &[0x19, 2]), apdu::error(1, 17, Error::PASSWORD_FAILURE));
    assert_eq!(
        ask(&mut rig, &control(1, "secret")),
        apdu::error(1, 17, Error::SERVICE_REQUEST_DENIED)
    );
    assert_eq!(ask(&mut rig, &control(2, "secret")), apdu::simple_ack(1, 17));
    let announced = |rig: &mut ServerWithClients| {
        rig.server.announce(101, &rig.plant, rig.now);
        rig.out().len()
    };
    assert_eq!(announced(&mut rig), 0);
    rig.later(Duration::from_secs(301));
    assert_eq!(announced(&mut rig), 1);
}
