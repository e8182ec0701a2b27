use super::*;

fn subscribe(object: ObjectId, confirmed: bool, seconds: u64) -> Vec<u8> {
    written(|w| {
        w.context_unsigned(0, 7)
            .context_object(1, object)
            .context_bool(2, confirmed)
            .context_unsigned(3, seconds);
    })
}

fn notified(out: &[Vec<u8>]) -> Vec<Option<Data>> {
    let notification = |apdu: &&Vec<u8>| apdu[..2] == [0x10, 2] || (apdu[0] == 0 && apdu[3] == 1);
    out.iter()
        .filter(notification)
        .map(|apdu| {
            let mut reader = Reader::new(&apdu[if apdu[0] == 0x10 { 2 } else { 4 }..]);
            reader.context_u32(0).unwrap();
            reader.context_object(1).unwrap();
            reader.context_object(2).unwrap();
            reader.context_u32(3).unwrap();
            reader.open(4).unwrap();
            reader.context_u32(0).unwrap();
            reader.open(2).unwrap();
            reader.data().unwrap()
        })
        .collect()
}

impl ServerWithClients {
    fn change(&mut self, value: f64) -> Vec<Option<Data>> {
        self.shows(101, 0, Datum::Number(value));
        self.server.changed(101, &self.plant, self.now);
        let out: Vec<Vec<u8>> = self.out().into_iter().map(|(.., apdu)| apdu).collect();
        notified(&out)
    }
}

#[test]
fn the_first_at_once_then_by_the_increment() {
    let mut rig = ServerWithClients::new();
    rig.shows(101, 0, Datum::Number(10.0));
    let answers = rig.ask(5, Some(1), 1, c::SUBSCRIBE_COV, &subscribe(SPEED, false, 60));
    assert_eq!(answers[0], apdu::simple_ack(1, c::SUBSCRIBE_COV));
    assert_eq!(notified(&answers[1..]), [Some(Data::Real(10.0))]);
    assert!(rig.change(10.05).is_empty());
    assert_eq!(rig.change(10.2), [Some(Data::Real(10.2))]);
    rig.plant.values.borrow_mut().get_mut(&(101, 0)).unwrap().reliability = Reliability::CommunicationFailure;
    rig.later(Duration::from_millis(100));
    assert_eq!(rig.out().len(), 1, "the flags changed, found by time alone");
    let own = ObjectId::new(ObjectType::DEVICE, 101);
    let listed = rig.ask(5, Some(1), 1, c::READ_PROPERTY, &read(own, 152)).remove(0);
    assert!(listed.len() > 40);
    rig.later(Duration::from_secs(61));
    assert!(rig.change(50.0).is_empty(), "its time is over");
    assert_eq!(rig.server.counters().subscriptions, 0);
}

#[test]
fn confirmed_ones_go_one_by_one_with_the_newest_value() {
    let mut rig = ServerWithClients::new();
    rig.shows(101, 0, Datum::Number(10.0));
    let answers = rig.ask(5, Some(1), 1, c::SUBSCRIBE_COV, &subscribe(SPEED, true, 0));
    assert_eq!(notified(&answers[1..]), [Some(Data::Real(10.0))]);
    let invoke = answers[1][2];
    assert!(rig.change(20.0).is_empty() && rig.change(30.0).is_empty());
    rig.later(Duration::from_secs(3));
    assert_eq!(rig.out().len(), 1, "again");
    rig.tell(5, Some(1), &apdu::simple_ack(invoke, 1));
    let out: Vec<Vec<u8>> = rig.out().into_iter().map(|(.., apdu)| apdu).collect();
    assert_eq!(notified(&out), [Some(Data::Real(30.0))], "merged");
}

#[test]
fn any_property_of_any_object_and_no_other() {
    let mut rig = ServerWithClients::new();
    rig.shows(101, 0, Datum::Number(0.0));
    for object in [
        SPEED,
        RUN,
        STATE,
        TEXT,
        ObjectId::new(ObjectType::DEVICE, 101),
        ObjectId::new(ObjectType::NETWORK_PORT, 1),
    ] {
        let answers = rig.ask(5, Some(1), 1, c::SUBSCRIBE_COV, &subscribe(object, false, 60));
        assert_eq!((answers.len(), answers[0][0]), (2, 0x20), "{object}");
    }
    let of_property = |property: u64| {
        written(|w| {
            w.context_unsigned(0, 8)
                .context_object(1, SPEED)
                .context_bool(2, false)
                .context_unsigned(3, 60);
            w.open(4).context_unsigned(0, property).close(4).context_real(5, 5.0);
        })
    };
    let answers = rig.ask(5, Some(1), 1, c::SUBSCRIBE_COV_PROPERTY, &of_property(PV.into()));
    assert_eq!(answers.len(), 2);
    assert_eq!(rig.change(3.0).len(), 1, "by 0.1, not by 5");
    assert_eq!(rig.change(9.0).len(), 2);
    let answers = rig.ask(5, Some(1), 1, c::SUBSCRIBE_COV_PROPERTY, &of_property(87));
    assert_eq!(answers, [apdu::error(1, 28, Error::UNKNOWN_PROPERTY)]);
    let answers = rig.ask(
        5,
        Some(1),
        1,
        c::SUBSCRIBE_COV,
        &subscribe(ObjectId::new(ObjectType::ANALOG_INPUT, 9), false, 1),
    );
    assert_eq!(answers, [apdu::error(1, 5, Error::UNKNOWN_OBJECT)]);
    let cancel = written(|w| {
        w.context_unsigned(0, 7).context_object(1, SPEED);
    });
    rig.ask(5, Some(1), 1, c::SUBSCRIBE_COV, &cancel);
    assert_eq!(rig.server.counters().subscriptions, 6);
    rig.server.set_devices(vec![device(100, None, 0)]);
    assert_eq!(rig.server.counters().subscriptions, 0, "its device is there no more");
}

#[test]
fn clocks_and_what_does_not_fit_are_not_subscribed_to() {
    let mut rig = ServerWithClients::of(1, 240);
    let own = ObjectId::new(ObjectType::DEVICE, 101);
    let of_property = |property: PropertyId| {
        written(|w| {
            w.context_unsigned(0, 8)
                .context_object(1, own)
                .context_bool(2, false)
                .context_unsigned(3, 0);
            w.open(4).context_property(0, property).close(4);
        })
    };
    for property in [
        PropertyId::LOCAL_TIME,
        PropertyId::LOCAL_DATE,
        PropertyId::ACTIVE_COV_SUBSCRIPTIONS,
        PropertyId::OBJECT_LIST,
        PropertyId::ALL,
    ] {
        let answers = rig.ask(5, Some(1), 1, c::SUBSCRIBE_COV_PROPERTY, &of_property(property));
        assert_eq!(answers, [apdu::error(1, 28, Error::NOT_COV_PROPERTY)], "{property:?}");
    }
    rig.later(Duration::from_secs(2));
    assert_eq!((rig.out().len(), rig.server.counters().subscriptions), (0, 0));
    let answers = rig.ask(
        5,
        Some(1),
        2,
        c::SUBSCRIBE_COV_PROPERTY,
        &of_property(PropertyId::OBJECT_NAME),
    );
    assert_eq!(answers.len(), 2);
}

#[test]
fn a_device_that_must_be_quiet_notifies_afterwards() {
    let mut rig = ServerWithClients::new();
    rig.shows(101, 0, Datum::Number(10.0));
    let answers = rig.ask(5, Some(1), 1, c::SUBSCRIBE_COV, &subscribe(SPEED, true, 600));
    let invoke = answers[1][2];
    // A second change waits until the first notification is acknowledged.
    assert!(rig.change(20.0).is_empty());
    let quiet = written(|w| {
        w.context_unsigned(0, 1).context_unsigned(1, 2);
        w.context_octets(2, &[&[0], "secret".as_bytes()].concat());
    });
    assert_eq!(
        rig.ask(5, Some(1), 2, c::DEVICE_COMMUNICATION_CONTROL, &quiet),
        [apdu::simple_ack(2, c::DEVICE_COMMUNICATION_CONTROL)]
    );
    rig.tell(5, Some(1), &apdu::simple_ack(invoke, c::COV_NOTIFICATION));
    assert!(rig.change(30.0).is_empty() && rig.out().is_empty());
    rig.later(Duration::from_secs(59));
    assert!(rig.out().is_empty());
    rig.later(Duration::from_secs(2));
    let out: Vec<Vec<u8>> = rig.out().into_iter().map(|(.., apdu)| apdu).collect();
    assert_eq!(notified(&out), [Some(Data::Real(30.0))], "the newest value");
}
