//! Requests that the process image cannot answer and that are forwarded to the drive.

use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Instant;

use tokio::sync::oneshot;

use super::client::Client;
use super::frame::Header;
use super::routes::At;
use crate::register_map::{BusState, DriveView};
use drivegate_core::order::{Arrival, Authority, Order, Outcome, Refusal};
use drivegate_core::plant::{DriveHandle, OrderRequest, Placed};
use drivegate_core::process_image::{Reading, Unavailable};
use drivegate_proto::n2::Object;
use drivegate_proto::{Exception, Protocol, Reply, RequestPdu, Table, describe};

/// A request that is forwarded to a drive.
#[derive(Debug)]
pub(super) struct ForwardedRequest {
    pub(super) header: Header,
    pub(super) drive: DriveHandle,
    pub(super) request: RequestPdu,
    /// Whether the command includes a fault reset by 0x8100.
    pub(super) resets: bool,
    /// The read that follows once the write is done.
    pub(super) then: Option<ReadBehind>,
    read: Option<PartialRead>,
}

/// The read of function 23, which follows its write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ReadBehind {
    pub(super) at: At,
    /// First address, as in the registers of the drive.
    pub(super) start: u16,
    pub(super) count: u16,
}

/// The work that a forwarded request gives the bus.
#[derive(Debug)]
pub(super) enum BusWork {
    Order(Order),
    /// The stop of a request whose rest is refused; the refusal is audited.
    Stop(Order, Refusal),
    /// The write is done; only the read after it remains.
    Written,
    /// No work, because the request is refused; the refusal is audited.
    Refused(Refusal),
    /// A read that is split by object.
    Parts(Vec<ReadPart>),
}

#[derive(Debug, Clone, PartialEq)]
pub(super) enum ReadPart {
    /// Words that are already known from the process image.
    Known(Vec<u16>),
    /// A read of one object: the first `skip` of its items are dropped, the next `take` are used.
    Object { pdu: RequestPdu, skip: usize, take: usize },
}

/// A read that is split by object.
#[derive(Debug)]
struct PartialRead {
    words: Vec<u16>,
    left: std::vec::IntoIter<ReadPart>,
    /// Items of the object being read to skip, and to use.
    asked: (usize, usize),
}

impl PartialRead {
    fn of(parts: Vec<ReadPart>) -> PartialRead {
        PartialRead {
            words: Vec::new(),
            left: parts.into_iter(),
            asked: (0, 0),
        }
    }
}

/// Progress of a forwarded request.
#[derive(Debug)]
pub(super) enum Progress {
    /// A command of the request is in the queue.
    Pending(PendingRequest),
    /// The outcome of the request is known.
    Done(Box<ForwardedRequest>, Outcome),
    /// A stop of all drives has ended: whether every drive acknowledged it.
    Stopped(Header, RequestPdu, bool),
}

/// A request whose command is in the queue and that only waits for the result. The content is `None` once the
/// request is answered.
#[derive(Debug)]
pub(super) enum PendingRequest {
    Forwarded(Option<Box<ForwardedRequest>>, Placed),
    /// A stop of all drives waits for its result.
    StopAll(Option<(Header, RequestPdu)>, oneshot::Receiver<bool>),
}

/// A request with the result of a command.
#[derive(Debug)]
pub(super) enum AnsweredRequest {
    Forwarded(Box<ForwardedRequest>, Outcome),
    /// A stop of all drives, with whether every drive acknowledged it.
    StopAll(Header, RequestPdu, bool),
}

impl Future for PendingRequest {
    type Output = AnsweredRequest;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<AnsweredRequest> {
        match &mut *self {
            PendingRequest::Forwarded(forwarded, placed) => {
                let Poll::Ready(answer) = placed.poll_answer(cx) else {
                    return Poll::Pending;
                };
                forwarded.take().map_or(Poll::Pending, |forwarded| {
                    Poll::Ready(AnsweredRequest::Forwarded(forwarded, answer.outcome))
                })
            }
            PendingRequest::StopAll(request, acknowledged) => {
                let Poll::Ready(all) = Pin::new(acknowledged).poll(cx) else {
                    return Poll::Pending;
                };
                // Without an answer the process is ending, and the result stays unknown.
                let all = all.unwrap_or(false);
                request.take().map_or(Poll::Pending, |(header, request)| {
                    Poll::Ready(AnsweredRequest::StopAll(header, request, all))
                })
            }
        }
    }
}

impl ForwardedRequest {
    pub(super) fn new(header: Header, drive: &DriveHandle, request: RequestPdu) -> ForwardedRequest {
        ForwardedRequest {
            header,
            drive: drive.clone(),
            request,
            resets: false,
            then: None,
            read: None,
        }
    }

    /// Queues the command of the request, or the first of several commands, before it returns.
    pub(super) fn send(self, work: BusWork, client: &Client, arrival: Arrival, now: Instant) -> Progress {
        let mut forwarded = Box::new(self);
        match work {
            BusWork::Order(order) => forwarded.place(order, client, client.rights.authority(), arrival, now),
            BusWork::Stop(stop, refusal) => {
                let what = describe::request(&forwarded.request);
                let request = OrderRequest::new(stop, client.origin(), client.rights.authority());
                let request = request.without_rest(&what, refusal).arrived(arrival).resolved();
                let placed = forwarded.drive.place(request, now);
                Progress::Pending(PendingRequest::Forwarded(Some(forwarded), placed))
            }
            BusWork::Written => match forwarded.then.take() {
                Some(then) => forwarded.read_behind(then, client, now),
                None => Progress::Done(forwarded, Outcome::Acknowledged(Reply::Written)),
            },
            BusWork::Refused(refusal) => {
                let what = describe::request(&forwarded.request);
                let answer = forwarded.drive.refuse(&what, refusal, client.origin(), now);
                Progress::Done(forwarded, answer.outcome)
            }
            BusWork::Parts(read_parts) => {
                forwarded.read = Some(PartialRead::of(read_parts));
                forwarded.read_on(client, now)
            }
        }
    }

    fn place(
        self: Box<Self>,
        order: Order,
        client: &Client,
        authority: Authority,
        arrival: Arrival,
        now: Instant,
    ) -> Progress {
        let request = OrderRequest::new(order, client.origin(), authority);
        let placed = self.drive.place(request.arrived(arrival).resolved(), now);
        Progress::Pending(PendingRequest::Forwarded(Some(self), placed))
    }

    /// Executes the read part of function 23 after its write: from the process image, and from the drive for words
    /// that are not polled.
    pub(super) fn read_behind(mut self: Box<Self>, then: ReadBehind, client: &Client, now: Instant) -> Progress {
        let ReadBehind { at, start, count } = then;
        let known = match at {
            At::Model(start) => common(&self.drive, client, start, count, now).map_err(Some),
            At::Drive => match self.drive.reading(now).words(Table::Holding, start, count) {
                Ok(words) => Ok(words),
                Err(Unavailable::NotPolled) => Err(None),
                Err(Unavailable::Refused(code)) => Err(Some(code)),
                Err(Unavailable::Stale) => Err(Some(Exception::GATEWAY_TARGET)),
            },
            At::Nowhere => Err(Some(Exception::ADDRESS)),
        };
        match known {
            Ok(words) => Progress::Done(self, Outcome::Acknowledged(Reply::Registers(words))),
            Err(Some(code)) => Progress::Done(self, Outcome::Exception(code)),
            Err(None) => {
                let protocol = self.drive.bus.image.spec.protocol;
                let parts = read_parts(protocol, &self.drive.reading(now), Table::Holding, start, count);
                match parts {
                    Ok(None) => {
                        let order = Order::Read(RequestPdu::read(Table::Holding, start, count));
                        self.place(order, client, Authority::ReadOnly, Arrival::now(now), now)
                    }
                    Ok(Some(parts)) => {
                        self.read = Some(PartialRead::of(parts));
                        self.read_on(client, now)
                    }
                    Err(code) => Progress::Done(self, Outcome::Exception(code)),
                }
            }
        }
    }

    /// Requests the next object of a read, if any is left.
    fn read_on(mut self: Box<Self>, client: &Client, now: Instant) -> Progress {
        let Some(read) = &mut self.read else {
            return Progress::Done(self, Outcome::Exception(Exception::DEVICE_FAILURE));
        };
        for part in read.left.by_ref() {
            match part {
                ReadPart::Known(known) => read.words.extend(known),
                ReadPart::Object { pdu, skip, take } => {
                    read.asked = (skip, take);
                    let arrival = Arrival::now(now);
                    return self.place(Order::Read(pdu), client, Authority::ReadOnly, arrival, now);
                }
            }
        }
        let words = std::mem::take(&mut read.words);
        let reply = match &self.request {
            RequestPdu::Read { table, .. } if table.is_bits() => {
                Reply::Bits(words.iter().map(|word| *word != 0).collect())
            }
            _ => Reply::Registers(words),
        };
        Progress::Done(self, Outcome::Acknowledged(reply))
    }
}

/// Reads registers of the common model from this address on.
///
/// # Errors
/// If the model has no such registers; contains exception 02.
pub(super) fn common(
    drive: &DriveHandle,
    client: &Client,
    start: u16,
    count: u16,
    now: Instant,
) -> Result<Vec<u16>, Exception> {
    let reading = drive.reading(now);
    let bus = if drive.bus_up() { BusState::Up } else { BusState::Down };
    let hold = drive.has_authority().then(|| client.origin());
    let hold = hold.and_then(|origin| drive.hold_view(Some(&origin), now));
    DriveView::new(&reading, bus).with_hold(hold).registers(start, count)
}

impl AnsweredRequest {
    /// Continues a read with its next object, until one fails; any other request is done.
    pub(super) fn go_on(self, client: &Client, now: Instant) -> Progress {
        let (mut forwarded, outcome) = match self {
            AnsweredRequest::Forwarded(forwarded, outcome) => (forwarded, outcome),
            AnsweredRequest::StopAll(header, request, all) => return Progress::Stopped(header, request, all),
        };
        if let Some(then) = forwarded
            .then
            .take_if(|_| outcome == Outcome::Acknowledged(Reply::Written))
        {
            // The drive took the reset, whatever becomes of the read.
            forwarded.resets = false;
            return forwarded.read_behind(then, client, now);
        }
        let Some(read) = &mut forwarded.read else {
            return Progress::Done(forwarded, outcome);
        };
        let (skip, take) = read.asked;
        match outcome {
            Outcome::Acknowledged(Reply::Registers(got)) => read.words.extend(got.iter().skip(skip).take(take)),
            Outcome::Acknowledged(Reply::Bits(got)) => {
                read.words
                    .extend(got.iter().skip(skip).take(take).map(|bit| u16::from(*bit)));
            }
            Outcome::Acknowledged(_) => {
                return Progress::Done(forwarded, Outcome::Exception(Exception::DEVICE_FAILURE));
            }
            outcome => return Progress::Done(forwarded, outcome),
        }
        forwarded.read_on(client, now)
    }
}

/// Splits a read that the process image cannot answer as a whole into one read for each object, for protocols that
/// read one object in each transaction (N2). `None` for protocols that read registers: there the request is
/// forwarded unchanged.
///
/// # Errors
/// If part of the read data is stale, was refused by the drive, or does not exist: contains the exception.
pub(super) fn read_parts(
    protocol: Protocol,
    reading: &Reading<'_>,
    table: Table,
    start: u16,
    count: u16,
) -> Result<Option<Vec<ReadPart>>, Exception> {
    if protocol != Protocol::N2 {
        return Ok(None);
    }
    let mut read_parts = Vec::new();
    let (mut at, mut left) = (start, count);
    while left > 0 {
        let (first, items) = object_around(table, at).ok_or(Exception::ADDRESS)?;
        let skip = at - first;
        let take = left.min(items - skip);
        match reading.words(table, at, take) {
            Ok(words) => read_parts.push(ReadPart::Known(words)),
            Err(Unavailable::Refused(code)) => return Err(code),
            Err(Unavailable::Stale) => return Err(Exception::GATEWAY_TARGET),
            Err(Unavailable::NotPolled) => read_parts.push(ReadPart::Object {
                pdu: RequestPdu::Read {
                    table,
                    start: first,
                    count: items,
                },
                skip: skip.into(),
                take: take.into(),
            }),
        }
        left -= take;
        at = at.saturating_add(take);
    }
    Ok(Some(read_parts))
}

/// First address and number of items of the object that contains the address.
fn object_around(table: Table, address: u16) -> Option<(u16, u16)> {
    let (first, object) = [address, address.saturating_sub(1)]
        .into_iter()
        .find_map(|first| Some((first, Object::containing(table, first)?)))?;
    let items = object.items();
    (address < first.checked_add(items)?).then_some((first, items))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_object_around_an_address() {
        let around = [
            (Table::Input, 0, Some((0, 2))),
            (Table::Input, 1, Some((0, 2))),
            (Table::Holding, 7, Some((6, 2))),
            (Table::Holding, 509, Some((508, 2))),
            (Table::Holding, 510, None),
            (Table::Input, 511, None),
            (Table::Input, 0x3FFF, None),
            (Table::Input, 0x4000, Some((0x4000, 1))),
            (Table::Input, 0x4001, Some((0x4001, 1))),
            (Table::Coil, 3, Some((3, 1))),
            (Table::Coil, 254, Some((254, 1))),
            (Table::Coil, 255, None),
            (Table::DiscreteInput, u16::MAX, None),
        ];
        for (table, address, expected) in around {
            assert_eq!(object_around(table, address), expected, "{table} {address}");
        }
    }
}
