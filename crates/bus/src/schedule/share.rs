//! The share of commands on a busy line: at most as much time as process data.
//!
//! The share of commands contains everything that a command causes: its steps, reads of the drive's control word,
//! forwarded reads, and the reads that confirm it. Otherwise a client that writes often would slow down polls
//! twice.

use std::time::Duration;

use super::COMMANDS_IN_A_ROW;
use drivegate_core::order::Urgency;

/// Time of the line that was used in advance, before the others have paid for it.
#[derive(Debug, Default)]
struct Lead {
    time: Duration,
    /// Duration of the last transaction: a burst may be ahead by eight of these.
    took: Duration,
}

impl Lead {
    fn charge(&mut self, took: Duration) {
        self.time += took;
        self.took = took;
    }

    /// Adds a transaction that is sent regardless of room. It uses up the room until it is paid for, and is not
    /// counted beyond that: otherwise the others would wait without limit.
    fn fill(&mut self, took: Duration) {
        let full = (self.time + took).min(COMMANDS_IN_A_ROW * took);
        (self.time, self.took) = (self.time.max(full), took);
    }

    fn pay(&mut self, took: Duration) {
        self.time = self.time.saturating_sub(took);
    }

    fn has_room(&self) -> bool {
        self.time.is_zero() || self.time < COMMANDS_IN_A_ROW * self.took
    }
}

#[derive(Debug, Default)]
pub(super) struct CommandShare {
    /// Time caused by all commands, in excess of process data; counted since polls last had nothing to do.
    all: Lead,
    /// Time used by stops alone, which wait for no other command.
    stops: Lead,
    /// Commands since the last poll, with the reads that they cause.
    in_a_row: u32,
    stops_in_a_row: u32,
    /// Commands since the last read that one of them caused.
    unread: u32,
    /// Whether no poll went since the last read for a command.
    asked_last: bool,
}

impl CommandShare {
    /// No poll is due: any request may have the line.
    pub(super) fn line_is_free(&mut self) {
        self.all.time = Duration::ZERO;
        self.stops.time = Duration::ZERO;
    }

    /// Whether a command of this rank is sent before a due poll. A stop waits for one poll at most, and only if
    /// stops alone used half of the line time.
    pub(super) fn admits(&self, urgency: Urgency) -> bool {
        match urgency {
            Urgency::Stop => {
                self.stops_in_a_row < COMMANDS_IN_A_ROW && (self.stops_in_a_row == 0 || self.stops.has_room())
            }
            Urgency::Command | Urgency::Read => self.in_a_row < COMMANDS_IN_A_ROW && self.all.has_room(),
        }
    }

    /// Whether a read for a command goes before the next command. One such read shows the effect of all earlier
    /// commands, so waiting commands go first, up to eight.
    pub(super) fn reads_before_commands(&self, command_waits: bool) -> bool {
        !command_waits || self.unread >= COMMANDS_IN_A_ROW
    }

    /// Whether a read for a command goes before a due poll: never two of them in a row, and none if stops already
    /// use their half of the line.
    pub(super) fn reads_before_polls(&self) -> bool {
        let room = self.all.has_room() && self.stops.has_room();
        !self.asked_last && self.in_a_row < COMMANDS_IN_A_ROW && room
    }

    /// A command, or a step of one, took that time.
    pub(super) fn commanded(&mut self, urgency: Urgency, took: Duration) {
        self.in_a_row += 1;
        self.unread += 1;
        if urgency == Urgency::Stop {
            self.stops_in_a_row += 1;
            self.all.fill(took);
            self.stops.charge(took);
        } else {
            self.stops_in_a_row = 0;
            self.all.charge(took);
        }
    }

    /// A read for a command took this time.
    pub(super) fn read(&mut self, took: Duration) {
        self.in_a_row += 1;
        self.stops_in_a_row = 0;
        self.unread = 0;
        self.asked_last = true;
        self.all.time += took;
    }

    /// Notes the end of a poll. `paid` is the time that commands may take for it.
    pub(super) fn polled(&mut self, paid: Duration) {
        self.in_a_row = 0;
        self.stops_in_a_row = 0;
        self.asked_last = false;
        self.all.pay(paid);
        self.stops.pay(paid);
    }
}
