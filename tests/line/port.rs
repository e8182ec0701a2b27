//! Tests of the port: unplugged and plugged in again, busy, missing, not a serial port; device servers on TCP.

use std::io::Read;
use std::net::{SocketAddr, TcpListener};
use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use drivegate_core::event::EventKind;
use drivegate_core::order::{Interruption, Outcome};
use drivegate_line::{Line, LineOptions, Rs485};
use drivegate_model::drive::{ModelPoint, State, Value};
use drivegate_proto::LineFormat;
use drivegate_sim::endpoint::EndpointOptions;
use drivegate_sim::faults::FaultPlan;
use drivegate_sim::statistics::Direction;

use super::rig::{Rig, Setup, reason, with_port};
use crate::support::process::until;

fn loopback() -> EndpointOptions {
    EndpointOptions::Tcp {
        listen: SocketAddr::from(([127, 0, 0, 1], 0)),
    }
}

/// A test in virtual time proves that each drive is read exactly once more.
#[tokio::test]
async fn after_a_replug_everything_is_read_and_nothing_written() {
    let rig = Rig::of(Setup {
        drives: 2,
        ..Setup::default()
    });
    let all_read = |r: &Rig| {
        [1, 2]
            .iter()
            .all(|d| r.good(*d, ModelPoint::FrequencyReference).is_some())
    };
    rig.until("both drives are read", all_read).await;
    assert!(rig.set(1, &[("speed_reference", 20.0), ("run", 1.0)]).await.is_ok());
    rig.until("it runs", |r| r.state(1) == State::Running).await;
    for _ in 0..3 {
        rig.line.vanish();
        rig.until("the bus is down", |r| !r.bus_up()).await;
        for address in [1, 2] {
            assert_eq!(rig.good(address, ModelPoint::OutputFrequency), None);
            assert_eq!(rig.state(address), State::Offline);
        }
        assert_eq!(rig.set(1, &[("run", 1.0)]).await, Outcome::BusDown);
        rig.line.record(10_000);
        rig.line.restore().unwrap();
        rig.until("all is good again", |r| r.bus_up() && all_read(r)).await;
        rig.until("it runs on", |r| r.state(1) == State::Running).await;
        let frames = rig.line.transcript();
        for request in frames.iter().filter(|f| f.direction == Direction::ToDrives) {
            assert_eq!(request.bytes[1], 3, "nothing is written: {request}");
        }
    }
    assert_eq!(rig.good(1, ModelPoint::SpeedReference), Some(Value::Number(20.0)));
}

#[tokio::test]
async fn a_command_that_loses_its_port_is_answered_once() {
    // The long time limit keeps the request open until the port disappears.
    let rig = Rig::of(Setup {
        response_timeout: Duration::from_secs(60),
        ..Setup::default()
    });
    for _ in 0..3 {
        rig.until("the drive answers", |r| r.bus_up() && r.state(1) == State::Ready)
            .await;
        // The drive does not answer, so the command is on the line when the port disappears.
        let met = rig.line.statistics().faults;
        rig.line.set_faults(FaultPlan::new("deaf=1".parse().unwrap(), 1));
        let before: u64 = rig.plant.command_log.results().values().sum();
        let commands = futures_util::future::join_all((0..5).map(|i| {
            let value = f64::from(i);
            let rig = &rig;
            async move { rig.set(1, &[("speed_reference", value)]).await }
        }));
        let unplug = async {
            rig.until("a request is met", |r| r.line.statistics().faults > met)
                .await;
            rig.line.vanish();
        };
        let (outcomes, ()) = tokio::join!(commands, unplug);
        for outcome in &outcomes {
            assert!(
                matches!(
                    outcome,
                    Outcome::BusDown
                        | Outcome::TimedOut
                        | Outcome::Replaced
                        | Outcome::Offline
                        | Outcome::Interrupted(_)
                ),
                "{outcome:?}"
            );
        }
        let cut = |outcome: &Outcome| {
            let down = Outcome::Interrupted(Interruption::BusDown);
            *outcome == Outcome::BusDown || *outcome == down
        };
        assert!(outcomes.iter().any(cut), "{outcomes:?}");
        let after: u64 = rig.plant.command_log.results().values().sum();
        assert_eq!(after - before, 5, "each is answered once");
        rig.line.set_faults(FaultPlan::default());
        rig.line.restore().unwrap();
    }
}

#[tokio::test]
async fn a_port_that_is_busy() {
    let rig = Rig::new();
    rig.until("the drive answers", |r| r.state(1) == State::Ready).await;
    let second = with_port(&rig.line.address());
    second.until("it is refused", |r| !reason(r).is_empty()).await;
    let text = reason(&second);
    assert!(text.contains("another program has it"), "{text}");
    assert!(text.contains(&rig.line.address()), "{text}");
    assert!(!second.bus_up());
    assert_eq!(rig.state(1), State::Ready, "the first is not disturbed");
    // The first bus releases the port; the second bus then opens the port by itself.
    let Rig { bus, line, .. } = rig;
    bus.stop();
    second.until("it has the port", Rig::bus_up).await;
    second.until("it reads the drive", |r| r.state(1) == State::Ready).await;
    drop(line);
}

#[tokio::test]
async fn a_port_that_is_none() {
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name).display().to_string();
    std::fs::write(path("file"), "precious").unwrap();
    for (port, expected) in [
        (path("missing"), "plugged in"),
        (path("file"), "not a serial port"),
        (directory.path().display().to_string(), "not a serial port"),
        ("/dev/null".to_string(), "not a serial port"),
    ] {
        let rig = with_port(&port);
        rig.until("it is tried", |r| !reason(r).is_empty()).await;
        let text = reason(&rig);
        assert!(text.contains(expected) && text.contains(&port), "{text}");
        assert!(!rig.bus_up());
    }
    assert_eq!(std::fs::read_to_string(path("file")).unwrap(), "precious");
}

/// The pauses between attempts are tested where they are computed.
#[tokio::test]
async fn a_server_that_hangs_up_is_tried_again() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = format!("tcp://{}", listener.local_addr().unwrap());
    let tries = Arc::new(AtomicUsize::new(0));
    let count = tries.clone();
    std::thread::spawn(move || {
        while listener.accept().is_ok() {
            count.fetch_add(1, Ordering::Relaxed);
        }
    });
    let rig = with_port(&port);
    rig.until("it is tried again", |_| tries.load(Ordering::Relaxed) > 3)
        .await;
    rig.until("the reason", |r| reason(r).contains("lost")).await;
}

#[tokio::test]
async fn a_port_that_comes_is_opened() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("late");
    let rig = with_port(&path.display().to_string());
    rig.until("it is tried", |r| !reason(r).is_empty()).await;
    std::os::unix::fs::symlink(rig.line.address(), &path).unwrap();
    rig.until("it is open", Rig::bus_up).await;
    rig.until("the drive answers", |r| r.state(1) == State::Ready).await;
    assert_eq!(rig.bus.handle().image.health().opened, 1);
}

/// Passes bytes between the bus and a device server, until it is to cut.
fn proxy(to: String) -> (String, Arc<AtomicBool>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("tcp://{}", listener.local_addr().unwrap());
    let cut = Arc::new(AtomicBool::new(false));
    let flag = cut.clone();
    std::thread::spawn(move || {
        while let Ok((near, _)) = listener.accept() {
            let Ok(far) = std::net::TcpStream::connect(to.trim_start_matches("tcp://")) else {
                continue;
            };
            near.set_nodelay(true).unwrap();
            far.set_nodelay(true).unwrap();
            let pump = |mut from: std::net::TcpStream, mut into: std::net::TcpStream| {
                std::thread::spawn(move || {
                    let _ = std::io::copy(&mut from, &mut into);
                    let _ = into.shutdown(std::net::Shutdown::Both);
                })
            };
            let pumps = [
                pump(near.try_clone().unwrap(), far.try_clone().unwrap()),
                pump(far.try_clone().unwrap(), near.try_clone().unwrap()),
            ];
            while !flag.swap(false, Ordering::Relaxed) && !pumps.iter().any(|p| p.is_finished()) {
                std::thread::sleep(Duration::from_millis(1));
            }
            let _ = near.shutdown(std::net::Shutdown::Both);
            let _ = far.shutdown(std::net::Shutdown::Both);
        }
    });
    (address, cut)
}

#[tokio::test]
async fn a_connection_that_is_cut_is_made_anew() {
    let server = Rig::of(Setup {
        endpoint: Some(loopback()),
        port: Some("tcp://127.0.0.1:1".to_string()),
        ..Setup::default()
    });
    assert!(server.line.address().starts_with("tcp://"));
    let (address, cut) = proxy(server.line.address());
    let rig = with_port(&address);
    rig.until("the drive answers", |r| r.state(1) == State::Ready).await;
    let mut events = rig.events.subscribe();
    for opened in 2..5 {
        assert!(rig.set(1, &[("speed_reference", 10.0)]).await.is_ok());
        cut.store(true, Ordering::Relaxed);
        rig.until("it is made anew", |r| r.bus.handle().image.health().opened == opened)
            .await;
        rig.until("it answers again", |r| r.bus_up() && r.state(1) == State::Ready)
            .await;
    }
    // The server had answered over each connection, so none counts as a lost port.
    let presence = [EventKind::BusDown, EventKind::BusUp, EventKind::Offline];
    let events = std::iter::from_fn(|| events.try_recv().ok()).filter(|e| presence.contains(&e.kind));
    assert_eq!(events.map(|e| e.text.clone()).collect::<Vec<_>>(), Vec::<String>::new());
    assert_eq!(rig.bus.handle().image.health().reconnects, 3);
}

#[tokio::test]
async fn a_server_that_says_nothing() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = format!("tcp://{}", listener.local_addr().unwrap());
    let heard = Arc::new(AtomicUsize::new(0));
    let count = heard.clone();
    std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let mut bytes = [0; 64];
        while let Ok(more) = stream.read(&mut bytes)
            && more > 0
        {
            count.fetch_add(more, Ordering::Relaxed);
        }
    });
    let rig = Rig::of(Setup {
        port: Some(port),
        response_timeout: Duration::from_millis(100),
        ..Setup::default()
    });
    rig.until("it is open", Rig::bus_up).await;
    rig.until("the drive is offline", |r| {
        r.state(1) == State::Offline && r.handle(1).image.snapshot().link.is_tried()
    })
    .await;
    assert_eq!(rig.set(1, &[("run", 1.0)]).await, Outcome::Offline);
    // Two attempts of 8 bytes are made, then probes; a test in virtual time proves how rare probes are.
    rig.until("it is probed", |_| heard.load(Ordering::Relaxed) > 24).await;
    assert!(rig.bus_up(), "a server that is mute is there");
}

#[tokio::test]
async fn no_server_and_no_name() {
    let closed = {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        format!("tcp://{}", listener.local_addr().unwrap())
    };
    for port in [closed.as_str(), "tcp://127.0.0.1", "tcp://no-such-host.invalid:4001"] {
        let rig = with_port(port);
        rig.until("it is tried", |r| !reason(r).is_empty()).await;
        let text = reason(&rig);
        assert!(text.contains(port) && text.contains("cannot reach"), "{text}");
    }
}

#[tokio::test]
async fn rs485_by_a_driver_that_cannot() {
    let rig = Rig::of(Setup {
        options: LineOptions {
            rs485: Rs485::Kernel,
            ..LineOptions::default()
        },
        ..Setup::default()
    });
    rig.until("it is tried", |r| !reason(r).is_empty()).await;
    let text = reason(&rig);
    assert!(
        text.contains("cannot switch RS-485 direction") && text.contains("rs485 = \"off\""),
        "{text}"
    );
    assert!(!rig.bus_up());
}

#[test]
fn a_format_that_the_port_does_not_take_is_warned_about() {
    let pty = rustix_pty();
    let even = LineFormat::new(19_200, "8E1").unwrap();
    let (_line, warnings) = opened(&pty.1, &even);
    assert_eq!(warnings.len(), 1, "{warnings:?}");
    assert!(
        warnings[0].contains("19200 8N1") && warnings[0].contains("19200 8E1"),
        "{warnings:?}"
    );
    drop(_line);
    let plain = LineFormat::new(19_200, "8N1").unwrap();
    assert!(opened(&pty.1, &plain).1.is_empty());
}

/// Opens the port once it is free: a process started by another test has inherited the open files until it executes
/// its program.
fn opened(path: &str, format: &LineFormat) -> (Line, Vec<String>) {
    until("the port", || Line::open(path, format, &LineOptions::default()).ok())
}

pub(crate) fn rustix_pty() -> (OwnedFd, String) {
    use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&master).unwrap();
    unlockpt(&master).unwrap();
    let name = ptsname(&master, Vec::new()).unwrap().to_string_lossy().into_owned();
    (master, name)
}

/// Whether a user without root's rights could open the port; root may open a port that another has opened exclusively.
fn opens_for_others(path: &str) -> bool {
    use std::os::unix::process::CommandExt;
    let mut other = std::process::Command::new("python3");
    let open = "import os, sys; os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)";
    other.args(["-c", open, path]).stderr(std::process::Stdio::null());
    if rustix::process::geteuid().is_root() {
        other.uid(65_534);
    }
    other.status().unwrap().success()
}

#[test]
fn a_port_that_is_closed_is_free_at_once() {
    // The other end stays open, like a driver that is still sending: the kernel keeps the exclusive mode that long.
    let (_master, path) = rustix_pty();
    std::fs::set_permissions(&path, std::os::unix::fs::PermissionsExt::from_mode(0o666)).unwrap();
    assert!(opens_for_others(&path));
    let format = LineFormat::new(19_200, "8N1").unwrap();
    for _ in 0..2 {
        let open = opened(&path, &format);
        assert!(!opens_for_others(&path), "it is exclusive");
        drop(open);
        assert!(opens_for_others(&path), "and free again");
    }
    let kernel = LineOptions {
        rs485: Rs485::Kernel,
        ..LineOptions::default()
    };
    assert!(Line::open(&path, &format, &kernel).is_err());
    assert!(opens_for_others(&path), "also after a failure");
}
