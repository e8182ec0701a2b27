//! One simulated drive on a line: its model, its autopilot, and whether it answers.

use super::SimTime;
use super::autopilot::Autopilot;
use super::by_profile::{ProfileDrive, ProfileOptions};
use super::cx::{CxDrive, CxOptions};
pub use super::model::Command;
use super::model::{DriveState, Model};
use super::nx::{NxDrive, NxOptions};
use super::random::Random;
use super::teco::{TecoDrive, TecoOptions};
use drivegate_model::drive::Profile;
use drivegate_proto::{Exception, Reply, RequestPdu};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

pub use super::parameter_set::Writes;

/// Missed actions of an autopilot that are older than this are skipped.
const LONGEST_CATCH_UP: Duration = Duration::from_secs(600);

/// Options of one drive on a simulated line.
#[derive(Debug, Clone)]
pub struct DriveOptions {
    /// Address on the line, 1..=247, with N2 to 255.
    pub address: u8,
    /// Model of the drive.
    pub model: ModelOptions,
    /// Seed of an autopilot that operates the drive until a master writes to it; `None` leaves it to the masters.
    pub autopilot: Option<u64>,
}

/// The drive models, each with its options.
#[derive(Debug, Clone)]
pub enum ModelOptions {
    /// Vacon NX, Eaton SVX, Eaton HVX.
    Nx(NxOptions),
    /// Vacon CX, CXL, CXS.
    Cx(CxOptions),
    /// A TECO 7300PA with its PA-C card.
    Teco(TecoOptions),
    /// A drive of any profile.
    Profile(ProfileOptions),
}

impl ModelOptions {
    /// Names of models that [`ModelOptions::by_name`] knows.
    pub const NAMES: [&'static str; 5] = ["nx", "svx", "hvx", "cx", "teco"];

    /// The model with this name in the key `simulator` of a profile, with its default options.
    pub fn by_name(name: &str) -> Option<ModelOptions> {
        Some(match name {
            "nx" => ModelOptions::Nx(NxOptions::vacon()),
            "svx" => ModelOptions::Nx(NxOptions::svx()),
            "hvx" => ModelOptions::Nx(NxOptions::hvx()),
            "cx" => ModelOptions::Cx(CxOptions::default()),
            "teco" => ModelOptions::Teco(TecoOptions::default()),
            _ => return None,
        })
    }

    /// The drive that a profile describes: the model that it names, otherwise one derived from its points and
    /// `[control]`. `None` if the profile cannot be simulated.
    pub fn of_profile(profile: &Arc<Profile>) -> Option<ModelOptions> {
        let named = profile.simulator.as_deref().and_then(ModelOptions::by_name);
        let by_profile =
            || ProfileOptions::can_simulate(profile).then(|| ModelOptions::Profile(ProfileOptions::new(profile)));
        named.or_else(by_profile)
    }

    /// Adds or removes the simulator's own register that trips a fault.
    pub fn set_trip_register(&mut self, on: bool) {
        match self {
            ModelOptions::Nx(nx) => nx.trip_register = on,
            ModelOptions::Cx(cx) => cx.trip_register = on,
            ModelOptions::Teco(teco) => teco.trip_register = on,
            ModelOptions::Profile(of) => of.trip_register = on,
        }
    }

    /// PDU address of the simulator's own holding register that trips a fault; no real drive has it.
    pub fn trip_address(&self) -> u16 {
        match self {
            ModelOptions::Nx(_) => NxOptions::TRIP_ADDRESS,
            ModelOptions::Cx(_) => CxOptions::TRIP_ADDRESS,
            ModelOptions::Teco(_) => TecoOptions::TRIP_ADDRESS,
            ModelOptions::Profile(of) => of.trip_address(),
        }
    }

    /// Response delay of the drive where its manual states one; otherwise the line's applies.
    pub fn turnaround(&self) -> Option<Duration> {
        match self {
            ModelOptions::Nx(_) | ModelOptions::Cx(_) => None,
            ModelOptions::Teco(teco) => teco.turnaround,
            ModelOptions::Profile(of) => of.turnaround,
        }
    }

    /// Leaves the time before an answer to the rules of the line.
    pub fn take_turnaround_of_line(&mut self) {
        match self {
            ModelOptions::Nx(_) | ModelOptions::Cx(_) => {}
            ModelOptions::Teco(teco) => teco.turnaround = None,
            ModelOptions::Profile(of) => of.turnaround = None,
        }
    }
}

impl DriveOptions {
    /// A drive without autopilot.
    pub fn new(address: u8, model: ModelOptions) -> DriveOptions {
        DriveOptions {
            address,
            model,
            autopilot: None,
        }
    }

    /// A Vacon NX with default options and without autopilot.
    pub fn nx(address: u8) -> DriveOptions {
        DriveOptions::new(address, ModelOptions::Nx(NxOptions::default()))
    }
}

#[derive(Debug, Clone)]
enum AnyModel {
    Nx(NxDrive),
    Cx(CxDrive),
    Teco(TecoDrive),
    Profile(Box<ProfileDrive>),
}

impl AnyModel {
    fn get(&self) -> &dyn Model {
        match self {
            AnyModel::Nx(drive) => drive,
            AnyModel::Cx(drive) => drive,
            AnyModel::Teco(drive) => drive,
            AnyModel::Profile(drive) => drive.as_ref(),
        }
    }

    fn get_mut(&mut self) -> &mut dyn Model {
        match self {
            AnyModel::Nx(drive) => drive,
            AnyModel::Cx(drive) => drive,
            AnyModel::Teco(drive) => drive,
            AnyModel::Profile(drive) => drive.as_mut(),
        }
    }
}

/// A drive of any model.
#[derive(Debug, Clone)]
pub struct SimulatedDrive {
    model: AnyModel,
    turnaround: Option<Duration>,
    autopilot: Option<Autopilot>,
    alive: bool,
    /// How often the drive was switched on again.
    power_cycles: u32,
}

impl SimulatedDrive {
    /// A drive that is switched on at `now`.
    pub fn new(options: DriveOptions, now: SimTime) -> SimulatedDrive {
        SimulatedDrive {
            turnaround: options.model.turnaround(),
            model: match options.model {
                ModelOptions::Nx(nx) => AnyModel::Nx(NxDrive::new(nx, now)),
                ModelOptions::Cx(cx) => AnyModel::Cx(CxDrive::new(cx, now)),
                ModelOptions::Teco(teco) => AnyModel::Teco(TecoDrive::new(teco, now)),
                ModelOptions::Profile(of) => AnyModel::Profile(Box::new(ProfileDrive::new(of, now))),
            },
            autopilot: options.autopilot.map(|seed| Autopilot::new(seed, now)),
            alive: true,
            power_cycles: 0,
        }
    }

    /// Advances the drive to `now`.
    pub fn advance(&mut self, now: SimTime) {
        let drive = self.model.get_mut();
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

    /// Whether the drive answers: connected, and with supply.
    pub fn answers(&self) -> bool {
        self.alive && self.model.get().powered()
    }

    /// Disconnects the drive from the line (the drive keeps running) or connects it again.
    pub fn set_alive(&mut self, alive: bool) {
        self.alive = alive;
    }

    /// Response delay, if the manual of the drive states one.
    pub fn turnaround(&self) -> Option<Duration> {
        self.turnaround
    }

    /// Notes a valid message on the line to this drive or to all drives.
    pub fn message_received(&mut self, now: SimTime) {
        self.advance(now);
        self.model.get_mut().message_received(now);
    }

    /// Notes a valid frame on the line to any address. Must be called before the frame takes effect.
    pub(crate) fn bus_message(&mut self) {
        self.model.get_mut().bus_message();
    }

    /// A frame with a wrong check code was on the line.
    pub(crate) fn bus_error(&mut self) {
        self.model.get_mut().bus_error();
    }

    /// The reply to a request that was complete at `now`; `None` when the drive stays silent. A write ends the autopilot for
    /// good.
    pub fn answer(&mut self, request: &RequestPdu, now: SimTime) -> Option<Reply> {
        self.advance(now);
        if request.is_write() {
            self.autopilot = None;
        }
        self.model.get_mut().answer(request, now)
    }

    /// The reply to a valid frame whose PDU is not a valid request, for which a plain slave returns `exception`; `None` when the
    /// drive stays silent.
    pub fn malformed(&mut self, pdu: &[u8], exception: Exception, now: SimTime) -> Option<Exception> {
        self.advance(now);
        self.model.get_mut().malformed(pdu, exception, now)
    }

    /// The answer to a frame to this drive with a wrong check code; `None` if the drive stays silent.
    pub(crate) fn check_error(&self) -> Option<Exception> {
        self.model.get().check_error()
    }

    /// A broadcast was received, which is not answered; a write ends the autopilot for good.
    pub(crate) fn broadcast_received(&mut self, request: &RequestPdu, now: SimTime) {
        self.advance(now);
        if request.is_write() {
            self.autopilot = None;
        }
        self.model.get_mut().broadcast(request, now);
    }

    /// Trips the drive with this fault, coded as in its registers; 0 does nothing.
    pub fn trip(&mut self, fault: u16) {
        self.model.get_mut().trip(fault);
    }

    /// Commands the drive as another master on the bus would.
    pub fn command(&mut self, command: Command) {
        self.model.get_mut().command(command);
    }

    /// Pulls the fault reset bit of the bus up or down.
    pub fn set_reset(&mut self, on: bool) {
        self.model.get_mut().set_reset(on);
    }

    /// Gives control of the drive to the bus, or to panel or terminals.
    pub fn set_remote(&mut self, on: bool) {
        self.model.get_mut().set_remote(on);
    }

    /// Switches the mode in which the drive accepts all parameters and does not run: PRGM and DRIVE of a TECO.
    /// Other drives have no such modes.
    pub fn set_programming(&mut self, on: bool) {
        self.model.get_mut().set_programming(on);
    }

    /// Switches the supply off.
    pub fn power_off(&mut self) {
        self.model.get_mut().power_off();
    }

    /// Switches the supply on again.
    pub fn power_on(&mut self, now: SimTime) {
        self.model.get_mut().power_on(now);
        self.power_cycles = self.power_cycles.wrapping_add(1);
    }

    /// Number of power cycles so far; a device with the same supply has restarted equally often.
    pub(crate) fn power_cycles(&self) -> u32 {
        self.power_cycles
    }

    /// State of the drive as seen from outside.
    pub fn state(&self) -> DriveState {
        self.model.get().state()
    }

    /// Writes over the bus to the drive's parameters since it was created, by PDU address.
    pub fn parameter_writes(&self) -> BTreeMap<u16, Writes> {
        self.model.get().parameter_writes()
    }

    /// Gives its parameters random valid values from this seed; the control place does not change.
    pub fn fill_parameters(&mut self, seed: u64) {
        self.model.get_mut().fill_parameters(&mut Random::new(seed));
    }

    /// The drive as one of the Vacon NX family; `None` if it is another model.
    pub fn as_nx(&mut self) -> Option<&mut NxDrive> {
        match &mut self.model {
            AnyModel::Nx(drive) => Some(drive),
            _ => None,
        }
    }

    /// The drive as a Vacon CX; `None` if it is another model.
    #[cfg(test)]
    pub(crate) fn as_cx(&mut self) -> Option<&mut CxDrive> {
        match &mut self.model {
            AnyModel::Cx(drive) => Some(drive),
            _ => None,
        }
    }
}

#[cfg(test)]
mod properties;

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_proto::Table;

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
        drive.answer(&RequestPdu::read(Table::Holding, 2100, 11), minute);
        assert!(drive.autopilot.is_some(), "reading leaves it alone");
        drive.answer(&RequestPdu::write_register(2000, 0), minute);
        assert!(drive.autopilot.is_none());
        drive.advance(minute * 5);
        assert_eq!(drive.state().output, 0.0, "the autopilot does not start it again");
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
            drive.answer(&RequestPdu::read(Table::Holding, 2100, 1), year),
            Some(Reply::Registers(_))
        ));
    }
}
