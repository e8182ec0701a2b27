//! One value for each rank of commands.

use drivegate_core::order::Urgency;

/// The ranks of commands, highest first.
pub(crate) const RANKS: [Urgency; 3] = [Urgency::Stop, Urgency::Command, Urgency::Read];

/// One value for each rank: every rank has its place, so that access cannot fail.
#[derive(Debug, Default)]
pub(crate) struct PerRank<T> {
    pub(crate) stop: T,
    pub(crate) command: T,
    pub(crate) read: T,
}

impl<T> PerRank<T> {
    /// The value of this rank.
    pub(crate) fn of(&self, rank: Urgency) -> &T {
        match rank {
            Urgency::Stop => &self.stop,
            Urgency::Command => &self.command,
            Urgency::Read => &self.read,
        }
    }

    /// The value of this rank, to change it.
    pub(crate) fn of_mut(&mut self, rank: Urgency) -> &mut T {
        match rank {
            Urgency::Stop => &mut self.stop,
            Urgency::Command => &mut self.command,
            Urgency::Read => &mut self.read,
        }
    }

    /// The values, highest rank first.
    pub(crate) fn iter(&self) -> impl Iterator<Item = &T> {
        [&self.stop, &self.command, &self.read].into_iter()
    }

    /// The values, highest rank first, to change them.
    pub(crate) fn iter_mut(&mut self) -> impl Iterator<Item = &mut T> {
        [&mut self.stop, &mut self.command, &mut self.read].into_iter()
    }
}
