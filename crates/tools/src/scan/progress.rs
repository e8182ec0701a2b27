//! Progress of the scan and its estimated time.

use std::collections::VecDeque;
use std::io::{IsTerminal, Write};
use std::time::{Duration, Instant};

use crate::printable;

/// Width of the progress bar in characters.
const BAR: usize = 24;
/// Shortest interval between updates of a terminal.
const PAUSE: Duration = Duration::from_millis(100);
/// Shortest interval between lines in a file.
const LINE_PAUSE: Duration = Duration::from_secs(10);
/// Steps that the estimate is averaged over.
const REMEMBERED: usize = 32;

/// A bar on standard error, or a line now and then where that is not a terminal.
#[derive(Debug)]
pub(super) struct Progress {
    total: usize,
    done: usize,
    /// Time of all remaining steps if no drive replies.
    patience: Duration,
    /// Time that each of the last steps took, and the longest time that it could have taken.
    steps: VecDeque<(Duration, Duration)>,
    begun: Instant,
    shown: Option<Instant>,
    live: bool,
}

impl Progress {
    pub(super) fn new() -> Progress {
        Progress {
            total: 0,
            done: 0,
            patience: Duration::ZERO,
            steps: VecDeque::new(),
            begun: Instant::now(),
            shown: None,
            live: std::io::stderr().is_terminal(),
        }
    }

    /// Plans this number of further steps, which take `patience` at most.
    pub(super) fn plan(&mut self, steps: usize, patience: Duration) {
        self.total = self.done + steps;
        self.patience = patience;
    }

    /// Shows what is being tried.
    pub(super) fn show(&mut self, what: &str) {
        let now = Instant::now();
        self.begun = now;
        let pause = if self.live { PAUSE } else { LINE_PAUSE };
        if self.shown.is_some_and(|shown| now.duration_since(shown) < pause) {
            return;
        }
        self.shown = Some(now);
        let text = line(self.done, self.total, left(&self.steps, self.patience), what);
        self.print(&text);
    }

    /// Counts an address as done; the step could have taken `patience`.
    pub(super) fn step(&mut self, patience: Duration) {
        self.done = (self.done + 1).min(self.total);
        self.patience = self.patience.saturating_sub(patience);
        self.steps.push_back((self.begun.elapsed(), patience));
        if self.steps.len() > REMEMBERED {
            self.steps.pop_front();
        }
    }

    /// Prints a line above the progress bar.
    pub(super) fn print_line(&mut self, text: &str) {
        let clear = if self.live { "\r\x1b[K" } else { "" };
        // If stderr is closed, this error cannot be reported anywhere.
        let _ = writeln!(std::io::stderr().lock(), "{clear}{}", printable::line(text));
        self.shown = None;
    }

    /// Clears the progress bar.
    pub(super) fn end(&mut self, early: bool) {
        if self.live {
            let _ = write!(std::io::stderr().lock(), "\r\x1b[K");
        }
        if early {
            self.print_line(&format!("stopped after {} of {} addresses", self.done, self.total));
        }
    }

    fn print(&self, text: &str) {
        let mut stderr = std::io::stderr().lock();
        let text = printable::line(text);
        let _ = if self.live {
            write!(stderr, "\r\x1b[K{text}").and_then(|()| stderr.flush())
        } else {
            writeln!(stderr, "{text}")
        };
    }
}

/// Estimated time for the remaining steps, which take `patience` at most: the share of their maximum time that the last
/// steps took is expected again.
fn left(steps: &VecDeque<(Duration, Duration)>, patience: Duration) -> Duration {
    let took: Duration = steps.iter().map(|(took, _)| *took).sum();
    let most: Duration = steps.iter().map(|(_, most)| *most).sum();
    if most.is_zero() {
        patience
    } else {
        patience.mul_f64(took.as_secs_f64() / most.as_secs_f64())
    }
}

fn line(done: usize, total: usize, left: Duration, what: &str) -> String {
    let full = BAR * done / total.max(1);
    let seconds = left.as_secs();
    let left = match seconds {
        0..=90 => format!("{} s", seconds + 1),
        _ => format!("{} min", seconds.div_ceil(60)),
    };
    let bar = "#".repeat(full) + &".".repeat(BAR - full);
    format!("[{bar}] {:3} %, {left} left, {what}", 100 * done / total.max(1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line() {
        assert_eq!(
            line(25, 100, Duration::from_secs(30), "modbus-rtu 9600 8N1, address 26"),
            "[######..................]  25 %, 31 s left, modbus-rtu 9600 8N1, address 26"
        );
        assert!(line(0, 0, Duration::ZERO, "").contains("0 %"));
        assert!(line(3, 9, Duration::from_secs(600), "").contains("10 min left"));
    }

    #[test]
    fn the_estimate_follows_what_was_measured() {
        let ms = Duration::from_millis;
        assert_eq!(left(&VecDeque::new(), ms(1200)), ms(1200));
        let steps = VecDeque::from([(ms(10), ms(40)), (ms(30), ms(40))]);
        assert_eq!(left(&steps, ms(1200)), ms(600));
    }

    #[test]
    fn a_plan_can_change() {
        let mut progress = Progress::new();
        progress.plan(100, Duration::from_secs(10));
        progress.step(Duration::from_millis(100));
        progress.plan(9, Duration::from_secs(1));
        assert_eq!((progress.done, progress.total), (1, 10));
        assert_eq!(progress.patience, Duration::from_secs(1));
    }
}
