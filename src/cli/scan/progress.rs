//! Progress of the scan and its estimated time.

use std::collections::VecDeque;
use std::io::{IsTerminal, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crate::cli::printable;

/// Characters of the bar.
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
    steps: VecDeque<Duration>,
    begun: Instant,
    shown: Option<Instant>,
    live: bool,
    stop: Arc<AtomicBool>,
}

impl Progress {
    pub(super) fn new(total: usize, stop: Arc<AtomicBool>) -> Progress {
        Progress {
            total,
            done: 0,
            steps: VecDeque::new(),
            begun: Instant::now(),
            shown: None,
            live: std::io::stderr().is_terminal(),
            stop,
        }
    }

    /// Shows what is tried now, which takes `patience` at most.
    pub(super) fn show(&mut self, what: &str, patience: Duration) {
        let now = Instant::now();
        self.begun = now;
        let pause = if self.live { PAUSE } else { LINE_PAUSE };
        if self.shown.is_some_and(|shown| now.duration_since(shown) < pause) {
            return;
        }
        self.shown = Some(now);
        let text = line(
            self.done,
            self.total,
            left(&self.steps, self.total - self.done, patience),
            what,
        );
        self.print(&text);
    }

    /// One address is done.
    pub(super) fn step(&mut self) {
        self.done = (self.done + 1).min(self.total);
        self.steps.push_back(self.begun.elapsed());
        if self.steps.len() > REMEMBERED {
            self.steps.pop_front();
        }
    }

    /// Prints a line that stays.
    pub(super) fn print_line(&mut self, text: &str) {
        let clear = if self.live { "\r\x1b[K" } else { "" };
        // With stderr gone there is nowhere left to report that.
        let _ = writeln!(std::io::stderr().lock(), "{clear}{}", printable::line(text));
        self.shown = None;
    }

    /// Clears the bar.
    pub(super) fn end(&mut self) {
        if self.live {
            let _ = write!(std::io::stderr().lock(), "\r\x1b[K");
        }
        if self.stop.load(Ordering::Relaxed) {
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

/// Estimated time for the remaining addresses: by the mean of the last ones, or by the longest time of the first.
fn left(steps: &VecDeque<Duration>, remaining: usize, patience: Duration) -> Duration {
    let remaining = u32::try_from(remaining).unwrap_or(u32::MAX);
    match u32::try_from(steps.len()) {
        Ok(count) if count > 0 => steps.iter().sum::<Duration>() / count * remaining,
        _ => patience * remaining,
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
        assert_eq!(left(&VecDeque::new(), 10, ms(120)), ms(1200));
        assert_eq!(left(&VecDeque::from([ms(10), ms(30)]), 10, ms(120)), ms(200));
    }
}
