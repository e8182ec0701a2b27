//! Plants made by hand: no bus runs, the images are filled and the queues emptied by the tests.

use std::sync::Arc;
use std::time::{Duration, Instant};

use drivegate::codec::{LineFormat, Protocol};
use drivegate::command::{Command, CommandQueue, Urgency};
use drivegate::drive::Profile;
use drivegate::drive::profile::Profiles;
use drivegate::plant::{BusHandle, Plant};
use drivegate::process_image::{BusImage, BusSpec, DriveImage, DriveSpec};

const SLOW_CYCLE: Duration = Duration::from_secs(1);

/// The shipped profile of the NX family.
pub(crate) fn nx() -> Arc<Profile> {
    Profiles::built_in().get("vacon-nx").unwrap().clone()
}

pub(crate) fn spec(bus: &str, name: &str, address: u8, profile: &Arc<Profile>) -> DriveSpec {
    DriveSpec {
        turnaround: Duration::from_millis(2),
        ..DriveSpec::new(name, bus, address, profile.clone())
    }
}

pub(crate) fn image(spec: DriveSpec) -> Arc<DriveImage> {
    Arc::new(DriveImage::new(spec, SLOW_CYCLE))
}

pub(crate) fn bus(name: &str, protocol: Protocol, drives: Vec<Arc<DriveImage>>) -> BusHandle {
    let spec = BusSpec {
        name: name.to_string(),
        port: format!("/dev/ttyUSB-{name}"),
        protocol,
        format: LineFormat::new(38_400, "8N1").unwrap(),
        cycle: Duration::from_millis(10),
        slow_cycle: SLOW_CYCLE,
    };
    BusHandle {
        image: Arc::new(BusImage::new(spec, drives)),
        queue: Arc::new(CommandQueue::new().unwrap()),
    }
}

/// Samples stay good for `stale_after`.
pub(crate) fn plant(gateway: &str, stale_after: Duration, buses: Vec<BusHandle>) -> Plant {
    Plant::new(gateway, stale_after, buses)
}

/// Takes the command that has its turn, where every drive is free and no stop is redundant.
pub(crate) fn take_next(queue: &CommandQueue, now: Instant) -> Option<Command> {
    let mut pending = queue.lock();
    let ranks = [Urgency::Stop, Urgency::Command, Urgency::Read];
    let chosen = ranks
        .into_iter()
        .find_map(|rank| pending.next(rank, now, |_| true, |_| false))?;
    pending.take(chosen)
}
