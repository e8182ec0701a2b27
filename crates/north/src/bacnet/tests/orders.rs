use super::*;

const NULL: Option<Datum> = None;

#[test]
fn a_slot_that_governs_is_an_order_and_stands_when_the_drive_took_it() {
    let rig = ControlledDrive::new();
    assert_eq!(
        rig.order("127.0.0.5", RUN, 8, on(true), done()),
        "run=true by bacnet 127.0.0.5"
    );
    assert_eq!(rig.slots(RUN), [(8, Datum::Bool(true))]);
    assert_eq!(rig.shown(RUN), Datum::Bool(true));
    assert_eq!(
        rig.at_once("127.0.0.6", RUN, 10, on(false)),
        Ok(()),
        "it does not govern"
    );
    assert_eq!(
        rig.order("127.0.0.7", RUN, 5, on(false), done()),
        "run=false by bacnet 127.0.0.7"
    );
    assert_eq!(
        rig.order("127.0.0.7", RUN, 5, NULL, done()),
        "run=true by bacnet 127.0.0.5",
        "an order of its owner"
    );
    assert_eq!(
        rig.order("127.0.0.5", RUN, 8, NULL, done()),
        "run=false by bacnet 127.0.0.6"
    );
    assert_eq!(
        rig.order("127.0.0.6", RUN, 10, NULL, done()),
        "run=false by bacnet 127.0.0.6",
        "the last one: a stop"
    );
    assert_eq!(rig.slots(RUN), []);
    assert_eq!(rig.at_once("127.0.0.6", RUN, 10, NULL), Ok(()), "was empty");
}

#[test]
fn what_failed_leaves_the_slot_and_what_is_unknown_leaves_what_is_read() {
    let mut rig = ControlledDrive::new();
    rig.order("127.0.0.5", RUN, 8, on(true), done());
    rig.order(
        "127.0.0.5",
        RUN,
        8,
        on(false),
        Outcome::Exception(drivegate_proto::Exception::DEVICE_FAILURE),
    );
    assert_eq!(rig.slots(RUN), [(8, Datum::Bool(true))]);
    rig.order("127.0.0.5", RUN, 8, on(false), Outcome::TimedOut);
    assert_eq!(rig.slots(RUN), []);
    rig.now += Duration::from_millis(50);
    rig.read(0);
    let drive = rig.drive();
    let reading = drive.reading(rig.now);
    drive.priorities(|all| {
        all.resolve(|what, since| {
            let sample = reading.model(what.point());
            sample.good().filter(|_| sample.at.is_some_and(|at| at > since))
        });
    });
    assert_eq!(rig.slots(RUN), [(8, Datum::Bool(false))], "the drive shows the stop");
}

#[test]
fn errors_say_what_happened() {
    use drivegate_core::order::Interruption;
    use drivegate_proto::Exception;
    let cases = [
        (
            Outcome::Exception(Exception::DEVICE_FAILURE),
            Error::OPERATIONAL_PROBLEM,
        ),
        (Outcome::NotTaken(String::new()), Error::OPERATIONAL_PROBLEM),
        (Outcome::TimedOut, Error::TIMEOUT),
        (Outcome::Interrupted(Interruption::Stop), Error::TIMEOUT),
        (Outcome::Offline, Error::TIMEOUT),
        (Outcome::Purged, Error::SERVICE_REQUEST_DENIED),
        (
            Outcome::Refused(Refusal::NotAllowed(String::new())),
            Error::WRITE_ACCESS_DENIED,
        ),
        (
            Outcome::Refused(Refusal::BadValue(String::new())),
            Error::VALUE_OUT_OF_RANGE,
        ),
        (
            Outcome::Refused(Refusal::NotWritable(String::new())),
            Error::WRITE_ACCESS_DENIED,
        ),
    ];
    for (outcome, error) in cases {
        assert_eq!(writes::error(&outcome), Err(error), "{outcome:?}");
    }
    let rig = ControlledDrive::new();
    assert_eq!(
        rig.at_once("127.0.0.5", SPEED, 8, number(80.5)),
        Err(Error::VALUE_OUT_OF_RANGE),
        "the limits"
    );
    assert_eq!(
        rig.at_once("127.0.0.5", RUN, 6, on(false)),
        Err(Error::WRITE_ACCESS_DENIED),
        "minimum on and off times"
    );
    assert_eq!(rig.slots(SPEED), []);
}

#[test]
fn both_references_are_one_thing_and_each_shows_its_unit() {
    let rig = ControlledDrive::new();
    assert_eq!(
        rig.order("127.0.0.5", SPEED, 8, number(50.0), done()),
        "speed_reference=50 by bacnet 127.0.0.5"
    );
    assert_eq!(
        (rig.shown(SPEED), rig.shown(FREQUENCY)),
        (Datum::Number(50.0), Datum::Number(25.0))
    );
    assert_eq!(rig.at_once("127.0.0.6", FREQUENCY, 9, number(10.0)), Ok(()));
    let order = rig.order("127.0.0.6", FREQUENCY, 7, number(20.0), done());
    assert_eq!(order, "speed_reference=40 by bacnet 127.0.0.6");
    assert_eq!(
        (rig.shown(SPEED), rig.shown(FREQUENCY)),
        (Datum::Number(40.0), Datum::Number(20.0))
    );
    assert_eq!(
        rig.order("127.0.0.6", FREQUENCY, 7, NULL, done()),
        "speed_reference=50 by bacnet 127.0.0.5"
    );
}

#[test]
fn a_stop_elsewhere_withdraws_and_a_slot_that_protects_refuses() {
    let rig = ControlledDrive::new();
    rig.order("127.0.0.5", RUN, 8, on(true), done());
    assert_eq!(rig.elsewhere(ModelPoint::Run, Value::Bool(false)), None);
    assert_eq!(rig.slots(RUN), []);
    rig.carry_out(done());
    rig.order("127.0.0.5", RUN, 3, on(false), done());
    let refused = rig.elsewhere(ModelPoint::Run, Value::Bool(true)).unwrap();
    assert_eq!(refused.code(), "held_by_other");
    assert!(
        refused.to_string().contains("127.0.0.5") && refused.to_string().contains("priority 3"),
        "{refused}"
    );
    assert_eq!(
        rig.elsewhere(ModelPoint::Run, Value::Bool(false)),
        None,
        "a stop passes"
    );
    rig.carry_out(done());
    assert_eq!(rig.slots(RUN), [(3, Datum::Bool(false))]);
    rig.order("127.0.0.5", RUN, 3, NULL, done());
    assert_eq!(rig.elsewhere(ModelPoint::Run, Value::Bool(true)), None);
}

#[test]
fn who_comes_to_govern_is_judged_anew_and_gives_its_slot_back_when_refused() {
    let rig = ControlledDrive::new();
    rig.order("127.0.0.5", RUN, 8, on(true), done());
    rig.order("127.0.0.7", RUN, 5, on(false), done());
    let drive = rig.drive();
    drive
        .image
        .restore_lock
        .set(Some("its parameters are being restored".to_string()));
    let order = rig.order("127.0.0.7", RUN, 5, NULL, done());
    assert_eq!(
        order, "run=false by bacnet 127.0.0.7",
        "nothing is left, so it is a stop"
    );
    assert_eq!(rig.slots(RUN), []);
}

#[test]
fn a_stop_between_plan_and_acceptance_keeps_the_next_slot_from_starting() {
    let rig = ControlledDrive::new();
    rig.order("127.0.0.5", RUN, 8, on(true), done());
    rig.order("127.0.0.7", RUN, 5, on(false), done());
    let drive = rig.drive();
    let null = SlotWrite::new(Commanded::Run, 5, None);
    let Follows::Order(_, entry) = drive.priorities(|all| all.plan(&null)) else {
        panic!("no order")
    };
    assert_eq!(rig.elsewhere(ModelPoint::Run, Value::Bool(false)), None);
    rig.carry_out(done());
    let run = drive.image.spec.profile.model_index(ModelPoint::Run).unwrap();
    let order = Order::Points(vec![(run, entry.value)]);
    let null = null.governed_by(&entry);
    let mut placed = drive.place(
        drivegate_core::plant::OrderRequest::new(order, entry.origin, Authority::Write)
            .within(Duration::from_secs(2))
            .by_slot(null),
        rig.now,
    );
    let outcome = placed.answer().expect("refused at once").outcome;
    assert_eq!(outcome, Outcome::Replaced);
    assert_eq!(writes::error(&outcome), Err(Error::SERVICE_REQUEST_DENIED));
    assert_eq!(rig.slots(RUN), [(5, Datum::Bool(false))]);
}

#[test]
fn what_hands_over_to_an_active_is_no_stop() {
    use drivegate_bacnet::services::{PropertyRef, WriteItem};
    let rig = ControlledDrive::new();
    let stops = |priority: u32, value: Data| {
        let property = PropertyRef {
            property: PropertyId::PRESENT_VALUE,
            index: None,
        };
        let item = WriteItem {
            object: RUN,
            property,
            value: Some(value),
            priority: Some(priority),
        };
        rig.view.stops(DEVICE, &item)
    };
    assert!(stops(8, Data::Null) && stops(16, Data::Enumerated(0)));
    rig.order("127.0.0.5", RUN, 8, on(true), done());
    rig.order("127.0.0.7", RUN, 5, on(false), done());
    assert!(!stops(5, Data::Null), "the active at 8 would start the motor");
    assert!(!stops(9, Data::Enumerated(0)), "it does not govern");
    assert!(stops(3, Data::Enumerated(0)) && !stops(300, Data::Enumerated(0)));
}

#[test]
fn a_pulse_leaves_nothing_behind() {
    let rig = ControlledDrive::new();
    let reset = ObjectId::new(ObjectType::BINARY_VALUE, 3);
    assert_eq!(
        rig.order("127.0.0.5", reset, 8, on(true), done()),
        "fault_reset=true by bacnet 127.0.0.5"
    );
    assert_eq!((rig.slots(reset), rig.shown(reset)), (vec![], Datum::Bool(false)));
    assert_eq!(rig.at_once("127.0.0.5", reset, 8, on(false)), Ok(()));
}
