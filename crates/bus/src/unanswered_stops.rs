//! Stops to a silent drive: when the next one may be sent. Pure: time is an argument.
//!
//! Limits repeated stops to a silent drive. A person presses the button again, and the drive may listen again at
//! any moment: the next stop is sent after the other requests had the line for as long as the last stop took.
//! Endless stops must not take half of the line: beyond a few in a row they get a tenth, but wait no longer than
//! for one reply. On N2 each further stop also waits until no late reply can come.

use std::ops::RangeInclusive;
use std::time::{Duration, Instant};

/// Number of unanswered stops in a row that alternate with the other requests.
const IN_TURN: f64 = 8.0;
/// Pause after further stops, as a multiple of the duration of the last one, up to the time for a reply.
const PAUSE: u32 = 10;

/// The stops of one drive without a reply.
#[derive(Debug, Default)]
pub(super) struct VainStops {
    /// Number of useless stops in a row; one less for each pause.
    count: f64,
    /// Duration of the transactions of the present one so far.
    took: Duration,
    last: Option<Instant>,
    until: Option<Instant>,
}

impl VainStops {
    /// Notes that a stop got no reply and took the line for `took`.
    pub(super) fn not_answered(&mut self, took: Duration) {
        self.took += took;
    }

    /// A stop failed without any reply; `pauses` are the shortest and the longest pause before the next one.
    pub(super) fn in_vain(&mut self, pauses: RangeInclusive<Duration>, now: Instant) {
        let took = std::mem::take(&mut self.took);
        let share = took * PAUSE;
        let (shortest, longest) = pauses.into_inner();
        let in_turn = took.max(shortest);
        let pause = share.min(longest).max(in_turn);
        if let Some(last) = self.last.replace(now) {
            let paid = now.saturating_duration_since(last).as_secs_f64() / share.as_secs_f64().max(1e-6);
            self.count = (self.count - paid).max(0.0);
        }
        self.count += 1.0;
        self.until = Some(now + if self.keeps_its_turn() { in_turn } else { pause });
    }

    fn keeps_its_turn(&self) -> bool {
        self.count <= IN_TURN
    }

    /// Notes that the drive replied.
    pub(super) fn answered(&mut self) {
        *self = VainStops::default();
    }

    /// Until when the next stop waits; `None` if it need not wait.
    pub(super) fn waits_until(&self, now: Instant) -> Option<Instant> {
        self.until.filter(|until| *until > now)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stop_pressed_again_goes_out_in_turn_and_a_flood_gets_a_tenth() {
        let ms = Duration::from_millis;
        for took in [ms(60), ms(1000)] {
            let (mut stops, mut now) = (VainStops::default(), Instant::now());
            let mut pauses = Vec::new();
            for _ in 0..40 {
                now += took;
                stops.not_answered(took);
                stops.in_vain(Duration::ZERO..=ms(1000), now);
                let until = stops.waits_until(now).unwrap();
                pauses.push(until - now);
                now = until;
                assert_eq!(stops.waits_until(now), None);
            }
            assert!(pauses[..8].iter().all(|pause| *pause == took), "{pauses:?}");
            let last: Duration = pauses[20..].iter().sum();
            assert!(last >= took * 20, "a flood has the line to itself: {pauses:?}");
            assert!(
                pauses[20..].iter().all(|pause| *pause <= (took * 10).min(ms(1000))),
                "{pauses:?}"
            );
            stops.answered();
            stops.not_answered(took);
            stops.in_vain(Duration::ZERO..=ms(1000), now);
            assert_eq!(stops.waits_until(now), Some(now + took));
        }
    }

    #[test]
    fn a_stop_a_second_is_never_held_up() {
        let (mut stops, mut now) = (VainStops::default(), Instant::now());
        for _ in 0..1000 {
            stops.not_answered(Duration::from_millis(100));
            stops.in_vain(Duration::ZERO..=Duration::from_secs(1), now);
            now += Duration::from_secs(1);
            assert_eq!(stops.waits_until(now), None);
        }
    }
}
