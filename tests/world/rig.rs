//! A bus in virtual time, used only by the test.

use std::sync::Arc;
use std::time::{Duration, Instant};

use arc_swap::ArcSwap;
use drivegate_core::event::Events;
use drivegate_core::order::{Authority, CommandLog, Order, Origin, Outcome, SourceKind};
use drivegate_core::plant::{DriveHandle, OrderRequest, Placed, Plant, SharedPlant};
use drivegate_core::process_image::{OnShutdown, Outcome as Counted};
use drivegate_core::start_guard::Guards;
use drivegate_model::drive::{ModelPoint, PollClass, Sample, State, Value};
use drivegate_proto::{Protocol, Reply, RequestPdu, Table};
use drivegate_sim::SimTime;
use drivegate_sim::faults::FaultPlan;
use drivegate_sim::simulated_drive::SimulatedDrive;
use drivegate_sim::statistics::{Direction, Recorded};

use super::bus::{Parts, Seen, WorldBus};
use super::scenario::Line;

/// Virtual time within which every awaited event must happen.
pub const PATIENCE: Duration = Duration::from_secs(60);

pub struct Rig {
    pub bus: WorldBus,
    pub now: Instant,
    pub plant: Plant,
}

/// Numbers of transactions by outcome, of foreign frames, and of faults that occurred.
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

/// A healthy line of this family with drives 1 to `drives`, and process data as often as possible.
pub fn line(family: &'static str, protocol: Protocol, baud: u32, drives: u8) -> Line {
    Line {
        refresh: None,
        own_timeout: None,
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
        on_shutdown: OnShutdown::LeaveRunning,
        dead: Vec::new(),
        swapped: false,
        refuses: None,
        spec: |_| {},
    }
}

impl Rig {
    /// A rig with the usual drives, whose frames are recorded.
    pub fn of(line: &Line) -> Rig {
        Rig::recorded(line, Parts::of(0, line, 5))
    }

    pub fn recorded(line: &Line, parts: Parts) -> Rig {
        let mut rig = Rig::new(line, parts);
        rig.bus.wire.record(100_000);
        rig
    }

    pub fn new(line: &Line, parts: Parts) -> Rig {
        let now = Instant::now();
        let (events, command_log) = (Events::default(), Arc::new(CommandLog::default()));
        let bus = WorldBus::new(0, line, parts, &events, &command_log, now);
        let plant = Plant {
            gateway: "world".to_string(),
            stale_after: Duration::from_secs(1),
            buses: vec![bus.handle.clone()],
            events,
            command_log,
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

    /// Gives an order of this client.
    pub fn place_as(&mut self, client: &str, address: u8, order: Order) -> Placed {
        let origin = Origin::new(SourceKind::Mqtt, client);
        let placed = self
            .drive(address)
            .place(OrderRequest::new(order, origin, Authority::Write), self.now);
        self.bus.command_came(self.now);
        placed
    }

    /// Restarts the bus, as a reload does.
    pub fn restart(&mut self) {
        while self.bus.core.asked().is_some() {
            self.step(self.now + Duration::from_secs(1));
        }
        self.restart_now();
    }

    /// Restarts the bus at once, even during a transaction.
    pub fn restart_now(&mut self) {
        if self.bus.core.asked().is_some() {
            self.bus.wire.cut();
        }
        self.bus.restart(0, &self.plant.events, self.now);
        self.plant.buses = vec![self.bus.handle.clone()];
    }

    /// The process is killed, and started again at once.
    pub fn killed(&mut self) {
        self.bus.vanish();
        self.bus.open = true;
        self.bus.kill(Guards::default(), &self.plant.events, self.now);
        self.plant.buses = vec![self.bus.handle.clone()];
    }

    /// The plant in the form that servers use.
    pub fn shared_plant(&self) -> SharedPlant {
        Arc::new(ArcSwap::from_pointee(Plant {
            gateway: self.plant.gateway.clone(),
            stale_after: self.plant.stale_after,
            buses: self.plant.buses.clone(),
            events: self.plant.events.clone(),
            command_log: self.plant.command_log.clone(),
        }))
    }

    /// Gives an order and waits for the answer.
    pub fn ordered(&mut self, address: u8, order: Order) -> Outcome {
        let mut placed = self.place(address, order);
        self.answered(&mut placed)
    }

    pub fn answered(&mut self, placed: &mut Placed) -> Outcome {
        let until = self.now + PATIENCE;
        loop {
            if let Some(answer) = placed.answer() {
                return answer.outcome;
            }
            assert!(self.step(until).is_some(), "an order that nobody answers");
        }
    }

    /// An order that sets points as one command.
    pub fn points(&self, address: u8, points: &[(&str, f64)]) -> Order {
        let profile = &self.drive(address).image.spec.profile;
        let index = |name: &str| profile.point_index(name).unwrap();
        let value = |(name, value): &(&str, f64)| (index(name), Value::Number(*value));
        Order::Points(points.iter().map(value).collect())
    }

    pub fn set(&mut self, address: u8, points: &[(&str, f64)]) -> Outcome {
        let order = self.points(address, points);
        self.ordered(address, order)
    }

    /// Reads holding registers of a drive through the bus.
    pub fn read(&mut self, address: u8, start: u16, count: u16) -> Outcome {
        let table = Table::Holding;
        self.ordered(address, Order::Read(RequestPdu::Read { table, start, count }))
    }

    pub fn sample(&self, address: u8, point: ModelPoint) -> Sample {
        self.drive(address).reading(self.now).model(point)
    }

    pub fn good(&self, address: u8, point: ModelPoint) -> Option<Value> {
        self.sample(address, point).good()
    }

    /// The good value of the point with this name.
    pub fn value(&self, address: u8, name: &str) -> Option<Value> {
        let drive = self.drive(address);
        let index = drive.image.spec.profile.point_index(name).unwrap();
        drive.reading(self.now).sample(index).good()
    }

    /// State of a drive; offline as long as the state is unknown.
    pub fn state(&self, address: u8) -> State {
        self.drive(address).reading(self.now).state().unwrap_or(State::Offline)
    }

    pub fn until_state(&mut self, address: u8, state: State) {
        self.until(&format!("{state:?}"), PATIENCE, |rig| rig.state(address) == state);
    }

    pub fn until_good(&mut self, address: u8, point: ModelPoint, value: Value) {
        let what = format!("{} = {value}", point.name());
        self.until(&what, PATIENCE, |rig| rig.good(address, point) == Some(value));
    }

    /// Calls `act` with a simulated drive in its present state.
    pub fn with_drive<R>(&mut self, address: u8, act: impl FnOnce(&mut SimulatedDrive, SimTime) -> R) -> R {
        let now = self.bus.sim(self.now);
        let drive = self.bus.wire.slaves().drive(address).unwrap();
        drive.advance(now);
        act(drive, now)
    }

    pub fn set_alive(&mut self, address: u8, alive: bool) {
        self.with_drive(address, |drive, _| drive.set_alive(alive));
    }

    /// Writes a register at the drive itself, as a person at its panel does.
    pub fn at_the_drive(&mut self, address: u8, register: u16, value: u16) {
        let write = RequestPdu::WriteRegister {
            address: register,
            value,
        };
        self.with_drive(address, |drive, now| drive.answer(&write, now))
            .unwrap();
    }

    /// A holding register, read directly from the simulated drive.
    pub fn word(&mut self, address: u8, start: u16) -> u16 {
        let (table, count) = (Table::Holding, 1);
        let read = RequestPdu::Read { table, start, count };
        match self.with_drive(address, |drive, now| drive.answer(&read, now)) {
            Some(Reply::Registers(words)) => words[0],
            other => unreachable!("{other:?}"),
        }
    }

    /// Frames of the master since the line is recorded.
    pub fn requests(&self) -> Vec<Recorded> {
        let mut frames = self.bus.wire.transcript().frames();
        frames.retain(|frame| frame.direction == Direction::ToDrives);
        frames
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

/// An order that writes one register.
pub fn write(address: u16, value: u16) -> Order {
    Order::Write(RequestPdu::WriteRegister { address, value })
}
