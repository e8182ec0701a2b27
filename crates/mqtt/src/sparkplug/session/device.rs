//! The metrics of the node or of one drive: which values were published, and which are due.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crate::sparkplug::history::Recorder;
use crate::sparkplug::metric::{Definition, Moment, Naming, Pace, Sample};
use crate::sparkplug::wire::Metric;

/// Minimum time between two messages because of figures alone.
const FIGURES: Duration = Duration::from_secs(1);

/// The node itself, or a drive.
#[derive(Debug)]
pub(super) struct Device {
    pub(super) name: String,
    pub(super) definitions: Vec<Definition>,
    pub(super) namings: Vec<Naming>,
    /// Number of metrics that are published, the first ones: all, unless the broker takes only smaller packets.
    pub(super) most: usize,
    pub(super) present: bool,
    pub(super) born: bool,
    /// Whether the device was lost since its birth, even if it has returned.
    pub(super) gone: bool,
    pub(super) now_is: Vec<Sample>,
    /// The metrics as last published or recorded.
    pub(super) sent: Vec<Option<Sample>>,
    /// Metrics that are published although they did not change.
    pub(super) repeat: Vec<usize>,
    pub(super) sent_at: Option<Instant>,
    /// Whether the present samples may differ from those that were sent.
    pub(super) changed: bool,
    pub(super) history: Recorder,
}

impl Device {
    pub(super) fn new(name: String, definitions: Vec<Definition>) -> Device {
        Device {
            name,
            namings: vec![Naming::Name; definitions.len()],
            sent: vec![None; definitions.len()],
            most: usize::MAX,
            definitions,
            present: false,
            born: false,
            gone: false,
            now_is: Vec::new(),
            repeat: Vec::new(),
            sent_at: None,
            changed: false,
            history: Recorder::default(),
        }
    }

    fn aliases(&self) -> BTreeMap<&str, Naming> {
        let names = self.definitions.iter().map(|d| d.name.as_str());
        names.zip(self.namings.iter().copied()).collect()
    }

    /// All metrics, including those without a known value; they count as published at `now`.
    pub(super) fn birth(&mut self, moment: Moment) -> Vec<Metric> {
        let unknown = moment.sample(None);
        let samples = self.now_is.iter().chain(std::iter::repeat(&unknown));
        let all = self.definitions.iter().zip(&self.namings).zip(samples);
        let metrics = all.map(|((d, naming), sample)| d.birth(*naming, sample));
        let metrics = metrics.take(self.most).collect();
        let sent = (0..self.definitions.len()).map(|place| self.now_is.get(place).cloned());
        self.sent = sent.collect();
        (self.born, self.gone, self.changed, self.sent_at) = (true, false, false, Some(moment.now));
        self.repeat.clear();
        metrics
    }

    /// Metrics that changed and are due, and the time of the next call.
    pub(super) fn data(&mut self, least: Duration, now: Instant) -> (Vec<Metric>, Option<Instant>) {
        if !self.changed {
            return (Vec::new(), None);
        }
        let differs = |place: usize| match (self.now_is.get(place), self.sent.get(place)) {
            (Some(sample), Some(Some(sent))) => !sent.is_same(sample),
            _ => true,
        };
        let published = self.now_is.len().min(self.most);
        let mut places: Vec<usize> = (0..published).filter(|place| differs(*place)).collect();
        let figures = |place: &usize| self.definitions.get(*place).is_some_and(|d| d.pace == Pace::Figure);
        let least = if places.iter().all(figures) && self.repeat.is_empty() {
            least.max(FIGURES)
        } else {
            least
        };
        places.extend(self.repeat.iter().copied().filter(|place| *place < published));
        places.sort_unstable();
        places.dedup();
        if places.is_empty() {
            self.changed = false;
            return (Vec::new(), None);
        }
        let due = self.sent_at.map_or(now, |at| at + least);
        if due > now {
            return (Vec::new(), Some(due));
        }
        let metrics = places.iter().filter_map(|place| self.publish(*place)).collect();
        (self.changed, self.sent_at) = (false, Some(now));
        self.repeat.clear();
        (metrics, None)
    }

    /// Publishes the metric with its present value.
    fn publish(&mut self, place: usize) -> Option<Metric> {
        let (definition, naming) = (self.definitions.get(place)?, *self.namings.get(place)?);
        let sample = self.now_is.get(place)?;
        let sent = self.sent.get_mut(place)?;
        let before = sent.as_ref().map(|sent| sent.quality);
        let metric = definition.data(naming, sample, before);
        *sent = Some(sample.clone());
        Some(metric)
    }

    pub(super) fn history(&mut self, most: usize) -> Vec<Metric> {
        let published = self.most;
        let metric = |(place, sample): (usize, Sample)| {
            if place >= published {
                return None;
            }
            let mut metric = self
                .definitions
                .get(place)?
                .data(*self.namings.get(place)?, &sample, None);
            metric.is_historical = Some(true);
            Some(metric)
        };
        self.history.take(most).into_iter().filter_map(metric).collect()
    }
}

/// Assigns an alias to each metric of `device`: the one it had `before`, otherwise one that no metric ever had.
pub(super) fn name(device: &mut Device, before: Option<&Device>, alias: bool, last: &mut u64) {
    let known = before.map(Device::aliases).unwrap_or_default();
    if alias {
        let names = device.definitions.iter().map(|d| d.name.as_str());
        let mut fresh = || {
            *last += 1;
            Naming::Alias(*last)
        };
        device.namings = names
            .map(|name| known.get(name).copied().unwrap_or_else(&mut fresh))
            .collect();
    }
}
