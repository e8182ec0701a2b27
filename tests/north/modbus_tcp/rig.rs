//! A hand-made plant with simulated buses, a server for it, and a minimal client.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

use arc_swap::ArcSwap;
use drivegate_core::order::{Command, Order, Outcome};
use drivegate_core::plant::{BusHandle, Plant, SharedPlant};
use drivegate_core::process_image::{Access, BusSpec, DriveImage, DriveSpec, LeaseAction, Link, Supervision};
use drivegate_core::queue::CommandQueue;
use drivegate_model::drive::RawWrites;
use drivegate_model::drive::profile::Profile;
use drivegate_north::modbus_tcp::{self, Listener, Options, Server, Uncached};
use drivegate_north::{NorthState, ServerError};
use drivegate_north::{Reconfigure as _, Server as _};
use drivegate_proto::{Protocol, Reply, RequestPdu, Table};
use drivegate_testkit::{bus_spec, monitored, nx, profile, take_next};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpSocket, TcpStream};
use tokio_util::sync::CancellationToken;

pub(crate) use crate::support::process::PATIENCE;

/// Longer than any test takes.
const HOUR: Duration = Duration::from_secs(3600);

/// A family that uses all four tables.
const METER: &str = r#"
name = "meter"
title = "Meter"
protocols = ["modbus-rtu"]
[[range]]
table = "coil"
first = 0
last = 99
read = 16
write = 16
[[range]]
table = "discrete-input"
first = 0
last = 99
read = 16
[[range]]
table = "input"
first = 0
last = 99
read = 10
[[range]]
table = "holding"
first = 0
last = 99
read = 10
write = 10
[[point]]
name = "running"
at = "discrete-input 3"
class = "fast"
[[point]]
name = "energised"
at = "discrete-input 4"
class = "fast"
[[point]]
name = "relay"
at = "coil 7"
class = "fast"
write = true
[[point]]
name = "motor_current"
at = "input 5"
class = "fast"
"#;

/// Reaction of a simulated bus to a command; `None` never answers it.
pub(crate) type Script = Box<dyn FnMut(&Command) -> Option<Outcome> + Send>;

/// The other end of a command queue.
pub(crate) struct FakeBus {
    queue: Arc<CommandQueue>,
    pub(crate) seen: Arc<Mutex<Vec<(usize, Order)>>>,
    script: Arc<Mutex<Script>>,
    paused: Arc<AtomicBool>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl FakeBus {
    pub(crate) fn start(queue: Arc<CommandQueue>) -> FakeBus {
        let mut bus = FakeBus {
            queue,
            seen: Arc::default(),
            script: Arc::new(Mutex::new(Box::new(|c| Some(acknowledge(c))))),
            paused: Arc::default(),
            stop: Arc::default(),
            thread: None,
        };
        let (queue, seen, script) = (bus.queue.clone(), bus.seen.clone(), bus.script.clone());
        let (paused, stop) = (bus.paused.clone(), bus.stop.clone());
        bus.thread = Some(std::thread::spawn(move || {
            let mut kept = Vec::new();
            // A start that arrives during a stall of the machine goes a moment later, and nothing else wakes the queue then.
            let pause = Timespec {
                tv_sec: 0,
                tv_nsec: 20_000_000,
            };
            while !stop.load(Ordering::SeqCst) {
                poll(
                    &mut [PollFd::from_borrowed_fd(queue.wake_fd(), PollFlags::IN)],
                    Some(&pause),
                )
                .unwrap();
                queue.clear_wake();
                while !paused.load(Ordering::SeqCst) {
                    let Some(command) = take_next(&queue, Instant::now()) else {
                        break;
                    };
                    seen.lock()
                        .unwrap()
                        .push((command.drive().unwrap().place(), command.intent.order.clone()));
                    match (script.lock().unwrap())(&command) {
                        Some(outcome) => command.answer(&outcome, Instant::now()),
                        None => kept.push(command),
                    }
                }
            }
        }));
        bus
    }

    /// Answers commands by this script from now on.
    pub(crate) fn answers(&self, script: impl FnMut(&Command) -> Option<Outcome> + Send + 'static) {
        *self.script.lock().unwrap() = Box::new(script);
    }

    /// With `paused`, leaves commands in the queue; otherwise takes them again.
    pub(crate) fn pause(&self, paused: bool) {
        self.paused.store(paused, Ordering::SeqCst);
        self.queue.wake();
    }

    pub(crate) fn waiting(&self) -> usize {
        self.queue.lock().len()
    }

    /// The orders that arrived since the last call.
    pub(crate) fn orders(&self) -> Vec<Order> {
        self.seen.lock().unwrap().drain(..).map(|(_, order)| order).collect()
    }
}

impl Drop for FakeBus {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::SeqCst);
        self.queue.wake();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// A drive whose register n holds n.
pub(crate) fn acknowledge(command: &Command) -> Outcome {
    Outcome::Acknowledged(match &command.intent.order {
        Order::Read(RequestPdu::Read { table, start, count }) if table.is_bits() => {
            Reply::Bits((*start..start + count).map(|n| n % 3 == 0).collect())
        }
        Order::Read(RequestPdu::Read { start, count, .. }) => Reply::Registers((*start..start + count).collect()),
        _ => Reply::Written,
    })
}

pub(crate) struct Rig {
    pub(crate) plant: SharedPlant,
    pub(crate) buses: Vec<FakeBus>,
    pub(crate) stats: Arc<NorthState>,
    pub(crate) cancel: CancellationToken,
    pub(crate) server: Server,
}

pub(crate) fn options() -> Options {
    Options {
        listeners: vec![listener()],
        tls: None,
        max_connections: 64,
        max_connections_per_address: 1000,
        idle_timeout: None,
        uncached: Uncached::Forward,
    }
}

/// A listener that all clients of this machine may use and 127.0.0.1 may write to.
pub(crate) fn listener() -> Listener {
    Listener {
        section: "[modbus_tcp]".to_string(),
        listen: vec![SocketAddr::from(([127, 0, 0, 1], 0))],
        allow: vec!["127.0.0.0/8".parse().unwrap()],
        write: vec!["127.0.0.1/32".parse().unwrap()],
        view: Default::default(),
    }
}

/// A drive with a lease that outlives every test.
fn supervised(name: &str, bus: &str, unit: u8, profile: &Arc<Profile>, access: Access) -> DriveSpec {
    DriveSpec {
        access,
        supervision: Some(Supervision {
            timeout: HOUR,
            action: LeaseAction::LeaveRunning,
            adopt: false,
        }),
        ..monitored(name, bus, unit, profile)
    }
}

fn bus(name: &str, protocol: Protocol, drives: Vec<DriveSpec>) -> BusHandle {
    let spec = BusSpec {
        protocol,
        ..bus_spec(name)
    };
    let images = drives.into_iter().map(drivegate_testkit::image).collect();
    let bus = drivegate_testkit::bus(spec, images);
    bus.image.update_health(|h| (h.up, h.load) = (true, Some(0.5)));
    bus
}

/// Fills in the values of a running NX drive at half speed.
pub(crate) fn fill(image: &DriveImage) {
    let now = Instant::now();
    image.update(|s| {
        s.link = Link::Online(SystemTime::now());
        s.fast_at = Some(now);
        s.store(
            Table::Holding,
            2100,
            &[0x0023, 0x2000, 5000, 2500, 1440, 123, 455, 387, 2301, 540, 0],
            now,
        );
        s.store(Table::Holding, 7, &[42, 30], now);
        s.store(Table::Holding, 2000, &[1, 0, 5000], now);
        s.store(Table::Holding, 100, &[0, 5000, 30, 30], now);
        s.store(Table::Holding, 732, &[1, 2], now);
    });
}

/// line1: unit 1 pump-1 (control), unit 2 pump-2 (monitor), unit 3 spare (control, never answered);
/// line2: unit 4 meter (control). Values are good for an hour.
pub(crate) fn plant() -> Plant {
    plant_where(|_| {})
}

/// The plant with its drives changed by `change`.
pub(crate) fn plant_where(change: impl Fn(&mut DriveSpec)) -> Plant {
    let bus = |name: &str, mut drives: Vec<DriveSpec>| {
        drives.iter_mut().for_each(&change);
        bus(name, Protocol::ModbusRtu, drives)
    };
    let nx = &nx();
    let meter = Arc::new(Profile::parse("meter.toml", METER, false).unwrap());
    let line1 = bus(
        "line1",
        vec![
            supervised("pump-1", "line1", 1, nx, Access::Control),
            supervised("pump-2", "line1", 2, nx, Access::Monitor),
            supervised("spare", "line1", 3, nx, Access::Control),
        ],
    );
    let meter = DriveSpec {
        raw_writes: RawWrites::Ranges(vec![0..=99]),
        ..supervised("meter", "line2", 4, &meter, Access::Control)
    };
    let line2 = bus("line2", vec![meter]);
    fill(&line1.image.drives[0]);
    fill(&line1.image.drives[1]);
    line2.image.drives[0].update(|s| {
        let now = Instant::now();
        s.link = Link::Online(SystemTime::now());
        s.fast_at = Some(now);
        s.store(Table::DiscreteInput, 3, &[1, 0], now);
        s.store(Table::Coil, 7, &[1], now);
        s.store(Table::Input, 5, &[77], now);
    });
    plant_of(vec![line1, line2])
}

fn plant_of(buses: Vec<BusHandle>) -> Plant {
    Plant::new("pump-house", HOUR, buses)
}

/// A plant in which unit 1 is a Vacon NX with an N2 board. Its objects BI 6, BI 7 and AI 2 were read.
pub(crate) fn n2_plant() -> Plant {
    let drives = vec![supervised("fan-1", "n2", 1, &profile("vacon-nx-n2"), Access::Control)];
    let n2 = bus("n2", Protocol::N2, drives);
    n2.image.drives[0].update(|s| {
        let now = Instant::now();
        s.link = Link::Online(SystemTime::now());
        s.fast_at = Some(now);
        s.store(Table::DiscreteInput, 5, &[1, 1], now);
        s.store(Table::Input, 2, &[0x41C8, 0], now);
    });
    plant_of(vec![n2])
}

impl Rig {
    pub(crate) async fn new() -> Rig {
        Rig::with(options()).await
    }

    pub(crate) async fn with(options: Options) -> Rig {
        Rig::of(plant(), options).await
    }

    pub(crate) async fn of(plant: Plant, options: Options) -> Rig {
        let buses = plant.buses.iter().map(|b| FakeBus::start(b.queue.clone())).collect();
        let plant: SharedPlant = Arc::new(ArcSwap::from_pointee(plant));
        let stats = Arc::new(NorthState::default());
        let cancel = CancellationToken::new();
        let server = modbus_tcp::Server::start(options, plant.clone(), stats.clone(), cancel.clone())
            .await
            .unwrap();
        Rig {
            plant,
            buses,
            stats,
            cancel,
            server,
        }
    }

    /// Applies other options as a reload does.
    pub(crate) async fn reload(&mut self, options: Options) -> Result<(), ServerError> {
        let change = self.server.prepare(options).await?;
        self.server.commit(change);
        Ok(())
    }

    pub(crate) fn address(&self) -> SocketAddr {
        self.server.addresses()[0]
    }

    pub(crate) fn drive(&self, name: &str) -> Arc<DriveImage> {
        self.plant.load().drive(name).unwrap().image
    }

    pub(crate) async fn client(&self) -> Client {
        Client::connect(self.address()).await
    }

    /// Ends the server and waits until all its tasks have ended.
    pub(crate) async fn end(self) {
        self.cancel.cancel();
        tokio::time::timeout(PATIENCE, self.server.stopped()).await.unwrap();
        assert_eq!(self.stats.modbus_tcp.connections(), 0);
    }
}

/// A client that sends any bytes.
pub(crate) struct Client {
    pub(crate) stream: TcpStream,
    transaction: u16,
}

impl Client {
    pub(crate) async fn connect(address: SocketAddr) -> Client {
        Client::connect_from([127, 0, 0, 1], address).await
    }

    /// Connects from another loopback address.
    pub(crate) async fn connect_from(from: [u8; 4], address: SocketAddr) -> Client {
        let socket = TcpSocket::new_v4().unwrap();
        socket
            .bind(SocketAddr::new(IpAddr::V4(Ipv4Addr::from(from)), 0))
            .unwrap();
        let stream = socket.connect(address).await.unwrap();
        stream.set_nodelay(true).unwrap();
        Client { stream, transaction: 0 }
    }

    pub(crate) async fn send(&mut self, bytes: &[u8]) {
        self.stream.write_all(bytes).await.unwrap();
    }

    /// Sends a request; returns the transaction id of the request.
    pub(crate) async fn request(&mut self, unit: u8, pdu: &[u8]) -> u16 {
        self.transaction = self.transaction.wrapping_add(1);
        self.send(&frame(self.transaction, unit, pdu)).await;
        self.transaction
    }

    /// The next answer: transaction id, unit id, PDU; `None` when the connection was closed.
    pub(crate) async fn answer(&mut self) -> Option<(u16, u8, Vec<u8>)> {
        let receive = async {
            let mut header = [0; 7];
            self.stream.read_exact(&mut header).await.ok()?;
            assert_eq!(header[2..4], [0, 0], "protocol id");
            let mut pdu = vec![0; usize::from(u16::from_be_bytes([header[4], header[5]])) - 1];
            self.stream.read_exact(&mut pdu).await.unwrap();
            Some((u16::from_be_bytes([header[0], header[1]]), header[6], pdu))
        };
        tokio::time::timeout(PATIENCE, receive).await.expect("no answer")
    }

    /// The PDU that answers `pdu`.
    pub(crate) async fn ask(&mut self, unit: u8, pdu: &[u8]) -> Vec<u8> {
        let transaction = self.request(unit, pdu).await;
        let (answered, from, pdu) = self.answer().await.expect("the connection was closed");
        assert_eq!((answered, from), (transaction, unit));
        pdu
    }

    /// Whether the server has closed the connection without another byte.
    pub(crate) async fn is_closed(&mut self) -> bool {
        self.answer().await.is_none()
    }
}

pub(crate) fn frame(transaction: u16, unit: u8, pdu: &[u8]) -> Vec<u8> {
    let mut bytes = transaction.to_be_bytes().to_vec();
    bytes.extend_from_slice(&[0, 0]);
    bytes.extend_from_slice(&(pdu.len() as u16 + 1).to_be_bytes());
    bytes.push(unit);
    bytes.extend_from_slice(pdu);
    bytes
}

/// A PDU made of a function code and words.
pub(crate) fn words(function: u8, words: &[u16]) -> Vec<u8> {
    let mut pdu = vec![function];
    words.iter().for_each(|w| pdu.extend_from_slice(&w.to_be_bytes()));
    pdu
}

/// Function 16.
pub(crate) fn write(start: u16, values: &[u16]) -> Vec<u8> {
    let mut pdu = words(16, &[start, values.len() as u16]);
    pdu.push(values.len() as u8 * 2);
    values.iter().for_each(|w| pdu.extend_from_slice(&w.to_be_bytes()));
    pdu
}

/// The regular answer with these registers.
pub(crate) fn registers(function: u8, values: &[u16]) -> Vec<u8> {
    let mut pdu = vec![function, values.len() as u8 * 2];
    values.iter().for_each(|w| pdu.extend_from_slice(&w.to_be_bytes()));
    pdu
}

/// Waits for a condition that another task brings about.
pub(crate) async fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !condition() {
        assert!(Instant::now() < deadline, "never: {what}");
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
}
