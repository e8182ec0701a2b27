//! The running recorder: one thread takes the tapes of the buses, for recordings and trends, and one writes files. A
//! slow disk delays neither the buses nor the rings.

use std::collections::{BTreeMap, VecDeque};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, SyncSender, TrySendError, channel, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, SystemTime};

use tokio::sync::broadcast::error::TryRecvError;
use tokio::sync::{broadcast, oneshot};

use super::assemble::assemble;
use super::recorder::{Capture, Note, NoteBody, Recorder};
use super::store::{self, Entry, ReadError, Store};
use super::trigger::{Trigger, TriggerKind, is_refused_stop};
use super::{Clock, History, RecorderOptions, Recording};
use crate::event::{Event, EventKind, Events, RecordingMade};
use crate::order::{AuditRecord, CommandLog};
use crate::process_image::BusImage;

/// Interval at which the tapes of the buses are taken.
const TICK: Duration = Duration::from_millis(100);
/// Recordings that wait for the disk at most.
const WAITING: usize = 64;
/// Recordings that are kept in memory while the disk refuses them, at most.
const REFUSED: usize = 4;
/// Interval at which a refused recording is written again.
const AGAIN: Duration = Duration::from_secs(10);
/// Characters of a text of a client that are kept.
const MOST_TEXT: usize = 300;

/// Why a recording was not started.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NotRecorded {
    /// The recorder is off.
    #[error("the recorder is off (max_count of [recordings] is 0)")]
    Off,
    /// There is no drive with this name.
    #[error("there is no drive `{0}`")]
    UnknownDrive(String),
}

enum Control {
    Buses(Vec<Arc<BusImage>>, Duration),
    Record(String, String, oneshot::Sender<Option<String>>),
    Stop,
}

/// The recordings, as the servers of the gateway use them.
#[derive(Debug, Default)]
pub struct Recordings {
    shared: Mutex<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    /// Number of recorders that were started.
    recorder: u64,
    options: Option<RecorderOptions>,
    control: Option<Sender<Control>>,
    entries: Vec<Arc<Entry>>,
    made: BTreeMap<TriggerKind, u64>,
}

impl Recordings {
    fn shared(&self) -> std::sync::MutexGuard<'_, Shared> {
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The recordings on disk, oldest first.
    pub fn list(&self) -> Vec<Arc<Entry>> {
        self.shared().entries.clone()
    }

    /// Time before and after the trigger that a recording has; zero while the recorder is off.
    pub fn span(&self) -> (Duration, Duration) {
        let shared = self.shared();
        shared
            .options
            .as_ref()
            .map_or_else(Default::default, |options| (options.before, options.after))
    }

    /// Recordings made since the gateway started, by trigger.
    pub fn made(&self) -> BTreeMap<TriggerKind, u64> {
        self.shared().made.clone()
    }

    /// Reads a recording; `None` if the id is unknown. Blocks while the disk is read.
    ///
    /// # Errors
    /// If the file of the recording cannot be read.
    pub fn read(&self, id: &str) -> Option<Result<Recording, ReadError>> {
        let path = {
            let shared = self.shared();
            let known = shared.entries.iter().any(|entry| entry.id == id);
            shared
                .options
                .as_ref()
                .filter(|_| known)
                .map(|options| store::path_of(&options.dir, id))
        };
        path.map(|path| store::read(&path))
    }

    /// Starts a recording of a drive, requested by `who`. Returns its id and the time after which the recording is
    /// complete.
    ///
    /// # Errors
    /// If the recorder is off, or no drive has this name.
    pub async fn record(&self, drive: &str, who: &str) -> Result<(String, Duration), NotRecorded> {
        let (reply, begun) = oneshot::channel();
        let after = {
            let shared = self.shared();
            let (Some(control), Some(options)) = (&shared.control, &shared.options) else {
                return Err(NotRecorded::Off);
            };
            // A recorder that has ended drops the reply.
            let _ = control.send(Control::Record(drive.to_string(), who.to_string(), reply));
            options.after
        };
        match begun.await {
            Ok(Some(id)) => Ok((id, after)),
            Ok(None) => Err(NotRecorded::UnknownDrive(drive.to_string())),
            Err(_) => Err(NotRecorded::Off),
        }
    }
}

/// The recorder of a gateway, at work; without recordings for trends only.
#[derive(Debug)]
pub struct RecorderTask {
    recordings: Arc<Recordings>,
    number: u64,
    control: Sender<Control>,
    threads: Vec<JoinHandle<()>>,
}

impl RecorderTask {
    /// Starts the threads. Nothing is recorded before [`RecorderTask::adopt`]. The channel closes when the
    /// recordings on disk are known.
    ///
    /// # Errors
    /// If the system cannot create a thread.
    pub fn start(
        options: RecorderOptions,
        recordings: Arc<Recordings>,
        history: Arc<History>,
        events: Events,
        command_log: &Arc<CommandLog>,
    ) -> std::io::Result<(RecorderTask, oneshot::Receiver<()>)> {
        let (control, orders) = channel();
        let (captures, waiting) = sync_channel(WAITING);
        let (opening, opened) = oneshot::channel();
        let number = {
            let mut shared = recordings.shared();
            shared.recorder += 1;
            shared.entries = Vec::new();
            shared.control = Some(control.clone());
            shared.options = Some(options.clone()).filter(RecorderOptions::is_on);
            shared.recorder
        };
        // Without recordings the directory is not touched.
        let writer = options.is_on().then(|| {
            let (options, recordings, events) = (options.clone(), recordings.clone(), events.clone());
            move || {
                let writer = Writer {
                    store: Store::open(&options),
                    recordings,
                    number,
                    events,
                    refused: VecDeque::new(),
                    failing: false,
                };
                writer.show(|_| {});
                drop(opening);
                writer.run(&waiting);
            }
        });
        let taker = Taker {
            recorder: Recorder::new(options, history),
            events: events.clone(),
            heard: events.subscribe(),
            commands: command_log.audit().subscribe(),
            captures,
            left_out: 0,
        };
        let thread = |name: &str| std::thread::Builder::new().name(name.to_string());
        let writer = writer.map(|writer| thread("recordings").spawn(writer));
        let writer = writer.transpose()?;
        let taker = thread("recorder").spawn(move || taker.run(&orders))?;
        let task = RecorderTask {
            recordings,
            number,
            control,
            threads: [taker].into_iter().chain(writer).collect(),
        };
        Ok((task, opened))
    }

    /// Records these buses from now on; process data is stale from `stale_after` on.
    pub fn adopt(&self, buses: Vec<Arc<BusImage>>, stale_after: Duration) {
        // The thread only ends when this is stopped.
        let _ = self.control.send(Control::Buses(buses, stale_after));
    }

    /// Ends the recordings in progress, and waits until they are on disk.
    pub fn stop(self) {
        let _ = self.control.send(Control::Stop);
        for thread in self.threads {
            if thread.join().is_err() {
                tracing::error!(target: "drivegate::history", "a thread of the recorder panicked; report this");
            }
        }
        let mut shared = self.recordings.shared();
        // Another recorder may have taken over while the disk delayed this one.
        if shared.recorder == self.number {
            (shared.control, shared.options) = (None, None);
        }
    }
}

/// The thread that takes the entries from the tapes of the buses.
struct Taker {
    recorder: Recorder,
    events: Events,
    heard: broadcast::Receiver<Arc<Event>>,
    commands: broadcast::Receiver<Arc<AuditRecord>>,
    captures: SyncSender<Capture>,
    /// Recordings that the writer had no room for, since the last report.
    left_out: u64,
}

impl Taker {
    fn run(mut self, orders: &Receiver<Control>) {
        loop {
            let order = orders.recv_timeout(TICK);
            let clock = Clock::read();
            // Notes are taken first, since entries taped before an order must precede it.
            self.take_notes(clock);
            let mut captures = self.recorder.tick(clock);
            match order {
                Ok(Control::Buses(buses, stale_after)) => {
                    captures.extend(self.recorder.adopt(&buses, stale_after, clock));
                }
                Ok(Control::Record(drive, who, reply)) => {
                    let trigger = Trigger {
                        kind: TriggerKind::Command,
                        at: clock.now,
                        text: format!("requested by {who}"),
                    };
                    // The client may have disconnected, so an error is ignored.
                    let _ = reply.send(self.recorder.trigger(&drive, trigger, clock));
                }
                Ok(Control::Stop) | Err(RecvTimeoutError::Disconnected) => {
                    for capture in self.recorder.end(clock) {
                        // The writer ends after the thread that takes the tapes.
                        let _ = self.captures.send(capture);
                    }
                    return;
                }
                Err(RecvTimeoutError::Timeout) => {}
            }
            for capture in captures {
                self.hand_over(capture);
            }
            self.report_left_out();
        }
    }

    fn hand_over(&mut self, capture: Capture) {
        if let Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) = self.captures.try_send(capture) {
            self.left_out += 1;
        }
    }

    fn report_left_out(&mut self) {
        let lost = std::mem::take(&mut self.left_out);
        if lost > 0 {
            let text = format!("{lost} recordings are lost: {WAITING} are waiting for the disk, which is too slow");
            publish(&self.events, String::new(), None, text, None);
        }
    }

    /// Events and commands since the last time.
    fn take_notes(&mut self, clock: Clock) {
        loop {
            match self.heard.try_recv() {
                Ok(event) => self.event(&event, clock),
                Err(TryRecvError::Lagged(_)) => {}
                Err(TryRecvError::Empty | TryRecvError::Closed) => break,
            }
        }
        loop {
            match self.commands.try_recv() {
                Ok(record) => self.command(&record, clock),
                Err(TryRecvError::Lagged(_)) => {}
                Err(TryRecvError::Empty | TryRecvError::Closed) => break,
            }
        }
    }

    fn event(&mut self, event: &Event, clock: Clock) {
        if event.kind == EventKind::Recording {
            return;
        }
        let at = clock.instant_at(event.time).min(clock.now);
        let body = NoteBody::Event {
            kind: event.kind.name(),
            text: shortened(&event.text),
        };
        self.recorder
            .note(&event.bus, event.drive.as_deref(), &Note { at, body });
        if let (Some(kind), Some(drive)) = (TriggerKind::of_event(event.kind), &event.drive) {
            let text = shortened(&event.text);
            self.recorder.trigger(drive, Trigger { kind, at, text }, clock);
        }
    }

    fn command(&mut self, record: &AuditRecord, clock: Clock) {
        let Some((bus, _)) = self.recorder.drive(&record.drive) else {
            return;
        };
        let at = clock.instant_at(record.time).min(clock.now);
        let body = NoteBody::Command {
            source: record.source,
            client: shortened(&record.client),
            command: shortened(&record.command),
            result: record.result,
            latency: record.latency,
        };
        self.recorder
            .note(&bus.spec.name, Some(&record.drive), &Note { at, body });
        if is_refused_stop(record) {
            let text = format!(
                "a stop from {} {} failed: {}",
                record.source, record.client, record.text
            );
            let trigger = Trigger {
                kind: TriggerKind::RefusedStop,
                at,
                text: shortened(&text),
            };
            self.recorder.trigger(&record.drive, trigger, clock);
        }
    }
}

fn shortened(text: &str) -> String {
    let end = text.char_indices().nth(MOST_TEXT).map_or(text.len(), |(end, _)| end);
    text.get(..end).unwrap_or_default().to_string()
}

/// The thread that writes recordings to disk.
struct Writer {
    store: Store,
    recordings: Arc<Recordings>,
    /// Number of the recorder, which changes with each reload.
    number: u64,
    events: Events,
    /// Recordings that the disk refused, oldest first.
    refused: VecDeque<Recording>,
    /// The disk refused the last one, which was reported.
    failing: bool,
}

impl Writer {
    /// Lists the recordings of the store, unless another recorder is at work since.
    fn show(&self, and: impl FnOnce(&mut Shared)) {
        let mut shared = self.recordings.shared();
        if shared.recorder == self.number {
            shared.entries = self.store.entries().to_vec();
            and(&mut shared);
        }
    }

    fn run(mut self, waiting: &Receiver<Capture>) {
        loop {
            let next = if self.refused.is_empty() {
                waiting.recv().map_err(|_| RecvTimeoutError::Disconnected)
            } else {
                waiting.recv_timeout(AGAIN)
            };
            match next {
                Ok(capture) => self.take(assemble(&capture)),
                Err(RecvTimeoutError::Timeout) => self.write_refused(),
                Err(RecvTimeoutError::Disconnected) => return self.write_refused(),
            }
        }
    }

    /// Writes a recording after those that the disk refused before.
    fn take(&mut self, recording: Recording) {
        self.write_refused();
        let is_first = self.refused.is_empty();
        if self.refused.len() >= REFUSED {
            let text = format!("{REFUSED} recordings wait for the disk");
            self.lost(&recording, &text);
            return;
        }
        self.refused.push_back(recording);
        if is_first {
            self.write_refused();
        }
    }

    /// Writes the recordings that wait, until the disk refuses one.
    fn write_refused(&mut self) {
        while let Some(mut recording) = self.refused.pop_front() {
            let error = match self.store.write(&mut recording, SystemTime::now()) {
                Ok(entry) => {
                    self.failing = false;
                    self.written(&recording, &entry);
                    continue;
                }
                Err(error) => error,
            };
            if error.kind() == std::io::ErrorKind::FileTooLarge {
                self.lost(&recording, &error.to_string());
                continue;
            }
            if !std::mem::replace(&mut self.failing, true) {
                let header = &recording.header;
                let text = format!(
                    "cannot write the recording of {}, {}: {error}; it is written as soon as there is space and \
                     permission, as are {REFUSED} at most; everything else continues",
                    header.drive.name,
                    store::path_of(self.store.dir(), &header.id).display()
                );
                self.publish(&recording, text, None);
            }
            self.refused.push_front(recording);
            return;
        }
    }

    fn written(&self, recording: &Recording, entry: &Entry) {
        self.show(|shared| *shared.made.entry(entry.trigger).or_default() += 1);
        let text = if entry.trigger.has_event() {
            format!("recording {}", entry.id)
        } else {
            format!("recording {}: {}", entry.id, entry.summary)
        };
        let made = RecordingMade {
            id: entry.id.clone(),
            trigger: entry.trigger.name().into(),
            summary: entry.summary.clone(),
        };
        self.publish(recording, text, Some(made));
    }

    fn lost(&self, recording: &Recording, why: &str) {
        let text = format!("the recording of {} is lost: {why}", recording.header.drive.name);
        self.publish(recording, text, None);
    }

    fn publish(&self, recording: &Recording, text: String, made: Option<RecordingMade>) {
        let header = &recording.header;
        let (bus, drive) = (header.bus.name.clone(), header.drive.name.clone());
        publish(&self.events, bus, Some(drive), text, made);
    }
}

fn publish(events: &Events, bus: String, drive: Option<String>, text: String, recording: Option<RecordingMade>) {
    events.publish(Event {
        bus,
        drive,
        recording,
        ..Event::new(EventKind::Recording, SystemTime::now(), text)
    });
}
