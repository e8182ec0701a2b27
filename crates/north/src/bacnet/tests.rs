use std::sync::Arc;
use std::time::{Duration, Instant};

use drivegate_bacnet::{Application as _, Data, Datum, Error, Job, ObjectId, ObjectType, PropertyId, Reliability};
use drivegate_testkit::{STALE_AFTER, bus, bus_spec, controlled, image, profile, read_all, take_next};

use super::view::View;
use super::writes::{JobProgress, Waiting};
use super::*;
use drivegate_core::order::{Arrival, Authority, Commanded, Order, Origin, Outcome, Refusal, SlotWrite, SourceKind};
use drivegate_core::permit::{Follows, Settled};
use drivegate_core::plant::{DriveHandle, OrderRequest, Plant};
use drivegate_core::process_image::{DriveSpec, Link};
use drivegate_model::drive::{ModelPoint, PointIndex, Value};
use drivegate_proto::{Reply, Table};

mod ending;
mod objects;
mod orders;
mod pauses;
mod refused;
mod reload;

const RUN: ObjectId = ObjectId::new(ObjectType::BINARY_VALUE, 1);
const SPEED: ObjectId = ObjectId::new(ObjectType::ANALOG_VALUE, 1);
const FREQUENCY: ObjectId = ObjectId::new(ObjectType::ANALOG_VALUE, 2);
const DEVICE: u32 = 101;

fn spec(name: &str) -> DriveSpec {
    DriveSpec {
        limits: [("speed_reference".to_string(), 0.0..=80.0)].into(),
        frequency_range: Some(0.0..=50.0),
        ..controlled("p1", "line1", 1, &profile(name))
    }
}

pub(super) fn options() -> Options {
    let everywhere = || vec!["127.0.0.0/8".parse().unwrap()];
    Options {
        listen: "127.0.0.1:0".parse().unwrap(),
        device: 100,
        network: Some(1001),
        foreign_devices: 0,
        offline: WhenOffline::Silent,
        commands: true,
        allow: everywhere(),
        write: everywhere(),
        keep_priorities: false,
        bbmd: None,
        vendor: 0,
        dcc_password: None,
        buses: None,
        state_dir: "/nonexistent".into(),
    }
}

/// A controlled Vacon NX that answers, and clients.
struct ControlledDrive {
    view: View,
    now: Instant,
}

impl ControlledDrive {
    fn new() -> ControlledDrive {
        let bus = bus(bus_spec("line1"), vec![image(spec("vacon-nx"))]);
        bus.image
            .update_health(|health| (health.up, health.tried) = (true, true));
        let plant = Plant::new("hall", STALE_AFTER, vec![bus]);
        let rig = ControlledDrive {
            view: View::new(Arc::new(plant), Arc::new(options()), HostRights::new(&options())),
            now: Instant::now(),
        };
        rig.read(0);
        rig
    }

    fn drive(&self) -> DriveHandle {
        self.view.plant.drive("p1").unwrap()
    }

    /// Stores this value in every polled register, as just read.
    fn read(&self, word: u16) {
        read_all(&self.drive().image, self.now, |_| word);
        self.view.set_time(self.now);
    }

    fn place(&self, object: ObjectId) -> usize {
        let devices = self.view.devices();
        devices
            .iter()
            .find(|device| device.instance == DEVICE)
            .unwrap()
            .find(object)
            .unwrap()
    }

    fn begin(&self, client: &str, object: ObjectId, priority: u8, value: Option<Datum>) -> JobProgress {
        let job = Job {
            token: 1,
            from: format!("{client}:47808").parse().unwrap(),
            device: DEVICE,
            place: self.place(object),
            object,
            value,
            priority: Some(priority),
            requested_at: self.now,
            since: self.now,
        };
        writes::begin(&self.view, &job, Arrival::now(self.now), self.now)
    }

    /// The immediate result of a write: the write is refused or done.
    fn at_once(&self, client: &str, object: ObjectId, priority: u8, value: Option<Datum>) -> Result<(), Error> {
        match self.begin(client, object, priority, value) {
            JobProgress::Answered(result) => result,
            JobProgress::Waits(mut waiting) => {
                let answer = waiting.placed.answer().expect("it waits for the drive");
                self.settle(&waiting, &answer.outcome);
                writes::error(&answer.outcome)
            }
        }
    }

    /// The order that results from a write, with its outcome: point, value and client.
    fn order(&self, client: &str, object: ObjectId, priority: u8, value: Option<Datum>, outcome: Outcome) -> String {
        let JobProgress::Waits(mut waiting) = self.begin(client, object, priority, value) else {
            panic!("no order");
        };
        let ordered = self.carry_out(outcome);
        let answer = waiting.placed.answer().unwrap();
        self.settle(&waiting, &answer.outcome);
        ordered
    }

    fn settle(&self, waiting: &Waiting, outcome: &Outcome) {
        if let Some(slot) = waiting.slot {
            self.drive()
                .priorities(|all| all.settle(slot, Settled::of(outcome), self.now));
        }
    }

    /// The bus takes the next order, which ends so.
    fn carry_out(&self, outcome: Outcome) -> String {
        let drive = self.drive();
        let command = take_next(&drive.bus.queue, self.now).expect("an order");
        let Order::Points(values) = &command.intent.order else {
            panic!("{:?}", command.intent.order)
        };
        let name = |index: PointIndex| drive.image.spec.profile.points.get(index).unwrap().name.clone();
        let values: Vec<String> = values
            .iter()
            .map(|(index, value)| format!("{}={value}", name(*index)))
            .collect();
        let text = format!("{} by {}", values.join(" "), command.ticket.origin().client());
        command.answer(&outcome, self.now);
        text
    }

    /// Values in the slots, as a client reads them.
    fn slots(&self, object: ObjectId) -> Vec<(u8, Datum)> {
        let commands = self.view.commands(DEVICE, self.place(object)).unwrap();
        (1..)
            .zip(commands.slots)
            .filter_map(|(priority, slot)| Some((priority, slot?.value)))
            .collect()
    }

    fn shown(&self, object: ObjectId) -> Datum {
        self.view.sample(DEVICE, self.place(object)).value.unwrap()
    }

    /// Gives the drive an order over another interface, as an MQTT client would; returns the refusal, if any.
    fn elsewhere(&self, point: ModelPoint, value: Value) -> Option<Refusal> {
        let drive = self.drive();
        let index = drive.image.spec.profile.model_index(point).unwrap();
        let origin = Origin::new(SourceKind::Mqtt, "cloud");
        let order = Order::Points(vec![(index, value)]);
        let mut placed = drive.place(
            OrderRequest::new(order, origin, Authority::Write).within(Duration::from_secs(2)),
            self.now,
        );
        match placed.answer().map(|answer| answer.outcome) {
            Some(Outcome::Refused(refusal)) => Some(refusal),
            _ => None,
        }
    }
}

fn done() -> Outcome {
    Outcome::Acknowledged(Reply::Written)
}

fn on(active: bool) -> Option<Datum> {
    Some(Datum::Bool(active))
}

fn number(value: f64) -> Option<Datum> {
    Some(Datum::Number(value))
}
