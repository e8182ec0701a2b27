//! Whether a connection stays awake for the next request. No I/O, no clock of its own.
//!
//! A processor that sleeps is woken some 20 microseconds after the bytes came, and the client's as late again: on one
//! machine, that is most of the time of a request. A client that asks again at once is therefore awaited with open eyes,
//! but only while it is the only busy one, for some microseconds, for a limited share of all time, and only where it pays:
//! where client and gateway share a processor, sleep is quicker.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Longest look-out for one request.
const PATIENCE: Duration = Duration::from_micros(50);
/// A client whose requests come so quickly to who has slept will ask within [`PATIENCE`] when seen at once.
const QUICK: Duration = Duration::from_micros(100);
/// So many such requests in a row show what the client is like.
const STREAK: u32 = 8;
/// One part in so many of the time of one processor, at most, ...
const SHARE: u32 = 5;
/// ... and while it does not pay: as much as it takes to see whether it does.
const TRIAL: u32 = 200;
/// Credit that can be saved up.
const MOST: Duration = Duration::from_millis(2);
/// A request counts as no longer than that: one that met a busy processor tells little.
const LONGEST: Duration = Duration::from_micros(200);

/// Counts what comes to any connection of the server.
#[derive(Debug, Default)]
pub(super) struct Turns(AtomicU64);

impl Turns {
    /// Something came; which turn that is, from 1.
    pub(super) fn next(&self) -> u64 {
        self.0.fetch_add(1, Ordering::Relaxed) + 1
    }

    /// The latest turn.
    pub(super) fn last(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

/// What one connection knows of its client.
#[derive(Debug)]
pub(super) struct Lookout {
    /// Requests in a row that came quickly, with no other client served in between.
    streak: u32,
    /// The turn in which this connection was served last, and when.
    turn: u64,
    at: Instant,
    credit: Duration,
    /// From request to request, on average, when it was slept in between and when it was looked out.
    slept: Duration,
    looked: Duration,
}

impl Lookout {
    pub(super) fn new(now: Instant) -> Lookout {
        Lookout {
            streak: 0,
            turn: 0,
            at: now,
            credit: Duration::ZERO,
            slept: LONGEST,
            looked: Duration::ZERO,
        }
    }

    /// Input has come at `now`, and was `looked` out for or not; `turn` counts what came to any connection.
    pub(super) fn served(&mut self, turn: u64, now: Instant, looked: bool) {
        let alone = turn.wrapping_sub(self.turn) == 1;
        let period = now.saturating_duration_since(self.at);
        (self.turn, self.at) = (turn, now);
        let earned = period / if self.pays() { SHARE } else { TRIAL };
        self.credit = (self.credit + earned).min(MOST);
        if looked {
            self.looked = (self.looked * 7 + period.min(LONGEST)) / 8;
        } else if self.streak > 0 {
            self.slept = (self.slept * 7 + period.min(LONGEST)) / 8;
        }
        self.streak = if alone && period <= QUICK {
            self.streak.saturating_add(1)
        } else {
            0
        };
    }

    /// Whether requests come a tenth more often when they are looked out for.
    fn pays(&self) -> bool {
        self.looked * 11 <= self.slept * 10
    }

    /// How long to look out for the next request; `None` to go to sleep.
    pub(super) fn patience(&self) -> Option<Duration> {
        (self.streak >= STREAK && self.credit >= PATIENCE).then_some(PATIENCE)
    }

    /// Whether to give up because `turn` shows that others are served.
    pub(super) fn is_disturbed(&self, turn: u64) -> bool {
        turn != self.turn
    }

    /// So long it was looked out.
    pub(super) fn spent(&mut self, time: Duration) {
        self.credit = self.credit.saturating_sub(time);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const US: Duration = Duration::from_micros(1);

    /// A client alone, whose requests come `slept` apart, or `looked` when it is looked out for.
    struct Client {
        now: Instant,
        turn: u64,
        spent: Duration,
        lookout: Lookout,
    }

    impl Client {
        fn new() -> Client {
            let now = Instant::now();
            Client {
                now,
                turn: 0,
                spent: Duration::ZERO,
                lookout: Lookout::new(now),
            }
        }

        /// A request after `time`; whether it was looked out for.
        fn ask(&mut self, slept: Duration, looked: Duration) -> bool {
            let patience = self.lookout.patience();
            self.turn += 1;
            let time = patience.map_or(slept, |_| looked);
            if let Some(patience) = patience {
                self.lookout.spent(time.min(patience));
                self.spent += time.min(patience);
            }
            self.now += time;
            self.lookout.served(self.turn, self.now, patience.is_some());
            patience.is_some()
        }

        /// Share of the time that was spent on look-outs, and requests in a second.
        fn run(&mut self, slept: Duration, looked: Duration) -> (f64, f64) {
            let (begin, spent, turn) = (self.now, self.spent, self.turn);
            for _ in 0..100_000 {
                self.ask(slept, looked);
            }
            let time = (self.now - begin).as_secs_f64();
            (
                (self.spent - spent).as_secs_f64() / time,
                (self.turn - turn) as f64 / time,
            )
        }
    }

    #[test]
    fn only_a_quick_client_that_is_alone_is_looked_out_for() {
        let mut client = Client::new();
        client.now += Duration::from_secs(1);
        let quick = |client: &mut Client| client.ask(40 * US, 20 * US);
        for turn in 0..=STREAK {
            assert!(!quick(&mut client), "after {turn}; the first one came late");
        }
        assert!(quick(&mut client));
        assert!(!client.lookout.is_disturbed(client.turn) && client.lookout.is_disturbed(client.turn + 1));
        // Another client had a turn.
        client.turn += 1;
        quick(&mut client);
        assert!(!quick(&mut client));
        for _ in 1..STREAK {
            quick(&mut client);
        }
        assert!(quick(&mut client));
        client.ask(QUICK + US, QUICK + US);
        assert!(!quick(&mut client), "after a slow request");
    }

    #[test]
    fn no_more_than_its_share_of_the_time_is_spent() {
        let (share, rate) = Client::new().run(60 * US, 30 * US);
        assert!((0.195..0.2001).contains(&share), "{share}");
        assert!(rate > 1.15 / 60e-6, "{rate}");
    }

    #[test]
    fn what_does_not_pay_is_only_tried_now_and_then() {
        let mut client = Client::new();
        // As on one processor: who looks out keeps the client from asking.
        let (share, rate) = client.run(15 * US, 60 * US);
        assert!(share < 0.006, "{share}");
        assert!(rate > 0.98 / 15e-6, "{rate}");
        // It is seen when that changes.
        let (share, _) = client.run(60 * US, 30 * US);
        assert!(share > 0.15, "{share}");
    }

    #[test]
    fn a_pause_saves_up_little() {
        let mut client = Client::new();
        client.now += Duration::from_secs(3600);
        for _ in 0..=STREAK {
            client.ask(40 * US, 20 * US);
        }
        let mut looked = 0;
        while client.lookout.patience().is_some() {
            client.lookout.spent(PATIENCE);
            looked += 1;
        }
        assert_eq!(looked, MOST.as_micros() / PATIENCE.as_micros());
    }
}
