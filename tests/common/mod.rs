//! A bus with simulated drives, for tests.
// Each test file uses its own part; a rig that cannot be built fails its test.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used, clippy::panic, clippy::expect_used)]

use std::sync::Arc;
use std::time::{Duration, Instant};

use drivegate::bus::predict::predict;
use drivegate::bus::{BusOptions, BusTask};
use drivegate::cache::{Access, BusImage, BusSpec, DriveImage, DriveSpec};
use drivegate::codec::wire::Silence;
use drivegate::codec::{LineFormat, Protocol, RequestPdu, Table};
use drivegate::command::{Authority, CommandQueue, DEFAULT_EXPIRY, Order, Origin, Outcome, SourceKind, WriteStats};
use drivegate::drive::profile::{Profile, Profiles};
use drivegate::drive::{ModelPoint, Sample, State, Value};
use drivegate::event::Events;
use drivegate::line::Rs485;
use drivegate::plant::{BusHandle, DriveHandle, Plant};
use drivegate::sim::drive::{DriveOptions, ModelOptions};
use drivegate::sim::endpoint::EndpointOptions;
use drivegate::sim::half_duplex::{Delivery, LineRules};
use drivegate::sim::nx::{NxOptions, Values};
use drivegate::sim::wire::{SimulatedBus, SimulatedBusOptions};

/// Longest wait for something that must come.
const PATIENCE: Duration = Duration::from_secs(20);

/// A bus, its simulated line, and the plant around it.
pub struct Rig {
    pub plant: Plant,
    pub events: Events,
    // The bus ends before its line.
    pub bus: BusTask,
    pub line: SimulatedBus,
    _link: tempfile::TempDir,
}

/// Name of the drive at an address.
pub fn drive(address: u8) -> String {
    format!("drive-{address}")
}

/// How a rig differs from the usual one: one pseudo-terminal at 38400 8N1, process data every 10 ms.
pub struct Setup {
    pub drives: Vec<DriveOptions>,
    pub protocol: Protocol,
    pub format: LineFormat,
    pub profile: Arc<Profile>,
    /// Where the simulated line is; the bus opens that, unless `port` says otherwise.
    pub endpoint: Option<EndpointOptions>,
    pub port: Option<String>,
    pub rs485: Rs485,
    pub slow_cycle: Duration,
    pub delivery: Delivery,
    pub transcript: usize,
}

impl Setup {
    pub fn new(addresses: &[u8], baud: u32) -> Setup {
        Setup {
            drives: addresses.iter().map(|a| DriveOptions::nx(*a)).collect(),
            protocol: Protocol::ModbusRtu,
            format: LineFormat::new(baud, "8N1").unwrap(),
            profile: Profiles::built_in().get("vacon-nx").unwrap().clone(),
            endpoint: None,
            port: None,
            rs485: Rs485::Off,
            slow_cycle: Duration::from_millis(500),
            delivery: Delivery::Whole,
            transcript: 0,
        }
    }

    /// Read-only registers carry the drive's address in the high byte and their own in the low byte.
    pub fn tagged(mut self) -> Setup {
        for drive in &mut self.drives {
            drive.model = ModelOptions::Nx(NxOptions {
                values: Values::Tagged(drive.address),
                ..NxOptions::default()
            });
        }
        self
    }
}

fn spec(address: u8) -> DriveSpec {
    DriveSpec {
        access: Access::Control,
        turnaround: Duration::from_micros(500),
        ..DriveSpec::new(
            &drive(address),
            "line1",
            address,
            Profiles::built_in().get("vacon-nx").unwrap().clone(),
        )
    }
}

impl Rig {
    pub async fn start(addresses: &[u8], baud: u32) -> Rig {
        Rig::build(addresses, baud, 0, |_| {})
    }

    pub async fn start_recorded(addresses: &[u8], baud: u32) -> Rig {
        Rig::build(addresses, baud, 10_000, |_| {})
    }

    pub async fn start_with(addresses: &[u8], baud: u32, change: impl Fn(&mut DriveSpec)) -> Rig {
        Rig::build(addresses, baud, 0, change)
    }

    fn build(addresses: &[u8], baud: u32, transcript: usize, change: impl Fn(&mut DriveSpec)) -> Rig {
        let setup = Setup {
            transcript,
            ..Setup::new(addresses, baud)
        };
        Rig::of(setup, change)
    }

    pub fn of(setup: Setup, change: impl Fn(&mut DriveSpec)) -> Rig {
        let format = setup.format;
        let link = tempfile::tempdir().unwrap();
        let pty = EndpointOptions::Pty {
            link: Some(link.path().join("line1")),
        };
        let addresses: Vec<u8> = setup.drives.iter().map(|d| d.address).collect();
        let rules = LineRules {
            delivery: setup.delivery,
            ..LineRules::of(setup.protocol, format)
        };
        let options = SimulatedBusOptions {
            endpoint: setup.endpoint.unwrap_or(pty),
            transcript: setup.transcript,
            ..SimulatedBusOptions::new("line1", rules, setup.drives)
        };
        let line = SimulatedBus::start(options).unwrap();
        let bus_spec = BusSpec {
            name: "line1".to_string(),
            port: setup.port.unwrap_or_else(|| line.address()),
            protocol: setup.protocol,
            format,
            cycle: Duration::from_millis(10),
            slow_cycle: setup.slow_cycle,
        };
        let specs = addresses.iter().map(|address| {
            let mut spec = DriveSpec {
                profile: setup.profile.clone(),
                ..spec(*address)
            };
            change(&mut spec);
            spec
        });
        let specs: Vec<DriveSpec> = specs.collect();
        // Points of a slow line are measured by what it can carry, as the daemon does.
        let achieved = predict(&bus_spec, Silence::Chars, &specs);
        let slow_cycle = bus_spec.slow_cycle.max(achieved.slow_cycle.unwrap_or_default());
        let floor = 3 * bus_spec.cycle.max(achieved.fast_cycle.unwrap_or_default());
        let images = specs
            .into_iter()
            .map(|spec| Arc::new(DriveImage::new(spec, slow_cycle).with_stale_floor(floor)));
        let image = Arc::new(BusImage::new(bus_spec.clone(), images.collect()));
        let handle = BusHandle {
            image,
            queue: Arc::new(CommandQueue::new().unwrap()),
        };
        let (events, writes) = (Events::default(), Arc::new(WriteStats::default()));
        let options = BusOptions {
            response_timeout: setup.protocol.usual_timeout(),
            retries: if setup.protocol == Protocol::N2 { 2 } else { 1 },
            silence: if setup.protocol == Protocol::N2 {
                Silence::Spec
            } else {
                Silence::Chars
            },
            rs485: setup.rs485,
        };
        let bus = BusTask::start(handle.clone(), options, writes.clone(), events.clone()).unwrap();
        let plant = Plant {
            gateway: "test".to_string(),
            stale_after: Duration::from_secs(1),
            buses: vec![handle],
            events: events.clone(),
            writes,
        };
        Rig {
            plant,
            events,
            bus,
            line,
            _link: link,
        }
    }

    /// Waits until something holds.
    pub async fn until(&self, what: &str, holds: impl Fn(&Rig) -> bool) {
        let deadline = Instant::now() + PATIENCE;
        while !holds(self) {
            assert!(Instant::now() < deadline, "never came: {what}");
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }

    pub fn handle(&self, address: u8) -> DriveHandle {
        self.plant.drive(&drive(address)).unwrap()
    }

    /// One that is not known yet counts as offline.
    pub fn state(&self, address: u8) -> State {
        let state = self.handle(address).reading(Instant::now()).state();
        state.unwrap_or(State::Offline)
    }

    pub fn sample(&self, address: u8, point: ModelPoint) -> Sample {
        self.handle(address).reading(Instant::now()).model(point)
    }

    pub fn good(&self, address: u8, point: ModelPoint) -> Option<Value> {
        self.sample(address, point).good()
    }

    pub fn bus_up(&self) -> bool {
        self.bus.handle().image.health().up
    }

    /// Sets points as one command.
    pub async fn set(&self, address: u8, points: &[(&str, f64)]) -> Outcome {
        let handle = self.handle(address);
        let index = |name| handle.image.spec.profile.point_index(name).unwrap();
        let values = points
            .iter()
            .map(|(name, value)| (index(name), Value::Number(*value)))
            .collect();
        let origin = Origin::new(SourceKind::Mqtt, "test");
        handle
            .place(
                Order::Points(values),
                origin,
                Authority::Write,
                DEFAULT_EXPIRY,
                Instant::now(),
            )
            .answered()
            .await
            .outcome
    }

    /// Reads holding registers of a drive through the bus.
    pub async fn read(&self, name: String, start: u16, count: u16) -> Outcome {
        let pdu = RequestPdu::Read {
            table: Table::Holding,
            start,
            count,
        };
        let origin = Origin::new(SourceKind::Mqtt, "test");
        self.plant
            .drive(&name)
            .unwrap()
            .place(
                Order::Read(pdu),
                origin,
                Authority::ReadOnly,
                DEFAULT_EXPIRY,
                Instant::now(),
            )
            .answered()
            .await
            .outcome
    }
}
