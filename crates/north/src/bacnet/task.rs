//! Moves datagrams between the sockets and the desk, and waits for drives; saves state for a restart, has the BBMD looked up.

use std::collections::{BTreeSet, HashMap};
use std::future::Future;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::Poll;
use std::time::{Duration, Instant, SystemTime};

use futures_util::StreamExt as _;
use futures_util::stream::FuturesUnordered;
use tokio::net::UdpSocket;
use tokio::sync::{Notify, mpsc, oneshot};
use tokio::time::{MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;

use super::bbmd::{self, Lookups};
use super::desk::{Desk, Ended};
use super::kept::{self, KeptFile, KeptSlots};
use super::rights::HostRights;
use super::sockets::{Outbox, Sockets};
use super::writes::Waiting;
use super::{NorthState, Options};
use crate::reading::{Reader, is_readable};
use crate::state_file::{self, LATE};
use crate::stats::BacnetFigures;
use drivegate_core::event::{Event, EventKind};
use drivegate_core::files::State as _;
use drivegate_core::files::names::BACNET_PRIORITIES;
use drivegate_core::order::Commanded;
use drivegate_core::plant::{DriveHandle, Plant, SharedPlant};
use drivegate_core::process_image::{Machine, Snapshot};
use drivegate_model::drive::ModelPoint;

/// Interval at which the task checks for due work.
const TICK: Duration = Duration::from_millis(100);
/// Shortest interval between reports of changes.
const LOOK: Duration = Duration::from_millis(5);
/// Datagrams that are taken up before anything else is.
const BATCH: usize = 64;
/// Longest wait for requests in progress at the end.
const LAST_ANSWERS: Duration = Duration::from_millis(1500);

/// A message from the server to its task.
#[derive(Debug)]
pub(super) enum ToTask {
    /// Use other sockets if the address has changed, another BBMD and another file of slots; clients see other options
    /// with the plant of the same reload.
    Apply(Box<Options>, Option<Sockets>),
    /// Accept no further requests.
    Retire,
}

type Ending = Pin<Box<dyn Future<Output = Ended> + Send>>;

/// The slots from before the start, once their file is read.
type SlotsRead = oneshot::Receiver<KeptSlots>;

pub(super) struct Task {
    options: Arc<Options>,
    sockets: Sockets,
    outbox: Outbox,
    /// Readers of the sockets: for this host, and for all.
    readers: [Reader; 3],
    stats: Arc<NorthState>,
    busy: Arc<AtomicBool>,
    desk: Desk,
    writes: FuturesUnordered<Ending>,
    /// Woken by every update of a drive of `watched`.
    news: Arc<Notify>,
    watched: Arc<Plant>,
    /// The last snapshot of each drive with subscriptions.
    seen: HashMap<u32, Arc<Snapshot>>,
    kept: KeptFile,
    /// The slots from before the start while they are read, with the path of their file.
    reading: Option<(PathBuf, SlotsRead)>,
    /// Drives with a slot from before the restart against which the motor may run.
    protected: BTreeSet<Machine>,
    lookups: Lookups,
    retired: bool,
}

impl Task {
    pub(super) fn new(
        options: Options,
        sockets: Sockets,
        rights: HostRights,
        plant: SharedPlant,
        stats: Arc<NorthState>,
        busy: Arc<AtomicBool>,
    ) -> Task {
        let options = Arc::new(options);
        let desk = Desk::new(options.clone(), rights, plant, sockets.place(), Instant::now());
        Task {
            options,
            sockets,
            outbox: Outbox::default(),
            readers: [waiting_reader(), waiting_reader(), waiting_reader()],
            stats,
            busy,
            writes: FuturesUnordered::new(),
            news: Arc::default(),
            watched: desk.view.plant.clone(),
            desk,
            seen: HashMap::new(),
            kept: KeptFile::new(KeptSlots::WORDS),
            reading: None,
            protected: BTreeSet::new(),
            lookups: Lookups::default(),
            retired: false,
        }
    }

    pub(super) async fn run(mut self, mut orders: mpsc::UnboundedReceiver<ToTask>, cancel: CancellationToken) {
        self.load().await;
        self.hear_drives();
        self.desk.start(Instant::now());
        let mut ticks = interval(TICK);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut buffer = vec![0; 2048];
        let (mut next_look, mut due) = (Instant::now(), false);
        loop {
            self.flush();
            let subscribed = self.stats.bacnet.get().is_some_and(|f| f.counters.subscriptions > 0);
            let (waits, unsent) = (!self.writes.is_empty(), self.outbox.is_waiting());
            tokio::select! {
                () = cancel.cancelled() => break,
                order = orders.recv() => match order {
                    Some(order) => self.apply(order),
                    None => break,
                },
                _ = ticks.tick() => self.tick(),
                ready = self.sockets.unicast.readable(), if !self.retired => {
                    if ready.is_ok() {
                        self.take(&mut buffer, None);
                    }
                }
                // The next turn goes on sending.
                _ = self.sockets.unicast.writable(), if unsent => {}
                place = broadcast_received(&self.sockets.broadcasts), if !self.retired => self.take(&mut buffer, Some(place)),
                Some(ended) = self.writes.next(), if waits => self.desk.ended(&ended, Instant::now()),
                () = self.news.notified(), if subscribed && !due => due = true,
                () = tokio::time::sleep_until(next_look.into()), if due => {
                    self.report_changes();
                    (next_look, due) = (Instant::now() + LOOK, false);
                }
            }
            self.take_up_jobs();
            self.watch_plant();
        }
        self.answer_what_was_begun().await;
        // A file that was not read is not overwritten.
        match self.reading.take() {
            Some(_) => self.stats.awaited.slots.end(),
            None => {
                let (path, plant) = (self.keep_file(), self.desk.newest_plant());
                kept::finish(&mut self.kept, path, &plant).await;
            }
        }
        self.stats.bacnet.set(None);
    }

    /// Anyone who waits for a drive is answered, as long as the gateway waits. The next write of a request follows as ever: the
    /// queues still take its stops and refuse everything else.
    async fn answer_what_was_begun(&mut self) {
        let until = tokio::time::Instant::now() + LAST_ANSWERS;
        while let Ok(Some(ended)) = tokio::time::timeout_at(until, self.writes.next()).await {
            self.desk.ended(&ended, Instant::now());
            self.take_up_jobs();
            self.flush();
        }
    }

    /// Reads and processes received datagrams.
    fn take(&mut self, buffer: &mut [u8], broadcast: Option<usize>) {
        let now = Instant::now();
        let [unicast, of_network, of_all] = &self.readers;
        for place in 0..BATCH {
            let (socket, reader) = match broadcast.map(|place| (place, self.sockets.broadcasts.get(place))) {
                Some((0, Some(socket))) => (socket, of_network),
                Some((_, Some(socket))) => (socket, of_all),
                _ => (&self.sockets.unicast, unicast),
            };
            let Ok((length, SocketAddr::V4(from))) = socket.try_recv_from(buffer) else {
                reader.nothing(Instant::now(), || is_readable(socket));
                return;
            };
            if place == 0 {
                reader.note_read(now, false, || false);
                self.desk.received(reader.last(), now);
            }
            if let Some(datagram) = buffer.get(..length) {
                self.desk.receive(from, datagram, now);
            }
        }
    }

    /// Sends pending datagrams, as many as the system accepts now.
    fn flush(&mut self) {
        let (server, sockets) = (&mut self.desk.server, &self.sockets);
        self.outbox
            .flush(|| server.transmit(), |to, datagram| sockets.send(to, datagram));
    }

    /// Passes writes to the drives.
    fn take_up_jobs(&mut self) {
        while let Some((token, waiting)) = self.desk.next_order(Instant::now()) {
            self.writes.push(Box::pin(ending(token, waiting)));
        }
        self.busy.store(!self.writes.is_empty(), Ordering::Relaxed);
    }

    fn tick(&mut self) {
        let now = Instant::now();
        self.desk.poll(now);
        self.watch_kept();
        self.stats.bacnet.set(Some(BacnetFigures {
            counters: self.desk.server.counters(),
            bbmd: self
                .options
                .bbmd
                .as_ref()
                .map(|(host, port)| (format!("{host}:{port}"), self.desk.server.registration())),
        }));
        self.find_bbmd(now);
        self.take_up_kept();
        if self.reading.is_none() {
            let path = self.keep_file();
            kept::keep(&mut self.kept, path, &self.desk.view.plant, now);
        }
    }

    /// Waits for updates of the drives that clients see now.
    fn watch_plant(&mut self) {
        if !Arc::ptr_eq(&self.watched, &self.desk.view.plant) {
            self.watched = self.desk.view.plant.clone();
            self.seen.clear();
            self.hear_drives();
        }
    }

    fn hear_drives(&self) {
        for drive in self.desk.view.drives.values() {
            drive.handle.image.notify(&self.news);
        }
    }

    /// Reports changes of drives with subscriptions.
    fn report_changes(&mut self) {
        let now = Instant::now();
        let subscribed = self.desk.server.subscribed();
        let mut changed = BTreeSet::new();
        for (drive, shown) in &self.desk.view.drives {
            let device = self.desk.view.shown_by(*drive);
            let snapshot = shown.handle.image.snapshot();
            let same = self.seen.get(drive).is_some_and(|seen| Arc::ptr_eq(seen, &snapshot));
            if !same && subscribed.contains(&device) {
                self.seen.insert(*drive, snapshot);
                changed.insert(device);
            }
        }
        for device in changed {
            self.desk.changed(device, now);
        }
    }

    /// File in which slots are saved; `None` if they are not saved, or if a reload removes the server and makes the
    /// file useless.
    fn keep_file(&self) -> Option<std::path::PathBuf> {
        let keeps = self.options.keep_priorities && self.desk.view.rights.options().is_some();
        keeps.then(|| self.options.state_dir.join(BACNET_PRIORITIES))
    }

    /// Loads the slots saved before the start; a disk that hangs is not waited for. A server that a reload starts
    /// loads none: they were void before.
    async fn load(&mut self) {
        let Some(path) = self.keep_file() else {
            self.stats.awaited.slots.end();
            return;
        };
        if self.stats.kept_slots_read.swap(true, Ordering::Relaxed) {
            return;
        }
        let (taken, reading) = oneshot::channel();
        let found = state_file::read::<KeptSlots>(path.clone());
        let read = async move {
            // A thread that panicked has logged that, and the file stays unread. A server that has ended takes nothing up.
            let _ = found.await.map(|found| taken.send(found.unwrap_or_default()));
        };
        if self.stats.patience.wait(read).await.is_none() {
            KeptSlots::WORDS.not_read(&path, &LATE);
        }
        self.reading = Some((path, reading));
        self.take_up_kept();
    }

    /// Restores the slots from before the start once their file is read.
    fn take_up_kept(&mut self) {
        let Some(slots) = self.reading.as_mut().and_then(|(_, reading)| reading.try_recv().ok()) else {
            return;
        };
        let Some((path, _)) = self.reading.take() else { return };
        let view = &self.desk.view;
        if self.keep_file().is_some() {
            kept::restore(&view.plant, &view.rights, &slots, Instant::now(), SystemTime::now());
        }
        self.kept.holds(Some((path, slots)));
        let drives = view.drives.values().map(|drive| &drive.handle);
        let protected = drives.filter(|drive| drive.priorities(|all| all.kept().next().is_some()));
        self.protected = protected.map(DriveHandle::machine).collect();
        self.stats.awaited.slots.end();
    }

    /// Raises an event if a motor runs against a slot from before the restart.
    fn watch_kept(&mut self) {
        let plant = &self.desk.view.plant;
        self.protected.retain(|machine| {
            let Some(drive) = plant.drive_at(machine) else {
                return false;
            };
            let now = Instant::now();
            let Some(running) = drive.reading(now).model(ModelPoint::Running).good() else {
                return true;
            };
            let slot = drive.priorities(|all| {
                let governs = all.governing(Commanded::Run)?;
                Some((governs.1, governs.2.origin.who.clone()))
            });
            if let (true, Some((priority, who))) = (running.as_bool(), slot) {
                let spec = &drive.image.spec;
                let text = format!(
                    "drive {} runs, and BACnet client {who} has held `run` inactive at priority {priority} since \
                     before the restart; nothing was written; stop the drive, or release the slot",
                    spec.name
                );
                drive.publish(Event {
                    bus: spec.bus.clone(),
                    drive: Some(spec.name.clone()),
                    ..Event::new(EventKind::ForeignCommand, SystemTime::now(), text)
                });
            }
            false
        });
    }

    fn apply(&mut self, order: ToTask) {
        match order {
            ToTask::Retire => self.retired = true,
            ToTask::Apply(options, sockets) => {
                let now = Instant::now();
                let same_bbmd = self.options.bbmd == options.bbmd;
                self.options = Arc::from(options);
                if let Some(sockets) = sockets {
                    self.sockets = sockets;
                    self.readers = [waiting_reader(), waiting_reader(), waiting_reader()];
                    self.desk.move_to(self.sockets.place(), now);
                }
                if !same_bbmd {
                    self.desk.server.set_bbmd(None, now);
                    self.lookups = Lookups::default();
                }
            }
        }
    }

    /// Looks up the address of the BBMD until one answers there.
    fn find_bbmd(&mut self, now: Instant) {
        let Some((host, port)) = self.options.bbmd.clone() else {
            return;
        };
        let server = &mut self.desk.server;
        let look_up = || tokio::spawn(bbmd::look_up(host.clone(), port));
        self.lookups.begin(server.registration(), now, look_up);
        match self.lookups.ended() {
            Some(Some(address)) if server.bbmd() != Some(address) => server.set_bbmd(Some(address), now),
            Some(Some(_)) | None => {}
            Some(None) => tracing::warn!(
                target: "drivegate::bacnet", "cannot find the BBMD {host}:{port}; retrying every 30 s; check `bbmd` \
                                              of [bacnet]"
            ),
        }
    }
}

async fn ending(token: u64, mut waiting: Waiting) -> Ended {
    let outcome = waiting.placed.answered().await.outcome;
    Ended::of(token, waiting, outcome)
}

/// The reader of a new socket, for bytes that arrive from now on.
fn waiting_reader() -> Reader {
    let reader = Reader::here();
    reader.nothing(Instant::now(), || false);
    reader
}

/// Waits for a broadcast; returns the index of the socket that received one.
async fn broadcast_received(sockets: &[UdpSocket]) -> usize {
    std::future::poll_fn(|cx| {
        // Any error of the socket is reported when the socket is read.
        let ready = sockets.iter().position(|socket| socket.poll_recv_ready(cx).is_ready());
        ready.map_or(Poll::Pending, Poll::Ready)
    })
    .await
}
