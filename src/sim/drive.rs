//! One simulated drive on a line: its model, who runs it by itself, and whether it answers.

use super::SimTime;
use super::autopilot::Autopilot;
use super::nx::{NxDrive, NxOptions};
use crate::codec::{Reply, RequestPdu};
use std::time::Duration;

/// Missed actions of an autopilot that lie longer back are passed over.
const LONGEST_CATCH_UP: Duration = Duration::from_secs(600);

/// How one drive on a simulated line is made.
#[derive(Debug, Clone)]
pub struct DriveOptions {
    /// Address on the line, 1..=247.
    pub address: u8,
    /// What it is.
    pub model: ModelOptions,
    /// Seed of an autopilot that runs it until a master writes to it; `None` leaves it to the masters.
    pub autopilot: Option<u64>,
}

/// The models, each with its options.
#[derive(Debug, Clone)]
pub enum ModelOptions {
    /// Vacon NX.
    Nx(NxOptions),
}

impl ModelOptions {
    /// The model that a profile names in its key `simulator`, with its default options.
    pub fn by_name(name: &str) -> Option<ModelOptions> {
        match name {
            "nx" => Some(ModelOptions::Nx(NxOptions::default())),
            _ => None,
        }
    }
}

impl DriveOptions {
    /// A Vacon NX with default options and without autopilot.
    pub fn nx(address: u8) -> DriveOptions {
        DriveOptions {
            address,
            model: ModelOptions::Nx(NxOptions::default()),
            autopilot: None,
        }
    }
}

#[derive(Debug, Clone)]
enum Model {
    Nx(NxDrive),
}

/// A drive of any model.
#[derive(Debug, Clone)]
pub struct SimulatedDrive {
    model: Model,
    autopilot: Option<Autopilot>,
    alive: bool,
}

impl SimulatedDrive {
    /// A drive that is switched on at `now`.
    pub fn new(options: DriveOptions, now: SimTime) -> SimulatedDrive {
        let model = match options.model {
            ModelOptions::Nx(nx) => Model::Nx(NxDrive::new(nx, now)),
        };
        SimulatedDrive {
            model,
            autopilot: options.autopilot.map(|seed| Autopilot::new(seed, now)),
            alive: true,
        }
    }

    /// Lives on until `now`.
    pub fn advance(&mut self, now: SimTime) {
        let Model::Nx(drive) = &mut self.model;
        if let Some(autopilot) = &mut self.autopilot {
            let earliest = now.saturating_sub(LONGEST_CATCH_UP);
            while autopilot.next_at() <= now {
                let at = autopilot.next_at().max(earliest);
                drive.advance(at);
                autopilot.act(drive, at);
            }
        }
        drive.advance(now);
    }

    /// Whether it answers: connected, and with supply.
    pub fn answers(&self) -> bool {
        let Model::Nx(drive) = &self.model;
        self.alive && drive.powered()
    }

    /// Takes it off the line (it goes on living) or puts it back.
    pub fn set_alive(&mut self, alive: bool) {
        self.alive = alive;
    }

    /// A valid message to this drive or to all was on the line.
    pub fn heard(&mut self, now: SimTime) {
        self.advance(now);
        let Model::Nx(drive) = &mut self.model;
        drive.heard(now);
    }

    /// The reply to a request that came whole at `now`. A write takes the drive from its autopilot for good.
    pub fn answer(&mut self, request: &RequestPdu, now: SimTime) -> Reply {
        self.advance(now);
        if request.is_write() {
            self.autopilot = None;
        }
        let Model::Nx(drive) = &mut self.model;
        drive.answer(request, now)
    }

    /// A request to all drives. Nobody answers it, so only writes have an effect.
    pub fn heard_broadcast(&mut self, request: &RequestPdu, now: SimTime) {
        if request.is_write() {
            let _: Reply = self.answer(request, now);
        }
    }

    /// Whether an autopilot still runs it.
    pub fn runs_by_itself(&self) -> bool {
        self.autopilot.is_some()
    }

    /// The Vacon NX that it is, if it is one.
    pub fn as_nx(&mut self) -> Option<&mut NxDrive> {
        let Model::Nx(drive) = &mut self.model;
        Some(drive)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec::Table;

    #[test]
    fn a_write_takes_the_drive_from_its_autopilot() {
        let mut drive = SimulatedDrive::new(
            DriveOptions {
                autopilot: Some(1),
                ..DriveOptions::nx(1)
            },
            SimTime::ZERO,
        );
        let minute = Duration::from_secs(60);
        drive.answer(
            &RequestPdu::Read {
                table: Table::Holding,
                start: 2100,
                count: 11,
            },
            minute,
        );
        assert!(drive.runs_by_itself(), "reading leaves it alone");
        drive.answer(
            &RequestPdu::WriteRegister {
                address: 2000,
                value: 0,
            },
            minute,
        );
        assert!(!drive.runs_by_itself());
        drive.advance(minute * 5);
        assert_eq!(drive.as_nx().unwrap().state().output, 0.0, "nobody starts it any more");
    }

    #[test]
    fn a_long_sleep_is_passed_over() {
        let mut drive = SimulatedDrive::new(
            DriveOptions {
                autopilot: Some(1),
                ..DriveOptions::nx(1)
            },
            SimTime::ZERO,
        );
        let year = Duration::from_secs(365 * 86_400);
        drive.advance(year);
        assert!(matches!(
            drive.answer(
                &RequestPdu::Read {
                    table: Table::Holding,
                    start: 2100,
                    count: 1
                },
                year
            ),
            Reply::Registers(_)
        ));
    }
}
