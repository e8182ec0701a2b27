//! The line with its ports, tested in real time; no test depends on how slow the machine is.

use super::super::faults::Fault;
use super::super::half_duplex::Delivery;
use super::super::statistics::Direction;
use super::*;
use drivegate_line::Pty;
use drivegate_proto::LineFormat;
use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::fd::AsFd;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

/// A read of the status word of drive 1, and the reply of an idle drive.
const ASK: [u8; 8] = [0x01, 0x03, 0x08, 0x34, 0x00, 0x01, 0xC7, 0xA4];
const REPLY: [u8; 7] = [0x01, 0x03, 0x02, 0x05, 0x41, 0x7B, 0x24];

fn options(baud: u32) -> SimulatedBusOptions {
    let rules = LineRules::new(LineFormat::new(baud, "8N1").unwrap());
    SimulatedBusOptions::new("test", rules, vec![DriveOptions::nx(1), DriveOptions::nx(2)])
}

fn open(address: &str) -> File {
    let flags = rustix::fs::OFlags::NOCTTY | rustix::fs::OFlags::NONBLOCK;
    OpenOptions::new()
        .read(true)
        .write(true)
        .custom_flags(flags.bits() as i32)
        .open(address)
        .unwrap()
}

/// Reads `count` bytes, or the bytes that arrive within `time`.
fn read(port: &mut (impl Read + AsFd), count: usize, time: Duration) -> Vec<u8> {
    let until = Instant::now() + time;
    let mut bytes = Vec::new();
    while bytes.len() < count && Instant::now() < until {
        poll_until(&mut [PollFd::new(&*port, PollFlags::IN)], until).unwrap();
        let mut buffer = [0; 256];
        match port.read(&mut buffer) {
            Ok(0) => break,
            Ok(count) => bytes.extend_from_slice(&buffer[..count]),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
            Err(_) => break,
        }
    }
    bytes
}

const LONG: Duration = Duration::from_secs(10);

#[test]
fn a_drive_answers_on_a_pseudo_terminal_no_sooner_than_the_wire_allows() {
    for delivery in [Delivery::Whole, Delivery::Chunks(1)] {
        let mut options = options(9600);
        options.transcript = 10;
        options.rules.delivery = delivery;
        let format = options.rules.format;
        let bus = SimulatedBus::start(options).unwrap();
        let mut port = open(&bus.address());
        let asked = Instant::now();
        port.write_all(&ASK).unwrap();
        assert_eq!(read(&mut port, REPLY.len(), LONG), REPLY);
        let least = format.chars(ASK.len() + REPLY.len()) + format.silence_chars() + Duration::from_micros(500);
        assert!(asked.elapsed() >= least, "{:?} < {least:?}", asked.elapsed());
        let frames = bus.transcript();
        assert_eq!(
            (frames[0].direction, frames[0].bytes.as_slice()),
            (Direction::ToDrives, ASK.as_slice())
        );
        assert_eq!(
            (frames[1].direction, frames[1].bytes.as_slice()),
            (Direction::FromDrives, REPLY.as_slice())
        );
        assert!(bus.lateness(0.5).is_some());
    }
}

#[test]
fn dead_drives_faults_and_direct_access() {
    let bus = SimulatedBus::start(options(38_400)).unwrap();
    let mut port = open(&bus.address());
    let mut ask = |count, time| {
        port.write_all(&ASK).unwrap();
        let reply = read(&mut port, count, time);
        std::thread::sleep(Duration::from_millis(5));
        reply
    };
    let short = Duration::from_millis(300);
    assert!(bus.set_alive(1, false) && !bus.set_alive(9, false));
    assert!(ask(1, short).is_empty());
    bus.set_alive(1, true);
    assert_eq!(ask(REPLY.len(), LONG), REPLY);
    bus.set_faults(
        FaultPlan::default()
            .on_request(1, Fault::Exception(6))
            .on_request(2, Fault::Drop),
    );
    assert_eq!(ask(5, LONG)[..3], [1, 0x83, 6]);
    assert!(ask(1, short).is_empty());
    assert_eq!(ask(REPLY.len(), LONG), REPLY);
    let fault = bus.with_drive(1, |drive, _| {
        drive.trip(14);
        drive.state().fault
    });
    assert_eq!(fault, Some(14));
    assert_eq!(bus.with_drive(9, |_, _| ()), None);
    let s = bus.statistics();
    assert_eq!((s.unanswered, s.requests, s.replies, s.faults), (1, 4, 3, 2));
}

#[test]
fn an_adapter_that_is_unplugged_and_plugged_in_again() {
    let directory = tempfile::tempdir().unwrap();
    let link = directory.path().join("line");
    let mut options = options(38_400);
    options.endpoint = EndpointOptions::Pty {
        link: Some(link.clone()),
    };
    let bus = SimulatedBus::start(options).unwrap();
    assert_eq!(bus.address(), link.display().to_string());
    let mut port = open(&bus.address());
    port.write_all(&ASK).unwrap();
    bus.vanish();
    assert!(bus.address().is_empty() && std::fs::symlink_metadata(&link).is_err());
    assert!(read(&mut port, 7, Duration::from_millis(50)).is_empty());
    assert!(port.write_all(&ASK).is_err(), "the open port is dead");
    bus.vanish();
    bus.restore().unwrap();
    bus.restore().unwrap();
    let mut port = open(&bus.address());
    port.write_all(&ASK).unwrap();
    assert_eq!(read(&mut port, REPLY.len(), LONG), REPLY);

    bus.vanish();
    std::fs::write(&link, "in the way").unwrap();
    assert!(bus.restore().unwrap_err().to_string().contains("not a symbolic link"));
    std::fs::remove_file(&link).unwrap();
    let waited = Instant::now();
    while bus.address().is_empty() && waited.elapsed() < LONG {
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(!bus.address().is_empty(), "it is opened again without help");
    bus.stop();
    assert!(std::fs::symlink_metadata(&link).is_err());
}

#[test]
fn what_a_killed_master_did_not_read_is_thrown_away() {
    let bus = SimulatedBus::start(options(38_400)).unwrap();
    let mut port = open(&bus.address());
    port.write_all(&ASK).unwrap();
    let waiting = || rustix::io::ioctl_fionread(open(&bus.address())).unwrap();
    let until = |wanted| {
        let waited = Instant::now();
        while waiting() != wanted && waited.elapsed() < LONG {
            std::thread::sleep(Duration::from_millis(10));
        }
        waiting()
    };
    assert_eq!(until(REPLY.len() as u64), REPLY.len() as u64);
    assert_eq!(until(0), 0);
}

#[test]
fn a_serial_device_server() {
    let mut options = options(38_400);
    options.endpoint = EndpointOptions::Tcp {
        listen: "127.0.0.1:0".parse().unwrap(),
    };
    let bus = SimulatedBus::start(options).unwrap();
    let address = bus.address().strip_prefix("tcp://").unwrap().to_string();
    for _ in 0..2 {
        let mut stream = TcpStream::connect(&address).unwrap();
        stream.set_nonblocking(true).unwrap();
        stream.write_all(&ASK).unwrap();
        assert_eq!(read(&mut stream, REPLY.len(), LONG), REPLY);
        let mut second = TcpStream::connect(&address).unwrap();
        second.set_read_timeout(Some(LONG)).unwrap();
        assert_eq!(second.read(&mut [0; 8]).unwrap_or(0), 0, "one master at a time");
        std::thread::sleep(Duration::from_millis(5));
    }
    bus.vanish();
    assert!(TcpStream::connect(&address).is_err());
}

#[test]
fn a_real_port_keeps_its_own_time() {
    let other_end = Pty::open(None).unwrap();
    let mut options = options(38_400);
    let format = options.rules.format;
    options.endpoint = EndpointOptions::Port {
        path: other_end.path().to_path_buf(),
    };
    let bus = SimulatedBus::start(options).unwrap();
    assert_eq!(Path::new(&bus.address()), other_end.path());
    let mut master = File::from(other_end.as_fd().try_clone_to_owned().unwrap());
    for _ in 0..2 {
        master.write_all(&ASK).unwrap();
        assert_eq!(read(&mut master, REPLY.len(), LONG), REPLY);
        // A real port would still be sending the reply, and the next request would take its time to arrive.
        std::thread::sleep(format.chars(REPLY.len() + ASK.len() + 4));
    }
    assert_eq!(bus.statistics().replies, 2);

    let mut missing = self::options(38_400);
    missing.endpoint = EndpointOptions::Port {
        path: "/nonexistent/ttyUSB0".into(),
    };
    let error = SimulatedBus::start(missing).unwrap_err().to_string();
    assert!(
        error.contains("cannot open the serial port /nonexistent/ttyUSB0"),
        "{error}"
    );
}

#[test]
fn addresses_in_short() {
    assert_eq!(ranges(&[]), "");
    assert_eq!(ranges(&[1, 2, 3, 7, 9, 10, 247]), "1-3, 7, 9-10, 247");
}
