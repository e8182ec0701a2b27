//! The four tables of a simulated drive of any profile: which addresses exist, and what is read and written.

use std::collections::BTreeMap;

use super::super::SimTime;
use super::super::model::Model;
use super::ProfileDrive;
use super::effect;
use super::state_bits::Key;
use drivegate_model::drive::control::{Control, ControlItem, OwnWord};
use drivegate_model::drive::identify::{PRODUCT, VENDOR};
use drivegate_model::drive::profile::Part;
use drivegate_model::drive::{Point, Profile, Value, parameters};
use drivegate_proto::{Exception, Reply, RequestPdu, Table};

/// Registers and bits by address; addresses not in the map do not exist.
#[derive(Debug, Clone)]
pub(super) struct Registers(BTreeMap<Key, u16>);

impl Registers {
    /// All registers that the profile uses, set to 0.
    pub(super) fn new(profile: &Profile, control: Option<&Control>) -> Registers {
        let mut all = BTreeMap::new();
        for range in profile.ranges.iter().filter(|range| range.holes) {
            all.extend(range.addresses.clone().map(|address| ((range.table, address), 0)));
        }
        for raw in profile.points.iter().filter_map(Point::raw) {
            all.extend(raw.addresses().map(|address| ((raw.table, address), 0)));
        }
        let places = control.map(effect::places).unwrap_or_default();
        all.extend(places.into_iter().map(|place| ((place.table, place.address), 0)));
        for expected in profile.identify.iter().filter(|expected| expected.values) {
            let probe = expected.probe;
            let addresses = (0..probe.count).filter_map(|item| probe.start.checked_add(item));
            all.extend(addresses.map(|address| ((profile.canonical(probe.table), address), 0)));
        }
        let parameters = profile.parameters.named.iter().map(|parameter| parameter.address);
        let save = profile.parameters.rules.save.map(|(address, _)| address);
        all.extend(parameters.chain(save).map(|address| ((Table::Holding, address), 0)));
        Registers(all)
    }

    pub(super) fn get(&self, table: Table, address: u16) -> Option<u16> {
        self.0.get(&(table, address)).copied()
    }

    /// Sets a register that exists.
    pub(super) fn set(&mut self, key: Key, value: u16) -> Result<(), Exception> {
        self.0.get_mut(&key).map(|held| *held = value).ok_or(Exception::ADDRESS)
    }

    /// Sets some bits of a register.
    pub(super) fn place(&mut self, key: Key, part: Part) {
        if let Some(held) = self.0.get_mut(&key) {
            *held = *held & !part.mask | part.value & part.mask;
        }
    }

    /// Copies what a drive keeps without supply: settings, but no commands.
    pub(super) fn keep_settings(&mut self, from: &Registers, profile: &Profile, control: Option<&Control>) {
        let places = control.map(effect::places).unwrap_or_default();
        let is_place = |key: Key| places.iter().any(|place| (place.table, place.address) == key);
        let parameters = &profile.parameters;
        let is_kept = |address: u16| {
            let named = parameters.named.iter().any(|parameter| parameter.address == address);
            named && !parameters::has(&parameters.rules.volatile, address)
        };
        for (key, held) in &mut self.0 {
            let mut points = profile
                .points
                .iter()
                .filter(|point| point.raw().is_some_and(|raw| raw.covers(key.0, key.1)));
            let setting = points.any(|point| point.write && point.model.is_none());
            let parameter = key.0 == Table::Holding && is_kept(key.1);
            if (setting || parameter) && !is_place(*key) {
                *held = from.0.get(key).copied().unwrap_or(*held);
            }
        }
    }
}

impl ProfileDrive {
    /// Whether the drive has a function.
    pub(super) fn has_function(&self, function: u8) -> bool {
        let profile = &self.options.profile;
        let has = |table: Table| profile.ranges.iter().any(|range| range.table == table);
        let functions = profile.functions;
        match function {
            1 => has(Table::Coil),
            2 => has(Table::DiscreteInput),
            3 => has(Table::Holding),
            4 => has(Table::Input) || profile.input_is_holding,
            5 => has(Table::Coil) && !functions.coils_by_15,
            6 => has(Table::Holding) && !functions.registers_by_16,
            15 => has(Table::Coil),
            16 => has(Table::Holding),
            22 => functions.mask_write,
            43 => !profile.nameplates.is_empty(),
            _ => false,
        }
    }

    pub(super) fn reply(&mut self, request: &RequestPdu, now: SimTime) -> Result<Reply, Exception> {
        if let RequestPdu::WriteRegister { address, value } = request
            && self.is_extra(Table::Holding, *address)
        {
            self.write_extra(*address, *value);
            return Ok(Reply::Written);
        }
        if !self.has_function(request.function()) {
            return Err(Exception::FUNCTION);
        }
        match request {
            RequestPdu::Read { table, start, count } => {
                self.show(now);
                let table = self.options.profile.canonical(*table);
                let words = self.read(table, *start, *count)?;
                Ok(if table.is_bits() {
                    Reply::Bits(words.into_iter().map(|bit| bit != 0).collect())
                } else {
                    Reply::Registers(words)
                })
            }
            RequestPdu::WriteCoil { address, on } => self.write(Table::Coil, *address, &[u16::from(*on)], now),
            RequestPdu::WriteCoils { start, bits } => {
                let bits: Vec<u16> = bits.iter().map(|on| u16::from(*on)).collect();
                self.write(Table::Coil, *start, &bits, now)
            }
            RequestPdu::WriteRegister { address, value } => self.write(Table::Holding, *address, &[*value], now),
            RequestPdu::WriteRegisters { start, values } => self.write(Table::Holding, *start, values, now),
            RequestPdu::MaskWrite {
                address,
                and_mask,
                or_mask,
            } => {
                let old = self.registers.get(Table::Holding, *address).ok_or(Exception::ADDRESS)?;
                let value = old & and_mask | or_mask & !and_mask;
                self.write(Table::Holding, *address, &[value], now)
            }
            RequestPdu::DeviceIdentification { code, object } => self.nameplate(*code, *object),
            _ => Err(Exception::FUNCTION),
        }
    }

    /// What the drive calls itself: vendor and product, as a stream (code 1) or one object (code 4).
    fn nameplate(&self, code: u8, object: u8) -> Result<Reply, Exception> {
        let plate = self.options.profile.nameplates.first().ok_or(Exception::FUNCTION)?;
        let (vendor, product) = plate.split_once(' ').unwrap_or((plate, ""));
        let objects = [(VENDOR, vendor), (PRODUCT, product)].into_iter();
        let wanted: Vec<(u8, &str)> = match code {
            1 => objects.collect(),
            4 => objects.filter(|(id, _)| *id == object).collect(),
            _ => return Err(Exception::VALUE),
        };
        if wanted.is_empty() {
            return Err(Exception::ADDRESS);
        }
        let mut body = vec![code, 0x81, 0, 0, wanted.len() as u8];
        for (id, text) in wanted {
            body.extend([id, text.len() as u8]);
            body.extend(text.as_bytes());
        }
        Ok(Reply::DeviceIdentification(body))
    }

    /// Whether the register is one that no real drive has.
    fn is_extra(&self, table: Table, address: u16) -> bool {
        let first = self.options.trip_address();
        self.options.trip_register && table == Table::Holding && (first..=first + 1).contains(&address)
    }

    fn write_extra(&mut self, address: u16, value: u16) {
        if address == self.options.trip_address() {
            self.trip(value)
        } else {
            self.give_to_bus(value == 0)
        }
    }

    fn read(&self, table: Table, start: u16, count: u16) -> Result<Vec<u16>, Exception> {
        let end = start
            .checked_add(count.checked_sub(1).ok_or(Exception::VALUE)?)
            .ok_or(Exception::ADDRESS)?;
        let one = |address: u16| {
            if !self.is_extra(table, address) {
                self.registers.get(table, address).ok_or(Exception::ADDRESS)
            } else if address == self.options.trip_address() {
                Ok(self.body.latch.fault())
            } else {
                Ok(u16::from(!self.remote))
            }
        };
        let words = (start..=end).map(one).collect::<Result<Vec<u16>, Exception>>()?;
        let limit = |address: u16| self.options.profile.range(table, address).map(|range| range.read);
        match (start..=end).filter_map(limit).min() {
            Some(most) if count > most => Err(Exception::VALUE),
            _ => Ok(words),
        }
    }

    fn write(&mut self, table: Table, start: u16, values: &[u16], now: SimTime) -> Result<Reply, Exception> {
        if let (true, [value]) = (self.is_extra(table, start), values) {
            self.write_extra(start, *value);
            return Ok(Reply::Written);
        }
        let profile = self.profile();
        let items: Vec<(Key, u16)> = values
            .iter()
            .zip(0u16..)
            .map(|(value, item)| Some(((table, start.checked_add(item)?), *value)))
            .collect::<Option<_>>()
            .ok_or(Exception::ADDRESS)?;
        if items.is_empty() {
            return Err(Exception::VALUE);
        }
        for ((table, address), _) in &items {
            let most = profile.range(*table, *address).map_or(0, |range| range.write);
            if most == 0 || self.registers.get(*table, *address).is_none() {
                return Err(Exception::ADDRESS);
            }
            if items.len() > usize::from(most) {
                return Err(Exception::VALUE);
            }
        }
        if profile.points.iter().any(|point| refuses(point, &items)) {
            return Err(Exception::VALUE);
        }
        for (key, value) in items {
            let place = ControlItem {
                table: key.0,
                address: key.1,
            };
            let shadow = |control: &Control| control.at == place && control.own_word == OwnWord::Shadow;
            if !self.control.as_ref().is_some_and(shadow) {
                self.registers.set(key, value)?;
            }
            self.apply_word(place, value, now);
        }
        Ok(Reply::Written)
    }
}

/// Whether a setting refuses these values because they are outside its range or its list. References are limited by
/// the drive instead.
fn refuses(point: &Point, items: &[(Key, u16)]) -> bool {
    let Some(raw) = point.raw().filter(|_| point.write && point.model.is_none()) else {
        return false;
    };
    let word = |address: u16| {
        let found = items.iter().find(|(key, _)| *key == (raw.table, address));
        found.map(|(_, value)| *value)
    };
    let Some(words) = raw.addresses().map(word).collect::<Option<Vec<u16>>>() else {
        return false;
    };
    let Some(value) = raw.decode(&words, point.kind()) else {
        return false;
    };
    let outside = point
        .range
        .as_ref()
        .is_some_and(|range| !range.contains(&value.as_f64()));
    let code = match value {
        Value::Integer(code) => Some(code),
        _ => None,
    };
    let unlisted =
        !point.texts.is_empty() && !point.unlisted && code.is_some_and(|code| !point.texts.contains_key(&code));
    outside || unlisted
}
