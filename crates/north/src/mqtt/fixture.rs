//! A small plant for tests.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use crate::codec::{LineFormat, Protocol, Table};
use crate::command::CommandQueue;
use crate::drive::profile::Profiles;
use crate::plant::{BusHandle, Plant};
use crate::process_image::{Access, BusImage, BusSpec, DriveImage, DriveSpec, Link};

/// A bus `line1` with NX drives of these names; all may be commanded.
pub(crate) fn plant(drives: &[&str]) -> Plant {
    let profile = Profiles::built_in().get("vacon-nx").unwrap().clone();
    let images = drives.iter().zip(1..).map(|(name, address)| {
        let spec = DriveSpec {
            access: Access::Control,
            turnaround: Duration::from_millis(2),
            ..DriveSpec::new(name, "line1", address, Arc::clone(&profile))
        };
        Arc::new(DriveImage::new(spec, Duration::from_secs(1)))
    });
    let spec = BusSpec {
        name: "line1".to_string(),
        port: "/dev/null".to_string(),
        protocol: Protocol::ModbusRtu,
        format: LineFormat::new(38_400, "8N1").unwrap(),
        cycle: Duration::from_millis(10),
        slow_cycle: Duration::from_secs(1),
    };
    let bus = BusHandle {
        image: Arc::new(BusImage::new(spec, images.collect())),
        queue: Arc::new(CommandQueue::new().unwrap()),
    };
    bus.image.update_health(|h| h.up = true);
    Plant::new("hall", Duration::from_secs(1), vec![bus])
}

/// The process data of an NX: status word and output frequency, 0.01 Hz, read at `now`.
pub(crate) fn read(plant: &Plant, drive: &str, status: u16, frequency: u16, now: Instant) {
    plant.drive(drive).unwrap().image.update(|s| {
        s.link = Link::Online(SystemTime::now());
        s.fast_at = Some(now);
        let words = [status, 0, 5000, frequency, 750, 12, 300, 280, 2300, 540, 0];
        s.store(Table::Holding, 2100, &words, now);
    });
}
