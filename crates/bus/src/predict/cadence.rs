//! The cadences that a line carries with something to spare. Pure.

use std::time::Duration;

use super::faster::with_faster_points;
use super::predict;
use drivegate_core::process_image::{BusSpec, DriveSpec};
use drivegate_proto::wire::Silence;

/// Cadences to choose from, in ms.
const STEPS: [u64; 17] = [
    10, 20, 30, 40, 50, 75, 100, 150, 200, 300, 500, 750, 1000, 1500, 2000, 3000, 5000,
];
/// Slow cadences to choose from, in ms.
const SLOW_STEPS: [u64; 7] = [1000, 2000, 5000, 10_000, 20_000, 30_000, 60_000];
/// Greatest ratio of a slow cycle to the fast one, unless the slow cycle is the shortest possible.
const MOST_RATIO: u32 = 10;
/// `cycle` and `slow_cycle` for this bus: the shortest cadences that leave a fifth of the line free, with the
/// points that are [read in the fast class where that is possible](super::faster_points). `None` if the line cannot
/// carry even the longest ones, or there is nothing to read.
pub fn carried(spec: &BusSpec, silence: Silence, drives: &[DriveSpec]) -> Option<(Duration, Duration)> {
    let faster = with_faster_points(drives);
    let drives = faster.as_deref().unwrap_or(drives);
    let all = STEPS.iter().flat_map(|cycle| {
        let cycle = Duration::from_millis(*cycle);
        let slow = SLOW_STEPS.into_iter().map(Duration::from_millis);
        let slow = slow.filter(move |slow| *slow >= cycle && *slow <= (cycle * MOST_RATIO).max(Duration::from_secs(1)));
        slow.map(move |slow| (cycle, slow))
    });
    all.into_iter().find(|(cycle, slow_cycle)| {
        let spec = BusSpec {
            cycle: *cycle,
            slow_cycle: *slow_cycle,
            ..spec.clone()
        };
        let prediction = predict(&spec, silence, drives);
        prediction.is_comfortable() && !prediction.requests.is_empty()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_proto::{LineFormat, Protocol};
    use drivegate_testkit::{bus_spec, monitored};

    fn carried_by(protocol: Protocol, baud: u32, profiles: &[&str]) -> Option<(u128, u128)> {
        let spec = BusSpec {
            protocol,
            format: LineFormat::new(baud, "8N1").unwrap(),
            ..bus_spec("b")
        };
        let drive =
            |(address, profile): (u8, &&str)| monitored("d", "b", address, &drivegate_testkit::profile(profile));
        let drives: Vec<DriveSpec> = (1..).zip(profiles).map(drive).collect();
        let (cycle, slow_cycle) = carried(&spec, Silence::Spec, &drives)?;
        let found = BusSpec {
            cycle,
            slow_cycle,
            ..spec
        };
        let prediction = predict(&found, Silence::Spec, &drives);
        assert!(prediction.is_comfortable(), "{prediction:?}");
        Some((cycle.as_millis(), slow_cycle.as_millis()))
    }

    #[test]
    fn lines_of_all_protocols() {
        let rtu = Protocol::ModbusRtu;
        assert_eq!(carried_by(rtu, 38_400, &["vacon-nx"]), Some((20, 1000)));
        assert_eq!(carried_by(rtu, 38_400, &["vacon-nx"; 2]), Some((40, 1000)));
        let slow = carried_by(rtu, 9600, &["vacon-nx"; 10]).unwrap();
        assert!(slow.0 > 400 && slow.1 >= 1000, "{slow:?}");
        let n2 = carried_by(Protocol::N2, 9600, &["vacon-nx-n2", "eaton-hvx-n2", "teco-7300pa-n2"]).unwrap();
        assert!(n2.0 > 800 && n2.1 > n2.0, "{n2:?}");
    }

    #[test]
    fn what_no_line_carries() {
        assert_eq!(carried_by(Protocol::N2, 9600, &["vacon-nx-n2"; 247]), None);
        assert_eq!(carried_by(Protocol::ModbusRtu, 9600, &[]), None);
    }
}
