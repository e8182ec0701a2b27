//! A bus of a world: the real core, and a simulated line instead of the port.

use std::sync::Arc;
use std::time::{Duration, Instant};

use drivegate_bus::BusOptions;
use drivegate_bus::core::{Action, BusCore, Closed};
use drivegate_bus::master::{Handover, Purpose};
use drivegate_bus::predict::{Prediction, predict};
use drivegate_bus::schedule::slow_share;
use drivegate_core::event::Events;
use drivegate_core::order::CommandLog;
use drivegate_core::plant::BusHandle;
use drivegate_core::process_image::{Access, BusImage, BusSpec, DriveImage, DriveSpec};
use drivegate_core::queue::CommandQueue;
use drivegate_core::start_guard::{BusGuards, Guards};
use drivegate_line::LineOptions;
use drivegate_model::drive::profile::Profiles;
use drivegate_model::drive::{DriveIndex, PollClass, Profile};
use drivegate_proto::wire::Silence;
use drivegate_proto::{Decoded, LineFormat, Protocol, Reply, Request, RequestPdu};
use drivegate_sim::faults::FaultPlan;
use drivegate_sim::half_duplex::{Delivery, HalfDuplex, LineRules};
use drivegate_sim::random::Random;
use drivegate_sim::simulated_drive::{DriveOptions, ModelOptions};
use drivegate_sim::slave::Slaves;
use drivegate_sim::statistics::Transcript;

use super::scenario::Line;

/// The place that stands for no drive: that of a broadcast.
pub const NO_DRIVE: usize = usize::MAX;

/// The last request on the line.
#[derive(Debug, Clone)]
pub struct Asked {
    pub drive: usize,
    pub pdu: RequestPdu,
    pub at: Instant,
    pub is_poll: bool,
    /// Whether the request is a refresh: an order written again.
    pub is_refresh: bool,
    /// When the image last received the first word of a read before this request.
    pub last_read: Option<Instant>,
    /// Reply of the drive, if it carried out the request.
    pub reply: Option<Reply>,
    /// Frame of the reply.
    pub frame: Vec<u8>,
    /// Address of the drive that acted last.
    pub acted: u8,
}

/// An event that was observed on the line.
#[derive(Debug, Clone)]
pub enum Seen {
    Sent(Asked),
    Acted(Asked),
    /// The previous transaction has ended.
    Over(Asked),
    /// Bytes arrived at the gateway.
    Heard(Vec<u8>),
}

pub struct WorldBus {
    pub index: usize,
    pub line: Line,
    pub handle: BusHandle,
    pub core: BusCore,
    pub wire: HalfDuplex,
    pub options: BusOptions,
    /// Record of the drives' starts, kept as long as the process.
    pub guards: Arc<Guards>,
    pub profile: Arc<Profile>,
    pub open: bool,
    /// Whether the bus is about to stop its drives, so that it does not poll any more.
    pub ending: bool,
    pub exchanges: u64,
    /// Whether replies may be duplicated, or arrive when they are no longer expected.
    pub late: bool,
    /// The predicted fast cycle of the line when polls saturate it.
    pub round: Duration,
    /// The slow cycle of the line, as predicted.
    pub slow_round: Duration,
    /// The slow round while drives come online, when their process data is compared with the monitoring registers.
    pub first_slow_round: Duration,
    /// Share of the frames to the gateway in which one bit is wrong, in addition to the faults of the line.
    pub flips: f64,
    dice: Random,
    began: Instant,
    until: Instant,
    commands: bool,
    asked: Option<Asked>,
    /// The last request without an address of a drive.
    broadcast: Option<Asked>,
    /// The previous transaction: a late reply may have ended it while its request was still on the wire.
    ended: Option<Asked>,
}

/// Properties of a line that its description does not have.
pub struct Parts {
    pub profile: Arc<Profile>,
    pub drives: Vec<DriveOptions>,
    pub faults: FaultPlan,
    pub flips: f64,
    pub delivery: Delivery,
    pub silence: Silence,
    /// Factor by which the line is faster than its baud rate.
    pub wire_speed: u32,
}

impl Parts {
    /// The usual options: drives of the family, except those that do not answer, and the faults of the description.
    pub fn of(index: usize, line: &Line, seed: u64) -> Parts {
        let mut profile = Profiles::built_in().get(line.family).unwrap().clone();
        Arc::make_mut(&mut profile).turnaround = line.turnaround;
        let drives = (1..=line.drives).filter(|address| !line.dead.contains(address));
        let drives = drives.map(|address| {
            let mut model = ModelOptions::of_profile(&profile).unwrap();
            model.take_turnaround_of_line();
            DriveOptions::new(address, model)
        });
        let mut faults = FaultPlan::new(line.faults.parse().unwrap(), seed ^ 0xFA17 ^ index as u64);
        if let Some(point) = line.refuses
            && let Some(raw) = profile.points.get(profile.point_index(point).unwrap()).unwrap().raw()
        {
            faults = faults.refusing(1, raw.table, raw.address);
        }
        Parts {
            drives: drives.collect(),
            faults,
            flips: line.flips,
            delivery: Delivery::Whole,
            silence: Silence::Spec,
            wire_speed: 1,
            profile,
        }
    }
}

/// A slow round on a line that is full of process data.
fn slow_round_of_full_line(predicted: &Prediction, slow_cycle: Duration) -> Duration {
    let slow = predicted
        .requests
        .iter()
        .filter(|request| request.read.class == PollClass::Slow);
    let work: Duration = slow.map(|request| request.wire).sum();
    work.div_f64(slow_share(work.as_secs_f64() / slow_cycle.as_secs_f64()))
}

impl WorldBus {
    pub fn new(
        index: usize,
        line: &Line,
        parts: Parts,
        events: &Events,
        command_log: &Arc<CommandLog>,
        now: Instant,
    ) -> WorldBus {
        let profile = parts.profile;
        let format = LineFormat::new(line.baud, line.format).unwrap();
        let options = BusOptions {
            response_timeout: line.response_timeout,
            retries: line.retries,
            silence: parts.silence,
            line: LineOptions::default(),
            allow: Vec::new(),
            mode: Default::default(),
        };
        let guards = Arc::new(Guards::default());
        let handle = handle(index, line, &profile, format, (&guards, now), command_log);
        let specs: Vec<DriveSpec> = handle.image.drives.iter().map(|drive| drive.spec.clone()).collect();
        let predicted = predict(&handle.image.spec, parts.silence, &specs);
        let (round, slow_round) = (predicted.fast_cycle, predicted.slow_cycle);
        // A drive that refuses a register is read in more requests than planned, which may fill the line: then slow polls
        // have no more than their share.
        let slow_round = match line.refuses {
            Some(_) => slow_round.map(|round| round.max(slow_round_of_full_line(&predicted, line.slow_cycle))),
            None => slow_round,
        };
        let (mut slow, mut monitors) = (0, 0);
        for plan in handle.image.drives.iter().map(|drive| &drive.plan) {
            slow += plan.reads.iter().filter(|read| read.class == PollClass::Slow).count() as u32;
            monitors += plan.monitors.len() as u32;
        }
        let first_slow_round = slow_round.map(|round| round * (slow + monitors) / slow.max(1));
        let wire_format = LineFormat::new(line.baud * parts.wire_speed, line.format).unwrap();
        let mut rules = LineRules::of(line.protocol, wire_format);
        rules.turnaround = line.turnaround;
        rules.delivery = parts.delivery;
        let slaves = Slaves::new(parts.drives, Duration::ZERO);
        let mut wire = HalfDuplex::new(rules, slaves, parts.faults, Transcript::new(0));
        wire.take_acts();
        let mut core = BusCore::new(handle.clone(), &options, events.clone(), &Handover::default(), now);
        core.opened(now);
        WorldBus {
            index,
            line: line.clone(),
            late: line.is_late(),
            handle,
            core,
            wire,
            options,
            guards,
            profile,
            open: true,
            ending: false,
            exchanges: 0,
            round: round.unwrap_or_default(),
            slow_round: slow_round.unwrap_or_default(),
            first_slow_round: first_slow_round.unwrap_or_default(),
            flips: parts.flips,
            dice: Random::new(index as u64 ^ 0xF11B),
            began: now,
            until: now,
            commands: true,
            asked: None,
            broadcast: None,
            ended: None,
        }
    }

    /// Whether a drive of the bus that answers was not found yet, or has values that were never read: then slow polls have
    /// half of the line.
    pub fn has_unread(&self) -> bool {
        let of_class = |class| matches!(class, PollClass::Slow | PollClass::Once);
        let has_unread = |image: &Arc<DriveImage>| {
            let snapshot = image.snapshot();
            let mut slow = image.plan.reads.iter().filter(|read| of_class(read.class));
            !snapshot.link.is_online() || slow.any(|read| snapshot.read_at(read.table, read.start).is_none())
        };
        let drives = self.handle.image.drives.iter();
        let mut answering = drives.filter(|image| !self.line.dead.contains(&image.spec.address));
        answering.any(has_unread)
    }

    /// Restarts the bus as a reload does, with the same drives on the same line.
    pub fn restart(&mut self, index: usize, events: &Events, now: Instant) {
        self.handle.queue.begin_handover(Vec::new(), now);
        let leaving: Vec<_> = self.handle.image.drives.iter().cloned().collect();
        self.guards.expect(&leaving, now);
        let before = self.core.ended(now);
        let format = self.handle.image.spec.format;
        let log = self.handle.command_log.clone();
        let stopped = std::mem::replace(
            &mut self.handle,
            handle(index, &self.line, &self.profile, format, (&self.guards, now), &log),
        );
        self.handle.take_over(std::slice::from_ref(&stopped), now);
        stopped.queue.close(drivegate_core::order::Outcome::ShuttingDown, now);
        let (bus, options) = (self.handle.clone(), &self.options);
        self.core = BusCore::new(bus, options, events.clone(), &before, now);
        if self.open {
            self.core.opened(now);
        }
        (self.asked, self.ended) = (None, None);
        (self.until, self.commands) = (now, true);
    }

    /// The process is gone: nothing is sent any more, and the drives go on.
    pub fn vanish(&mut self) {
        self.open = false;
        self.wire.cut();
        (self.asked, self.ended) = (None, None);
    }

    /// The process is killed and started again: of all that it knew, `guards` has what is left.
    pub fn kill(&mut self, guards: Guards, events: &Events, now: Instant) {
        self.wire.cut();
        self.guards = Arc::new(guards);
        let format = self.handle.image.spec.format;
        let log = self.handle.command_log.clone();
        self.handle = handle(self.index, &self.line, &self.profile, format, (&self.guards, now), &log);
        let (bus, options, before) = (self.handle.clone(), &self.options, Handover::default());
        self.core = BusCore::new(bus, options, events.clone(), &before, now);
        if self.open {
            self.core.opened(now);
        }
        (self.asked, self.ended) = (None, None);
        (self.until, self.commands) = (now, true);
    }

    /// The maximum frequency in a drive, in Hz; with `new` it is first set, as at the drive's panel. `None` if the
    /// family has no register for it, or the drive is off.
    pub fn maximum_frequency(&mut self, address: u8, new: Option<f64>, now: Instant) -> Option<f64> {
        if self.line.protocol == Protocol::N2 {
            return None;
        }
        let index = self.profile.point_index("maximum_frequency")?;
        let raw = self
            .profile
            .points
            .get(index)
            .unwrap()
            .raw()
            .filter(|raw| raw.form.items() == 1)?
            .clone();
        let sim = self.sim(now);
        let drive = self.wire.slaves().drive(address)?;
        if let Some(hertz) = new {
            let value = *raw
                .encode(drivegate_model::drive::Value::Number(hertz), 0)
                .ok()?
                .first()?;
            let address = raw.address;
            drive.answer(&RequestPdu::WriteRegister { address, value }, sim)?;
        }
        let (table, start) = (raw.table, raw.address);
        let words = drive
            .answer(&RequestPdu::Read { table, start, count: 1 }, sim)?
            .words()?;
        Some(
            raw.decode(&words, drivegate_model::drive::model::Kind::Number)?
                .as_f64(),
        )
    }

    /// The time on the simulated line.
    pub fn sim(&self, now: Instant) -> Duration {
        now - self.began
    }

    /// When the bus needs its next step.
    pub fn wake_at(&self) -> Instant {
        let wire = self.wire.wake().map(|wake| self.began + wake.at);
        let core = self.open.then_some(self.until);
        let wake = [wire, core].into_iter().flatten().min();
        wake.unwrap_or(self.began + Duration::from_secs(1_000_000))
    }

    /// Notes that a client gave an order.
    pub fn command_came(&mut self, now: Instant) {
        if self.open && self.commands {
            self.core.command_came();
            self.until = now;
        }
    }

    /// The port disappears, or returns.
    pub fn set_open(&mut self, open: bool, now: Instant) {
        if open == self.open {
            return;
        }
        self.open = open;
        (self.asked, self.ended) = (None, None);
        if open {
            self.core.opened(now);
            (self.until, self.commands) = (now, true);
        } else {
            self.wire.cut();
            self.core.lost("the adapter is gone", now);
        }
    }

    /// Lets the device server close its connection; bytes on the line may then be lost. The bus reacts as its thread would.
    pub fn close(&mut self, lose_reply: bool, now: Instant) -> Closed {
        if lose_reply {
            self.wire.cut();
        }
        let closed = self.core.closed(now);
        match closed {
            Closed::Reconnect | Closed::ReconnectToAsk => self.core.reconnected(),
            Closed::Lost => {
                self.core.lost("the device server closed the connection", now);
                self.core.opened(now);
                (self.asked, self.ended) = (None, None);
            }
        }
        (self.until, self.commands) = (now, true);
        closed
    }

    /// Advances the bus as far as possible at `now`.
    pub fn step(&mut self, now: Instant, seen: &mut Vec<Seen>) {
        self.deliver(now, false, seen);
        while self.open {
            match self.core.poll(now) {
                Action::Send => self.send(now, seen),
                Action::Wait { until, commands, .. } => {
                    assert!(until > now, "idle until a time that is past");
                    return self.waits(until, commands, seen);
                }
            }
        }
    }

    /// When the wire must be processed next.
    pub fn wire_wakes(&self) -> Option<Instant> {
        self.wire.wake().map(|wake| self.began + wake.at)
    }

    /// Advances the wire and the drives, whatever the bus does.
    pub fn wire_runs(&mut self, now: Instant, seen: &mut Vec<Seen>) {
        self.wire.on_time(self.sim(now));
        self.note_acts(seen);
    }

    /// Lets the thread of the bus sleep until this time, or until an order arrives.
    pub fn waits(&mut self, until: Instant, commands: bool, seen: &mut Vec<Seen>) {
        self.note_over(seen);
        (self.until, self.commands) = (until, commands);
    }

    pub fn send(&mut self, now: Instant, seen: &mut Vec<Seen>) {
        self.note_over(seen);
        let frame = self.core.sending(now).to_vec();
        self.exchanges += 1;
        let turn = self.core.asked().expect("a turn is on the line");
        let asked = Asked {
            drive: turn.drive().map_or(NO_DRIVE, DriveIndex::place),
            pdu: turn.pdu().clone(),
            at: now,
            is_poll: matches!(turn.purpose, Purpose::Poll(_)),
            is_refresh: matches!(turn.purpose, Purpose::Refresh(_)),
            last_read: match turn.pdu() {
                RequestPdu::Read { table, start, .. } => {
                    let image = turn.drive().and_then(|drive| self.handle.image.drives.get(drive));
                    image.and_then(|image| image.snapshot().read_at(*table, *start))
                }
                _ => None,
            },
            reply: None,
            frame: Vec::new(),
            acted: 0,
        };
        seen.push(Seen::Sent(asked.clone()));
        if asked.drive == NO_DRIVE {
            self.broadcast = Some(asked.clone());
        }
        self.asked = Some(asked);
        self.wire.on_bytes(&frame, self.sim(now));
        self.note_acts(seen);
    }

    /// Delivers the due bytes to the drives and to the gateway. The gateway also reads without bytes after it
    /// `stood` still.
    pub fn deliver(&mut self, now: Instant, stood: bool, seen: &mut Vec<Seen>) {
        let sim = self.sim(now);
        self.wire.on_time(sim);
        self.note_acts(seen);
        let mut bytes = Vec::new();
        while self.wire.take_due(sim, &mut bytes).is_some() {}
        if !bytes.is_empty() && self.dice.chance(self.flips) {
            let place = self.dice.within(0..=bytes.len() as u64 - 1) as usize;
            bytes[place] ^= 1 << self.dice.within(0..=7);
        }
        if self.open && (stood || !bytes.is_empty()) {
            seen.push(Seen::Heard(bytes.clone()));
            self.core.received(&bytes, now);
            self.note_over(seen);
        }
    }

    fn note_acts(&mut self, seen: &mut Vec<Seen>) {
        for act in self.wire.take_acts() {
            let Some(asked) = self.asked.as_mut().or(self.ended.as_mut()) else {
                continue;
            };
            asked.frame = act.reply.clone();
            asked.acted = act.address;
            let is_asked = self
                .handle
                .image
                .drives
                .get(DriveIndex::new(asked.drive))
                .is_none_or(|image| image.spec.address == act.address);
            if let Some(broadcast) = self.broadcast.as_mut().filter(|_| !is_asked) {
                // A drive may carry out a broadcast after the request to another drive was sent.
                broadcast.acted = act.address;
                seen.push(Seen::Acted(broadcast.clone()));
                continue;
            }
            let Some(image) = self.handle.image.drives.get(DriveIndex::new(asked.drive)) else {
                // No drive is configured at that address.
                seen.push(Seen::Acted(asked.clone()));
                continue;
            };
            let spec = &image.spec;
            if spec.address != act.address {
                // A repeated reply was accepted as the reply to a later request, and the bus was restarted after that.
                assert!(self.late, "drive {} acted that was not asked", act.address);
                continue;
            }
            let request = Request {
                address: spec.address,
                pdu: asked.pdu.clone(),
                n2: spec.profile.n2,
            };
            if let Decoded::Reply { reply, .. } = self.line.protocol.decode(&request, &act.reply) {
                asked.reply = Some(reply);
                seen.push(Seen::Acted(asked.clone()));
            }
        }
    }

    /// Notes the end of the transaction once the core has nothing on the line any more.
    fn note_over(&mut self, seen: &mut Vec<Seen>) {
        if self.core.asked().is_none()
            && let Some(asked) = self.asked.take()
        {
            seen.push(Seen::Over(asked.clone()));
            self.ended = Some(asked);
        }
    }
}

pub fn handle(
    index: usize,
    line: &Line,
    profile: &Arc<Profile>,
    format: LineFormat,
    (guards, now): (&Arc<Guards>, Instant),
    command_log: &Arc<CommandLog>,
) -> BusHandle {
    let name = format!("line{index}");
    let spec = BusSpec {
        name: name.clone(),
        port: "none".to_string(),
        protocol: line.protocol,
        format,
        cycle: line.cycle,
        slow_cycle: line.slow_cycle,
    };
    let drive = |address: u8| {
        let place = if line.swapped {
            line.drives + 1 - address
        } else {
            address
        };
        let mut spec = DriveSpec {
            access: Access::Control,
            unit: index as u8 * 40 + place,
            supervision: line.supervision.clone(),
            refresh: line.refresh,
            on_shutdown: line.on_shutdown,
            turnaround: line.turnaround,
            frequency_range: (line.protocol == Protocol::N2).then_some(0.0..=50.0),
            ..DriveSpec::new(&format!("d{index}-{place}"), &name, address, profile.clone())
        };
        (line.spec)(&mut spec);
        Arc::new(DriveImage::new(spec, line.slow_cycle))
    };
    let drives: Vec<Arc<DriveImage>> = (1..=line.drives).map(drive).collect();
    let guarded = BusGuards::of(guards, &spec, drives.iter().map(|drive| &drive.spec));
    guarded.iter().for_each(|guarded| guarded.begin());
    let watched = drives.iter().map(|drive| (spec.machine(&drive.spec), drive.clone()));
    guards.watch(watched, Duration::from_secs(1), now);
    let queue = Arc::new(CommandQueue::new().unwrap().guarded(guarded));
    BusHandle::new(Arc::new(BusImage::new(spec, drives)), queue, command_log.clone())
}
