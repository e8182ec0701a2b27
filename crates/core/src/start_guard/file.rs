//! The form of the file of starts. Pure.

use std::time::{Duration, SystemTime};

use serde::{Deserialize, Serialize};

use super::MOST_STARTS;
use crate::files::{State, Words};
use crate::process_image::Machine;

/// Maximum number of motors in a file. A file with more motors was not written by the gateway.
const MOST_MOTORS: usize = 16_384;
/// The year 9999, in which no clock is.
const LATEST: Duration = Duration::from_secs(253_370_764_800);

/// The starts of the last hour of all motors.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Saved {
    motors: Vec<SavedMotor>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct SavedMotor {
    #[serde(flatten)]
    machine: Machine,
    /// Times of the starts, milliseconds since 1970.
    starts: Vec<u64>,
}

impl State for Saved {
    const WORDS: Words = Words {
        what: "the starts",
        unread: "drives with a guard are not started",
        unsaved: "drives with a guard are not started",
        lost: "starts before now are not counted",
    };
    const VERSION_KEY: &'static str = "drivegate_starts";
    const LONGEST: u64 = 64 << 20;

    fn check(&self) -> Result<(), String> {
        let most = MOST_STARTS as usize + 1;
        if self.motors.len() > MOST_MOTORS || self.motors.iter().any(|motor| motor.starts.len() > most) {
            return Err(format!(
                "it has more than {MOST_MOTORS} motors, or {most} starts of one"
            ));
        }
        Ok(())
    }
}

impl Saved {
    pub(super) fn new(motors: impl Iterator<Item = (Machine, Vec<SystemTime>)>) -> Saved {
        let millis = |at: SystemTime| {
            let since = at.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
            u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
        };
        let motor = |(machine, starts): (Machine, Vec<SystemTime>)| SavedMotor {
            machine,
            starts: starts.into_iter().map(millis).collect(),
        };
        Saved {
            motors: motors.map(motor).collect(),
        }
    }

    /// The saved motors with their starts.
    pub(super) fn motors(&self) -> impl Iterator<Item = (Machine, impl Iterator<Item = SystemTime> + '_)> + '_ {
        self.motors.iter().map(|motor| {
            let at = |millis: &u64| {
                // A time that the clock cannot represent becomes the latest time of the form.
                let at = SystemTime::UNIX_EPOCH.checked_add(Duration::from_millis(*millis));
                at.unwrap_or(SystemTime::UNIX_EPOCH + LATEST)
            };
            (motor.machine.clone(), motor.starts.iter().map(at))
        })
    }
}
