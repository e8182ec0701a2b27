//! The gateway is stopped (SIGSTOP) and continues: requests that clients sent meanwhile, and values of the drives.
//! The clients are bytes on sockets, so that they can give up.

use std::io::{Read, Write};
use std::net::{TcpStream, UdpSocket};
use std::time::{Duration, Instant};

use drivegate_proto::rtu;

use crate::support::process::{PATIENCE, Running, api, free_port, get, local, until};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, MQTT, Site, controlled};

const MS: Duration = Duration::from_millis(1);
const RESPONSE_TIMEOUT: Duration = Duration::from_millis(300);
/// Repetitions of each kind of pause in which the order of two clients is unknown.
const TIMES: usize = 12;
/// Lengths of pauses, as in the tests of what clients sent during a pause.
const HICCUP: Duration = Duration::from_millis(200);
const PAUSES: [Duration; 4] = [
    HICCUP,
    Duration::from_millis(1500),
    Duration::from_secs(3),
    Duration::from_secs(10),
];

struct Plant {
    site: Site,
    gateway: Running,
    simulator: Running,
    _broker: Running,
    slot: u16,
    bacnet: u16,
}

impl Plant {
    fn new() -> Plant {
        let slot = free_port();
        let bacnet = UdpSocket::bind("0.0.0.0:0").unwrap().local_addr().unwrap().port();
        let more = format!(
            "[[bus.slot]]\nlisten = \"127.0.0.1:{slot}\"\naccess = \"write\"\n\
             [bacnet]\nlisten = \"127.0.0.10:{bacnet}\"\ncommands = true\nwrite = [\"127.0.0.0/8\"]\n"
        );
        let socket = "[gateway]\nsocket = \"socket\"\n";
        let line = LINE1.replace("[gateway]\n", socket);
        let line = line.replace("response_timeout = \"2s\"", "response_timeout = \"300ms\"");
        let site = Site::new();
        let line = line.replace("\"socket\"", &format!("\"{}\"", site.path("socket")));
        site.configure(&[&line, &controlled("pump-1", 1, ""), MODBUS_TCP, MQTT, HTTP, &more]);
        let simulator = site.simulate(&["--addresses", "1", "--baud", "38400"]);
        let broker = site.broker();
        let gateway = site.run_ready();
        // The local socket is opened last; connections made before that are accepted later.
        gateway.until_printed("drivegate is running");
        site.until_connected(true);
        site.until_state("pump-1", "ready");
        Plant {
            site,
            gateway,
            simulator,
            _broker: broker,
            slot,
            bacnet,
        }
    }

    /// Stalls the gateway for this time while `meanwhile` runs.
    fn stands<T>(&self, time: Duration, meanwhile: impl FnOnce() -> T) -> T {
        self.gateway.stand();
        let began = Instant::now();
        let done = meanwhile();
        std::thread::sleep(time.saturating_sub(began.elapsed()));
        self.gateway.signal("CONT");
        done
    }

    /// Whether the motor runs; after the sleep, any earlier reading is outdated.
    fn runs(&self) -> bool {
        std::thread::sleep(700 * MS);
        until("a reading", || self.site.point("pump-1", "running").as_bool())
    }

    /// Resets the motor to standstill through a new connection.
    fn reset(&self) {
        self.modbus().says(0);
        until("standstill", || {
            (self.site.point("pump-1", "running") == false).then_some(())
        });
    }

    /// A client of Modbus TCP that has already sent a request.
    fn modbus(&self) -> Client {
        let stream = TcpStream::connect(("127.0.0.1", self.site.modbus)).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let mut client = Client {
            stream: Box::new(stream),
            how: How::Modbus,
        };
        client
            .stream
            .write_all(&[0, 9, 0, 0, 0, 6, 1, 3, 0x80, 0x00, 0, 1])
            .unwrap();
        let mut answer = [0; 64];
        assert!(client.stream.read(&mut answer).unwrap() > 8);
        client
    }

    fn slot(&self) -> Client {
        let stream = TcpStream::connect(("127.0.0.1", self.slot)).unwrap();
        // A tool gets no reply to a request that a stop has overtaken.
        stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
        Client {
            stream: Box::new(stream),
            how: How::Slot,
        }
    }

    /// A client of HTTP at the local socket, which needs no login.
    fn http(&self) -> Client {
        let stream = local(self.site.path("socket"));
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        Client {
            stream: Box::new(stream),
            how: How::Http,
        }
    }

    fn publishes(&self, run: bool) {
        let payload = format!("{{\"run\": {run}}}");
        self.site
            .publish(&["-t", "drivegate/test/drive/pump-1/set", "-m", &payload]);
    }

    fn datagram(&self, run: bool) {
        let run = u8::from(run);
        let apdu = [
            0,
            5,
            1 + run,
            15,
            0x0C,
            1,
            0x40,
            0,
            1,
            0x19,
            85,
            0x3E,
            0x91,
            run,
            0x3F,
            0x49,
            8,
        ];
        let npdu = [1, 0x24, 0x03, 0xE9, 1, 1, 0xFF];
        let length = 4 + npdu.len() + apdu.len();
        let bytes = [&[0x81, 0x0A, 0, length as u8][..], &npdu, &apdu].concat();
        let socket = UdpSocket::bind("127.0.0.20:0").unwrap();
        socket.send_to(&bytes, ("127.0.0.10", self.bacnet)).unwrap();
    }
}

/// Function that opens a connection of a client.
type Opens = fn(&Plant) -> Client;

trait Stream: Read + Write {}
impl<S: Read + Write> Stream for S {}

#[derive(Debug, Clone, Copy)]
enum How {
    Modbus,
    Slot,
    Http,
}

/// A client with a separate connection, which is closed when the client is dropped.
struct Client {
    stream: Box<dyn Stream>,
    how: How,
}

impl Client {
    /// A run command, 1 or 0.
    fn command(&self, run: u16) -> Vec<u8> {
        match self.how {
            How::Modbus => vec![0, run as u8, 0, 0, 0, 6, 1, 6, 0x81, 0x00, 0, run as u8],
            How::Slot => {
                let mut frame = Vec::new();
                // The control word of a Vacon NX.
                rtu::encode_frame(1, &[6, 0x07, 0xD0, 0, run as u8], &mut frame);
                frame
            }
            How::Http => {
                let body = format!("{{\"run\": {}}}", run == 1);
                format!(
                    "POST /api/v1/drives/pump-1/commands HTTP/1.1\r\nHost: gateway\r\nContent-Length: {}\r\n\r\n{body}",
                    body.len()
                )
                .into_bytes()
            }
        }
    }

    /// Sends a run command, 1 or 0, and does not wait.
    fn gives(&mut self, run: u16) {
        let bytes = self.command(run);
        self.stream.write_all(&bytes).unwrap();
    }

    /// Reads the answer; returns whether the request was carried out.
    fn is_done(&mut self) -> bool {
        self.answer().is_ok()
    }

    /// Reads an answer; an error where the order was not carried out.
    fn answer(&mut self) -> Result<(), String> {
        let mut answer = vec![0; 4096];
        let count = self.stream.read(&mut answer).unwrap_or(0);
        let is_done = match self.how {
            How::Modbus => count == 12 && answer[7] == 6,
            How::Slot => count == 8 && answer[1] == 6,
            How::Http => answer.starts_with(b"HTTP/1.1 200"),
        };
        let text = || match self.how {
            How::Http => String::from_utf8_lossy(&answer[..count]).into_owned(),
            How::Modbus | How::Slot => format!("{:?}", &answer[..count]),
        };
        if is_done { Ok(()) } else { Err(text()) }
    }

    fn says(&mut self, run: u16) -> bool {
        self.gives(run);
        self.is_done()
    }
}

#[test]
fn a_client_that_gave_up_starts_nothing() {
    let plant = Plant::new();
    for pause in PAUSES {
        let by: [(&str, Option<Opens>); 5] = [
            ("Modbus TCP", Some(Plant::modbus)),
            ("a slot", Some(Plant::slot)),
            ("HTTP", Some(Plant::http)),
            ("MQTT", None),
            ("BACnet", None),
        ];
        for (name, client) in by {
            let client = client.map(|client| client(&plant));
            // For a client behind a broker, or without a connection, it is unknown whether it still exists.
            if client.is_none() && pause < Duration::from_secs(1) {
                continue;
            }
            plant.stands(pause, || match client {
                Some(mut client) => client.gives(1),
                None if name == "MQTT" => plant.publishes(true),
                None => plant.datagram(true),
            });
            assert!(!plant.runs(), "{name}, {pause:?}");
        }
        // A client that connects during the pause and leaves starts nothing, either.
        plant.stands(pause, || {
            let mut stream = TcpStream::connect(("127.0.0.1", plant.site.modbus)).unwrap();
            stream.write_all(&[0, 1, 0, 0, 0, 6, 1, 6, 0x81, 0, 0, 1]).unwrap();
        });
        assert!(!plant.runs(), "a new one, {pause:?}");
    }
    let (_, metrics) = get(plant.site.http, "/metrics").unwrap();
    let total = |name: &str| -> f64 {
        let line = metrics.lines().find_map(|line| line.strip_prefix(name)).unwrap();
        line.trim().parse().unwrap()
    };
    // Three pauses, six times each; the machine may pause as well.
    let pauses = total("drivegate_pauses_total ");
    assert!((18.0..=20.0).contains(&pauses), "{pauses}");
    assert!((87.0..99.0).contains(&total("drivegate_paused_seconds_total ")));
    let (_, events) = get(plant.site.http, "/api/v1/events/log?limit=100").unwrap();
    assert_eq!(events.matches("\"paused\"").count() as f64, pauses, "{events}");
}

/// An order that starts before a pause and is completed during it starts no motor.
#[test]
fn what_is_completed_in_a_pause_starts_nothing() {
    let plant = Plant::new();
    let by: [(&str, Opens); 3] = [
        ("Modbus TCP", Plant::modbus),
        ("a slot", Plant::slot),
        ("HTTP", Plant::http),
    ];
    for (name, open) in by {
        let mut client = open(&plant);
        let bytes = client.command(1);
        // The head of the HTTP request is complete; only the body is cut.
        let (begin, rest) = bytes.split_at(bytes.len() - 3);
        client.stream.write_all(begin).unwrap();
        std::thread::sleep(100 * MS);
        plant.stands(Duration::from_millis(1500), || client.stream.write_all(rest).unwrap());
        assert!(client.answer().is_err(), "{name}: it is refused");
        assert!(!plant.runs(), "{name}");
        assert!(client.says(0), "{name}: a stop passes");
    }
}

/// Two clients in one pause: the one that stops wins, in whatever sequence they are read; for one client, its own
/// order counts.
#[test]
fn a_stop_in_a_pause_wins() {
    let plant = Plant::new();
    for (pause, times) in [(HICCUP, TIMES), (Duration::from_millis(700), 3)] {
        for time in 0..times {
            let (mut one, mut other) = (plant.modbus(), plant.modbus());
            plant.stands(pause, || {
                one.gives(1);
                other.gives(0);
            });
            assert!(!plant.runs(), "run, stop; {pause:?}, {time}");
            let (mut one, mut other) = (plant.modbus(), plant.modbus());
            plant.stands(pause, || {
                one.gives(0);
                other.gives(1);
            });
            assert!(!plant.runs(), "stop, run; {pause:?}, {time}");
            let mut one = plant.modbus();
            plant.stands(pause, || {
                one.gives(1);
                plant.publishes(false);
            });
            assert!(!plant.runs(), "run, stop by MQTT; {pause:?}, {time}");
            let mut one = plant.http();
            plant.stands(pause, || {
                plant.datagram(false);
                one.gives(1);
            });
            assert!(!plant.runs(), "stop by BACnet, run by HTTP; {pause:?}, {time}");
        }
    }
    for pause in [HICCUP, Duration::from_millis(1500)] {
        let mut one = plant.modbus();
        plant.stands(pause, || {
            one.gives(1);
            one.gives(0);
        });
        assert!(!plant.runs(), "{pause:?}");
        let stop_and_run = || {
            let mut one = plant.modbus();
            plant.stands(pause, || {
                one.gives(0);
                one.gives(1);
            });
            plant.runs()
        };
        if pause == HICCUP {
            // A pause of the machine makes a hiccup longer than its own order counts.
            until("its own order counts", || stop_and_run().then_some(()));
        } else {
            assert!(!stop_and_run(), "{pause:?}");
        }
        plant.reset();
    }
}

/// On a busy machine, the gateway may stall for longer than the hiccup: up to one in ten orders may be lost because
/// of that.
#[test]
fn a_healthy_client_loses_nothing_by_a_hiccup() {
    let (plant, mut lost, mut all) = (Plant::new(), Vec::new(), 0);
    let mut clients = [plant.modbus(), plant.http(), plant.slot()];
    for time in 0..TIMES as u32 {
        for client in &mut clients {
            // Two hiccups in quick succession count as one, in which the order of a stop and a start is unknown.
            std::thread::sleep(400 * MS);
            let run = u16::from(time % 2 == 0);
            plant.stands(HICCUP, || client.gives(run));
            all += 1;
            lost.extend(client.answer().err());
            // Around a hiccup, and in the time in which the bytes from the hiccup are read.
            plant.stands(HICCUP, || {});
            std::thread::sleep(50 * MS * (time % 8));
            all += 1;
            client.gives(1 - run);
            lost.extend(client.answer().err());
        }
    }
    assert!(lost.len() * 10 <= all, "{} of {all}: {lost:?}", lost.len());
}

#[test]
fn a_new_connection_starts_a_motor_behind_a_pause_and_an_old_one_later() {
    let plant = Plant::new();
    let (mut old, mut also) = (plant.modbus(), plant.http());
    plant.stands(Duration::from_millis(1500), || {});
    assert!(!old.says(1), "what its kernel still sends is as old");
    assert!(!also.says(1));
    assert!(!plant.runs());
    assert!(old.says(0), "a stop passes");
    assert!(plant.modbus().says(1));
    plant.site.until_point("pump-1", "running", true);
    plant.reset();
    std::thread::sleep(Duration::from_millis(2500));
    assert!(old.says(1));
    plant.site.until_point("pump-1", "running", true);
}

/// While the gateway is stopped, its drives send nothing either: values must not be reported younger than that,
/// except for the time in which the last reply can have left its drive.
#[test]
fn nothing_is_told_as_younger_than_it_is() {
    let plant = Plant::new();
    for time in 0..TIMES as u32 {
        // The pause begins at different moments of a transaction.
        std::thread::sleep(7 * MS * time);
        let silent = plant.stands(Duration::from_millis(2000), || {
            std::thread::sleep(200 * MS);
            plant.simulator.signal("STOP");
            Instant::now()
        });
        let until = Instant::now() + 300 * MS;
        while Instant::now() < until {
            let least = silent.elapsed();
            let drive = api(plant.site.http, "pump-1");
            if let Some(age) = drive["age_ms"].as_u64() {
                let latest = Duration::from_millis(age) + RESPONSE_TIMEOUT + 30 * MS;
                assert!(latest >= least, "{time}: {age} ms, {least:?}");
            }
        }
        plant.simulator.signal("CONT");
        plant.site.until_state("pump-1", "ready");
    }
    let (_, events) = get(plant.site.http, "/api/v1/events/log?limit=1000").unwrap();
    // The machine may pause as well.
    let pauses = events.matches("\"paused\"").count();
    assert!((TIMES..=TIMES + 2).contains(&pauses), "{events}");
}

/// A drive that answers is not reported as offline after a pause, and reads continue.
#[test]
fn a_pause_takes_no_drive_away() {
    let plant = Plant::new();
    for time in 0..20 {
        std::thread::sleep(3 * MS * time);
        plant.stands(Duration::from_millis(1100), || {});
        let mut client = plant.modbus();
        let answer = client.stream.write_all(&[0, 1, 0, 0, 0, 6, 1, 3, 0x80, 0, 0, 1]);
        assert!(answer.is_ok());
    }
    let (_, events) = get(plant.site.http, "/api/v1/events/log?limit=1000").unwrap();
    assert!(!events.contains("\"offline\""), "{events}");
}
