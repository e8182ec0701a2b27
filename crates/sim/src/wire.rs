//! The simulated line as a thread that uses a port, with the timing of a real line.
//!
//! Each simulated line has one thread, which owns the port. The thread sleeps in `ppoll` until bytes arrive or the
//! next character is due, with the timer slack of the kernel switched off, and busy-waits for the last microseconds
//! before a delivery.

use super::SimTime;
use super::endpoint::{Endpoint, EndpointOptions};
use super::faults::FaultPlan;
use super::half_duplex::{HalfDuplex, LineRules, Wire};
use super::n2::BoardOptions;
use super::simulated_drive::{DriveOptions, SimulatedDrive};
use super::slave::Slaves;
use super::statistics::{Recorded, Statistics, Transcript};
use drivegate_line::{poll_until, sharpen_timers, wait_until};
use drivegate_proto::Protocol;
use rustix::event::{EventfdFlags, PollFd, PollFlags, eventfd};
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Options of a simulated line.
#[derive(Debug, Clone)]
pub struct SimulatedBusOptions {
    /// Name for messages and for the thread.
    pub name: String,
    /// The endpoint by which a master reaches the simulated line.
    pub endpoint: EndpointOptions,
    /// Behaviour of the line. On a real serial port the hardware determines the times, whatever `wire` says, and
    /// silence is counted but not enforced: drivers and adapters deliver bytes late.
    pub rules: LineRules,
    pub drives: Vec<DriveOptions>,
    /// Options of the drives' boards, if the drives speak N2.
    pub boards: BoardOptions,
    /// Faults on the line.
    pub faults: FaultPlan,
    /// Maximum number of frames that the transcript keeps; 0 keeps none.
    pub transcript: usize,
}

impl SimulatedBusOptions {
    /// A line on a pseudo-terminal without a link and without faults.
    pub fn new(name: &str, rules: LineRules, drives: Vec<DriveOptions>) -> SimulatedBusOptions {
        SimulatedBusOptions {
            name: name.to_string(),
            endpoint: EndpointOptions::Pty { link: None },
            rules,
            drives,
            boards: BoardOptions::default(),
            faults: FaultPlan::default(),
            transcript: 0,
        }
    }
}

/// Time before a delivery in which the thread watches the clock instead of sleeping: the wake-up from `ppoll` was measured
/// late by 50 to 80 microseconds in most cases, on a virtual machine.
const SPIN: Duration = Duration::from_micros(80);
/// Period at which the drives of an idle line are advanced.
const IDLE: Duration = Duration::from_millis(100);
/// Time without traffic after which the master may have left the line; the port is then settled, and again at this
/// interval.
const SETTLE_AFTER: Duration = Duration::from_secs(1);
/// Interval of attempts to open a lost port again.
const REOPEN: Duration = Duration::from_secs(1);
/// Longest wait for the thread of the line to carry out an action.
const PATIENCE: Duration = Duration::from_secs(5);

/// Whether the simulated port should exist.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Wanted {
    Present,
    Absent,
    Stop,
}

/// Whether the port exists, and where.
#[derive(Debug)]
enum Found {
    Present(String),
    Absent,
    Failed(io::ErrorKind, String),
}

#[derive(Debug)]
struct Port {
    wanted: Wanted,
    found: Found,
}

#[derive(Debug)]
struct Shared {
    name: String,
    start: Instant,
    line: Mutex<HalfDuplex>,
    port: Mutex<Port>,
    changed: Condvar,
    bell: OwnedFd,
}

impl Shared {
    fn now(&self) -> SimTime {
        self.start.elapsed()
    }

    /// A panic elsewhere leaves the line usable: it is only a simulation.
    fn line(&self) -> MutexGuard<'_, HalfDuplex> {
        self.line.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn port(&self) -> MutexGuard<'_, Port> {
        self.port.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn want(&self, wanted: Wanted) {
        self.port().wanted = wanted;
        let _ = rustix::io::write(&self.bell, &1u64.to_ne_bytes());
    }

    fn found(&self, found: Found) {
        self.port().found = found;
        self.changed.notify_all();
    }

    /// Waits until the thread has the port in the state that `right` accepts.
    fn wait_for(&self, right: impl Fn(&Found) -> bool) -> MutexGuard<'_, Port> {
        let waited = self
            .changed
            .wait_timeout_while(self.port(), PATIENCE, |port| !right(&port.found));
        waited.unwrap_or_else(PoisonError::into_inner).0
    }
}

/// A running simulated line; dropping it ends the thread and removes the port.
#[derive(Debug)]
pub struct SimulatedBus {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl SimulatedBus {
    /// Opens the port and starts the thread.
    ///
    /// # Errors
    /// If the port cannot be opened, linked or listened on.
    pub fn start(options: SimulatedBusOptions) -> io::Result<SimulatedBus> {
        let SimulatedBusOptions {
            name,
            endpoint,
            mut rules,
            drives,
            boards,
            faults,
            transcript,
        } = options;
        if matches!(endpoint, EndpointOptions::Port { .. }) {
            rules.wire = Wire::Real;
            rules.strict = false;
        }
        let format = rules.format;
        let port = Endpoint::open(&endpoint, &format)?;
        let mut slaves = Slaves::new(drives, SimTime::ZERO);
        slaves.set_boards(boards);
        let shared = Arc::new(Shared {
            name: name.clone(),
            start: Instant::now(),
            line: Mutex::new(HalfDuplex::new(rules, slaves, faults, Transcript::new(transcript))),
            port: Mutex::new(Port {
                wanted: Wanted::Present,
                found: Found::Present(port.address()),
            }),
            changed: Condvar::new(),
            bell: eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?,
        });
        let open = move || Endpoint::open(&endpoint, &format);
        let runner = Runner {
            shared: Arc::clone(&shared),
            open,
            settled: SimTime::ZERO,
        };
        let thread = std::thread::Builder::new()
            .name(format!("sim-{name}"))
            .spawn(move || runner.run(Some(port)))?;
        Ok(SimulatedBus {
            shared,
            thread: Some(thread),
        })
    }

    /// Ends the thread and takes the port away.
    pub fn stop(mut self) {
        self.end();
    }

    fn end(&mut self) {
        self.shared.want(Wanted::Stop);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Drop for SimulatedBus {
    fn drop(&mut self) {
        self.end();
    }
}

impl SimulatedBus {
    /// The port that a master opens: a path or `tcp://host:port`; empty while the port is away.
    pub fn address(&self) -> String {
        match &self.shared.port().found {
            Found::Present(address) => address.clone(),
            _ => String::new(),
        }
    }

    /// Description of the line in one row: `line1: 10 drives (1-10) at 38400 8N1 on /tmp/line1`, with the protocol
    /// unless it is Modbus RTU.
    pub fn description(&self) -> String {
        let (addresses, format, protocol) = {
            let mut line = self.shared.line();
            let addresses: Vec<u8> = line.slaves().addresses().collect();
            (addresses, line.rules().format, line.rules().protocol)
        };
        let protocol = match protocol {
            Protocol::ModbusRtu => String::new(),
            other => format!(" {}", other.name()),
        };
        let drives = if addresses.len() == 1 {
            "1 drive".to_string()
        } else {
            format!("{} drives", addresses.len())
        };
        format!(
            "{}: {drives} ({}) at {format}{protocol} on {}",
            self.shared.name,
            ranges(&addresses),
            self.address()
        )
    }

    /// Time since the line was switched on.
    pub fn now(&self) -> SimTime {
        self.shared.now()
    }

    /// Counters of the line so far.
    pub fn statistics(&self) -> Statistics {
        self.shared.line().statistics()
    }

    /// How late the simulator delivered, as a quantile (0.5 is the median).
    pub fn lateness(&self, quantile: f64) -> Option<Duration> {
        let lateness = self.shared.line().lateness().clone();
        lateness.quantile(quantile)
    }

    /// Frames of the transcript, oldest first.
    pub fn transcript(&self) -> Vec<Recorded> {
        self.shared.line().transcript().frames()
    }

    /// Starts an empty transcript of the last `limit` frames; 0 ends recording.
    pub fn record(&self, limit: usize) {
        self.shared.line().record(limit);
    }

    /// Replaces the faults from the next request on.
    pub fn set_faults(&self, faults: FaultPlan) {
        self.shared.line().set_faults(faults);
    }

    /// Calls `act` with the drive at this address in its present state; returns `None` if no drive has the address.
    pub fn with_drive<R>(&self, address: u8, act: impl FnOnce(&mut SimulatedDrive, SimTime) -> R) -> Option<R> {
        let mut line = self.shared.line();
        let now = self.shared.now();
        line.slaves().drive(address).map(|drive| {
            drive.advance(now);
            act(drive, now)
        })
    }

    /// Disconnects a drive from the line or connects it again; returns false if no drive has the address.
    pub fn set_alive(&self, address: u8, alive: bool) -> bool {
        self.with_drive(address, |drive, _| drive.set_alive(alive)).is_some()
    }

    /// Simulates an unplugged adapter: path and link no longer exist when this returns, and a master's open port fails.
    pub fn vanish(&self) {
        self.shared.want(Wanted::Absent);
        drop(self.shared.wait_for(|found| !matches!(found, Found::Present(_))));
    }

    /// Plugs the adapter in again: the link now leads to a new pseudo-terminal.
    ///
    /// # Errors
    /// If the port cannot be opened again.
    pub fn restore(&self) -> io::Result<()> {
        {
            let mut port = self.shared.port();
            if matches!(port.found, Found::Present(_)) {
                return Ok(());
            }
            port.found = Found::Absent;
        }
        self.shared.want(Wanted::Present);
        match &self.shared.wait_for(|found| !matches!(found, Found::Absent)).found {
            Found::Failed(kind, text) => Err(io::Error::new(*kind, text.clone())),
            Found::Present(_) => Ok(()),
            Found::Absent => Err(io::ErrorKind::TimedOut.into()),
        }
    }
}

/// Ascending addresses in short: `1-10, 12`.
fn ranges(addresses: &[u8]) -> String {
    let mut runs: Vec<(u8, u8)> = Vec::new();
    for &address in addresses {
        match runs.last_mut() {
            Some((_, last)) if u16::from(*last) + 1 == u16::from(address) => *last = address,
            _ => runs.push((address, address)),
        }
    }
    let text = |(first, last): &(u8, u8)| {
        if first == last {
            first.to_string()
        } else {
            format!("{first}-{last}")
        }
    };
    runs.iter().map(text).collect::<Vec<String>>().join(", ")
}

/// The thread that runs a line.
struct Runner<F> {
    shared: Arc<Shared>,
    open: F,
    /// Time of the last traffic, or when the port was last settled.
    settled: SimTime,
}

impl<F: Fn() -> io::Result<Endpoint>> Runner<F> {
    fn run(mut self, mut endpoint: Option<Endpoint>) {
        sharpen_timers();
        loop {
            let wanted = self.shared.port().wanted;
            match (wanted, endpoint.as_mut()) {
                (Wanted::Stop, _) => return,
                (Wanted::Absent, _) => {
                    endpoint = None;
                    self.without_port(Found::Absent);
                }
                (Wanted::Present, None) => endpoint = self.try_open(),
                (Wanted::Present, Some(port)) => {
                    if let Err(error) = self.turn(port) {
                        endpoint = None;
                        self.without_port(Found::Failed(error.kind(), error.to_string()));
                    }
                }
            }
        }
    }

    fn try_open(&mut self) -> Option<Endpoint> {
        match (self.open)() {
            Ok(endpoint) => {
                self.shared.found(Found::Present(endpoint.address()));
                Some(endpoint)
            }
            Err(error) => {
                self.without_port(Found::Failed(error.kind(), error.to_string()));
                None
            }
        }
    }

    /// Advances the drives without a line, until the bell rings or it is time to try again.
    fn without_port(&self, found: Found) {
        self.shared.line().cut();
        self.shared.found(found);
        let mut bell = [PollFd::new(&self.shared.bell, PollFlags::IN)];
        let _ = poll_until(&mut bell, Instant::now() + REOPEN);
        self.unring();
        let now = self.shared.now();
        self.shared.line().slaves().advance(now);
    }

    fn unring(&self) {
        let _ = rustix::io::read(&self.shared.bell, &mut [0u8; 8]);
    }

    /// Sends what is due, waits for the next event, and receives what has arrived.
    fn turn(&mut self, port: &mut Endpoint) -> io::Result<()> {
        port.connect();
        self.deliver(port)?;
        let now = self.shared.now();
        let wake = self.shared.line().wake();
        let until = match wake {
            Some(wake) if wake.delivery => wake.at.saturating_sub(SPIN),
            Some(wake) => wake.at,
            None => now + IDLE,
        };
        let until = self.shared.start + until.min(now + IDLE);
        let ready = {
            let mut fds = port.poll_fds();
            fds.push(PollFd::from_borrowed_fd(self.shared.bell.as_fd(), PollFlags::IN));
            poll_until(&mut fds, until)?
        };
        if ready {
            self.unring();
            return self.take(port);
        }
        match wake {
            Some(wake) if wake.delivery && self.shared.start + wake.at <= until + SPIN => {
                wait_until(self.shared.start + wake.at, SPIN);
            }
            Some(_) => {}
            None => self.idle(port),
        }
        Ok(())
    }

    fn take(&mut self, port: &mut Endpoint) -> io::Result<()> {
        let mut buffer = [0u8; 512];
        let count = port.receive(&mut buffer)?;
        if let Some(bytes) = buffer.get(..count).filter(|bytes| !bytes.is_empty()) {
            let now = self.shared.now();
            self.settled = now;
            let mut line = self.shared.line();
            line.on_bytes(bytes, now);
            // No action is due before the request's silence is over, which leaves time for a drive that is not polled.
            line.slaves().advance_next(now);
        }
        Ok(())
    }

    fn deliver(&self, port: &mut Endpoint) -> io::Result<()> {
        let mut line = self.shared.line();
        line.on_time(self.shared.now());
        let mut bytes = Vec::new();
        while let Some(due) = line.take_due(self.shared.now(), &mut bytes) {
            let sent = port.send(&bytes)?;
            line.lost(bytes.len().saturating_sub(sent));
            line.lateness().record(self.shared.now().saturating_sub(due));
            bytes.clear();
        }
        Ok(())
    }

    fn idle(&mut self, port: &Endpoint) {
        let now = self.shared.now();
        self.shared.line().slaves().advance(now);
        if now.saturating_sub(self.settled) >= SETTLE_AFTER {
            self.settled = now;
            port.settle();
        }
    }
}

#[cfg(test)]
mod tests;
