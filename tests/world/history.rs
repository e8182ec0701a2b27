//! What happened in a world, of which the end is printed when a check fails.

use std::collections::VecDeque;
use std::time::Duration;

/// Entries kept.
const KEPT: usize = 160;

#[derive(Default)]
pub struct History {
    entries: VecDeque<(Duration, Box<dyn FnOnce() -> String>)>,
}

impl History {
    /// Notes something; the words are made when they are wanted.
    pub fn note(&mut self, at: Duration, words: impl FnOnce() -> String + 'static) {
        if self.entries.len() == KEPT {
            self.entries.pop_front();
        }
        self.entries.push_back((at, Box::new(words)));
    }

    /// The end of the history, one line an entry.
    pub fn take(&mut self) -> String {
        let line = |(at, words): (Duration, Box<dyn FnOnce() -> String>)| {
            format!("{:>12.6} s  {}\n", at.as_secs_f64(), words())
        };
        self.entries.drain(..).map(line).collect()
    }
}
