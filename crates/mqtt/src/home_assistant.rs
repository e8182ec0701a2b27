//! Discovery for Home Assistant (`docs/home-assistant.md`): one retained message for the gateway and one for each drive
//! lists their entities and the topics of their values.
//!
//! The messages are made one at a time, when the last ones are with the broker, so that a thousand drives hold up neither
//! telemetry nor results. Time is an argument.

mod device;
mod entity;

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use self::device::Device;
use super::Telemetry;
use super::publisher::Update;
use super::topics::Topics;
use drivegate_core::plant::{DriveHandle, Plant};

/// Messages that wait for the broker at a time.
const UNDER_WAY: usize = 8;
/// Minimum time between two announcements of everything because Home Assistant was started.
const BIRTHS: Duration = Duration::from_secs(10);

/// What the entities get their values from.
#[derive(Debug, Clone)]
pub(super) struct Sources {
    pub(super) topics: Topics,
    /// The telemetry that is published.
    pub(super) telemetry: Telemetry,
    /// Whether the set topics are served.
    pub(super) commands: bool,
}

/// Decides which discovery messages are published, and when.
#[derive(Debug)]
pub(super) struct Announcer {
    prefix: String,
    sources: Sources,
    /// The id of the gateway.
    gateway: String,
    devices: Vec<Announced>,
    /// Largest packet of the broker, bytes.
    max_packet: usize,
    /// Indices of the devices that have not been announced yet.
    pending: VecDeque<usize>,
    /// Topics of messages given to the outbox, some of which may still wait there.
    under_way: Vec<Arc<str>>,
    /// A device has another number of messages.
    changed: bool,
    begun: Option<Instant>,
    /// When everything is announced again because Home Assistant was started.
    again: Option<Instant>,
}

#[derive(Debug)]
struct Announced {
    device: Device,
    /// The topics of the device's message; more than one if the broker does not accept the message as a whole.
    topics: Vec<Arc<str>>,
}

impl Announcer {
    /// An announcer for the discovery prefix of Home Assistant.
    pub(super) fn new(prefix: &str, sources: Sources) -> Announcer {
        Announcer {
            prefix: prefix.to_string(),
            gateway: id_of(sources.topics.root()),
            sources,
            devices: Vec::new(),
            max_packet: usize::MAX,
            pending: VecDeque::new(),
            under_way: Vec::new(),
            changed: false,
            begun: None,
            again: None,
        }
    }

    /// Announces the devices of this plant from now on; all of them are announced again.
    pub(super) fn adopt(&mut self, plant: &Plant) {
        let gateway = Device::gateway(&self.gateway, plant);
        let drives = plant
            .drives()
            .map(|drive: DriveHandle| Device::drive(&self.gateway, &self.sources, drive));
        let devices: Vec<Device> = std::iter::once(gateway).chain(drives).collect();
        self.devices = devices
            .into_iter()
            .map(|device| Announced {
                topics: vec![self.topic(device.id(), 0)],
                device,
            })
            .collect();
        self.begin();
    }

    /// Announces everything again, since the broker may have lost it; `max_packet` is the largest packet that the
    /// broker accepts.
    pub(super) fn restart(&mut self, max_packet: usize) {
        self.max_packet = max_packet;
        self.under_way.clear();
        self.again = None;
        self.begin();
    }

    fn begin(&mut self) {
        self.pending = (0..self.devices.len()).collect();
    }

    /// The topic on which Home Assistant reports that it has started.
    pub(super) fn birth_topic(&self) -> String {
        format!("{}/status", self.prefix)
    }

    /// The topics of all messages of this gateway, as a filter.
    pub(super) fn own_filter(&self) -> String {
        format!("{}/device/{}/+/config", self.prefix, self.gateway)
    }

    /// The topics that the broker must let the gateway publish.
    pub(super) fn own_topics(&self) -> String {
        format!("{}/device/{}/#", self.prefix, self.gateway)
    }

    /// Whether a topic is one of this gateway's messages, now or earlier.
    pub(super) fn is_own(&self, topic: &str) -> bool {
        let rest = topic.strip_prefix(self.prefix.as_str());
        let rest = rest.and_then(|rest| rest.strip_prefix("/device/")?.strip_prefix(self.gateway.as_str()));
        rest.is_some_and(|rest| rest.starts_with('/') && rest.ends_with("/config"))
    }

    /// Home Assistant was started, or became connected again.
    pub(super) fn born(&mut self, now: Instant) {
        let soonest = self.begun.map_or(now, |begun| begun + BIRTHS);
        self.again.get_or_insert(soonest.max(now));
    }

    /// The retained topics of all devices.
    pub(super) fn topics(&self) -> impl Iterator<Item = &Arc<str>> {
        self.devices.iter().flat_map(|announced| &announced.topics)
    }

    /// Whether the topics have changed since the last call.
    pub(super) fn take_changed(&mut self) -> bool {
        std::mem::take(&mut self.changed)
    }

    /// The messages of the next device, if there is one and it is due; `waits` returns whether a message of a topic
    /// is still on its way to the broker.
    pub(super) fn next(&mut self, now: Instant, waits: impl Fn(&str) -> bool) -> Vec<Update> {
        if self.again.is_some_and(|at| at <= now) {
            (self.again, self.begun) = (None, Some(now));
            self.begin();
        }
        self.under_way.retain(|topic| waits(topic));
        if self.under_way.len() >= UNDER_WAY {
            return Vec::new();
        }
        let Some(place) = self.pending.pop_front() else {
            return Vec::new();
        };
        let updates = self.messages(place);
        self.under_way.extend(updates.iter().map(|update| update.topic.clone()));
        updates
    }

    fn messages(&mut self, place: usize) -> Vec<Update> {
        let Some(Announced { device, topics }) = self.devices.get(place) else {
            return Vec::new();
        };
        let id = device.id().to_string();
        // All topics of the device have about this length; the digits of a part number are not counted exactly.
        let overhead = topics.first().map_or(0, |topic| topic.len()) + 32;
        let payloads = device.payloads(&self.sources, self.max_packet.saturating_sub(overhead));
        // Topics of an earlier connection, whose packets were smaller, are cleared.
        let empty = std::iter::repeat_n(Vec::new(), topics.len().saturating_sub(payloads.len()));
        let count = payloads.len();
        let updates: Vec<Update> = payloads
            .into_iter()
            .chain(empty)
            .enumerate()
            .map(|(part, payload)| Update {
                topic: self.topic(&id, part),
                payload,
            })
            .collect();
        if let Some(announced) = self.devices.get_mut(place) {
            self.changed |= announced.topics.len() != count;
            announced.topics = updates.iter().take(count).map(|update| update.topic.clone()).collect();
        }
        updates
    }

    fn topic(&self, device: &str, part: usize) -> Arc<str> {
        // The topic contains the part after the gateway's own id, or `gateway` for the message of the gateway.
        let name = device.strip_prefix(self.gateway.as_str()).unwrap_or(device);
        let name = name.strip_prefix('_').unwrap_or("gateway");
        match part {
            0 => format!("{}/device/{}/{name}/config", self.prefix, self.gateway).into(),
            part => format!("{}/device/{}/{name}__{}/config", self.prefix, self.gateway, part + 1).into(),
        }
    }
}

/// A topic as an id of Home Assistant, which has letters, digits, `_` and `-`. Different topics have different ids: `/`
/// becomes `_`, every other byte `__` and two hexadecimal digits.
fn id_of(topic: &str) -> String {
    let mut id = String::with_capacity(topic.len());
    for byte in topic.bytes() {
        match byte {
            b'/' => id.push('_'),
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'-' => id.push(char::from(byte)),
            other => id += &format!("__{other:02x}"),
        }
    }
    id
}

#[cfg(test)]
mod tests;
