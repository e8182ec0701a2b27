//! Confirmed requests in general, and the requests that read properties (clauses 15.5, 15.7).

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::{Application, Server};
use crate::apdu::{self, Accepts, Apdu};
use crate::encoding::{Read, Writer};
use crate::object::{Context, Device, list, property};
use crate::services::{self, PropertyRef, confirmed};
use crate::types::{Abort, Address, Error, ObjectId, ObjectType, PropertyId, Reject, WILDCARD};

/// Longest answer in octets, all segments together.
const LONGEST: usize = 64 * 1024;
/// Longest time for which a device sends no notification of its own accord.
const QUIET: Duration = Duration::from_secs(300);

/// The content of an answer; `None` if nothing is to be answered now.
type Answered = Result<Option<Vec<u8>>, Failure>;

/// Why a request was not carried out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Failure {
    Error(Error),
    Reject(Reject),
    Abort(Abort),
}

impl From<Reject> for Failure {
    fn from(reject: Reject) -> Failure {
        Failure::Reject(reject)
    }
}

impl From<Error> for Failure {
    fn from(error: Error) -> Failure {
        Failure::Error(error)
    }
}

impl Server {
    pub(super) fn confirmed(
        &mut self,
        from: Address,
        device: &Arc<Device>,
        request: Apdu<'_>,
        app: &dyn Application,
        now: Instant,
    ) {
        let Apdu::Confirmed {
            segmented,
            accepts,
            invoke,
            service,
            data,
        } = request
        else {
            return;
        };
        let answers = app.answers(device.instance);
        if segmented {
            if answers {
                self.refuse(
                    from,
                    device,
                    (invoke, service),
                    Failure::Abort(Abort::SegmentationNotSupported),
                    now,
                );
            }
            return;
        }
        if matches!(service, confirmed::WRITE_PROPERTY | confirmed::WRITE_PROPERTY_MULTIPLE) {
            return self.write_request(from, device, (invoke, service), data, app, now);
        }
        self.exchanges.next_request(from, device.instance);
        // The device does not answer, like one that is switched off.
        if !answers {
            return;
        }
        let done = match service {
            confirmed::READ_PROPERTY => self.read_property(device, data, app, now),
            confirmed::READ_PROPERTY_MULTIPLE => self.read_multiple(device, data, app, now),
            confirmed::SUBSCRIBE_COV => self.subscribe(from, device, services::subscribe_cov(data), app, now),
            confirmed::SUBSCRIBE_COV_PROPERTY => {
                self.subscribe(from, device, services::subscribe_cov_property(data), app, now)
            }
            confirmed::DEVICE_COMMUNICATION_CONTROL => self.control(device, data, app, now),
            confirmed::REINITIALIZE_DEVICE => Err(Error::SERVICE_REQUEST_DENIED.into()),
            _ => Err(Reject::UnrecognizedService.into()),
        };
        match done {
            Err(failure) => self.refuse(from, device, (invoke, service), failure, now),
            Ok(None) => {
                self.counters.done += 1;
                self.send(from, device.instance, &apdu::simple_ack(invoke, service), now);
                if matches!(service, confirmed::SUBSCRIBE_COV | confirmed::SUBSCRIBE_COV_PROPERTY) {
                    self.changed(device.instance, app, now);
                }
            }
            Ok(Some(content)) => self.answer(from, device, (invoke, service), accepts, content, now),
        }
    }

    /// Sends an answer, in segments if it does not fit into one message.
    fn answer(
        &mut self,
        from: Address,
        device: &Arc<Device>,
        (invoke, service): (u8, u8),
        accepts: Accepts,
        content: Vec<u8>,
        now: Instant,
    ) {
        if content.len() > LONGEST {
            let abort = Failure::Abort(Abort::BufferOverflow);
            return self.refuse(from, device, (invoke, service), abort, now);
        }
        let whole = apdu::complex_ack(invoke, service, &content);
        if whole.len() <= accepts.size {
            self.counters.done += 1;
            return self.send(from, device.instance, &whole, now);
        }
        let segments = content
            .len()
            .div_ceil(accepts.size.saturating_sub(apdu::SEGMENT_HEADER).max(1));
        let failure = match accepts.segments {
            None => Some(Abort::SegmentationNotSupported),
            Some(most) if segments > most => Some(Abort::BufferOverflow),
            Some(_) => {
                let mut out = Vec::new();
                let (to, number) = ((from, device.instance), (invoke, service));
                let begun = self.segments.begin(to, number, content, accepts.size, now, &mut out);
                self.send_segments(out, now);
                (!begun).then_some(Abort::OutOfResources)
            }
        };
        match failure {
            Some(abort) => self.refuse(from, device, (invoke, service), Failure::Abort(abort), now),
            None => self.counters.done += 1,
        }
    }

    pub(super) fn refuse(
        &mut self,
        from: Address,
        device: &Device,
        (invoke, service): (u8, u8),
        failure: Failure,
        now: Instant,
    ) {
        self.counters.refused += 1;
        let apdu = match failure {
            Failure::Error(error) => apdu::error(invoke, service, error),
            Failure::Reject(reason) => apdu::reject(invoke, reason),
            Failure::Abort(reason) => apdu::abort(invoke, reason),
        };
        self.send(from, device.instance, &apdu, now);
    }

    /// Calls `with` for an object of a device in its present state.
    pub(super) fn with_object<T>(
        &self,
        device: &Device,
        id: ObjectId,
        app: &dyn Application,
        now: Instant,
        with: impl FnOnce(&Context<'_>) -> T,
    ) -> Option<T> {
        let own = ObjectId::new(ObjectType::DEVICE, WILDCARD);
        if id == device.id() || id == own {
            let instance = device.instance;
            return Some(with(&Context::Device {
                device,
                now: app.clock(),
                subscriptions: &|out| self.list_subscriptions(instance, out, now),
            }));
        }
        if id == ObjectId::new(ObjectType::NETWORK_PORT, 1) {
            return Some(with(&Context::Port(device)));
        }
        let place = device.find(id)?;
        let object = device.objects().get(place)?;
        let commands = app.commands(device.instance, place).map(Box::new);
        Some(with(&Context::Object {
            object,
            sample: app.sample(device.instance, place),
            commands,
            increment: self.increment(device.instance, object),
        }))
    }

    fn read_property(&mut self, device: &Device, data: &[u8], app: &dyn Application, now: Instant) -> Answered {
        let (id, asked) = services::read_property(data)?;
        let content = self.with_object(device, id, app, now, |of| {
            let mut content = Writer::default();
            content
                .context_object(0, of.object_id())
                .context_property(1, asked.property);
            if let Some(index) = asked.index {
                content.context_unsigned(2, index.into());
            }
            content.open(3);
            property(&mut content, of, asked, &self.environment)?;
            content.close(3);
            Ok(content.into_bytes())
        });
        match content {
            None => Err(Error::UNKNOWN_OBJECT.into()),
            Some(content) => content.map(Some).map_err(Failure::Error),
        }
    }

    fn read_multiple(&mut self, device: &Device, data: &[u8], app: &dyn Application, now: Instant) -> Answered {
        let mut content = Writer::default();
        for (id, asked) in services::read_property_multiple(data)? {
            let known = self.with_object(device, id, app, now, |of| {
                content.context_object(0, of.object_id()).open(1);
                for one in self.expand(of, &asked) {
                    result(&mut content, one, |out| property(out, of, one, &self.environment));
                    if content.bytes().len() > LONGEST {
                        break;
                    }
                }
                content.close(1);
            });
            if known.is_none() {
                content.context_object(0, id).open(1);
                for one in asked {
                    result(&mut content, one, |_| Err(Error::UNKNOWN_OBJECT));
                }
                content.close(1);
            }
            if content.bytes().len() > LONGEST {
                return Err(Failure::Abort(Abort::BufferOverflow));
            }
        }
        Ok(Some(content.into_bytes()))
    }

    /// The properties that are meant by ALL, REQUIRED and OPTIONAL.
    fn expand(&self, of: &Context<'_>, asked: &[PropertyRef]) -> Vec<PropertyRef> {
        let mut all = Vec::new();
        for one in asked {
            let (required, optional) = match one.property {
                PropertyId::ALL | PropertyId::REQUIRED | PropertyId::OPTIONAL => list(of, &self.environment),
                _ => {
                    all.push(*one);
                    continue;
                }
            };
            let mut wanted = Vec::new();
            if one.property != PropertyId::OPTIONAL {
                wanted.extend(required);
            }
            if one.property != PropertyId::REQUIRED {
                wanted.extend(optional);
            }
            // ALL, REQUIRED and OPTIONAL expand to other properties; Property_List itself is left out.
            let own = |property: &PropertyId| *property != PropertyId::PROPERTY_LIST;
            let whole = |property| PropertyRef { property, index: None };
            all.extend(wanted.into_iter().filter(own).map(whole));
        }
        all
    }

    /// Executes DeviceCommunicationControl, unless it would block a stop.
    fn control(&mut self, device: &Device, data: &[u8], app: &dyn Application, now: Instant) -> Answered {
        let control = services::device_communication_control(data)?;
        if !app.password(control.password.as_deref().unwrap_or("")) {
            return Err(Error::PASSWORD_FAILURE.into());
        }
        match control.wanted {
            0 => {
                self.quiet.remove(&device.instance);
            }
            2 => {
                let given = control
                    .minutes
                    .map(|minutes| Duration::from_secs(u64::from(minutes) * 60));
                let time = given.filter(|time| !time.is_zero()).unwrap_or(QUIET).min(QUIET);
                self.quiet.insert(device.instance, now + time);
            }
            // Disabling was withdrawn from the standard, and would block stops.
            _ => return Err(Error::SERVICE_REQUEST_DENIED.into()),
        }
        Ok(None)
    }

    fn subscribe(
        &mut self,
        from: Address,
        device: &Device,
        asked: Read<services::Subscribe>,
        app: &dyn Application,
        now: Instant,
    ) -> Answered {
        self.subscribe_to(from, device, asked?, app, now)?;
        Ok(None)
    }
}

/// Writes one result of ReadPropertyMultiple.
fn result(content: &mut Writer, one: PropertyRef, read: impl FnOnce(&mut Writer) -> Result<(), Error>) {
    content.context_property(2, one.property);
    if let Some(index) = one.index {
        content.context_unsigned(3, index.into());
    }
    let mut value = Writer::default();
    match read(&mut value) {
        Ok(()) => content.open(4).raw(value.bytes()).close(4),
        Err(error) => {
            content.open(5).enumerated(error.class as u32);
            content.enumerated(error.code.into()).close(5)
        }
    };
}
