//! The reservation after a stop continues when the process is restarted. Pure: both clocks are arguments.

use std::time::{Duration, Instant, SystemTime};

use serde::{Deserialize, Serialize};

use super::{Claim, Rules};
use crate::files::{State, Words};
use crate::process_image::Machine;

/// A reservation as it is saved on disk.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct KeptReservation {
    /// The machine that is reserved.
    #[serde(flatten)]
    pub machine: Machine,
    /// Name of the client that stopped the drive.
    pub who: String,
    /// Name of the client's rank at that time.
    pub rank: String,
    /// Time of the stop, ms since 1970.
    pub stopped_ms: u64,
    /// Duration of the reservation, ms.
    pub lease_ms: u64,
}

/// The reservations on disk.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct KeptReservations(pub Vec<KeptReservation>);

impl State for KeptReservations {
    const WORDS: Words = Words {
        what: "the reservations after stops",
        unread: "no motor is started",
        unsaved: "they end with the process",
        lost: "drives stopped just before the restart are no longer reserved",
    };
    const VERSION_KEY: &'static str = "drivegate_reservations";
    const LONGEST: u64 = 1 << 20;
}

/// Milliseconds of the clock of the day.
fn milliseconds(time: SystemTime) -> u64 {
    let since = time.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}

impl KeptReservation {
    /// A reservation of this machine for a client of this name and rank.
    pub fn new(
        machine: Machine,
        (who, rank): (String, String),
        stopped: SystemTime,
        lease: Duration,
    ) -> KeptReservation {
        KeptReservation {
            machine,
            who,
            rank,
            stopped_ms: milliseconds(stopped),
            lease_ms: u64::try_from(lease.as_millis()).unwrap_or(u64::MAX),
        }
    }

    /// The client of the reservation and the time until which it continues after a start at `now`, which is `time`
    /// on the calendar; `None` if it has ended or its rank no longer exists. If the clock shows a time before the
    /// stop, the full time is left.
    pub fn continues_after_start(&self, rules: &Rules, now: Instant, time: SystemTime) -> Option<(Claim, Instant)> {
        let rank = rules.ranks.iter().position(|rank| **rank == *self.rank)?;
        let passed = milliseconds(time).saturating_sub(self.stopped_ms);
        let left = Duration::from_millis(self.lease_ms.checked_sub(passed)?).min(rules.lease);
        let who = Claim {
            name: self.who.as_str().into(),
            rank,
            cyclic: false,
            may_repeat: false,
            breaks: false,
        };
        (left > Duration::ZERO).then(|| Some((who, now.checked_add(left)?)))?
    }
}
