//! The N2 board of a simulated drive: it waits for Identify, has objects with attributes, reports changes and takes
//! overrides (n2.md; reference/drives.md 6.2 to 6.7). Pure: the time is an argument.
//!
//! The drive behind the N2 board gets requests as over Modbus, see [`maps`]. Behaviour that no manual specifies is
//! an option or an entry of [`drivegate_proto::n2::assumptions`].

pub(crate) mod maps;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

pub(crate) use maps::{Entry, Map};

use self::maps::{Backing, Beyond};
use super::SimTime;
use drivegate_proto::n2::assumptions::{CONFIG_REPORT_BIT, INVALID_FLOAT, N2Options, STATUS_OVERRIDE_BIT};
use drivegate_proto::n2::command::{CHECKSUM, DATA, LONGEST_REPORT, RESTARTED, SIZE, TYPE, UNKNOWN, checksum};
use drivegate_proto::n2::{Answer, Command, Object, Region};
use drivegate_proto::{Exception, Reply, RequestPdu};

/// Time without a poll after which a drive considers itself disconnected (reference/drives.md 6.5).
pub(crate) const MASTER_TIMEOUT: Duration = Duration::from_secs(600);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BoardOptions {
    /// Whether a byte with the status of the object precedes the value in the reply to a read.
    pub leading_byte: bool,
    /// Whether refusals have a checksum.
    pub nak_checksum: bool,
    /// Bit of a status byte that is the state of BI and BO.
    pub state_bit: u8,
    /// Device type that Identify returns.
    pub device_type: u8,
    /// Whether the board answers nothing before Identify.
    pub waits_for_identify: bool,
}

impl Default for BoardOptions {
    fn default() -> Self {
        BoardOptions {
            leading_byte: false,
            nak_checksum: false,
            state_bit: N2Options::DEFAULT.state_bit,
            device_type: N2Options::DEFAULT.device_type,
            waits_for_identify: true,
        }
    }
}

/// The drive to which the board belongs; it may give no reply.
pub(crate) type Model<'m> = &'m mut dyn FnMut(&RequestPdu) -> Option<Reply>;

/// The N2 board of one drive.
#[derive(Debug, Clone)]
pub struct Board {
    /// Options of the board; may change at any time.
    pub options: BoardOptions,
    map: &'static Map,
    waiting: bool,
    /// Attributes set over the bus: configuration bytes, limits and times, by object and attribute.
    attributes: BTreeMap<(Object, u8), Vec<u8>>,
    /// Overridden objects with the given values.
    overridden: BTreeMap<Object, Vec<u8>>,
    /// Status of the objects as last reported.
    reported: BTreeMap<Object, u8>,
    /// Records that are not acknowledged yet, a reply each.
    reports: VecDeque<Vec<u8>>,
    /// Whether the first of these reports was sent.
    has_sent_reports: bool,
    polled: SimTime,
    /// Number of the drive's power cycles that the board has followed.
    power_cycles: u32,
}

impl Board {
    /// A board that was just switched on.
    pub fn new(map: &'static Map, now: SimTime) -> Board {
        Board {
            options: BoardOptions::default(),
            map,
            waiting: true,
            attributes: BTreeMap::new(),
            overridden: BTreeMap::new(),
            reported: BTreeMap::new(),
            reports: VecDeque::new(),
            has_sent_reports: false,
            polled: now,
            power_cycles: 0,
        }
    }

    /// The board restarts, as after a power cycle or a warm reset.
    pub fn restart(&mut self, now: SimTime) {
        let (options, power_cycles) = (self.options, self.power_cycles);
        *self = Board {
            options,
            power_cycles,
            ..Board::new(self.map, now)
        };
    }

    /// Informs the board how often the drive, which supplies it, was switched on again so far.
    pub fn fed(&mut self, power_cycles: u32, now: SimTime) {
        if std::mem::replace(&mut self.power_cycles, power_cycles) != power_cycles {
            self.restart(now);
        }
    }

    /// Appends the answer to a command to `out`; `Err` is the error code of an invalid frame. Nothing is appended
    /// if the drive stays silent.
    pub fn answer(&mut self, command: &Result<Command, u8>, now: SimTime, model: Model<'_>, out: &mut Vec<u8>) {
        if self.map.stands_alone && now.saturating_sub(self.polled) > MASTER_TIMEOUT {
            self.overridden.clear();
            self.polled = now;
        }
        let identify = matches!(command, Ok(Command::Identify));
        let waits = self.waiting && self.options.waits_for_identify && !identify;
        let answer = match command {
            Err(CHECKSUM) => Err(CHECKSUM),
            _ if waits => Err(RESTARTED),
            Err(code) => Err(*code),
            Ok(command) => match self.act(command, now, model) {
                Ok(Some(answer)) => Ok(answer),
                Ok(None) => return,
                Err(code) => Err(code),
            },
        };
        self.encode(&answer.unwrap_or_else(Answer::Nak), out);
    }

    fn encode(&self, answer: &Answer, out: &mut Vec<u8>) {
        match answer {
            Answer::Nak(code) if self.options.nak_checksum => {
                let digits = format!("{code:02X}");
                let sum = checksum(digits.as_bytes());
                out.extend(format!("N{digits}{sum:02X}\r").into_bytes());
            }
            _ => answer.encode(out),
        }
    }

    fn act(&mut self, command: &Command, now: SimTime, model: Model<'_>) -> Result<Option<Answer>, u8> {
        match command {
            Command::Identify => {
                if std::mem::take(&mut self.waiting) {
                    self.polled = now;
                }
                self.full_report(model);
                Ok(Some(Answer::bytes(&[self.options.device_type])))
            }
            Command::Poll { again } => {
                self.polled = now;
                if *again && std::mem::take(&mut self.has_sent_reports) {
                    self.reports.pop_front();
                }
                self.note_changes(model);
                self.has_sent_reports = !self.reports.is_empty();
                Ok(Some(self.reports.front().cloned().map_or(Answer::Ack, Answer::Data)))
            }
            Command::WarmReset if self.map.warm_reset => {
                self.restart(now);
                Ok(Some(Answer::Ack))
            }
            Command::WarmReset | Command::ReadMemory | Command::Status => Err(UNKNOWN),
            Command::SyncTime | Command::Other => Ok(Some(Answer::Ack)),
            Command::Read { object, attribute } => self.read(*object, *attribute, model),
            Command::Write {
                object,
                attribute,
                data,
            } => self.write(*object, *attribute, data).map(|()| Some(Answer::Ack)),
            Command::Override { object, data } => self.set(*object, data, model).map(|()| Some(Answer::Ack)),
            Command::Release { object } => {
                self.entry(*object)?;
                self.overridden.remove(object);
                Ok(Some(Answer::Ack))
            }
        }
    }

    fn entry(&self, object: Object) -> Result<&'static Entry, u8> {
        let here = |entry: &&Entry| entry.region == object.region && entry.number == object.number;
        self.map.entries.iter().find(here).ok_or(DATA)
    }

    fn read(&mut self, object: Object, attribute: u8, model: Model<'_>) -> Result<Option<Answer>, u8> {
        use Region::{Adf, Adi, Ai, Ao, Bd, Bi, Bo};
        let entry = self.entry(object)?;
        let byte = |value: u8| Ok(Some(Answer::bytes(&[value])));
        match (object.region, attribute) {
            (Ai | Bi | Ao | Bo, 1) => byte(self.configuration(object)),
            (Ai | Bi | Ao | Bo, 2) | (Adf | Adi | Bd, 1) => match self.status(entry, object, model) {
                Some(status) => byte(status),
                None => Ok(None),
            },
            (Ai | Ao, 3) => {
                let value = self.float(entry, object, model);
                Ok(value.map(|value| self.value(object, &value.to_be_bytes())))
            }
            (Ai, 8..=12) if self.map.has_limits => {
                let limit = self.attributes.get(&(object, attribute));
                let value = limit.cloned().unwrap_or_else(|| INVALID_FLOAT.to_be_bytes().to_vec());
                Ok(Some(self.value(object, &value)))
            }
            (Bo, 3..=5) => {
                let time = self.attributes.get(&(object, attribute)).cloned();
                Ok(Some(self.value(object, &time.unwrap_or_else(|| vec![0, 0]))))
            }
            (Adi, 2) => {
                if let Some(value) = self.overridden.get(&object) {
                    return Ok(Some(self.value(object, value)));
                }
                let value = fetch(entry.place, model);
                Ok(value.map(|value| self.value(object, &(value as i32 as u16).to_be_bytes())))
            }
            _ => Err(TYPE),
        }
    }

    /// A value of more than a byte, in the form that this board uses.
    fn value(&self, object: Object, value: &[u8]) -> Answer {
        if self.options.leading_byte {
            let overridden = u8::from(self.overridden.contains_key(&object)) << STATUS_OVERRIDE_BIT;
            Answer::bytes(&[&[overridden], value].concat())
        } else {
            Answer::bytes(value)
        }
    }

    fn configuration(&self, object: Object) -> u8 {
        let byte = self.attributes.get(&(object, 1)).and_then(|data| data.first().copied());
        byte.unwrap_or(0)
    }

    fn status(&self, entry: &Entry, object: Object, model: Model<'_>) -> Option<u8> {
        let overridden = self.overridden.get(&object);
        let mut status = u8::from(overridden.is_some()) << STATUS_OVERRIDE_BIT;
        if matches!(object.region, Region::Bi | Region::Bo) {
            let state = match overridden.filter(|_| object.region == Region::Bi) {
                Some(value) => value.first() == Some(&1),
                None => fetch(entry.place, model)? != 0.0,
            };
            status |= u8::from(state)
                .checked_shl(u32::from(self.options.state_bit))
                .unwrap_or(0);
        }
        Some(status)
    }

    fn float(&self, entry: &Entry, object: Object, model: Model<'_>) -> Option<f32> {
        // An AO always shows the drive's parameter; an AI shows the value with which the bus has overridden it.
        let given = self.overridden.get(&object).filter(|_| object.region == Region::Ai);
        match given.map(|data| <[u8; 4]>::try_from(data.as_slice())) {
            Some(Ok(bytes)) => Some(f32::from_be_bytes(bytes)),
            _ => fetch(entry.place, model).map(|value| value as f32),
        }
    }

    fn write(&mut self, object: Object, attribute: u8, data: &[u8]) -> Result<(), u8> {
        use Region::{Ai, Ao, Bi, Bo};
        self.entry(object)?;
        let size = match (object.region, attribute) {
            (Ai | Bi | Ao | Bo, 1) => 1,
            (Ai, 8..=12) if self.map.has_limits => 4,
            (Bo, 3..=5) => 2,
            // A value or a status is changed by override only (reference/n2.md 2).
            _ => return Err(TYPE),
        };
        if data.len() != size {
            return Err(SIZE);
        }
        self.attributes.insert((object, attribute), data.to_vec());
        Ok(())
    }

    fn set(&mut self, object: Object, data: &[u8], model: Model<'_>) -> Result<(), u8> {
        let entry = self.entry(object)?;
        if data.len() != object.region.override_bytes() {
            return Err(SIZE);
        }
        let value = match data {
            [a, b, c, d] => f64::from(f32::from_be_bytes([*a, *b, *c, *d])),
            [high, low] => f64::from(i16::from_be_bytes([*high, *low])),
            [state @ (0 | 1)] => f64::from(*state),
            _ => return Err(DATA),
        };
        match object.region {
            Region::Ao => self.set_register(entry, value, model)?,
            Region::Bo => set_bit(entry.place, value != 0.0, model)?,
            Region::Ai | Region::Bi | Region::Adi if !self.map.overrides_inputs => return Ok(()),
            Region::Ai | Region::Bi | Region::Adi => {}
            Region::Adf | Region::Bd => return Err(TYPE),
        }
        self.overridden.insert(object, data.to_vec());
        Ok(())
    }

    fn set_register(&self, entry: &Entry, value: f64, model: Model<'_>) -> Result<(), u8> {
        let (table, address, scale, least, most) = match entry.place {
            Backing::Signed(table, address, scale) => (table, address, scale, f64::from(i16::MIN), f64::from(i16::MAX)),
            Backing::Unsigned(table, address, scale) => (table, address, scale, 0.0, f64::from(u16::MAX)),
            Backing::Bit(..) | Backing::Fixed(_) => return Err(TYPE),
        };
        if !(least..=most).contains(&(value / scale).round()) {
            // The value is too large for the drive's variable, or not a number.
            return Err(DATA);
        }
        let value = match (entry.limits, self.map.beyond) {
            (Some((low, high)), Beyond::Clamp) => value.clamp(low, high),
            (Some((low, high)), Beyond::Refuse) if !(low..=high).contains(&value) => return Err(DATA),
            _ => value,
        };
        if table != drivegate_proto::Table::Holding {
            return Err(TYPE);
        }
        let count = (value / scale).round() as i32 as u16;
        store(address, count, model)
    }

    /// Reports all AI, AO, BI and BO, as after each Identify, even if they were reported before.
    fn full_report(&mut self, model: Model<'_>) {
        self.reports.clear();
        self.has_sent_reports = false;
        self.reported.clear();
        self.collect(true, model);
    }

    /// The objects whose report is switched on and whose status changed.
    fn note_changes(&mut self, model: Model<'_>) {
        if self.reports.is_empty() {
            self.collect(false, model);
        }
    }

    fn collect(&mut self, all: bool, model: Model<'_>) {
        for entry in self.map.entries.iter().filter(|entry| entry.region != Region::Adi) {
            let object = Object {
                region: entry.region,
                number: entry.number,
            };
            if !all && (self.configuration(object) >> CONFIG_REPORT_BIT) & 1 == 0 {
                continue;
            }
            let Some(status) = self.status(entry, object, model) else {
                continue;
            };
            if self.reported.insert(object, status) == Some(status) {
                continue;
            }
            let mut record = format!("{:X}{:02X}{status:02X}", object.region as u8, object.number);
            if matches!(object.region, Region::Ai | Region::Ao)
                && let Some(value) = self.float(entry, object, model)
            {
                record.push_str(&format!("{:08X}", value.to_bits()));
            }
            match self.reports.back_mut() {
                Some(last) if last.len() + record.len() <= LONGEST_REPORT => last.extend(record.bytes()),
                _ => self.reports.push_back(record.into_bytes()),
            }
        }
    }
}

fn fetch(place: Backing, model: Model<'_>) -> Option<f64> {
    let mut word = |table, address| {
        let (start, count) = (address, 1);
        match model(&RequestPdu::read(table, start, count))? {
            Reply::Registers(words) => words.first().copied(),
            // A drive without this register counts as having 0, the value at rest.
            _ => Some(0),
        }
    };
    Some(match place {
        Backing::Signed(table, address, scale) => f64::from(word(table, address)? as i16) * scale,
        Backing::Unsigned(table, address, scale) => f64::from(word(table, address)?) * scale,
        Backing::Bit(table, address, bit) => f64::from((word(table, address)? >> bit.min(15)) & 1),
        Backing::Fixed(value) => f64::from(value),
    })
}

fn set_bit(place: Backing, on: bool, model: Model<'_>) -> Result<(), u8> {
    let Backing::Bit(table, address, bit) = place else {
        return Err(TYPE);
    };
    let (start, count) = (address, 1);
    let old = match model(&RequestPdu::read(table, start, count)) {
        Some(Reply::Registers(words)) => words.first().copied().unwrap_or(0),
        Some(Reply::Exception(exception)) => return Err(code_of(exception)),
        _ => 0,
    };
    let mask = 1u16.checked_shl(u32::from(bit)).unwrap_or(0);
    store(address, if on { old | mask } else { old & !mask }, model)
}

fn store(address: u16, value: u16, model: Model<'_>) -> Result<(), u8> {
    match model(&RequestPdu::write_register(address, value)) {
        Some(Reply::Exception(exception)) => Err(code_of(exception)),
        _ => Ok(()),
    }
}

/// The error code of the board for an exception that the drive answers on Modbus.
pub(crate) fn code_of(exception: Exception) -> u8 {
    match exception {
        Exception::Modbus(0x01) => UNKNOWN,
        // A parameter of TECO that is written in DRIVE mode.
        Exception::Modbus(0x22) => TYPE,
        Exception::N2(own) => own,
        Exception::Modbus(_) => DATA,
    }
}
