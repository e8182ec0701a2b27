//! The four tables of the simulated CX (reference/drives.md 4.1 to 4.5).

use super::super::SimTime;
use super::super::model::{Model, bit, signed, unsigned};
use super::{AT_REFERENCE_BAND, CxDrive, CxOptions, OutOfRange};
use drivegate_proto::{Exception, Reply, RequestPdu, Table};

/// Function codes that the board supports.
pub(super) const FUNCTIONS: [u8; 7] = [1, 2, 3, 4, 5, 6, 8];

/// Item of the active fault among the input registers; the monitoring variables n1 to n99 have lower numbers.
const FAULT: u16 = 100;
/// Item of the frequency reference among the holding registers.
const REFERENCE: u16 = 0;
/// Items of the references; parameters have higher numbers.
const REFERENCES: std::ops::Range<u16> = 0..100;
/// Version number of the control program, n18.
const PROGRAM: u16 = 115;

impl CxDrive {
    pub(super) fn reply(&mut self, request: &RequestPdu, now: SimTime) -> Result<Reply, Exception> {
        if !FUNCTIONS.contains(&request.function()) {
            return Err(Exception::FUNCTION);
        }
        if self.failed {
            return Err(Exception::DEVICE_FAILURE);
        }
        if now < self.busy_until {
            return Err(Exception::BUSY);
        }
        match *request {
            RequestPdu::Read { table, start, count } if table.is_bits() => {
                let limits = self.options.limits;
                limits.beyond.check(count, limits.bits)?;
                self.read(table, start, count, Self::bit).map(Reply::Bits)
            }
            RequestPdu::Read { table, start, count } => {
                let limits = self.options.limits;
                limits.beyond.check(count, limits.registers)?;
                self.read(table, start, count, Self::register).map(Reply::Registers)
            }
            RequestPdu::WriteCoil { address, on } => {
                let item = self.item(Table::Coil, address)?;
                self.write_coil(item, on).map(|()| Reply::Written)
            }
            RequestPdu::WriteRegister { address, value } => {
                self.write_register(address, value).map(|()| Reply::Written)
            }
            _ => Err(Exception::FUNCTION),
        }
    }

    fn read<T>(
        &self,
        table: Table,
        start: u16,
        count: u16,
        one: impl Fn(&Self, Table, u16) -> Result<T, Exception>,
    ) -> Result<Vec<T>, Exception> {
        (0..count)
            .map(|index| {
                let address = start.checked_add(index).ok_or(Exception::ADDRESS)?;
                one(self, table, address)
            })
            .collect()
    }

    /// The item of the manual's tables that this address means, see [`AddressOffset`](super::AddressOffset).
    fn item(&self, table: Table, address: u16) -> Result<u16, Exception> {
        let offset = self.options.offset.of(table);
        address.checked_sub(offset).ok_or(Exception::ADDRESS)
    }

    fn bit(&self, table: Table, address: u16) -> Result<bool, Exception> {
        let item = self.item(table, address)?;
        let coils = [self.coils.run, self.coils.reverse, self.coils.reset];
        let inputs = [
            self.fieldbus,
            self.ready(),
            self.body.shows_running(),
            self.body.turns_reverse(self.target()),
            self.body.latch.fault() != 0,
        ];
        let bits: &[bool] = if table == Table::Coil { &coils } else { &inputs };
        bits.get(usize::from(item)).copied().ok_or(Exception::ADDRESS)
    }

    fn register(&self, table: Table, address: u16) -> Result<u16, Exception> {
        if table == Table::Holding && self.is_trip(address) {
            return Ok(0);
        }
        let item = self.item(table, address)?;
        let value = match (table, item) {
            (Table::Input, FAULT) => Some(self.body.latch.fault()),
            (Table::Input, _) => self.variable(item),
            (_, REFERENCE) => Some(self.reference),
            _ => self.parameters.set.get(item),
        };
        value.ok_or(Exception::ADDRESS)
    }

    /// Monitoring variable n1 and following, by its item, which is one less (reference/drives.md 4.4).
    fn variable(&self, item: u16) -> Option<u16> {
        let (motor, ratings, totals) = (&self.body.motor, &self.ratings, &self.totals);
        let step = self.options.time_step;
        Some(match item {
            0 => signed(motor.output * 100.0),
            1 => signed(motor.rpm(ratings)),
            2 => unsigned(motor.current(ratings) * 10.0),
            3 => signed(motor.torque),
            4 => signed(motor.power(ratings)),
            5 => unsigned(motor.voltage(ratings)),
            6 => unsigned(motor.dc_link(ratings, &self.options.load)),
            7 => signed(motor.heatsink),
            8 => unsigned((totals.days / step).floor()),
            9 => unsigned((totals.trip_hours / step).floor()),
            10 => unsigned((totals.energy * 1000.0).floor()),
            11 => unsigned((totals.trip_energy * 1000.0).floor()),
            // These terminals have nothing connected.
            12..=15 => 0,
            16 => bit(self.ready(), 1) | bit(self.body.shows_running(), 2) | bit(self.body.latch.fault() != 0, 4),
            17 => PROGRAM,
            18 => unsigned(self.unit_power * 10.0),
            19 => unsigned(motor.heat),
            _ => return None,
        })
    }

    fn write_coil(&mut self, item: u16, on: bool) -> Result<(), Exception> {
        match item {
            0 => self.set_run(on),
            1 => self.coils.reverse = on,
            2 => self.pull_reset(on),
            _ => return Err(Exception::ADDRESS),
        }
        Ok(())
    }

    fn write_register(&mut self, address: u16, value: u16) -> Result<(), Exception> {
        if self.is_trip(address) {
            self.trip(value);
            return Ok(());
        }
        let item = self.item(Table::Holding, address)?;
        if item == REFERENCE {
            return self.write_reference(value);
        }
        if REFERENCES.contains(&item) {
            return Err(Exception::ADDRESS);
        }
        self.parameters.set.write(item, value, self.body.motor.fed)?;
        self.ratings = self.parameters.ratings();
        Ok(())
    }

    /// 0.01 Hz, from Par 1.1 to Par 1.2.
    fn write_reference(&mut self, value: u16) -> Result<(), Exception> {
        let wanted = f64::from(value) / 100.0;
        let (minimum, maximum) = (self.parameters.minimum(), self.ratings.maximum);
        let inside = (minimum - AT_REFERENCE_BAND..=maximum + AT_REFERENCE_BAND).contains(&wanted);
        self.reference = match self.options.reference_out_of_range {
            _ if inside => value,
            OutOfRange::Exception => return Err(Exception::VALUE),
            OutOfRange::Clamp => unsigned(wanted.max(minimum).min(maximum) * 100.0),
        };
        Ok(())
    }

    fn is_trip(&self, address: u16) -> bool {
        self.options.trip_register && address == CxOptions::TRIP_ADDRESS
    }
}
