//! The cadences that a line carries with something to spare. Pure.

use std::time::Duration;

use super::predict;
use crate::codec::wire::Silence;
use crate::process_image::{BusSpec, DriveSpec};

/// Cadences to choose from, ms.
const STEPS: [u64; 17] = [
    10, 20, 30, 40, 50, 75, 100, 150, 200, 300, 500, 750, 1000, 1500, 2000, 3000, 5000,
];
/// Slow cadences to choose from, ms.
const SLOW_STEPS: [u64; 7] = [1000, 2000, 5000, 10_000, 20_000, 30_000, 60_000];
/// A slow cadence is at most so many times the fast one, or the shortest.
const MOST_RATIO: u32 = 10;
/// Share of the line that is used at most: the rest is for commands, retries and drives slower than their profile says.
const MOST_LOAD: f64 = 0.8;

/// `cycle` and `slow_cycle` for that bus: the shortest cadences that leave a fifth of the line free. `None` if the line does
/// not carry the longest ones, or there is nothing to read.
pub fn carried(spec: &BusSpec, silence: Silence, drives: &[DriveSpec]) -> Option<(Duration, Duration)> {
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
        prediction.shortage.is_none() && prediction.demand <= MOST_LOAD && !prediction.requests.is_empty()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Settings;

    fn carried_by(bus: &str, drives: &[(&str, u8)]) -> Option<(u128, u128)> {
        let drives = drives.iter().map(|(profile, address)| {
            format!("[[bus.drive]]\nname = \"d{address}\"\naddress = {address}\nprofile = \"{profile}\"\n")
        });
        let text = format!(
            "[gateway]\nname = \"g\"\n[[bus]]\nname = \"b\"\nport = \"/dev/x\"\n{bus}\n{}",
            drives.collect::<String>()
        );
        let loaded = Settings::parse("t.toml", &text, std::iter::empty());
        let settings = loaded.settings.unwrap_or_else(|| panic!("{:?}", loaded.errors));
        let bus = &settings.buses[0];
        let (cycle, slow_cycle) = carried(&bus.spec, bus.options.silence, &bus.drives)?;
        Some((cycle.as_millis(), slow_cycle.as_millis()))
    }

    #[test]
    fn lines_of_all_protocols() {
        let nx = "baud = 38400";
        assert_eq!(carried_by(nx, &[("vacon-nx", 1)]), Some((20, 1000)));
        let ten: Vec<(&str, u8)> = (1..=10).map(|address| ("vacon-nx", address)).collect();
        assert_eq!(carried_by(nx, &ten), Some((300, 1000)));
        assert_eq!(carried_by("baud = 9600", &[("vacon-nx", 1)]), Some((75, 1000)));
        let n2 = [("vacon-nx-n2", 1), ("eaton-hvx-n2", 2), ("teco-7300pa-n2", 3)];
        assert_eq!(carried_by("protocol = \"n2\"", &n2), Some((2000, 10_000)));
        let far: Vec<(&str, u8)> = (1..=247).map(|address| ("vacon-nx-n2", address)).collect();
        assert_eq!(carried_by("protocol = \"n2\"", &far), None, "more than a line carries");
    }
}
