//! `[recordings]`.

use super::forms::*;

keys! {
    /// What the recorder keeps: [recordings](history.md#recordings) of the time around faults.
    RECORDINGS: Recordings {
        /// Time recorded before the trigger.
        before: Duration = Time(Duration::from_secs(1)..=Duration::from_secs(600)), default "30s";
        /// Time recorded after it.
        after: Duration = Time(Duration::ZERO..=Duration::from_secs(600)), default "10s";
        /// Maximum size of all recordings on disk.
        max_bytes: u64 = Size(1 << 20..=1 << 40), default "256MiB";
        /// Maximum number of recordings; 0: nothing is recorded.
        max_count: usize = Number(0..=100_000, None), default 200;
        /// Whether a warning of a drive also triggers a recording.
        warnings: bool = Flag, default false;
    }
}
