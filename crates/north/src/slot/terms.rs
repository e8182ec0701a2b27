//! Decides which requests a slot permits its tools, and gives them to the bus.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use arc_swap::ArcSwap;

use super::request::{Meaning, Refused, ToolRequest};
use super::rights::ToolRights;
use super::{Options, Slot, SlotAccess};
use crate::{NorthState, SlotOutcome};
use drivegate_core::order::{Arrival, Authority, Order, Origin, Outcome, Parts, Proof, Refusal, SourceKind, Urgency};
use drivegate_core::permit::{self, Stage, client_access, meant_another};
use drivegate_core::plant::{
    BusHandle, DriveHandle, DriveKey, Exchange, OrderRequest, Placed, Plant, Question, SharedPlant, Target, turn_away,
};
use drivegate_core::process_image::Access;
use drivegate_model::drive::plan::WireTime;
use drivegate_proto::frames::HIGHEST_ADDRESS;
use drivegate_proto::{LineFormat, Protocol, RequestPdu, describe};

/// Share of the time of a line that writes of tools take at most, stops apart.
const SHARE_OF_WRITES: f64 = 0.1;
/// A command of a tool is not sent later than that.
const EXPIRY: Duration = super::dialogue::ANSWER_WITHIN;

/// The decision about a request.
#[derive(Debug)]
pub(super) enum Decision {
    Refuse(Refused),
    /// The request is neither sent nor answered.
    Silent,
    /// The request waits for the bus.
    Wait(Work),
}

/// The work that was given to the bus.
#[derive(Debug)]
pub(super) enum Work {
    Exchange(Exchange),
    Command(Placed),
}

impl Work {
    /// The outcome of the work, with the frame of the drive if it was kept.
    pub(super) fn poll(&mut self, cx: &mut Context<'_>) -> Poll<(Outcome, Option<Vec<u8>>)> {
        match self {
            Work::Exchange(exchange) => exchange.poll(cx),
            Work::Command(placed) => placed.poll_answer(cx).map(|answer| (answer.outcome, None)),
        }
    }
}

/// The conditions of time for sending a request.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pace {
    pub(super) not_before: Instant,
    /// Whether the request stops a drive, so that it is sent at once.
    pub(super) is_stop: bool,
    /// Number of stops given so far to the drives of the request.
    pub(super) stops: u64,
}

/// Times from which tools may write next, by bus.
#[derive(Debug, Default)]
pub(super) struct WritePaces(Mutex<BTreeMap<String, Instant>>);

impl WritePaces {
    fn not_before(&self, bus: &str) -> Option<Instant> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).get(bus).copied()
    }

    fn wrote(&self, bus: &str, took: Duration, now: Instant) {
        let pause = took.mul_f64(1.0 / SHARE_OF_WRITES);
        let mut paces = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        paces.insert(bus.to_string(), now + pause);
    }
}

/// A slot with its present configuration, and the plant that belongs to it.
#[derive(Debug)]
pub(super) struct Terms {
    pub(super) slot: Slot,
    /// The slots of all buses as they are configured now.
    pub(super) current: Arc<ArcSwap<Options>>,
    pub(super) plant: SharedPlant,
    pub(super) stats: Arc<NorthState>,
    pub(super) paces: Arc<WritePaces>,
}

/// A tool that is connected to a slot.
#[derive(Debug)]
pub(super) struct Tool {
    terms: Arc<Terms>,
    /// Origin with the right to write.
    origin: Origin,
    /// Origin with the right to send requests that cannot be checked.
    raw: Origin,
}

impl Tool {
    /// The tool at `peer`; all connections of a `client` share its turns in the queues.
    pub(super) fn new(terms: Arc<Terms>, peer: &str, client: &str, proof: Proof) -> Tool {
        let (kind, bus) = (SourceKind::Slot, &terms.slot.bus);
        let client: Arc<str> = format!("{} {bus} {client}", kind.name()).into();
        let rights = ToolRights::new(&terms.current, bus, &proof);
        let origin = Origin::of(client, kind, format!("{peer} at {bus}")).proven(proof);
        let raw = origin.clone().with_right(rights.of(SlotAccess::Raw));
        let origin = origin.with_right(rights.of(SlotAccess::Write));
        Tool { terms, origin, raw }
    }

    pub(super) fn protocol(&self) -> Protocol {
        self.terms.slot.protocol
    }

    pub(super) fn format(&self) -> LineFormat {
        self.terms.slot.format
    }

    pub(super) fn who(&self) -> &str {
        &self.origin.who
    }

    pub(super) fn count(&self, outcome: SlotOutcome) {
        self.terms.stats.slots.count(&self.terms.slot.bus, outcome);
    }

    /// Highest address on a Modbus line: that of the specification, unless the bus has a drive at a reserved one.
    pub(super) fn highest_address(&self) -> u8 {
        let plant = self.terms.plant.load();
        let on_bus = |bus: &&BusHandle| bus.image.spec.name == self.terms.slot.bus;
        let drives = plant
            .buses
            .iter()
            .filter(on_bus)
            .flat_map(|bus| bus.image.drives.iter());
        drives.map(|drive| drive.spec.address).fold(HIGHEST_ADDRESS, u8::max)
    }

    fn writes(&self) -> bool {
        self.terms.slot.access != SlotAccess::Read
    }

    /// When the request may be sent: writes one after the other within a share of the line, stops at once.
    pub(super) fn pace(&self, request: &ToolRequest, now: Instant) -> Pace {
        let mut pace = Pace {
            not_before: now,
            is_stop: false,
            stops: 0,
        };
        if matches!(request.meaning, Meaning::Read(_) | Meaning::Faulty(_)) {
            return pace;
        }
        let plant = self.terms.plant.load();
        let drives = self.asked(&plant, request);
        pace.stops = drives.iter().map(DriveHandle::stops).sum();
        let Meaning::Write(pdu) = &request.meaning else {
            return pace;
        };
        pace.is_stop = self.writes() && drives.iter().any(|drive| stop_in(drive, pdu, now).is_some());
        // A request that will be refused does not wait.
        let admitted = drives
            .iter()
            .all(|drive| permit::admit(Order::Write(pdu.clone()), &drive.reading(now), Authority::Write).is_ok());
        if self.writes() && !pace.is_stop && admitted {
            pace.not_before = self
                .terms
                .paces
                .not_before(&self.terms.slot.bus)
                .unwrap_or(now)
                .max(now);
        }
        pace
    }

    /// The configured drives to which a request applies: one, none, or all.
    fn asked(&self, plant: &Plant, request: &ToolRequest) -> Vec<DriveHandle> {
        let broadcast = request.is_broadcast(self.protocol());
        let on_bus = plant
            .drives()
            .filter(|drive| drive.image.spec.bus == self.terms.slot.bus);
        on_bus
            .filter(|drive| broadcast || drive.image.spec.address == request.address)
            .collect()
    }

    /// Decides about a request with this arrival. `stops` is the number of stops that its drives had when it was
    /// complete: after a later stop it is not sent. A permitted request is in the queue of the bus when this
    /// returns, and is not sent after `deadline`.
    pub(super) fn decide(
        &self,
        request: &ToolRequest,
        mut arrival: Arrival,
        stops: u64,
        deadline: Instant,
        now: Instant,
    ) -> Decision {
        let plant = self.terms.plant.load();
        let bus = plant
            .buses
            .iter()
            .find(|bus| bus.image.spec.name == self.terms.slot.bus);
        let Some(bus) = bus else { return Decision::Silent };
        let drives = self.asked(&plant, request);
        let broadcast = request.is_broadcast(self.protocol());
        // A stop that was accepted while the request was held may have the same time stamp, so the number of stops
        // is compared.
        let stopped = drives.iter().map(DriveHandle::stops).sum::<u64>() != stops;
        if stopped {
            let before = arrival.asked.checked_sub(Duration::from_nanos(1));
            arrival.asked = before.unwrap_or(arrival.asked);
        }
        let case = Case {
            plant: &plant,
            bus,
            arrival,
            deadline,
            now,
        };
        match &request.meaning {
            Meaning::Faulty(why) => Decision::Refuse(*why),
            Meaning::Read(pdu) if !broadcast => {
                let target = target(request, drives.first());
                Decision::Wait(self.exchange(&case, target, pdu, false))
            }
            Meaning::Write(pdu) if !broadcast && drives.len() == 1 => match drives.first() {
                Some(drive) => self.write(drive, pdu, case.arrival, now),
                None => Decision::Silent,
            },
            Meaning::Read(pdu) | Meaning::Write(pdu) | Meaning::Unchecked(pdu) => {
                if let Some(placed) = self.stop_at_former(&case, request, &drives, pdu) {
                    return Decision::Wait(Work::Command(placed));
                }
                self.raw(&case, request, &drives, pdu)
            }
        }
    }

    /// Gives the stop in a write to the machine that had the address when the request began, where no drive has the address
    /// any more; `None` if there is no such machine or stop.
    fn stop_at_former(
        &self,
        case: &Case<'_>,
        request: &ToolRequest,
        drives: &[DriveHandle],
        pdu: &RequestPdu,
    ) -> Option<Placed> {
        if !drives.is_empty() || !self.writes() {
            return None;
        }
        let key = DriveKey::Address(self.terms.slot.bus.clone(), request.address);
        let former = case.plant.drive_formerly(&key, case.arrival.asked)?;
        let stop = former.stop_meant(&Order::Write(pdu.clone()), &former)?;
        let what = describe::request_on(self.protocol(), pdu);
        let may = client_access(Stage::Accept, true, &self.origin, &self.terms.slot.bus).is_ok();
        let origin = self.origin.clone();
        let origin = if may { origin.lasting() } else { origin };
        let order = OrderRequest::new(stop, origin, Authority::Write).within(EXPIRY);
        let order = order.without_rest(&what, meant_another()).arrived(case.arrival.clone());
        Some(former.place(order.resolved(), case.now))
    }

    /// Whether a reload has given the line, or an address on it, to another machine since the request began.
    fn meant_another_line(&self, case: &Case<'_>) -> bool {
        let of_bus = |drive: &DriveHandle| drive.image.spec.bus == self.terms.slot.bus;
        let is_moved = |drive: DriveHandle| drive.is_meant(SourceKind::Slot, &case.arrival).is_err();
        case.plant.drives().filter(of_bus).any(is_moved)
    }

    /// Orders a write to a configured drive, after the checks that a Modbus TCP client must pass.
    fn write(&self, drive: &DriveHandle, pdu: &RequestPdu, arrival: Arrival, now: Instant) -> Decision {
        if !self.writes() {
            let text = format!("the slot of bus `{}` has access = \"read\"", self.terms.slot.bus);
            return self.refuse(drive, pdu, Refusal::NotAllowed(text), now);
        }
        if let Err(refusal) = client_access(Stage::Accept, false, &self.origin, &self.terms.slot.bus) {
            return self.refuse(drive, pdu, refusal, now);
        }
        let cost = cost(drive, pdu);
        self.terms.paces.wrote(&self.terms.slot.bus, cost, now);
        let request =
            OrderRequest::new(Order::Write(pdu.clone()), self.origin.clone(), Authority::Write).within(EXPIRY);
        let placed = drive.place(request.arrived(arrival), now);
        Decision::Wait(Work::Command(placed))
    }

    /// Requests that only `access = "raw"` admits: broadcasts, functions that are not decoded, writes to addresses without a
    /// configured drive.
    fn raw(&self, case: &Case<'_>, request: &ToolRequest, drives: &[DriveHandle], pdu: &RequestPdu) -> Decision {
        let now = case.now;
        let why = if request.is_broadcast(self.protocol()) {
            "it is a broadcast"
        } else if drives.is_empty() {
            "no drive is configured at its address"
        } else {
            "what it writes cannot be checked"
        };
        if self.terms.slot.access != SlotAccess::Raw {
            let text = format!("{why}; only a slot with access = \"raw\" forwards it");
            return self.refuse_any(case, request, drives, pdu, Refusal::NotAllowed(text));
        }
        if let Err(refusal) = client_access(Stage::Accept, false, &self.raw, &self.terms.slot.bus) {
            return self.refuse_any(case, request, drives, pdu, refusal);
        }
        for drive in drives {
            let spec = &drive.image.spec;
            if spec.access != Access::Control {
                let text = format!(
                    "drive `{}` is only monitored; set access = \"control\" for it",
                    spec.name
                );
                return self.refuse(drive, pdu, Refusal::NotAllowed(text), now);
            }
        }
        for drive in drives {
            // A broadcast has no reply, so the stops are placed without waiting for one.
            if let Some(stop) = stop_in(drive, pdu, now) {
                let request = OrderRequest::new(stop, self.origin.clone(), Authority::Write).within(EXPIRY);
                drop(drive.place(request.arrived(case.arrival.clone()), now));
            }
        }
        if self.meant_another_line(case) {
            return self.refuse_any(case, request, drives, pdu, meant_another());
        }
        for drive in drives {
            let whole = Order::Write(pdu.clone());
            // Limits hold for each of the drives.
            if let Meaning::Write(_) = &request.meaning
                && let Err(refusal) = permit::admit(whole, &drive.reading(now), Authority::Write)
            {
                return self.refuse(drive, pdu, refusal, now);
            }
        }
        let first = drives.first().filter(|_| !request.is_broadcast(self.protocol()));
        Decision::Wait(self.exchange(case, target(request, first), pdu, true))
    }

    fn exchange(&self, case: &Case<'_>, target: Target, pdu: &RequestPdu, may_write: bool) -> Work {
        let question = Question {
            target,
            pdu: pdu.clone(),
            may_write,
            arrival: case.arrival.clone(),
            expires: case.deadline,
            origin: if may_write { &self.raw } else { &self.origin }.clone(),
        };
        Work::Exchange(case.bus.ask(question, case.now))
    }

    /// Refuses a request that concerns no drive, one or all of them: audited and published once.
    fn refuse_any(
        &self,
        case: &Case<'_>,
        request: &ToolRequest,
        drives: &[DriveHandle],
        pdu: &RequestPdu,
        refusal: Refusal,
    ) -> Decision {
        if let Some(drive) = drives.first() {
            return self.refuse(drive, pdu, refusal, case.now);
        }
        let what = describe::request_on(self.protocol(), pdu);
        let name = format!("address {} of {}", request.address, self.terms.slot.bus);
        let outcome = Outcome::Refused(refusal.clone());
        turn_away(
            &case.plant.command_log,
            &name,
            &what,
            outcome,
            self.origin.clone(),
            case.now,
        );
        Decision::Refuse(Refused::Exception(refusal.exception()))
    }

    fn refuse(&self, drive: &DriveHandle, pdu: &RequestPdu, refusal: Refusal, now: Instant) -> Decision {
        let what = describe::request_on(self.protocol(), pdu);
        let why = Refused::Exception(refusal.exception());
        drive.refuse(&what, refusal, self.origin.clone(), now);
        Decision::Refuse(why)
    }
}

/// The facts on which a decision is based.
struct Case<'c> {
    plant: &'c Plant,
    bus: &'c BusHandle,
    arrival: Arrival,
    deadline: Instant,
    now: Instant,
}

fn target(request: &ToolRequest, drive: Option<&DriveHandle>) -> Target {
    drive.map_or(Target::Address(request.address), |drive| Target::Drive(drive.index))
}

/// The stop in a write that takes the run command of the drive away, if it is admitted: the whole write, or the
/// part of it that stops.
fn stop_in(drive: &DriveHandle, pdu: &RequestPdu, now: Instant) -> Option<Order> {
    let (Parts::One(stop) | Parts::Two(stop, _)) = Parts::of(Order::Write(pdu.clone()), &drive.image.spec.profile);
    let admitted = permit::admit(stop.clone(), &drive.reading(now), Authority::Write).ok()?;
    (admitted.urgency == Urgency::Stop).then_some(stop)
}

/// Wire time of a write and of the read that shows its effect.
fn cost(drive: &DriveHandle, pdu: &RequestPdu) -> Duration {
    let line = &drive.bus.image.spec;
    let silence = line.protocol.silence(Default::default(), &line.format);
    2 * WireTime::of(line.protocol, &line.format, pdu).total(drive.image.spec.turnaround, silence)
}
