use super::*;

fn ack(invoke: u8) -> Vec<u8> {
    apdu::simple_ack(invoke, c::WRITE_PROPERTY)
}

fn run(on: u32, priority: u64) -> Vec<u8> {
    write(RUN, Some(priority), |w| {
        w.enumerated(on);
    })
}

impl ServerWithClients {
    fn write(&mut self, from: u8, invoke: u8, content: &[u8]) -> Vec<Vec<u8>> {
        self.ask(from, Some(1), invoke, c::WRITE_PROPERTY, content)
    }

    fn job(&mut self) -> Option<Job> {
        self.server.take_job()
    }

    fn done(&mut self, job: &Job, result: Result<(), Error>) -> Vec<Vec<u8>> {
        self.plant.orders.set(self.plant.orders.get() + 1);
        self.server.written(job.token, result, &self.plant, self.now);
        self.out().into_iter().map(|(.., apdu)| apdu).collect()
    }
}

#[test]
fn an_acknowledgement_waits_for_whoever_carries_it_out() {
    let mut rig = ServerWithClients::new();
    assert!(rig.write(5, 3, &run(1, 8)).is_empty());
    let job = rig.job().unwrap();
    assert_eq!(
        (job.device, job.object, job.value.clone(), job.priority),
        (101, RUN, Some(Datum::Bool(true)), Some(8))
    );
    assert!(rig.server.is_busy() && rig.job().is_none());
    assert_eq!(rig.done(&job, Ok(())), [ack(3)]);
    assert!(!rig.server.is_busy());
    assert!(rig.done(&job, Ok(())).is_empty(), "answered once");
    rig.write(5, 4, &run(1, 8));
    let job = rig.job().unwrap();
    assert_eq!(
        rig.done(&job, Err(Error::TIMEOUT)),
        [apdu::error(4, 15, Error::TIMEOUT)]
    );
}

#[test]
fn what_comes_twice_is_done_once() {
    let mut rig = ServerWithClients::new();
    rig.write(5, 3, &run(1, 8));
    let job = rig.job().unwrap();
    assert!(
        rig.write(5, 3, &run(1, 8)).is_empty() && rig.job().is_none(),
        "it joins"
    );
    assert_eq!(rig.done(&job, Ok(())), [ack(3)]);
    assert_eq!(rig.write(5, 3, &run(1, 8)), [ack(3)], "from memory");
    assert!(rig.job().is_none());
    rig.plant.orders.set(99);
    let denied = apdu::error(3, 15, Error::SERVICE_REQUEST_DENIED);
    assert_eq!(
        rig.write(5, 3, &run(1, 8)),
        [denied],
        "somebody else ordered something since"
    );
    assert!(rig.job().is_none());
    rig.ask(5, Some(1), 4, c::READ_PROPERTY, &read(SPEED, PV));
    rig.write(5, 3, &run(1, 8));
    let job = rig.job().expect("a new request, behind another one");
    rig.done(&job, Ok(()));
    rig.later(Duration::from_secs(11));
    rig.write(5, 3, &run(1, 8));
    let job = rig.job().expect("forgotten");
    rig.done(&job, Ok(()));
    // A repeated stop is carried out again.
    rig.write(5, 5, &run(0, 8));
    let job = rig.job().unwrap();
    rig.write(5, 5, &run(0, 8));
    assert!(rig.job().is_none(), "while it is under way");
    rig.done(&job, Ok(()));
    rig.write(5, 5, &run(0, 8));
    assert!(rig.job().is_some());
}

#[test]
fn what_comes_twice_is_done_once_across_new_numbers() {
    let mut rig = ServerWithClients::new();
    rig.write(5, 3, &run(1, 8));
    let first = rig.job().unwrap();
    rig.write(6, 1, &run(1, 8));
    rig.restart(200);
    let second = rig.job().expect("accepted before the restart");
    let run_of_second = device(200, None, 0).find(RUN).unwrap();
    assert_eq!((second.device, second.place), (201, run_of_second));
    assert!(
        rig.write(5, 3, &run(1, 8)).is_empty() && rig.job().is_none(),
        "it joins the write in progress"
    );
    rig.write(7, 1, &run(1, 8));
    let third = rig.job().unwrap();
    assert!(
        first.token != third.token && second.token != third.token,
        "an earlier write must not answer a later one"
    );
    assert_eq!(rig.done(&first, Ok(())), [ack(3)]);
    assert_eq!(rig.done(&second, Ok(())), [ack(1)]);
    rig.restart(300);
    let denied = apdu::error(3, 15, Error::SERVICE_REQUEST_DENIED);
    assert_eq!(
        rig.write(5, 3, &run(1, 8)),
        [denied],
        "a late duplicate behind another order"
    );
    assert_eq!(
        rig.done(&third, Err(Error::TIMEOUT)),
        [apdu::error(1, 15, Error::TIMEOUT)]
    );
    assert!(rig.job().is_none());
}

#[test]
fn another_request_by_the_same_number_gets_the_one_answer() {
    let mut rig = ServerWithClients::new();
    rig.write(5, 3, &run(1, 8));
    let first = rig.job().unwrap();
    rig.write(5, 3, &run(0, 8));
    let second = rig.job().unwrap();
    assert!(rig.done(&first, Ok(())).is_empty(), "its client does not wait for it");
    assert_eq!(rig.done(&second, Ok(())), [ack(3)]);
}

#[test]
fn values_are_judged_by_what_the_object_is() {
    let mut rig = ServerWithClients::new();
    let real = |number: f32| {
        move |w: &mut Writer| {
            w.real(number);
        }
    };
    let cases: Vec<(Vec<u8>, Error)> = vec![
        (
            write(REFERENCE, None, |w| {
                w.unsigned(5);
            }),
            Error::INVALID_DATA_TYPE,
        ),
        (write(REFERENCE, None, real(f32::NAN)), Error::VALUE_OUT_OF_RANGE),
        (write(REFERENCE, Some(0), real(1.0)), Error::PARAMETER_OUT_OF_RANGE),
        (write(REFERENCE, Some(17), real(1.0)), Error::PARAMETER_OUT_OF_RANGE),
        (run(2, 8), Error::VALUE_OUT_OF_RANGE),
        (
            write(RUN, None, |w| {
                w.enumerated(1).enumerated(1);
            }),
            Error::INVALID_DATA_TYPE,
        ),
        (write(SPEED, None, real(1.0)), Error::WRITE_ACCESS_DENIED),
        (
            write(ObjectId::new(ObjectType::ANALOG_VALUE, 9), None, real(1.0)),
            Error::UNKNOWN_OBJECT,
        ),
        (
            write(ObjectId::new(ObjectType::DEVICE, 101), None, real(1.0)),
            Error::WRITE_ACCESS_DENIED,
        ),
    ];
    for (content, error) in cases {
        assert_eq!(rig.write(5, 1, &content), [apdu::error(1, 15, error)], "{content:?}");
        assert!(rig.job().is_none());
    }
    let of = |object: ObjectId, property: u64, real: f32| {
        written(|w| {
            w.context_object(0, object)
                .context_unsigned(1, property)
                .open(3)
                .real(real)
                .close(3);
        })
    };
    assert_eq!(
        rig.write(5, 1, &of(SPEED, 81, 0.0)),
        [apdu::error(1, 15, Error::WRITE_ACCESS_DENIED)],
        "Out_Of_Service"
    );
    assert_eq!(
        rig.write(5, 1, &of(SPEED, 999, 0.0)),
        [apdu::error(1, 15, Error::UNKNOWN_PROPERTY)]
    );
    assert_eq!(rig.write(5, 1, &of(SPEED, 22, 2.5)), [ack(1)], "COV_Increment");
    let answer = rig.ask(5, Some(1), 1, c::READ_PROPERTY, &read(SPEED, 22)).remove(0);
    assert_eq!(value(&answer), Some(Data::Real(2.5)));
    rig.write(5, 2, &write(REFERENCE, None, real(33.3)));
    let job = rig.job().unwrap();
    assert_eq!(
        (job.value, job.priority),
        (Some(Datum::Number(33.3)), Some(16)),
        "as it was written"
    );
}

#[test]
fn those_that_may_not_write_are_refused_and_a_silent_device_can_be_stopped() {
    let mut rig = ServerWithClients::new();
    assert_eq!(
        rig.write(200, 1, &run(1, 8)),
        [apdu::error(1, 15, Error::WRITE_ACCESS_DENIED)]
    );
    assert!(rig.job().is_none());
    rig.plant.silent.borrow_mut().insert(101);
    assert!(rig.write(5, 1, &run(1, 8)).is_empty() && rig.job().is_none());
    assert!(rig.ask(5, Some(1), 2, c::READ_PROPERTY, &read(SPEED, PV)).is_empty());
    rig.write(5, 3, &run(0, 8));
    let job = rig.job().unwrap();
    assert_eq!(
        rig.done(&job, Err(Error::TIMEOUT)),
        [apdu::error(3, 15, Error::TIMEOUT)]
    );
}

/// A WritePropertyMultiple of Present_Values at priority 8.
fn several(items: &[(ObjectId, f32)]) -> Vec<u8> {
    written(|w| {
        for (object, value) in items {
            w.context_object(0, *object)
                .open(1)
                .context_unsigned(0, PV.into())
                .open(2);
            match object.kind {
                ObjectType::BINARY_VALUE => w.enumerated(*value as u32),
                _ => w.real(*value),
            };
            w.close(2).context_unsigned(3, 8).close(1);
        }
    })
}

#[test]
fn of_several_writes_a_stop_waits_for_none_and_outlives_all() {
    let mut rig = ServerWithClients::new();
    let begin = |rig: &mut ServerWithClients, items: &[(ObjectId, f32)]| {
        assert!(
            rig.ask(5, Some(1), 1, c::WRITE_PROPERTY_MULTIPLE, &several(items))
                .is_empty()
        );
    };
    begin(&mut rig, &[(REFERENCE, 50.0), (RUN, 0.0)]);
    let stop = rig.job().unwrap();
    assert_eq!(stop.object, RUN, "the stop goes first");
    assert!(rig.done(&stop, Ok(())).is_empty());
    let reference = rig.job().unwrap();
    assert_eq!(rig.done(&reference, Ok(())), [apdu::simple_ack(1, 16)]);
    begin(&mut rig, &[(RUN, 1.0), (REFERENCE, 50.0), (RUN, 0.0)]);
    let start = rig.job().unwrap();
    assert_eq!(
        start.value,
        Some(Datum::Bool(true)),
        "but not before what its client wrote to the same object"
    );
    rig.done(&start, Err(Error::SERVICE_REQUEST_DENIED));
    let stop = rig.job().unwrap();
    assert_eq!(
        (stop.object, stop.value.clone()),
        (RUN, Some(Datum::Bool(false))),
        "the rest is not carried out, the stop is"
    );
    let answer = rig.done(&stop, Ok(())).remove(0);
    let failed = written(|w| {
        w.raw(&[0x50, 1, 16]).open(0).enumerated(5).enumerated(29).close(0);
        w.open(1).context_object(0, RUN).context_unsigned(1, PV.into()).close(1);
    });
    assert_eq!(answer, failed);
    assert!(rig.job().is_none());
}

#[test]
fn the_rest_of_a_request_reaches_no_device_that_gets_the_number_of_a_removed_one() {
    let mut rig = ServerWithClients::new();
    let items = several(&[(REFERENCE, 50.0), (RUN, 1.0)]);
    rig.ask(5, Some(2), 1, c::WRITE_PROPERTY_MULTIPLE, &items);
    let reference = rig.job().unwrap();
    assert_eq!((reference.device, reference.object), (102, REFERENCE));
    rig.ask(6, Some(2), 1, c::WRITE_PROPERTY, &run(1, 8));
    // The device of station 2 is gone, and that of station 1 has its number.
    let present = vec![device(101, None, 0), device(102, Some(1), 0), device(104, Some(3), 0)];
    rig.server.restart(options(), present, rig.now);
    let waiting = rig.job().unwrap();
    assert_eq!((waiting.device, waiting.place), (103, usize::MAX));
    assert!(!rig.done(&waiting, Err(Error::WRITE_ACCESS_DENIED)).is_empty());
    let answer = rig.done(&reference, Ok(())).remove(0);
    assert_eq!(rig.job(), None);
    let failed = written(|w| {
        w.raw(&[0x50, 1, 16]).open(0).enumerated(1).enumerated(31).close(0);
        w.open(1).context_object(0, RUN).context_unsigned(1, PV.into()).close(1);
    });
    assert_eq!(answer, failed, "unknown object");
}

#[test]
fn writes_under_way_are_bounded_and_stops_find_room() {
    let mut rig = ServerWithClients::new();
    let taken = (0..=255_u8).filter(|n| {
        let answers = rig.write(5, *n, &run(1, 8));
        answers.is_empty()
    });
    assert_eq!(taken.count(), 64);
    let jobs = std::iter::from_fn(|| rig.job()).count();
    assert_eq!(jobs, 64);
    assert!(rig.write(6, 1, &run(1, 8)).is_empty(), "another client has its own");
    assert!(rig.write(5, 200, &run(0, 8)).is_empty() && rig.job().is_some() && rig.job().is_some());
}
