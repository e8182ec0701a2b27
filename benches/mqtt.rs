//! How old the values are that a subscriber of the broker holds, near and far.
//!
//! `cargo bench --bench mqtt` (options: `-- --seconds 10 --drives 32 --round-trip 100`; times in ms). A mosquitto with its
//! defaults (receive maximum 20), and between it and the gateway a proxy that delays each direction by half the round
//! trip. Drives are updated one after the other as by a line, each with a new value in every cycle.

mod common;

use std::collections::BTreeMap;
use std::error::Error;
use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::process::{Child, Command, ExitCode, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant, SystemTime};

use arc_swap::ArcSwap;
use drivegate_core::event::{Event, EventKind};
use drivegate_core::plant::SharedPlant;
use drivegate_mqtt::{History, Options, Telemetry};
use drivegate_north::{NorthState, Server as _};
use rumqttc::mqttbytes::QoS;
use rumqttc::{AsyncClient, MqttOptions, Packet};
use tokio::runtime::Runtime;
use tokio_util::sync::CancellationToken;

use common::{option, quantile, session};

fn main() -> ExitCode {
    common::exit(measure())
}

fn measure() -> Result<(), Box<dyn Error>> {
    let seconds: u64 = option("--seconds", 10)?;
    let drives: u16 = option("--drives", 32)?;
    let far = Duration::from_millis(option("--round-trip", 100)?);
    let broker = Broker::start()?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()?;
    println!("{drives} drives; oldest: age of a held value when the next one replaces it; all in ms");
    println!("round trip | cycle | min_interval | state period, mean | p99 | oldest p50 | p99");
    for (trip, cycle, min) in [(0, 133, 0), (0, 133, 50), (1, 133, 50), (1, 20, 50), (1, 400, 0)] {
        let trip = far * trip;
        let port = proxy(broker.port, trip / 2)?;
        let (cycle, min) = (Duration::from_millis(cycle), Duration::from_millis(min));
        let figures = states(&runtime, &broker, port, drives, cycle, min, seconds)?;
        let columns = [trip, cycle, min].map(|time| time.as_millis().to_string()).join(" | ");
        println!("{columns} | {figures}");
    }
    let port = proxy(broker.port, far / 2)?;
    let (rate, trip) = events(&runtime, &broker, port)?;
    println!(
        "events: {rate:.0}/s; {:.2} of receive maximum / round trip, {:.2} with the round trip of a single event, {:.0} ms",
        rate * far.as_secs_f64() / 20.0,
        rate * trip / 20.0,
        trip * 1e3
    );
    Ok(())
}

/// The gateway under test with its plant.
struct Gateway {
    plant: SharedPlant,
    stats: Arc<NorthState>,
    cancel: CancellationToken,
    mqtt: drivegate_mqtt::Mqtt,
}

impl Gateway {
    fn start(runtime: &Runtime, port: u16, drives: u16, min_interval: Duration) -> Result<Gateway, Box<dyn Error>> {
        let plant = Arc::new(ArcSwap::from_pointee(session::plant("hall", drives)?));
        let options = Options {
            base: "bench".to_string(),
            telemetry: Telemetry {
                state: true,
                points: true,
                history: History::Off,
            },
            min_interval,
            ..session::options("bench-gateway", "127.0.0.1", port)
        };
        let stats = Arc::<NorthState>::default();
        let cancel = CancellationToken::new();
        let guard = runtime.enter();
        let mqtt = drivegate_mqtt::start(options, plant.clone(), stats.clone(), cancel.clone());
        drop(guard);
        let deadline = Instant::now() + Duration::from_secs(10);
        while !stats.mqtt.connected.load(Ordering::Relaxed) {
            if Instant::now() > deadline {
                return Err("the gateway does not connect".into());
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        Ok(Gateway {
            plant,
            stats,
            cancel,
            mqtt,
        })
    }

    fn stop(self, runtime: &Runtime) {
        self.cancel.cancel();
        runtime.block_on(self.mqtt.stopped());
    }
}

/// Period and age of the states that a subscriber near the broker receives.
fn states(
    runtime: &Runtime,
    broker: &Broker,
    port: u16,
    drives: u16,
    cycle: Duration,
    min: Duration,
    seconds: u64,
) -> Result<String, Box<dyn Error>> {
    let arrived = broker.subscribe(runtime, "bench/hall/drive/+/state")?;
    let gateway = Gateway::start(runtime, port, drives, min)?;
    let (plant, end) = (gateway.plant.load_full(), Arc::new(AtomicBool::new(false)));
    let ended = end.clone();
    let poller = std::thread::spawn(move || session::poll(&[plant], cycle, &ended));
    std::thread::sleep(Duration::from_secs(2));
    while arrived.try_recv().is_ok() {}
    std::thread::sleep(Duration::from_secs(seconds));
    let mut held: BTreeMap<String, (SystemTime, SystemTime)> = BTreeMap::new();
    let (mut periods, mut ages) = (Vec::new(), Vec::new());
    let since = |later: SystemTime, earlier| later.duration_since(earlier).unwrap_or_default().as_secs_f64() * 1e3;
    for (topic, payload, at) in arrived.try_iter() {
        let state: serde_json::Value = serde_json::from_slice(&payload)?;
        let time = state.get("time").and_then(|time| time.as_str());
        let time = time.ok_or("a state without time")?;
        let time = humantime::parse_rfc3339(time)?;
        if let Some((before, sampled)) = held.insert(topic, (at, time)) {
            periods.push(since(at, before));
            ages.push(since(at, sampled));
        }
    }
    end.store(true, Ordering::Relaxed);
    poller.join().map_err(|_| "the poller failed")?;
    gateway.stop(runtime);
    let mean = periods.iter().sum::<f64>() / periods.len().max(1) as f64;
    let at = |values: &[f64], share| format!("{:.0}", quantile(values, share));
    Ok(format!(
        "{mean:.0} | {} | {} | {}",
        at(&periods, 0.99),
        at(&ages, 0.5),
        at(&ages, 0.99)
    ))
}

/// Events a second that arrive from a burst, and the time from a single event to its acknowledgement, s.
fn events(runtime: &Runtime, broker: &Broker, port: u16) -> Result<(f64, f64), Box<dyn Error>> {
    let arrived = broker.subscribe(runtime, "bench/hall/drive/+/event")?;
    let gateway = Gateway::start(runtime, port, 1, Duration::ZERO)?;
    let publish = |n: u32| {
        gateway.plant.load().events.publish(Event {
            bus: "line".to_string(),
            drive: Some("d1".to_string()),
            ..Event::new(EventKind::Online, SystemTime::now(), n.to_string())
        });
    };
    let mut trips = Vec::new();
    for n in 0..20 {
        let begun = Instant::now();
        publish(n);
        arrived.recv_timeout(Duration::from_secs(20))?;
        while gateway.stats.mqtt.buffered.load(Ordering::Relaxed) > 0 {
            std::thread::sleep(Duration::from_millis(1));
        }
        trips.push(begun.elapsed().as_secs_f64());
    }
    (0..1000).for_each(publish);
    let mut times = Vec::new();
    while times.len() < 1000 {
        let (.., at) = arrived.recv_timeout(Duration::from_secs(20))?;
        times.push(at.duration_since(SystemTime::UNIX_EPOCH)?.as_secs_f64());
    }
    gateway.stop(runtime);
    Ok((common::rate(&times), common::median(&trips)))
}

type Arrived = (String, Vec<u8>, SystemTime);

/// A mosquitto process started by the bench.
struct Broker {
    port: u16,
    child: Child,
    _dir: tempfile::TempDir,
}

impl Broker {
    fn start() -> Result<Broker, Box<dyn Error>> {
        let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
        let dir = tempfile::tempdir()?;
        let file = dir.path().join("mosquitto.conf");
        std::fs::write(
            &file,
            format!(
                "listener {port} 127.0.0.1\nallow_anonymous true\nset_tcp_nodelay true\npersistence false\nlog_dest none\nuser root\n"
            ),
        )?;
        let program = ["/usr/sbin/mosquitto", "/usr/local/sbin/mosquitto"];
        let program = program.into_iter().find(|path| std::path::Path::new(path).exists());
        let mut command = Command::new(program.unwrap_or("mosquitto"));
        let child = command.arg("-c").arg(&file).stdout(Stdio::null()).stderr(Stdio::null());
        let child = child
            .spawn()
            .map_err(|error| format!("mosquitto: {error}; apt install mosquitto"))?;
        let broker = Broker { port, child, _dir: dir };
        let deadline = Instant::now() + Duration::from_secs(10);
        while TcpStream::connect(("127.0.0.1", port)).is_err() {
            if Instant::now() > deadline {
                return Err("mosquitto does not listen".into());
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(broker)
    }

    /// Messages that arrive for a filter from now on.
    fn subscribe(&self, runtime: &Runtime, filter: &str) -> Result<Receiver<Arrived>, Box<dyn Error>> {
        let mut options = MqttOptions::new(
            format!("bench-{filter}").replace(['/', '+'], "-"),
            ("127.0.0.1", self.port),
        );
        options.set_clean_start(true);
        let (client, mut eventloop) = AsyncClient::builder(options).capacity(10).build();
        client.try_subscribe(filter, QoS::AtLeastOnce)?;
        let (sender, arrived) = channel();
        let (ready, is_ready) = channel();
        runtime.spawn(async move {
            // The client exists as long as its receiver does.
            let _client = client;
            while let Ok(event) = eventloop.poll().await {
                match event {
                    rumqttc::Event::Incoming(Packet::SubAck(_)) => drop(ready.send(())),
                    rumqttc::Event::Incoming(Packet::Publish(publish)) => {
                        let topic = String::from_utf8_lossy(&publish.topic).into_owned();
                        let message = (topic, publish.payload.to_vec(), SystemTime::now());
                        if sender.send(message).is_err() {
                            return;
                        }
                    }
                    _ => {}
                }
            }
        });
        is_ready.recv_timeout(Duration::from_secs(10))?;
        Ok(arrived)
    }
}

impl Drop for Broker {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A port whose connections reach the broker with that delay in each direction.
fn proxy(broker: u16, delay: Duration) -> Result<u16, Box<dyn Error>> {
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let port = listener.local_addr()?.port();
    std::thread::spawn(move || {
        for near in listener.incoming().map_while(Result::ok) {
            let Ok(far) = TcpStream::connect(("127.0.0.1", broker)) else {
                continue;
            };
            for (from, to) in [(near.try_clone(), far.try_clone()), (far.try_clone(), near.try_clone())] {
                if let (Ok(from), Ok(to)) = (from, to) {
                    let _ = to.set_nodelay(true);
                    let (sender, bytes) = channel();
                    std::thread::spawn(move || receive(from, &sender));
                    std::thread::spawn(move || forward(&bytes, to, delay));
                }
            }
        }
    });
    Ok(port)
}

fn receive(mut from: TcpStream, sender: &Sender<(Instant, Vec<u8>)>) {
    let mut buffer = vec![0; 64 << 10];
    while let Ok(count) = from.read(&mut buffer) {
        if count == 0
            || sender
                .send((Instant::now(), buffer.get(..count).unwrap_or_default().to_vec()))
                .is_err()
        {
            return;
        }
    }
}

fn forward(bytes: &Receiver<(Instant, Vec<u8>)>, mut to: TcpStream, delay: Duration) {
    while let Ok((received, bytes)) = bytes.recv() {
        std::thread::sleep((received + delay).saturating_duration_since(Instant::now()));
        if to.write_all(&bytes).is_err() {
            return;
        }
    }
    let _ = to.shutdown(Shutdown::Both);
}
