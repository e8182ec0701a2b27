//! A bus with its thread on a real port, connected to simulated drives.

use std::sync::Arc;
use std::time::{Duration, Instant};

use drivegate_bus::{BusOptions, BusTask};
use drivegate_core::event::Events;
use drivegate_core::order::{Authority, Order, Origin, Outcome, SourceKind};
use drivegate_core::plant::{DriveHandle, OrderRequest, Plant};
use drivegate_core::process_image::{BusSpec, DriveImage, DriveSpec};
use drivegate_line::LineOptions;
use drivegate_model::drive::profile::Profile;
use drivegate_model::drive::{ModelPoint, State, Value};
use drivegate_proto::wire::Silence;
use drivegate_proto::{LineFormat, Protocol};
use drivegate_sim::endpoint::EndpointOptions;
use drivegate_sim::half_duplex::LineRules;
use drivegate_sim::simulated_drive::DriveOptions;
use drivegate_sim::wire::{SimulatedBus, SimulatedBusOptions};
use drivegate_testkit as testkit;

use crate::support::process::PATIENCE;

/// Response timeout so long that a reply delayed by a busy machine is still in time.
const RESPONSE_TIMEOUT: Duration = Duration::from_secs(2);

/// A bus with its simulated line, and the plant around it.
pub(crate) struct Rig {
    pub(crate) plant: Plant,
    pub(crate) events: Events,
    // This field is dropped first, so that the bus ends before its line.
    pub(crate) bus: BusTask,
    pub(crate) line: SimulatedBus,
    _link: tempfile::TempDir,
}

/// Name of the drive at an address.
pub(crate) fn drive(address: u8) -> String {
    format!("drive-{address}")
}

/// How a rig differs from the usual one: one pseudo-terminal at 38400 8N1, process data every 10 ms.
pub(crate) struct Setup {
    pub(crate) drives: u8,
    pub(crate) protocol: Protocol,
    pub(crate) profile: Arc<Profile>,
    /// Endpoint of the simulated line; the bus opens it unless `port` is set.
    pub(crate) endpoint: Option<EndpointOptions>,
    pub(crate) port: Option<String>,
    pub(crate) options: LineOptions,
    pub(crate) response_timeout: Duration,
}

impl Default for Setup {
    fn default() -> Setup {
        Setup {
            drives: 1,
            protocol: Protocol::ModbusRtu,
            profile: testkit::nx(),
            endpoint: None,
            port: None,
            options: LineOptions::default(),
            response_timeout: RESPONSE_TIMEOUT,
        }
    }
}

impl Rig {
    pub(crate) fn new() -> Rig {
        Rig::of(Setup::default())
    }

    pub(crate) fn of(setup: Setup) -> Rig {
        let baud = if setup.protocol == Protocol::N2 { 9600 } else { 38_400 };
        let format = LineFormat::new(baud, "8N1").unwrap();
        let link = tempfile::tempdir().unwrap();
        let pty = EndpointOptions::Pty {
            link: Some(link.path().join("line1")),
        };
        let drives = (1..=setup.drives).map(DriveOptions::nx).collect();
        let rules = LineRules::of(setup.protocol, format);
        let line = SimulatedBus::start(SimulatedBusOptions {
            endpoint: setup.endpoint.unwrap_or(pty),
            ..SimulatedBusOptions::new("line1", rules, drives)
        });
        let line = line.unwrap();
        let spec = BusSpec {
            port: setup.port.unwrap_or_else(|| line.address()),
            protocol: setup.protocol,
            format,
            slow_cycle: Duration::from_millis(500),
            ..testkit::bus_spec("line1")
        };
        let image = |address| {
            let spec = DriveSpec {
                turnaround: Duration::from_micros(500),
                ..testkit::controlled(&drive(address), "line1", address, &setup.profile)
            };
            // With this limit, no value becomes stale because the test machine is busy.
            Arc::new(DriveImage::new(spec, Duration::from_millis(500)).with_stale_floor(PATIENCE))
        };
        let handle = testkit::bus(spec, (1..=setup.drives).map(image).collect());
        let events = Events::default();
        let options = BusOptions {
            response_timeout: setup.response_timeout,
            retries: 1,
            silence: Silence::Spec,
            line: setup.options,
            allow: Vec::new(),
            mode: Default::default(),
        };
        let bus = BusTask::start(handle.clone(), options, events.clone()).unwrap();
        let plant = Plant {
            events: events.clone(),
            ..Plant::new("test", PATIENCE, vec![handle])
        };
        Rig {
            plant,
            events,
            bus,
            line,
            _link: link,
        }
    }

    /// Waits until a condition holds.
    pub(crate) async fn until(&self, what: &str, holds: impl Fn(&Rig) -> bool) {
        let deadline = Instant::now() + PATIENCE;
        while !holds(self) {
            assert!(Instant::now() < deadline, "never came: {what}");
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }

    pub(crate) fn handle(&self, address: u8) -> DriveHandle {
        self.plant.drive(&drive(address)).unwrap()
    }

    /// State of a drive; offline as long as the state is unknown.
    pub(crate) fn state(&self, address: u8) -> State {
        let state = self.handle(address).reading(Instant::now()).state();
        state.unwrap_or(State::Offline)
    }

    pub(crate) fn good(&self, address: u8, point: ModelPoint) -> Option<Value> {
        self.handle(address).reading(Instant::now()).model(point).good()
    }

    pub(crate) fn bus_up(&self) -> bool {
        self.bus.handle().image.health().up
    }

    /// Sets several points as one command.
    pub(crate) async fn set(&self, address: u8, points: &[(&str, f64)]) -> Outcome {
        let handle = self.handle(address);
        let index = |name| handle.image.spec.profile.point_index(name).unwrap();
        let values = points
            .iter()
            .map(|(name, value)| (index(name), Value::Number(*value)))
            .collect();
        let origin = Origin::new(SourceKind::Mqtt, "test");
        handle
            .place(
                OrderRequest::new(Order::Points(values), origin, Authority::Write).within(PATIENCE),
                Instant::now(),
            )
            .answered()
            .await
            .outcome
    }
}

/// The reason why the bus is down.
pub(crate) fn reason(rig: &Rig) -> String {
    rig.bus.handle().image.health().reason.unwrap_or_default()
}

/// A rig whose bus is configured to open `port` instead of its line.
pub(crate) fn with_port(port: &str) -> Rig {
    Rig::of(Setup {
        port: Some(port.to_string()),
        ..Setup::default()
    })
}
