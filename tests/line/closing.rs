//! Device servers that close their connection: after each reply, after ten, on a request, after a pause.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::time::{Duration, Instant};

use drivegate_core::event::EventKind;
use drivegate_model::drive::{ModelPoint, State, Value};
use drivegate_proto::rtu;
use drivegate_sim::endpoint::EndpointOptions;

use super::rig::{Rig, Setup};

/// When the device server closes the connection of its client.
#[derive(Debug, Clone, Copy)]
enum Rule {
    /// The server closes after this number of replies.
    Behind(u32),
    /// The server closes at the request that follows this number of replies; the request is lost.
    Upon(u32),
    /// The server closes after a pause of this length without requests.
    Pause(Duration),
}

/// A device server in front of the simulated line at `to`; it keeps its own connection to the line open.
fn device_server(to: &str, rule: Rule) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("tcp://{}", listener.local_addr().unwrap());
    let mut far = TcpStream::connect(to.trim_start_matches("tcp://")).unwrap();
    far.set_nodelay(true).unwrap();
    std::thread::spawn(move || {
        while let Ok((mut near, _)) = listener.accept() {
            near.set_nodelay(true).unwrap();
            let mut replies = 0;
            while !(replies > 0 && pauses(&near, rule))
                && let Ok(request) = frame(&mut near, false)
            {
                if matches!(rule, Rule::Upon(count) if replies >= count) {
                    break;
                }
                far.write_all(&request).unwrap();
                let Ok(reply) = frame(&mut far, true) else { return };
                if near.write_all(&reply).is_err() {
                    break;
                }
                replies += 1;
                if matches!(rule, Rule::Behind(count) if replies >= count) {
                    break;
                }
            }
        }
    });
    address
}

/// Whether the client is silent for the time of the rule.
fn pauses(near: &TcpStream, rule: Rule) -> bool {
    let Rule::Pause(pause) = rule else { return false };
    let until = Instant::now() + pause;
    near.set_nonblocking(true).unwrap();
    while near.peek(&mut [0]).is_err() {
        if Instant::now() > until {
            return true;
        }
        std::thread::sleep(Duration::from_micros(50));
    }
    near.set_nonblocking(false).unwrap();
    false
}

/// Reads a frame of Modbus RTU with functions 3, 6 and 16.
fn frame(from: &mut TcpStream, is_reply: bool) -> std::io::Result<Vec<u8>> {
    let mut frame = vec![0; 3];
    from.read_exact(&mut frame)?;
    let length = match (frame[1], is_reply) {
        (3, true) => 5 + usize::from(frame[2]),
        (16, false) => {
            frame.resize(7, 0);
            from.read_exact(&mut frame[3..])?;
            9 + usize::from(frame[6])
        }
        (function, true) if function >= 0x80 => 5,
        (3 | 6 | 16, _) => 8,
        _ => return Err(ErrorKind::InvalidData.into()),
    };
    let begun = frame.len();
    frame.resize(length, 0);
    from.read_exact(&mut frame[begun..])?;
    Ok(frame)
}

#[tokio::test]
async fn a_server_that_closes_after_replies_or_pauses_is_no_lost_port() {
    for rule in [
        Rule::Behind(1),
        Rule::Behind(10),
        Rule::Upon(10),
        // Shorter than the silence between two exchanges.
        Rule::Pause(Duration::from_millis(1)),
    ] {
        let server = Rig::of(Setup {
            endpoint: Some(EndpointOptions::Tcp {
                listen: SocketAddr::from(([127, 0, 0, 1], 0)),
            }),
            port: Some("tcp://127.0.0.1:1".to_string()),
            drives: 2,
            ..Setup::default()
        });
        let rig = Rig::of(Setup {
            port: Some(device_server(&server.line.address(), rule)),
            drives: 2,
            response_timeout: Duration::from_millis(300),
            ..Setup::default()
        });
        let ready = |r: &Rig| r.state(1) == State::Ready && r.state(2) == State::Ready;
        rig.until("both drives answer", ready).await;
        // A drive's first event follows after its values.
        let told = |r: &Rig| {
            let events = r.events.recent();
            events.iter().filter(|e| e.kind == EventKind::Online).count() == 2
        };
        rig.until("both drives are told to be online", told).await;
        let mut events = rig.events.subscribe();
        let before = rig.bus.handle().image.health().reconnects;
        for turn in 0..10 {
            let reference = 10.0 + f64::from(turn);
            let set = rig.set(1, &[("speed_reference", reference), ("run", 1.0)]).await;
            assert!(set.is_ok(), "{rule:?}: {set:?}");
            let runs = |r: &Rig| r.state(1) == State::Running;
            rig.until("it runs", runs).await;
            let stop = rig.set(1, &[("run", 0.0)]).await;
            assert!(stop.is_ok(), "{rule:?}: {stop:?}");
            rig.until("it stands", |r| r.state(1) == State::Ready).await;
            let reached = |r: &Rig| r.good(1, ModelPoint::SpeedReference) == Some(Value::Number(reference));
            rig.until("the reference is read", reached).await;
        }
        let reconnects = rig.bus.handle().image.health().reconnects - before;
        assert!(reconnects >= 4, "{rule:?}: {reconnects}");
        let presence = [
            EventKind::BusDown,
            EventKind::BusUp,
            EventKind::Offline,
            EventKind::Online,
        ];
        let told: Vec<String> = std::iter::from_fn(|| events.try_recv().ok())
            .filter(|event| presence.contains(&event.kind))
            .map(|event| event.text.clone())
            .collect();
        assert_eq!(told, Vec::<String>::new(), "{rule:?}");
    }
}

/// A device that answers every read at once with zeros, over one connection after the other.
fn at_once(listener: &TcpListener, until: Instant) {
    listener.set_nonblocking(true).unwrap();
    let mut open: Vec<TcpStream> = Vec::new();
    while Instant::now() < until {
        if let Ok((stream, _)) = listener.accept() {
            stream.set_nodelay(true).unwrap();
            stream.set_nonblocking(false).unwrap();
            stream.set_read_timeout(Some(Duration::from_millis(5))).unwrap();
            open.push(stream);
        }
        std::thread::sleep(Duration::from_micros(200));
        open.retain_mut(|stream| {
            let request = match frame(stream, false) {
                Ok(request) => request,
                Err(error) => return matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut),
            };
            let count = usize::from(request[5]) * 2;
            let mut pdu = vec![3, count as u8];
            pdu.resize(2 + count, 0);
            let mut reply = Vec::new();
            rtu::encode_frame(request[0], &pdu, &mut reply);
            stream.write_all(&reply).is_ok()
        });
    }
}

#[tokio::test]
async fn a_device_without_wire_time_is_there_at_once_after_an_outage() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    drop(listener);
    let serving = std::thread::spawn(move || {
        for _ in 0..3 {
            let listener = TcpListener::bind(address).unwrap();
            at_once(&listener, Instant::now() + Duration::from_secs(2));
            drop(listener);
            std::thread::sleep(Duration::from_millis(300));
        }
    });
    // The reply alone takes 7 ms at the 38400 baud of the rig.
    let rig = Rig::of(Setup {
        port: Some(format!("tcp://{address}")),
        response_timeout: Duration::from_millis(100),
        ..Setup::default()
    });
    let online = |r: &Rig| r.handle(1).image.snapshot().link.is_online();
    rig.until("it is there", online).await;
    let mut took = Vec::new();
    for _ in 0..2 {
        rig.until("the bus is down", |r| !r.bus_up()).await;
        rig.until("the bus is up again", Rig::bus_up).await;
        let began = Instant::now();
        rig.until("the drive, too", online).await;
        took.push(began.elapsed());
    }
    // One of the two may meet a pause of the machine.
    assert!(took.iter().min().unwrap() < &Duration::from_millis(800), "{took:?}");
    serving.join().unwrap();
}
