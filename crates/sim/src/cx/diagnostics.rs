//! Function 08 of the simulated CX: event counters and Listen Only Mode (reference/drives.md 4.6).

use drivegate_proto::{Exception, Reply};

/// Numbers of the subfunctions.
mod subfunction {
    pub(super) const ECHO: u16 = 0x0000;
    pub(super) const REINITIALISE: u16 = 0x0001;
    pub(super) const LISTEN_ONLY: u16 = 0x0004;
    pub(super) const CLEAR: u16 = 0x000A;
    pub(super) const BUS_MESSAGES: u16 = 0x000B;
    pub(super) const BUS_ERRORS: u16 = 0x000C;
    pub(super) const EXCEPTIONS: u16 = 0x000D;
    pub(super) const SLAVE_MESSAGES: u16 = 0x000E;
    pub(super) const NO_RESPONSES: u16 = 0x000F;
}

/// Event counters, which wrap at 16 bits.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counters {
    /// Valid frames on the line, for any address.
    pub bus_messages: u16,
    /// Counter of frames with a wrong checksum.
    pub bus_errors: u16,
    /// Counter of exceptions that this slave sent.
    pub exceptions: u16,
    /// Counter of frames for this slave, including broadcasts.
    pub slave_messages: u16,
    /// Frames for this slave that the slave did not answer, including broadcasts.
    pub no_responses: u16,
}

/// The diagnostics of the communication board.
#[derive(Debug, Clone, Default)]
pub(super) struct Diagnostics {
    pub(super) counters: Counters,
    listen_only: bool,
}

pub(super) fn count(counter: &mut u16) {
    *counter = counter.wrapping_add(1);
}

impl Diagnostics {
    pub(super) fn listens_only(&self) -> bool {
        self.listen_only
    }

    /// Whether the request ends Listen Only Mode; in that mode all other requests are ignored.
    pub(super) fn is_reinitialise(subfunction: u16, data: u16) -> bool {
        subfunction == subfunction::REINITIALISE && matches!(data, 0 | 0xFF00)
    }

    /// Resets the diagnostics to the state after power-on.
    pub(super) fn reinitialise(&mut self) {
        *self = Diagnostics::default();
    }

    /// Carries out the subfunction; `None` for the one without an answer.
    pub(super) fn serve(&mut self, subfunction: u16, data: u16) -> Option<Reply> {
        if Self::is_reinitialise(subfunction, data) {
            self.reinitialise();
            return Some(Reply::Diagnostics(data));
        }
        let counters = self.counters;
        let value = match subfunction {
            subfunction::ECHO => return Some(Reply::Diagnostics(data)),
            subfunction::REINITIALISE..=subfunction::NO_RESPONSES if data != 0 && known(subfunction) => {
                return Some(Reply::Exception(Exception::VALUE));
            }
            subfunction::LISTEN_ONLY => {
                self.listen_only = true;
                return None;
            }
            subfunction::CLEAR => {
                self.counters = Counters::default();
                0
            }
            subfunction::BUS_MESSAGES => counters.bus_messages,
            subfunction::BUS_ERRORS => counters.bus_errors,
            subfunction::EXCEPTIONS => counters.exceptions,
            subfunction::SLAVE_MESSAGES => counters.slave_messages,
            subfunction::NO_RESPONSES => counters.no_responses,
            _ => return Some(Reply::Exception(Exception::FUNCTION)),
        };
        Some(Reply::Diagnostics(value))
    }
}

fn known(subfunction: u16) -> bool {
    matches!(
        subfunction,
        subfunction::ECHO | subfunction::REINITIALISE | subfunction::LISTEN_ONLY | subfunction::CLEAR
            ..=subfunction::NO_RESPONSES
    )
}
