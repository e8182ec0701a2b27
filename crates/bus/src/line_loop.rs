//! The running bus: the only code of the master that does I/O. One thread owns the line and does what the
//! [`BusCore`] returns.

use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::time::{Duration, Instant};

use super::core::{Action, BusCore, Closed};
use super::listener::ListenCore;
use super::longest_transaction::{longest_transaction, stops_of_all};
use super::master::Handover;
use super::{BusOptions, Mode};
use drivegate_core::event::Events;
use drivegate_core::order::{DEFAULT_EXPIRY, Outcome};
use drivegate_core::plant::BusHandle;
use drivegate_core::stalls::Stalls;
use drivegate_line::{Arrival, Line, LineOptions, Lost, Names, OpenError, Receiver, Woken};
use drivegate_model::drive::DriveIndex;
use drivegate_proto::LineFormat;

/// First and longest pause between two attempts to open the port.
const REOPEN: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(3));
/// Longest wait for the transaction on the line when the bus is to end: a present drive replies within it, and an
/// absent one must not delay a stop or a reload for its full `response_timeout`.
const LAST_EXCHANGE: Duration = Duration::from_secs(1);
/// Longest time between two signs of life of the thread, even while it waits for a reply.
const BEAT: Duration = Duration::from_millis(100);

/// The handle of a running bus.
#[derive(Debug)]
pub struct BusTask {
    handle: BusHandle,
    stop: Arc<AtomicBool>,
    beats: Arc<AtomicU64>,
    /// Longest wait for stops when the bus ends.
    last_stops: Duration,
    /// Channel for the handover to the prepared bus; present until the bus begins.
    begin: Option<SyncSender<Handover>>,
    thread: Option<std::thread::JoinHandle<Handover>>,
}

impl BusTask {
    /// Starts the bus in a separate thread.
    ///
    /// # Errors
    /// If the system cannot create a thread.
    pub fn start(handle: BusHandle, options: BusOptions, events: Events) -> std::io::Result<BusTask> {
        let mut task = BusTask::prepare(handle, options, events)?;
        task.begin(Handover::default());
        Ok(task)
    }

    /// Gets all that a bus needs from the system; the thread waits for [`BusTask::begin`] and touches no port before
    /// that.
    ///
    /// # Errors
    /// If the system cannot create a thread.
    pub fn prepare(handle: BusHandle, options: BusOptions, events: Events) -> std::io::Result<BusTask> {
        let stop = Arc::new(AtomicBool::new(false));
        let beats = Arc::new(AtomicU64::new(0));
        let drives = || handle.image.drives.iter().map(|image| &image.spec);
        let longest = longest_transaction(&handle.image.spec, &options, drives());
        let of_all = stops_of_all(&handle.image.spec, &options, drives());
        let worker = Worker {
            handle: handle.clone(),
            options,
            stop: stop.clone(),
            beats: beats.clone(),
        };
        let name = format!("bus-{}", handle.image.spec.name);
        let (begin, begun) = sync_channel::<Handover>(1);
        let thread = std::thread::Builder::new().name(name).spawn(move || {
            // A bus that is dropped before it began needs no ending.
            let Ok(before) = begun.recv() else {
                return Handover::default();
            };
            or_end_the_process(|| match worker.options.mode {
                Mode::Master => worker.run(events, &before),
                Mode::Listen => worker.listen(events),
            })
        })?;
        Ok(BusTask {
            handle,
            stop,
            beats,
            // The transaction on the line, and the last one of a stop, which may begin at the end of the time of the stop.
            last_stops: LAST_STOPS + 2 * longest + of_all,
            begin: Some(begin),
            thread: Some(thread),
        })
    }

    /// Lets a prepared bus open its port; nothing can fail after this. `before` is the handover of the previous bus.
    pub fn begin(&mut self, before: Handover) {
        if let Some(begin) = self.begin.take() {
            // The channel has room for the value and the thread waits for it, so sending cannot fail.
            let _ = begin.send(before);
        }
    }

    /// Number of turns of the bus; a bus whose number does not advance for seconds hangs.
    pub fn heartbeat_counter(&self) -> Arc<AtomicU64> {
        self.beats.clone()
    }

    pub fn handle(&self) -> &BusHandle {
        &self.handle
    }

    /// Longest time for which [`BusTask::stop`] and [`BusTask::make_room`] wait for stops.
    pub fn last_stops(&self) -> Duration {
        self.last_stops
    }

    /// Ends the bus when the stops that clients ordered are sent, and after the transaction on the line; all other pending
    /// requests end. The wait for stops is bounded by [`BusTask::last_stops`], that for the transaction by a second.
    pub fn stop(mut self) {
        let queue = self.handle.queue.clone();
        queue.accept_only_stops(Instant::now());
        self.wait_for_stops(|| !queue.close_after_stops(Instant::now()));
        queue.close(Outcome::ShuttingDown, Instant::now());
        self.halt();
    }

    /// Ends a bus that another one replaces: stops wait for that one, handed over by [`BusHandle::take_over`]. The stops of the
    /// drives of `last`, which no bus serves any more, are sent before; the wait for a silent drive is bounded by
    /// [`BusTask::last_stops`]. Returns the handover.
    pub fn make_room(mut self, last: Vec<DriveIndex>) -> Handover {
        let queue = self.handle.queue.clone();
        queue.begin_handover(last, Instant::now());
        self.wait_for_stops(|| queue.has_last_stops());
        self.halt()
    }

    /// Waits within the time for the last stops while there are some.
    fn wait_for_stops(&self, remain: impl Fn() -> bool) {
        let began = Instant::now();
        while remain() && began.elapsed() < self.last_stops {
            std::thread::sleep(LOOK_AGAIN);
        }
    }

    fn halt(&mut self) -> Handover {
        self.stop.store(true, Ordering::Relaxed);
        self.begin = None;
        self.handle.queue.wake();
        // Never an error: a panic of the bus has ended the process.
        let thread = self.thread.take();
        thread.and_then(|thread| thread.join().ok()).unwrap_or_default()
    }
}

impl Drop for BusTask {
    fn drop(&mut self) {
        if self.thread.is_some() {
            self.handle.queue.close(Outcome::ShuttingDown, Instant::now());
        }
        self.halt();
    }
}

/// The time for the last stops of a bus, besides the transactions at both ends of it.
const LAST_STOPS: Duration = DEFAULT_EXPIRY;
/// Pause between two checks of the last stops.
const LOOK_AGAIN: Duration = Duration::from_millis(5);

/// Time for the log to be written before the process ends.
const LAST_WORDS: Duration = Duration::from_millis(200);

/// Ends the process if the bus thread panics: otherwise commands would be accepted that nothing serves, a stop
/// would be lost, and the last values shown forever. A process that exits is restarted, and its clients notice.
fn or_end_the_process<T>(work: impl FnOnce() -> T) -> T {
    std::panic::catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|_| {
        let bus = std::thread::current().name().unwrap_or_default().to_string();
        tracing::error!(
            target: "drivegate::bus::line_loop", "the thread {bus} panicked, which is a bug in drivegate; the process \
                                                  exits to be restarted"
        );
        // Log lines are written by another thread, which gets time to finish.
        std::thread::sleep(LAST_WORDS);
        std::process::abort();
    })
}

/// The pauses between two attempts to open the port: each twice as long as the one before, so that a port that is
/// lost again at once is opened less and less often.
#[derive(Debug)]
struct ReopenPauses {
    next: Duration,
}

impl Default for ReopenPauses {
    fn default() -> ReopenPauses {
        ReopenPauses { next: REOPEN.0 }
    }
}

impl ReopenPauses {
    /// Starts the pauses again because the device is back.
    fn begin_anew(&mut self) {
        self.next = REOPEN.0;
    }

    /// Starts again with the shortest pause if the port was open for this time.
    fn was_open_for(&mut self, time: Duration) {
        if time >= REOPEN.1 {
            self.next = REOPEN.0;
        }
    }

    fn next(&mut self) -> Duration {
        let pause = self.next;
        self.next = (pause * 2).min(REOPEN.1);
        pause
    }
}

struct Worker {
    handle: BusHandle,
    options: BusOptions,
    stop: Arc<AtomicBool>,
    beats: Arc<AtomicU64>,
}

impl Worker {
    fn run(self, events: Events, before: &Handover) -> Handover {
        let handle = self.handle.clone();
        let core = BusCore::new(handle, &self.options, events, before, Instant::now());
        self.keep_open(core).ended(Instant::now())
    }

    fn listen(self, events: Events) -> Handover {
        let handle = self.handle.clone();
        let core = ListenCore::new(handle, &self.options, events, Instant::now());
        self.keep_open(core);
        // A listening bus has no leases and sent no requests, so there is nothing to hand over.
        Handover::default()
    }

    /// Serves the port while it exists, and opens it again whenever it is lost, until the bus is to end.
    fn keep_open<C: Core>(&self, mut core: C) -> C {
        drivegate_line::sharpen_timers();
        let mut pauses = ReopenPauses::default();
        let mut names = Names::allowing(&self.options.allow);
        while !self.stopping() {
            let spec = &self.handle.image.spec;
            let go_on = || !self.stopping();
            // The watch starts before the attempt, so that no change is missed after it.
            let watching = Arrival::of(&spec.port);
            let arrival = match C::open(&mut names, &spec.port, &spec.format, &self.options.line, &go_on) {
                Ok((line, warnings)) => {
                    drop(watching);
                    for warning in warnings {
                        tracing::warn!(target: "drivegate::bus::line_loop", bus = %spec.name, "{warning}");
                    }
                    let opened = Instant::now();
                    core.opened(opened);
                    let why = self.stay_connected(&mut core, &mut names, line);
                    pauses.was_open_for(opened.elapsed());
                    if let Err(why) = why {
                        core.lost(&why, Instant::now());
                    }
                    Arrival::of(&spec.port)
                }
                // Anyone who ended the bus ended the try, too.
                Err(_) if self.stopping() => None,
                Err(error) => {
                    core.lost(&error.to_string(), Instant::now());
                    watching
                }
            };
            if self.rest(pauses.next(), arrival.as_ref()) {
                pauses.begin_anew();
            }
        }
        core
    }

    /// Serves an open port until the bus is to end. A device server that closes its connection after a reply or
    /// after a pause does not count as a lost port: the gateway reconnects.
    ///
    /// # Errors
    /// If the port is lost; contains the reason.
    fn stay_connected<C: Core>(&self, core: &mut C, names: &mut Names, mut line: C::Line) -> Result<(), String> {
        loop {
            let Err(lost) = core.serve(self, &line) else {
                return Ok(());
            };
            let closed = if lost.closed {
                core.closed(Instant::now())
            } else {
                Closed::Lost
            };
            // Some servers accept a single connection, so the old one is closed first.
            drop(line);
            match closed {
                Closed::Lost => return Err(lost.to_string()),
                Closed::Reconnect => {}
                Closed::ReconnectToAsk => core.wait_to_ask(self),
            }
            line = match self.connect_anew::<C>(names) {
                Ok((line, _)) => line,
                Err(_) if self.stopping() => return Ok(()),
                Err(error) => return Err(format!("{lost}; {error}")),
            };
            core.reconnected();
        }
    }

    /// Connects to a device server that closed a connection. A server that is still busy with that is tried twice.
    fn connect_anew<C: Core>(&self, names: &mut Names) -> Opened<C::Line> {
        let spec = &self.handle.image.spec;
        let go_on = || !self.stopping();
        let mut connect = || C::open(names, &spec.port, &spec.format, &self.options.line, &go_on);
        match connect() {
            Err(error) if error.is_refused() => {
                self.rest(REOPEN.0, None);
                connect()
            }
            opened => opened,
        }
    }

    fn stopping(&self) -> bool {
        self.beats.fetch_add(1, Ordering::Relaxed);
        self.stop.load(Ordering::Relaxed)
    }

    /// Waits before the next attempt to open the port: for this time, or until the device appears, which is
    /// returned; at least for the first pause.
    fn rest(&self, pause: Duration, arrival: Option<&Arrival>) -> bool {
        let began = Instant::now();
        let mut until = began + pause;
        let mut came = false;
        while !self.stopping() && Instant::now() < until {
            let beat = until.min(Instant::now() + BEAT);
            if drivegate_line::wait_without_port(beat, self.handle.queue.wake_fd(), arrival) {
                came = true;
                until = until.min(began + REOPEN.0);
            }
            self.handle.queue.clear_wake();
        }
        came
    }

    fn serve_as_master(&self, core: &mut BusCore, line: &Line) -> Result<(), Lost> {
        let mut buffer = [0u8; 512];
        let mut break_off = None;
        core.runs_on(Instant::now(), drivegate_line::since_boot());
        // The transaction on the line is completed first: the next user of the line would otherwise send into its reply.
        while !self.stopping() || core.asked().is_some() {
            let now = Instant::now();
            if core.note_run(now, drivegate_line::since_boot()) {
                // Bytes that arrived during the stall are a reply, although its time limit has passed.
                let count = line.receive(&mut buffer)?;
                core.received(buffer.get(..count).unwrap_or_default(), now);
            }
            if self.stop.load(Ordering::Relaxed) && now >= *break_off.get_or_insert(now + LAST_EXCHANGE) {
                return Ok(());
            }
            let woken = match core.poll(now) {
                Action::Send if self.stopping() => return Ok(()),
                Action::Send => {
                    // A delayed thread may not have read the last bytes yet.
                    let count = line.receive(&mut buffer)?;
                    let now = Instant::now();
                    if count > 0 {
                        core.received(buffer.get(..count).unwrap_or_default(), now);
                    } else if !core.note_run(now, drivegate_line::since_boot()) {
                        line.send(core.sending(now))?;
                    }
                    continue;
                }
                Action::Wait {
                    until,
                    commands,
                    precise,
                } => {
                    let wake = commands.then(|| self.handle.queue.wake_fd());
                    line.wait(until.min(now + BEAT), wake, precise)?
                }
            };
            match woken {
                Woken::Readable => {
                    let count = line.receive(&mut buffer)?;
                    core.received(buffer.get(..count).unwrap_or_default(), Instant::now());
                }
                Woken::Command => {
                    self.handle.queue.clear_wake();
                    core.command_came();
                }
                Woken::Time => {}
            }
        }
        Ok(())
    }

    /// Waits without a connection until a request is to be sent, or the bus is to end.
    fn wait_to_ask(&self, core: &mut BusCore) {
        core.runs_on(Instant::now(), drivegate_line::since_boot());
        while !self.stopping() {
            let now = Instant::now();
            core.note_run(now, drivegate_line::since_boot());
            match core.poll(now) {
                Action::Send => return,
                Action::Wait { until, commands, .. } => {
                    let until = until.min(now + BEAT);
                    if commands {
                        drivegate_line::wait_without_port(until, self.handle.queue.wake_fd(), None);
                        self.handle.queue.clear_wake();
                        core.command_came();
                    } else {
                        drivegate_line::wait_until(until, Duration::ZERO);
                    }
                }
            }
        }
    }

    fn only_listen(&self, core: &mut ListenCore, line: &Receiver) -> Result<(), Lost> {
        let mut buffer = [0u8; 512];
        let mut stalls = Stalls::new(Instant::now(), drivegate_line::since_boot());
        // Earliest time at which the bytes read next may have arrived.
        let mut since = None;
        while !self.stopping() {
            let now = Instant::now();
            let stood = stalls.observe(now, drivegate_line::since_boot());
            since = since.or(stood.map(|stall| stall.began));
            let until = core.on_time(now).min(now + BEAT);
            match line.wait(until, Some(self.handle.queue.wake_fd()))? {
                Woken::Readable => {
                    let count = line.receive(&mut buffer)?;
                    let now = Instant::now();
                    let stood = stalls.observe(now, drivegate_line::since_boot());
                    let came = since.take().or(stood.map(|stall| stall.began));
                    core.on_bytes(buffer.get(..count).unwrap_or_default(), came.unwrap_or(now));
                }
                Woken::Command => {
                    self.handle.queue.clear_wake();
                    core.refuse_all(Instant::now());
                }
                Woken::Time => since = None,
            }
        }
        Ok(())
    }
}

/// An opened port with its warnings.
type Opened<L> = Result<(L, Vec<String>), OpenError>;

/// A bus without its thread, and the kind of line that it needs.
trait Core {
    type Line;

    fn open(
        names: &mut Names,
        port: &str,
        format: &LineFormat,
        options: &LineOptions,
        go_on: &dyn Fn() -> bool,
    ) -> Opened<Self::Line>;
    fn opened(&mut self, now: Instant);
    fn lost(&mut self, why: &str, now: Instant);
    fn closed(&mut self, now: Instant) -> Closed;
    fn reconnected(&mut self);
    /// Returns when something is to be sent, or the bus is to stop.
    fn wait_to_ask(&mut self, worker: &Worker);
    fn serve(&mut self, worker: &Worker, line: &Self::Line) -> Result<(), Lost>;
}

impl Core for BusCore {
    type Line = Line;

    fn open(
        names: &mut Names,
        port: &str,
        format: &LineFormat,
        options: &LineOptions,
        go_on: &dyn Fn() -> bool,
    ) -> Opened<Line> {
        Line::open_by(names, port, format, options, go_on)
    }

    fn opened(&mut self, now: Instant) {
        BusCore::opened(self, now);
    }

    fn lost(&mut self, why: &str, now: Instant) {
        BusCore::lost(self, why, now);
    }

    fn closed(&mut self, now: Instant) -> Closed {
        BusCore::closed(self, now)
    }

    fn reconnected(&mut self) {
        BusCore::reconnected(self);
    }

    fn wait_to_ask(&mut self, worker: &Worker) {
        worker.wait_to_ask(self);
    }

    fn serve(&mut self, worker: &Worker, line: &Line) -> Result<(), Lost> {
        worker.serve_as_master(self, line)
    }
}

impl Core for ListenCore {
    type Line = Receiver;

    fn open(
        names: &mut Names,
        port: &str,
        format: &LineFormat,
        _: &LineOptions,
        go_on: &dyn Fn() -> bool,
    ) -> Opened<Receiver> {
        Receiver::open_by(names, port, format, go_on)
    }

    fn opened(&mut self, now: Instant) {
        ListenCore::opened(self, now);
    }

    fn lost(&mut self, why: &str, now: Instant) {
        ListenCore::lost(self, why, now);
    }

    fn closed(&mut self, _: Instant) -> Closed {
        ListenCore::closed(self)
    }

    fn reconnected(&mut self) {
        ListenCore::reconnected(self);
    }

    fn wait_to_ask(&mut self, _: &Worker) {}

    fn serve(&mut self, worker: &Worker, line: &Receiver) -> Result<(), Lost> {
        worker.only_listen(self, line)
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::process::ExitStatusExt;
    use std::process::Command;

    use super::*;

    /// Environment variable for the child process that the test below starts to see it exit.
    const DIES: &str = "DRIVEGATE_TEST_DIES";

    #[test]
    fn a_bus_that_panics_ends_the_process() {
        if std::env::var_os(DIES).is_some() {
            let bus = std::thread::spawn(|| or_end_the_process(|| panic!("as a test wants it")));
            let _ = bus.join();
            return;
        }
        let test = "line_loop::tests::a_bus_that_panics_ends_the_process";
        let mut same = Command::new(std::env::current_exe().unwrap());
        let ended = same.args([test, "--exact"]).env(DIES, "1").output().unwrap();
        assert_eq!(ended.status.signal(), Some(6), "{ended:?}");
    }

    #[test]
    fn pauses_between_tries_to_open_the_port_double_from_a_tenth_of_a_second_to_three() {
        let first = [100, 200, 400, 800, 1600, 3000].map(Duration::from_millis);
        let next = |pauses: &mut ReopenPauses| first.map(|_| pauses.next());
        let mut pauses = ReopenPauses::default();
        assert_eq!(next(&mut pauses), first);
        assert_eq!(next(&mut pauses), [REOPEN.1; 6]);
        // The port opens and is lost again after a short time.
        pauses.was_open_for(Duration::from_millis(2999));
        assert_eq!(pauses.next(), REOPEN.1);
        pauses.was_open_for(REOPEN.1);
        assert_eq!(next(&mut pauses), first);
    }
}
