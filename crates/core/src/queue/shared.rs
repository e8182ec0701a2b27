//! The command queue of a bus, shared by the servers and the bus: protected by a lock, with the descriptor that
//! wakes the bus.

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use rustix::event::{EventfdFlags, eventfd};
use tokio::sync::oneshot;

use super::{Background, NotStopped, Pending, Stopping};
use crate::order::{BackgroundRequest, Command, Outcome, Refusal};
use crate::permit::{AwaitedFiles, DrillLock, Facts, Rules};
use crate::start_guard::BusGuards;
use drivegate_model::drive::DriveIndex;

/// The queue between the north sides and one bus.
#[derive(Debug)]
pub struct CommandQueue {
    pending: Mutex<Pending>,
    background: Mutex<Background>,
    /// Whether `[authority]` is on.
    has_authority: AtomicBool,
    /// Whether a drive is to be sent nothing for a time.
    has_quiet: AtomicBool,
    wake: OwnedFd,
    guards: Option<Arc<BusGuards>>,
}

impl CommandQueue {
    /// An empty queue.
    ///
    /// # Errors
    /// If the system provides no event descriptor.
    pub fn new() -> io::Result<CommandQueue> {
        let wake = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?;
        Ok(CommandQueue {
            pending: Mutex::default(),
            background: Mutex::default(),
            has_authority: AtomicBool::new(false),
            has_quiet: AtomicBool::new(false),
            wake,
            guards: None,
        })
    }

    /// Sets the start guards of its drives.
    #[must_use]
    pub fn guarded(mut self, guards: Option<Arc<BusGuards>>) -> CommandQueue {
        self.lock().gate.set_starts(guards.clone());
        self.guards = guards;
        self
    }

    /// Sets the files that may forbid starts until they are read.
    #[must_use]
    pub fn awaiting(self, files: Arc<AwaitedFiles>) -> CommandQueue {
        self.lock().gate.set_awaited(files);
        self
    }

    /// The start guards of the bus, if any.
    pub fn guards(&self) -> Option<&Arc<BusGuards>> {
        self.guards.as_ref()
    }

    /// Adds a command and wakes the bus. Returns the refusal if the gate refused the command, which is then answered.
    pub fn submit(&self, command: Command, facts: &dyn Facts, now: Instant) -> Option<Refusal> {
        let refusal = self.lock().push(command, facts, now);
        self.wake();
        refusal
    }

    /// Adds the stop of a command and its rest without anything in between, and wakes the bus. Returns the refusals
    /// of both.
    pub(crate) fn submit_parts(
        &self,
        stop: Command,
        rest: Command,
        facts: &dyn Facts,
        now: Instant,
    ) -> [Option<Refusal>; 2] {
        let mut pending = self.lock();
        let of_stop = pending.push(stop, facts, now);
        let of_rest = pending.push(rest, facts, now);
        drop(pending);
        self.wake();
        [of_stop, of_rest]
    }

    /// Adds a background request and wakes the bus.
    pub fn submit_background(&self, request: BackgroundRequest, now: Instant) {
        self.background().push(request, now);
        self.wake();
    }

    /// The waiting background requests, for the bus.
    pub fn background(&self) -> MutexGuard<'_, Background> {
        self.background.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Locks the waiting commands.
    pub fn lock(&self) -> MutexGuard<'_, Pending> {
        self.pending.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Ends everything that waits, and everything submitted from now on, with `outcome`.
    pub fn close(&self, outcome: Outcome, now: Instant) {
        self.background().close(&outcome, now);
        self.lock().close(outcome, now);
    }

    /// Closes the queue for the end of the gateway, unless a client's stop waits or is in progress: an accepted stop is
    /// sent. Returns whether the queue is closed.
    pub fn close_after_stops(&self, now: Instant) -> bool {
        let mut pending = self.lock();
        let is_free = !pending.has_client_stops();
        if is_free {
            pending.close(Outcome::ShuttingDown, now);
        }
        is_free
    }

    /// Accepts only stops from now on, and ends all other waiting commands. Stops are not delayed any more.
    pub fn accept_only_stops(&self, now: Instant) {
        self.background().close(&Outcome::ShuttingDown, now);
        let mut pending = self.lock();
        pending.remove(now, &Outcome::ShuttingDown, |c| !c.ends_the_gateway());
        pending.waiting.iter_mut().for_each(Command::end_delay);
        pending.stops_only = true;
        drop(pending);
        self.wake();
    }

    /// Prepares for the end of the gateway: from now on only stops are accepted, and all other waiting commands
    /// end. The bus stops its drives until `deadline`, and reports those that were not stopped.
    pub fn begin_shutdown(&self, deadline: Instant, now: Instant) -> oneshot::Receiver<Vec<NotStopped>> {
        let (report, missing) = oneshot::channel();
        self.accept_only_stops(now);
        self.lock().stopping = Some(Stopping { deadline, report });
        self.wake();
        missing
    }

    /// Accepts commands again.
    pub fn open(&self) {
        let mut pending = self.lock();
        if pending.ending {
            return;
        }
        pending.closed = None;
        if !pending.stops_only {
            self.background().open();
        }
    }

    /// Wakes the bus from its wait.
    pub fn wake(&self) {
        // A full counter means that the bus is being woken already.
        let _ = rustix::io::write(&self.wake, &1u64.to_ne_bytes());
    }

    /// Readable when the bus is to look at the queue.
    pub fn wake_fd(&self) -> BorrowedFd<'_> {
        self.wake.as_fd()
    }

    /// Clears the wake-up of the bus.
    pub fn clear_wake(&self) {
        let mut count = [0u8; 8];
        // A read without data only means that the bus was not woken.
        let _ = rustix::io::read(&self.wake, &mut count);
    }

    /// Applies these rules to the drives of the bus from now on; `None` means that `[authority]` is off.
    pub fn set_authority(&self, rules: Option<Arc<Rules>>) {
        let mut pending = self.lock();
        self.has_authority.store(rules.is_some(), Ordering::Release);
        pending.gate.set_rules(rules);
    }

    /// Whether `[authority]` is on.
    pub fn has_authority(&self) -> bool {
        self.has_authority.load(Ordering::Acquire)
    }

    /// Notes that a drill starts, goes silent, or ends on this drive.
    pub fn set_drill(&self, drive: DriveIndex, lock: Option<DrillLock>) {
        let mut pending = self.lock();
        let is_quiet = lock.as_ref().is_some_and(|lock| lock.quiet_until.is_some());
        self.has_quiet.store(is_quiet, Ordering::Release);
        pending.gate.set_drill(drive, lock);
        drop(pending);
        self.wake();
    }

    /// The drive to which a drill sends nothing but stops, and until when.
    pub fn quiet(&self, now: Instant) -> Option<(DriveIndex, Instant)> {
        if !self.has_quiet.load(Ordering::Acquire) {
            return None;
        }
        let pending = self.lock();
        let quiet = pending.gate.quiet(now);
        // The flag is set under the lock, so that a drill that starts at this moment is not missed.
        self.has_quiet.store(quiet.is_some(), Ordering::Release);
        quiet
    }
}

impl Pending {
    fn close(&mut self, outcome: Outcome, now: Instant) {
        // A lost port does not matter to stops that another bus will send.
        let keeps_stops = self.ending && outcome == Outcome::BusDown;
        self.remove(now, &outcome, |c| !keeps_stops || !c.is_stop());
        self.ending = keeps_stops;
        self.begun_stops.clear();
        self.closed = Some(outcome);
    }
}
