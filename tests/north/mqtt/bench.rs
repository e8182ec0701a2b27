//! Mosquitto with its clients, a line that can be cut, and a gateway with a hand-made bus.

use std::collections::BTreeMap;
use std::fs;
use std::io::Write as _;
use std::net::{SocketAddr, TcpStream as StdStream};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant, SystemTime};

use arc_swap::ArcSwap;
use drivegate_core::event::{Event, EventKind};
use drivegate_core::order::{Order, Outcome};
use drivegate_core::plant::{Plant, SharedPlant};
use drivegate_core::process_image::Access;
use drivegate_model::drive::{PointIndex, Value};
use drivegate_mqtt::{History, Mqtt, Options, Qos, Telemetry};
use drivegate_north::{NorthState, Server as _};
use drivegate_proto::Reply;
use drivegate_testkit::{bus, bus_spec, controlled, image, nx, read_nx, take_next, up};
use tempfile::TempDir;
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Runtime;
use tokio_util::sync::CancellationToken;

use crate::support::mqtt::{Subscriber, client};
use crate::support::tools::tool;

pub(crate) use crate::support::process::{PATIENCE as DEADLINE, free_port, until as wait_for};

static LOG: Mutex<Vec<String>> = Mutex::new(Vec::new());

struct LogWriter;

impl std::io::Write for LogWriter {
    fn write(&mut self, line: &[u8]) -> std::io::Result<usize> {
        LOG.lock().unwrap().push(String::from_utf8_lossy(line).into_owned());
        Ok(line.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// Waits for a line of the log since the last call for `port` that names this port and holds `text`.
pub(crate) fn wait_log(port: u16, text: &str) {
    let port = format!(":{port}");
    let found = |line: &String| line.contains(&port) && line.contains(text);
    let deadline = Instant::now() + DEADLINE;
    while !LOG.lock().unwrap().iter().any(found) {
        let all = LOG.lock().unwrap().clone();
        assert!(
            Instant::now() < deadline,
            "waited in vain for {text:?} in the log: {all:#?}"
        );
        std::thread::sleep(Duration::from_millis(5));
    }
    LOG.lock().unwrap().retain(|line| !line.contains(&port));
}

fn keep_log() {
    // All calls except the first one fail, because the log is already set up.
    let _ = tracing_subscriber::fmt()
        .with_ansi(false)
        // Only messages of the MQTT client are needed, not those of servers in this process.
        .with_env_filter("drivegate::north::mqtt=info")
        .with_writer(|| LogWriter)
        .try_init();
}

/// A Mosquitto process started by the test.
pub(crate) struct Broker {
    pub(crate) port: u16,
    pub(crate) dir: TempDir,
    child: Option<Child>,
}

impl Broker {
    pub(crate) fn start() -> Broker {
        Broker::with("allow_anonymous true\n")
    }

    /// A broker with further lines of configuration, which may name files in `{dir}`.
    pub(crate) fn with(settings: &str) -> Broker {
        let mut broker = Broker::prepared(TempDir::new().unwrap(), settings);
        broker.up();
        broker
    }

    /// A broker that is configured but not started.
    pub(crate) fn prepared(dir: TempDir, settings: &str) -> Broker {
        let port = free_port();
        let settings = settings.replace("{dir}", &dir.path().display().to_string());
        // As root, the broker would otherwise give up its rights, and with them its access to the files of the test.
        let conf = format!("user root\npersistence false\nlog_dest none\nlistener {port} 127.0.0.1\n{settings}");
        fs::write(dir.path().join("mosquitto.conf"), conf).unwrap();
        Broker { port, dir, child: None }
    }

    pub(crate) fn up(&mut self) {
        let mut command = Command::new(tool("mosquitto"));
        command.arg("-c").arg(self.dir.path().join("mosquitto.conf"));
        command.stdout(Stdio::null()).stderr(Stdio::null());
        let mut child = command.spawn().unwrap();
        wait_for("mosquitto", || {
            assert!(
                child.try_wait().unwrap().is_none(),
                "mosquitto ended at once: bad configuration?"
            );
            StdStream::connect(("127.0.0.1", self.port)).ok()
        });
        self.child = Some(child);
    }

    /// Kills the broker with SIGKILL.
    pub(crate) fn kill(&mut self) {
        let mut child = self.child.take().unwrap();
        child.kill().unwrap();
        child.wait().unwrap();
    }

    /// Sends a signal to the broker.
    pub(crate) fn signal(&self, name: &str) {
        let id = self.child.as_ref().unwrap().id().to_string();
        let sent = Command::new("kill").args(["-s", name, &id]).status().unwrap();
        assert!(sent.success());
    }

    /// Publishes with `mosquitto_pub` and QoS 1; the broker has the message when this returns.
    pub(crate) fn publish(&self, topic: &str, payload: &str, more: &[&str]) {
        let output = self.run(
            "mosquitto_pub",
            &[&["-q", "1", "-t", topic, "-m", payload], more].concat(),
        );
        assert!(output.status.success(), "{output:?}");
    }

    /// Publishes each of `payloads` on one topic over one connection, with QoS 1, as fast as possible.
    pub(crate) fn publish_all(&self, topic: &str, payloads: &[&str]) {
        let mut command = client("mosquitto_pub", self.port);
        command.args(["-q", "1", "-t", topic, "-l"]).stdin(Stdio::piped());
        let mut client = command.spawn().unwrap();
        let lines = payloads.join("\n") + "\n";
        client.stdin.take().unwrap().write_all(lines.as_bytes()).unwrap();
        assert!(client.wait().unwrap().success());
    }

    /// Runs a client program until it ends.
    pub(crate) fn run(&self, name: &str, arguments: &[&str]) -> Output {
        client(name, self.port).args(arguments).output().unwrap()
    }

    /// The retained message of a topic, with `mosquitto_sub`.
    pub(crate) fn retained(&self, topic: &str) -> Option<String> {
        // A stall of the machine may take the second for which the client waits.
        let arguments = ["-t", topic, "-W", "1", "-C", "1", "--retained-only", "-N"];
        (0..2).find_map(|_| {
            let output = self.run("mosquitto_sub", &arguments);
            (!output.stdout.is_empty()).then(|| String::from_utf8(output.stdout).unwrap())
        })
    }
}

impl Drop for Broker {
    fn drop(&mut self) {
        if let Some(child) = &mut self.child {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// A message as `mosquitto_sub` received it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Seen {
    pub(crate) retain: bool,
    pub(crate) qos: u8,
    pub(crate) topic: String,
    pub(crate) payload: String,
}

impl Seen {
    pub(crate) fn json(&self) -> serde_json::Value {
        serde_json::from_str(&self.payload).unwrap_or_else(|e| panic!("{e}: {self:?}"))
    }
}

static MARKERS: AtomicU64 = AtomicU64::new(0);

/// A running `mosquitto_sub` with all messages that it has received.
pub(crate) struct Watcher {
    _client: Subscriber,
    seen: Arc<(Mutex<Vec<Seen>>, Condvar)>,
}

impl Watcher {
    /// Receives messages of `filter`; returns when the subscription is in effect.
    pub(crate) fn new(broker: &Broker, filter: &str) -> Watcher {
        Watcher::with(broker, filter, &[])
    }

    pub(crate) fn with(broker: &Broker, filter: &str, more: &[&str]) -> Watcher {
        let mut command = client("mosquitto_sub", broker.port);
        let marker = format!("marker/{}", MARKERS.fetch_add(1, Ordering::SeqCst));
        command.args(["-q", "1", "-t", filter, "-t", &marker, "-F", "%r|%q|%t|%p"]);
        let seen: Arc<(Mutex<Vec<Seen>>, Condvar)> = Arc::default();
        let stands = Arc::new(AtomicBool::new(false));
        let (writer, arrived, own_marker) = (seen.clone(), stands.clone(), marker.clone());
        let _client = Subscriber::start(command.args(more), move |line| {
            let parts: Vec<&str> = line.splitn(4, '|').collect();
            let &[retain, qos, topic, payload] = parts.as_slice() else {
                panic!("unexpected line of mosquitto_sub: {line}");
            };
            if topic.starts_with("marker/") {
                if topic == own_marker {
                    arrived.store(true, Ordering::SeqCst);
                }
                return;
            }
            writer.0.lock().unwrap().push(Seen {
                retain: retain == "1",
                qos: qos.parse().unwrap(),
                topic: topic.to_string(),
                payload: payload.to_string(),
            });
            writer.1.notify_all();
        });
        let watcher = Watcher { _client, seen };
        wait_for("the subscription of mosquitto_sub", || {
            broker.publish(&marker, "?", more_login(more));
            stands.load(Ordering::SeqCst).then_some(())
        });
        watcher
    }

    pub(crate) fn all(&self) -> Vec<Seen> {
        self.seen.0.lock().unwrap().clone()
    }

    /// All payloads received on a topic.
    pub(crate) fn payloads(&self, topic: &str) -> Vec<String> {
        let all = self.all().into_iter().filter(|m| m.topic == topic);
        all.map(|m| m.payload).collect()
    }

    /// Forgets the messages received so far.
    pub(crate) fn clear(&self) {
        self.seen.0.lock().unwrap().clear();
    }

    /// Waits for a message that `which` accepts.
    pub(crate) fn wait(&self, what: &str, which: impl Fn(&Seen) -> bool) -> Seen {
        let deadline = Instant::now() + DEADLINE;
        let mut seen = self.seen.0.lock().unwrap();
        loop {
            if let Some(found) = seen.iter().find(|m| which(m)) {
                return found.clone();
            }
            let left = deadline.saturating_duration_since(Instant::now());
            assert!(!left.is_zero(), "waited in vain for {what}; seen: {seen:#?}");
            seen = self.seen.1.wait_timeout(seen, left).unwrap().0;
        }
    }

    /// Waits for that payload on that topic.
    pub(crate) fn wait_payload(&self, topic: &str, payload: &str) -> Seen {
        self.wait(&format!("{payload:?} on {topic}"), |m| {
            m.topic == topic && m.payload == payload
        })
    }

    /// Waits until `count` messages have arrived on a topic; returns them.
    pub(crate) fn wait_count(&self, topic: &str, count: usize) -> Vec<Seen> {
        wait_for(&format!("{count} messages on {topic}"), || {
            let all: Vec<_> = self.all().into_iter().filter(|m| m.topic == topic).collect();
            (all.len() >= count).then_some(all)
        })
    }
}

/// The arguments of a watcher that a publisher needs too.
fn more_login<'a>(more: &'a [&'a str]) -> &'a [&'a str] {
    if more.first().is_some_and(|first| ["-u", "--cafile"].contains(first)) {
        more
    } else {
        &[]
    }
}

/// A line between gateway and broker that can be cut.
pub(crate) struct CutLine {
    pub(crate) port: u16,
    open: Arc<AtomicBool>,
    cut: Arc<Mutex<CancellationToken>>,
    _runtime: Runtime,
}

impl CutLine {
    pub(crate) fn to(broker: u16) -> CutLine {
        let runtime = runtime();
        let open = Arc::new(AtomicBool::new(true));
        let cut = Arc::new(Mutex::new(CancellationToken::new()));
        let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0")).unwrap();
        let port = listener.local_addr().unwrap().port();
        let target: SocketAddr = ([127, 0, 0, 1], broker).into();
        let (is_open, token) = (open.clone(), cut.clone());
        runtime.spawn(async move {
            loop {
                let (mut near, _) = listener.accept().await.unwrap();
                if !is_open.load(Ordering::SeqCst) {
                    continue; // closed at once
                }
                let cut = token.lock().unwrap().clone();
                tokio::spawn(async move {
                    let Ok(mut far) = TcpStream::connect(target).await else {
                        return;
                    };
                    tokio::select! {
                        () = cut.cancelled() => {}
                        _ = tokio::io::copy_bidirectional(&mut near, &mut far) => {}
                    }
                });
            }
        });
        CutLine {
            port,
            open,
            cut,
            _runtime: runtime,
        }
    }

    pub(crate) fn cut(&self) {
        self.open.store(false, Ordering::SeqCst);
        std::mem::take(&mut *self.cut.lock().unwrap()).cancel();
    }

    pub(crate) fn mend(&self) {
        self.open.store(true, Ordering::SeqCst);
    }
}

/// Number of threads of the gateway's runtime.
const THREADS: usize = 2;

pub(crate) fn runtime() -> Runtime {
    let mut builder = tokio::runtime::Builder::new_multi_thread();
    builder.worker_threads(THREADS).enable_all().build().unwrap()
}

/// An order that reached the bus: drive, what, time to live.
pub(crate) type Ordered = (usize, Vec<(String, Value)>, Duration);

/// The MQTT client on a plant whose images the test fills, and whose commands a substitute for the bus answers.
pub(crate) struct Gateway {
    pub(crate) plant: SharedPlant,
    pub(crate) stats: Arc<NorthState>,
    pub(crate) orders: Arc<Mutex<Vec<Ordered>>>,
    cancel: CancellationToken,
    mqtt: Mqtt,
    runtime: Runtime,
}

impl Gateway {
    pub(crate) fn start(options: Options, plant: Plant) -> Gateway {
        keep_log();
        let runtime = runtime();
        let plant = Arc::new(ArcSwap::from_pointee(plant));
        let stats = Arc::new(NorthState::default());
        let cancel = CancellationToken::new();
        let guard = runtime.enter();
        let mqtt = drivegate_mqtt::start(options, plant.clone(), stats.clone(), cancel.clone());
        drop(guard);
        let orders: Arc<Mutex<Vec<Ordered>>> = Arc::default();
        runtime.spawn(stand_in(plant.clone(), orders.clone()));
        Gateway {
            plant,
            stats,
            orders,
            cancel,
            mqtt,
            runtime,
        }
    }

    pub(crate) fn connected(&self) -> bool {
        self.stats.mqtt.connected.load(Ordering::Relaxed)
    }

    pub(crate) fn buffered(&self) -> u64 {
        self.stats.mqtt.buffered.load(Ordering::Relaxed)
    }

    pub(crate) fn wait_connected(&self, connected: bool) {
        wait_for("the connection", || (self.connected() == connected).then_some(()));
    }

    /// Process data of a drive, read now.
    pub(crate) fn read(&self, drive: &str, frequency: u16) {
        fill(&self.plant.load(), drive, frequency);
    }

    pub(crate) fn publish_event(&self, drive: &str, kind: EventKind, text: &str) -> SystemTime {
        let time = SystemTime::now();
        self.plant.load().events.publish(Event {
            bus: "line1".to_string(),
            drive: Some(drive.to_string()),
            ..Event::new(kind, time, text.to_string())
        });
        time
    }

    /// Runs `act` while the client gets no processor time: afterwards the client finds everything at once.
    pub(crate) fn while_held<T>(&self, act: impl FnOnce() -> T) -> T {
        let (release, held) = std::sync::mpsc::channel::<()>();
        let held = Arc::new(Mutex::new(held));
        let holding = Arc::new(AtomicU64::new(0));
        for _ in 0..THREADS {
            let (held, holding) = (held.clone(), holding.clone());
            self.runtime.spawn(async move {
                holding.fetch_add(1, Ordering::SeqCst);
                let _ = held.lock().unwrap().recv();
            });
        }
        let all = THREADS as u64;
        wait_for("the hold", || (holding.load(Ordering::SeqCst) == all).then_some(()));
        let done = act();
        drop(release);
        done
    }

    pub(crate) fn ordered(&self) -> Vec<Ordered> {
        self.orders.lock().unwrap().clone()
    }

    /// Stops the gateway in an orderly way.
    pub(crate) fn stop(self) {
        self.cancel.cancel();
        let stopped = async { tokio::time::timeout(DEADLINE, self.mqtt.stopped()).await };
        self.runtime.block_on(stopped).expect("it stops");
    }

    /// Changes the options as a reload does: the client ends, `meanwhile` runs, another client starts.
    pub(crate) fn replace(mut self, options: Options, meanwhile: impl FnOnce(&Gateway)) -> Gateway {
        self.cancel.cancel();
        let idle = Mqtt::default();
        let before = std::mem::replace(&mut self.mqtt, idle);
        let stopped = async { tokio::time::timeout(DEADLINE, before.stopped()).await };
        self.runtime.block_on(stopped).expect("it stops");
        meanwhile(&self);
        self.cancel = CancellationToken::new();
        let guard = self.runtime.enter();
        self.mqtt = drivegate_mqtt::start(options, self.plant.clone(), self.stats.clone(), self.cancel.clone());
        drop(guard);
        self
    }

    /// Stops like a kill -9: everything stops at once, and sockets are closed without a message.
    pub(crate) fn kill(self) {
        self.runtime.shutdown_background();
    }
}

/// Answers for the bus: acknowledges all commands.
async fn stand_in(plant: SharedPlant, orders: Arc<Mutex<Vec<Ordered>>>) {
    loop {
        let now = Instant::now();
        plant.load().report_refusals(now);
        for bus in &plant.load().buses {
            while let Some(command) = take_next(&bus.queue, now) {
                let drive = &bus.image.drives[command.drive().unwrap().place()];
                let name = |index: PointIndex| drive.spec.profile.points.get(index).unwrap().name.clone();
                if let Order::Points(points) = &command.intent.order {
                    let points = points.iter().map(|(index, value)| (name(*index), *value)).collect();
                    // The command may have arrived after `now`.
                    let life = command.intent.window.expires.saturating_duration_since(Instant::now());
                    orders
                        .lock()
                        .unwrap()
                        .push((command.drive().unwrap().place(), points, life));
                }
                command.answer(&Outcome::Acknowledged(Reply::Written), now);
            }
        }
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}

/// Process data of an NX: running, ready, at reference; output frequency in 0.01 Hz.
pub(crate) fn fill(plant: &Plant, drive: &str, frequency: u16) {
    read_nx(plant, drive, 0x0023, frequency, Instant::now());
}

/// A plant `hall` with a bus `line1`; drives whose name begins with `m` are only monitored. Samples stay good for an hour.
pub(crate) fn plant(drives: &[&str]) -> Plant {
    let nx = nx();
    let images = drives.iter().zip(1..).map(|(name, address)| {
        let mut spec = controlled(name, "line1", address, &nx);
        spec.limits = BTreeMap::from([("speed_reference".to_string(), 0.0..=80.0)]);
        if name.starts_with('m') {
            spec.access = Access::Monitor;
        }
        image(spec)
    });
    let bus = up(bus(bus_spec("line1"), images.collect()));
    let plant = Plant::new("hall", Duration::from_secs(3600), vec![bus]);
    for drive in drives {
        fill(&plant, drive, 2500);
    }
    plant
}

/// A broker of this machine.
pub(crate) fn at(port: u16) -> drivegate_mqtt::Broker {
    drivegate_mqtt::Broker {
        host: "127.0.0.1".to_string(),
        port,
        path: None,
    }
}

/// Options for a broker on that port; commands are served.
pub(crate) fn options(port: u16) -> Options {
    Options {
        retain: true,
        brokers: vec![at(port)],
        tls: false,
        client_id: "drivegate-hall".to_string(),
        username: None,
        password: None,
        proxy: None,
        publish_limit: 0,
        ca: None,
        identity: None,
        base: "drivegate".to_string(),
        telemetry: Telemetry {
            state: true,
            points: true,
            history: History::Off,
        },
        telemetry_qos: Qos::AtMostOnce,
        event_qos: Qos::AtLeastOnce,
        expiry: None,
        message_expiry: None,
        min_interval: Duration::from_millis(40),
        max_interval: Duration::from_secs(60),
        commands: true,
        require_id: false,
        response_topics: Vec::new(),
        principals: None,
        buffer: None,
        home_assistant: None,
        sparkplug: None,
    }
}
