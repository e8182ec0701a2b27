use std::cell::{Cell, RefCell};
use std::collections::{HashMap, HashSet};
use std::time::Duration;

use super::*;
use crate::apdu;
use crate::bvlc;
use crate::encoding::{Reader, Writer};
use crate::npdu::{self, Npdu, Payload};
use crate::object::{Access, Datum, Kind, Object, Reliability};
use crate::services::confirmed as c;
use crate::types::{Data, Error, ObjectType, PropertyId};

mod chance;
mod discovery;
mod limits;
mod notifying;
mod reading;
mod writing;

const NETWORK: u16 = 1001;
const PV: u32 = 85;

/// The devices behind the server of a test.
#[derive(Default)]
struct Plant {
    values: RefCell<HashMap<(u32, usize), Sample>>,
    silent: RefCell<HashSet<u32>>,
    orders: Cell<u64>,
    nobody_writes: Cell<bool>,
}

impl Application for Plant {
    fn admits(&self, host: Ipv4Addr) -> bool {
        host.octets()[0] == 10
    }

    fn may_write(&self, host: Ipv4Addr) -> bool {
        host.octets()[3] < 100 && !self.nobody_writes.get()
    }

    fn clock(&self) -> DateTime {
        DateTime::from_unix_ms(0)
    }

    fn answers(&self, device: u32) -> bool {
        !self.silent.borrow().contains(&device)
    }

    fn sample(&self, device: u32, place: usize) -> Sample {
        let known = self.values.borrow().get(&(device, place)).cloned();
        known.unwrap_or(Sample {
            value: None,
            reliability: Reliability::CommunicationFailure,
            at: None,
        })
    }

    fn commands(&self, _: u32, _: usize) -> Option<Commands> {
        Some(Commands::default())
    }

    fn stops(&self, _: u32, write: &WriteItem) -> bool {
        write.object == RUN && matches!(write.value, Some(Data::Enumerated(0) | Data::Null))
    }

    fn orders(&self, _: u32) -> u64 {
        self.orders.get()
    }

    fn password(&self, given: &str) -> bool {
        given == "secret"
    }
}

const SPEED: ObjectId = ObjectId::new(ObjectType::ANALOG_INPUT, 1);
const REFERENCE: ObjectId = ObjectId::new(ObjectType::ANALOG_VALUE, 1);
const RUN: ObjectId = ObjectId::new(ObjectType::BINARY_VALUE, 1);
const STATE: ObjectId = ObjectId::new(ObjectType::MULTI_STATE_INPUT, 1);
const TEXT: ObjectId = ObjectId::new(ObjectType::CHARACTERSTRING_VALUE, 1);

fn object(id: ObjectId, name: &str) -> Object {
    let analog = Kind::Analog {
        units: 98,
        resolution: 0.01,
        range: Some((0.0, 100.0)),
        increment: 0.1,
    };
    let (kind, access) = match id {
        SPEED => (analog, Access::Read),
        REFERENCE => (analog, Access::Command),
        RUN => (
            Kind::Binary {
                texts: ["off".into(), "on".into()],
            },
            Access::Command,
        ),
        STATE => (
            Kind::MultiState {
                texts: vec!["offline".to_string(), "ready".to_string()].into(),
            },
            Access::Read,
        ),
        _ => (Kind::Text, Access::Read),
    };
    Object {
        id,
        name: name.into(),
        description: "".into(),
        kind,
        access,
    }
}

fn device(instance: u32, station: Option<u8>, more: u32) -> Arc<Device> {
    let mut objects = vec![
        object(SPEED, "speed"),
        object(REFERENCE, "reference"),
        object(RUN, "run"),
        object(STATE, "state"),
        object(TEXT, "text"),
    ];
    for number in 100..100 + more {
        let id = ObjectId::new(ObjectType::ANALOG_INPUT, number);
        objects.push(Object {
            id,
            name: format!("own_{number}").into(),
            ..object(SPEED, "")
        });
    }
    let station = station.map(|octet| Mac::new(&[octet]).unwrap());
    let texts = ("model".to_string(), "a device".to_string());
    Arc::new(Device::new(
        instance,
        station,
        format!("device-{instance}"),
        texts,
        objects,
    ))
}

fn options() -> Options {
    Options {
        address: "10.0.0.1:47808".parse().unwrap(),
        prefix: 24,
        network: Some(NETWORK),
        vendor: (0, "test".into()),
        version: "1".into(),
        bbmd: None,
        foreign_devices: 0,
    }
}

/// The server's own device and those of its drives, numbered from `first` on.
fn devices(first: u32, drives: u8, more: u32) -> Vec<Arc<Device>> {
    let drives = (1..=drives).map(|unit| device(first + u32::from(unit), Some(unit), more));
    [device(first, None, 0)].into_iter().chain(drives).collect()
}

/// A test server at 10.0.0.1 with its own device 100, the devices 101 to 103 behind it, and its clients.
struct ServerWithClients {
    server: Server,
    plant: Plant,
    now: Instant,
}

/// A sent message: destination, network and station of the device, and the APDU.
type Out = (To, Option<(u16, Mac, u8)>, Option<u8>, Vec<u8>);

impl ServerWithClients {
    fn new() -> ServerWithClients {
        ServerWithClients::of(3, 0)
    }

    fn of(drives: u8, more: u32) -> ServerWithClients {
        let now = Instant::now();
        ServerWithClients {
            server: Server::new(options(), devices(100, drives, more), now),
            plant: Plant::default(),
            now,
        }
    }

    /// Starts the server anew with these numbers: its own device has number `first`, its drives the next ones.
    fn restart(&mut self, first: u32) {
        self.server.restart(options(), devices(first, 3, 0), self.now);
    }

    fn client(last: u8) -> SocketAddrV4 {
        SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, last), 47808)
    }

    fn shows(&self, device: u32, place: usize, value: Datum) {
        let good = Sample {
            value: Some(value),
            reliability: Reliability::NoFault,
            at: None,
        };
        self.plant.values.borrow_mut().insert((device, place), good);
    }

    fn datagram(&mut self, from: u8, bytes: &[u8]) {
        self.server
            .receive(ServerWithClients::client(from), bytes, &self.plant, self.now);
    }

    /// Sends a message to a station of the virtual network, or to the gateway itself.
    fn tell(&mut self, from: u8, station: Option<u8>, apdu: &[u8]) {
        let to = station.map(|octet| (NETWORK, Mac::new(&[octet]).unwrap()));
        let npdu = npdu::encode(to, None, true, Payload::Application(apdu));
        self.datagram(from, &bvlc::unicast(&npdu));
    }

    /// Sends a request with the usual header; returns the APDUs that follow.
    fn ask(&mut self, from: u8, station: Option<u8>, invoke: u8, service: u8, content: &[u8]) -> Vec<Vec<u8>> {
        let mut apdu = vec![0x02, 0x05, invoke, service];
        apdu.extend(content);
        self.tell(from, station, &apdu);
        self.out().into_iter().map(|(.., apdu)| apdu).collect()
    }

    fn out(&mut self) -> Vec<Out> {
        std::iter::from_fn(|| self.server.transmit())
            .map(|(to, bytes)| opened(to, &bytes))
            .collect()
    }

    fn later(&mut self, time: Duration) {
        let end = self.now + time;
        while self.now < end {
            self.now += Duration::from_millis(100);
            self.server.poll(&self.plant, self.now);
        }
    }
}

fn opened(to: To, bytes: &[u8]) -> Out {
    let (bvlc::Bvlc::Unicast(npdu) | bvlc::Bvlc::Broadcast(npdu)) = bvlc::decode(bytes).unwrap() else {
        panic!("{bytes:?}");
    };
    let Npdu {
        to: remote,
        from,
        payload,
        ..
    } = npdu::decode(npdu).unwrap();
    let station = from.map(|(network, mac)| {
        assert_eq!(network, NETWORK);
        mac.octets()[0]
    });
    match payload {
        Payload::Application(apdu) => (to, remote, station, apdu.to_vec()),
        Payload::Network(kind, content) => (to, remote, station, [&[0xFF, kind], content].concat()),
    }
}

fn written(write: impl FnOnce(&mut Writer)) -> Vec<u8> {
    let mut writer = Writer::default();
    write(&mut writer);
    writer.into_bytes()
}

fn read(object: ObjectId, property: u32) -> Vec<u8> {
    written(|w| {
        w.context_object(0, object).context_unsigned(1, property.into());
    })
}

/// A WriteProperty request for a Present_Value.
fn write(object: ObjectId, priority: Option<u64>, value: impl FnOnce(&mut Writer)) -> Vec<u8> {
    written(|w| {
        w.context_object(0, object).context_unsigned(1, PV.into()).open(3);
        value(w);
        w.close(3);
        if let Some(priority) = priority {
            w.context_unsigned(4, priority);
        }
    })
}

/// The value in the answer to ReadProperty.
fn value(answer: &[u8]) -> Option<Data> {
    let mut reader = Reader::new(answer.get(3..)?);
    reader.context_object(0).ok()?;
    reader.context_property(1).ok()?;
    reader.optional_u32(2).ok()?;
    reader.open(3).ok()?;
    reader.data().ok()?
}
