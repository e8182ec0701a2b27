//! The rings of all buses and the recordings in progress; also updates the trends. Pure: time is an argument, and
//! the taped data is taken from the images of the buses.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use super::budget::Budget;
use super::drives::{DriveHistory, History};
use super::line::LineHistory;
use super::packed_ring::{Packed, PackedRing};
use super::ring::{Ring, Timed};
use super::trend::Reach;
use super::trigger::{LineErrors, Trigger, TriggerKind, Watch};
use super::{Clock, RecorderOptions};
use crate::process_image::{
    BusImage, DriveImage, DriveSpec, Link, Reading, Snapshot, Taped, TapedFrame, TapedRead, Taping,
};
use drivegate_model::drive::{DriveIndex, PerDrive, Plan};

/// Further triggers that a recording notes after the first.
const MOST_TRIGGERS: usize = 32;
/// Age at which a value is still good here: a recording shows readings of any age.
const ANY_AGE: Duration = Duration::from_secs(10 * 365 * 86_400);

/// An entry for a drive, except its samples.
#[derive(Debug, Clone, PartialEq)]
pub struct Note {
    /// Time of the entry.
    pub at: Instant,
    /// Content of the note.
    pub body: NoteBody,
}

/// The content of a recorder note.
#[derive(Debug, Clone, PartialEq)]
pub enum NoteBody {
    /// An event of the drive or of its bus.
    Event {
        /// Kind of the event.
        kind: &'static str,
        text: String,
    },
    /// A completed command.
    Command {
        /// Kind of the source.
        source: &'static str,
        /// Client that gave the command.
        client: String,
        /// The command as text.
        command: String,
        /// The result code.
        result: &'static str,
        /// Time from acceptance to result.
        latency: Duration,
    },
}

impl Timed for Note {
    fn at(&self) -> Instant {
        self.at
    }

    fn size(&self) -> usize {
        size_of::<Note>()
            + match &self.body {
                NoteBody::Event { text, .. } => text.len(),
                NoteBody::Command { client, command, .. } => client.len() + command.len(),
            }
    }
}

/// An empty snapshot of a drive for its samples, including the reads made only on a fault.
pub(super) fn empty_snapshot(spec: &DriveSpec) -> Snapshot {
    let mut plan = Plan::of(&spec.profile);
    plan.reads.extend_from_slice(&plan.on_fault);
    let mut snapshot = Snapshot::empty(&plan);
    // Failed reads are not among the samples, so every value in them came from the drive.
    snapshot.link = Link::Online(std::time::SystemTime::UNIX_EPOCH);
    snapshot
}

/// Adds the values of a sample that leaves its ring to the base state.
fn leave(base: &mut Arc<Snapshot>, at: Instant, packed: &[u8]) {
    if let Some(gone) = TapedRead::unpack(at, packed) {
        Arc::make_mut(base).store(gone.table, gone.start, &gone.words, at);
    }
}

/// The reading of a drive at this time, from its recorded samples.
pub(super) fn reading<'d>(spec: &'d DriveSpec, snapshot: &Arc<Snapshot>, at: Instant) -> Reading<'d> {
    Reading::new(spec, snapshot.clone(), at, ANY_AGE, Duration::ZERO)
}

/// The data from which a recording is made.
#[derive(Debug, Clone)]
pub struct Capture {
    pub id: String,
    /// Time of day and instant that the times of the capture are calculated by.
    pub clock: Clock,
    pub bus: Arc<BusImage>,
    pub drive: Arc<DriveImage>,
    /// Trigger of the recording.
    pub trigger: Trigger,
    /// Further triggers during the recording.
    pub more: Vec<Trigger>,
    /// First and last time that the recording covers.
    pub span: (Instant, Instant),
    /// The state of the drive before the first sample.
    pub base: Arc<Snapshot>,
    /// The samples, oldest first; also from before the span.
    pub samples: Vec<TapedRead>,
    /// Events and commands, oldest first.
    pub notes: Vec<Note>,
    /// Frames of the line, oldest first.
    pub frames: Vec<TapedFrame>,
    /// Entries lost since the gateway started, because they were not taken from the tape in time.
    pub lost: u64,
}

#[derive(Debug)]
struct DriveRing {
    image: Arc<DriveImage>,
    history: Arc<DriveHistory>,
    /// Whether the drive answered when its link was last checked, and since when.
    link: Link,
    samples: PackedRing<TapedRead>,
    notes: Ring<Note>,
    /// The state before the oldest sample, and the present one.
    base: Arc<Snapshot>,
    now: Arc<Snapshot>,
    watch: Watch,
    pending: Option<Pending>,
    /// When the last recording of each kind was started.
    last: BTreeMap<TriggerKind, Instant>,
}

/// A recording in progress.
#[derive(Debug)]
struct Pending {
    id: String,
    trigger: Trigger,
    more: Vec<Trigger>,
}

#[derive(Debug)]
struct LineRing {
    bus: Arc<BusImage>,
    last_hour: Arc<Mutex<LineHistory>>,
    drives: PerDrive<DriveRing>,
    frames: PackedRing<TapedFrame>,
    /// Memory that the rings need for complete recordings.
    need: Budget,
    errors: LineErrors,
    lost: u64,
}

/// The recorder of a gateway.
#[derive(Debug)]
pub struct Recorder {
    options: RecorderOptions,
    history: Arc<History>,
    /// Age from which process data is stale.
    stale_after: Duration,
    lines: Vec<LineRing>,
}

impl Recorder {
    /// A recorder without buses, which keeps trends in `history`.
    pub fn new(options: RecorderOptions, history: Arc<History>) -> Recorder {
        Recorder {
            options,
            history,
            stale_after: Duration::from_secs(1),
            lines: Vec::new(),
        }
    }

    /// Records these buses from now on. Buses that were recorded already keep their rings; recordings of other
    /// buses end now. Process data counts as stale after `stale_after`.
    pub fn adopt(&mut self, buses: &[Arc<BusImage>], stale_after: Duration, clock: Clock) -> Vec<Capture> {
        self.stale_after = stale_after;
        let captures = self.leave_all_but(buses, clock);
        self.history.keep_only(buses);
        let profiles = buses.iter().flat_map(|bus| &bus.drives);
        let reach = Reach::of(profiles.map(|drive| &*drive.spec.profile));
        for bus in buses {
            if !self.lines.iter().any(|line| Arc::ptr_eq(bus, &line.bus)) {
                self.lines
                    .push(LineRing::new(bus, &self.options, (&self.history, reach), clock));
                bus.tape.switch(if self.options.is_on() {
                    Taping::Everything
                } else {
                    Taping::Reads
                });
            }
        }
        self.share_memory(reach);
        captures
    }

    /// Shares the total memory among the buses again, after their number has changed.
    fn share_memory(&mut self, reach: Reach) {
        let shares = Budget::shared(self.lines.iter().map(|line| line.need.clone()).collect());
        for (line, share) in self.lines.iter_mut().zip(shares) {
            line.limit(&share, reach);
        }
    }

    fn leave_all_but(&mut self, buses: &[Arc<BusImage>], clock: Clock) -> Vec<Capture> {
        let mut captures = Vec::new();
        let (kept, gone): (Vec<_>, Vec<_>) = std::mem::take(&mut self.lines)
            .into_iter()
            .partition(|line| buses.iter().any(|bus| Arc::ptr_eq(bus, &line.bus)));
        self.lines = kept;
        for mut line in gone {
            line.take_in(&self.options, self.stale_after, clock);
            line.bus.tape.switch(Taping::Off);
            captures.extend(line.ended(&self.options, clock, true));
        }
        captures
    }

    /// Notes an event of a drive, or of a whole bus.
    pub fn note(&mut self, bus: &str, drive: Option<&str>, note: &Note) {
        let lines = self.lines.iter_mut().filter(|line| line.bus.spec.name == bus);
        let drives = lines.flat_map(|line| &mut line.drives);
        for ring in drives.filter(|ring| drive.is_none_or(|name| ring.image.spec.name == name)) {
            ring.notes.push(note.clone(), drop);
        }
    }

    pub fn drive(&self, name: &str) -> Option<(Arc<BusImage>, Arc<DriveImage>)> {
        self.lines.iter().find_map(|line| {
            let ring = line.drives.iter().find(|ring| ring.image.spec.name == name)?;
            Some((line.bus.clone(), ring.image.clone()))
        })
    }

    /// Starts a recording of a drive, or adds the trigger to the recording in progress. Returns its id; `None` if
    /// the drive is unknown, or had a trigger of the same kind very recently.
    pub fn trigger(&mut self, drive: &str, trigger: Trigger, clock: Clock) -> Option<String> {
        let mut drives = self.lines.iter_mut().flat_map(|line| &mut line.drives);
        drives
            .find(|ring| ring.image.spec.name == drive)?
            .trigger(trigger, clock)
    }

    /// Takes the entries from the tapes of the buses; returns the recordings that are complete at `clock.now`.
    pub fn tick(&mut self, clock: Clock) -> Vec<Capture> {
        let mut captures = Vec::new();
        for line in &mut self.lines {
            line.take_in(&self.options, self.stale_after, clock);
            captures.extend(line.ended(&self.options, clock, false));
        }
        captures
    }

    /// Ends all recordings now; the tapes stop.
    pub fn end(&mut self, clock: Clock) -> Vec<Capture> {
        let captures = self.tick(clock);
        captures.into_iter().chain(self.leave_all_but(&[], clock)).collect()
    }
}

impl LineRing {
    /// Rings without memory, which [`LineRing::limit`] gives their share.
    fn new(
        bus: &Arc<BusImage>,
        options: &RecorderOptions,
        (history, reach): (&History, Reach),
        clock: Clock,
    ) -> LineRing {
        let specs: Vec<DriveSpec> = bus.drives.iter().map(|drive| drive.spec.clone()).collect();
        let window = options.window();
        let ring = |image: &Arc<DriveImage>| {
            let base = Arc::new(empty_snapshot(&image.spec));
            DriveRing {
                image: image.clone(),
                history: history.of(&image.spec, reach, clock),
                link: image.snapshot().link,
                samples: PackedRing::new(0, window),
                notes: Ring::new(0, window),
                now: base.clone(),
                base,
                watch: Watch::default(),
                pending: None,
                last: BTreeMap::new(),
            }
        };
        LineRing {
            drives: bus.drives.iter().map(ring).collect(),
            frames: PackedRing::new(0, window),
            need: Budget::of(&bus.spec, &specs, options),
            errors: LineErrors::default(),
            lost: 0,
            last_hour: history.of_line(bus, clock),
            bus: bus.clone(),
        }
    }

    /// Sets the memory that the rings may take to `share`, and how far trends reach back to `reach`.
    fn limit(&mut self, share: &Budget, reach: Reach) {
        self.frames.limit(share.frames, |_, _| ());
        for (drive, samples) in self.drives.iter_mut().zip(&share.samples) {
            drive.notes.limit(share.notes);
            let base = &mut drive.base;
            drive.samples.limit(*samples, |at, packed| leave(base, at, packed));
            drive.history.trend().set_reach(reach);
        }
    }

    fn take_in(&mut self, options: &RecorderOptions, stale_after: Duration, clock: Clock) {
        let (entries, lost) = self.bus.tape.take();
        self.lost += lost;
        let mut last_hour = self.last_hour.lock().unwrap_or_else(PoisonError::into_inner);
        last_hour.sample_if_due(&self.bus, clock.now);
        drop(last_hour);
        for entry in entries {
            match entry {
                Taped::Read(index, read) => {
                    if let Some(drive) = self.drives.get_mut(index)
                        && let Some(trigger) = drive.read(read, options, stale_after, clock)
                    {
                        drive.trigger(trigger, clock);
                    }
                }
                Taped::Frame(frame) => {
                    let failed = frame.drive.filter(|_| frame.verdict.is_error());
                    let burst = failed.filter(|drive| self.answers(*drive));
                    let burst = burst.and_then(|drive| self.errors.note(frame.at, drive));
                    self.frames.push(&frame, |_, _| ());
                    if let Some((drive, trigger)) = burst
                        && let Some(drive) = self.drives.get_mut(drive)
                    {
                        drive.trigger(trigger, clock);
                    }
                }
            }
        }
        self.drives.iter_mut().for_each(DriveRing::check_link);
    }

    fn answers(&self, drive: DriveIndex) -> bool {
        let ring = self.drives.get(drive);
        ring.is_some_and(|ring| ring.image.snapshot().link.is_online())
    }

    /// Takes out the recordings that are complete, or with `all` every recording.
    fn ended(&mut self, options: &RecorderOptions, clock: Clock, all: bool) -> Vec<Capture> {
        let mut captures = Vec::new();
        for ring in &mut self.drives {
            let complete = |pending: &mut Pending| all || clock.now > pending.trigger.at + options.after;
            let Some(Pending { id, trigger, more }) = ring.pending.take_if(complete) else {
                continue;
            };
            let from = trigger.at.checked_sub(options.before).unwrap_or(trigger.at);
            let to = (trigger.at + options.after).min(clock.now);
            let within = |at: Instant| at >= from && at <= to;
            captures.push(Capture {
                id,
                clock,
                bus: self.bus.clone(),
                drive: ring.image.clone(),
                trigger,
                more,
                span: (from, to),
                base: ring.base.clone(),
                samples: ring.samples.iter().filter(|sample| sample.at <= to).collect(),
                notes: ring.notes.iter().filter(|note| within(note.at)).cloned().collect(),
                frames: self.frames.iter().filter(|frame| within(frame.at)).collect(),
                lost: self.lost,
            });
        }
        captures
    }
}

impl DriveRing {
    /// Handles drives that went offline. Must be called after all earlier readings were taken in.
    fn check_link(&mut self) {
        let link = self.image.snapshot().link;
        let before = std::mem::replace(&mut self.link, link);
        if before.is_online() && before != link {
            self.history.interrupt();
        }
    }

    fn read(
        &mut self,
        read: TapedRead,
        options: &RecorderOptions,
        stale_after: Duration,
        clock: Clock,
    ) -> Option<Trigger> {
        let at = read.at;
        Arc::make_mut(&mut self.now).store(read.table, read.start, &read.words, at);
        let known = self.image.reading(clock.now, stale_after);
        for of in [&mut self.now, &mut self.base] {
            if of.monitored != known.snapshot.monitored {
                Arc::make_mut(of).monitored = known.snapshot.monitored.clone();
            }
        }
        let reading = reading(&self.image.spec, &self.now, at);
        self.history.read(&read, &reading, &known);
        if !options.is_on() {
            return None;
        }
        let base = &mut self.base;
        self.samples.push(&read, |at, packed| leave(base, at, packed));
        self.watch.check(&reading, at, options.warnings)
    }

    fn trigger(&mut self, trigger: Trigger, clock: Clock) -> Option<String> {
        if let Some(pending) = &mut self.pending {
            if pending.more.len() < MOST_TRIGGERS {
                pending.more.push(trigger);
            }
            return Some(pending.id.clone());
        }
        // A drive that never answered cannot be lost.
        if trigger.kind == TriggerKind::Lost && self.samples.is_empty() {
            return None;
        }
        let pause = trigger.kind.pause();
        let last = self.last.get(&trigger.kind);
        if last.is_some_and(|last| trigger.at.saturating_duration_since(*last) < pause) {
            return None;
        }
        self.last.insert(trigger.kind, trigger.at);
        let time = humantime::format_rfc3339_millis(clock.wall_at(trigger.at)).to_string();
        let time: String = time.chars().filter(|c| !matches!(c, '-' | ':')).collect();
        let id = format!("{time}-{}", self.image.spec.name);
        self.pending = Some(Pending {
            id: id.clone(),
            trigger,
            more: Vec::new(),
        });
        Some(id)
    }
}
