//! The view of a host, compared with the rules of the specification.

use std::collections::{BTreeMap, BTreeSet};
use std::time::UNIX_EPOCH;

use super::*;
use crate::sparkplug::wire::MetricValue;

mod births;
mod chance;
mod changes;
mod outage;

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
