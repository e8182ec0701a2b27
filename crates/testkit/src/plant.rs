//! Hand-made plants for tests.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use drivegate_core::plant::{BusHandle, Plant};
use drivegate_core::process_image::{Access, BusImage, BusSpec, DriveImage, DriveSpec, Link};
use drivegate_core::queue::CommandQueue;
use drivegate_model::drive::Profile;
use drivegate_model::drive::profile::Profiles;
use drivegate_proto::{LineFormat, Protocol, Table};

/// Time for which a sample is good, and cadence of slow points.
pub const STALE_AFTER: Duration = Duration::from_secs(1);

/// The built-in profile with this name.
pub fn profile(name: &str) -> Arc<Profile> {
    Profiles::built_in().get(name).unwrap().clone()
}

/// The built-in profile of the Vacon NX.
pub fn nx() -> Arc<Profile> {
    profile("vacon-nx")
}

/// A drive that is only monitored.
pub fn monitored(name: &str, bus: &str, address: u8, profile: &Arc<Profile>) -> DriveSpec {
    DriveSpec::new(name, bus, address, profile.clone())
}

/// A drive that may be commanded.
pub fn controlled(name: &str, bus: &str, address: u8, profile: &Arc<Profile>) -> DriveSpec {
    DriveSpec {
        access: Access::Control,
        turnaround: Duration::from_millis(2),
        ..monitored(name, bus, address, profile)
    }
}

/// The image of a drive that was never read.
pub fn image(spec: DriveSpec) -> Arc<DriveImage> {
    Arc::new(DriveImage::new(spec, STALE_AFTER))
}

/// Modbus RTU at 38,400 baud 8N1, process data every 10 ms.
pub fn bus_spec(name: &str) -> BusSpec {
    BusSpec {
        name: name.to_string(),
        port: format!("/dev/ttyUSB-{name}"),
        protocol: Protocol::ModbusRtu,
        format: LineFormat::new(38_400, "8N1").unwrap(),
        cycle: Duration::from_millis(10),
        slow_cycle: STALE_AFTER,
    }
}

/// A bus whose port is not open yet.
pub fn bus(spec: BusSpec, drives: Vec<Arc<DriveImage>>) -> BusHandle {
    let image = Arc::new(BusImage::new(spec, drives));
    BusHandle::new(image, Arc::new(CommandQueue::new().unwrap()), Arc::default())
}

/// The bus with its port shown as open.
pub fn up(bus: BusHandle) -> BusHandle {
    bus.image.update_health(|health| health.up = true);
    bus
}

/// A bus `line1` with NX drives with these names at addresses 1, 2, …; all may be commanded.
pub fn nx_bus(drives: &[&str]) -> BusHandle {
    let nx = nx();
    let drives = drives.iter().zip(1..);
    let images = drives.map(|(name, address)| image(controlled(name, "line1", address, &nx)));
    up(bus(bus_spec("line1"), images.collect()))
}

/// A plant `hall` of [`nx_bus`].
pub fn nx_plant(drives: &[&str]) -> Plant {
    Plant::new("hall", STALE_AFTER, vec![nx_bus(drives)])
}

/// Marks the drive as answering.
pub fn online(image: &DriveImage) {
    image.update(|snapshot| snapshot.link = Link::Online(SystemTime::now()));
}

/// The drive answered at `now`: these holding registers.
pub fn read(image: &DriveImage, start: u16, words: &[u16], now: Instant) {
    image.update(|snapshot| {
        snapshot.link = Link::Online(SystemTime::now());
        snapshot.fast_at = Some(now);
        snapshot.store(Table::Holding, start, words, now);
    });
}

/// Stores a reading of all planned registers at `now`, each word given by its address.
pub fn read_all(image: &DriveImage, now: Instant, word: impl Fn(u16) -> u16) {
    image.update(|snapshot| {
        snapshot.link = Link::Online(SystemTime::now());
        snapshot.fast_at = Some(now);
        for read in &image.plan.reads {
            let words: Vec<u16> = (read.start..).take(read.count.into()).map(&word).collect();
            snapshot.store(read.table, read.start, &words, now);
        }
    });
}

/// The process data of an NX: status word and output frequency, 0.01 Hz, read at `now`.
pub fn read_nx(plant: &Plant, drive: &str, status: u16, frequency: u16, now: Instant) {
    let words = [status, 0, 5000, frequency, 750, 12, 300, 280, 2300, 540, 0];
    read(&plant.drive(drive).unwrap().image, 2100, &words, now);
}
