//! Births: when they are due, and what they contain.

use super::*;

#[test]
fn births_come_first_and_only_of_devices_that_are_there() {
    let mut bench = SessionWithHost::new(live(), 3);
    bench.tell(0, true, 1.0);
    bench.tell(2, true, 2.0);
    assert_eq!(bench.send(9), 0, "there is no connection");
    bench.connect(7);
    assert_eq!(bench.send(9), 0, "nothing before the subscriptions stand");
    bench.session.subscribed();
    bench.send(9);
    let births = [
        of(Kind::NodeBirth, ""),
        of(Kind::DeviceBirth, "p0"),
        of(Kind::DeviceBirth, "p2"),
    ];
    assert_eq!(bench.kinds(), births);
    bench.time += 100;
    bench.tell(0, true, 1.0);
    assert_eq!(bench.send(9), 0, "nothing changed");
    bench.tell(0, true, 3.0);
    bench.tell(1, true, 4.0);
    bench.tell(2, false, 5.0);
    bench.send(9);
    let expected = [
        of(Kind::DeviceData, "p0"),
        of(Kind::DeviceBirth, "p1"),
        of(Kind::DeviceDeath, "p2"),
    ];
    assert_eq!(bench.kinds(), expected);
    assert_eq!((bench.value("p0", "a"), bench.value("p1", "a")), (Some(3.0), Some(4.0)));
    bench.tell(2, true, 6.0);
    bench.send(9);
    assert_eq!(bench.kinds(), [of(Kind::DeviceBirth, "p2")]);
    // The drive is lost and returns before anything was sent; its death is sent in any case.
    bench.tell(2, false, 6.0);
    bench.tell(2, true, 6.0);
    bench.send(9);
    assert_eq!(
        bench.kinds(),
        [of(Kind::DeviceDeath, "p2"), of(Kind::DeviceBirth, "p2")]
    );
}

#[test]
fn a_rebirth_stops_data_and_repeats_all_births() {
    let mut bench = SessionWithHost::new(live(), 2);
    bench.tell(0, true, 1.0);
    bench.tell(1, true, 1.0);
    bench.connect(3);
    bench.session.subscribed();
    bench.send(9);
    bench.kinds();
    bench.time += 100;
    bench.tell(0, true, 2.0);
    bench.session.request_birth();
    bench.session.request_birth();
    let tick = bench.tick();
    let due = bench.start + Duration::from_millis(1_000) + REBIRTH;
    assert_eq!(bench.session.next(tick), Err(Some(due)), "no data meanwhile");
    bench.time = 1_250;
    bench.send(1);
    // A request during the births is served after them.
    bench.session.request_birth();
    bench.send(9);
    let births = [
        of(Kind::NodeBirth, ""),
        of(Kind::DeviceBirth, "p0"),
        of(Kind::DeviceBirth, "p1"),
    ];
    assert_eq!((bench.kinds(), bench.value("p0", "a")), (births.to_vec(), Some(2.0)));
    bench.time += 250;
    bench.send(9);
    assert_eq!(bench.kinds(), births);
    bench.time += 1_000;
    assert_eq!(bench.send(9), 0);
}

/// Names and nulls of the metrics of the next message, which is of this kind.
fn next_metrics(session: &mut Session, kind: Kind, tick: Moment) -> Vec<(String, bool)> {
    let packet = session.next(tick).unwrap();
    assert_eq!(packet.kind, kind);
    let metrics = packet.payload.metrics.into_iter();
    metrics
        .map(|metric| (metric.name.unwrap_or_default(), metric.is_null == Some(true)))
        .collect()
}

#[test]
fn births_have_every_metric_though_nothing_is_known_yet() {
    let mut session = Session::new(live());
    session.adopt(definitions(&["Bus/line1/state", "Bus/line1/load"]), vec![]);
    session.opened(0, usize::MAX);
    session.subscribed();
    let now = Moment::present();
    let metrics = next_metrics(&mut session, Kind::NodeBirth, now);
    let expected = [
        ("bdSeq", false),
        (REBIRTH_METRIC, false),
        ("Bus/line1/state", true),
        ("Bus/line1/load", true),
    ];
    assert_eq!(metrics, expected.map(|(name, null)| (name.to_string(), null)));
    session.set_node(vec![sample(1.0, 8), sample(2.0, 8)]);
    let later = Moment {
        now: now.now + Duration::from_secs(2),
        ..now
    };
    let metrics = next_metrics(&mut session, Kind::NodeData, later);
    assert_eq!(metrics.len(), 2, "what becomes known is told");
}

#[test]
fn what_was_left_out_of_a_birth_is_in_no_data() {
    let mut session = Session::new(live());
    let names = ["a", "b", "c"];
    session.adopt(vec![], vec![("p1".to_string(), definitions(&names))]);
    session.opened(0, 1000);
    session.subscribed();
    let start = Instant::now();
    let at = |s: u64| Moment {
        now: start + Duration::from_secs(s),
        wall: UNIX_EPOCH + Duration::from_secs(s),
    };
    let tell = |session: &mut Session, number: f64| {
        let samples = (0..3).map(|_| sample(number, 1)).collect();
        session.set_device(0, true, samples, start);
    };
    tell(&mut session, 1.0);
    next_metrics(&mut session, Kind::NodeBirth, at(0));
    assert_eq!(next_metrics(&mut session, Kind::DeviceBirth, at(0)).len(), 3);
    session.keep(Some("p1"), 2);
    tell(&mut session, 2.0);
    session.repeat(0, [2]);
    assert_eq!(next_metrics(&mut session, Kind::DeviceData, at(10)).len(), 2);
    assert!(session.next(at(20)).is_err());
    session.request_birth();
    next_metrics(&mut session, Kind::NodeBirth, at(30));
    assert_eq!(next_metrics(&mut session, Kind::DeviceBirth, at(30)).len(), 2);
    session.opened(1, usize::MAX);
    session.subscribed();
    next_metrics(&mut session, Kind::NodeBirth, at(40));
    assert_eq!(next_metrics(&mut session, Kind::DeviceBirth, at(40)).len(), 3);
}

#[test]
fn births_wait_for_their_time_after_the_host_came_online() {
    let rules = Rules {
        history: false,
        ..rules("scada")
    };
    let mut bench = SessionWithHost::new(rules, 1);
    (bench.births_after, bench.time) = (1_500, 10_000);
    bench.tell(0, true, 1.0);
    bench.connect(0);
    bench.session.subscribed();
    assert!(!bench.state(true, 100));
    bench.time = 11_499;
    let due = bench.session.next(bench.tick()).unwrap_err();
    assert_eq!(due, Some(bench.start + Duration::from_millis(11_500)));
    // Offline before the births: the connection ends, and nothing was sent.
    assert!(bench.state(false, 101), "the connection is given up");
    bench.connect(1);
    bench.session.subscribed();
    assert!(!bench.state(true, 102));
    bench.time = 12_998;
    assert_eq!(bench.send(9), 0);
    bench.time = 12_999;
    assert_eq!(bench.send(9), 2, "the births of the node and its device");
}
