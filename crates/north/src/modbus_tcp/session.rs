//! Interprets the requests of one client and builds the replies.

mod gateway_unit;
mod model_registers;
mod request;

use std::sync::Arc;
use std::time::Instant;

use futures_util::FutureExt;
use tokio::sync::oneshot;

use super::client::Client;
use super::command_words::LastWord;
use super::forwarded_request::{
    AnsweredRequest, BusWork, ForwardedRequest, PendingRequest, Progress, ReadBehind, common, read_parts,
};
use super::frame::{self, Frame, Header};
use super::identify::Identity;
use super::routes::{At, EarlierUnit, PlantView, Registers, Routes};
use super::{ServerState, Uncached};
use crate::ModbusTcpStats;
use crate::log_throttle::LogThrottle;
use crate::register_map::{GATEWAY_UNIT, STOP_ALL};
use drivegate_core::order::{Arrival, Authority, Order, Outcome};
use drivegate_core::permit::meant_another;
use drivegate_core::plant::DriveHandle;
use drivegate_core::process_image::{Access, Unavailable};
use drivegate_model::drive::{ModelPoint, Value};
use drivegate_proto::modbus::encode_exception;
use drivegate_proto::{Exception, Reply, RequestPdu, Table};

use request::{answers, has_function, not_readable, read_limit, stops_all_only, stops_by, write_part};

/// Function codes that write registers or coils.
const WRITES: [u8; 6] = [5, 6, 15, 16, 22, 23];
/// Function codes that every drive supports, through the blocks from 0x8000 on and the device identification.
const OWN_FUNCTIONS: [u8; 6] = [3, 4, 6, 16, 23, 43];

/// How a request is handled.
enum Decision {
    /// Reply to send at once.
    Reply(RequestPdu, Reply),
    /// Exception to send at once.
    Exception(Exception),
    /// The request is forwarded to the drive, or was refused on the way.
    Drive(Box<(ForwardedRequest, BusWork)>),
    /// The stops of all drives are in the queues of their buses.
    StopAll(RequestPdu, oneshot::Receiver<bool>),
}

impl From<Exception> for Decision {
    fn from(exception: Exception) -> Decision {
        Decision::Exception(exception)
    }
}

/// A connected client.
#[derive(Debug)]
pub(super) struct ClientSession {
    state: Arc<ServerState>,
    view: Arc<PlantView>,
    client: Client,
    routes: Arc<Routes>,
    foreign_codes: LogThrottle,
}

impl Drop for ClientSession {
    fn drop(&mut self) {
        self.stats().disconnected();
    }
}

impl ClientSession {
    /// Counts the client as connected until the session is dropped.
    pub(super) fn new(state: Arc<ServerState>, view: Arc<PlantView>, client: Client) -> ClientSession {
        state.stats.modbus_tcp.connected();
        let (routes, client) = (view.routes(), client.seeing(&view));
        ClientSession {
            state,
            view,
            client,
            routes,
            foreign_codes: LogThrottle::default(),
        }
    }

    /// A session for another client of this server.
    pub(super) fn beside(&self, client: Client) -> ClientSession {
        ClientSession::new(self.state.clone(), self.view.clone(), client)
    }

    /// Name of the client for the log.
    pub(super) fn who(&self) -> &str {
        &self.client.who
    }

    fn stats(&self) -> &ModbusTcpStats {
        &self.state.stats.modbus_tcp
    }

    /// Uses the current plant, which a reload may have replaced.
    pub(super) fn refresh(&mut self) {
        if !self.view.is_current(&self.routes) {
            self.routes = self.view.routes();
        }
    }

    /// Writes the reply to a request that arrived at this time into `out`, or returns the pending request. The
    /// command is in the queue when this returns, so commands reach the bus in the order of their frames.
    pub(super) fn take(
        &mut self,
        frame: &Frame<'_>,
        arrival: Arrival,
        now: Instant,
        out: &mut Vec<u8>,
    ) -> Option<PendingRequest> {
        match self.decide(frame, &arrival, now) {
            Decision::Reply(request, reply) => self.put(frame.header, &request, &reply, out),
            Decision::Exception(code) if code > Exception::GATEWAY_TARGET => {
                let drive = self.routes.drive(frame.header.unit);
                let name = drive.map_or_else(String::new, |d| d.image.spec.name.clone());
                self.log_foreign_code(&name, code, now);
                self.put_exception(frame.header, frame.function, Exception::DEVICE_FAILURE, out);
            }
            Decision::Exception(code) => self.put_exception(frame.header, frame.function, code, out),
            Decision::Drive(forwarded) => {
                let (forwarded, work) = *forwarded;
                let step = forwarded.send(work, &self.client, arrival, now);
                return self.follow(step, now, out);
            }
            Decision::StopAll(request, acknowledged) => {
                let request = Some((frame.header, request));
                return Some(PendingRequest::StopAll(request, acknowledged));
            }
        }
        None
    }

    /// Appends the reply to a request that the bus has answered, or returns the request if it waits for its next
    /// part, whose command is in the queue when this returns.
    pub(super) fn finish(
        &mut self,
        answered: AnsweredRequest,
        now: Instant,
        out: &mut Vec<u8>,
    ) -> Option<PendingRequest> {
        let step = answered.go_on(&self.client, now);
        self.follow(step, now, out)
    }

    fn follow(&mut self, mut step: Progress, now: Instant, out: &mut Vec<u8>) -> Option<PendingRequest> {
        loop {
            match step {
                Progress::Done(forwarded, outcome) => {
                    self.answer(&forwarded, &outcome, now, out);
                    return None;
                }
                Progress::Stopped(header, request, all) => {
                    if !all {
                        self.put_exception(header, request.function(), Exception::DEVICE_FAILURE, out);
                    } else if stops_all_only(&request) {
                        self.put(header, &request, &Reply::Written, out);
                    } else {
                        self.put_exception(header, request.function(), Exception::ADDRESS, out);
                    }
                    return None;
                }
                Progress::Pending(mut waiting) => match (&mut waiting).now_or_never() {
                    Some(answered) => step = answered.go_on(&self.client, now),
                    None => return Some(waiting),
                },
            }
        }
    }

    fn answer(&mut self, forwarded: &ForwardedRequest, outcome: &Outcome, now: Instant, out: &mut Vec<u8>) {
        let ForwardedRequest { header, request, .. } = forwarded;
        let drive = &forwarded.drive.image.spec.name;
        if forwarded.resets && !outcome.is_ok() {
            self.last_word(header.unit, &forwarded.drive, LastWord::forget_reset);
        }
        if let Outcome::Exception(code) = outcome
            && *code > Exception::GATEWAY_TARGET
        {
            self.log_foreign_code(drive, *code, now);
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
        self.stats().answered(function, code.code());
    }

    /// Logs an exception code that only this drive uses; the client gets 04.
    fn log_foreign_code(&self, drive: &str, code: Exception, now: Instant) {
        if let Some(suppressed) = self.foreign_codes.permit(now) {
            tracing::warn!(target: "drivegate::north::modbus_tcp", drive, client = %self.client.who, suppressed,
                "Modbus TCP: the drive replied {code}; passed on as exception 04");
        }
    }

    fn decide(&self, frame: &Frame<'_>, arrival: &Arrival, now: Instant) -> Decision {
        let unit = frame.header.unit;
        let writes = WRITES.contains(&frame.function);
        // A reload since the first byte may have given the unit id or the address to another drive or register.
        if writes && let Some(earlier) = self.routes.meaning_at(unit, arrival.asked) {
            return if unit == GATEWAY_UNIT && !earlier.is_default {
                self.gateway(frame, now).unwrap_or_else(Decision::from)
            } else {
                self.to_former(frame, &earlier)
            };
        }
        let is_default = self.routes.has_default_drive() && [0, GATEWAY_UNIT].contains(&unit);
        if unit == GATEWAY_UNIT && !is_default {
            return self.gateway(frame, now).unwrap_or_else(Decision::from);
        }
        let Some(drive) = self.routes.drive(unit) else {
            return Exception::GATEWAY_PATH.into();
        };
        let profile = &drive.image.spec.profile;
        let decoded = RequestPdu::decode(frame.pdu);
        // Authority is checked before anything else that could be wrong with the request.
        if writes && !self.may_write(drive) {
            return match decoded {
                Ok(request) => forwarded(
                    frame.header,
                    drive,
                    request.clone(),
                    BusWork::Order(Order::Write(request)),
                ),
                Err(_) => Exception::FUNCTION.into(),
            };
        }
        let registers = self.routes.registers();
        let has_function = has_function(profile, frame.function);
        let is_own = OWN_FUNCTIONS.contains(&frame.function) && (registers != Registers::Raw || frame.function == 43);
        if !has_function && !is_own && !is_default {
            return Exception::FUNCTION.into();
        }
        let request = match decoded {
            Ok(request) => request,
            Err(code) => return code.into(),
        };
        if is_default && stops_by(&request, STOP_ALL) {
            return stop_of_default(frame.header, drive, request);
        }
        match request {
            RequestPdu::Read { table, start, count } if !table.is_bits() => match registers.locate(start, count) {
                At::Model(start) => self.common(drive, request, start, count, now),
                At::Drive if has_function => self.raw_read(frame.header, drive, request, now),
                At::Drive => Exception::FUNCTION.into(),
                At::Nowhere => Exception::ADDRESS.into(),
            },
            RequestPdu::WriteRegister { address, value } => {
                self.write(frame.header, drive, request, (address, &[value]), now)
            }
            RequestPdu::WriteRegisters { start, ref values } => {
                let values = values.clone();
                self.write(frame.header, drive, request, (start, &values), now)
            }
            RequestPdu::ReadWrite {
                read_start,
                read_count,
                write_start,
                ref values,
            } => {
                let values = values.clone();
                let write = (write_start, values.as_slice());
                self.write_and_read(frame.header, drive, request, write, (read_start, read_count), now)
            }
            RequestPdu::DeviceIdentification { code, object } => {
                let identity = Identity {
                    product: &profile.name,
                    title: &profile.described(),
                    name: &drive.image.spec.name,
                };
                identity
                    .reply(code, object)
                    .map_or_else(Decision::from, |reply| Decision::Reply(request, reply))
            }
            RequestPdu::Read { .. } if has_function => self.raw_read(frame.header, drive, request, now),
            _ if has_function => forwarded(
                frame.header,
                drive,
                request.clone(),
                BusWork::Order(Order::Write(request)),
            ),
            _ => Exception::FUNCTION.into(),
        }
    }

    /// A write that began when its unit id or its address meant something else: a stop in it is carried out on the
    /// machine that it named, the rest nowhere.
    fn to_former(&self, frame: &Frame<'_>, earlier: &EarlierUnit) -> Decision {
        let may_write = self.client.rights.authority() == Authority::Write;
        let (Some(drive), Ok(request), true) = (&earlier.drive, RequestPdu::decode(frame.pdu), may_write) else {
            return Exception::GATEWAY_PATH.into();
        };
        let work = match earlier.stop(drive, &request) {
            Some(stop) => BusWork::Stop(stop, meant_another()),
            None => BusWork::Refused(meant_another()),
        };
        forwarded(frame.header, drive, request, work)
    }

    /// A write of registers: to the command block, or to the drive.
    fn write(
        &self,
        header: Header,
        drive: &DriveHandle,
        request: RequestPdu,
        (start, values): (u16, &[u16]),
        now: Instant,
    ) -> Decision {
        let count = u16::try_from(values.len()).unwrap_or(u16::MAX);
        match self.routes.registers().locate(start, count) {
            At::Model(start) => self.command(header, drive, request, start, values, now),
            At::Drive if has_function(&drive.image.spec.profile, 6) => {
                let order = Order::Write(write_part(&request).into_owned());
                forwarded(header, drive, request, BusWork::Order(order))
            }
            At::Drive => Exception::FUNCTION.into(),
            At::Nowhere => match self.routes.registers().around_the_command_word(start, count) {
                Some(start) => self.command(header, drive, request, start, values, now),
                None => Exception::ADDRESS.into(),
            },
        }
    }

    /// Executes function 23: the write and, after its result, the read. Both are checked before anything is
    /// written; a stop in the write is carried out even if the rest is refused. Nothing else of a refused write counts,
    /// not even for the hold, the lease or the next command word.
    fn write_and_read(
        &self,
        header: Header,
        drive: &DriveHandle,
        request: RequestPdu,
        write: (u16, &[u16]),
        (start, count): (u16, u16),
        now: Instant,
    ) -> Decision {
        let registers = self.routes.registers();
        let at = registers.locate(start, count);
        let then = ReadBehind { at, start, count };
        if let Err(code) = self.judge_read(header, drive, then, now) {
            return match registers.stop_in(drive, write) {
                Some(stop) => forwarded(header, drive, request, BusWork::Stop(stop, not_readable(code, start))),
                None => code.into(),
            };
        }
        match self.write(header, drive, request, write, now) {
            Decision::Drive(mut both) => {
                both.0.then = Some(then);
                Decision::Drive(both)
            }
            // The write needs no command on the bus: it only renews the lease or concerns the hold of the drive.
            Decision::Reply(request, _) => {
                let mut forwarded = ForwardedRequest::new(header, drive, request);
                forwarded.then = Some(then);
                Decision::Drive(Box::new((forwarded, BusWork::Written)))
            }
            other => other,
        }
    }

    /// Whether a read of holding registers can be answered.
    fn judge_read(
        &self,
        header: Header,
        drive: &DriveHandle,
        ReadBehind { at, start, count }: ReadBehind,
        now: Instant,
    ) -> Result<(), Exception> {
        match at {
            At::Model(start) => common(drive, &self.client, start, count, now).map(|_| ()),
            At::Drive if !has_function(&drive.image.spec.profile, 3) => Err(Exception::ADDRESS),
            At::Drive => match self.raw_read(header, drive, RequestPdu::read(Table::Holding, start, count), now) {
                Decision::Exception(code) => Err(code),
                _ => Ok(()),
            },
            At::Nowhere => Err(Exception::ADDRESS),
        }
    }

    fn may_write(&self, drive: &DriveHandle) -> bool {
        self.client.rights.authority() == Authority::Write && drive.image.spec.access == Access::Control
    }

    fn raw_read(&self, header: Header, drive: &DriveHandle, request: RequestPdu, now: Instant) -> Decision {
        let RequestPdu::Read { table, start, count } = request else {
            return Exception::FUNCTION.into();
        };
        let profile = &drive.image.spec.profile;
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
            Err(Unavailable::NotPolled) if self.state.options.load().uncached == Uncached::Refuse => {
                Exception::ADDRESS.into()
            }
            Err(Unavailable::NotPolled) => {
                match read_parts(drive.bus.image.spec.protocol, &reading, table, start, count) {
                    Err(code) => code.into(),
                    Ok(Some(read_parts)) => forwarded(header, drive, request, BusWork::Parts(read_parts)),
                    Ok(None) if count > read_limit(profile, table, start, count) => Exception::VALUE.into(),
                    Ok(None) => forwarded(header, drive, request.clone(), BusWork::Order(Order::Read(request))),
                }
            }
        }
    }
}

fn forwarded(header: Header, drive: &DriveHandle, request: RequestPdu, work: BusWork) -> Decision {
    Decision::Drive(Box::new((ForwardedRequest::new(header, drive, request), work)))
}

/// The drive at units 0 and 255 is stopped by the write that elsewhere stops all drives.
fn stop_of_default(header: Header, drive: &DriveHandle, request: RequestPdu) -> Decision {
    let Some(run) = drive.image.spec.profile.model_index(ModelPoint::Run) else {
        return Exception::FUNCTION.into();
    };
    let stop = Order::Points(vec![(run, Value::Bool(false))]);
    let alone = stops_all_only(&request);
    let work = if alone {
        BusWork::Order(stop)
    } else {
        BusWork::Stop(stop, not_readable(Exception::ADDRESS, STOP_ALL))
    };
    forwarded(header, drive, request, work)
}

#[cfg(test)]
mod tests;
