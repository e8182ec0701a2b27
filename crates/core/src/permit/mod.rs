//! Whether a command may move a motor now: one rule a file in `rules`, each with a table as its test. Pure.

pub mod rules;

/// The moments at which a command is judged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Moment {
    /// It is complete and is to take its place in the queue.
    Accept,
    /// The line is free for it.
    Turn,
    /// Its next frame is about to be sent.
    Write,
}

impl Moment {
    /// All, in the order in which they come.
    pub const ALL: [Moment; 3] = [Moment::Accept, Moment::Turn, Moment::Write];
}
