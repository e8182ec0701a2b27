//! How long a thread did not run, and what this means for the time of the bytes that it reads. Pure: time is an argument.
//!
//! A process can stall as a whole (it is stopped, its virtual machine is saved, the machine is suspended, the host
//! is overloaded), and so can one thread. Bytes found in a socket afterwards may have arrived at any time during
//! the stall, in any order.

mod pauses;

use std::time::{Duration, Instant};

pub use self::pauses::{Heartbeat, Pauses};

/// Longest time between two runs of a reading thread.
pub const TICK: Duration = Duration::from_millis(100);
/// Longest time between two turns of a thread that is not a stall. A tick is late by some milliseconds on any machine;
/// by half of its time only where the thread did not get the processor. Any stall of 150 ms or more is detected.
pub const UNNOTICED: Duration = Duration::from_millis(150);
/// Time after a stall within which bytes that arrived during it are read, unless the reader finds nothing left
/// before: a thousand connections are read in a few milliseconds.
pub const READ_WITHIN: Duration = Duration::from_millis(250);
/// A stall longer than this is a pause: clients may have given up (many wait for a second) and sent again. A hiccup
/// of a busy machine is shorter.
const PAUSE: Duration = Duration::from_secs(1);
/// Longest interval between two retransmissions (RFC 6298 and Linux: 120 s). A client's system sends data undelivered
/// during a pause again at intervals that double, so within the length of the pause again.
const RESENT_WITHIN: Duration = Duration::from_secs(120);
/// Time for retransmitted data to arrive and to be read.
const ON_ITS_WAY: Duration = Duration::from_secs(1);

/// A time in which a thread did not run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stall {
    /// When the thread ran last. If the machine was suspended, this is moved back by the time of the suspension, during
    /// which the clock did not advance.
    pub began: Instant,
    /// When the thread ran again after the stall.
    pub ended: Instant,
    /// Part of the stall during which the machine was suspended and its clock did not advance: times recorded
    /// before are older by this.
    pub slept: Duration,
}

impl Stall {
    /// A stall of a machine that was not suspended.
    pub fn new(began: Instant, ended: Instant) -> Stall {
        Stall {
            began,
            ended,
            slept: Duration::ZERO,
        }
    }

    /// Length of the stall.
    pub fn length(&self) -> Duration {
        self.ended.saturating_duration_since(self.began)
    }

    /// Whether the stall was so long that clients may have given up waiting.
    pub fn is_pause(&self) -> bool {
        self.length() > PAUSE
    }

    /// Until when bytes that arrived during the stall may be read.
    pub fn read_by(&self) -> Instant {
        self.ended + READ_WITHIN
    }

    /// Until when bytes that clients sent before the end of the stall may still arrive.
    pub fn over(&self) -> Instant {
        self.ended + self.length().min(RESENT_WITHIN) + ON_ITS_WAY
    }
}

/// When bytes read from a connection arrived.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Dated {
    /// Earliest time at which the bytes may have arrived.
    pub earliest: Instant,
    /// The stall during which the bytes may have arrived.
    pub stall: Option<Stall>,
    /// The last pause, while bytes sent before its end may still arrive.
    pub pause: Option<Stall>,
}

/// The stalls of one thread, or of threads that work together.
#[derive(Debug, Clone)]
pub struct Stalls {
    /// When the thread last ran, and the reading at that time of the clock that continues during a suspend.
    ran: Instant,
    boot: Duration,
    last: Option<Stall>,
    pause: Option<Stall>,
}

impl Stalls {
    /// Observes a thread that runs at `now`; `boot` is the time since the machine was started, suspensions included.
    pub fn new(now: Instant, boot: Duration) -> Stalls {
        Stalls {
            ran: now,
            boot,
            last: None,
            pause: None,
        }
    }

    /// The thread runs. Returns the stall that has ended by that.
    pub fn observe(&mut self, now: Instant, boot: Duration) -> Option<Stall> {
        let ran = now.saturating_duration_since(self.ran);
        let booted = boot.saturating_sub(self.boot);
        (self.ran, self.boot) = (self.ran.max(now), boot);
        let gap = ran.max(booted);
        if gap <= UNNOTICED {
            return None;
        }
        let stall = Stall {
            began: now.checked_sub(gap).unwrap_or(now),
            ended: now,
            // The two clocks are not read at exactly the same moment.
            slept: Some(booted.saturating_sub(ran))
                .filter(|slept| *slept > TICK)
                .unwrap_or_default(),
        };
        self.note_stall(stall);
        Some(stall)
    }

    /// Notes that the thread runs, and that the time since it last ran was not a stall, for example because it
    /// opened a port.
    pub fn go_on(&mut self, now: Instant, boot: Duration) {
        (self.ran, self.boot) = (now, boot);
    }

    /// A stall that was found by other means.
    pub fn note_stall(&mut self, stall: Stall) {
        if stall.is_pause() {
            self.pause = Some(stall);
        }
        // Bytes that arrived during the previous stall may still be unread, so both stalls are joined.
        let before = self.last.filter(|last| stall.began < last.ended + TICK);
        self.last = Some(Stall {
            began: before.map_or(stall.began, |before| before.began.min(stall.began)),
            ended: before.map_or(stall.ended, |before| before.ended.max(stall.ended)),
            slept: stall.slept + before.map_or(Duration::ZERO, |before| before.slept),
        });
    }

    /// When the thread last ran.
    pub fn last_run(&self) -> Instant {
        self.ran
    }

    /// The last stall of the thread.
    pub fn last(&self) -> Option<Stall> {
        self.last
    }

    /// The last pause, if bytes sent before its end may still arrive.
    pub fn pause(&self, now: Instant) -> Option<Stall> {
        self.pause.filter(|pause| now < pause.over())
    }

    /// Until when an earlier stall affects the time of received bytes.
    pub fn matters_until(&self) -> Option<Instant> {
        let last = self.last.map(|last| last.read_by());
        last.max(self.pause.map(|pause| pause.over()))
    }

    /// The arrival time of bytes that are read at `now`. No unread byte arrived before `floor`: the reader found
    /// nothing left then, or the bytes before these arrived then. `waited` means that the reader has been waiting
    /// since, so the bytes arrived just now unless its thread did not run.
    pub fn date(&self, floor: Instant, waited: bool, now: Instant) -> Dated {
        let since = self.last.filter(|stall| floor < stall.ended);
        let slept = since.map_or(Duration::ZERO, |stall| stall.slept);
        let floor = floor.checked_sub(slept).unwrap_or(floor);
        let stall = since.filter(|stall| now <= stall.read_by());
        let asked = match (waited, stall) {
            (false, _) => floor,
            (true, None) => now,
            (true, Some(stall)) => floor.max(stall.began),
        };
        Dated {
            earliest: asked.min(now),
            stall,
            pause: self.pause(now),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    struct Thread {
        start: Instant,
        stalls: Stalls,
    }

    impl Thread {
        fn new() -> Thread {
            let start = Instant::now();
            Thread {
                start,
                stalls: Stalls::new(start, Duration::from_secs(5000)),
            }
        }

        fn at(&self, ms: u32) -> Instant {
            self.start + MS * ms
        }

        /// Lets the thread run at each of these times, in milliseconds; the suspended time `slept` is not part of them.
        fn runs(&mut self, times: &[(u32, u32)]) -> Vec<(i64, i64, u128)> {
            let mut all = Vec::new();
            for (ms, slept) in times {
                let boot = Duration::from_secs(5000) + MS * (ms + slept);
                let stood = self.stalls.observe(self.at(*ms), boot);
                all.extend(stood.map(|s| (self.ms(s.began), self.ms(s.ended), s.slept.as_millis())));
            }
            all
        }

        fn ms(&self, at: Instant) -> i64 {
            let after = at.saturating_duration_since(self.start).as_millis() as i64;
            after - self.start.saturating_duration_since(at).as_millis() as i64
        }

        /// Date, stall and pause of the data that is read.
        fn reads(&self, floor: u32, waited: bool, now: u32) -> (i64, Option<(i64, i64)>, bool) {
            let dated = self.stalls.date(self.at(floor), waited, self.at(now));
            let stall = dated.stall.map(|s| (self.ms(s.began), self.ms(s.ended)));
            (self.ms(dated.earliest), stall, dated.pause.is_some())
        }
    }

    #[test]
    fn a_gap_between_two_turns_is_a_stall() {
        for (times, stalls) in [
            (&[(100, 0), (200, 0), (349, 0)][..], &[][..]),
            (&[(100, 0), (251, 0)], &[(100, 251, 0)]),
            (&[(100, 0), (3100, 0), (3200, 0)], &[(100, 3100, 0)]),
            // The machine was suspended for an hour, during which its clock did not advance.
            (&[(100, 0), (150, 3_600_000)], &[(-3_599_900, 150, 3_600_000)]),
            (&[(100, 0), (2100, 3000), (2200, 3000)], &[(-2900, 2100, 3000)]),
            // The two clocks are not read at exactly the same moment.
            (&[(100, 3), (200, 0), (300, 40), (400, 0)], &[]),
        ] {
            assert_eq!(Thread::new().runs(times), stalls, "{times:?}");
        }
    }

    #[test]
    fn what_was_no_stall_is_none() {
        let mut thread = Thread::new();
        let boot = Duration::from_secs(5010);
        thread.stalls.go_on(thread.at(10_000), boot);
        assert_eq!(thread.stalls.observe(thread.at(10_100), boot + 100 * MS), None);
    }

    #[test]
    fn the_date_of_what_is_read() {
        let mut thread = Thread::new();
        thread.runs(&[(100, 0), (2100, 0), (2200, 0)]);
        let stall = Some((100, 2100));
        for (what, floor, waited, now, expected) in [
            ("one that waited since long before", 20, true, 2101, (100, stall, true)),
            (
                "one that found nothing at last while it ran",
                100,
                true,
                2101,
                (100, stall, true),
            ),
            ("one that did not read since before", 20, false, 2101, (20, stall, true)),
            ("the second piece, found at once", 100, false, 2102, (100, stall, true)),
            ("it found nothing after the stall", 2101, true, 2103, (2103, None, true)),
            (
                "the same, and did not read for a time",
                2101,
                false,
                2203,
                (2101, None, true),
            ),
            ("the last moment", 20, true, 2350, (100, stall, true)),
            ("later, one that waited", 20, true, 2351, (2351, None, true)),
            ("later, one whose bytes lay there", 20, false, 2351, (20, None, true)),
            (
                "the pause is over when as long again has gone by and a second",
                20,
                true,
                5099,
                (5099, None, true),
            ),
            ("and no longer", 20, true, 5100, (5100, None, false)),
        ] {
            assert_eq!(thread.reads(floor, waited, now), expected, "{what}");
        }
    }

    #[test]
    fn what_came_before_the_machine_was_suspended_is_as_old_as_that() {
        let mut thread = Thread::new();
        thread.runs(&[(100, 0), (150, 60_000)]);
        let stall = Some((-59_900, 150));
        assert_eq!(thread.reads(90, true, 151), (-59_900, stall, true));
        assert_eq!(
            thread.reads(120, true, 151),
            (-59_880, stall, true),
            "it found nothing after that"
        );
        assert_eq!(thread.reads(50, false, 151), (-59_950, stall, true), "it did not read");
        assert_eq!(thread.reads(50, false, 500), (-59_950, None, true));
        assert_eq!(thread.reads(150, true, 160), (160, None, true));
    }

    #[test]
    fn a_hiccup_is_no_pause_however_often_it_comes() {
        let mut thread = Thread::new();
        let times: Vec<(u32, u32)> = (1..50).flat_map(|n| [(n * 500 - 100, 0), (n * 500, 0)]).collect();
        assert_eq!(thread.runs(&times).len(), 49);
        assert_eq!(thread.reads(0, true, 24_401), (24_000, Some((24_000, 24_400)), false));
    }

    #[test]
    fn stalls_close_to_each_other_are_one_for_what_is_not_read_yet() {
        let mut thread = Thread::new();
        thread.runs(&[(100, 0), (400, 0), (480, 0), (800, 0)]);
        assert_eq!(thread.reads(100, true, 801), (100, Some((100, 800)), false));
        let mut thread = Thread::new();
        thread.runs(&[(100, 0), (400, 0), (510, 0), (800, 0)]);
        assert_eq!(thread.reads(100, true, 801), (510, Some((510, 800)), false));
    }

    #[test]
    fn after_a_long_pause_old_connections_do_not_wait_for_ever() {
        let now = Instant::now();
        let stall = |seconds| Stall::new(now, now + Duration::from_secs(seconds));
        for (seconds, over) in [(2, 5), (100, 201), (3600, 3721)] {
            assert_eq!(stall(seconds).over(), now + Duration::from_secs(over), "{seconds} s");
        }
    }
}
