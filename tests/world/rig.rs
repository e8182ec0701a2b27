//! One bus in virtual time, with nobody around it but the test.

use std::sync::Arc;
use std::time::{Duration, Instant};

use arc_swap::ArcSwap;
use drivegate::cache::{OnShutdown, Outcome as Counted};
use drivegate::codec::{Protocol, RequestPdu};
use drivegate::command::{Authority, DEFAULT_EXPIRY, Order, Origin, SourceKind, WriteStats};
use drivegate::drive::PollClass;
use drivegate::event::Events;
use drivegate::plant::{DriveHandle, Placed, Plant, SharedPlant};
use drivegate::sim::faults::FaultPlan;

use super::bus::{Parts, Seen, WorldBus};
use super::scenario::Line;

pub struct Rig {
    pub bus: WorldBus,
    pub now: Instant,
    pub plant: Plant,
}

/// Exchanges by how they ended, foreign frames and faults that were met.
#[derive(Debug, Clone, Copy, Default)]
pub struct Counts {
    pub ok: u64,
    pub exception: u64,
    pub timeout: u64,
    pub corrupt: u64,
    pub foreign: u64,
    pub faults: u64,
}

impl Counts {
    pub fn since(self, before: Counts) -> Counts {
        Counts {
            ok: self.ok - before.ok,
            exception: self.exception - before.exception,
            timeout: self.timeout - before.timeout,
            corrupt: self.corrupt - before.corrupt,
            foreign: self.foreign - before.foreign,
            faults: self.faults - before.faults,
        }
    }
}

/// A sound line of that family with drives 1 to `drives`, process data as often as it goes.
pub fn line(family: &'static str, protocol: Protocol, baud: u32, drives: u8) -> Line {
    Line {
        family,
        protocol,
        baud,
        format: if protocol == Protocol::ModbusAscii {
            "7E1"
        } else {
            "8N1"
        },
        drives,
        turnaround: Duration::from_micros(500),
        response_timeout: protocol.usual_timeout(),
        retries: if protocol == Protocol::N2 { 2 } else { 1 },
        cycle: Duration::from_millis(10),
        slow_cycle: Duration::from_secs(1),
        faults: String::new(),
        flips: 0.0,
        supervision: None,
        on_shutdown: OnShutdown::Hold,
        dead: Vec::new(),
        refuses: None,
    }
}

impl Rig {
    pub fn new(line: &Line, parts: Parts) -> Rig {
        let now = Instant::now();
        let (events, writes) = (Events::default(), Arc::new(WriteStats::default()));
        let bus = WorldBus::new(0, line, parts, &events, &writes, now);
        let plant = Plant {
            gateway: "world".to_string(),
            stale_after: Duration::from_secs(1),
            buses: vec![bus.handle.clone()],
            events,
            writes,
        };
        Rig { bus, now, plant }
    }

    /// The next thing that happens by `until`, if any does.
    pub fn step(&mut self, until: Instant) -> Option<Vec<Seen>> {
        let next = self.bus.wake_at().max(self.now);
        if next > until {
            self.now = until;
            return None;
        }
        self.now = next;
        let mut seen = Vec::new();
        self.bus.step(self.now, &mut seen);
        Some(seen)
    }

    pub fn run(&mut self, time: Duration) {
        let until = self.now + time;
        while self.step(until).is_some() {}
    }

    /// Waits until something holds; how long that took.
    pub fn until(&mut self, what: &str, most: Duration, holds: impl Fn(&Rig) -> bool) -> Duration {
        let (began, until) = (self.now, self.now + most);
        while !holds(self) {
            assert!(self.step(until).is_some(), "not within {most:?}: {what}");
        }
        self.now - began
    }

    pub fn drive(&self, address: u8) -> DriveHandle {
        self.plant.drive(&format!("d0-{address}")).unwrap()
    }

    /// Gives an order at the present time.
    pub fn place(&mut self, address: u8, order: Order) -> Placed {
        self.place_as("test", address, order)
    }

    /// The same for that client.
    pub fn place_as(&mut self, client: &str, address: u8, order: Order) -> Placed {
        let origin = Origin::new(SourceKind::Mqtt, client);
        let placed = self
            .drive(address)
            .place(order, origin, Authority::Write, DEFAULT_EXPIRY, self.now);
        self.bus.command_came(self.now);
        placed
    }

    /// The bus is started anew, as by a reload.
    pub fn restart(&mut self) {
        while self.bus.core.asked().is_some() {
            self.step(self.now + Duration::from_secs(1));
        }
        self.bus.restart(0, &self.plant.events, &self.plant.writes, self.now);
        self.plant.buses = vec![self.bus.handle.clone()];
    }

    /// The plant as servers have it.
    pub fn shared_plant(&self) -> SharedPlant {
        Arc::new(ArcSwap::from_pointee(Plant {
            gateway: self.plant.gateway.clone(),
            stale_after: self.plant.stale_after,
            buses: self.plant.buses.clone(),
            events: self.plant.events.clone(),
            writes: self.plant.writes.clone(),
        }))
    }

    pub fn set_faults(&mut self, faults: FaultPlan) {
        self.bus.wire.set_faults(faults);
    }

    pub fn counts(&self) -> Counts {
        let image = &self.bus.handle.image;
        let sum = |outcome| image.drives.iter().map(|drive| drive.counted(outcome)).sum();
        Counts {
            ok: sum(Counted::Ok),
            exception: sum(Counted::Exception),
            timeout: sum(Counted::Timeout),
            corrupt: sum(Counted::Corrupt),
            foreign: image.health().foreign,
            faults: self.bus.wire.statistics().faults,
        }
    }

    pub fn is_online(&self, drive: usize) -> bool {
        self.bus.handle.image.drives[drive].snapshot().link.is_online()
    }

    /// Whether all process data of all drives is good.
    pub fn is_whole(&self) -> bool {
        let drives = &self.bus.handle.image.drives;
        drives.iter().all(|image| {
            let reading = image.reading(self.now, self.plant.stale_after);
            let mut fast = image.plan.reads.iter().filter(|read| read.class == PollClass::Fast);
            fast.all(|read| reading.words(read.table, read.start, read.count).is_ok())
        })
    }
}

/// A write of one register.
pub fn write(address: u16, value: u16) -> Order {
    Order::Write(RequestPdu::WriteRegister { address, value })
}
