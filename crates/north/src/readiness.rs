//! Whether the gateway is ready: every bus is open, each drive was tried, and every server listens.

use super::NorthState;
use drivegate_core::plant::Plant;

/// Why the gateway is not ready; empty if it is ready.
pub fn reasons(plant: &Plant, stats: &NorthState) -> Vec<String> {
    let mut reasons = Vec::new();
    for bus in &plant.buses {
        let name = &bus.image.spec.name;
        let health = bus.image.health();
        if !health.up {
            let why = health
                .reason
                .unwrap_or_else(|| "its port has not been opened yet".to_string());
            reasons.push(format!("bus {name}: {why}"));
        }
        for drive in &bus.image.drives {
            if !drive.snapshot().link.is_tried() {
                reasons.push(format!("drive {} on bus {name}: not polled yet", drive.spec.name));
            }
        }
    }
    reasons.extend(stats.listeners.reasons());
    reasons.extend(stats.bacnet.reason());
    reasons
}
