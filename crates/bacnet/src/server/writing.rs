//! Writes (clauses 15.9, 15.10): each is given out as a job and answered when its result is known.
//!
//! A repeated request joins the one in progress. After the end of the request, a stop is carried out again;
//! anything else is answered from memory for some time, unless another client gave an order since: a late duplicate
//! starts nothing.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::reading::Failure;
use super::{Application, Server};
use crate::apdu;
use crate::encoding::Writer;
use crate::object::{Access, Datum, Device, Kind, Object};
use crate::services::{self, PropertyRef, WriteItem, confirmed};
use crate::types::{Address, Data, Error, Mac, ObjectId, ObjectType, PropertyId, WILDCARD};

/// Time for which an answer is remembered.
const REMEMBERED: Duration = Duration::from_secs(10);
/// Limits of the number of requests in progress or remembered: for one host, and for all hosts. Stops are accepted
/// beyond these limits.
const MOST_OF_HOST: usize = 64;
const MOST_REQUESTS: usize = 1024;
/// Requests beyond [`MOST_REQUESTS`] for which stops find room.
const FOR_STOPS: usize = 256;

/// A write to carry out.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    /// Identifies the job in [`Server::written`].
    pub token: u64,
    /// The client that writes.
    pub from: Address,
    /// Instance of the device that is written.
    pub device: u32,
    /// The object to write, by its index in the device; an index without an object if the device no longer has it.
    pub place: usize,
    /// The object to write.
    pub object: ObjectId,
    /// The value to write; `None` releases the slot.
    pub value: Option<Datum>,
    /// The slot, of an object with priorities.
    pub priority: Option<u8>,
    /// When the request of the write arrived.
    pub requested_at: Instant,
    /// When this write was started: at the arrival of the request, or when the previous write of the request was answered.
    pub since: Instant,
}

#[derive(Debug)]
enum State {
    Running,
    Done { answer: Vec<u8>, at: Instant, orders: u64 },
}

#[derive(Debug)]
struct Exchange {
    token: u64,
    from: Address,
    device: u32,
    /// The station that was addressed, and that answers even if no device has it any more.
    station: Option<Mac>,
    invoke: u8,
    service: u8,
    request: Box<[u8]>,
    requested_at: Instant,
    rest: VecDeque<WriteItem>,
    /// The write in progress.
    current: Option<(ObjectId, PropertyRef)>,
    failed: Option<(Failure, Option<(ObjectId, PropertyRef)>)>,
    /// The client has sent another request with the same invoke id since then: this answer is not sent.
    mute: bool,
    state: State,
}

/// Writes in progress, and remembered results.
#[derive(Debug, Default)]
pub(super) struct Exchanges {
    all: VecDeque<Exchange>,
    tokens: u64,
}

impl Exchanges {
    /// Notes another request of the client to the device: the answers to its earlier requests are forgotten, as
    /// they cannot be repeated any more.
    pub(super) fn next_request(&mut self, from: Address, device: u32) {
        self.all
            .retain(|e| matches!(e.state, State::Running) || (e.from, e.device) != (from, device));
    }

    pub(super) fn poll(&mut self, now: Instant) {
        self.all.retain(|e| match e.state {
            State::Running => true,
            State::Done { at, .. } => now.saturating_duration_since(at) < REMEMBERED,
        });
    }

    pub(super) fn is_busy(&self) -> bool {
        self.all.iter().any(|e| matches!(e.state, State::Running))
    }

    /// The instances of the devices that are or were written.
    pub(super) fn devices(&mut self) -> impl Iterator<Item = &mut u32> {
        self.all.iter_mut().map(|exchange| &mut exchange.device)
    }

    fn find(&self, from: Address, device: u32, invoke: u8) -> Option<&Exchange> {
        let is = |e: &&Exchange| (e.from, e.device, e.invoke) == (from, device, invoke) && !e.mute;
        self.all.iter().rev().find(is)
    }

    pub(super) fn is_running(&self, token: u64) -> bool {
        self.all
            .iter()
            .any(|e| e.token == token && matches!(e.state, State::Running))
    }

    fn running(&mut self, token: u64) -> Option<&mut Exchange> {
        let is = |e: &&mut Exchange| e.token == token && matches!(e.state, State::Running);
        self.all.iter_mut().find(is)
    }

    /// Makes room for one more request. Returns false if all remembered requests are in progress.
    fn make_room(&mut self, from: Address, stops: bool) -> bool {
        let is_done = |e: &Exchange| matches!(e.state, State::Done { .. });
        let own = |e: &Exchange| e.from.ip() == from.ip();
        if self.all.iter().filter(|e| own(e)).count() >= MOST_OF_HOST {
            match self.all.iter().position(|e| own(e) && is_done(e)) {
                Some(oldest) => drop(self.all.remove(oldest)),
                None if stops => {}
                None => return false,
            }
        }
        if self.all.len() >= MOST_REQUESTS {
            match self.all.iter().position(is_done) {
                Some(oldest) => drop(self.all.remove(oldest)),
                None => return stops && self.all.len() < MOST_REQUESTS + FOR_STOPS,
            }
        }
        true
    }
}

/// The immediate result of a write.
enum Step {
    /// The item needs no job: the write is complete.
    Done,
    /// The write is handed out to the application as a job.
    Job(usize, Option<Datum>, Option<u8>),
}

impl Server {
    pub(super) fn write_request(
        &mut self,
        from: Address,
        device: &Arc<Device>,
        (invoke, service): (u8, u8),
        data: &[u8],
        app: &dyn Application,
        now: Instant,
    ) {
        let items = match service {
            confirmed::WRITE_PROPERTY => services::write_property(data).map(|item| VecDeque::from([item])),
            _ => services::write_property_multiple(data).map(VecDeque::from),
        };
        let instance = device.instance;
        let answers = app.answers(instance);
        let stops = items.iter().flatten().any(|item| app.stops(instance, item));
        // The device does not answer, like one that is switched off, but it can be stopped.
        if !answers && !stops {
            return;
        }
        match self
            .exchanges
            .find(from, instance, invoke)
            .map(|known| (known, &known.state))
        {
            Some((known, State::Running)) if *known.request == *data && known.service == service => return,
            Some((known, State::Done { answer, orders, .. }))
                if *known.request == *data && known.service == service && !stops =>
            {
                let answer = answer.clone();
                return if *orders == app.orders(instance) {
                    self.send(from, instance, &answer, now)
                } else {
                    self.refuse(
                        from,
                        device,
                        (invoke, service),
                        Error::SERVICE_REQUEST_DENIED.into(),
                        now,
                    )
                };
            }
            _ => {}
        }
        self.exchanges.next_request(from, instance);
        let items = match items {
            Ok(items) => items,
            Err(reject) => return self.refuse(from, device, (invoke, service), reject.into(), now),
        };
        if !app.may_write(from.ip()) {
            let failed = items.front().map(|item| (item.object, item.property));
            if let Some(first) = items.front() {
                app.denied(&from, instance, first);
            }
            let apdu = failure(invoke, service, Error::WRITE_ACCESS_DENIED.into(), failed);
            self.counters.refused += 1;
            return self.send(from, instance, &apdu, now);
        }
        for other in self.exchanges.all.iter_mut() {
            let same = (other.from, other.device, other.invoke) == (from, instance, invoke);
            other.mute |= same && matches!(other.state, State::Running);
        }
        if !self.exchanges.make_room(from, stops) {
            let abort = Failure::Abort(crate::types::Abort::OutOfResources);
            return self.refuse(from, device, (invoke, service), abort, now);
        }
        let items = stops_first(items, |item| app.stops(instance, item));
        self.exchanges.tokens += 1;
        let token = self.exchanges.tokens;
        self.exchanges.all.push_back(Exchange {
            token,
            from,
            device: instance,
            station: device.station,
            invoke,
            service,
            request: data.into(),
            requested_at: now,
            rest: items,
            current: None,
            failed: None,
            mute: false,
            state: State::Running,
        });
        self.go_on(token, app, now);
    }

    /// Reports the result of a job.
    pub fn written(&mut self, token: u64, result: Result<(), Error>, app: &dyn Application, now: Instant) {
        let Some(exchange) = self.exchanges.running(token) else {
            return;
        };
        let current = exchange.current.take();
        if let Err(error) = result
            && exchange.failed.is_none()
        {
            exchange.failed = Some((error.into(), current));
        }
        self.go_on(token, app, now);
    }

    /// Carries out the writes of a request one after the other; after a failed write only its stops.
    fn go_on(&mut self, token: u64, app: &dyn Application, now: Instant) {
        loop {
            let Some(exchange) = self.exchanges.running(token) else {
                return;
            };
            let Some(item) = exchange.rest.pop_front() else { break };
            let (from, instance, asked) = (exchange.from, exchange.device, exchange.requested_at);
            let failed = exchange.failed.is_some();
            let is_stop = app.stops(instance, &item);
            if failed && !is_stop {
                continue;
            }
            let place = (item.object, item.property);
            let step = match self.device(instance) {
                device if is_stop && device.as_ref().is_none_or(|device| device.find(item.object).is_none()) => {
                    stop_of_removed(&item)
                }
                None => Err(Error::UNKNOWN_OBJECT.into()),
                Some(_) if !is_stop && !app.answers(instance) => Err(Error::TIMEOUT.into()),
                Some(device) => self.step(&device, &item),
            };
            let Some(exchange) = self.exchanges.running(token) else {
                return;
            };
            match step {
                Ok(Step::Done) => {}
                Ok(Step::Job(at, value, priority)) => {
                    exchange.current = Some(place);
                    self.jobs.push_back(Job {
                        token,
                        from,
                        device: instance,
                        place: at,
                        object: item.object,
                        value,
                        priority,
                        requested_at: asked,
                        since: now,
                    });
                    return;
                }
                Err(failure) if exchange.failed.is_none() => exchange.failed = Some((failure, Some(place))),
                Err(_) => {}
            }
        }
        self.finish(token, app, now);
    }

    fn finish(&mut self, token: u64, app: &dyn Application, now: Instant) {
        let Some(exchange) = self.exchanges.running(token) else {
            return;
        };
        let (invoke, service) = (exchange.invoke, exchange.service);
        let failed = exchange.failed.take();
        let refused = failed.is_some();
        let answer = match failed {
            None => apdu::simple_ack(invoke, service),
            Some((why, at)) => failure(invoke, service, why, at),
        };
        let (from, device, mute) = (exchange.from, exchange.device, exchange.mute);
        let station = exchange.station;
        exchange.state = State::Done {
            answer: answer.clone(),
            at: now,
            orders: app.orders(device),
        };
        if refused {
            self.counters.refused += 1;
        } else {
            self.counters.done += 1;
        }
        if !mute {
            let station = self.options.network.zip(station);
            self.send_as(station, from, &answer, now);
        }
    }

    /// Decides about a write by the kind of the object.
    fn step(&mut self, device: &Device, item: &WriteItem) -> Result<Step, Failure> {
        if item.priority.is_some_and(|priority| !(1..=16).contains(&priority)) {
            return Err(Error::PARAMETER_OUT_OF_RANGE.into());
        }
        let is_device = item.object == device.id() || item.object == ObjectId::new(ObjectType::DEVICE, WILDCARD);
        let property = item.property.property;
        if is_device || item.object == ObjectId::new(ObjectType::NETWORK_PORT, 1) {
            // The properties of the Device and Network Port objects come from the configuration and are not writable.
            return Err(Error::WRITE_ACCESS_DENIED.into());
        }
        let place = device.find(item.object).ok_or(Error::UNKNOWN_OBJECT)?;
        let object = device.objects().get(place).ok_or(Error::UNKNOWN_OBJECT)?;
        if !has(object, property) {
            return Err(Error::UNKNOWN_PROPERTY.into());
        }
        let writable = match property {
            PropertyId::PRESENT_VALUE => object.access != Access::Read,
            PropertyId::COV_INCREMENT => true,
            _ => false,
        };
        if !writable {
            return Err(Error::WRITE_ACCESS_DENIED.into());
        }
        if item.property.index.is_some() {
            return Err(Error::NOT_AN_ARRAY.into());
        }
        let value = item.value.as_ref().ok_or(Error::INVALID_DATA_TYPE)?;
        if property == PropertyId::COV_INCREMENT {
            let Data::Real(increment) = value else {
                return Err(Error::INVALID_DATA_TYPE.into());
            };
            if !increment.is_finite() || *increment < 0.0 {
                return Err(Error::VALUE_OUT_OF_RANGE.into());
            }
            self.increments.insert((device.instance, object.id), *increment);
            return Ok(Step::Done);
        }
        let value = written(object, value)?;
        let priority = item
            .priority
            .and_then(|priority| u8::try_from(priority).ok())
            .unwrap_or(16);
        Ok(Step::Job(
            place,
            value,
            (object.access == Access::Command).then_some(priority),
        ))
    }
}

/// A stop for an object that the devices no longer have: the application knows the machine.
fn stop_of_removed(item: &WriteItem) -> Result<Step, Failure> {
    let value = match &item.value {
        Some(Data::Null) => None,
        _ => Some(Datum::Bool(false)),
    };
    let priority = u8::try_from(item.priority.unwrap_or(16)).ok();
    let priority = priority.filter(|priority| (1..=16).contains(priority));
    let priority = priority.ok_or(Error::PARAMETER_OUT_OF_RANGE)?;
    Ok(Step::Job(usize::MAX, value, Some(priority)))
}

/// The writes in their order, with stops moved to the front unless they follow a write to another object, for which
/// they would have to wait.
fn stops_first(items: VecDeque<WriteItem>, stops: impl Fn(&WriteItem) -> bool) -> VecDeque<WriteItem> {
    let mut ordered: Vec<WriteItem> = Vec::with_capacity(items.len());
    for item in items {
        let same = |other: &WriteItem| other.object == item.object;
        let place = if stops(&item) {
            ordered.iter().rposition(same).map_or(0, |place| place + 1)
        } else {
            ordered.len()
        };
        ordered.insert(place, item);
    }
    ordered.into()
}

/// Whether an object has a property, as far as writes need to know.
fn has(object: &Object, property: PropertyId) -> bool {
    let command = object.access == Access::Command;
    match property {
        PropertyId::COV_INCREMENT | PropertyId::UNITS | PropertyId::RESOLUTION => {
            matches!(object.kind, Kind::Analog { .. })
        }
        PropertyId::MIN_PRES_VALUE | PropertyId::MAX_PRES_VALUE => {
            matches!(object.kind, Kind::Analog { range: Some(_), .. })
        }
        PropertyId::PRIORITY_ARRAY | PropertyId::RELINQUISH_DEFAULT | PropertyId::CURRENT_COMMAND_PRIORITY => command,
        PropertyId::VALUE_SOURCE | PropertyId::VALUE_SOURCE_ARRAY => command,
        PropertyId::LAST_COMMAND_TIME | PropertyId::COMMAND_TIME_ARRAY => command,
        PropertyId::POLARITY => object.id.kind == ObjectType::BINARY_INPUT,
        PropertyId::ACTIVE_TEXT | PropertyId::INACTIVE_TEXT => matches!(object.kind, Kind::Binary { .. }),
        PropertyId::STATE_TEXT | PropertyId::NUMBER_OF_STATES => matches!(object.kind, Kind::MultiState { .. }),
        PropertyId::OBJECT_IDENTIFIER
        | PropertyId::OBJECT_NAME
        | PropertyId::OBJECT_TYPE
        | PropertyId::PRESENT_VALUE
        | PropertyId::DESCRIPTION
        | PropertyId::STATUS_FLAGS
        | PropertyId::EVENT_STATE
        | PropertyId::RELIABILITY
        | PropertyId::OUT_OF_SERVICE
        | PropertyId::VALUE_TIME
        | PropertyId::PROPERTY_LIST => true,
        _ => false,
    }
}

/// Converts the value to the type of the object; `None` releases a slot.
fn written(object: &Object, value: &Data) -> Result<Option<Datum>, Error> {
    Ok(Some(match (&object.kind, value) {
        (_, Data::Null) if object.access == Access::Command => return Ok(None),
        (Kind::Analog { .. }, Data::Real(number)) if number.is_finite() => Datum::Number(shortest(*number)),
        (Kind::Analog { .. }, Data::Real(_)) => return Err(Error::VALUE_OUT_OF_RANGE),
        (Kind::Binary { .. }, Data::Enumerated(state)) => match state {
            0 | 1 => Datum::Bool(*state == 1),
            _ => return Err(Error::VALUE_OUT_OF_RANGE),
        },
        (Kind::MultiState { texts }, Data::Unsigned(state)) => match u32::try_from(*state) {
            Ok(state) if (1..=texts.len()).contains(&(state as usize)) => Datum::State(state),
            _ => return Err(Error::VALUE_OUT_OF_RANGE),
        },
        (Kind::Text, Data::Text(text)) => Datum::Text(Arc::from(text.as_str())),
        _ => return Err(Error::INVALID_DATA_TYPE),
    }))
}

/// The number that a REAL was written for: 33.3, not 33.29999923706055.
fn shortest(number: f32) -> f64 {
    number.to_string().parse().unwrap_or_else(|_| f64::from(number))
}

/// The answer to a failed request, with the write that failed.
fn failure(invoke: u8, service: u8, why: Failure, at: Option<(ObjectId, PropertyRef)>) -> Vec<u8> {
    let error = match why {
        Failure::Error(error) => error,
        Failure::Reject(reason) => return apdu::reject(invoke, reason),
        Failure::Abort(reason) => return apdu::abort(invoke, reason),
    };
    let (service, Some((object, property))) = (service, at.filter(|_| service == confirmed::WRITE_PROPERTY_MULTIPLE))
    else {
        return apdu::error(invoke, service, error);
    };
    let mut content = Writer::default();
    content.raw(&[0x50, invoke, service]);
    content
        .open(0)
        .enumerated(error.class as u32)
        .enumerated(error.code.into())
        .close(0);
    content
        .open(1)
        .context_object(0, object)
        .context_property(1, property.property);
    if let Some(index) = property.index {
        content.context_unsigned(2, index.into());
    }
    content.close(1);
    content.into_bytes()
}
