//! Events of a world; the last ones are printed when a check fails.

use std::collections::VecDeque;
use std::time::Duration;

/// Entries kept, of single orders and commands; and where one seed is run again, of all that was on the lines.
const KEPT: [usize; 2] = [160, 40_000];

pub struct History {
    long: bool,
    entries: VecDeque<(Duration, Box<dyn FnOnce() -> String>)>,
}

impl Default for History {
    fn default() -> History {
        History {
            long: std::env::var_os("WORLD_SEED").is_some(),
            entries: VecDeque::new(),
        }
    }
}

impl History {
    /// Whether all is noted that was on the lines.
    pub fn is_long(&self) -> bool {
        self.long
    }

    /// Notes an entry; its text is only created when it is needed.
    pub fn note(&mut self, at: Duration, words: impl FnOnce() -> String + 'static) {
        if self.entries.len() == KEPT[usize::from(self.long)] {
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
