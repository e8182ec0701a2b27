//! Decides when a topic is published: on change, but not before `min_interval`, and at the latest after `max_interval`.
//! Time is an argument.
//!
//! A drive is checked when its image was updated, when a postponed change may be published, and four times a second
//! for values that change by themselves (age).

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use tokio::sync::Notify;

use super::Telemetry;
use super::connection::PACKET_OVERHEAD;
use super::history::Recorder;
use super::payload::{self, BusFigures, BusState, PointPayload, StateContent, StateObject};
use super::rounds::{self, LOOK};
use super::topics::Topics;
use drivegate_core::plant::{BusHandle, DriveHandle, Plant};
use drivegate_core::process_image::{Reading, Snapshot};
use drivegate_model::drive::{ModelPoint, PointIndex};

/// Minimum time between publications because counters or load of a bus changed, which they do all the time.
const FIGURES_INTERVAL: Duration = Duration::from_secs(1);

/// A retained message to be published.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Update {
    pub(super) topic: Arc<str>,
    pub(super) payload: Vec<u8>,
}

/// Observes the process image and returns the messages to publish.
#[derive(Debug)]
pub(super) struct Publisher {
    topics: Topics,
    pace: PublishInterval,
    telemetry: Telemetry,
    /// Wakes the publisher when a drive was updated.
    fresh: Arc<Notify>,
    drives: Vec<DriveTopics>,
    /// Index of the drive that is looked at next among the drives that are due.
    cursor: usize,
    buses: Vec<BusTopic>,
    buses_at: Option<Instant>,
    /// Retained topics that other code publishes.
    besides: Vec<Arc<str>>,
    /// Largest packet of the broker, bytes.
    max_packet: usize,
    /// States that do not fit whole, to be logged.
    reduced: Vec<String>,
    /// Topics that are no longer published, to be cleared at the broker.
    vanished: BTreeSet<Arc<str>>,
    vanished_cleared: bool,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct PublishInterval {
    pub(super) min: Duration,
    pub(super) max: Duration,
}

impl PublishInterval {
    /// Whether `current` is published now, if the last publication and its time were `last`.
    fn is_due<T: PartialEq>(self, last: Option<&(T, Instant)>, current: &T, now: Instant) -> bool {
        last.is_none_or(|(last, at)| {
            let since = now.saturating_duration_since(*at);
            since >= self.max || last != current && since >= self.min
        })
    }
}

#[derive(Debug)]
struct DriveTopics {
    drive: DriveHandle,
    /// The last snapshot that was processed, and when the drive is processed again even without a new one.
    seen: Option<Arc<Snapshot>>,
    look_at: Option<Instant>,
    /// Topic of the state; `None` if only points are published.
    state: Option<Arc<str>>,
    recorder: Recorder,
    /// Index in the profile and name of each published point.
    indices: Vec<PointIndex>,
    names: Vec<String>,
    /// Number of points in the state object: all, unless the broker takes only smaller packets.
    fits: usize,
    last: Option<(StateContent, Instant)>,
    points: Vec<PointTopic>,
}

#[derive(Debug)]
struct PointTopic {
    topic: Arc<str>,
    source: PointSource,
    last: Option<(PointPayload, Instant)>,
}

#[derive(Debug, Clone, Copy)]
enum PointSource {
    /// Index of the point in [`StateContent::points`].
    Point(usize),
    State,
    FaultText,
}

#[derive(Debug)]
struct BusTopic {
    bus: BusHandle,
    topic: Arc<str>,
    /// The bus state as last published, and when.
    state: Option<(BusState, Instant)>,
    figures: Option<(BusFigures, Instant)>,
}

impl Publisher {
    /// `pace` as configured; `fresh` is woken when a drive was updated.
    pub(super) fn new(topics: Topics, pace: PublishInterval, telemetry: Telemetry, fresh: Arc<Notify>) -> Publisher {
        Publisher {
            topics,
            pace,
            telemetry,
            fresh,
            drives: Vec::new(),
            cursor: 0,
            buses: Vec::new(),
            buses_at: None,
            besides: Vec::new(),
            max_packet: usize::MAX,
            reduced: Vec::new(),
            vanished: BTreeSet::new(),
            vanished_cleared: false,
        }
    }

    /// Observes this plant from now on; publishes everything again and clears topics that no longer exist.
    /// `besides` are retained topics that other code publishes.
    pub(super) fn adopt(&mut self, plant: &Plant, besides: Vec<Arc<str>>) {
        let old: Vec<Arc<str>> = self.all_topics().cloned().collect();
        self.drives = plant
            .drives()
            .map(|drive| DriveTopics::new(&self.topics, self.telemetry, drive))
            .collect();
        for drive in &self.drives {
            drive.drive.image.notify(&self.fresh);
        }
        let bus_topic = |bus: &BusHandle| BusTopic {
            bus: bus.clone(),
            topic: self.topics.bus(&bus.image.spec.name).into(),
            state: None,
            figures: None,
        };
        self.buses = plant.buses.iter().map(bus_topic).collect();
        self.buses_at = None;
        self.besides = besides;
        self.clear(old);
    }

    /// Notes that other code publishes these retained topics from now on.
    pub(super) fn publish_besides(&mut self, besides: Vec<Arc<str>>) {
        let old = std::mem::replace(&mut self.besides, besides);
        self.clear(old);
    }

    /// Clears those of the given topics that are not published any more.
    pub(super) fn clear(&mut self, old: impl IntoIterator<Item = Arc<str>>) {
        let present: BTreeSet<Arc<str>> = self.all_topics().cloned().collect();
        self.vanished.extend(old);
        self.vanished.retain(|topic| !present.contains(topic));
        self.vanished_cleared = false;
    }

    /// The retained topics of drives and buses, and the additional ones.
    pub(super) fn all_topics(&self) -> impl Iterator<Item = &Arc<str>> {
        let drives = self
            .drives
            .iter()
            .flat_map(|d| d.points.iter().map(|p| &p.topic).chain(&d.state));
        drives.chain(self.buses.iter().map(|b| &b.topic)).chain(&self.besides)
    }

    /// Publishes everything again, since the broker may have lost it; `max_packet` is the largest packet that the
    /// broker accepts.
    pub(super) fn restart(&mut self, max_packet: usize) {
        self.max_packet = max_packet;
        self.vanished_cleared = false;
        self.buses_at = None;
        for drive in &mut self.drives {
            (drive.last, drive.look_at, drive.fits) = (None, None, drive.names.len());
            drive.points.iter_mut().for_each(|p| p.last = None);
        }
        self.buses.iter_mut().for_each(|b| (b.state, b.figures) = (None, None));
    }

    /// Log lines about states that do not fit whole, since the last call.
    pub(super) fn take_reduced(&mut self) -> Vec<String> {
        std::mem::take(&mut self.reduced)
    }

    /// Topics that are still to be cleared.
    pub(super) fn vanished(&self) -> impl Iterator<Item = &Arc<str>> {
        self.vanished.iter()
    }

    /// The broker has a message of that topic; whether it was the last one to be cleared.
    pub(super) fn was_cleared(&mut self, topic: &Arc<str>) -> bool {
        self.vanished.remove(topic) && self.vanished.is_empty()
    }

    /// The topics to clear, once per connection.
    pub(super) fn cleared(&mut self) -> Vec<Arc<str>> {
        if std::mem::replace(&mut self.vanished_cleared, true) {
            Vec::new()
        } else {
            self.vanished.iter().cloned().collect()
        }
    }

    /// The messages to publish now, and when to call again at the latest; `wall` is the time of day at `now`. An update of
    /// a drive requires an earlier call.
    pub(super) fn tick(&mut self, now: Instant, wall: SystemTime) -> (Vec<Update>, Instant) {
        let mut updates = Vec::new();
        let (pace, most) = (self.pace, self.max_packet);
        let mut reduced = std::mem::take(&mut self.reduced);
        let all = self.visit_due(now, |drive| {
            let fits = drive.fits;
            drive.tick(pace, most, now, wall, &mut updates);
            if drive.fits < fits {
                reduced.push(drive.reduced(most));
            }
        });
        self.reduced = reduced;
        if self.buses_at.is_none_or(|at| at <= now) {
            for bus in &mut self.buses {
                bus.tick(pace, now, wall, &mut updates);
            }
            self.buses_at = Some(now + LOOK.min(pace.max).min(pace.min.max(Duration::from_millis(25))));
        }
        let buses_at = self.buses_at;
        (updates, self.next(all, now, buses_at))
    }

    /// Records values while the broker is away; returns when to call again, as [`Publisher::tick`] does.
    pub(super) fn record(&mut self, now: Instant, wall: SystemTime) -> (Vec<Update>, Instant) {
        let mut updates = Vec::new();
        let (pace, mode, most) = (self.pace, self.telemetry.history, self.max_packet);
        let all = self.visit_due(now, |drive| {
            let fresh = drive.is_fresh();
            let reading = drive.drive.reading(now);
            if reading.age().is_none() {
                // The drive was never read, so it has no value of that time.
                drive.look_at = Some(now + LOOK);
                return;
            }
            let shown = drive.shown(&reading);
            let (names, indices, fits) = (&drive.names, &drive.indices, drive.fits);
            let render = |shown: &StateContent| render(names, indices, fits, &reading, shown, wall, true);
            drive.recorder.limit(most);
            let wait = drive.recorder.record(mode, pace.min, shown, fresh, render, now);
            drive.seen = Some(reading.snapshot);
            drive.look_at = Some(now + wait.unwrap_or(LOOK).min(LOOK));
        });
        for drive in &mut self.drives {
            updates.extend(drive.recorder.ripe(now));
        }
        // No history is recorded of the buses.
        (updates, self.next(all, now, None))
    }

    /// Messages that were recorded and not returned yet.
    pub(super) fn recorded(&mut self) -> Vec<Update> {
        self.drives
            .iter_mut()
            .flat_map(|drive| drive.recorder.take_all())
            .collect()
    }

    /// Checks the drives that are due, a few in one call; returns whether none is left.
    fn visit_due(&mut self, now: Instant, mut look: impl FnMut(&mut DriveTopics)) -> bool {
        let drives = &self.drives;
        let is_due = |place| drives.get(place).is_some_and(|drive: &DriveTopics| drive.is_due(now));
        let (due, all) = rounds::due(&mut self.cursor, drives.len(), is_due);
        for place in due {
            if let Some(drive) = self.drives.get_mut(place) {
                look(drive);
            }
        }
        all
    }

    fn next(&self, all: bool, now: Instant, buses_at: Option<Instant>) -> Instant {
        if !all {
            return now;
        }
        let drives = self.drives.iter().filter_map(|drive| drive.look_at);
        drives.chain(buses_at).min().unwrap_or(now + LOOK)
    }
}

impl DriveTopics {
    fn new(topics: &Topics, telemetry: Telemetry, drive: DriveHandle) -> DriveTopics {
        let spec = &drive.image.spec;
        let published = payload::published_points(&spec.profile);
        let topic = |name: &str, source| PointTopic {
            topic: topics.point(&spec.name, name).into(),
            source,
            last: None,
        };
        let mut points: Vec<_> = published
            .iter()
            .enumerate()
            .map(|(place, (_, name))| topic(name, PointSource::Point(place)))
            .collect();
        points.push(topic("state", PointSource::State));
        if spec.profile.model_index(ModelPoint::FaultCode).is_some() {
            points.push(topic("fault_text", PointSource::FaultText));
        }
        points.retain(|_| telemetry.points);
        DriveTopics {
            seen: None,
            look_at: None,
            state: telemetry.state.then(|| topics.drive(&spec.name, "state").into()),
            recorder: Recorder::new(topics.drive(&spec.name, "history").into()),
            indices: published.iter().map(|(index, _)| *index).collect(),
            names: published.iter().map(|(_, name)| (*name).to_string()).collect(),
            fits: published.len(),
            last: None,
            points,
            drive,
        }
    }

    /// Whether the drive was updated since the last look.
    fn is_fresh(&self) -> bool {
        let image = &self.drive.image;
        self.seen.as_ref().is_none_or(|seen| image.is_newer_than(seen))
    }

    fn is_due(&self, now: Instant) -> bool {
        self.is_fresh() || self.look_at.is_none_or(|at| at <= now)
    }

    fn shown(&self, reading: &Reading<'_>) -> StateContent {
        let (drive, indices) = (&self.drive, self.indices.iter().copied());
        let words = drive.why(reading).names();
        let hold = drive.hold_view(None, reading.now).map(|(view, _)| view);
        StateContent {
            refreshing: reading.spec.refresh.map(|_| drive.image.is_refreshing()),
            ..StateContent::of(reading, indices, words, drive.stop_waits(reading.now), hold)
        }
    }

    /// The line of the log about a state that is published without some of its points.
    fn reduced(&self, most: usize) -> String {
        let omitted = self.names.get(self.fits..).unwrap_or_default().join(", ");
        format!(
            "the state of drive {} is too large for the broker, which accepts {most} bytes per packet: it is published without \
             {omitted}; raise the broker's limit, or read these as single points",
            self.drive.image.spec.name
        )
    }

    /// The state object, without its last points if the broker only accepts smaller packets.
    fn state_object(
        &mut self,
        reading: &Reading<'_>,
        shown: &StateContent,
        most: usize,
        wall: SystemTime,
    ) -> Option<Vec<u8>> {
        let room = most.saturating_sub(self.state.as_ref().map_or(0, |topic| topic.len()) + PACKET_OVERHEAD);
        loop {
            let payload = render(&self.names, &self.indices, self.fits, reading, shown, wall, false)?;
            if payload.len() <= room || self.fits == 0 {
                return Some(payload);
            }
            self.fits -= 1;
        }
    }

    fn tick(&mut self, pace: PublishInterval, most: usize, now: Instant, wall: SystemTime, updates: &mut Vec<Update>) {
        let drive = self.drive.clone();
        let reading = drive.reading(now);
        let shown = self.shown(&reading);
        let mut look_at = now + LOOK.min(pace.max);
        for point in &mut self.points {
            let payload = match point.source {
                PointSource::Point(place) => PointPayload::of(shown.points.get(place).and_then(|(value, _)| *value)),
                PointSource::State => PointPayload::state(shown.state),
                PointSource::FaultText => PointPayload::fault_text(&reading),
            };
            if point.due(pace, now, payload) {
                point.last = Some((payload, now));
                updates.push(Update {
                    topic: point.topic.clone(),
                    payload: payload.render(&reading.spec.profile),
                });
            } else if let Some((last, at)) = &point.last
                && *last != payload
            {
                look_at = look_at.min(*at + pace.min);
            }
        }
        if let Some(topic) = self.state.clone() {
            if pace.is_due(self.last.as_ref(), &shown, now) {
                let payload = self.state_object(&reading, &shown, most, wall);
                updates.extend(payload.map(|payload| Update { topic, payload }));
                self.last = Some((shown, now));
            } else if let Some((last, at)) = &self.last
                && *last != shown
            {
                look_at = look_at.min(*at + pace.min);
            }
        }
        self.seen = Some(reading.snapshot);
        self.look_at = Some(look_at);
    }
}

/// The state object with the first `fits` points.
fn render(
    names: &[String],
    indices: &[PointIndex],
    fits: usize,
    reading: &Reading<'_>,
    shown: &StateContent,
    wall: SystemTime,
    historical: bool,
) -> Option<Vec<u8>> {
    let object = StateObject {
        shown,
        names: names.get(..fits).unwrap_or(names),
        indices: indices.get(..fits).unwrap_or(indices),
        omitted: names.len().saturating_sub(fits),
        profile: &reading.spec.profile,
        fault_text: reading.fault_text(),
        age: reading.age(),
        wall,
        historical,
    };
    // Strings, numbers and null can always be serialized.
    serde_json::to_vec(&object).ok()
}

impl PointTopic {
    /// Whether a value is due: a value that is no longer good is cleared at once, and only once.
    fn due(&self, pace: PublishInterval, now: Instant, payload: PointPayload) -> bool {
        match (&self.last, payload) {
            (Some((last, _)), PointPayload::Nothing) => *last != PointPayload::Nothing,
            (last, _) => pace.is_due(last.as_ref(), &payload, now),
        }
    }
}

impl BusTopic {
    fn tick(&mut self, pace: PublishInterval, now: Instant, wall: SystemTime, updates: &mut Vec<Update>) {
        let (state, figures) = payload::bus_now(&self.bus);
        let slower = PublishInterval {
            min: pace.min.max(FIGURES_INTERVAL),
            ..pace
        };
        let due = pace.is_due(self.state.as_ref(), &state, now);
        if due || slower.is_due(self.figures.as_ref(), &figures, now) {
            updates.push(Update {
                topic: self.topic.clone(),
                payload: payload::bus_object(&state, &figures, wall),
            });
            (self.state, self.figures) = (Some((state, now)), Some((figures, now)));
        }
    }
}

#[cfg(test)]
mod tests;
