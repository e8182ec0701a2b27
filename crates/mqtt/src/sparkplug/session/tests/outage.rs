//! The primary host, and values of the time without it.

use super::*;

#[test]
fn the_primary_host_opens_and_ends_the_session() {
    let mut bench = SessionWithHost::new(rules("scada"), 1);
    bench.tell(0, true, 1.0);
    bench.connect(0);
    assert!(!bench.state(false, 100));
    bench.session.subscribed();
    assert!(bench.session.is_waiting());
    assert_eq!(bench.send(9), 0);
    bench.time += 100;
    bench.tell(0, true, 2.0);
    assert!(!bench.state(true, 99), "it is older than the last");
    assert_eq!(bench.send(9), 0);
    assert!(!bench.state(true, 100));
    bench.send(9);
    let kinds = [
        of(Kind::NodeBirth, ""),
        of(Kind::DeviceBirth, "p0"),
        of(Kind::DeviceData, "p0"),
    ];
    assert_eq!(bench.kinds(), kinds, "and the history");
    let numbers: Vec<(f64, u64)> = bench
        .host
        .past
        .iter()
        .filter(|p| p.1 == "a")
        .map(|p| (p.2, p.3))
        .collect();
    assert_eq!(numbers, [(1.0, 1_000), (2.0, 1_100)]);
    assert!(!bench.state(true, 101));
    assert!(!bench.state(false, 100), "it is older than the last");
    assert!(bench.state(false, 101), "the connection is given up");
    let death = bench.session.end(bench.tick());
    bench.host.see(&death);
    assert_eq!(bench.send(9), 0);
    // The next connection waits for a new state message.
    bench.connect(1);
    bench.session.subscribed();
    assert_eq!(bench.send(9), 0);
    assert!(!bench.state(true, 50), "the clock of the host may have been set back");
    assert_eq!(bench.send(2), 2);
}

#[test]
fn an_outage_is_told_afterwards_in_order() {
    let mut bench = SessionWithHost::new(rules(""), 2);
    bench.tell(0, true, 0.0);
    bench.tell(1, true, 0.0);
    bench.connect(0);
    bench.session.subscribed();
    bench.send(9);
    while bench.send(9) > 0 || bench.waiting() > 0 {
        bench.time += 25;
    }
    bench.host.past.clear();
    bench.session.closed();
    let (mut expected, begun) = (Vec::new(), bench.time);
    for step in 1..=600u32 {
        bench.time += 60;
        bench.tell(0, true, f64::from(step));
        // The value is unchanged, so nothing is recorded.
        bench.tell(1, true, 0.0);
        expected.push((f64::from(step), bench.time));
    }
    assert_eq!(bench.waiting(), 600);
    bench.connect(1);
    bench.session.subscribed();
    bench.kinds();
    bench.send(9);
    assert_eq!(bench.kinds().last(), Some(&of(Kind::DeviceData, "p0")));
    assert_eq!(bench.value("p0", "a"), Some(600.0), "the birth has the value of now");
    bench.time += 10;
    assert_eq!(bench.send(9), 0, "live values have the connection in between");
    while bench.waiting() > 0 {
        bench.time += 25;
        bench.send(9);
    }
    let seen: Vec<(f64, u64)> = bench.host.past.iter().map(|p| (p.2, p.3)).collect();
    assert!(begun < seen[0].1 && seen == expected, "{seen:?}");
    assert_eq!(bench.session.take_lost(), 0);
}

#[test]
fn what_there_is_no_room_for_is_counted() {
    let mut bench = SessionWithHost::new(rules(""), HISTORY / 5);
    for step in 0..10u32 {
        bench.time += 100;
        bench.tell(0, true, f64::from(step));
    }
    // Two metrics are recorded first, then one at a time; the session keeps five.
    assert_eq!((bench.waiting(), bench.session.take_lost()), (5, 6));
    let mut off = SessionWithHost::new(
        Rules {
            history: false,
            ..rules("")
        },
        1,
    );
    off.tell(0, true, 1.0);
    assert_eq!(off.waiting(), 0);
}
