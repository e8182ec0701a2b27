//! Placing commands in the queue of a bus, and refusing those that cannot be placed.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use super::{BusHandle, DriveHandle, Manner, Placed};
use crate::codec::{RequestPdu, Table, describe};
use crate::command::{
    self, Admitted, Answer, Authority, BackgroundRequest, Change, Command, Effect, Order, Origin, Outcome, Pace, Parts,
    Refusal, SlotWrite, StopEnd, Ticket, Urgency, WriteStats,
};
use crate::drive::parameters::RawValue;
use crate::drive::{DriveIndex, ModelPoint, PointIndex, Value};
use crate::event::RefusedCommand;
use crate::permit::Moment;
use crate::permit::rules::client_access;
use crate::process_image::Reading;

/// Who gives a command, what that client may do at all, until when it may be sent, when its head came, and now.
struct Terms {
    origin: Origin,
    authority: Authority,
    expires: Instant,
    asked: Instant,
    now: Instant,
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
            let (table, items) = command::written(pdu).unwrap_or((Table::Holding, Vec::new()));
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

/// Refuses a command; audited and counted.
pub fn turn_away(
    writes: &Arc<WriteStats>,
    drive: &str,
    what: &str,
    outcome: Outcome,
    origin: Origin,
    now: Instant,
) -> Answer {
    let (ticket, _) = Ticket::new(origin, drive, what.to_string(), true, now, writes.clone());
    ticket.answer(outcome.clone(), now);
    Answer {
        outcome,
        latency: Duration::ZERO,
    }
}

impl BusHandle {
    /// Gives the drive of `reading`, at place `drive` on this bus, a command of the gateway itself: a point of the
    /// model and its value. No client is after it, so it renews no lease, and no newer reference of a client takes its
    /// place.
    ///
    /// # Errors
    /// The refusal; it is neither audited nor counted.
    pub fn own_order(
        &self,
        drive: DriveIndex,
        reading: &Reading<'_>,
        (point, value): (ModelPoint, Value),
        origin: Origin,
        expiry: Duration,
        writes: &Arc<WriteStats>,
    ) -> Result<oneshot::Receiver<Answer>, Refusal> {
        let (spec, now) = (reading.spec, reading.now);
        let index = spec.profile.model_index(point).ok_or_else(|| {
            let (profile, point) = (&spec.profile.name, point.name());
            Refusal::NotWritable(format!("profile `{profile}` has no `{point}`"))
        })?;
        let order = Order::Points(vec![(index, value)]);
        let changes = changes(reading, &order);
        let mut admitted = command::admit(order, reading, Authority::Write)?;
        admitted.reference_only = false;
        let what = format!("{}={value}", point.name());
        let (ticket, answer) = Ticket::new(origin, &spec.name, what, true, now, writes.clone());
        let command = Command::new(drive, admitted, now + expiry, ticket.with_changes(changes));
        let command = command.asked_of(&spec.profile, now);
        self.queue.submit(command, now);
        Ok(answer)
    }
}

impl DriveHandle {
    /// Gives a command to the drive, at `now`. When this returns it is in the queue of the bus, behind all that was
    /// placed before, or answered: refused when it is not admitted, not sent when the bus is down or the drive offline.
    ///
    /// `authority` says what the client may do at all. The order is not sent later than `expiry` from now. Refused
    /// writes are audited and published as an event. Of a command that stops and does more, the stop is carried out
    /// whatever becomes of the rest; it is audited as two.
    pub fn place(&self, order: Order, origin: Origin, authority: Authority, expiry: Duration, now: Instant) -> Placed {
        self.place_asked(order, origin, authority, expiry, now, now)
    }

    /// The same of a command whose head came at `asked`: no stop that came in since is undone by it.
    pub fn place_asked(
        &self,
        order: Order,
        origin: Origin,
        authority: Authority,
        expiry: Duration,
        asked: Instant,
        now: Instant,
    ) -> Placed {
        let reading = self.reading(now);
        let terms = Terms {
            origin,
            authority,
            expires: now + expiry,
            asked,
            now,
        };
        match Parts::of(order.clone(), &self.image.spec.profile) {
            Parts::Two(stop, rest) if self.may_go(&stop, &reading, authority) => {
                let what = self.describe(&rest);
                self.place_parts(stop, (&what, Ok(rest)), terms)
            }
            Parts::Two(..) => self.place_one(order, None, terms),
            Parts::One(order) => self.place_one(order, None, terms),
        }
    }

    /// As [`DriveHandle::place`] for a command whose stop was understood and whose rest, `what`, is refused.
    pub fn place_stop(
        &self,
        stop: Order,
        (what, refusal): (&str, Refusal),
        origin: Origin,
        authority: Authority,
        expiry: Duration,
        now: Instant,
    ) -> Placed {
        let terms = Terms {
            origin,
            authority,
            expires: now + expiry,
            asked: now,
            now,
        };
        match self.may_go(&stop, &self.reading(now), authority) {
            true => self.place_parts(stop, (what, Err(refusal)), terms),
            false => self.place_one(stop, None, terms),
        }
    }

    /// Whether a stop goes to the bus.
    fn may_go(&self, stop: &Order, reading: &Reading<'_>, authority: Authority) -> bool {
        self.takes_stops() && command::admit(stop.clone(), reading, authority).is_ok()
    }

    /// Whether the bus is open, or about to open its port: a stop waits for that.
    fn takes_stops(&self) -> bool {
        self.bus_up() || !self.bus.image.is_tried()
    }

    /// The order that follows from a write to a slot; both are accepted, or neither is.
    pub fn place_slot(
        &self,
        order: Order,
        write: SlotWrite,
        origin: Origin,
        expiry: Duration,
        (asked, now): (Instant, Instant),
    ) -> Placed {
        let terms = Terms {
            origin,
            authority: Authority::Write,
            expires: now + expiry,
            asked,
            now,
        };
        self.place_one(order, Some(write), terms)
    }

    fn place_one(&self, order: Order, write_to: Option<SlotWrite>, terms: Terms) -> Placed {
        let Terms {
            origin, expires, now, ..
        } = terms;
        let reading = self.reading(now);
        let write = !matches!(order, Order::Read(_));
        let what = self.describe(&order);
        let (mut ticket, answer) = self.ticket(&what, changes(&reading, &order), origin, write, now);
        let placed = Placed::new(now, answer, ticket.confirmation());
        match self.judge(order, ticket.origin(), &reading, terms.authority, expires) {
            Err(outcome) => self.turn_away(ticket, &what, outcome, write, now),
            Ok(admitted) => {
                let command = Command::new(self.index, admitted, expires, ticket).of_slot(write_to);
                let command = command.asked_of(&self.image.spec.profile, terms.asked);
                self.bus.queue.submit(self.in_manner(command), now);
            }
        }
        placed
    }

    /// The stop of a command goes to the bus, and its rest after it unless it is refused.
    fn place_parts(&self, stop: Order, (what, rest): (&str, Result<Order, Refusal>), terms: Terms) -> Placed {
        let Terms {
            origin,
            authority,
            expires,
            asked,
            now,
        } = terms;
        let reading = self.reading(now);
        let end = StopEnd::default();
        let sets = changes(&reading, &stop);
        let (ticket, answer) = self.ticket(&self.describe(&stop), sets, origin.clone(), true, now);
        let mut ticket = ticket.with_rest(end.clone());
        let placed = Placed::new(now, answer, ticket.confirmation());
        // The stop is the other part's, also where a block repeats it.
        let mut sets = rest
            .as_ref()
            .map_or_else(|_| Vec::new(), |order| changes(&reading, order));
        sets.iter_mut().for_each(|change| change.run = None);
        let (mut rest_ticket, rest_answer) = self.ticket(what, sets, origin, true, now);
        let placed = placed.with_rest(rest_answer, rest_ticket.confirmation());
        let stop = match self.judge(stop, ticket.origin(), &reading, authority, expires) {
            Ok(admitted) => {
                let stop = Command::new(self.index, admitted, expires, ticket);
                self.in_manner(stop.asked_of(&self.image.spec.profile, now))
            }
            Err(outcome) => {
                self.turn_away(ticket, what, outcome, true, now);
                rest_ticket.answer(Outcome::NotStopped, now);
                return placed;
            }
        };
        let judged = match rest {
            Ok(order) => self.judge(order, rest_ticket.origin(), &reading, authority, expires),
            Err(refusal) => Err(Outcome::Refused(refusal)),
        };
        match judged {
            Ok(admitted) => {
                let rest = Command::new(self.index, admitted, expires, rest_ticket).behind(end);
                let rest = rest.asked_of(&self.image.spec.profile, asked);
                self.bus.queue.submit_parts(stop, rest, now);
            }
            Err(outcome) => {
                self.bus.queue.submit(stop, now);
                self.turn_away(rest_ticket, what, outcome, true, now);
            }
        }
        placed
    }

    fn in_manner(&self, command: Command) -> Command {
        Command {
            waits: self.manner == Manner::Waits,
            is_urgent: self.manner == Manner::AtOnce,
            ..command
        }
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
        let (ticket, answer) = Ticket::new(origin, name, what.to_string(), write, now, self.writes.clone());
        (ticket.with_changes(sets), answer)
    }

    /// Decides whether a command may be sent, or why not.
    fn judge(
        &self,
        order: Order,
        origin: &Origin,
        reading: &Reading<'_>,
        authority: Authority,
        expires: Instant,
    ) -> Result<Admitted, Outcome> {
        let online = reading.snapshot.link.is_online();
        let admitted = match command::admit(order, reading, authority) {
            Err(Refusal::NotKnown(_)) if !self.bus_up() => return Err(Outcome::BusDown),
            Err(Refusal::NotKnown(_)) if !online => return Err(Outcome::Offline),
            admitted => admitted.map_err(Outcome::Refused)?,
        };
        let is_stop = admitted.urgency == Urgency::Stop;
        if admitted.urgency != Urgency::Read {
            let bus = &self.image.spec.bus;
            client_access(Moment::Accept, is_stop, origin, bus).map_err(Outcome::Refused)?;
        }
        if let Some(refusal) = self.hold_refuses(&admitted, origin, reading.now) {
            return Err(Outcome::Refused(refusal));
        }
        if (!is_stop && !self.bus_up()) || !self.takes_stops() {
            return Err(Outcome::BusDown);
        }
        // A stop goes to a drive that does not answer too: it may be back.
        if !online && !is_stop {
            return Err(Outcome::Offline);
        }
        let held_back = || {
            let effect = Effect::of(&admitted.order, &self.image.spec.profile);
            let until = (self.manner == Manner::Waits).then_some(expires);
            let queue = self.bus.queue.lock();
            let held_back = queue.held_back(self.index, origin, effect);
            held_back.or_else(|| queue.guarded(self.index, effect, until, reading.now))
        };
        // Judged once more when it is accepted.
        match (admitted.urgency == Urgency::Command).then(held_back).flatten() {
            Some(refusal) => Err(Outcome::Refused(refusal)),
            None => Ok(admitted),
        }
    }

    /// Answers a command that is not sent. Reads that nothing answers are no commands, and no event.
    fn turn_away(&self, ticket: Ticket, what: &str, outcome: Outcome, write: bool, now: Instant) {
        if let Outcome::Refused(refusal) = &outcome
            && write
        {
            self.publish_refusal(what, refusal, ticket.origin(), now);
        }
        ticket.answer(outcome, now);
    }

    /// Asks the drive for something at the lowest rank, at `now`; nothing is sent later than `expiry` from now. The
    /// result of it; a read on a line that another master owns is refused.
    pub async fn read_in_background(
        &self,
        pdu: RequestPdu,
        pace: Pace,
        origin: Origin,
        expiry: Duration,
        now: Instant,
    ) -> Outcome {
        let reading = self.reading(now);
        let order = match command::admit(Order::Read(pdu), &reading, Authority::ReadOnly) {
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
        let (ticket, answer) = Ticket::new(origin, name, String::new(), false, now, self.writes.clone());
        let request = BackgroundRequest {
            drive: self.index,
            pdu,
            pace,
            expires: now + expiry,
            ticket,
            passed_on: None,
        };
        self.bus.queue.submit_background(request, now);
        // A ticket answers even when it is dropped; a lost sender can only mean that the process ends.
        answer.await.map_or(Outcome::ShuttingDown, |answer| answer.outcome)
    }

    /// Refuses a command before it became a command; audited, counted and published like any other refusal.
    pub fn refuse(&self, what: &str, refusal: Refusal, origin: Origin, now: Instant) -> Answer {
        self.publish_refusal(what, &refusal, &origin, now);
        let name = &self.image.spec.name;
        turn_away(&self.writes, name, what, Outcome::Refused(refusal), origin, now)
    }

    /// Publishes that a command was refused; a flood of them is counted.
    fn publish_refusal(&self, what: &str, refusal: &Refusal, origin: &Origin, now: Instant) {
        let what = if what.is_empty() { "an empty command" } else { what };
        let spec = &self.image.spec;
        let refused = RefusedCommand {
            client: origin.client(),
            reason: refusal.code(),
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
