//! What a command requires of the hold of a drive. Pure.

use crate::command::{Command, Effect, Order, Urgency};
use crate::drive::DriveIndex;

/// What a command requires of the hold of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Asks {
    /// It may start the motor: needs the hold, takes a free drive.
    Run,
    /// A reference or a direction: the same, but starts nothing.
    Steer,
    /// A fault reset, a parameter, any other raw write: passes if the drive is free, and takes no hold.
    Other,
    /// Takes the run command away: always passes.
    Stop,
    /// Nothing: a read, or a write of a restore that has started and is not to be left half done.
    Nothing,
}

impl Asks {
    /// What a command requires of that drive's hold.
    pub fn of(command: &Command, drive: DriveIndex) -> Asks {
        match command.stops(drive) {
            true => Asks::Stop,
            false => Asks::by(&command.order, command.urgency, command.effect(drive)),
        }
    }

    /// What a command of that rank with that effect requires.
    pub fn by(order: &Order, urgency: Urgency, effect: Effect) -> Asks {
        match (urgency, order) {
            (Urgency::Stop, _) => Asks::Stop,
            (Urgency::Read, _) | (_, Order::Read(_) | Order::Parameter(_)) => Asks::Nothing,
            (Urgency::Command, Order::Points(_) | Order::Write(_)) => Asks::by_effect(effect),
        }
    }

    fn by_effect(effect: Effect) -> Asks {
        if effect.run == Some(true) || effect.word {
            Asks::Run
        } else if effect.reverse.is_some() || effect.reference {
            Asks::Steer
        } else {
            Asks::Other
        }
    }

    /// Whether it takes a free drive.
    pub fn takes(self) -> bool {
        matches!(self, Asks::Run | Asks::Steer)
    }
}
