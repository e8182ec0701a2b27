//! The public register map of Modbus TCP: common model, command block, float block and the gateway itself
//! (`docs/modbus-tcp.md`).
//!
//! Addresses below [`FIRST`] are those of the drive. Holding and input registers from there on are equal. A value
//! that does not fit its register is shown as "not available", never clamped.

mod command;
mod gateway;

pub(crate) use command::{CommandContext, CommandWrite, FAULT_RESET, command};
pub use gateway::{BUS_BLOCK, BUS_REGISTERS, BusFigures, gateway};

use drivegate_core::permit::{HoldState, HoldView};
use drivegate_core::process_image::Reading;
use drivegate_model::drive::tidy;
use drivegate_model::drive::{ModelPoint, State, Value};
use drivegate_proto::Exception;

/// First address that does not belong to the drive.
pub const FIRST: u16 = 0x8000;
/// Unit id of the gateway itself.
pub const GATEWAY_UNIT: u8 = 255;
/// Register of unit 255 to which 1 is written to stop all drives.
pub const STOP_ALL: u16 = 0x0100;
/// Register of unit 255 with the number of controlled drives not known to have stopped.
pub const NOT_STANDING: u16 = 0x8101;

const COMMAND_WORD: u16 = 0x8100;
const SPEED_REFERENCE: u16 = 0x8101;
const FREQUENCY_REFERENCE: u16 = 0x8102;
pub(crate) const HEARTBEAT: u16 = 0x8103;
/// Register by which a client takes, renews, releases or breaks the hold of the drive.
pub(crate) const HOLD: u16 = 0x8104;

/// Value of a signed register for "not available".
const NO_I16: u16 = 0x8000;
/// Value of an unsigned register for "not available".
const NO_U16: u16 = 0xFFFF;
/// Maximum age that the age register can show, ms.
const MAX_AGE_MS: u128 = 65_534;

const RUN: u16 = 1 << 0;
const REVERSE: u16 = 1 << 1;
const STALE: u16 = 1 << 14;
const ONLINE: u16 = 1 << 15;

/// How a value is encoded in registers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// A register, 0 to 65534; 0xFFFF is not available.
    U16,
    /// A register, -32767 to 32767; 0x8000 is not available.
    I16,
    /// Two registers, high word first, 0 to 2^32 - 2; 0xFFFFFFFF is not available.
    U32,
    /// Two registers, high word first, IEEE 754; NaN is not available.
    F32,
}

impl Form {
    /// Number of registers.
    pub fn registers(self) -> u16 {
        match self {
            Form::U16 | Form::I16 => 1,
            Form::U32 | Form::F32 => 2,
        }
    }

    /// Name in the printed map.
    pub fn name(self) -> &'static str {
        match self {
            Form::U16 => "u16",
            Form::I16 => "i16",
            Form::U32 => "u32",
            Form::F32 => "f32",
        }
    }

    /// The register content for "not available", for the printed map.
    pub fn not_available(self) -> &'static str {
        match self {
            Form::U16 => "0xFFFF",
            Form::I16 => "0x8000",
            Form::U32 => "0xFFFFFFFF",
            Form::F32 => "NaN",
        }
    }

    /// The registers of `value` in steps of `1 / per_unit`; the second one is unused by 16-bit forms.
    fn registers_of(self, value: Option<f64>, per_unit: f64) -> [u16; 2] {
        let count = |least: f64, most: f64| {
            value
                .map(|v| tidy(v * per_unit).round())
                .filter(|c| (least..=most).contains(c))
        };
        match self {
            Form::U16 => [count(0.0, 65_534.0).map_or(NO_U16, |c| c as u16), 0],
            Form::I16 => [count(-32_767.0, 32_767.0).map_or(NO_I16, |c| c as i16 as u16), 0],
            Form::U32 => high_low(count(0.0, f64::from(u32::MAX - 1)).map_or(u32::MAX, |c| c as u32)),
            Form::F32 => {
                let float = value.map(|v| v as f32).filter(|v| v.is_finite()).unwrap_or(f32::NAN);
                high_low(float.to_bits())
            }
        }
    }
}

fn high_low(word: u32) -> [u16; 2] {
    [(word >> 16) as u16, word as u16]
}

/// The content of a map entry.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Content {
    /// The status bits.
    Status,
    /// The state as a number.
    State,
    /// Age of the process data.
    Age,
    /// A point of the common model.
    Point(ModelPoint),
    /// The command bits; reading returns the present command of the drive.
    Command,
    /// Any write renews the supervision; reading returns 0.
    Heartbeat,
    /// The holder of the drive.
    Holder,
    /// Time for which the hold still lasts.
    HoldLeft,
    /// Whether the client holds the drive; a write takes, renews, releases or breaks the hold. Only with `[authority]`.
    Hold,
}

/// A value of the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Entry {
    /// First PDU address.
    pub address: u16,
    /// Content of the value.
    pub content: Content,
    /// How the value is encoded.
    pub form: Form,
    /// Counts for one unit of the point.
    pub per_unit: f64,
}

const fn entry(address: u16, content: Content, form: Form, per_unit: f64) -> Entry {
    Entry {
        address,
        content,
        form,
        per_unit,
    }
}

const fn point(address: u16, point: ModelPoint, form: Form, per_unit: f64) -> Entry {
    entry(address, Content::Point(point), form, per_unit)
}

/// The common model, from 0x8000 on.
const COMMON: [Entry; 19] = [
    entry(0x8000, Content::Status, Form::U16, 1.0),
    entry(0x8001, Content::State, Form::U16, 1.0),
    entry(0x8002, Content::Age, Form::U16, 1.0),
    point(0x8003, ModelPoint::FaultCode, Form::U16, 1.0),
    point(0x8004, ModelPoint::ActualSpeed, Form::I16, 100.0),
    point(0x8005, ModelPoint::OutputFrequency, Form::I16, 100.0),
    point(0x8006, ModelPoint::MotorSpeed, Form::I16, 1.0),
    point(0x8007, ModelPoint::MotorCurrent, Form::I16, 10.0),
    point(0x8008, ModelPoint::MotorTorque, Form::I16, 10.0),
    point(0x8009, ModelPoint::MotorPower, Form::I16, 10.0),
    point(0x800A, ModelPoint::MotorVoltage, Form::U16, 10.0),
    point(0x800B, ModelPoint::DcLinkVoltage, Form::U16, 1.0),
    point(0x800C, ModelPoint::HeatsinkTemperature, Form::I16, 10.0),
    point(0x800D, ModelPoint::Energy, Form::U32, 1.0),
    point(0x800F, ModelPoint::OperatingHours, Form::U32, 1.0),
    point(0x8011, ModelPoint::SpeedReference, Form::I16, 100.0),
    point(0x8012, ModelPoint::FrequencyReference, Form::I16, 100.0),
    entry(0x8013, Content::Holder, Form::U16, 1.0),
    entry(0x8014, Content::HoldLeft, Form::U16, 1.0),
];

/// The command block, from 0x8100 on.
const COMMAND: [Entry; 5] = [
    entry(COMMAND_WORD, Content::Command, Form::U16, 1.0),
    point(SPEED_REFERENCE, ModelPoint::SpeedReference, Form::I16, 100.0),
    point(FREQUENCY_REFERENCE, ModelPoint::FrequencyReference, Form::U16, 100.0),
    entry(HEARTBEAT, Content::Heartbeat, Form::U16, 1.0),
    entry(HOLD, Content::Hold, Form::U16, 1.0),
];

/// The float block, from 0x8200 on.
const FLOAT: [Entry; 13] = [
    point(0x8200, ModelPoint::ActualSpeed, Form::F32, 1.0),
    point(0x8202, ModelPoint::OutputFrequency, Form::F32, 1.0),
    point(0x8204, ModelPoint::MotorSpeed, Form::F32, 1.0),
    point(0x8206, ModelPoint::MotorCurrent, Form::F32, 1.0),
    point(0x8208, ModelPoint::MotorTorque, Form::F32, 1.0),
    point(0x820A, ModelPoint::MotorPower, Form::F32, 1.0),
    point(0x820C, ModelPoint::MotorVoltage, Form::F32, 1.0),
    point(0x820E, ModelPoint::DcLinkVoltage, Form::F32, 1.0),
    point(0x8210, ModelPoint::HeatsinkTemperature, Form::F32, 1.0),
    point(0x8212, ModelPoint::Energy, Form::F32, 1.0),
    point(0x8214, ModelPoint::OperatingHours, Form::F32, 1.0),
    point(0x8216, ModelPoint::SpeedReference, Form::F32, 1.0),
    point(0x8218, ModelPoint::FrequencyReference, Form::F32, 1.0),
];

/// The blocks of a drive, each without gaps, in the order of their addresses.
pub const BLOCKS: [&[Entry]; 3] = [&COMMON, &COMMAND, &FLOAT];

impl Entry {
    /// First address after this register entry.
    fn end(&self) -> u32 {
        u32::from(self.address) + u32::from(self.form.registers())
    }

    /// Whether the entry can be written.
    pub fn is_command(&self) -> bool {
        (COMMAND_WORD..=HOLD).contains(&self.address)
    }

    fn registers(&self, view: &DriveView<'_>) -> [u16; 2] {
        match self.content {
            Content::Status => [view.status(), 0],
            Content::State => [view.state().map_or(NO_U16, State::code), 0],
            Content::Age => [view.age_ms(), 0],
            Content::Point(point) => self.form.registers_of(view.good(point), self.per_unit),
            Content::Command => [view.command(), 0],
            Content::Heartbeat => [0, 0],
            Content::Holder => [view.holder(), 0],
            Content::HoldLeft => [view.hold_left(), 0],
            Content::Hold => [u16::from(view.hold.as_ref().is_some_and(|(_, own)| *own)), 0],
        }
    }
}

/// Whether the port of a bus is open.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum BusState {
    /// The port of the bus is open.
    Up,
    /// The port of the bus is closed, so no value is current.
    Down,
}

/// A drive as Modbus TCP clients see it at one time.
#[derive(Debug)]
pub(crate) struct DriveView<'r> {
    reading: &'r Reading<'r>,
    bus: BusState,
    stale: bool,
    /// Hold of the drive, and whether this client has it; `None` if `[authority]` is off.
    hold: Option<(HoldView, bool)>,
}

impl<'r> DriveView<'r> {
    /// The drive as in `reading`; while its bus is down no value is good.
    pub(crate) fn new(reading: &'r Reading<'r>, bus: BusState) -> DriveView<'r> {
        let stale = bus == BusState::Down || reading.is_stale();
        DriveView {
            reading,
            bus,
            stale,
            hold: None,
        }
    }

    /// Adds the hold, and whether this client has it.
    pub(crate) fn with_hold(mut self, hold: Option<(HoldView, bool)>) -> DriveView<'r> {
        self.hold = hold;
        self
    }

    /// Registers of the blocks from 0x8000 on, all from one reading. A drive that is offline or stale has a state
    /// and an age but no values.
    ///
    /// # Errors
    /// Exception 02 if the span is not within one block.
    pub(crate) fn registers(&self, start: u16, count: u16) -> Result<Vec<u16>, Exception> {
        let (start, end) = (u32::from(start), u32::from(start) + u32::from(count));
        let inside = |block: &&&[Entry]| {
            let mapped = |e: &&Entry| e.content != Content::Hold || self.hold.is_some();
            let last = block.iter().rev().find(mapped);
            block.first().is_some_and(|e| u32::from(e.address) <= start) && last.is_some_and(|e| end <= e.end())
        };
        let block = BLOCKS.iter().find(inside).ok_or(Exception::ADDRESS)?;
        let mut registers = Vec::with_capacity(usize::from(count));
        for entry in block.iter().filter(|e| e.end() > start && u32::from(e.address) < end) {
            let both = (u32::from(entry.address)..entry.end()).zip(entry.registers(self));
            registers.extend(both.filter(|(a, _)| (start..end).contains(a)).map(|(_, word)| word));
        }
        Ok(registers)
    }

    /// The value of a point if it is good; a stale drive has no good values.
    fn good(&self, point: ModelPoint) -> Option<f64> {
        if self.stale {
            return None;
        }
        self.reading.model(point).good().map(Value::as_f64)
    }

    /// A bit of the model; `None` if the family has the bit but its value is not good.
    fn bit(&self, point: ModelPoint) -> Option<bool> {
        self.reading.bit(point).filter(|_| !self.stale)
    }

    /// A bit that is not good is 0 and marks the word as stale.
    fn status(&self) -> u16 {
        let mut word = if self.stale { STALE } else { 0 };
        for (bit, point) in (0u16..).zip(ModelPoint::STATUS_WORD) {
            word |= self.bit(point).map_or(STALE, |set| u16::from(set) << bit);
        }
        let online = self.bus == BusState::Up && self.reading.snapshot.link.is_online();
        word | if online { ONLINE } else { 0 }
    }

    fn state(&self) -> Option<State> {
        if self.stale {
            Some(State::Offline)
        } else {
            self.reading.state()
        }
    }

    /// Holder of the drive as a register value: 0 free, 1 this client, 2 another client, 3 local control, 4
    /// reserved after a stop.
    fn holder(&self) -> u16 {
        match &self.hold {
            None => NO_U16,
            Some((view, own)) => match view.state {
                HoldState::Free => 0,
                HoldState::Held => 2 - u16::from(*own),
                HoldState::Local => 3,
                HoldState::Reserved => 4,
            },
        }
    }

    fn hold_left(&self) -> u16 {
        let left = self.hold.as_ref().and_then(|(view, _)| view.left_s);
        left.map_or(NO_U16, |left| left.min(65_534) as u16)
    }

    fn age_ms(&self) -> u16 {
        self.reading
            .age()
            .map_or(NO_U16, |age| age.as_millis().min(MAX_AGE_MS) as u16)
    }

    /// The command register: "not available" has bits set that are invalid in a command, so that writing it back is
    /// refused.
    fn command(&self) -> u16 {
        let (Some(run), Some(reverse)) = (self.good(ModelPoint::Run), self.bit(ModelPoint::Reverse)) else {
            return NO_U16;
        };
        let run = if run != 0.0 { RUN } else { 0 };
        run | if reverse { REVERSE } else { 0 }
    }
}

#[cfg(test)]
mod tests;
