//! Memory that the gateway takes at most, with every ring full.

use super::settings::{BusSettings, Settings};
use drivegate_core::history::budget::Budget;
use drivegate_core::history::line;
use drivegate_core::history::trend::Reach;

/// Memory of the program, its libraries, its threads and its servers for the clients that they allow, bytes; measured.
const PROGRAM: usize = 25 << 20;
/// A bus: queue, trace, tape and thread, bytes; measured.
const BUS: usize = 256 << 10;
/// Memory of a drive: plan, image, health, data of the servers and its part of the longest answers, bytes; measured
/// with 992 drives.
const DRIVE: usize = 42 << 10;

/// Memory for BACnet: subscriptions, writes and waiting answers; and for the objects of one drive, bytes.
const BACNET: (usize, usize) = (7 << 20, 24 << 10);

/// Memory for comparing the passwords of users, bytes; measured. 12 MiB of it are needed by a hash made with
/// `drivegate user add`.
const LOGINS: usize = 14 << 20;

/// Maximum memory of a gateway, by use.
#[derive(Debug)]
pub struct Memory {
    /// How far back trends reach.
    pub reach: Reach,
    /// Memory of each bus, in the order of the buses.
    pub buses: Vec<BusMemory>,
}

/// Memory of the past of a bus at most.
#[derive(Debug)]
pub struct BusMemory {
    /// Memory for the trends of the bus's drives and the last hour of the line, bytes.
    pub trends: usize,
    /// Trends of the drive with the most points, bytes.
    pub drive_trends: usize,
    /// Memory of the recorder.
    pub recorder: Budget,
}

impl Memory {
    /// Memory of a gateway with these settings.
    pub fn of(settings: &Settings) -> Memory {
        let buses = &settings.buses;
        let drives = buses.iter().flat_map(|bus| &bus.drives);
        let reach = Reach::of(drives.map(|drive| &*drive.profile));
        let needs = buses
            .iter()
            .map(|bus| Budget::of(&bus.spec, &bus.drives, &settings.recordings));
        let recorders = Budget::shared(needs.collect());
        let of = |(bus, recorder): (&BusSettings, Budget)| {
            let each = bus
                .drives
                .iter()
                .map(|drive| reach.bytes_of(&drive.profile) + line::BYTES.1);
            BusMemory {
                trends: each.clone().sum::<usize>() + line::BYTES.0,
                drive_trends: each.max().unwrap_or(0),
                recorder,
            }
        };
        Memory {
            reach,
            buses: buses.iter().zip(recorders).map(of).collect(),
        }
    }

    /// Memory for all data, bytes.
    pub fn total(&self, settings: &Settings) -> usize {
        let drives: usize = settings.buses.iter().map(|bus| bus.drives.len()).sum();
        let past: usize = self
            .buses
            .iter()
            .map(|bus| bus.trends + bus.recorder.with_growth())
            .sum();
        let bacnet = settings.bacnet.as_ref().map_or(0, |_| BACNET.0 + BACNET.1 * drives);
        let users = settings.http.as_ref().and_then(|http| http.users.as_ref());
        let logins = users.map_or(0, |_| LOGINS);
        PROGRAM + bacnet + logins + BUS * settings.buses.len() + DRIVE * drives + past
    }
}
