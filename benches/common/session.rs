//! A gateway's session with a broker without its lines: a plant whose values change, and the options of the client.

use std::error::Error;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime};

use drivegate_core::plant::{BusHandle, Plant};
use drivegate_core::process_image::{BusImage, BusSpec, DriveImage, DriveSpec, Link};
use drivegate_core::queue::CommandQueue;
use drivegate_model::drive::profile::Profiles;
use drivegate_mqtt::{Broker, History, Options, Qos, Telemetry};
use drivegate_proto::{LineFormat, Protocol, Table};

/// States and events as by default, without TLS, commands and Sparkplug.
pub fn options(client_id: &str, host: &str, port: u16) -> Options {
    Options {
        retain: true,
        brokers: vec![Broker {
            host: host.to_string(),
            port,
            path: None,
        }],
        tls: false,
        client_id: client_id.to_string(),
        username: None,
        password: None,
        ca: None,
        identity: None,
        base: "drivegate".to_string(),
        telemetry: Telemetry {
            state: true,
            points: false,
            history: History::Off,
        },
        telemetry_qos: Qos::AtMostOnce,
        event_qos: Qos::AtLeastOnce,
        expiry: Some(Duration::from_secs(300)),
        proxy: None,
        publish_limit: 0,
        message_expiry: Some(Duration::from_secs(600)),
        min_interval: Duration::from_millis(50),
        max_interval: Duration::from_secs(60),
        commands: false,
        require_id: false,
        response_topics: Vec::new(),
        buffer: None,
        home_assistant: None,
        principals: None,
        sparkplug: None,
    }
}

/// A bus of Vacon NX drives without a poller.
pub fn plant(name: &str, drives: u16) -> Result<Plant, Box<dyn Error>> {
    let profile = Profiles::built_in().get("vacon-nx").ok_or("no profile")?.clone();
    let image = |n: u16| {
        let spec = DriveSpec::new(&format!("d{n}"), "line", n as u8, profile.clone());
        Arc::new(DriveImage::new(spec, Duration::from_secs(1)))
    };
    let spec = BusSpec {
        name: "line".to_string(),
        port: "/dev/null".to_string(),
        protocol: Protocol::ModbusRtu,
        format: LineFormat::new(115_200, "8N1")?,
        cycle: Duration::from_millis(10),
        slow_cycle: Duration::from_secs(1),
    };
    let bus = BusHandle::new(
        Arc::new(BusImage::new(spec, (1..=drives).map(image).collect())),
        Arc::new(CommandQueue::new()?),
        Arc::default(),
    );
    bus.image.update_health(|health| health.up = true);
    Ok(Plant::new(name, Duration::from_secs(60), vec![bus]))
}

/// Updates each drive once a cycle, evenly spread, until the end.
pub fn poll(plants: &[Arc<Plant>], cycle: Duration, end: &AtomicBool) {
    let drives: Vec<_> = plants
        .iter()
        .flat_map(|plant| plant.drives().map(|drive| drive.image).collect::<Vec<_>>())
        .collect();
    let Ok(count) = u32::try_from(drives.len()) else { return };
    let (step, mut next) = (cycle / count.max(1), Instant::now());
    for (turn, drive) in drives.iter().cycle().enumerate() {
        if end.load(Ordering::Relaxed) {
            return;
        }
        let value = (turn / drives.len() % 50_000) as u16;
        let now = Instant::now();
        drive.update(|snapshot| {
            snapshot.link = Link::Online(SystemTime::UNIX_EPOCH);
            snapshot.fast_at = Some(now);
            let words = [0x0023, 0, value, value, value, 12, 300, 280, 2300, 540, 0];
            snapshot.store(Table::Holding, 2100, &words, now);
        });
        next += step;
        std::thread::sleep(next.saturating_duration_since(Instant::now()));
    }
}
