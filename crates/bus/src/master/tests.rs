//! The master with drives of one family that do as commanded, in virtual time.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::SystemTime;

use drivegate_testkit::{bus, bus_spec, controlled, image, submit, window};
use tokio::sync::oneshot::Receiver;

use super::*;
use crate::supervision::Lease;
use crate::transaction::{Ended, MAY_BE_LATE};
use drivegate_core::order::{Answer, Authority, Order, Target, Ticket};
use drivegate_core::process_image::{BusSpec, DriveSpec, LeaseAction, Link, OnShutdown, Supervision as Settings};
use drivegate_core::stalls::Stall;
use drivegate_line::LineOptions;
use drivegate_model::drive::{DriveIndex, ModelPoint, PollClass, Value};
use drivegate_proto::n2::Session;
use drivegate_proto::wire::Silence;
use drivegate_proto::{Exception, Reply, Table};

mod background;
mod chosen;
mod drill;
mod exceptions;
mod family_drive;
mod holder;
mod interlocks;
mod late_replies;
mod pauses;
mod refreshing;
mod rights;
mod shutdown;
mod stop_all;
mod stops;
mod timing;

/// Silence before each request in these tests.
const SILENCE: Duration = Duration::from_micros(1750);
/// Duration of a transaction in these tests.
const COST: Duration = Duration::from_millis(20);
/// Time of a transaction without an answer.
const TIMEOUT: Duration = Duration::from_millis(110);

/// Registers of a drive, and whether it answers.
#[derive(Default)]
struct Registers {
    holding: BTreeMap<u16, u16>,
    silent: bool,
    /// The result of the next write.
    next_write: Option<Ended>,
    /// Number of writes that get this exception.
    to_writes: Option<(u32, Exception)>,
    /// Exception that answers every read.
    to_reads: Option<Exception>,
    /// Set if the drive is of another family.
    family: Option<family_drive::FamilyDrive>,
}

impl Registers {
    /// Register 2000 is the control word, register 2100 the status word.
    fn answer(&mut self, pdu: &RequestPdu) -> Ended {
        if self.silent {
            return Ended::Silent;
        }
        if let Some(ended) = self.next_write.take_if(|_| pdu.is_write()) {
            return ended;
        }
        if let Some((left, exception)) = &mut self.to_writes
            && pdu.is_write()
            && *left > 0
        {
            *left -= 1;
            return Ended::Reply(Reply::Exception(*exception));
        }
        if let (Some(exception), RequestPdu::Read { .. }) = (self.to_reads, pdu) {
            return Ended::Reply(Reply::Exception(exception));
        }
        if let Some(family) = &mut self.family {
            return Ended::Reply(family.answer(pdu));
        }
        let reply = match pdu {
            RequestPdu::Read {
                table: Table::Holding,
                start,
                count,
            } => {
                let run = self.holding.get(&2000).is_some_and(|word| word & 1 == 1);
                // With a fault (bit 3) the simulated motor does not run.
                let fault = self.holding.get(&2100).map_or(0, |word| word & 8);
                self.holding.insert(2100, if run && fault == 0 { 3 } else { 1 | fault });
                let word = |address| self.holding.get(&address).copied().unwrap_or(0);
                Reply::Registers((*start..start + count).map(word).collect())
            }
            RequestPdu::WriteRegister { address, value } => {
                self.holding.insert(*address, *value);
                Reply::Written
            }
            RequestPdu::Read {
                table: Table::Coil | Table::DiscreteInput,
                count,
                ..
            } => Reply::Bits(vec![false; usize::from(*count)]),
            RequestPdu::Read { count, .. } => Reply::Registers(vec![0; usize::from(*count)]),
            RequestPdu::N2(Session::Identify) => Reply::Identified(0x10),
            RequestPdu::N2(Session::Poll { .. }) => Reply::Changes(Vec::new()),
            RequestPdu::N2(_) | RequestPdu::WriteCoil { .. } => Reply::Written,
            _ => Reply::Exception(Exception::ADDRESS),
        };
        Ended::Reply(reply)
    }
}

fn options() -> BusOptions {
    BusOptions {
        response_timeout: Duration::from_millis(100),
        retries: 1,
        silence: Silence::Spec,
        line: LineOptions::default(),
        mode: Default::default(),
        allow: Vec::new(),
    }
}

struct Rig {
    bus: BusHandle,
    master: Master,
    drives: Vec<Registers>,
    /// Whether the drives do not receive a broadcast.
    deaf: bool,
    news: Vec<News>,
    /// The thread stalls behind the request for which this holds, before the reply is read.
    stalls: Option<fn(&Turn) -> bool>,
    /// All turns that were sent on the line.
    wire: Vec<(Instant, Turn)>,
    now: Instant,
}

impl Rig {
    fn new(drives: u8) -> Rig {
        Rig::of(drives, "vacon-nx", Protocol::ModbusRtu)
    }

    fn of(drives: u8, profile: &str, protocol: Protocol) -> Rig {
        Rig::at(drives, profile, protocol, Duration::from_millis(10))
    }

    fn at(drives: u8, profile: &str, protocol: Protocol, cycle: Duration) -> Rig {
        Rig::with(drives, profile, protocol, cycle, |spec| spec)
    }

    fn with(
        drives: u8,
        profile: &str,
        protocol: Protocol,
        cycle: Duration,
        other: impl Fn(DriveSpec) -> DriveSpec,
    ) -> Rig {
        let mut rig = Rig::empty(drives, profile, protocol, cycle, other);
        rig.run(Duration::from_secs(3));
        rig
    }

    /// A rig that has not sent any request.
    fn empty(
        drives: u8,
        profile: &str,
        protocol: Protocol,
        cycle: Duration,
        other: impl Fn(DriveSpec) -> DriveSpec,
    ) -> Rig {
        let line = BusSpec {
            protocol,
            cycle,
            ..bus_spec("b")
        };
        Rig::on(line, drives, profile, other)
    }

    /// A rig on this line that has not sent any request.
    fn on(line: BusSpec, drives: u8, profile: &str, other: impl Fn(DriveSpec) -> DriveSpec) -> Rig {
        let profile = drivegate_testkit::profile(profile);
        let spec = |address: u8| DriveSpec {
            turnaround: Duration::ZERO,
            on_shutdown: OnShutdown::Stop,
            supervision: Some(Settings {
                timeout: Duration::from_millis(500),
                action: LeaseAction::Stop,
                adopt: false,
            }),
            ..controlled(&format!("d{address}"), "b", address, &profile)
        };
        let images = (1..=drives).map(|address| image(other(spec(address))));
        let bus = bus(line, images.collect());
        let now = Instant::now();
        let mut master = Master::new(bus.clone(), &options(), SILENCE, &Handover::default(), now);
        master.opened(now);
        Rig {
            bus,
            master,
            drives: (0..drives).map(|_| Registers::default()).collect(),
            deaf: false,
            news: Vec::new(),
            stalls: None,
            wire: Vec::new(),
            now,
        }
    }

    /// Replaces the bus by a new one.
    fn begin_anew(&mut self, before: &Handover) {
        self.master = Master::new(self.bus.clone(), &options(), SILENCE, before, self.now);
        self.master.opened(self.now);
    }

    /// Runs one transaction, or the wait for the next one.
    fn step(&mut self) {
        let mut news = Vec::new();
        match self.master.next(self.now, &mut news) {
            Err(until) => {
                assert!(until > self.now, "idle into the past");
                self.now = until;
            }
            Ok(turn) => self.carry_out(turn, &mut news),
        }
        for one in &news {
            self.apply(one);
        }
        self.news.append(&mut news);
    }

    /// The chosen request goes out, and its exchange ends.
    fn carry_out(&mut self, turn: Turn, news: &mut Vec<News>) {
        self.master.sending(&turn, self.now);
        let began = self.now;
        let ended = match turn.target() {
            Target::Address(_) => {
                let heard = self.drives.iter_mut().filter(|drive| !drive.silent && !self.deaf);
                for drive in heard {
                    drive.answer(turn.pdu());
                }
                Ended::Silent
            }
            Target::Drive(drive) => self.drives[drive.place()].answer(turn.pdu()),
        };
        let took = if ended == Ended::Silent { TIMEOUT } else { COST };
        self.now += took;
        let at = self.now;
        let stood = self.stalls.take_if(|stalls| stalls(&turn)).is_some();
        if stood {
            self.now += Duration::from_millis(200);
            self.master.after_stall(Stall::new(at, self.now), self.now);
        }
        let mangled = false;
        let end = TurnEnd {
            ended,
            began,
            at,
            stood,
            took,
            mangled,
            doubted: false,
            frame: Vec::new(),
        };
        self.master.done(&turn, end, self.now, news);
        self.wire.push((began, turn));
    }

    /// Stores a read in the process image.
    fn apply(&self, news: &News) {
        let image = |drive: &DriveIndex| self.bus.image.drives[drive.place()].clone();
        match news {
            News::Read { drive, read, words, at } => image(drive).update(|s| {
                s.store(read.table, read.start, words, *at);
                if read.class == PollClass::Fast {
                    s.fast_at = Some(*at);
                }
            }),
            News::Online(drive) => image(drive).update(|s| s.link = Link::Online(SystemTime::now())),
            News::Offline(drive) => image(drive).update(|s| s.link = Link::Offline(SystemTime::now())),
            _ => {}
        }
    }

    fn run(&mut self, time: Duration) {
        let end = self.now + time;
        while self.now < end {
            self.step();
        }
    }

    /// Gives an order of a client.
    fn order(&self, drive: usize, who: &str, point: ModelPoint, value: Value) -> Receiver<Answer> {
        let image = &self.bus.image.drives[drive];
        let index = image.spec.profile.model_index(point).unwrap();
        let order = Order::Points(vec![(index, value)]);
        let origin = Origin::new(SourceKind::Mqtt, who);
        let window = window(self.now, DEFAULT_EXPIRY);
        submit(&self.bus, DriveIndex::new(drive), origin, order, window, self.now)
    }

    fn switch(&self, drive: usize, who: &str, run: bool) -> Receiver<Answer> {
        self.order(drive, who, ModelPoint::Run, Value::Bool(run))
    }

    /// Shuts the gateway down; returns the drives that did not acknowledge their stop.
    fn shut_down(&mut self) -> Vec<String> {
        let deadline = self.now + Duration::from_secs(5);
        let mut missing = self.bus.queue.begin_shutdown(deadline, self.now);
        loop {
            self.step();
            if let Ok(missing) = missing.try_recv() {
                return missing.iter().map(ToString::to_string).collect();
            }
            assert!(self.now < deadline + TIMEOUT * 2, "{:?}", self.wire);
        }
    }

    fn runs(&self, drive: usize) -> bool {
        self.drives[drive].holding.get(&2000).is_some_and(|word| word & 1 == 1)
    }
}

fn outcome(answer: &mut Receiver<Answer>) -> Option<Outcome> {
    answer.try_recv().ok().map(|a| a.outcome)
}

#[test]
fn a_lease_ends_with_the_action_though_its_order_waited_longer_than_it() {
    let mut rig = Rig::new(2);
    let _writes: Vec<_> = (0..12)
        .map(|k| {
            rig.order(
                1,
                &format!("{k}"),
                ModelPoint::SpeedReference,
                Value::Number(f64::from(k)),
            )
        })
        .collect();
    let _flood: Vec<_> = (0..40).map(|k| rig.switch(1, &format!("{k}"), true)).collect();
    let mut run = rig.switch(0, "client", true);
    let begin = rig.now;
    while !rig.runs(0) {
        rig.step();
        assert!(rig.now < begin + DEFAULT_EXPIRY);
    }
    rig.run(Duration::from_millis(1));
    assert!(outcome(&mut run).is_some_and(|o| o.is_ok()));
    let started = rig.now;
    while rig.runs(0) {
        rig.step();
        assert!(
            rig.now < started + Duration::from_millis(900),
            "the action does not come"
        );
    }
    assert!(rig.now >= started + Duration::from_millis(450), "it came too soon");
    assert!(rig.news.contains(&News::LeaseRanOut(DriveIndex::new(0))));
}

/// While the port is lost, heartbeats are not evaluated; a reload hands them over.
#[test]
fn a_heartbeat_of_an_outage_is_handed_over_with_the_lease() {
    let mut rig = Rig::new(1);
    let _run = rig.switch(0, "client", true);
    rig.run(Duration::from_millis(100));
    rig.master.lost(rig.now);
    rig.now += Duration::from_millis(300);
    rig.bus.image.drives[0].renew_lease(rig.now);
    let heard = rig.now;
    rig.now += Duration::from_millis(300);
    let handover = rig.master.ended(None, rig.now);
    assert_eq!(handover.leases[0].lease, Lease::held(heard));
}

/// Index of the drive of a turn.
fn drive_of(turn: &Turn) -> usize {
    turn.drive().expect("a drive").place()
}

#[test]
fn what_was_on_the_wire_when_the_port_was_lost_is_not_told_to_be_unsent() {
    let mut rig = Rig::new(2);
    let mut sent = rig.order(0, "a", ModelPoint::SpeedReference, Value::Number(10.0));
    loop {
        let turn = rig.master.next(rig.now, &mut Vec::new()).expect("the write");
        rig.master.sending(&turn, rig.now);
        if turn.pdu().is_write() {
            break;
        }
        let ended = rig.drives[drive_of(&turn)].answer(turn.pdu());
        let end = TurnEnd {
            ended,
            began: rig.now,
            at: rig.now + COST,
            stood: false,
            took: COST,
            mangled: false,
            doubted: false,
            frame: Vec::new(),
        };
        rig.now += COST;
        rig.master.done(&turn, end, rig.now, &mut Vec::new());
    }
    let mut waiting = rig.order(0, "a", ModelPoint::SpeedReference, Value::Number(20.0));
    rig.bus.queue.close(Outcome::BusDown, rig.now);
    rig.master.lost(rig.now);
    assert_eq!(outcome(&mut sent), Some(Outcome::Interrupted(Interruption::BusDown)));
    assert_eq!(outcome(&mut waiting), Some(Outcome::BusDown));
}
