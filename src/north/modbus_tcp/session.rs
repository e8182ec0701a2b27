//! What the requests of one client mean, and what is answered.

use std::sync::Arc;
use std::time::Instant;

use futures_util::FutureExt;

use super::errand::{Answered, Errand, Step, Waiting, Work, pieces};
use super::frame::{self, Frame, Header};
use super::identify::Identity;
use super::lookout::Turns;
use super::shared::{Client, Routes, Shared, View};
use super::{Seldom, Uncached};
use crate::cache::{Access, Unavailable};
use crate::codec::modbus::encode_exception;
use crate::codec::{Exception, Reply, RequestPdu, Table};
use crate::command::{Authority, Order, Outcome};
use crate::drive::{Profile, State};
use crate::north::ModbusTcpStats;
use crate::north::register_map::{self, BusFigures, CommandWrite, FIRST, GATEWAY_UNIT, Look};
use crate::plant::{BusHandle, DriveHandle};

/// Function codes that change something.
const WRITES: [u8; 6] = [5, 6, 15, 16, 22, 23];
/// Function codes that every drive has here, by the blocks from 0x8000 on and the identification.
const OWN_FUNCTIONS: [u8; 5] = [3, 4, 6, 16, 43];

/// What becomes of a request.
enum Decision {
    /// Answered at once.
    Reply(RequestPdu, Reply),
    /// Refused at once.
    Exception(Exception),
    /// The drive is asked, or a command refused on the way to it.
    Drive(Errand, Work),
}

impl From<Exception> for Decision {
    fn from(exception: Exception) -> Decision {
        Decision::Exception(exception)
    }
}

/// One client.
#[derive(Debug)]
pub(super) struct Session {
    shared: Arc<Shared>,
    view: Arc<View>,
    client: Client,
    routes: Arc<Routes>,
    foreign_codes: Seldom,
}

impl Drop for Session {
    fn drop(&mut self) {
        self.stats().disconnected();
    }
}

impl Session {
    /// A client has connected; it has left when the session is dropped.
    pub(super) fn new(shared: Arc<Shared>, view: Arc<View>, client: Client) -> Session {
        shared.stats.modbus_tcp.connected();
        let routes = view.routes();
        Session {
            shared,
            view,
            client,
            routes,
            foreign_codes: Seldom::default(),
        }
    }

    /// Another client has connected to the same server.
    pub(super) fn beside(&self, client: Client) -> Session {
        Session::new(self.shared.clone(), self.view.clone(), client)
    }

    /// The client, for the log.
    pub(super) fn who(&self) -> &str {
        &self.client.who
    }

    /// The turns of all connections.
    pub(super) fn turns(&self) -> Arc<Turns> {
        self.shared.turns.clone()
    }

    fn stats(&self) -> &ModbusTcpStats {
        &self.shared.stats.modbus_tcp
    }

    /// Takes over a plant that a reload has put in place.
    pub(super) fn refresh(&mut self) {
        if !self.view.is_current(&self.routes) {
            self.routes = self.view.routes();
        }
    }

    /// Answers a request into `out`, or gives what its answer waits for. An order has been queued when this
    /// returns, so orders reach the bus in the order of their frames.
    pub(super) fn take(&mut self, frame: &Frame<'_>, now: Instant, out: &mut Vec<u8>) -> Option<Waiting> {
        match self.decide(frame, now) {
            Decision::Reply(request, reply) => self.put(frame.header, &request, &reply, out),
            Decision::Exception(code) if code > Exception::GATEWAY_TARGET => {
                let drive = self.routes.drive(frame.header.unit);
                let name = drive.map_or_else(String::new, |d| d.image.spec.name.clone());
                self.tell_foreign_code(&name, code, now);
                self.put_exception(frame.header, frame.function, Exception::DEVICE_FAILURE, out);
            }
            Decision::Exception(code) => self.put_exception(frame.header, frame.function, code, out),
            Decision::Drive(errand, work) => {
                let step = errand.send(work, &self.client, now);
                return self.follow(step, now, out);
            }
        }
        None
    }

    /// The bus has answered: appends the answer to the request, or gives what it waits for next. A read piece by piece
    /// has its next order in the queue when this returns.
    pub(super) fn finish(&mut self, answered: Answered, now: Instant, out: &mut Vec<u8>) -> Option<Waiting> {
        let step = answered.go_on(&self.client, now);
        self.follow(step, now, out)
    }

    fn follow(&mut self, mut step: Step, now: Instant, out: &mut Vec<u8>) -> Option<Waiting> {
        loop {
            match step {
                Step::Done(errand, outcome) => {
                    self.answer(&errand, &outcome, now, out);
                    return None;
                }
                Step::Waits(mut waiting) => match (&mut waiting).now_or_never() {
                    Some(answered) => step = answered.go_on(&self.client, now),
                    None => return Some(waiting),
                },
            }
        }
    }

    fn answer(&mut self, errand: &Errand, outcome: &Outcome, now: Instant, out: &mut Vec<u8>) {
        let Errand { header, request, .. } = errand;
        let drive = &errand.drive.image.spec.name;
        if errand.resets && !outcome.is_ok() {
            self.shared
                .with_command_word(drive, |word| *word = word.map(register_map::without_reset));
        }
        if let Outcome::Exception(code) = outcome
            && *code > Exception::GATEWAY_TARGET
        {
            self.tell_foreign_code(drive, *code, now);
        }
        let exception = outcome.exception();
        match (outcome, exception) {
            (_, Some(code)) => self.put_exception(*header, request.function(), code, out),
            (Outcome::Acknowledged(reply), None) if answers(request, reply) => self.put(*header, request, reply, out),
            _ => self.put_exception(*header, request.function(), Exception::DEVICE_FAILURE, out),
        }
    }

    fn put(&self, header: Header, request: &RequestPdu, reply: &Reply, out: &mut Vec<u8>) {
        frame::encode(header, out, |out| reply.encode(request, out));
        self.stats().answered(request.function(), 0);
    }

    fn put_exception(&self, header: Header, function: u8, code: Exception, out: &mut Vec<u8>) {
        frame::encode(header, out, |out| encode_exception(function, code, out));
        self.stats().answered(function, code.0);
    }

    /// A drive's own code is answered as 04; what it means is told here.
    fn tell_foreign_code(&mut self, drive: &str, code: Exception, now: Instant) {
        if let Some(more) = self.foreign_codes.tell(now) {
            tracing::warn!(drive, client = %self.client.who, more,
                "Modbus TCP: the drive answered {code}; the client was told 04");
        }
    }

    fn decide(&self, frame: &Frame<'_>, now: Instant) -> Decision {
        if frame.header.unit == GATEWAY_UNIT {
            return self.gateway(frame).unwrap_or_else(Decision::from);
        }
        let Some(drive) = self.routes.drive(frame.header.unit) else {
            return Exception::GATEWAY_PATH.into();
        };
        let profile = &drive.image.spec.profile;
        let decoded = RequestPdu::decode(frame.pdu);
        // Authority comes before everything that the request could be wrong in.
        if WRITES.contains(&frame.function) && !self.may_write(drive) {
            return match decoded {
                Ok(request) => errand(frame.header, drive, request.clone(), Work::Order(Order::Write(request))),
                Err(_) => Exception::FUNCTION.into(),
            };
        }
        let has_function = has_function(profile, frame.function);
        if !has_function && !OWN_FUNCTIONS.contains(&frame.function) {
            return Exception::FUNCTION.into();
        }
        let request = match decoded {
            Ok(request) => request,
            Err(code) => return code.into(),
        };
        match request {
            RequestPdu::Read { table, start, count } if !table.is_bits() && start >= FIRST => {
                common(drive, request, start, count, now)
            }
            RequestPdu::WriteRegister { address, value } if address >= FIRST => {
                self.command(frame.header, drive, request, address, &[value], now)
            }
            RequestPdu::WriteRegisters { start, ref values } if start >= FIRST => {
                let values = values.clone();
                self.command(frame.header, drive, request, start, &values, now)
            }
            RequestPdu::DeviceIdentification { code, object } => {
                let identity = Identity {
                    product: &profile.name,
                    title: &profile.title,
                    name: &drive.image.spec.name,
                };
                identity
                    .reply(code, object)
                    .map_or_else(Decision::from, |reply| Decision::Reply(request, reply))
            }
            RequestPdu::Read { .. } if has_function => self.raw_read(frame.header, drive, request, now),
            _ if has_function => errand(frame.header, drive, request.clone(), Work::Order(Order::Write(request))),
            _ => Exception::FUNCTION.into(),
        }
    }

    fn may_write(&self, drive: &DriveHandle) -> bool {
        self.client.authority == Authority::Write && drive.image.spec.access == Access::Control
    }

    /// Unit 255: input registers; holding registers alike, since many clients read nothing else.
    fn gateway(&self, frame: &Frame<'_>) -> Result<Decision, Exception> {
        if WRITES.contains(&frame.function) {
            return Err(Exception::FUNCTION);
        }
        let request = RequestPdu::decode(frame.pdu)?;
        let plant = &self.routes.plant;
        let reply = match request {
            RequestPdu::Read { table, start, count } if !table.is_bits() => {
                let bus = |place: usize| self.routes.bus(place).map(figures);
                Reply::Registers(register_map::gateway(start, count, bus)?)
            }
            RequestPdu::DeviceIdentification { code, object } => {
                let identity = Identity {
                    product: "gateway",
                    title: "drivegate",
                    name: &plant.gateway,
                };
                identity.reply(code, object)?
            }
            _ => return Err(Exception::FUNCTION),
        };
        Ok(Decision::Reply(request, reply))
    }

    fn raw_read(&self, header: Header, drive: &DriveHandle, request: RequestPdu, now: Instant) -> Decision {
        let RequestPdu::Read { table, start, count } = request else {
            return Exception::FUNCTION.into();
        };
        let profile = &drive.image.spec.profile;
        let beyond = !table.is_bits() && u32::from(start) + u32::from(count) > u32::from(FIRST);
        if beyond {
            return Exception::ADDRESS.into();
        }
        if !drive.bus_up() {
            return Exception::GATEWAY_PATH.into();
        }
        let reading = drive.reading(now);
        match reading.words(table, start, count) {
            Ok(words) if table.is_bits() => {
                Decision::Reply(request, Reply::Bits(words.iter().map(|w| *w != 0).collect()))
            }
            Ok(words) => Decision::Reply(request, Reply::Registers(words)),
            Err(Unavailable::Refused(code)) => code.into(),
            Err(Unavailable::Stale) => Exception::GATEWAY_TARGET.into(),
            Err(Unavailable::NotPolled) if self.shared.options.uncached == Uncached::Refuse => {
                Exception::ADDRESS.into()
            }
            Err(Unavailable::NotPolled) => match pieces(drive.bus.image.spec.protocol, &reading, table, start, count) {
                Err(code) => code.into(),
                Ok(Some(pieces)) => errand(header, drive, request, Work::Pieces(pieces)),
                Ok(None) if count > read_limit(profile, table, start, count) => Exception::VALUE.into(),
                Ok(None) => errand(header, drive, request.clone(), Work::Order(Order::Read(request))),
            },
        }
    }

    /// A write to the blocks from 0x8000 on, by a client that may write to that drive.
    fn command(
        &self,
        header: Header,
        drive: &DriveHandle,
        request: RequestPdu,
        start: u16,
        values: &[u16],
        now: Instant,
    ) -> Decision {
        let spec = &drive.image.spec;
        let fault = drive.reading(now).state() == Some(State::Fault);
        let write = self.shared.with_command_word(&spec.name, |last| {
            let before = register_map::Before { word: *last, fault };
            let write = register_map::command(&spec.profile, start, values, before)?;
            let resets = write.word.is_some_and(|word| before.resets(word));
            *last = write.word.or(*last);
            Ok((write, resets))
        });
        let (work, resets) = match write {
            // A heartbeat alone is no command: it is answered at once and not audited.
            Ok((CommandWrite { points, .. }, _)) if points.is_empty() => {
                drive.image.renew_lease(now);
                return Decision::Reply(request, Reply::Written);
            }
            Ok((CommandWrite { points, .. }, resets)) => (Work::Order(Order::Points(points)), resets),
            Err(refusal) => (Work::Refused(refusal), false),
        };
        Decision::Drive(Errand::new(header, drive, request, resets), work)
    }
}

fn errand(header: Header, drive: &DriveHandle, request: RequestPdu, work: Work) -> Decision {
    Decision::Drive(Errand::new(header, drive, request, false), work)
}

fn common(drive: &DriveHandle, request: RequestPdu, start: u16, count: u16, now: Instant) -> Decision {
    let reading = drive.reading(now);
    Look::new(&reading, drive.bus_up())
        .registers(start, count)
        .map_or_else(Decision::from, |words| {
            Decision::Reply(request, Reply::Registers(words))
        })
}

/// Whether a raw request with that function makes sense to the family: it has the table. No family has the
/// functions 22 and 23.
fn has_function(profile: &Profile, function: u8) -> bool {
    let table = match function {
        1 | 5 | 15 => Table::Coil,
        2 => Table::DiscreteInput,
        3 | 6 | 16 => Table::Holding,
        4 => profile.canonical(Table::Input),
        _ => return false,
    };
    profile.ranges.iter().any(|r| r.table == table)
}

/// Items that the drive gives in one read of that span, by the ranges of the profile that it touches.
fn read_limit(profile: &Profile, table: Table, start: u16, count: u16) -> u16 {
    let table = profile.canonical(table);
    let last = start.saturating_add(count.saturating_sub(1));
    let touched = profile
        .ranges
        .iter()
        .filter(|r| r.table == table && *r.addresses.start() <= last && start <= *r.addresses.end());
    touched.map(|r| r.read).min().unwrap_or(table.max_read())
}

/// Whether a drive's reply is one to the request.
fn answers(request: &RequestPdu, reply: &Reply) -> bool {
    match (request, reply) {
        (RequestPdu::Read { table, count, .. }, Reply::Bits(bits)) => {
            table.is_bits() && bits.len() == usize::from(*count)
        }
        (RequestPdu::Read { table, count, .. }, Reply::Registers(words)) => {
            !table.is_bits() && words.len() == usize::from(*count)
        }
        (_, Reply::Written) => request.is_write(),
        _ => false,
    }
}

fn figures(bus: &BusHandle) -> BusFigures {
    let health = bus.image.health();
    BusFigures {
        up: health.up,
        drives: bus.image.drives.len(),
        online: bus.image.online(),
        load: health.load,
        cycle: health.fast.last,
        transactions: bus.image.transactions_total(),
        errors: bus.image.errors_total(),
        queued: bus.queue.lock().writes(),
    }
}
