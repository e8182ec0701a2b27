//! Stops on the line: to a drive that does not answer, cyclic ones, and ones that meet a command or a reset in progress.

use super::family_drive::FamilyDrive;
use super::*;

#[test]
fn a_stop_is_the_probe_of_a_drive_that_does_not_answer() {
    let mut rig = Rig::new(2);
    rig.drives[0].silent = true;
    rig.run(Duration::from_secs(20));
    assert!(rig.news.contains(&News::Offline(DriveIndex::new(0))));
    let mut run = rig.switch(0, "a", true);
    rig.run(Duration::from_millis(50));
    assert_eq!(outcome(&mut run), Some(Outcome::Offline), "at once, and unsent");
    // The drive is back, which the gateway does not know yet.
    rig.drives[0].silent = false;
    rig.drives[0].holding.insert(2000, 1);
    let mut stop = rig.switch(0, "a", false);
    rig.run(Duration::from_millis(200));
    assert!(outcome(&mut stop).is_some_and(|o| o.is_ok()));
    assert!(!rig.runs(0));
    rig.run(Duration::from_millis(200));
    assert_eq!(
        rig.news
            .iter()
            .rfind(|n| **n == News::Online(DriveIndex::new(0)) || **n == News::Offline(DriveIndex::new(0))),
        Some(&News::Online(DriveIndex::new(0)))
    );
}

#[test]
fn a_stop_to_a_drive_that_is_away_is_sent_again_after_a_damaged_reply() {
    let mut rig = Rig::new(2);
    rig.drives[0].silent = true;
    rig.run(Duration::from_secs(20));
    assert!(rig.news.contains(&News::Offline(DriveIndex::new(0))));
    rig.drives[0].silent = false;
    rig.drives[0].holding.insert(2000, 1);
    rig.drives[0].next_write = Some(Ended::Corrupt("checksum"));
    let mut stop = rig.switch(0, "a", false);
    rig.run(Duration::from_millis(200));
    assert!(outcome(&mut stop).is_some_and(|o| o.is_ok()));
    assert!(!rig.runs(0));
}

#[test]
fn stops_at_a_silent_drive_leave_the_line_to_the_others() {
    let mut rig = Rig::new(2);
    rig.drives[0].silent = true;
    rig.run(Duration::from_secs(10));
    let (from, begin) = (rig.wire.len(), rig.now);
    let mut answers = Vec::new();
    while rig.now < begin + Duration::from_secs(20) {
        answers.push(rig.switch(0, "a", false));
        rig.step();
    }
    let polls: Vec<Instant> = rig.wire[from..]
        .iter()
        .filter(|(_, turn)| drive_of(turn) == 1)
        .map(|(at, _)| *at)
        .collect();
    let longest = polls.windows(2).map(|w| w[1] - w[0]).max().unwrap();
    assert!(longest < Duration::from_millis(400), "{longest:?}");
    rig.run(Duration::from_secs(3));
    let open = answers
        .iter_mut()
        .filter_map(|a| outcome(a).is_none().then_some(()))
        .count();
    assert_eq!(open, 0, "every stop is answered");
}

#[test]
fn cyclic_stops_of_a_drive_that_stands_starve_nobody() {
    let mut rig = Rig::new(2);
    let _first = rig.switch(0, "plc", false);
    rig.run(Duration::from_secs(1));
    let mut longest = Duration::ZERO;
    for round in 0..50 {
        let begin = rig.now;
        let mut reference = rig.order(1, "other", ModelPoint::SpeedReference, Value::Number(f64::from(round)));
        while outcome(&mut reference).is_none() {
            let _stop = rig.switch(0, "plc", false);
            let _other = rig.switch(0, "second plc", false);
            rig.step();
        }
        longest = longest.max(rig.now - begin);
    }
    // At most eight stops in a row are sent, then polls for as long as those took.
    assert!(longest < COST * 32, "{longest:?}");
}

#[test]
fn cyclic_stops_of_a_drive_that_stands_do_not_make_each_other_urgent() {
    let mut rig = Rig::new(1);
    let _first = rig.switch(0, "plc", false);
    rig.run(Duration::from_secs(1));
    let from = rig.wire.len();
    for _ in 0..200 {
        let _stop = rig.switch(0, "plc", false);
        rig.step();
    }
    let ranks: Vec<Urgency> = rig.wire[from..].iter().filter_map(|(_, turn)| turn.rank()).collect();
    assert!(
        ranks.len() > 50 && ranks.iter().all(|rank| *rank == Urgency::Command),
        "{ranks:?}"
    );
    // A stop without an acknowledgement leaves a doubt.
    rig.drives[0].next_write = Some(Ended::Corrupt("noise"));
    let _doubtful = rig.switch(0, "plc", false);
    rig.drives[0].silent = true;
    rig.step();
    rig.step();
    rig.drives[0].silent = false;
    rig.run(COST * 10);
    let from = rig.wire.len();
    let _stop = rig.switch(0, "plc", false);
    rig.step();
    assert_eq!(rig.wire[from].1.rank(), Some(Urgency::Stop));
}

#[test]
fn stops_without_end_do_not_leave_a_reset_bit_set() {
    let mut rig = Rig::new(1);
    let reset = |rig: &Rig| rig.drives[0].holding.get(&2000).is_some_and(|word| word & 4 == 4);
    let _reset = rig.order(0, "other", ModelPoint::FaultReset, Value::Bool(true));
    while !reset(&rig) {
        rig.step();
    }
    let from = rig.wire.len();
    while reset(&rig) {
        let _stop = rig.switch(0, "plc", false);
        rig.step();
        assert!(rig.wire.len() < from + 40, "the reset bit is still set");
    }
}

#[test]
fn a_stop_yields_to_a_command_and_not_to_what_that_has_to_wait_for() {
    let mut rig = Rig::new(2);
    let from = rig.wire.len();
    for round in 0..300 {
        // A run command follows each stop, so that the next stop has an effect again.
        let _stop = rig.switch(0, "flood", false);
        let _run = rig.switch(0, "flood", true);
        let _reference = rig.order(
            1,
            "other",
            ModelPoint::SpeedReference,
            Value::Number(f64::from(round % 100)),
        );
        rig.step();
    }
    let ranks: Vec<Option<Urgency>> = rig.wire[from..].iter().map(|(_, turn)| turn.rank()).collect();
    let others = ranks.split(|rank| *rank == Some(Urgency::Stop));
    let polls = others.map(|others| others.iter().filter(|rank| rank.is_none()).count());
    assert!(polls.max() <= Some(2), "{ranks:?}");
    let before = ranks.split(|rank| *rank == Some(Urgency::Command)).map(<[_]>::len);
    assert!(before.max() <= Some(32), "{ranks:?}");
}

#[test]
fn a_stop_to_an_n2_drive_that_cannot_be_identified_is_answered_and_leaves_the_line() {
    let mut rig = Rig::of(2, "vacon-nx-n2", Protocol::N2);
    rig.drives[0].silent = true;
    rig.run(Duration::from_secs(10));
    assert!(rig.news.contains(&News::Offline(DriveIndex::new(0))));
    let from = rig.wire.len();
    let mut stop = rig.switch(0, "a", false);
    rig.run(Duration::from_millis(1500));
    let tries = rig.wire[from..]
        .iter()
        .filter(|(_, turn)| turn.rank().is_some())
        .count();
    assert!(tries <= 4, "{tries} times Identify for one stop");
    let is_stop = |(_, turn): &(Instant, Turn)| turn.pdu().is_write() && turn.target() == DriveIndex::new(0);
    assert!(
        rig.wire[from..].iter().any(is_stop),
        "perhaps only its replies are lost"
    );
    assert_eq!(outcome(&mut stop), Some(Outcome::TimedOut));
}

/// A drive of this family behind a Modbus TCP gateway, which has been polled for some seconds.
fn behind_a_network(family: &str) -> Rig {
    let line = BusSpec {
        port: "modbus-tcp://10.0.0.1:502".to_string(),
        cycle: Duration::from_millis(10),
        ..bus_spec("b")
    };
    let mut rig = Rig::on(line, 1, family, |spec| DriveSpec {
        supervision: None,
        ..spec
    });
    rig.drives[0].family = Some(FamilyDrive::new(&drivegate_testkit::profile(family)));
    rig.run(Duration::from_secs(5));
    rig
}

/// A network may deliver an unanswered write late, so the stop behind it is sent again; not into a start that has begun since.
#[test]
fn a_stop_is_not_sent_again_into_a_start_by_a_sequence() {
    for family in ["abb-acs580", "siemens-g120", "schneider-altivar"] {
        let mut rig = behind_a_network(family);
        rig.drives[0].next_write = Some(Ended::Silent);
        rig.order(0, "a", ModelPoint::SpeedReference, Value::Number(30.0));
        rig.run(Duration::from_millis(300));
        let stop = rig.now;
        rig.switch(0, "a", false);
        rig.run(Duration::from_millis(400));
        let pending = rig.master.drives[0].repeated_stops.is_any();
        assert!(pending, "{family}: the stop is to be sent again");
        // The first word of the sequence has been sent when the stop is due, and the drive has not shown its state yet.
        rig.now = rig.now.max(stop + Duration::from_millis(940));
        let mut start = rig.switch(0, "a", true);
        let outcome = loop {
            rig.step();
            if let Some(outcome) = outcome(&mut start) {
                break outcome;
            }
            assert!(rig.now < stop + Duration::from_secs(9), "{family}: no answer");
        };
        assert!(outcome.is_ok(), "{family}: {outcome}");
        rig.run(Duration::from_secs(4));
        assert!(rig.drives[0].family.as_ref().unwrap().runs, "{family}");
    }
}

/// The last word of a start gets no reply, so a stop follows; the word may arrive later, and the stop is sent again behind it.
#[test]
fn the_stop_behind_a_start_that_failed_is_sent_again() {
    for family in ["abb-acs580", "siemens-g120", "schneider-altivar"] {
        let mut rig = behind_a_network(family);
        let profile = drivegate_testkit::profile(family);
        let control = profile.control.as_ref().unwrap();
        let is_run = |turn: &Turn| {
            let items = drivegate_core::order::written(turn.pdu())
                .map(|(_, items)| items)
                .unwrap_or_default();
            items.iter().any(|(_, word)| control.is_run(control.at, *word))
        };
        let is_stop = |turn: &Turn| turn.pdu().is_write() && !is_run(turn);
        let from = rig.wire.len();
        let mut start = rig.switch(0, "a", true);
        // The motor does not run yet, and nothing of the drive is heard, when the last word is sent.
        while outcome(&mut start).is_none() {
            let tries = rig.wire[from..].iter().filter(|(_, turn)| is_run(turn)).count();
            let first_words = rig.wire[from..].iter().filter(|(_, turn)| is_stop(turn)).count();
            let last_is_next = first_words >= control_steps(control) - 1;
            rig.drives[0].next_write = (last_is_next && tries < 2).then_some(Ended::Silent);
            rig.step();
            assert!(rig.wire.len() < from + 3000, "{family}: no answer");
        }
        rig.drives[0].next_write = None;
        let stopped = rig.now;
        rig.run(Duration::from_secs(5));
        let again = rig
            .wire
            .iter()
            .filter(|(at, turn)| *at > stopped && is_stop(turn))
            .count();
        assert_eq!(again, 2, "{family}");
    }
}

fn control_steps(control: &drivegate_model::drive::control::Control) -> usize {
    match &control.run {
        drivegate_model::drive::control::Run::Steps(steps) => steps.len(),
        _ => 1,
    }
}

/// A reload ends the bus and begins another one, which knows no word of the drive.
/// A run command behind a stop that is to be sent again writes its reference, and another stop ends it before its run word:
/// the write that the network holds may still arrive, so that the stop is sent again as before.
#[test]
fn a_start_that_ends_before_its_run_word_ends_no_repeated_stop() {
    for family in ["vacon-nx", "danfoss-fc", "abb-acs580", "siemens-g120", "delta-ms300"] {
        let mut rig = behind_a_network(family);
        rig.drives[0].next_write = Some(Ended::Silent);
        rig.order(0, "a", ModelPoint::SpeedReference, Value::Number(30.0));
        rig.run(Duration::from_millis(300));
        rig.switch(0, "a", false);
        rig.run(Duration::from_millis(200));
        let pending = rig.master.drives[0].repeated_stops.is_any();
        assert!(pending, "{family}: the stop is to be sent again");
        let profile = &rig.bus.image.drives[0].spec.profile;
        let index = |point| profile.model_index(point).unwrap();
        let order = Order::Points(vec![
            (index(ModelPoint::SpeedReference), Value::Number(40.0)),
            (index(ModelPoint::Run), Value::Bool(true)),
        ]);
        let origin = Origin::new(SourceKind::Mqtt, "b");
        let window = window(rig.now, DEFAULT_EXPIRY);
        let mut start = submit(&rig.bus, DriveIndex::new(0), origin, order, window, rig.now);
        let from = rig.wire.len();
        while !rig.wire[from..].iter().any(|(_, turn)| turn.pdu().is_write()) {
            rig.step();
        }
        let mut stop = rig.switch(0, "a", false);
        while outcome(&mut stop).is_none() {
            rig.step();
        }
        assert!(outcome(&mut start).is_some_and(|outcome| !outcome.is_ok()), "{family}");
        let stopped = rig.now;
        rig.run(Duration::from_secs(5));
        let again = rig
            .wire
            .iter()
            .filter(|(at, turn)| *at > stopped && turn.pdu().is_write());
        assert_eq!(again.count(), 2, "{family}");
    }
}

#[test]
fn a_reload_keeps_the_direction_of_a_run_command_that_names_none() {
    for (family, back) in [("danfoss-fc", 0x847C), ("weg-cfw", 0x0013), ("fuji-frenic", 0x0002)] {
        let cycle = Duration::from_millis(10);
        let mut rig = Rig::empty(1, family, Protocol::ModbusRtu, cycle, |spec| DriveSpec {
            supervision: None,
            ..spec
        });
        rig.drives[0].family = Some(FamilyDrive::new(&drivegate_testkit::profile(family)));
        rig.run(Duration::from_secs(5));
        let points = |names: &[ModelPoint]| {
            let profile = &rig.bus.image.drives[0].spec.profile;
            let value = |point: &ModelPoint| (profile.model_index(*point).unwrap(), Value::Bool(true));
            Order::Points(names.iter().map(value).collect())
        };
        for (order, reloads) in [
            (points(&[ModelPoint::Run, ModelPoint::Reverse]), true),
            (points(&[ModelPoint::Run]), false),
        ] {
            let origin = Origin::new(SourceKind::Mqtt, "a");
            let window = window(rig.now, DEFAULT_EXPIRY);
            let mut answer = submit(&rig.bus, DriveIndex::new(0), origin, order, window, rig.now);
            let from = rig.wire.len();
            for _ in 0..200 {
                rig.step();
            }
            let words = rig.wire[from..]
                .iter()
                .filter_map(|(_, turn)| drivegate_core::order::written(turn.pdu()));
            let words: Vec<u16> = words.flat_map(|(_, items)| items).map(|(_, word)| word).collect();
            let outcome = outcome(&mut answer);
            assert!(
                words.contains(&back),
                "{family}, reload={reloads}: {words:04X?}, {outcome:?}"
            );
            if reloads {
                let handover = rig.master.ended(None, rig.now);
                rig.begin_anew(&handover);
                rig.run(Duration::from_secs(2));
            }
        }
    }
}

/// The gateway has just started and has read one register of a drive whose motor turns in reverse: a run command that names no
/// direction waits for the reads that show the direction, and does not reverse the motor.
#[test]
fn a_run_command_waits_until_the_direction_of_the_motor_is_read() {
    for (family, back) in [
        ("danfoss-fc", 0x847C),
        ("weg-cfw", 0x0013),
        ("fuji-frenic", 0x0002),
        ("delta-ms300", 0x0022),
    ] {
        let mut rig = Rig::empty(1, family, Protocol::ModbusRtu, Duration::from_millis(10), |spec| {
            DriveSpec {
                supervision: None,
                ..spec
            }
        });
        let mut drive = FamilyDrive::new(&drivegate_testkit::profile(family));
        drive.run();
        if family == "danfoss-fc" {
            drive.show_word(50_199, 0x0A07);
            drive.show_word(50_209, (-0x2000_i16) as u16);
            drive.show_word(50_009, 0x2000);
        } else {
            drive.show(ModelPoint::Reversed, true);
        }
        rig.drives[0].family = Some(drive);
        while !matches!(rig.bus.image.drives[0].snapshot().link, Link::Online(_)) {
            rig.step();
        }
        let mut run = rig.switch(0, "a", true);
        let outcome = loop {
            rig.step();
            if let Some(outcome) = outcome(&mut run) {
                break outcome;
            }
        };
        let words = rig
            .wire
            .iter()
            .filter_map(|(_, turn)| drivegate_core::order::written(turn.pdu()));
        let words: Vec<u16> = words.flat_map(|(_, items)| items).map(|(_, word)| word).collect();
        assert!(
            outcome.is_ok() && words == [back],
            "{family}: {words:04X?}, {outcome:?}"
        );
    }
}

/// A drive that is too busy for every read does not keep a run command waiting until its time is over.
#[test]
fn a_run_command_does_not_wait_for_a_drive_that_is_always_busy() {
    for family in ["danfoss-fc", "weg-cfw", "fuji-frenic"] {
        let mut rig = Rig::empty(1, family, Protocol::ModbusRtu, Duration::from_millis(10), |spec| {
            DriveSpec {
                supervision: None,
                ..spec
            }
        });
        rig.drives[0].family = Some(FamilyDrive::new(&drivegate_testkit::profile(family)));
        rig.drives[0].to_reads = Some(Exception::BUSY);
        while !matches!(rig.bus.image.drives[0].snapshot().link, Link::Online(_)) {
            rig.step();
        }
        let mut run = rig.switch(0, "a", true);
        rig.run(DEFAULT_EXPIRY - Duration::from_millis(100));
        let outcome = outcome(&mut run);
        assert!(outcome.as_ref().is_some_and(Outcome::is_ok), "{family}: {outcome:?}");
    }
}

/// A direction that waits for the next start, because the drive has no word for it at standstill, waits behind a reload too.
#[test]
fn a_direction_for_the_next_start_outlives_a_reload() {
    for (family, back) in [("danfoss-fc", 0x847C), ("fuji-frenic", 0x0002)] {
        let mut rig = behind_a_network(family);
        let ordered = |rig: &mut Rig, point: ModelPoint, on: bool| {
            let mut answer = rig.order(0, "a", point, Value::Bool(on));
            let from = rig.wire.len();
            while outcome(&mut answer).is_none() {
                rig.step();
                assert!(rig.wire.len() < from + 4000, "{family}: no answer to {point:?}");
            }
            rig.wire[from..]
                .iter()
                .filter_map(|(_, turn)| drivegate_core::order::written(turn.pdu()))
                .flat_map(|(_, items)| items)
                .map(|(_, word)| word)
                .collect::<Vec<u16>>()
        };
        ordered(&mut rig, ModelPoint::Run, true);
        // Stopped at its panel.
        rig.drives[0].family.as_mut().unwrap().stand();
        rig.run(Duration::from_secs(1));
        ordered(&mut rig, ModelPoint::Reverse, true);
        let handover = rig.master.ended(None, rig.now);
        rig.begin_anew(&handover);
        rig.run(Duration::from_secs(2));
        let words = ordered(&mut rig, ModelPoint::Run, true);
        assert!(words.contains(&back), "{family}: {words:04X?}");
    }
}
