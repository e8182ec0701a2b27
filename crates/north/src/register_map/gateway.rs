//! Registers about the gateway itself: the registers of the buses.

use std::time::Duration;

use super::{Form, high_low};
use drivegate_proto::Exception;

/// Number of registers of a bus.
pub const BUS_BLOCK: u16 = 16;

/// The statistics of one bus in the register map.
#[derive(Debug, Clone, PartialEq)]
pub struct BusFigures {
    /// Whether the port is open.
    pub(crate) up: bool,
    /// Number of configured drives.
    pub(crate) drives: usize,
    /// Number of drives that are online.
    pub(crate) online: usize,
    /// Line load, 0 to 1; unknown until the port was open for a second.
    pub(crate) load: Option<f64>,
    /// Achieved cycle of the fast poll class.
    pub(crate) cycle: Option<Duration>,
    /// Number of transactions so far.
    pub(crate) transactions: u64,
    /// Transactions that failed so far.
    pub(crate) errors: u64,
    /// Writes in the queue.
    pub(crate) queued: usize,
}

/// A register of a bus under unit 255, for the printed map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BusRegister {
    /// Offset in the block of the bus.
    pub offset: u16,
    /// Content of the register.
    pub name: &'static str,
    /// How the value is encoded.
    pub form: Form,
    /// Engineering value of one count.
    pub scale: &'static str,
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
    /// The register block of the bus. A bus that is down has no drives online and no load; a load not measured yet
    /// is 0xFFFF, an unknown cycle 0xFFFFFFFF; counters are modulo 2^32; reserved registers are 0.
    pub(crate) fn registers(&self) -> [u16; BUS_BLOCK as usize] {
        let count = |n: usize| n.min(usize::from(u16::MAX - 1)) as u16;
        let per_mille = |load: f64| (load.clamp(0.0, 1.0) * 1000.0).round() as u16;
        let ms = |cycle: Duration| (cycle.as_secs_f64() * 1000.0).round().min(f64::from(u32::MAX - 1)) as u32;
        let [cycle_high, cycle_low] = high_low(self.cycle.map_or(u32::MAX, ms));
        let [done_high, done_low] = high_low(self.transactions as u32);
        let [errors_high, errors_low] = high_low(self.errors as u32);
        [
            u16::from(self.up),
            count(self.drives),
            if self.up { count(self.online) } else { 0 },
            if self.up {
                self.load.map_or(u16::MAX, per_mille)
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

/// Registers of the gateway itself; `bus` returns the statistics of a bus by its index in the configuration.
///
/// # Errors
/// Exception 02 if the span goes beyond the last bus.
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
