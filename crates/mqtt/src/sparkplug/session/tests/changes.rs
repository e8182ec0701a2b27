//! Changes of values, and of the configuration.

use super::*;

#[test]
fn changes_keep_their_distance() {
    let mut bench = SessionWithHost::new(live(), 1);
    bench.tell(0, true, 1.0);
    bench.connect(0);
    bench.session.subscribed();
    bench.send(9);
    bench.kinds();
    bench.time += 20;
    bench.tell(0, true, 2.0);
    let tick = bench.tick();
    let due = tick.now + Duration::from_millis(30);
    assert_eq!(bench.session.next(tick), Err(Some(due)));
    bench.time += 30;
    bench.tell(0, true, 3.0);
    bench.send(9);
    assert_eq!(
        (bench.kinds(), bench.value("p0", "a")),
        (vec![of(Kind::DeviceData, "p0")], Some(3.0))
    );
    // The value returns to the one last sent before a message is due, so nothing is sent.
    bench.time += 10;
    bench.tell(0, true, 4.0);
    bench.tell(0, true, 3.0);
    bench.time += 100;
    assert_eq!(bench.send(9), 0);
    // A value that a client tried to change is published again.
    bench.session.repeat(0, [0, 0]);
    bench.send(9);
    assert_eq!(bench.kinds(), [of(Kind::DeviceData, "p0")]);
}

#[test]
fn a_reload_keeps_aliases_and_bears_anew() {
    let mut bench = SessionWithHost::new(live(), 2);
    bench.tell(0, true, 1.0);
    bench.tell(1, true, 1.0);
    bench.connect(0);
    bench.session.subscribed();
    bench.send(9);
    bench.kinds();
    let known = bench.host.ever.clone();
    let node = definitions(&["Bus/line1/load"]);
    let same = || {
        vec![
            ("p0".to_string(), definitions(&["a", "b"])),
            ("p1".to_string(), definitions(&["a", "b"])),
        ]
    };
    bench.session.adopt(node.clone(), same());
    bench.time += 1_000;
    assert_eq!(bench.send(9), 0, "nothing changed");
    let devices = vec![
        ("p1".to_string(), definitions(&["a", "c"])),
        ("p2".to_string(), definitions(&["a"])),
    ];
    bench.session.adopt(node, devices);
    bench.session.set_node(vec![sample(0.5, bench.time)]);
    bench.tell(0, true, 5.0);
    let now = bench.tick().now;
    bench.session.set_device(1, true, vec![sample(6.0, bench.time)], now);
    bench.send(9);
    let expected = [
        of(Kind::DeviceDeath, "p0"),
        of(Kind::NodeBirth, ""),
        of(Kind::DeviceBirth, "p1"),
        of(Kind::DeviceBirth, "p2"),
    ];
    assert_eq!(bench.kinds(), expected);
    let alias = |all: &BTreeMap<u64, (String, String)>, device: &str, name: &str| {
        let is = |(_, of): &(&u64, &(String, String))| of.0 == device && of.1 == name;
        all.iter().find(is).map(|(alias, _)| *alias)
    };
    let (before, after) = (&known, &bench.host.ever);
    assert_eq!(alias(before, "p1", "a"), alias(after, "p1", "a"));
    assert_eq!(after.len(), known.len() + 2, "p1/c and p2/a");
}

#[test]
fn names_replace_aliases_where_they_are_off() {
    let mut bench = SessionWithHost::new(
        Rules {
            alias: false,
            ..rules("")
        },
        1,
    );
    bench.tell(0, true, 1.0);
    bench.session.opened(0, usize::MAX);
    bench.session.subscribed();
    let mut names = Vec::new();
    for _ in 0..2 {
        while let Ok(packet) = bench.session.next(bench.tick()) {
            for metric in packet.payload.metrics {
                assert_eq!(metric.alias, None);
                names.push(metric.name.unwrap());
            }
        }
        bench.time += 100;
        bench.tell(0, true, 2.0);
    }
    assert_eq!(
        names,
        ["bdSeq", REBIRTH_METRIC, "Bus/line1/load", "a", "b", "a", "b", "a"]
    );
    assert_eq!(bench.session.metric(0, Some("b"), None), Some(1));
    assert_eq!(bench.session.metric(0, None, Some(1)), None);
}
