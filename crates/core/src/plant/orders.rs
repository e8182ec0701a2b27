//! Placing orders in the queue of a bus, and refusing those that cannot be placed.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use super::earlier_meanings::FormerMachine;
use super::{BusHandle, DriveHandle, Placed};
use crate::event::RefusedCommand;
use crate::order::{
    Answer, Arrival, Authority, BackgroundRequest, Change, Command, CommandLog, DEFAULT_EXPIRY, Haste, Order, Origin,
    Outcome, Pace, Parts, Refusal, SlotWrite, StopEnd, Ticket, Urgency, Window, Work, written,
};
use crate::permit::{DriveFacts, Facts, Stage, Verdict, admit, client_access, meant_another};
use crate::process_image::{BusImage, Reading};
use drivegate_model::drive::parameters::RawValue;
use drivegate_model::drive::{DriveIndex, ModelPoint, PointIndex, Value};
use drivegate_proto::{RequestPdu, Table, describe};

/// An order as an interface gives it to a drive.
#[derive(Debug, Clone)]
pub struct OrderRequest {
    order: Order,
    /// The refused part of the request, if only its stop was understood: its text, and the refusal.
    rest: Option<(String, Refusal)>,
    origin: Origin,
    authority: Authority,
    /// When and over which connection the request arrived; `None` means now.
    arrival: Option<Arrival>,
    expiry: Duration,
    slot: Option<SlotWrite>,
    waits: bool,
    at_once: bool,
    is_resolved: bool,
}

impl OrderRequest {
    /// The order of this client with the rights of the client. The order is not sent later than 2 s after it arrived.
    pub fn new(order: Order, origin: Origin, authority: Authority) -> OrderRequest {
        OrderRequest {
            order,
            rest: None,
            origin,
            authority,
            arrival: None,
            expiry: DEFAULT_EXPIRY,
            slot: None,
            waits: false,
            at_once: false,
            is_resolved: false,
        }
    }

    /// Limits the time after its arrival within which the order is sent.
    #[must_use]
    pub fn within(self, expiry: Duration) -> OrderRequest {
        OrderRequest { expiry, ..self }
    }

    /// Sets the arrival, so that the order undoes no stop accepted since.
    #[must_use]
    pub fn arrived(self, arrival: Arrival) -> OrderRequest {
        OrderRequest {
            arrival: Some(arrival),
            ..self
        }
    }

    /// Marks the order as the stop of a command that was understood; the rest, as text, is refused.
    #[must_use]
    pub fn without_rest(self, what: &str, refusal: Refusal) -> OrderRequest {
        OrderRequest {
            rest: Some((what.to_string(), refusal)),
            ..self
        }
    }

    /// Marks the order as following from this write to a slot: both are accepted, or neither is.
    #[must_use]
    pub fn by_slot(self, write: SlotWrite) -> OrderRequest {
        OrderRequest {
            slot: Some(write),
            ..self
        }
    }

    /// Sets whether a start that a guard delays waits up to its expiry; otherwise it is refused.
    #[must_use]
    pub fn waiting(self, waits: bool) -> OrderRequest {
        OrderRequest { waits, ..self }
    }

    /// Marks the order as meant for this machine: the caller knows what its name or unit id meant when it arrived.
    #[must_use]
    pub fn resolved(self) -> OrderRequest {
        OrderRequest {
            is_resolved: true,
            ..self
        }
    }

    /// Excludes a delay of the stop by a guard.
    #[must_use]
    pub fn at_once(self) -> OrderRequest {
        OrderRequest { at_once: true, ..self }
    }
}

/// The stop or the rest of an order, on its way into the queue.
struct Part {
    ticket: Ticket,
    window: Window,
    slot: Option<SlotWrite>,
    at_once: bool,
}

/// State of the drives of a bus when an order is accepted.
struct AtAccept<'a> {
    image: &'a BusImage,
    now: Instant,
    stale_after: Duration,
}

impl Facts for AtAccept<'_> {
    fn seen(&self, drive: DriveIndex) -> Option<DriveFacts<'_>> {
        let reading = self.image.drives.get(drive)?.reading(self.now, self.stale_after);
        Some(DriveFacts {
            reading,
            written: None,
            run: None,
            repeats: None,
        })
    }
}

/// The points a command sets, with their previous values.
pub(super) fn changes(reading: &Reading<'_>, order: &Order) -> Vec<Change> {
    let is = |point: ModelPoint, index: PointIndex| reading.spec.profile.model_index(point) == Some(index);
    match order {
        Order::Points(values) => values
            .iter()
            .map(|(index, new)| Change {
                point: reading
                    .spec
                    .profile
                    .points
                    .get(*index)
                    .map_or_else(|| format!("point {index}"), |p| p.name.clone()),
                old: reading.sample(*index).good(),
                new: *new,
                run: is(ModelPoint::Run, *index).then(|| new.as_bool()),
                resets: is(ModelPoint::FaultReset, *index) && new.as_bool(),
            })
            .collect(),
        Order::Write(pdu) => {
            let (table, items) = written(pdu).unwrap_or((Table::Holding, Vec::new()));
            let runs = |address: u16, word: u16| reading.spec.profile.runs_by(table, address, word);
            let number = |word: u16| Value::Integer(i64::from(word));
            let change = |(address, word): (u16, u16)| Change {
                point: format!("{table} {address}"),
                old: reading
                    .words(table, address, 1)
                    .ok()
                    .and_then(|words| words.first().copied().map(number)),
                new: number(word),
                run: runs(address, word),
                resets: false,
            };
            items.into_iter().map(change).collect()
        }
        Order::Parameter(order) => {
            let number = |raw: RawValue| match raw {
                RawValue::Word(word) => Value::Integer(i64::from(word)),
                RawValue::Float(_) => Value::Number(raw.number()),
            };
            vec![Change {
                point: order.id.clone(),
                old: order.from.map(number),
                new: number(order.to),
                run: None,
                resets: false,
            }]
        }
        Order::Read(_) => Vec::new(),
    }
}

/// Refuses a command, which is audited and counted.
pub fn turn_away(
    command_log: &Arc<CommandLog>,
    drive: &str,
    what: &str,
    outcome: Outcome,
    origin: Origin,
    now: Instant,
) -> Answer {
    let (ticket, _) = Ticket::new(origin, drive, what.to_string(), true, now, command_log.clone());
    ticket.answer(outcome.clone(), now);
    Answer {
        outcome,
        latency: Duration::ZERO,
    }
}

impl BusHandle {
    /// State of the drives when an order is accepted; samples older than `stale_after` are stale.
    pub(super) fn at_accept(&self, stale_after: Duration, now: Instant) -> impl Facts + '_ {
        AtAccept {
            image: &self.image,
            now,
            stale_after,
        }
    }

    /// Gives the drive of `reading`, at index `drive` on this bus, a command of the gateway itself: a point of the
    /// model and its value. No client gives it, so it renews no lease, and no newer reference of a client replaces
    /// it.
    ///
    /// # Errors
    /// If the command is refused; the refusal is neither audited nor counted.
    pub fn own_order(
        &self,
        drive: DriveIndex,
        reading: &Reading<'_>,
        (point, value): (ModelPoint, Value),
        origin: Origin,
        expiry: Duration,
    ) -> Result<oneshot::Receiver<Answer>, Refusal> {
        let (spec, now) = (reading.spec, reading.now);
        let index = spec.profile.model_index(point).ok_or_else(|| {
            let (profile, point) = (&spec.profile.name, point.name());
            Refusal::NotWritable(format!("profile `{profile}` has no `{point}`"))
        })?;
        let order = Order::Points(vec![(index, value)]);
        let changes = changes(reading, &order);
        let mut admitted = admit(order, reading, Authority::Write)?;
        admitted.reference_only = false;
        let what = format!("{}={value}", point.name());
        let (ticket, answer) = Ticket::new(origin, &spec.name, what, true, now, self.command_log.clone());
        let window = Window {
            arrival: Arrival::now(now),
            expires: now + expiry,
            waits: false,
        };
        let ticket = ticket.with_changes(changes);
        let command = Command::new(drive, admitted, &spec.profile, window, ticket);
        self.queue
            .submit(command, &self.at_accept(reading.stale_after, now), now);
        Ok(answer)
    }
}

impl DriveHandle {
    /// Gives the drive an order at `now`; all interfaces use this function. When it returns the order is in the
    /// queue of the bus, behind all earlier ones, or answered: refused if it is not admitted, not sent if the bus
    /// is down or the drive offline. Refused writes are audited and published as an event.
    ///
    /// An order that stops and also does more is audited as two: its stop is carried out whatever happens to the rest.
    ///
    /// An order whose first byte arrived before a reload gave its name to this machine belongs to the machine that
    /// it named then: a stop in it is carried out there, and the rest is carried out nowhere.
    pub fn place(&self, request: OrderRequest, now: Instant) -> Placed {
        let arrival = request.arrival.clone().unwrap_or_else(|| Arrival::now(now));
        let former = (!request.is_resolved).then(|| self.meant(request.origin.kind, &arrival));
        let Some(meant) = former.flatten() else {
            return self.place_here(request, now);
        };
        let refusal = meant_another();
        let what = self.describe(&request.order);
        if let FormerMachine::There(there) = &meant
            && let Some(stop) = there.stop_meant(&request.order, self)
        {
            // The client needs the right where it named the machine, on whatever bus the machine is now.
            let origin = match client_access(Stage::Accept, true, &request.origin, &self.image.spec.bus) {
                Ok(()) => request.origin.lasting(),
                Err(_) => request.origin,
            };
            let order = OrderRequest {
                order: stop,
                origin,
                ..request
            };
            return there.place_here(order.without_rest(&what, refusal), now);
        }
        let write = !matches!(request.order, Order::Read(_));
        let (mut ticket, answer) = self.ticket(&what, Vec::new(), request.origin, write, now);
        let placed = Placed::new(now, answer, ticket.confirmation());
        self.turn_away(ticket, &what, Outcome::Refused(refusal), write, now);
        placed
    }

    /// Places an order that means this machine; otherwise like [`DriveHandle::place`].
    fn place_here(&self, request: OrderRequest, now: Instant) -> Placed {
        let reading = self.reading(now);
        let OrderRequest { order, rest, .. } = request.clone();
        if let Some((what, refusal)) = rest {
            return if self.may_go(&order, &reading, request.authority) {
                self.place_parts(order, (&what, Err(refusal)), request, &reading)
            } else {
                self.place_one(order, request, &reading)
            };
        }
        match Parts::of(order.clone(), &self.image.spec.profile) {
            Parts::Two(stop, rest) if self.may_go(&stop, &reading, request.authority) => {
                let what = self.describe(&rest);
                self.place_parts(stop, (&what, Ok(rest)), request, &reading)
            }
            Parts::Two(..) => self.place_one(order, request, &reading),
            Parts::One(order) => self.place_one(order, request, &reading),
        }
    }

    /// Whether a stop may be passed to the bus.
    fn may_go(&self, stop: &Order, reading: &Reading<'_>, authority: Authority) -> bool {
        self.takes_stops() && admit(stop.clone(), reading, authority).is_ok()
    }

    /// Whether the bus is open, or about to open its port: a stop waits for that.
    fn takes_stops(&self) -> bool {
        self.bus_up() || !self.bus.image.is_tried()
    }

    fn place_one(&self, order: Order, request: OrderRequest, reading: &Reading<'_>) -> Placed {
        let now = reading.now;
        let write = !matches!(order, Order::Read(_));
        let what = self.describe(&order);
        let window = request.window(now);
        let (mut ticket, answer) = self.ticket(&what, changes(reading, &order), request.origin, write, now);
        let placed = Placed::new(now, answer, ticket.confirmation());
        let part = Part {
            ticket,
            window,
            slot: request.slot,
            at_once: request.at_once,
        };
        match self.command(order, part, reading, request.authority) {
            Err(refused) => {
                let (ticket, outcome) = *refused;
                self.turn_away(ticket, &what, outcome, write, now);
            }
            Ok(command) => {
                let (origin, stops) = (command.ticket.origin().clone(), command.is_stop());
                let facts = self.bus.at_accept(self.stale_after, now);
                let refusal = self.bus.queue.submit(command, &facts, now);
                self.report_refusal(&what, refusal, &origin, now);
                if stops {
                    self.events.pauses().note_stop();
                }
            }
        }
        placed
    }

    /// Gives the bus the stop of an order, and then its rest unless that is refused.
    fn place_parts(
        &self,
        stop: Order,
        (what, rest): (&str, Result<Order, Refusal>),
        request: OrderRequest,
        reading: &Reading<'_>,
    ) -> Placed {
        let (now, window) = (reading.now, request.window(reading.now));
        let end = StopEnd::default();
        let sets = changes(reading, &stop);
        let of_stop = self.describe(&stop);
        let (ticket, answer) = self.ticket(&of_stop, sets, request.origin.clone(), true, now);
        let mut ticket = ticket.with_rest(end.clone());
        let placed = Placed::new(now, answer, ticket.confirmation());
        // The stop is counted with the other part, even if a block repeats it.
        let mut sets = rest
            .as_ref()
            .map_or_else(|_| Vec::new(), |order| changes(reading, order));
        sets.iter_mut().for_each(|change| change.run = None);
        let (mut rest_ticket, rest_answer) = self.ticket(what, sets, request.origin.clone(), true, now);
        let placed = placed.with_rest(rest_answer, rest_ticket.confirmation());
        let part = |ticket: Ticket| Part {
            ticket,
            window: window.clone(),
            slot: None,
            at_once: request.at_once,
        };
        let stop = match self.command(stop, part(ticket), reading, request.authority) {
            Ok(stop) => stop,
            Err(refused) => {
                let (ticket, outcome) = *refused;
                self.turn_away(ticket, &of_stop, outcome, true, now);
                rest_ticket.answer(Outcome::NotStopped, now);
                return placed;
            }
        };
        let facts = self.bus.at_accept(self.stale_after, now);
        let rest = match rest {
            Ok(order) => self.command(order, part(rest_ticket), reading, request.authority),
            Err(refusal) => Err(Box::new((rest_ticket, Outcome::Refused(refusal)))),
        };
        match rest {
            Ok(mut rest) => {
                if let Work::Set(set) = &mut rest.work {
                    set.behind = Some(end);
                }
                let [of_stop_refused, of_rest] = self.bus.queue.submit_parts(stop, rest, &facts, now);
                self.report_refusal(&of_stop, of_stop_refused, &request.origin, now);
                self.report_refusal(what, of_rest, &request.origin, now);
            }
            Err(unsent) => {
                let (ticket, outcome) = *unsent;
                let refused = self.bus.queue.submit(stop, &facts, now);
                self.report_refusal(&of_stop, refused, &request.origin, now);
                self.turn_away(ticket, what, outcome, true, now);
            }
        }
        self.events.pauses().note_stop();
        placed
    }

    fn ticket(
        &self,
        what: &str,
        sets: Vec<Change>,
        origin: Origin,
        write: bool,
        now: Instant,
    ) -> (Ticket, oneshot::Receiver<Answer>) {
        let name = &self.image.spec.name;
        let (ticket, answer) = Ticket::new(origin, name, what.to_string(), write, now, self.bus.command_log.clone());
        (ticket.with_changes(sets), answer)
    }

    /// The command for an order that configuration, profile and limits allow, or why the order is refused.
    fn command(
        &self,
        order: Order,
        part: Part,
        reading: &Reading<'_>,
        authority: Authority,
    ) -> Result<Command, Box<(Ticket, Outcome)>> {
        let online = reading.snapshot.link.is_online();
        let admitted = match admit(order, reading, authority) {
            Err(Refusal::NotKnown(_)) if !self.bus_up() => return Err(Box::new((part.ticket, Outcome::BusDown))),
            Err(Refusal::NotKnown(_)) if !online => return Err(Box::new((part.ticket, Outcome::Offline))),
            Err(refusal) => return Err(Box::new((part.ticket, Outcome::Refused(refusal)))),
            Ok(admitted) => admitted,
        };
        let is_stop = admitted.urgency == Urgency::Stop;
        if !self.takes_stops() {
            return Err(Box::new((part.ticket, Outcome::BusDown)));
        }
        let profile = &self.image.spec.profile;
        let mut command = Command::new(self.index, admitted, profile, part.window, part.ticket);
        command.intent.slot = part.slot;
        // A stop is sent even to a drive that does not answer, because the drive may be back.
        let unreachable = match (is_stop, self.bus_up(), online) {
            (true, ..) | (false, true, true) => None,
            (false, false, _) => Some(Outcome::BusDown),
            (false, true, false) => Some(Outcome::Offline),
        };
        if let Some(outcome) = unreachable {
            let refused = self.gate_refuses(&command, reading.now);
            return Err(Box::new((command.ticket, refused.unwrap_or(outcome))));
        }
        if let Work::Stop(stop) = &mut command.work
            && part.at_once
        {
            stop.haste = Haste::AtOnce;
        }
        Ok(command)
    }

    /// Why a command to an unreachable drive would be refused even if the drive could be reached.
    fn gate_refuses(&self, command: &Command, now: Instant) -> Option<Outcome> {
        let facts = self.bus.at_accept(self.stale_after, now);
        match self.bus.queue.lock().gate.judge(Stage::Accept, command, &facts, now) {
            Verdict::Refuse(outcome) => Some(outcome),
            Verdict::Go | Verdict::Wait(_) | Verdict::LookFirst => None,
        }
    }

    /// Answers an order that is not sent. Reads without an answer are not commands and cause no event.
    fn turn_away(&self, ticket: Ticket, what: &str, outcome: Outcome, write: bool, now: Instant) {
        if let Outcome::Refused(refusal) = &outcome
            && write
        {
            self.publish_refusal(what, refusal, ticket.origin(), now);
        }
        ticket.answer(outcome, now);
    }

    /// Publishes the refusal of a command that the gate refused and answered.
    fn report_refusal(&self, what: &str, refusal: Option<Refusal>, origin: &Origin, now: Instant) {
        if let Some(refusal) = refusal {
            self.publish_refusal(what, &refusal, origin, now);
        }
    }

    /// Sends the drive a request of the lowest rank at `now`, at the latest `expiry` later. Returns its result; on
    /// a line that another master owns, the read is refused.
    pub async fn read_in_background(
        &self,
        pdu: RequestPdu,
        pace: Pace,
        origin: Origin,
        expiry: Duration,
        now: Instant,
    ) -> Outcome {
        let reading = self.reading(now);
        let order = match admit(Order::Read(pdu), &reading, Authority::ReadOnly) {
            Ok(admitted) => admitted.order,
            Err(refusal) => return Outcome::Refused(refusal),
        };
        let Order::Read(pdu) = order else {
            return Outcome::Expired;
        };
        if !self.bus_up() {
            return Outcome::BusDown;
        }
        if !reading.snapshot.link.is_online() {
            return Outcome::Offline;
        }
        let name = &self.image.spec.name;
        let (ticket, answer) = Ticket::new(origin, name, String::new(), false, now, self.bus.command_log.clone());
        let request = BackgroundRequest {
            target: self.index.into(),
            pdu,
            pace,
            expires: now + expiry,
            ticket,
            passed_on: None,
        };
        self.bus.queue.submit_background(request, now);
        // A dropped ticket answers too, so a closed channel can only mean that the process ends.
        answer.await.map_or(Outcome::ShuttingDown, |answer| answer.outcome)
    }

    /// Refuses an order before it became a command; the refusal is audited, counted and published like any other.
    pub fn refuse(&self, what: &str, refusal: Refusal, origin: Origin, now: Instant) -> Answer {
        self.publish_refusal(what, &refusal, &origin, now);
        let name = &self.image.spec.name;
        turn_away(
            &self.bus.command_log,
            name,
            what,
            Outcome::Refused(refusal),
            origin,
            now,
        )
    }

    /// Publishes that a command was refused; many refusals are published as a count.
    fn publish_refusal(&self, what: &str, refusal: &Refusal, origin: &Origin, now: Instant) {
        let what = if what.is_empty() { "an empty command" } else { what };
        let spec = &self.image.spec;
        let refused = RefusedCommand {
            client: origin.client(),
            reason: refusal.code(),
            kind: refusal.event_kind(),
            bus: &spec.bus,
            drive: &spec.name,
            text: format!("refused {what} from {} {}: {refusal}", origin.kind.name(), origin.who),
        };
        self.events.publish_refusal(refused, now);
    }

    fn describe(&self, order: &Order) -> String {
        match order {
            Order::Points(values) => {
                let name = |i: PointIndex| self.image.spec.profile.points.get(i).map_or("?", |p| p.name.as_str());
                let parts: Vec<String> = values
                    .iter()
                    .map(|(i, v): &(PointIndex, Value)| format!("{}={v}", name(*i)))
                    .collect();
                parts.join(" ")
            }
            Order::Parameter(order) => order.what(),
            Order::Write(pdu) | Order::Read(pdu) => describe::request_on(self.bus.image.spec.protocol, pdu),
        }
    }
}

impl OrderRequest {
    fn window(&self, now: Instant) -> Window {
        let arrival = self.arrival.clone().unwrap_or_else(|| Arrival::now(now));
        Window {
            expires: arrival.asked + self.expiry,
            arrival,
            waits: self.waits,
        }
    }
}
