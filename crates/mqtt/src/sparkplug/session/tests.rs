//! The view of a host, compared with the rules of the specification.

use std::collections::{BTreeMap, BTreeSet};
use std::time::UNIX_EPOCH;

use super::*;
use crate::sparkplug::wire::MetricValue;

mod chance;

const STATE: &str = r#"{"online": ONLINE, "timestamp": TIME}"#;

fn rules(primary_host: &str) -> Rules {
    Rules {
        topics: Topics::new("plant", "hall", primary_host),
        alias: true,
        history: true,
        min_interval: Duration::from_millis(50),
    }
}

/// Rules without history, for tests of everything else.
fn live() -> Rules {
    Rules {
        history: false,
        ..rules("")
    }
}

fn definitions(names: &[&str]) -> Vec<Definition> {
    let of = |name: &&str| Definition::new(name, DataType::Double);
    names.iter().map(of).collect()
}

fn sample(number: f64, time: u64) -> Sample {
    Sample {
        value: Some(Datum::Number(number)),
        quality: Quality::Good,
        time,
    }
}

/// A session with a clock, watched by a host.
struct SessionWithHost {
    session: Session,
    start: Instant,
    /// Time since the start, ms.
    time: u64,
    /// Time from the message that the host is online to the births, ms.
    births_after: u64,
    host: Watcher,
}

/// A host that checks the node: its knowledge of the node, and every rule that a host can check.
#[derive(Default)]
struct Watcher {
    seq: Option<u64>,
    bd_seq: Option<u8>,
    /// Alias to device and name, as of the last births.
    aliases: BTreeMap<u64, (String, String)>,
    /// All aliases that were used so far.
    ever: BTreeMap<u64, (String, String)>,
    born: BTreeSet<String>,
    births: usize,
    /// The last values, and the values received as history, with their times.
    values: BTreeMap<(String, String), (f64, u64)>,
    past: Vec<(String, String, f64, u64)>,
    deaths: Vec<String>,
    /// Types of the received messages in order.
    order: Vec<(Kind, Option<String>)>,
}

impl Watcher {
    /// A new connection with this last will.
    fn connect(&mut self, will: &Packet) {
        assert_eq!((will.kind, will.payload.seq), (Kind::NodeDeath, None));
        self.bd_seq = Some(bd_seq(&will.payload));
        self.seq = None;
        self.born.clear();
        self.aliases.clear();
    }

    fn see(&mut self, packet: &Packet) {
        self.order.push((packet.kind, packet.device.clone()));
        assert!(packet.payload.timestamp.is_some());
        if packet.kind == Kind::NodeDeath {
            assert_eq!((packet.payload.seq, Some(bd_seq(&packet.payload))), (None, self.bd_seq));
            return;
        }
        let seq = packet.payload.seq.expect("a sequence number");
        if packet.kind == Kind::NodeBirth {
            assert_eq!(seq, 0, "the birth of the node begins the sequence");
            assert_eq!(Some(bd_seq(&packet.payload)), self.bd_seq, "the number of the will");
            self.born.clear();
            self.births += 1;
        } else {
            let expected = self.seq.map(|seq| (seq + 1) % 256);
            assert_eq!(Some(seq), expected, "no gap, and nothing before the birth of the node");
        }
        self.seq = Some(seq);
        let device = packet.device.clone().unwrap_or_default();
        match packet.kind {
            Kind::NodeBirth => self.birth(&device, &packet.payload),
            Kind::DeviceBirth => {
                assert!(self.born.insert(device.clone()), "{device} was not dead");
                self.birth(&device, &packet.payload);
            }
            Kind::DeviceDeath => {
                // A device that was removed may have been declared dead already by a birth of the node.
                self.born.remove(&device);
                self.deaths.push(device);
                assert_eq!(packet.payload.metrics, []);
            }
            Kind::DeviceData | Kind::NodeData => {
                assert!(
                    device.is_empty() || self.born.contains(&device),
                    "data of {device} without its birth"
                );
                self.data(&device, &packet.payload);
            }
            Kind::NodeDeath => unreachable!(),
        }
    }

    fn birth(&mut self, device: &str, payload: &Payload) {
        for metric in &payload.metrics {
            let name = metric.name.clone().expect("births have names");
            assert!(metric.timestamp.is_some() && metric.datatype.is_some(), "{name}");
            assert_eq!(metric.is_historical, None);
            if device.is_empty() && (name == "bdSeq" || name == REBIRTH_METRIC) {
                assert_eq!(metric.alias, None, "{name} has no alias");
                continue;
            }
            let alias = metric.alias.expect("an alias");
            let of = (device.to_string(), name.clone());
            let known = self.ever.entry(alias).or_insert_with(|| of.clone());
            assert_eq!(*known, of, "alias {alias} was used for another metric");
            self.aliases.insert(alias, of.clone());
            self.note(of, metric);
        }
    }

    fn data(&mut self, device: &str, payload: &Payload) {
        assert!(!payload.metrics.is_empty());
        for metric in &payload.metrics {
            assert_eq!(metric.name, None, "an alias replaces the name");
            assert!(metric.timestamp.is_some() && metric.datatype.is_some());
            let alias = metric.alias.expect("an alias");
            let of = self.aliases.get(&alias).expect("an alias of a birth").clone();
            assert_eq!(of.0, device);
            match (metric.is_historical, &metric.value) {
                (Some(true), Some(MetricValue::Double(number))) => {
                    self.past.push((of.0, of.1, *number, metric.timestamp.unwrap()));
                }
                (Some(true), _) => {}
                _ => self.note(of, metric),
            }
        }
    }

    fn note(&mut self, of: (String, String), metric: &Metric) {
        match &metric.value {
            Some(MetricValue::Double(number)) => {
                self.values.insert(of, (*number, metric.timestamp.unwrap()));
            }
            _ => assert_eq!(metric.is_null, Some(true)),
        }
    }
}

fn bd_seq(payload: &Payload) -> u8 {
    let metric = payload.metrics.iter().find(|m| m.name.as_deref() == Some("bdSeq"));
    let metric = metric.expect("bdSeq");
    assert_eq!(metric.datatype, Some(DataType::Int64.code()));
    match metric.value {
        Some(MetricValue::Long(number)) => u8::try_from(number).unwrap(),
        _ => panic!("{metric:?}"),
    }
}

impl SessionWithHost {
    fn new(rules: Rules, devices: usize) -> SessionWithHost {
        let mut bench = SessionWithHost {
            session: Session::new(rules),
            start: Instant::now(),
            time: 1_000,
            births_after: 0,
            host: Watcher::default(),
        };
        let devices = (0..devices).map(|n| (format!("p{n}"), definitions(&["a", "b"])));
        bench.session.adopt(definitions(&["Bus/line1/load"]), devices.collect());
        bench.session.set_node(vec![sample(0.5, 1_000)]);
        bench
    }

    fn tick(&self) -> Moment {
        Moment {
            now: self.start + Duration::from_millis(self.time),
            wall: UNIX_EPOCH + Duration::from_millis(self.time),
        }
    }

    fn tell(&mut self, device: usize, present: bool, number: f64) {
        let samples = vec![sample(number, self.time), sample(1.0, 1_000)];
        let now = self.tick().now;
        self.session.set_device(device, present, samples, now);
    }

    fn connect(&mut self, bd_seq: u8) {
        self.host.connect(&self.session.will(bd_seq, self.tick()));
        self.session.opened(bd_seq, usize::MAX);
    }

    fn state(&mut self, online: bool, time: u64) -> bool {
        let state = STATE
            .replace("ONLINE", &online.to_string())
            .replace("TIME", &time.to_string());
        let at = self.tick().now + Duration::from_millis(self.births_after);
        self.session
            .host_state(StateForm::Object, state.as_bytes(), at)
            .unwrap()
    }

    /// Number of waiting values of an outage.
    fn send(&mut self, most: usize) -> usize {
        let tick = self.tick();
        for count in 0..most {
            match self.session.next(tick) {
                Ok(packet) => self.host.see(&packet),
                Err(due) => {
                    assert!(due.is_none_or(|due| due > tick.now), "due at once means a message");
                    return count;
                }
            }
        }
        most
    }

    /// Values of an outage that wait.
    fn waiting(&self) -> usize {
        self.session.devices.iter().map(|device| device.history.len()).sum()
    }

    fn value(&self, device: &str, name: &str) -> Option<f64> {
        let value = self.host.values.get(&(device.to_string(), name.to_string()));
        value.map(|(number, _)| *number)
    }

    fn kinds(&mut self) -> Vec<(Kind, String)> {
        let order = std::mem::take(&mut self.host.order);
        order
            .into_iter()
            .map(|(kind, device)| (kind, device.unwrap_or_default()))
            .collect()
    }
}

fn of(kind: Kind, device: &str) -> (Kind, String) {
    (kind, device.to_string())
}

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
