//! The public register map of Modbus TCP: common model, command block, float block and the gateway itself
//! (public contract, section 5). Pure.
//!
//! Addresses below [`FIRST`] are the drive's own; everything from there on is answered from here, for holding
//! and input registers alike. A figure that does not fit its register is served as "not available", never
//! clamped.

use std::time::Duration;

use crate::cache::Reading;
use crate::codec::Exception;
use crate::command::Refusal;
use crate::drive::profile::tidy;
use crate::drive::{ModelPoint, Profile, State, Value};

/// First address that is not the drive's own.
pub const FIRST: u16 = 0x8000;
/// Unit id under which the gateway itself is reached.
pub const GATEWAY_UNIT: u8 = 255;
/// Registers of a bus in the block of the gateway.
pub const BUS_BLOCK: u16 = 16;

const COMMAND_WORD: u16 = 0x8100;
const SPEED_REFERENCE: u16 = 0x8101;
const FREQUENCY_REFERENCE: u16 = 0x8102;
const HEARTBEAT: u16 = 0x8103;

/// "Not available" of a signed register.
const NO_I16: u16 = 0x8000;
/// "Not available" of an unsigned register.
const NO_U16: u16 = 0xFFFF;
/// Oldest age that is told apart, ms.
const MAX_AGE_MS: u128 = 65_534;

const RUN: u16 = 1 << 0;
const REVERSE: u16 = 1 << 1;
const FAULT_RESET: u16 = 1 << 2;
const STALE: u16 = 1 << 14;
const ONLINE: u16 = 1 << 15;

/// Bits 0 to 7 of the status register.
const STATUS_BITS: [ModelPoint; 8] = [
    ModelPoint::Ready,
    ModelPoint::Running,
    ModelPoint::Reversed,
    ModelPoint::Fault,
    ModelPoint::Warning,
    ModelPoint::AtReference,
    ModelPoint::ZeroSpeed,
    ModelPoint::Remote,
];

/// How a figure lies in registers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// One register, 0 to 65534; 0xFFFF is not available.
    U16,
    /// One register, -32767 to 32767; 0x8000 is not available.
    I16,
    /// Two registers, high word first, 0 to 2^32 - 2; 0xFFFFFFFF is not available.
    U32,
    /// Two registers, high word first, IEEE 754; NaN is not available.
    F32,
}

impl Form {
    /// Registers that it takes.
    pub fn registers(self) -> u16 {
        match self {
            Form::U16 | Form::I16 => 1,
            Form::U32 | Form::F32 => 2,
        }
    }

    /// The name in the printed map.
    pub fn name(self) -> &'static str {
        match self {
            Form::U16 => "u16",
            Form::I16 => "i16",
            Form::U32 => "u32",
            Form::F32 => "f32",
        }
    }

    /// What stands there when there is no value, for the printed map.
    pub fn not_available(self) -> &'static str {
        match self {
            Form::U16 => "0xFFFF",
            Form::I16 => "0x8000",
            Form::U32 => "0xFFFFFFFF",
            Form::F32 => "NaN",
        }
    }

    /// The registers of `value` counted in `1 / per_unit`; the second one of a 16-bit form means nothing.
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

/// What a place of the map tells.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Content {
    /// The status bits.
    Status,
    /// The state in one number.
    State,
    /// Age of the process data.
    Age,
    /// A point of the common model.
    Point(ModelPoint),
    /// The command bits; read: as the drive has them.
    Command,
    /// Any write renews the supervision; reads 0.
    Heartbeat,
}

/// One figure of the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Entry {
    /// First PDU address.
    pub address: u16,
    /// What it tells.
    pub content: Content,
    /// How it lies there.
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
const COMMON: [Entry; 17] = [
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
];

/// The command block, from 0x8100 on.
const COMMAND: [Entry; 4] = [
    entry(COMMAND_WORD, Content::Command, Form::U16, 1.0),
    point(SPEED_REFERENCE, ModelPoint::SpeedReference, Form::I16, 100.0),
    point(FREQUENCY_REFERENCE, ModelPoint::FrequencyReference, Form::U16, 100.0),
    entry(HEARTBEAT, Content::Heartbeat, Form::U16, 1.0),
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

/// The blocks of a drive, each without a gap, in the order of their addresses: common model, command block,
/// float block.
pub const BLOCKS: [&[Entry]; 3] = [&COMMON, &COMMAND, &FLOAT];

impl Entry {
    /// First address after it.
    fn end(&self) -> u32 {
        u32::from(self.address) + u32::from(self.form.registers())
    }

    /// Whether writes are taken there.
    pub fn is_command(&self) -> bool {
        (COMMAND_WORD..=HEARTBEAT).contains(&self.address)
    }

    fn registers(&self, look: &Look<'_>) -> [u16; 2] {
        match self.content {
            Content::Status => [look.status(), 0],
            Content::State => [look.state().code(), 0],
            Content::Age => [look.age_ms(), 0],
            Content::Point(point) => self.form.registers_of(look.good(point), self.per_unit),
            Content::Command => [look.command(), 0],
            Content::Heartbeat => [0, 0],
        }
    }
}

/// A drive as a Modbus TCP client sees it at one time.
#[derive(Debug)]
pub struct Look<'r> {
    reading: &'r Reading<'r>,
    bus_up: bool,
    stale: bool,
}

impl<'r> Look<'r> {
    /// The drive as `reading` shows it; while the bus is down nothing of it is good.
    pub fn new(reading: &'r Reading<'r>, bus_up: bool) -> Look<'r> {
        let stale = !bus_up || reading.is_stale();
        Look { reading, bus_up, stale }
    }

    /// Registers of the blocks from 0x8000 on, all of the same reading. A drive that is offline or stale is
    /// served too, with no value in it but its state and age.
    ///
    /// # Errors
    /// 02 when the span does not lie within one block.
    pub fn registers(&self, start: u16, count: u16) -> Result<Vec<u16>, Exception> {
        let (start, end) = (u32::from(start), u32::from(start) + u32::from(count));
        let inside = |block: &&&[Entry]| {
            block.first().is_some_and(|e| u32::from(e.address) <= start) && block.last().is_some_and(|e| end <= e.end())
        };
        let block = BLOCKS.iter().find(inside).ok_or(Exception::ADDRESS)?;
        let mut registers = Vec::with_capacity(usize::from(count));
        for entry in block.iter().filter(|e| e.end() > start && u32::from(e.address) < end) {
            let both = (u32::from(entry.address)..entry.end()).zip(entry.registers(self));
            registers.extend(both.filter(|(a, _)| (start..end).contains(a)).map(|(_, word)| word));
        }
        Ok(registers)
    }

    /// The figure of a point, when it is good; nothing of a stale drive is.
    fn good(&self, point: ModelPoint) -> Option<f64> {
        if self.stale {
            return None;
        }
        self.reading.model(point).good().map(Value::as_f64)
    }

    fn is_set(&self, point: ModelPoint) -> bool {
        self.good(point).is_some_and(|v| v != 0.0)
    }

    fn status(&self) -> u16 {
        let bits = (0u16..).zip(STATUS_BITS).filter(|(_, point)| self.is_set(*point));
        let bits = bits.fold(0, |word, (bit, _)| word | (1 << bit));
        let online = self.bus_up && self.reading.snapshot.link.is_online();
        bits | if self.stale { STALE } else { 0 } | if online { ONLINE } else { 0 }
    }

    fn state(&self) -> State {
        if self.stale {
            State::Offline
        } else {
            self.reading.state()
        }
    }

    fn age_ms(&self) -> u16 {
        self.reading
            .age()
            .map_or(NO_U16, |age| age.as_millis().min(MAX_AGE_MS) as u16)
    }

    /// "Not available" has bits set that a command may not have, so that it cannot be written back unnoticed.
    fn command(&self) -> u16 {
        let Some(run) = self.good(ModelPoint::Run) else {
            return NO_U16;
        };
        let run = if run != 0.0 { RUN } else { 0 };
        run | if self.is_set(ModelPoint::Reverse) { REVERSE } else { 0 }
    }
}

/// What a write to the command block means.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CommandWrite {
    /// Points to set as one command: index in the profile, value in engineering units. May be empty when
    /// only the heartbeat was written.
    pub points: Vec<(usize, Value)>,
    /// The word at 0x8100, if it was written.
    pub word: Option<u16>,
    /// The heartbeat was written.
    pub heartbeat: bool,
}

/// What writing `values` from `start` on means to a drive of that family. `last` is the word written at
/// 0x8100 before: a fault reset is the change of bit 2 from 0 to 1.
///
/// Where one write covers both references, the one that is "not available" (0x8000, 0xFFFF) is left alone.
///
/// # Errors
/// An address that takes no command or that the family lacks, then a value that is none.
pub fn command(profile: &Profile, start: u16, values: &[u16], last: u16) -> Result<CommandWrite, Refusal> {
    let both = values.len() > 1 && start <= SPEED_REFERENCE && usize::from(FREQUENCY_REFERENCE - start) < values.len();
    let writes: Vec<(u32, u16)> = (u32::from(start)..).zip(values.iter().copied()).collect();
    let outside = |a: &u32| !(u32::from(COMMAND_WORD)..=u32::from(HEARTBEAT)).contains(a);
    if let Some((address, _)) = writes.iter().find(|(a, _)| outside(a)) {
        return Err(Refusal::NotWritable(format!(
            "register 0x{address:04X} takes no writes; commands go to 0x8100 to 0x8103"
        )));
    }
    let mut write = CommandWrite::default();
    let mut bad = None;
    for (address, value) in writes {
        match address as u16 {
            COMMAND_WORD => {
                write.word = Some(value);
                bad = bad.or(command_word(profile, value, last, &mut write.points)?);
            }
            SPEED_REFERENCE if !(both && value == NO_I16) => {
                write.points.push((
                    writable(profile, ModelPoint::SpeedReference)?,
                    Value::Number(f64::from(value as i16) / 100.0),
                ));
                bad = bad.or((value == NO_I16).then(|| no_value(address)));
            }
            FREQUENCY_REFERENCE if !(both && value == NO_U16) => {
                write.points.push((
                    writable(profile, ModelPoint::FrequencyReference)?,
                    Value::Number(f64::from(value) / 100.0),
                ));
                bad = bad.or((value == NO_U16).then(|| no_value(address)));
            }
            HEARTBEAT => write.heartbeat = true,
            _ => {}
        }
    }
    let references = write
        .points
        .iter()
        .filter(|(_, v)| matches!(v, Value::Number(_)))
        .count();
    match bad {
        Some(refusal) => Err(refusal),
        None if references > 1 => Err(Refusal::BadValue(
            "two references in one command; send one and \"not available\" for the other; nothing was written"
                .to_string(),
        )),
        None if write.points.is_empty() && !write.heartbeat => Err(Refusal::BadValue(
            "both references are \"not available\"; nothing was written".to_string(),
        )),
        None => Ok(write),
    }
}

fn no_value(address: u32) -> Refusal {
    Refusal::BadValue(format!(
        "\"not available\" is no reference for register 0x{address:04X}; nothing was written"
    ))
}

fn writable(profile: &Profile, point: ModelPoint) -> Result<usize, Refusal> {
    let index = profile.model_index(point);
    let index = index.filter(|i| profile.points.get(*i).is_some_and(|p| p.write));
    index.ok_or_else(|| {
        Refusal::NotWritable(format!(
            "`{}` of profile `{}` cannot be written",
            point.name(),
            profile.name
        ))
    })
}

/// The points that the word at 0x8100 sets, or what is wrong with its value.
fn command_word(
    profile: &Profile,
    word: u16,
    last: u16,
    points: &mut Vec<(usize, Value)>,
) -> Result<Option<Refusal>, Refusal> {
    points.push((writable(profile, ModelPoint::Run)?, Value::Bool(word & RUN != 0)));
    if word & !(RUN | REVERSE | FAULT_RESET) != 0 {
        return Ok(Some(Refusal::BadValue(format!(
            "0x{word:04X} is no command: bits 3 to 15 must be 0; nothing was written"
        ))));
    }
    // Nothing is dropped in silence: a bit that the family lacks must be 0.
    let lacks = |refusal: Refusal| Ok(Some(Refusal::BadValue(refusal.to_string())));
    let reverse = word & REVERSE != 0;
    match writable(profile, ModelPoint::Reverse) {
        Ok(index) => points.push((index, Value::Bool(reverse))),
        Err(refusal) if reverse => return lacks(refusal),
        Err(_) => {}
    }
    if is_reset(word, last) {
        match writable(profile, ModelPoint::FaultReset) {
            Ok(index) => points.push((index, Value::Bool(true))),
            Err(refusal) => return lacks(refusal),
        }
    }
    Ok(None)
}

/// The word at 0x8100 after its fault reset did not reach the drive: the next write with bit 2 resets again.
pub fn without_reset(word: u16) -> u16 {
    word & !FAULT_RESET
}

/// Whether the word at 0x8100 asks for a fault reset after `last` stood there.
pub fn is_reset(word: u16, last: u16) -> bool {
    word & !last & FAULT_RESET != 0
}

/// What the gateway tells of one bus.
#[derive(Debug, Clone, PartialEq)]
pub struct BusFigures {
    /// Whether the port is open.
    pub up: bool,
    /// Drives configured.
    pub drives: usize,
    /// Drives that answer.
    pub online: usize,
    /// Share of the time in which the line is in use, 0..=1.
    pub load: f64,
    /// Achieved cycle of the fast class.
    pub cycle: Option<Duration>,
    /// Exchanges so far.
    pub transactions: u64,
    /// Exchanges that failed so far.
    pub errors: u64,
    /// Writes that wait for the line.
    pub queued: usize,
}

/// A register of a bus under unit 255, for the printed map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BusRegister {
    /// Place in the block of the bus.
    pub offset: u16,
    /// What it tells.
    pub name: &'static str,
    /// How it lies there.
    pub form: Form,
    /// Engineering value of one count.
    pub scale: &'static str,
    /// Unit.
    pub unit: &'static str,
}

const fn bus_register(offset: u16, name: &'static str, form: Form) -> BusRegister {
    BusRegister {
        offset,
        name,
        form,
        scale: "1",
        unit: "",
    }
}

/// The registers of a bus under unit 255; the rest of its block is reserved and reads 0.
pub const BUS_REGISTERS: [BusRegister; 8] = [
    bus_register(0, "state: 0 down, 1 up", Form::U16),
    bus_register(1, "drives configured", Form::U16),
    bus_register(2, "drives online", Form::U16),
    BusRegister {
        scale: "0.1",
        unit: "%",
        ..bus_register(3, "line load", Form::U16)
    },
    BusRegister {
        unit: "ms",
        ..bus_register(4, "cycle of the fast class", Form::U32)
    },
    bus_register(6, "transactions, modulo 2^32", Form::U32),
    bus_register(8, "errors, modulo 2^32", Form::U32),
    bus_register(10, "queued writes", Form::U16),
];

impl BusFigures {
    /// The block of the bus. A bus that is down has no drive online and no load; a cycle that was never
    /// measured is 0xFFFFFFFF; the counters run modulo 2^32; reserved registers are 0.
    pub fn registers(&self) -> [u16; BUS_BLOCK as usize] {
        let count = |n: usize| n.min(usize::from(u16::MAX - 1)) as u16;
        let ms = |cycle: Duration| (cycle.as_secs_f64() * 1000.0).round().min(f64::from(u32::MAX - 1)) as u32;
        let [cycle_high, cycle_low] = high_low(self.cycle.map_or(u32::MAX, ms));
        let [done_high, done_low] = high_low(self.transactions as u32);
        let [errors_high, errors_low] = high_low(self.errors as u32);
        [
            u16::from(self.up),
            count(self.drives),
            if self.up { count(self.online) } else { 0 },
            if self.up {
                (self.load.clamp(0.0, 1.0) * 1000.0).round() as u16
            } else {
                0
            },
            cycle_high,
            cycle_low,
            done_high,
            done_low,
            errors_high,
            errors_low,
            count(self.queued),
            0,
            0,
            0,
            0,
            0,
        ]
    }
}

/// Registers of the gateway itself; `bus` gives the figures of a bus by its place in the file.
///
/// # Errors
/// 02 when the span goes beyond the last bus.
pub fn gateway(start: u16, count: u16, bus: impl Fn(usize) -> Option<BusFigures>) -> Result<Vec<u16>, Exception> {
    let mut registers = Vec::with_capacity(usize::from(count));
    let end = start.checked_add(count).ok_or(Exception::ADDRESS)?;
    for block in start / BUS_BLOCK..end.div_ceil(BUS_BLOCK) {
        let figures = bus(usize::from(block)).ok_or(Exception::ADDRESS)?;
        let addressed = (u32::from(block) * u32::from(BUS_BLOCK)..).zip(figures.registers());
        registers.extend(
            addressed
                .filter(|(a, _)| (u32::from(start)..u32::from(end)).contains(a))
                .map(|(_, word)| word),
        );
    }
    Ok(registers)
}

#[cfg(test)]
mod tests;
