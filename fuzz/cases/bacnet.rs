//! Datagrams that hosts may send to the BACnet server, and replies that drives may send meanwhile.
//!
//! Input: steps of a kind, a length and as many bytes. A step is a raw datagram, an APDU to the gateway or to a
//! drive, by one host or by all, from behind a router, or lets time pass. All output must be BACnet/IP datagrams,
//! in total no more than eight times the input and 16 kB a second.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;
use std::time::{Duration, Instant};

use drivegate_bacnet::npdu::{self, Payload};
use drivegate_bacnet::object::{Access, Commands, Datum, Device, Kind, Object, Reliability, Sample};
use drivegate_bacnet::services::WriteItem;
use drivegate_bacnet::types::Error;
use drivegate_bacnet::{Application, DateTime, Mac, ObjectId, ObjectType, Options, Server, To, bvlc};

const NETWORK: u16 = 1001;
const GATEWAY: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), 47808);

struct Plant;

impl Application for Plant {
    fn admits(&self, host: Ipv4Addr) -> bool {
        host.octets()[0] == 10
    }

    fn may_write(&self, _: Ipv4Addr) -> bool {
        true
    }

    fn clock(&self) -> DateTime {
        DateTime::from_unix_ms(0)
    }

    fn answers(&self, device: u32) -> bool {
        device != 103
    }

    fn sample(&self, device: u32, place: usize) -> Sample {
        let value = [Datum::Number(f64::from(device)), Datum::Number(1.5), Datum::Bool(true), Datum::State(2)];
        Sample { value: value.get(place).cloned(), reliability: Reliability::NoFault, at: None }
    }

    fn commands(&self, _: u32, _: usize) -> Option<Commands> {
        Some(Commands::default())
    }

    fn stops(&self, _: u32, write: &WriteItem) -> bool {
        write.object.kind == ObjectType::BINARY_VALUE
    }

    fn orders(&self, device: u32) -> u64 {
        u64::from(device)
    }

    fn password(&self, given: &str) -> bool {
        given == "p"
    }
}

fn device(instance: u32, station: Option<u8>) -> Arc<Device> {
    let analog = || Kind::Analog { units: 98, resolution: 0.1, range: None, increment: 1.0 };
    let object = |kind: ObjectType, name: &str, values: Kind, access: Access| Object {
        id: ObjectId::new(kind, 1),
        name: name.into(),
        description: "".into(),
        kind: values,
        access,
    };
    let texts = vec!["a".to_string(), "b".to_string()];
    let objects = vec![
        object(ObjectType::ANALOG_INPUT, "speed", analog(), Access::Read),
        object(ObjectType::ANALOG_VALUE, "reference", analog(), Access::Command),
        object(ObjectType::BINARY_VALUE, "run", Kind::Binary { texts: ["off".into(), "on".into()] }, Access::Command),
        object(ObjectType::MULTI_STATE_INPUT, "state", Kind::MultiState { texts: texts.into() }, Access::Read),
        object(ObjectType::CHARACTERSTRING_VALUE, "text", Kind::Text, Access::Read),
    ];
    let station = station.and_then(|octet| Mac::new(&[octet]));
    Arc::new(Device::new(instance, station, format!("d{instance}"), ("m".to_string(), "".to_string()), objects))
}

pub(crate) fn run(data: &[u8]) {
    let mut now = Instant::now();
    let options = Options {
        address: GATEWAY,
        prefix: 24,
        network: Some(NETWORK),
        vendor: (0, "fuzz".into()),
        version: "0".into(),
        bbmd: None,
        foreign_devices: 2,
    };
    let devices = [None, Some(1), Some(2), Some(3)].map(|unit| device(100 + u32::from(unit.unwrap_or(0)), unit));
    let mut server = Server::new(options, devices.to_vec(), now);
    let (mut came, mut left, mut seconds) = (0, 0, 1);
    let mut rest = data;
    while let [kind, length, after @ ..] = rest {
        let (bytes, after) = after.split_at(usize::from(*length).min(after.len()));
        rest = after;
        let host = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 2 + (kind >> 6)), 47808);
        let station = (kind >> 4 & 3 > 0).then(|| Mac::new(&[kind >> 4 & 3])).flatten();
        let to = station.map(|mac| (NETWORK, mac));
        let apdu = |from| npdu::encode(to, from, true, Payload::Application(bytes));
        let datagram = match kind & 7 {
            0 => bytes.to_vec(),
            1 => bvlc::unicast(bytes),
            2..=4 => bvlc::unicast(&apdu(None)),
            5 => bvlc::broadcast(&apdu(None)),
            6 => bvlc::unicast(&apdu(Mac::new(&[9]).map(|mac| (7, mac)))),
            _ => {
                now += Duration::from_millis(100 * u64::from(*length));
                seconds += u64::from(*length) / 10 + 1;
                server.poll(&Plant, now);
                Vec::new()
            }
        };
        came += datagram.len();
        server.receive(host, &datagram, &Plant, now);
        while let Some(job) = server.take_job() {
            let result = if job.token % 3 == 0 { Err(Error::TIMEOUT) } else { Ok(()) };
            server.written(job.token, result, &Plant, now);
        }
        while let Some((to, bytes)) = server.transmit() {
            assert!(bvlc::decode(&bytes).is_some() && bytes.len() <= 1497, "{bytes:?}");
            left += if to == To::Broadcast { 0 } else { bytes.len() };
        }
        assert!(server.counters().subscriptions <= 4096);
    }
    let notifications = server.counters().notifications as usize * 3 * 200;
    // There are four hosts; datagrams that wait at the end of a second are sent in the next one.
    assert!(left <= 8 * came + 4 * 16 * 1024 * seconds as usize + notifications, "{left} of {came} in {seconds} s");
}
