//! The session of the edge node: births before data, sequence numbers without gaps, deaths before new births. No I/O
//! and no clock: it receives what happens, and returns the next message.

mod device;

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use self::device::{Device, name};
use super::host::Host;
use super::metric::{Datum, Definition, Moment, Naming, Sample};
use super::topics::{Kind, StateForm, Topics};
use super::wire::{DataType, Metric, Payload};
use drivegate_model::drive::Quality;

/// Minimum time between two births of the node on one connection: requests in between are served together.
const REBIRTH: Duration = Duration::from_millis(250);
/// Maximum number of values in one history message, and the minimum interval between two of them, so that live values
/// take precedence.
const HISTORY_VALUES: usize = 250;
const HISTORY_PACE: Duration = Duration::from_millis(25);
/// Values of an outage that are kept, of all drives together.
const HISTORY: usize = 200_000;
/// Bytes of one value in a message of the history, about.
const HISTORY_BYTES: usize = 100;
/// Metrics at the start of a birth of the node that are not among its definitions.
pub(super) const FIXED_METRICS: usize = 2;
/// The metric with which a host requests a birth.
pub(super) const REBIRTH_METRIC: &str = "Node Control/Rebirth";

/// The configured rules of the session.
#[derive(Debug, Clone)]
pub(super) struct Rules {
    pub(super) topics: Topics,
    /// Whether metrics have aliases.
    pub(super) alias: bool,
    /// Values of an outage are published afterwards.
    pub(super) history: bool,
    /// Minimum time between two messages of a device.
    pub(super) min_interval: Duration,
}

/// A message for the broker.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Packet {
    pub(super) kind: Kind,
    pub(super) device: Option<String>,
    pub(super) payload: Payload,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// There is no connection, or it is not subscribed.
    Away,
    /// Connected; the primary host is not online.
    Waiting,
    /// The node is connected; its birth follows, at this time at the earliest.
    NodeBirth(Option<Instant>),
    /// The births of the devices follow, from this index on.
    DeviceBirths(usize),
    Live,
}

/// The Sparkplug session of a node, which continues over several connections.
#[derive(Debug)]
pub(super) struct Session {
    rules: Rules,
    phase: Phase,
    host: Host,
    seq: u8,
    bd_seq: u8,
    last_alias: u64,
    node: Device,
    devices: Vec<Device>,
    /// Devices that are no longer configured and are to be declared dead.
    departed: Vec<String>,
    /// Index of the device that is checked first, so that each device gets its turn.
    cursor: usize,
    rebirth: bool,
    born_at: Option<Instant>,
    history_at: Option<Instant>,
    /// Values in one message of the history.
    history_values: usize,
    lost: u64,
}

impl Session {
    pub(super) fn new(rules: Rules) -> Session {
        Session {
            rules,
            phase: Phase::Away,
            host: Host::default(),
            seq: 0,
            bd_seq: 0,
            last_alias: 0,
            node: Device::new(String::new(), Vec::new()),
            devices: Vec::new(),
            departed: Vec::new(),
            cursor: 0,
            rebirth: false,
            born_at: None,
            history_at: None,
            history_values: HISTORY_VALUES,
            lost: 0,
        }
    }

    /// Sets the metrics of the node and of the devices. A node that was born is born again if they differ.
    pub(super) fn adopt(&mut self, node: Vec<Definition>, devices: Vec<(String, Vec<Definition>)>) {
        let before = self.devices.iter().map(|d| (d.name.as_str(), &d.definitions));
        if self.node.definitions == node && before.eq(devices.iter().map(|(name, d)| (name.as_str(), d))) {
            return;
        }
        let node_before = std::mem::replace(&mut self.node, Device::new(String::new(), node));
        name(
            &mut self.node,
            Some(&node_before),
            self.rules.alias,
            &mut self.last_alias,
        );
        let mut old: BTreeMap<String, Device> = BTreeMap::new();
        for device in std::mem::take(&mut self.devices) {
            old.insert(device.name.clone(), device);
        }
        for (device_name, definitions) in devices {
            let mut device = Device::new(device_name, definitions);
            let before = old.remove(&device.name);
            name(&mut device, before.as_ref(), self.rules.alias, &mut self.last_alias);
            if let Some(before) = before {
                (device.born, device.gone) = (before.born, before.gone);
                if before.definitions == device.definitions {
                    device.history = before.history;
                } else {
                    self.lost += before.history.len() as u64;
                }
            }
            self.devices.push(device);
        }
        for device in old.into_values() {
            self.lost += device.history.len() as u64;
            if device.born {
                self.departed.push(device.name);
            }
        }
        self.cursor = 0;
        self.request_birth();
    }

    /// The last will of a connection with this number.
    pub(super) fn will(&self, bd_seq: u8, moment: Moment) -> Packet {
        death(bd_seq, moment)
    }

    /// Notes that the broker accepted the connection with this number and packets of this size; the state of the
    /// host will be reported again.
    pub(super) fn opened(&mut self, bd_seq: u8, max_packet: usize) {
        self.bd_seq = bd_seq;
        self.host.forget();
        self.history_values = (max_packet / HISTORY_BYTES).clamp(1, HISTORY_VALUES);
        for device in self.devices.iter_mut().chain([&mut self.node]) {
            device.most = usize::MAX;
        }
        self.closed();
    }

    /// Limits the metrics of this device, or of the node, to the first `most` from now on.
    pub(super) fn keep(&mut self, device: Option<&str>, most: usize) {
        let device = match device {
            None => Some(&mut self.node),
            Some(name) => self.devices.iter_mut().find(|device| device.name == name),
        };
        if let Some(device) = device {
            device.most = most;
        }
    }

    /// Notes that the broker granted the subscriptions.
    pub(super) fn subscribed(&mut self) {
        if self.phase == Phase::Away {
            self.phase = if self.may_be_born() {
                Phase::NodeBirth(None)
            } else {
                Phase::Waiting
            };
        }
    }

    /// Notes that the connection has ended.
    pub(super) fn closed(&mut self) {
        self.phase = Phase::Away;
        (self.rebirth, self.born_at, self.node.born) = (false, None, false);
        self.departed.clear();
        for device in &mut self.devices {
            (device.born, device.gone) = (false, false);
        }
    }

    fn may_be_born(&self) -> bool {
        self.rules.topics.state().is_none() || self.host.is_online()
    }

    /// Whether the node is born, or its birth is in progress.
    pub(super) fn is_alive(&self) -> bool {
        matches!(self.phase, Phase::DeviceBirths(_) | Phase::Live)
    }

    /// Whether the session waits for the primary host.
    pub(super) fn is_waiting(&self) -> bool {
        self.phase == Phase::Waiting
    }

    /// Processes a message about the primary host. If the host comes online, the births follow at `births_at`.
    /// Returns whether the connection must be given up because the host went offline.
    ///
    /// # Errors
    /// If the message is not valid; contains the reason, and nothing changes.
    pub(super) fn host_state(&mut self, form: StateForm, payload: &[u8], births_at: Instant) -> Result<bool, String> {
        self.host.take(form, payload)?;
        match (self.phase, self.host.is_online()) {
            (Phase::Waiting, true) => self.phase = Phase::NodeBirth(Some(births_at)),
            (Phase::NodeBirth(_) | Phase::DeviceBirths(_) | Phase::Live, false) => return Ok(true),
            _ => {}
        }
        Ok(false)
    }

    /// A host requests the births. No data is sent before them.
    pub(super) fn request_birth(&mut self) {
        self.rebirth = self.is_alive();
    }

    /// Sets the present values of the node.
    pub(super) fn set_node(&mut self, samples: Vec<Sample>) {
        self.node.changed = true;
        self.node.now_is = samples;
    }

    /// Sets the present samples of a device, and whether it is present.
    pub(super) fn set_device(&mut self, device: usize, present: bool, samples: Vec<Sample>, now: Instant) {
        let count = self.devices.len().max(1);
        let record = self.rules.history && !self.is_alive();
        let Some(device) = self.devices.get_mut(device) else {
            return;
        };
        device.gone |= device.born && !present;
        // A device that was never present records nothing.
        if record && (present || device.sent.iter().any(Option::is_some)) {
            let (least, most) = (self.rules.min_interval, (HISTORY / count).max(1));
            if let Some(lost) = device.history.record(&device.sent, &samples, least, most, now) {
                self.lost += lost;
                device.sent = samples.iter().cloned().map(Some).collect();
            }
        }
        (device.present, device.now_is, device.changed) = (present, samples, true);
    }

    /// Publishes these metrics of a device even without a change: a host has tried to write them.
    pub(super) fn repeat(&mut self, device: usize, metrics: impl IntoIterator<Item = usize>) {
        if let Some(device) = self.devices.get_mut(device) {
            device.repeat.extend(metrics);
            device.repeat.sort_unstable();
            device.repeat.dedup();
            device.changed = true;
        }
    }

    pub(super) fn metric(&self, device: usize, by_name: Option<&str>, alias: Option<u64>) -> Option<usize> {
        let device = self.devices.get(device)?;
        match (by_name, alias) {
            (Some(name), _) => device.definitions.iter().position(|d| d.name == name),
            (None, Some(alias)) => device.namings.iter().position(|n| *n == Naming::Alias(alias)),
            (None, None) => None,
        }
    }

    /// The alias of a metric; `None` if it has none.
    pub(super) fn alias(&self, device: usize, metric: usize) -> Option<u64> {
        match self.devices.get(device)?.namings.get(metric)? {
            Naming::Alias(alias) => Some(*alias),
            Naming::Name => None,
        }
    }

    /// Name and data type of a metric.
    pub(super) fn definition(&self, device: usize, metric: usize) -> Option<&Definition> {
        self.devices.get(device)?.definitions.get(metric)
    }

    /// Values of an outage that were given up since the last call.
    pub(super) fn take_lost(&mut self) -> u64 {
        std::mem::take(&mut self.lost)
    }

    /// The death of the node: the last message on the connection before it is closed.
    pub(super) fn end(&mut self, moment: Moment) -> Packet {
        self.closed();
        death(self.bd_seq, moment)
    }

    /// The next message if one is due; otherwise when to call again, unless something happens before. A returned
    /// message counts as sent.
    pub(super) fn next(&mut self, moment: Moment) -> Result<Packet, Option<Instant>> {
        match self.phase {
            Phase::Away | Phase::Waiting => Err(None),
            Phase::NodeBirth(Some(at)) if at > moment.now => Err(Some(at)),
            Phase::NodeBirth(_) => Ok(self.node_birth(moment)),
            Phase::DeviceBirths(from) => match self.next_born(from) {
                Some(place) => {
                    self.phase = Phase::DeviceBirths(place + 1);
                    self.device_birth(place, moment).ok_or(None)
                }
                None => {
                    self.phase = Phase::Live;
                    self.live(moment)
                }
            },
            Phase::Live => self.live(moment),
        }
    }

    fn next_born(&self, from: usize) -> Option<usize> {
        let waits = |device: &Device| device.present && !device.born;
        let rest = self.devices.iter().enumerate().skip(from);
        rest.filter(|(_, device)| waits(device)).map(|(place, _)| place).next()
    }

    fn live(&mut self, moment: Moment) -> Result<Packet, Option<Instant>> {
        if let Some(name) = self.departed.pop() {
            return Ok(self.packet(Kind::DeviceDeath, Some(name), Vec::new(), moment));
        }
        if self.rebirth {
            let due = self.born_at.map_or(moment.now, |at| at + REBIRTH);
            return if due > moment.now {
                Err(Some(due))
            } else {
                Ok(self.node_birth(moment))
            };
        }
        let mut again: Option<Instant> = None;
        for step in 0..self.devices.len() {
            let place = (self.cursor + step) % self.devices.len();
            match self.device(place, moment) {
                Ok(packet) => {
                    self.cursor = place + 1;
                    return Ok(packet);
                }
                Err(due) => again = again.into_iter().chain(due).min(),
            }
        }
        let (metrics, due) = self.node.data(self.rules.min_interval, moment.now);
        if !metrics.is_empty() {
            return Ok(self.packet(Kind::NodeData, None, metrics, moment));
        }
        again = again.into_iter().chain(due).min();
        self.past(moment).map_err(|due| again.into_iter().chain(due).min())
    }

    /// The message that is due for a device.
    fn device(&mut self, place: usize, moment: Moment) -> Result<Packet, Option<Instant>> {
        let least = self.rules.min_interval;
        let device = self.devices.get_mut(place).ok_or(None)?;
        if device.gone {
            (device.gone, device.born) = (false, false);
            let name = device.name.clone();
            return Ok(self.packet(Kind::DeviceDeath, Some(name), Vec::new(), moment));
        }
        if device.present && !device.born {
            return self.device_birth(place, moment).ok_or(None);
        }
        if !device.born {
            return Err(None);
        }
        let (metrics, due) = device.data(least, moment.now);
        if metrics.is_empty() {
            return Err(due);
        }
        let name = device.name.clone();
        Ok(self.packet(Kind::DeviceData, Some(name), metrics, moment))
    }

    /// The next message with past values.
    fn past(&mut self, moment: Moment) -> Result<Packet, Option<Instant>> {
        let holds = |device: &&mut Device| device.born && !device.history.is_empty();
        let device = self.devices.iter_mut().find(holds).ok_or(None)?;
        if let Some(due) = self
            .history_at
            .map(|at| at + HISTORY_PACE)
            .filter(|due| *due > moment.now)
        {
            return Err(Some(due));
        }
        let (name, metrics) = (device.name.clone(), device.history(self.history_values));
        self.history_at = Some(moment.now);
        Ok(self.packet(Kind::DeviceData, Some(name), metrics, moment))
    }

    fn node_birth(&mut self, moment: Moment) -> Packet {
        self.seq = u8::MAX;
        (self.phase, self.rebirth, self.born_at) = (Phase::DeviceBirths(0), false, Some(moment.now));
        for device in &mut self.devices {
            // After the birth of the node, hosts know none of its devices.
            (device.born, device.gone) = (false, false);
        }
        let control = Definition::new(REBIRTH_METRIC, DataType::Boolean);
        let off = moment.sample(Some(Datum::Bool(false)));
        let mut metrics = vec![number(self.bd_seq, moment), control.birth(Naming::Name, &off)];
        metrics.extend(self.node.birth(moment));
        self.packet(Kind::NodeBirth, None, metrics, moment)
    }

    fn device_birth(&mut self, place: usize, moment: Moment) -> Option<Packet> {
        let device = self.devices.get_mut(place)?;
        let (name, metrics) = (device.name.clone(), device.birth(moment));
        Some(self.packet(Kind::DeviceBirth, Some(name), metrics, moment))
    }

    fn packet(&mut self, kind: Kind, device: Option<String>, metrics: Vec<Metric>, moment: Moment) -> Packet {
        self.seq = self.seq.wrapping_add(1);
        Packet {
            kind,
            device,
            payload: Payload {
                timestamp: Some(moment.millis()),
                metrics,
                seq: Some(self.seq.into()),
            },
        }
    }
}

/// The metric `bdSeq`.
fn number(bd_seq: u8, moment: Moment) -> Metric {
    let sample = moment.sample(Some(Datum::Integer(bd_seq.into())));
    Definition::new("bdSeq", DataType::Int64).data(Naming::Name, &sample, Some(Quality::Good))
}

fn death(bd_seq: u8, moment: Moment) -> Packet {
    Packet {
        kind: Kind::NodeDeath,
        device: None,
        payload: Payload {
            timestamp: Some(moment.millis()),
            metrics: vec![number(bd_seq, moment)],
            seq: None,
        },
    }
}

#[cfg(test)]
mod tests;
