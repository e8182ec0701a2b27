use serde_json::Value as Json;

use super::super::{History, fixture};
use super::*;
use drivegate_core::process_image::Link;
use drivegate_proto::{Exception, Table};

struct PublishedPlant {
    plant: Plant,
    publisher: Publisher,
    now: Instant,
    wall: SystemTime,
}

impl PublishedPlant {
    /// Drives `p1` (running at 25 Hz) and `p2` (never read), published at intervals of 100 ms to 60 s.
    fn new() -> PublishedPlant {
        let plant = fixture::plant(&["p1", "p2"]);
        let topics = Topics::new("drivegate", "hall");
        let telemetry = Telemetry {
            state: true,
            points: true,
            history: History::All,
        };
        let pace = PublishInterval {
            min: Duration::from_millis(100),
            max: Duration::from_secs(60),
        };
        let mut publisher = Publisher::new(topics, pace, telemetry, Arc::default());
        publisher.adopt(&plant, Vec::new());
        let bench = PublishedPlant {
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

    /// Advances the time, then publishes; returns the topics below `drivegate/hall/`.
    fn after(&mut self, ms: u64) -> Vec<(String, String)> {
        self.now += Duration::from_millis(ms);
        self.wall += Duration::from_millis(ms);
        let text = |update: Update| {
            let topic = update.topic.strip_prefix("drivegate/hall/").unwrap().to_string();
            (topic, String::from_utf8(update.payload).unwrap())
        };
        let cleared = self.publisher.cleared().into_iter().map(|topic| Update {
            topic,
            payload: Vec::new(),
        });
        let (updates, next) = self.publisher.tick(self.now, self.wall);
        assert!(next > self.now, "all drives were looked at");
        cleared.chain(updates).map(text).collect()
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
    let mut bench = PublishedPlant::new();
    let all = bench.after(20);
    let state: Json = serde_json::from_str(payload(&all, "drive/p1/state").unwrap()).unwrap();
    assert_eq!(state["state"], "running");
    assert_eq!(state["quality"], "good");
    assert_eq!(state["time"], "2023-11-14T22:13:20.500Z");
    assert_eq!(state["age_ms"], 20);
    assert_eq!(state["fault_text"], "");
    assert_eq!(state["blocked_by"], serde_json::json!([]), "it runs");
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
    assert_eq!(other["blocked_by"], serde_json::json!(["offline"]));
    assert_eq!(other.get("point_quality"), None, "all are bad, as the drive");
}

#[test]
fn point_topics_carry_bare_values_and_nothing_that_is_not_good() {
    let mut bench = PublishedPlant::new();
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
    // After 1 s the value is stale: it is cleared at once, and only once.
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
    let mut bench = PublishedPlant::new();
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
    let mut bench = PublishedPlant::new();
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
    let mut bench = PublishedPlant::new();
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
    let mut bench = PublishedPlant::new();
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
    let mut bench = PublishedPlant::new();
    let first: Json = serde_json::from_str(payload(&bench.after(0), "bus/line1").unwrap()).unwrap();
    assert_eq!(
        (&first["state"], &first["drives"], &first["online"]),
        (&"up".into(), &2.into(), &1.into())
    );
    assert_eq!(first["reason"], Json::Null);
    let image = bench.plant.buses[0].image.clone();
    image.update_health(|h| h.load = Some(0.12345));
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
    let mut bench = PublishedPlant::new();
    let first = topics(&bench.after(0)).len();
    bench.publisher.restart(usize::MAX);
    let again = bench.after(1);
    assert_eq!(topics(&again).len(), first);
}

#[test]
fn vanished_drives_are_cleared_until_they_come_back() {
    let mut bench = PublishedPlant::new();
    bench.after(0);
    bench.publisher.adopt(&fixture::plant(&["p1", "p3"]), Vec::new());
    let all = bench.after(10);
    assert_eq!(payload(&all, "drive/p2/state"), Some(""));
    assert_eq!(payload(&all, "drive/p2/point/running"), Some(""));
    assert!(payload(&all, "drive/p3/state").unwrap().contains("offline"));
    assert_eq!(payload(&bench.after(1000), "drive/p2/state"), None, "once");
    bench.publisher.restart(usize::MAX);
    assert_eq!(
        payload(&bench.after(1), "drive/p2/state"),
        Some(""),
        "and again for a broker that comes back"
    );
    bench.publisher.adopt(&bench.plant, Vec::new());
    let back = bench.after(1);
    assert_ne!(payload(&back, "drive/p2/state"), Some(""));
    assert_eq!(payload(&back, "drive/p3/state"), Some(""));
}

#[test]
fn a_new_sample_is_published_at_once_and_says_when_to_look_again() {
    let mut bench = PublishedPlant::new();
    bench.after(0);
    bench.after(150);
    bench.read(0x0023, 2501);
    let (updates, next) = bench.publisher.tick(bench.now, bench.wall);
    assert!(updates.iter().any(|u| u.topic.ends_with("p1/state")));
    assert_eq!(next - bench.now, Duration::from_millis(100), "the buses");
    bench.now += Duration::from_millis(30);
    bench.read(0x0023, 2502);
    let (updates, next) = bench.publisher.tick(bench.now, bench.wall);
    assert_eq!((updates.len(), next - bench.now), (0, Duration::from_millis(70)));
    bench.now = next;
    let (updates, _) = bench.publisher.tick(bench.now, bench.wall);
    assert!(updates.iter().any(|u| u.topic.ends_with("p1/state")));
}

#[test]
fn an_update_wakes_the_client() {
    let bench = PublishedPlant::new();
    let notified = bench.publisher.fresh.notified();
    bench.read(0x0023, 2501);
    let mut notified = std::pin::pin!(notified);
    let mut context = std::task::Context::from_waker(std::task::Waker::noop());
    assert!(notified.as_mut().poll(&mut context).is_ready());
}

#[test]
fn many_drives_are_looked_at_a_few_at_a_time() {
    let names: Vec<String> = (0..100).map(|n| format!("d{n}")).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let mut bench = PublishedPlant::new();
    bench.plant = fixture::plant(&names);
    bench.publisher.adopt(&bench.plant, Vec::new());
    let mut states = 0;
    for calls in 1.. {
        let (updates, next) = bench.publisher.tick(bench.now, bench.wall);
        let now = updates
            .iter()
            .filter(|u| u.topic.ends_with("/state") && !u.topic.contains("/point/"));
        let now = now.count();
        assert!(now <= rounds::DRIVES);
        states += now;
        if next > bench.now {
            assert_eq!((calls, states), (4, 100));
            break;
        }
    }
}

#[test]
fn only_what_is_wanted_is_published() {
    for (state, points) in [(true, false), (false, true)] {
        let mut bench = PublishedPlant::new();
        bench.publisher.telemetry.state = state;
        bench.publisher.telemetry.points = points;
        bench.publisher.adopt(&bench.plant, Vec::new());
        let (updates, _) = bench.publisher.tick(bench.now, bench.wall);
        assert_eq!(updates.iter().any(|u| u.topic.ends_with("p1/state")), state);
        assert_eq!(updates.iter().any(|u| u.topic.contains("/point/")), points);
        let vanished = bench.publisher.cleared();
        assert_eq!(
            vanished.iter().any(|t| t.contains("/point/")),
            !points,
            "what was published before"
        );
    }
}

#[test]
fn topics_of_an_earlier_run_are_cleared_until_the_broker_has_it() {
    let mut bench = PublishedPlant::new();
    let old = ["old/hall/drive/p1/state", "drivegate/hall/drive/p1/state"];
    bench.publisher.clear(old.map(Arc::from));
    assert_eq!(bench.publisher.cleared(), [Arc::from(old[0])]);
    assert!(bench.publisher.cleared().is_empty(), "once per connection");
    bench.publisher.restart(usize::MAX);
    assert_eq!(bench.publisher.cleared().len(), 1);
    assert!(!bench.publisher.was_cleared(&Arc::from("x")));
    assert!(bench.publisher.was_cleared(&Arc::from(old[0])));
    assert_eq!(bench.publisher.vanished().count(), 0);
}

#[test]
fn the_values_of_an_outage_are_recorded() {
    for (mode, expected) in [(History::All, 6), (History::Changes, 3), (History::Off, 0)] {
        let mut bench = PublishedPlant::new();
        bench.publisher.telemetry.history = mode;
        // The broker disconnects after this.
        bench.after(20);
        let mut arrays = Vec::new();
        for value in [2500, 2500, 2501, 2501, 2501, 2502] {
            bench.read(0x0023, value);
            // The interval for another entry has not passed yet.
            for ms in [0, 50, 50] {
                bench.now += Duration::from_millis(ms);
                bench.wall += Duration::from_millis(ms);
                let (complete, next) = bench.publisher.record(bench.now, bench.wall);
                arrays.extend(complete);
                assert!(next > bench.now, "{mode:?}: nothing is left to look at now");
            }
        }
        assert!(arrays.is_empty());
        let recorded = bench.publisher.recorded();
        let of_p1 = recorded
            .iter()
            .find(|u| u.topic.as_ref() == "drivegate/hall/drive/p1/history");
        let entries: Vec<Json> = of_p1.map_or(Vec::new(), |u| serde_json::from_slice(&u.payload).unwrap());
        assert_eq!(entries.len(), expected, "{mode:?}");
        assert!(entries.iter().all(|e| e["historical"] == true && e["time"].is_string()));
        assert!(entries.is_sorted_by_key(|e| e["time"].as_str().unwrap().to_string()));
        if let Some(last) = entries.last() {
            assert_eq!(last["output_frequency"], 25.02);
        }
        assert!(bench.publisher.recorded().is_empty());
    }
}

#[test]
fn every_client_that_observes_a_drive_is_woken_once() {
    use futures_util::FutureExt as _;
    let plant = fixture::plant(&["p1"]);
    let image = plant.drive("p1").unwrap().image;
    let listeners: [Arc<Notify>; 2] = Default::default();
    let ended = Arc::<Notify>::default();
    for listener in [&listeners[0], &ended, &listeners[1], &listeners[0]] {
        image.notify(listener);
    }
    drop(ended);
    image.update(|_| {});
    for listener in &listeners {
        let woken = || listener.notified().now_or_never().is_some();
        assert_eq!((woken(), woken()), (true, false));
    }
}

#[test]
fn a_state_that_is_too_large_for_the_broker_goes_without_its_last_points() {
    let mut bench = PublishedPlant::new();
    let whole = bench.after(0);
    let whole: Json = serde_json::from_str(payload(&whole, "drive/p1/state").unwrap()).unwrap();
    let most = 400;
    bench.publisher.restart(most);
    let updates = bench.after(1000);
    let state = payload(&updates, "drive/p1/state").unwrap();
    assert!(
        state.len() + "drivegate/hall/drive/p1/state".len() + PACKET_OVERHEAD <= most,
        "{state}"
    );
    let reduced: Json = serde_json::from_str(state).unwrap();
    let (whole, reduced) = (whole.as_object().unwrap(), reduced.as_object().unwrap());
    let omitted = usize::try_from(reduced["omitted"].as_u64().unwrap()).unwrap();
    assert!(omitted > 0 && reduced.contains_key("running"), "{state}");
    assert_eq!(
        (&reduced["state"], &reduced["quality"]),
        (&whole["state"], &whole["quality"])
    );
    let lines = bench.publisher.take_reduced();
    let of_p1: Vec<&String> = lines.iter().filter(|line| line.contains("drive p1")).collect();
    let [line] = of_p1[..] else { panic!("{lines:?}") };
    let names = whole
        .keys()
        .filter(|key| !reduced.contains_key(*key) && !key.ends_with("_text") && *key != "point_quality");
    for name in names {
        assert!(line.contains(name.as_str()), "{line} lacks {name}");
    }
    bench.read(0x0023, 2600);
    assert!(payload(&bench.after(1000), "drive/p1/state").is_some());
    assert!(bench.publisher.take_reduced().is_empty(), "it is told once");
    bench.publisher.restart(usize::MAX);
    let updates = bench.after(1000);
    assert!(!payload(&updates, "drive/p1/state").unwrap().contains("omitted"));
}

#[test]
fn arrays_of_the_history_fit_into_the_packets_of_the_broker() {
    let mut bench = PublishedPlant::new();
    let most = 2000;
    bench.publisher.restart(most);
    let mut arrays = Vec::new();
    for n in 0..30 {
        bench.now += Duration::from_millis(200);
        bench.read(0x0023, 2500 + n);
        arrays.extend(bench.publisher.record(bench.now, bench.wall).0);
    }
    arrays.extend(bench.publisher.recorded());
    let of_p1 = arrays.iter().filter(|update| update.topic.contains("/p1/"));
    let mut entries = 0;
    for update in of_p1 {
        assert!(update.topic.len() + update.payload.len() + PACKET_OVERHEAD <= most);
        let array: Vec<Json> = serde_json::from_slice(&update.payload).unwrap();
        entries += array.len();
    }
    assert_eq!(entries, 30);
}

#[test]
fn a_drive_that_was_never_read_has_no_history() {
    let mut bench = PublishedPlant::new();
    assert!(bench.plant.drives().count() > 1);
    for n in 0..5 {
        bench.now += Duration::from_millis(200);
        bench.read(0x0023, 2500 + n);
        let _ = bench.publisher.record(bench.now, bench.wall);
    }
    let recorded = bench.publisher.recorded();
    assert!(!recorded.is_empty());
    assert!(
        recorded.iter().all(|update| update.topic.contains("/p1/")),
        "{recorded:?}"
    );
}
