//! How often and how soon a motor may be started, and under which conditions.

use std::time::Duration;

/// Highest configurable number of starts per hour.
pub const MOST_STARTS: u32 = 120;

/// The limits in `guard` of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Guard {
    /// Maximum number of starts within any hour.
    pub starts_per_hour: Option<u32>,
    /// Minimum time that the motor must be at standstill before another start.
    pub min_off: Duration,
    /// Time that the motor runs before an ordinary stop.
    pub min_run: Duration,
    /// Minimum time between two starts of drives of the same group.
    pub stagger: Duration,
}

/// A condition for starting a motor.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Interlock {
    /// The drive with the point.
    pub drive: String,
    /// Name of the point; its values are true and false.
    pub point: String,
    /// Value that the point must have.
    pub is: bool,
    /// Whether the running motor is stopped when the interlock no longer holds.
    pub trip: bool,
}
