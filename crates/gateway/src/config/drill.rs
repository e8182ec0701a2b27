//! Reads `[drill]`: how stops are proven.

use super::keys::DRILL;
use drivegate_core::drill::DrillOptions;
use drivegate_model::document::Reader;

/// Absent when a part cannot be used, which is reported.
pub(super) fn read(reader: &Reader<'_>) -> Option<DrillOptions> {
    let max_speed = DRILL.max_speed.read(reader);
    let limit = DRILL.limit.read(reader);
    let every = DRILL.every.read(reader);
    let fits = max_speed.filter(|speed| *speed > 0.0 && *speed <= 100.0);
    if let (Some(speed), None) = (max_speed, fits) {
        let what = format!("{speed} is out of range");
        reader.problem(DRILL.max_speed.name, what, "write more than 0 to 100");
    }
    reader.finish();
    Some(DrillOptions {
        max_speed: fits?,
        limit: limit?,
        every: every?,
    })
}
