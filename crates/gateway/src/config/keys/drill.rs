//! `[drill]`.

use super::forms::*;

/// Ten years.
const LONGEST_EVERY: Duration = Duration::from_secs(10 * 8760 * 3600);

keys! {
    /// [Drills](safety.md#drills): proving that motors stop.
    DRILL: DrillTable {
        /// Highest speed of a drill, % of the motor's range, more than 0 to 100.
        max_speed: f64 = Figure, default 20.0;
        /// Time within which the motor must stop: longer than the timeouts of its supervision and of the drive itself.
        limit: Duration = Time(Duration::from_secs(1)..=HOUR), default "10s";
        /// Age after which `check`, page and metrics report a proof as too old.
        every: Duration = Time(HOUR..=LONGEST_EVERY), default "8760h";
    }
}
