//! Decides when a topic is published: on change, but not before `min_interval`, and at the latest after `max_interval`.
//! Time is an argument.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use super::payload::{self, BusFigures, BusState, PointPayload, StateContent, StateObject, Topics};
use crate::drive::ModelPoint;
use crate::plant::{BusHandle, DriveHandle, Plant};

/// Minimum time between publications because counters or load of a bus changed, which they do all the time.
const FIGURES_INTERVAL: Duration = Duration::from_secs(1);

/// A retained message to be published.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Update {
    pub(super) topic: Arc<str>,
    pub(super) payload: Vec<u8>,
}

/// Observes the process image and returns what is to be published.
#[derive(Debug)]
pub(super) struct Publisher {
    topics: Topics,
    pace: PublishInterval,
    drives: Vec<DriveTopics>,
    buses: Vec<BusTopic>,
    /// Topics of drives and buses that are no longer configured, to be cleared at the broker.
    vanished: BTreeSet<Arc<str>>,
    vanished_cleared: bool,
}

#[derive(Debug, Clone, Copy)]
struct PublishInterval {
    min: Duration,
    max: Duration,
}

impl PublishInterval {
    /// Whether `current` is published now, if the last publication and its time were `last`.
    fn is_due<T: PartialEq>(self, last: Option<&(T, Instant)>, current: &T, now: Instant) -> bool {
        last.is_none_or(|(last, at)| {
            let since = now.saturating_duration_since(*at);
            since >= self.max || last != current && since >= self.min
        })
    }
}

#[derive(Debug)]
struct DriveTopics {
    drive: DriveHandle,
    state: Arc<str>,
    /// Index in the profile and name of each published point.
    indices: Vec<usize>,
    names: Vec<String>,
    last: Option<(StateContent, Instant)>,
    points: Vec<PointTopic>,
}

#[derive(Debug)]
struct PointTopic {
    topic: Arc<str>,
    source: PointSource,
    last: Option<(PointPayload, Instant)>,
}

#[derive(Debug, Clone, Copy)]
enum PointSource {
    /// Index in [`StateContent::points`].
    Point(usize),
    State,
    FaultText,
}

#[derive(Debug)]
struct BusTopic {
    bus: BusHandle,
    topic: Arc<str>,
    /// As last published.
    state: Option<(BusState, Instant)>,
    figures: Option<(BusFigures, Instant)>,
}

impl Publisher {
    /// `min` and `max` as configured.
    pub(super) fn new(topics: Topics, min: Duration, max: Duration) -> Publisher {
        Publisher {
            topics,
            pace: PublishInterval { min, max },
            drives: Vec::new(),
            buses: Vec::new(),
            vanished: BTreeSet::new(),
            vanished_cleared: false,
        }
    }

    /// Observes this plant from now on; publishes everything again and clears the topics that no longer exist.
    pub(super) fn adopt(&mut self, plant: &Plant) {
        let old: Vec<Arc<str>> = self.all_topics().cloned().collect();
        self.drives = plant
            .drives()
            .map(|drive| DriveTopics::new(&self.topics, drive))
            .collect();
        let bus_topic = |bus: &BusHandle| BusTopic {
            bus: bus.clone(),
            topic: self.topics.bus(&bus.image.spec.name).into(),
            state: None,
            figures: None,
        };
        self.buses = plant.buses.iter().map(bus_topic).collect();
        let present: BTreeSet<Arc<str>> = self.all_topics().cloned().collect();
        self.vanished.extend(old);
        self.vanished.retain(|topic| !present.contains(topic));
        self.vanished_cleared = false;
    }

    fn all_topics(&self) -> impl Iterator<Item = &Arc<str>> {
        let drives = self
            .drives
            .iter()
            .flat_map(|d| d.points.iter().map(|p| &p.topic).chain([&d.state]));
        drives.chain(self.buses.iter().map(|b| &b.topic))
    }

    /// Publishes everything again, since the broker may have lost it.
    pub(super) fn restart(&mut self) {
        self.vanished_cleared = false;
        for drive in &mut self.drives {
            drive.last = None;
            drive.points.iter_mut().for_each(|p| p.last = None);
        }
        self.buses.iter_mut().for_each(|b| (b.state, b.figures) = (None, None));
    }

    /// The messages to publish now; `wall` is the time of day at `now`.
    pub(super) fn tick(&mut self, now: Instant, wall: SystemTime) -> Vec<Update> {
        let mut updates = Vec::new();
        if !std::mem::replace(&mut self.vanished_cleared, true) {
            updates.extend(self.vanished.iter().map(|topic| Update {
                topic: topic.clone(),
                payload: Vec::new(),
            }));
        }
        for drive in &mut self.drives {
            drive.tick(self.pace, now, wall, &mut updates);
        }
        for bus in &mut self.buses {
            bus.tick(self.pace, now, wall, &mut updates);
        }
        updates
    }
}

impl DriveTopics {
    fn new(topics: &Topics, drive: DriveHandle) -> DriveTopics {
        let spec = &drive.image.spec;
        let published = payload::published_points(&spec.profile);
        let topic = |name: &str, source| PointTopic {
            topic: topics.point(&spec.name, name).into(),
            source,
            last: None,
        };
        let mut points: Vec<_> = published
            .iter()
            .enumerate()
            .map(|(place, (_, name))| topic(name, PointSource::Point(place)))
            .collect();
        points.push(topic("state", PointSource::State));
        if spec.profile.model_index(ModelPoint::FaultCode).is_some() {
            points.push(topic("fault_text", PointSource::FaultText));
        }
        DriveTopics {
            state: topics.drive(&spec.name, "state").into(),
            indices: published.iter().map(|(index, _)| *index).collect(),
            names: published.iter().map(|(_, name)| (*name).to_string()).collect(),
            last: None,
            points,
            drive,
        }
    }

    fn tick(&mut self, pace: PublishInterval, now: Instant, wall: SystemTime, updates: &mut Vec<Update>) {
        let reading = self.drive.reading(now);
        let shown = StateContent::of(&reading, self.indices.iter().copied());
        for point in &mut self.points {
            let payload = match point.source {
                PointSource::Point(place) => PointPayload::of(shown.points.get(place).and_then(|(value, _)| *value)),
                PointSource::State => PointPayload::state(shown.state),
                PointSource::FaultText => PointPayload::fault_text(&reading),
            };
            if point.due(pace, now, payload) {
                point.last = Some((payload, now));
                updates.push(Update {
                    topic: point.topic.clone(),
                    payload: payload.render(&reading.spec.profile),
                });
            }
        }
        if pace.is_due(self.last.as_ref(), &shown, now) {
            let object = StateObject {
                shown: &shown,
                names: &self.names,
                indices: &self.indices,
                profile: &reading.spec.profile,
                fault_text: reading.fault_text(),
                age: reading.age(),
                wall,
            };
            // Strings, numbers and null can always be serialized.
            if let Ok(payload) = serde_json::to_vec(&object) {
                updates.push(Update {
                    topic: self.state.clone(),
                    payload,
                });
            }
            self.last = Some((shown, now));
        }
    }
}

impl PointTopic {
    /// A value that is no longer good is cleared at once, and only once.
    fn due(&self, pace: PublishInterval, now: Instant, payload: PointPayload) -> bool {
        match (&self.last, payload) {
            (Some((last, _)), PointPayload::Nothing) => *last != PointPayload::Nothing,
            (last, _) => pace.is_due(last.as_ref(), &payload, now),
        }
    }
}

impl BusTopic {
    fn tick(&mut self, pace: PublishInterval, now: Instant, wall: SystemTime, updates: &mut Vec<Update>) {
        let (state, figures) = payload::bus_now(&self.bus);
        let slower = PublishInterval {
            min: pace.min.max(FIGURES_INTERVAL),
            ..pace
        };
        let due = pace.is_due(self.state.as_ref(), &state, now);
        if due || slower.is_due(self.figures.as_ref(), &figures, now) {
            updates.push(Update {
                topic: self.topic.clone(),
                payload: payload::bus_object(&state, &figures, wall),
            });
            (self.state, self.figures) = (Some((state, now)), Some((figures, now)));
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::Value as Json;

    use super::super::fixture;
    use super::*;
    use crate::codec::{Exception, Table};
    use crate::process_image::Link;

    struct Bench {
        plant: Plant,
        publisher: Publisher,
        now: Instant,
        wall: SystemTime,
    }

    impl Bench {
        /// Drives `p1` (running at 25 Hz) and `p2` (never read); 100 ms to 60 s.
        fn new() -> Bench {
            let plant = fixture::plant(&["p1", "p2"]);
            let topics = Topics::new("drivegate", "hall");
            let mut publisher = Publisher::new(topics, Duration::from_millis(100), Duration::from_secs(60));
            publisher.adopt(&plant);
            let bench = Bench {
                plant,
                publisher,
                now: Instant::now(),
                wall: SystemTime::UNIX_EPOCH + Duration::from_millis(1_700_000_000_500),
            };
            bench.read(0x0023, 2500);
            bench
        }

        fn read(&self, status: u16, frequency: u16) {
            fixture::read(&self.plant, "p1", status, frequency, self.now);
        }

        /// Lets time pass, then publishes; topics below `drivegate/hall/`.
        fn after(&mut self, ms: u64) -> Vec<(String, String)> {
            self.now += Duration::from_millis(ms);
            self.wall += Duration::from_millis(ms);
            let text = |update: Update| {
                let topic = update.topic.strip_prefix("drivegate/hall/").unwrap().to_string();
                (topic, String::from_utf8(update.payload).unwrap())
            };
            self.publisher.tick(self.now, self.wall).into_iter().map(text).collect()
        }
    }

    fn payload<'u>(updates: &'u [(String, String)], topic: &str) -> Option<&'u str> {
        updates.iter().find(|(t, _)| t == topic).map(|(_, p)| p.as_str())
    }

    fn topics(updates: &[(String, String)]) -> Vec<&str> {
        updates.iter().map(|(t, _)| t.as_str()).collect()
    }

    #[test]
    fn the_state_object_has_values_quality_and_time() {
        let mut bench = Bench::new();
        let all = bench.after(20);
        let state: Json = serde_json::from_str(payload(&all, "drive/p1/state").unwrap()).unwrap();
        assert_eq!(state["state"], "running");
        assert_eq!(state["quality"], "good");
        assert_eq!(state["time"], "2023-11-14T22:13:20.500Z");
        assert_eq!(state["age_ms"], 20);
        assert_eq!(state["fault_text"], "");
        assert_eq!(state["output_frequency"], 25.0);
        assert_eq!(state["running"], true);
        assert_eq!(state["fault_code"], 0);
        assert_eq!(state["flux_ready"], false, "points of the profile too");
        assert_eq!(state["heatsink_temperature"], Json::Null, "never read");
        assert_eq!(state["point_quality"]["heatsink_temperature"], "bad");
        assert_eq!(state["point_quality"].get("running"), None);
        let other: Json = serde_json::from_str(payload(&all, "drive/p2/state").unwrap()).unwrap();
        assert_eq!((&other["state"], &other["quality"]), (&"offline".into(), &"bad".into()));
        assert_eq!((&other["time"], &other["age_ms"]), (&Json::Null, &Json::Null));
        assert_eq!(other.get("point_quality"), None, "all are bad, as the drive");
    }

    #[test]
    fn point_topics_carry_bare_values_and_nothing_that_is_not_good() {
        let mut bench = Bench::new();
        let all = bench.after(0);
        for (point, value) in [
            ("running", "true"),
            ("fault", "false"),
            ("output_frequency", "25"),
            ("motor_current", "1.2"),
            ("fault_code", "0"),
            ("state", "running"),
            ("fault_text", ""),
            ("heatsink_temperature", ""),
        ] {
            assert_eq!(
                payload(&all, &format!("drive/p1/point/{point}")),
                Some(value),
                "{point}"
            );
        }
        assert_eq!(payload(&all, "drive/p2/point/running"), Some(""));
        assert_eq!(payload(&all, "drive/p2/point/state"), Some("offline"));
        // Stale after 1 s: cleared at once, and only once.
        let stale = bench.after(1001);
        assert_eq!(payload(&stale, "drive/p1/point/output_frequency"), Some(""));
        assert_eq!(payload(&stale, "drive/p1/point/state"), Some("offline"));
        assert!(
            payload(&stale, "drive/p1/state")
                .unwrap()
                .contains("\"quality\":\"stale\"")
        );
        assert_eq!(payload(&stale, "drive/p1/point/heatsink_temperature"), None);
        assert_eq!(topics(&bench.after(100)), Vec::<&str>::new());
    }

    #[test]
    fn changes_wait_for_min_interval() {
        let mut bench = Bench::new();
        bench.after(0);
        bench.read(0x0023, 2501);
        assert_eq!(topics(&bench.after(99)), Vec::<&str>::new());
        bench.read(0x0023, 2502);
        let changed = bench.after(1);
        assert_eq!(topics(&changed), ["drive/p1/point/output_frequency", "drive/p1/state"]);
        assert_eq!(payload(&changed, "drive/p1/point/output_frequency"), Some("25.02"));
        bench.read(0x0023, 2502);
        assert_eq!(
            topics(&bench.after(500)),
            Vec::<&str>::new(),
            "read again, nothing changed"
        );
    }

    #[test]
    fn good_values_are_repeated_after_max_interval() {
        let mut bench = Bench::new();
        bench.after(0);
        bench.now += Duration::from_secs(60);
        bench.read(0x0023, 2500);
        let all = bench.after(0);
        assert_eq!(payload(&all, "drive/p1/point/output_frequency"), Some("25"));
        assert!(payload(&all, "drive/p1/state").is_some() && payload(&all, "drive/p2/state").is_some());
        assert!(payload(&all, "bus/line1").is_some());
        assert_eq!(payload(&all, "drive/p2/point/running"), None, "empty stays empty");
    }

    #[test]
    fn an_offline_drive_has_no_values() {
        let mut bench = Bench::new();
        bench.after(0);
        let drive = bench.plant.drive("p1").unwrap();
        drive.image.update(|s| s.link = Link::Offline(SystemTime::now()));
        let gone = bench.after(10);
        assert_eq!(payload(&gone, "drive/p1/point/running"), Some(""), "without waiting");
        assert_eq!(
            payload(&gone, "drive/p1/state"),
            None,
            "not sooner than the least interval"
        );
        let state: Json = serde_json::from_str(payload(&bench.after(90), "drive/p1/state").unwrap()).unwrap();
        assert_eq!((&state["state"], &state["running"]), (&"offline".into(), &Json::Null));
    }

    #[test]
    fn a_refused_point_is_bad_while_the_drive_is_good() {
        let mut bench = Bench::new();
        let drive = bench.plant.drive("p1").unwrap();
        drive
            .image
            .update(|s| s.refuse(Table::Holding, 2105, 1, Exception::ADDRESS));
        let all = bench.after(0);
        let state: Json = serde_json::from_str(payload(&all, "drive/p1/state").unwrap()).unwrap();
        assert_eq!(state["motor_current"], Json::Null);
        assert_eq!(state["point_quality"]["motor_current"], "bad");
        assert_eq!(payload(&all, "drive/p1/point/motor_current"), Some(""));
    }

    #[test]
    fn bus_changes_are_published_at_once_and_figures_every_second() {
        let mut bench = Bench::new();
        let first: Json = serde_json::from_str(payload(&bench.after(0), "bus/line1").unwrap()).unwrap();
        assert_eq!(
            (&first["state"], &first["drives"], &first["online"]),
            (&"up".into(), &2.into(), &1.into())
        );
        assert_eq!(first["reason"], Json::Null);
        let image = bench.plant.buses[0].image.clone();
        image.update_health(|h| h.load = 0.12345);
        assert_eq!(payload(&bench.after(500), "bus/line1"), None);
        let later: Json = serde_json::from_str(payload(&bench.after(500), "bus/line1").unwrap()).unwrap();
        assert_eq!(later["load"], 0.123);
        image.update_health(|h| {
            h.up = false;
            h.reason = Some("unplugged".to_string());
        });
        let down: Json = serde_json::from_str(payload(&bench.after(100), "bus/line1").unwrap()).unwrap();
        assert_eq!((&down["state"], &down["reason"]), (&"down".into(), &"unplugged".into()));
    }

    #[test]
    fn after_a_restart_everything_comes_again() {
        let mut bench = Bench::new();
        let first = topics(&bench.after(0)).len();
        bench.publisher.restart();
        let again = bench.after(1);
        assert_eq!(topics(&again).len(), first);
    }

    #[test]
    fn vanished_drives_are_cleared_until_they_come_back() {
        let mut bench = Bench::new();
        bench.after(0);
        bench.publisher.adopt(&fixture::plant(&["p1", "p3"]));
        let all = bench.after(10);
        assert_eq!(payload(&all, "drive/p2/state"), Some(""));
        assert_eq!(payload(&all, "drive/p2/point/running"), Some(""));
        assert!(payload(&all, "drive/p3/state").unwrap().contains("offline"));
        assert_eq!(payload(&bench.after(1000), "drive/p2/state"), None, "once");
        bench.publisher.restart();
        assert_eq!(
            payload(&bench.after(1), "drive/p2/state"),
            Some(""),
            "and again for a broker that comes back"
        );
        bench.publisher.adopt(&bench.plant);
        let back = bench.after(1);
        assert_ne!(payload(&back, "drive/p2/state"), Some(""));
        assert_eq!(payload(&back, "drive/p3/state"), Some(""));
    }
}
