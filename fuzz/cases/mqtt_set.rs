//! A message on a set topic. Input: flags, length and bytes of the topic below the base, then the payload.
//!
//! Any message gets one result, and only a valid command reaches the queue of the bus.

use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant, SystemTime};

use arc_swap::ArcSwap;
use drivegate_proto::{Reply, Table};
use drivegate_core::order::{Order, Outcome, Urgency};
use drivegate_core::queue::{Ready, CommandQueue};
use drivegate_gateway::config::Settings;
use drivegate_mqtt::{Incoming, Loopback};
use drivegate_core::plant::{BusHandle, Plant, SharedPlant};
use drivegate_core::process_image::{BusImage, DriveImage, Link};

const CONFIGURATION: &str = r#"
[gateway]
name = "fuzz"
[[bus]]
name = "line1"
port = "/dev/null"
drive = [
    { name = "p1", address = 1, profile = "vacon-nx", access = "control", limits = { speed_reference = [0.0, 80.0] } },
    { name = "m1", address = 2, profile = "vacon-nx" },
]
"#;

static PLANT: LazyLock<SharedPlant> = LazyLock::new(|| {
    let loaded = Settings::parse("fuzz.toml", CONFIGURATION, std::iter::empty());
    let settings = loaded.settings.unwrap_or_else(|| panic!("{:?}", loaded.errors));
    let now = Instant::now();
    let buses = settings.buses.iter().map(|bus| {
        let image = |d: &drivegate_core::process_image::DriveSpec| Arc::new(DriveImage::new(d.clone(), bus.spec.slow_cycle));
        let drives: Vec<Arc<DriveImage>> = bus.drives.iter().map(image).collect();
        for drive in &drives {
            drive.update(|s| {
                s.link = Link::Online(SystemTime::now());
                s.fast_at = Some(now);
                s.store(Table::Holding, 2100, &[0x23, 0x2000, 5000, 2500, 1440, 123, 455, 387, 2301, 540, 0], now);
            });
        }
        let image = BusImage::new(bus.spec.clone(), drives);
        image.update_health(|h| h.up = true);
        BusHandle::new(Arc::new(image), Arc::new(CommandQueue::new().expect("a queue")), Arc::default())
    });
    Arc::new(ArcSwap::from_pointee(Plant::new(&settings.gateway, Duration::from_secs(1_000_000), buses.collect())))
});

pub(crate) fn run(data: &[u8]) {
    let [flags, length, rest @ ..] = data else { return };
    let (topic, payload) = rest.split_at(usize::from(*length).min(rest.len()));
    let topic = match flags & 3 {
        0 => format!("drivegate/fuzz/drive/{}", String::from_utf8_lossy(topic)),
        1 => "drivegate/fuzz/drive/p1/set".to_string(),
        2 => format!("drivegate/fuzz/drive/p1/set/{}", String::from_utf8_lossy(topic)),
        _ => "drivegate/fuzz/drive/m1/set".to_string(),
    };
    let plant = PLANT.clone();
    let now = Instant::now();
    let mut client = Loopback::new("drivegate", plant.clone(), now, SystemTime::UNIX_EPOCH);
    let retain = flags & 4 != 0;
    client.receive(
        Incoming {
            topic: topic.clone(),
            payload: payload.to_vec(),
            retain,
            response_topic: (flags & 8 != 0).then(|| String::from_utf8_lossy(topic.as_bytes()).into_owned()),
            ..Incoming::default()
        },
        now,
    );
    let bus = &plant.load().buses[0];
    let mut queued = 0;
    loop {
        let mut pending = bus.queue.lock();
        let ranks = [Urgency::Stop, Urgency::Command, Urgency::Read];
        let chosen = ranks.into_iter().find_map(|rank| pending.next(rank, now, &(), |_| Ready::Now, |_| false).chosen);
        let Some(command) = chosen.and_then(|chosen| pending.take(chosen)) else { break };
        drop(pending);
        queued += 1;
        assert!(!retain && command.drive().is_some_and(|drive| drive == 0), "only p1 is commanded, and never by a retained message");
        let Order::Points(points) = &command.intent.order else { panic!("points only") };
        let profile = &bus.image.drives[0].spec.profile;
        for (index, value) in points {
            let point = profile.points.get(*index).unwrap();
            assert!(point.write && value.as_f64().is_finite());
            assert!(point.name != "speed_reference" || (0.0..=80.0).contains(&value.as_f64()));
        }
        command.answer(&Outcome::Acknowledged(Reply::Written), now);
    }
    let results = client.poll(now);
    assert!(queued <= 1 && results.len() <= 1 && !client.is_waiting());
    for result in &results {
        let json: serde_json::Value = serde_json::from_slice(&result.payload).expect("JSON");
        // A stop is carried out whatever else its message has; the rest is refused.
        let stop_only = json["error"]["code"] == "stop_only";
        assert_eq!(json["ok"], queued == 1 && !stop_only, "{json}");
        assert!(queued == 1 || !stop_only, "{json}");
    }
    assert!(queued == 0 || results.len() == 1);
}
