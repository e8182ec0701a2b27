//! The bus at work: the only place south that does I/O. One thread owns the line.
//!
//! This file has its life: opening, losing and serving the port. One turn of the line is in `turn`, what an exchange
//! that is over means in `results`.

mod results;
mod turn;

use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::time::{Duration, Instant};

use super::BusOptions;
use super::desk::{Desk, Job};
use super::leases::Leases;
use super::report::Report;
use super::schedule::{Cadence, Schedule};
use super::session::Sessions;
use crate::codec::Protocol;
use crate::command::Outcome;
use crate::drive::plan::WireTime;
use crate::drive::{Plan, PlannedRead};
use crate::event::Events;
use crate::line::{self, Line, Lost, Names, Woken};
use crate::plant::BusHandle;

/// First and longest pause between two tries to open the port.
const REOPEN: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(3));
/// A line that never falls silent is spoken on after this time: a stop must get out.
const BABBLE: Duration = Duration::from_millis(500);
/// The bus looks around at least this often.
const LOOK_ROUND: Duration = Duration::from_millis(100);

/// A bus that runs.
#[derive(Debug)]
pub struct BusTask {
    handle: BusHandle,
    stop: Arc<AtomicBool>,
    beats: Arc<AtomicU64>,
    /// Present until the bus begins.
    begin: Option<SyncSender<()>>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl BusTask {
    /// Starts the bus in a thread of its own.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(handle: BusHandle, options: BusOptions, leases: Leases, events: Events) -> std::io::Result<BusTask> {
        let mut task = BusTask::prepare(handle, options, leases, events)?;
        task.begin();
        Ok(task)
    }

    /// Gets all that a bus needs from the system; its thread waits for [`BusTask::begin`] and touches no port before.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn prepare(handle: BusHandle, options: BusOptions, leases: Leases, events: Events) -> std::io::Result<BusTask> {
        let stop = Arc::new(AtomicBool::new(false));
        let beats = Arc::new(AtomicU64::new(0));
        let worker = Worker::new(handle.clone(), options, leases, events, stop.clone(), beats.clone());
        let name = format!("bus-{}", handle.image.spec.name);
        let (begin, begun) = sync_channel(1);
        let thread = std::thread::Builder::new().name(name).spawn(move || {
            // A bus that is given up before it began has nothing to end.
            if begun.recv().is_ok() {
                or_end_the_process(|| worker.run());
            }
        })?;
        Ok(BusTask {
            handle,
            stop,
            beats,
            begin: Some(begin),
            thread: Some(thread),
        })
    }

    /// Lets a prepared bus open its port; nothing further can fail.
    pub fn begin(&mut self) {
        if let Some(begin) = self.begin.take() {
            // Room for one; the thread waits for it.
            let _ = begin.send(());
        }
    }

    /// Turns that the bus has taken: it hangs when this stands still for seconds.
    pub fn beats(&self) -> u64 {
        self.beats.load(Ordering::Relaxed)
    }

    /// The bus.
    pub fn handle(&self) -> &BusHandle {
        &self.handle
    }

    /// Ends the bus after the exchange that is running; everything that waits is answered.
    pub fn stop(mut self) {
        self.halt();
    }

    fn halt(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.begin = None;
        self.handle.queue.close(Outcome::ShuttingDown, Instant::now());
        self.handle.queue.wake();
        if let Some(thread) = self.thread.take() {
            // Never an error: a panic of the bus has ended the process.
            let _ = thread.join();
        }
    }
}

impl Drop for BusTask {
    fn drop(&mut self) {
        self.halt();
    }
}

/// Time for the log to be written before the process ends.
const LAST_WORDS: Duration = Duration::from_millis(200);

/// A bus that panicked would take commands that nobody serves, and show the last values for ever: a stop would be lost
/// in it. A process that dies is started again, and its clients see that it is gone.
fn or_end_the_process(work: impl FnOnce()) {
    if std::panic::catch_unwind(AssertUnwindSafe(work)).is_err() {
        let bus = std::thread::current().name().unwrap_or_default().to_string();
        tracing::error!(
            "the thread {bus} panicked, which is a fault of drivegate; the process ends to be started again"
        );
        // Log lines are written by a thread of their own.
        std::thread::sleep(LAST_WORDS);
        std::process::abort();
    }
}

struct Worker {
    handle: BusHandle,
    options: BusOptions,
    silence: Duration,
    schedule: Schedule,
    desk: Desk,
    /// What N2 says to drives beside reading them.
    sessions: Sessions,
    leases: Leases,
    report: Report,
    stop: Arc<AtomicBool>,
    beats: Arc<AtomicU64>,
    /// End of the last character on the line, either direction.
    quiet_since: Instant,
    /// The adapter sends back what it is given.
    echo: bool,
    /// Replies come faster than the wire could carry them: a simulation, or another baud rate behind a device server.
    untimed: bool,
    /// The last exchange ended with the drive's reply, mangled: it owes none.
    paid: bool,
    frame: Vec<u8>,
}

impl Worker {
    fn new(
        handle: BusHandle,
        options: BusOptions,
        leases: Leases,
        events: Events,
        stop: Arc<AtomicBool>,
        beats: Arc<AtomicU64>,
    ) -> Worker {
        let now = Instant::now();
        let spec = handle.image.spec.clone();
        let silence = spec.protocol.silence(options.silence, &spec.format);
        let cadence = Cadence {
            fast: spec.cycle,
            slow: spec.slow_cycle,
            retries: options.retries,
        };
        let plans: Vec<&Plan> = handle.image.drives.iter().map(|d| &d.plan).collect();
        let drives = &handle.image.drives;
        let cost = |index: usize, read: &PlannedRead| {
            let turnaround = drives.get(index).map_or(Duration::ZERO, |d| d.spec.turnaround);
            WireTime::of(spec.protocol, &spec.format, &read.pdu()).total(turnaround, silence)
        };
        let schedule = Schedule::new(cadence, &plans, cost, now);
        let report = Report::new(handle.image.clone(), events);
        let sessions = match spec.protocol {
            Protocol::N2 => Sessions::new(drives.iter().map(|d| d.spec.profile.n2)),
            Protocol::ModbusRtu | Protocol::ModbusAscii => Sessions::default(),
        };
        Worker {
            handle,
            options,
            silence,
            schedule,
            desk: Desk::default(),
            sessions,
            leases,
            report,
            stop,
            beats,
            quiet_since: now,
            echo: false,
            untimed: false,
            paid: false,
            frame: Vec::with_capacity(260),
        }
    }

    fn run(mut self) {
        line::sharpen_timers();
        let mut pause = REOPEN.0;
        let mut names = Names::default();
        while !self.stopping() {
            let spec = &self.handle.image.spec;
            let go_on = || !self.stopping();
            match Line::open_by(&mut names, &spec.port, &spec.format, self.options.rs485, &go_on) {
                Ok((line, warnings)) => {
                    self.opened(warnings);
                    let opened = Instant::now();
                    let why = self.serve(&line);
                    // A port that goes again at once is opened ever less often.
                    if opened.elapsed() >= REOPEN.1 {
                        pause = REOPEN.0;
                    }
                    if let Err(lost) = why {
                        self.lost(&lost.to_string());
                    }
                }
                // Whoever ended the bus ended the try, too.
                Err(_) if self.stopping() => {}
                Err(error) => self.lost(&error.to_string()),
            }
            self.rest(pause);
            pause = (pause * 2).min(REOPEN.1);
        }
        let now = Instant::now();
        self.desk.close(&Outcome::ShuttingDown, now);
        // What the drive acknowledged last is not owed by the bus that takes over.
        self.leases.settle(&self.handle, now);
    }

    fn stopping(&self) -> bool {
        self.beats.fetch_add(1, Ordering::Relaxed);
        self.stop.load(Ordering::Relaxed)
    }

    fn rest(&self, pause: Duration) {
        let until = Instant::now() + pause;
        while !self.stopping() && Instant::now() < until {
            line::wait_without_port(until.min(Instant::now() + LOOK_ROUND), self.handle.queue.wake_fd());
            self.handle.queue.clear_wake();
        }
    }

    fn opened(&mut self, warnings: Vec<String>) {
        let now = Instant::now();
        for warning in warnings {
            tracing::warn!(bus = %self.handle.image.spec.name, "{warning}");
        }
        self.quiet_since = now;
        self.echo = false;
        self.untimed = false;
        self.schedule.reset(now);
        self.sessions.reset();
        self.handle.queue.open();
        self.report.bus_up();
    }

    /// The port is gone or cannot be opened: everything is stale at once, everybody who waits is answered.
    fn lost(&mut self, why: &str) {
        let now = Instant::now();
        self.handle.queue.close(Outcome::BusDown, now);
        self.desk.close(&Outcome::BusDown, now);
        for index in 0..self.handle.image.drives.len() {
            self.desk.shadow.forget(index);
            self.report.offline(index, "its bus is down");
        }
        self.report.bus_down(why);
    }

    fn serve(&mut self, line: &Line) -> Result<(), Lost> {
        while !self.stopping() {
            let now = Instant::now();
            self.leases.look(&self.handle, now);
            match self.decide(now) {
                Ok(job) => self.work(line, job)?,
                Err(until) => self.idle(line, until.min(now + LOOK_ROUND))?,
            }
            let now = Instant::now();
            for late in self.desk.not_confirmed(&self.handle.image.drives, now) {
                self.report.not_confirmed(&late);
            }
            for drive in self.sessions.neglected(now) {
                self.schedule.ask(drive, now);
            }
            self.report.tick(now);
        }
        Ok(())
    }

    fn idle(&mut self, line: &Line, until: Instant) -> Result<(), Lost> {
        match line.wait(until, Some(self.handle.queue.wake_fd()), true)? {
            Woken::Readable => self.hear_noise(line),
            Woken::Command => {
                self.handle.queue.clear_wake();
                Ok(())
            }
            Woken::Time => Ok(()),
        }
    }

    /// Bytes that nobody asked for; the line is not silent while they come.
    fn hear_noise(&mut self, line: &Line) -> Result<(), Lost> {
        let mut buffer = [0u8; 512];
        let count = line.receive(&mut buffer)?;
        if count > 0 {
            let now = Instant::now();
            self.sessions.strayed();
            self.report
                .noise(buffer.get(..count).unwrap_or_default(), self.quiet_since, now);
            self.quiet_since = now;
        }
        Ok(())
    }

    /// What goes on the line next, or until when nothing does.
    fn decide(&mut self, now: Instant) -> Result<Job, Instant> {
        let drives = &self.handle.image.drives;
        let decided = self
            .desk
            .decide(drives, &mut self.handle.queue.lock(), &mut self.schedule, now);
        if let Some(round) = self.schedule.take_round() {
            self.report.fast_round(round.cycle);
        }
        decided
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::process::ExitStatusExt;
    use std::process::Command;

    use super::*;

    /// Set in the process that the test below starts to see it die.
    const DIES: &str = "DRIVEGATE_TEST_DIES";

    #[test]
    fn a_bus_that_panics_ends_the_process() {
        if std::env::var_os(DIES).is_some() {
            let bus = std::thread::spawn(|| or_end_the_process(|| panic!("as a test wants it")));
            let _ = bus.join();
            return;
        }
        let test = "bus::task::tests::a_bus_that_panics_ends_the_process";
        let mut same = Command::new(std::env::current_exe().unwrap());
        let ended = same.args([test, "--exact"]).env(DIES, "1").output().unwrap();
        assert_eq!(ended.status.signal(), Some(6), "{ended:?}");
    }
}
