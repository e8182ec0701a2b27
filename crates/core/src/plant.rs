//! What the north sides see: images to read from, queues to write into. No clock: time is an argument.

mod exchange;
mod hold;
mod placed;
mod why;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use arc_swap::ArcSwap;
use tokio::sync::oneshot;

use crate::codec::{RequestPdu, Table, describe};
use crate::command::{
    self, Admitted, Answer, Authority, BackgroundRequest, Change, Command, CommandQueue, Effect, Order, Origin,
    Outcome, Pace, Parts, Priorities, Refusal, SlotWrite, StopEnd, Ticket, Urgency, WriteStats,
};
use crate::drive::parameters::RawValue;
use crate::drive::why::Explanation;
use crate::drive::{ModelPoint, Value};
use crate::event::{Event, Events, RefusedCommand};
use crate::history::{History, Recordings};
use crate::parameters::Vault;
use crate::process_image::{Access, BusImage, DriveImage, Machine, Reading};
use crate::stop_all::StopAll;

pub use self::exchange::{Exchange, Question, Target};
pub use self::placed::{Placed, Shown};
pub use self::why::explain;

/// The plant as it is configured now; a reload puts a new one in its place.
pub type SharedPlant = Arc<ArcSwap<Plant>>;

/// Where the stops of the next drive are counted from that is started or added.
static ADDED: AtomicU64 = AtomicU64::new(STOPS_OF_ONE);
/// More stops than one drive gets. Few enough that the stops of all drives of a bus can be added, after any number of reloads.
const STOPS_OF_ONE: u64 = 1 << 32;

/// One bus: its image and its queue.
#[derive(Debug, Clone)]
pub struct BusHandle {
    /// What is known.
    pub image: Arc<BusImage>,
    /// What is wanted.
    pub queue: Arc<CommandQueue>,
}

impl BusHandle {
    /// Takes over what the stopped buses `before` a reload know of its drives, and the stops that wait there; a drive is the
    /// same if it is the same machine, whatever its name.
    /// The stops of one that is added are counted from a number that no drive had before: what was remembered of a drive by
    /// that name is outdated.
    pub fn take_over(&self, before: &[BusHandle], now: Instant) {
        for (index, drive) in self.image.drives.iter().enumerate() {
            let machine = self.image.spec.machine(&drive.spec);
            let known = before.iter().find_map(|bus| {
                let same = |image: &Arc<DriveImage>| bus.image.spec.machine(&image.spec) == machine;
                Some((bus, bus.image.drives.iter().position(same)?))
            });
            let holding = known.and_then(|(bus, place)| bus.queue.lock().holding(place));
            let (commander, stops, priorities) = match known {
                Some((bus, place)) => {
                    if let Some(image) = bus.image.drives.get(place) {
                        drive.take_over(image);
                    }
                    let mut queue = bus.queue.lock();
                    let priorities = queue.priorities(place).clone();
                    (queue.commander(place).cloned(), queue.stops(place), priorities)
                }
                None => (
                    None,
                    ADDED.fetch_add(STOPS_OF_ONE, Ordering::Relaxed),
                    Priorities::default(),
                ),
            };
            let mut queue = self.queue.lock();
            queue.take_over(index, commander, stops, priorities);
            if let Some(holding) = holding {
                queue.take_over_holding(index, holding);
            }
            drop(queue);
            // What is only monitored from now on is sent nothing.
            if let Some((bus, place)) = known.filter(|_| drive.spec.access == Access::Control) {
                bus.queue.hand_over(place, &self.queue, index, now);
            }
        }
    }
}

/// All buses of the gateway.
#[derive(Debug)]
pub struct Plant {
    /// Name of the gateway: topics, metric label.
    pub gateway: String,
    /// Age from which a sample of process data is stale.
    pub stale_after: Duration,
    /// In the order of the file.
    pub buses: Vec<BusHandle>,
    /// What happens.
    pub events: Events,
    /// Counters of commands.
    pub writes: Arc<WriteStats>,
    /// What the recorder has kept.
    pub recordings: Arc<Recordings>,
    /// Orders that stop all drives.
    pub stop_all: Arc<StopAll>,
    /// Readings of parameters.
    pub parameters: Arc<Vault>,
    /// The past of the drives.
    pub history: Arc<History>,
}

/// One drive and the way to it.
#[derive(Debug, Clone)]
pub struct DriveHandle {
    /// Its bus.
    pub bus: BusHandle,
    /// Index on the bus.
    pub index: usize,
    /// What is known.
    pub image: Arc<DriveImage>,
    stale_after: Duration,
    events: Events,
    writes: Arc<WriteStats>,
    manner: Manner,
}

/// How orders are placed that guards of starts would refuse or delay.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Manner {
    /// A start that must wait is refused, an ordinary stop is delayed.
    #[default]
    Usual,
    /// A start that must wait does so.
    Waits,
    /// No stop is delayed.
    AtOnce,
}

/// What an order sets, with the values that are known before it.
fn changes(reading: &Reading<'_>, order: &Order) -> Vec<Change> {
    let is = |point: ModelPoint, index: usize| reading.spec.profile.model_index(point) == Some(index);
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

/// Answers a command that is not taken; audited and counted.
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
    /// Gives the drive of `reading`, at place `drive` on this bus, an order of the gateway itself: a point of the model and
    /// its value. No client is behind it, so it renews no lease, and no newer reference of a client takes its place.
    ///
    /// # Errors
    /// The refusal; it is neither audited nor counted.
    pub fn own_order(
        &self,
        drive: usize,
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

impl Plant {
    /// Logs and publishes the refusals that were held back for their count and are due at `now`; to be called several
    /// times a second.
    pub fn report_refusals(&self, now: Instant) {
        self.events.publish_due(now);
        self.writes.audit().record_due(now);
    }

    /// Refuses a command to a drive that there is not; audited and counted. `why` names the nearest one.
    pub fn refuse_unknown(&self, drive: &str, what: &str, why: String, origin: Origin, now: Instant) -> Answer {
        let outcome = Outcome::Refused(Refusal::UnknownDrive(why));
        turn_away(&self.writes, drive, what, outcome, origin, now)
    }

    /// All drives, bus by bus in the order of the file.
    pub fn drives(&self) -> impl Iterator<Item = DriveHandle> {
        self.buses.iter().flat_map(move |bus| {
            bus.image
                .drives
                .iter()
                .enumerate()
                .map(move |(index, image)| self.handle(bus, index, image))
        })
    }

    /// The drive of that name.
    pub fn drive(&self, name: &str) -> Option<DriveHandle> {
        self.buses.iter().find_map(|bus| {
            let index = bus.image.drives.iter().position(|drive| drive.spec.name == name)?;
            Some(self.handle(bus, index, bus.image.drives.get(index)?))
        })
    }

    /// The drive that is that machine.
    pub fn drive_at(&self, machine: &Machine) -> Option<DriveHandle> {
        self.drives().find(|drive| drive.machine() == *machine)
    }

    fn handle(&self, bus: &BusHandle, index: usize, image: &Arc<DriveImage>) -> DriveHandle {
        DriveHandle {
            bus: bus.clone(),
            index,
            image: image.clone(),
            stale_after: self.stale_after,
            events: self.events.clone(),
            writes: self.writes.clone(),
            manner: Manner::default(),
        }
    }
}

impl DriveHandle {
    /// The same, whose orders wait where a guard lets their start wait, within their expiry.
    #[must_use]
    pub fn waiting(mut self, waits: bool) -> DriveHandle {
        self.manner = if waits { Manner::Waits } else { Manner::Usual };
        self
    }

    /// The same, whose stops no guard delays.
    #[must_use]
    pub fn at_once(mut self) -> DriveHandle {
        self.manner = Manner::AtOnce;
        self
    }

    /// For how long the stop that waits for the drive still does so, by `min_run`.
    pub fn stop_waits(&self, now: Instant) -> Option<Duration> {
        self.bus.queue.guards()?;
        let until = self.bus.queue.lock().stop_waits(self.index, now)?;
        Some(until.saturating_duration_since(now))
    }

    /// Which machine it is, whatever its name.
    pub fn machine(&self) -> Machine {
        self.bus.image.spec.machine(&self.image.spec)
    }

    /// The drive as it looks at `now`.
    pub fn reading(&self, now: Instant) -> Reading<'_> {
        self.image.reading(now, self.stale_after)
    }

    /// Stops of the drive that were taken in, from some number on; another one when a reload removed and added the drive, or
    /// changed its address.
    pub fn stops(&self) -> u64 {
        self.bus.queue.lock().stops(self.index)
    }

    /// The login that commanded the drive last, unless another client did since.
    pub fn commander(&self) -> Option<Arc<str>> {
        self.bus.queue.lock().commander(self.index).cloned()
    }

    /// Whether the drive of `reading` runs, and why not.
    pub fn why(&self, reading: &Reading<'_>) -> Explanation {
        let explanation = explain(reading, &self.bus.image, &self.writes);
        let mut explanation = self.with_reservation(explanation, reading.now);
        let guards = self.bus.queue.guards().filter(|_| explanation.runs == Some(false));
        if let Some(hindrance) = guards.and_then(|guards| guards.hindrance(self.index, reading.now)) {
            explanation.add(why::guarded(&hindrance));
        }
        explanation
    }

    /// Whether the bus is open.
    pub fn bus_up(&self) -> bool {
        self.bus.image.is_up()
    }

    /// Gives an order to the drive, at `now`. When this returns it is in the queue of the bus, behind all that was placed
    /// before, or answered: refused when it is not admitted, not sent when the bus is down or the drive offline.
    ///
    /// `authority` says what the client may do at all. The order is not sent later than `expiry` from now. Refused writes
    /// are audited and published as an event. Of an order that stops and does more, the stop is carried out whatever becomes of
    /// the rest; it is audited as two.
    pub fn place(&self, order: Order, origin: Origin, authority: Authority, expiry: Duration, now: Instant) -> Placed {
        self.place_asked(order, origin, authority, expiry, now, now)
    }

    /// The same of an order whose head came at `asked`: no stop that came in since is undone by it.
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
        match Parts::of(order.clone(), &self.image.spec.profile) {
            Parts::Two(stop, rest) if self.may_go(&stop, &reading, authority) => {
                let what = self.describe(&rest);
                self.place_parts(stop, (&what, Ok(rest)), origin, authority, expiry, (asked, now))
            }
            Parts::Two(..) => self.place_one(order, None, origin, authority, expiry, (asked, now)),
            Parts::One(order) => self.place_one(order, None, origin, authority, expiry, (asked, now)),
        }
    }

    /// As [`DriveHandle::place`] for an order whose stop was understood and whose rest, `what`, is refused.
    pub fn place_stop(
        &self,
        stop: Order,
        (what, refusal): (&str, Refusal),
        origin: Origin,
        authority: Authority,
        expiry: Duration,
        now: Instant,
    ) -> Placed {
        if !self.may_go(&stop, &self.reading(now), authority) {
            return self.place_one(stop, None, origin, authority, expiry, (now, now));
        }
        self.place_parts(stop, (what, Err(refusal)), origin, authority, expiry, (now, now))
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
        self.place_one(order, Some(write), origin, Authority::Write, expiry, (asked, now))
    }

    /// Calls `with` for the priority arrays of the drive.
    pub fn priorities<T>(&self, with: impl FnOnce(&mut Priorities) -> T) -> T {
        with(self.bus.queue.lock().priorities(self.index))
    }

    fn place_one(
        &self,
        order: Order,
        write_to: Option<SlotWrite>,
        origin: Origin,
        authority: Authority,
        expiry: Duration,
        (asked, now): (Instant, Instant),
    ) -> Placed {
        let reading = self.reading(now);
        let write = !matches!(order, Order::Read(_));
        let what = self.describe(&order);
        let (mut ticket, answer) = self.ticket(&what, changes(&reading, &order), origin, write, now);
        let placed = Placed::new(now, answer, ticket.confirmation());
        match self.judge(order, ticket.origin(), &reading, authority, now + expiry) {
            Err(outcome) => self.turn_away(ticket, &what, outcome, write, now),
            Ok(admitted) => {
                let command = Command::new(self.index, admitted, now + expiry, ticket).of_slot(write_to);
                let command = command.asked_of(&self.image.spec.profile, asked);
                self.bus.queue.submit(self.in_manner(command), now);
            }
        }
        placed
    }

    /// The stop of an order goes to the bus, and its rest behind it unless it is refused.
    fn place_parts(
        &self,
        stop: Order,
        (what, rest): (&str, Result<Order, Refusal>),
        origin: Origin,
        authority: Authority,
        expiry: Duration,
        (asked, now): (Instant, Instant),
    ) -> Placed {
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
        let stop = match self.judge(stop, ticket.origin(), &reading, authority, now + expiry) {
            Ok(admitted) => {
                let stop = Command::new(self.index, admitted, now + expiry, ticket);
                self.in_manner(stop.asked_of(&self.image.spec.profile, now))
            }
            Err(outcome) => {
                self.turn_away(ticket, what, outcome, true, now);
                rest_ticket.answer(Outcome::NotStopped, now);
                return placed;
            }
        };
        let judged = match rest {
            Ok(order) => self.judge(order, rest_ticket.origin(), &reading, authority, now + expiry),
            Err(refusal) => Err(Outcome::Refused(refusal)),
        };
        match judged {
            Ok(admitted) => {
                let rest = Command::new(self.index, admitted, now + expiry, rest_ticket).behind(end);
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

    /// What becomes of an order at once: why it is not sent, or that it may be.
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
        if let Some(refusal) = self.hold_refuses(&admitted, origin, reading.now) {
            return Err(Outcome::Refused(refusal));
        }
        let is_stop = admitted.urgency == Urgency::Stop;
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

    /// Answers an order that is not sent. Reads that nothing answers are no commands, and no event.
    fn turn_away(&self, ticket: Ticket, what: &str, outcome: Outcome, write: bool, now: Instant) {
        if let Outcome::Refused(refusal) = &outcome
            && write
        {
            self.publish_refusal(what, refusal, ticket.origin(), now);
        }
        ticket.answer(outcome, now);
    }

    /// Asks the drive for something at the lowest rank, at `now`; nothing is sent later than `expiry` from now. What came of
    /// it; a read on a line that another master owns is refused.
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

    /// Publishes what happened to the drive.
    pub fn publish(&self, event: Event) {
        self.events.publish(event);
    }

    /// Refuses a command before it became an order; audited, counted and published like any other refusal.
    pub fn refuse(&self, what: &str, refusal: Refusal, origin: Origin, now: Instant) -> Answer {
        self.publish_refusal(what, &refusal, &origin, now);
        let name = &self.image.spec.name;
        turn_away(&self.writes, name, what, Outcome::Refused(refusal), origin, now)
    }

    /// Passes a request on to the line of the drive, as [`BusHandle::ask`].
    pub fn ask_line(&self, question: Question, now: Instant) -> Exchange {
        self.bus.ask(question, &self.writes, now)
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
                let name = |i: usize| self.image.spec.profile.points.get(i).map_or("?", |p| p.name.as_str());
                let parts: Vec<String> = values
                    .iter()
                    .map(|(i, v): &(usize, Value)| format!("{}={v}", name(*i)))
                    .collect();
                parts.join(" ")
            }
            Order::Parameter(order) => order.what(),
            Order::Write(pdu) | Order::Read(pdu) => describe::request_on(self.bus.image.spec.protocol, pdu),
        }
    }
}
