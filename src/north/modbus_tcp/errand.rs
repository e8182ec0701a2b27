//! Requests whose answers the cache does not have: they go to the drive.

use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Instant;

use super::frame::Header;
use super::shared::Client;
use crate::cache::{Reading, Unavailable};
use crate::codec::n2::Object;
use crate::codec::{Exception, Protocol, Reply, RequestPdu, Table, describe};
use crate::command::{Authority, DEFAULT_EXPIRY, Order, Outcome, Refusal};
use crate::plant::{DriveHandle, Placed};

/// A request on its way to a drive.
#[derive(Debug)]
pub(super) struct Errand {
    pub(super) header: Header,
    pub(super) drive: DriveHandle,
    pub(super) request: RequestPdu,
    /// The order carries a fault reset that came by 0x8100.
    pub(super) resets: bool,
    read: Option<PiecewiseRead>,
}

/// What there is to do.
#[derive(Debug)]
pub(super) enum Work {
    Order(Order),
    /// There is no order; it is refused, which the audit shows.
    Refused(Refusal),
    /// A read object by object.
    Pieces(Vec<Piece>),
}

/// Part of a read.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Piece {
    /// The cache has it.
    Known(Vec<u16>),
    /// The drive is asked for an object; so many of its items are left out, so many taken.
    Ask { pdu: RequestPdu, skip: usize, take: usize },
}

/// How far a read object by object has come.
#[derive(Debug)]
struct PiecewiseRead {
    words: Vec<u16>,
    left: std::vec::IntoIter<Piece>,
    /// Of the object that the drive is asked for now: so many items are left out, so many taken.
    asked: (usize, usize),
}

/// What becomes of an errand.
#[derive(Debug)]
pub(super) enum Step {
    /// An order of it is in the queue.
    Waits(Waiting),
    /// Its answer is known.
    Done(Box<Errand>, Outcome),
}

/// An errand that waits for the bus. Its order is in the queue; waiting is all that is left.
#[derive(Debug)]
pub(super) struct Waiting {
    /// Gone once it is answered.
    errand: Option<Box<Errand>>,
    placed: Placed,
}

/// The bus has answered an order of the errand.
#[derive(Debug)]
pub(super) struct Answered {
    errand: Box<Errand>,
    outcome: Outcome,
}

impl Future for Waiting {
    type Output = Answered;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Answered> {
        match (self.placed.poll_answer(cx), self.errand.take()) {
            (Poll::Ready(answer), Some(errand)) => Poll::Ready(Answered {
                errand,
                outcome: answer.outcome,
            }),
            (_, errand) => {
                self.errand = errand;
                Poll::Pending
            }
        }
    }
}

impl Errand {
    pub(super) fn new(header: Header, drive: &DriveHandle, request: RequestPdu, resets: bool) -> Errand {
        Errand {
            header,
            drive: drive.clone(),
            request,
            resets,
            read: None,
        }
    }

    /// Sends it: its order, or its first one, is in the queue when this returns.
    pub(super) fn send(self, work: Work, client: &Client, now: Instant) -> Step {
        let mut errand = Box::new(self);
        match work {
            Work::Order(order) => errand.place(order, client, client.authority, now),
            Work::Refused(refusal) => {
                let what = describe::request(&errand.request);
                let answer = errand.drive.refuse(&what, refusal, client.origin(), now);
                Step::Done(errand, answer.outcome)
            }
            Work::Pieces(pieces) => {
                errand.read = Some(PiecewiseRead {
                    words: Vec::new(),
                    left: pieces.into_iter(),
                    asked: (0, 0),
                });
                errand.read_on(client, now)
            }
        }
    }

    fn place(self: Box<Self>, order: Order, client: &Client, authority: Authority, now: Instant) -> Step {
        let placed = self.drive.place(order, client.origin(), authority, DEFAULT_EXPIRY, now);
        Step::Waits(Waiting {
            errand: Some(self),
            placed,
        })
    }

    /// Asks for the next object of a read, if any is left.
    fn read_on(mut self: Box<Self>, client: &Client, now: Instant) -> Step {
        let Some(read) = &mut self.read else {
            return Step::Done(self, Outcome::Exception(Exception::DEVICE_FAILURE));
        };
        for piece in read.left.by_ref() {
            match piece {
                Piece::Known(known) => read.words.extend(known),
                Piece::Ask { pdu, skip, take } => {
                    read.asked = (skip, take);
                    return self.place(Order::Read(pdu), client, Authority::ReadOnly, now);
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
        Step::Done(self, Outcome::Acknowledged(reply))
    }
}

impl Answered {
    /// What comes of the errand now: a read object by object asks for the next one, until one fails.
    pub(super) fn go_on(mut self, client: &Client, now: Instant) -> Step {
        let Some(read) = &mut self.errand.read else {
            return Step::Done(self.errand, self.outcome);
        };
        let (skip, take) = read.asked;
        match self.outcome {
            Outcome::Acknowledged(Reply::Registers(got)) => read.words.extend(got.iter().skip(skip).take(take)),
            Outcome::Acknowledged(Reply::Bits(got)) => {
                read.words
                    .extend(got.iter().skip(skip).take(take).map(|bit| u16::from(*bit)));
            }
            Outcome::Acknowledged(_) => {
                return Step::Done(self.errand, Outcome::Exception(Exception::DEVICE_FAILURE));
            }
            outcome => return Step::Done(self.errand, outcome),
        }
        self.errand.read_on(client, now)
    }
}

/// A read that the cache cannot answer as a whole, object by object, where it is objects that the drive reads (N2: one in
/// a transaction); `None` where it reads registers, and the request goes to it as it is.
///
/// # Errors
/// What the client is told at once: part of it is stale, was refused by the drive, or cannot be an object.
pub(super) fn pieces(
    protocol: Protocol,
    reading: &Reading<'_>,
    table: Table,
    start: u16,
    count: u16,
) -> Result<Option<Vec<Piece>>, Exception> {
    if protocol != Protocol::N2 {
        return Ok(None);
    }
    let mut pieces = Vec::new();
    let (mut at, mut left) = (start, count);
    while left > 0 {
        let (first, items) = object_around(table, at).ok_or(Exception::ADDRESS)?;
        let skip = at - first;
        let take = left.min(items - skip);
        match reading.words(table, at, take) {
            Ok(words) => pieces.push(Piece::Known(words)),
            Err(Unavailable::Refused(code)) => return Err(code),
            Err(Unavailable::Stale) => return Err(Exception::GATEWAY_TARGET),
            Err(Unavailable::NotPolled) => pieces.push(Piece::Ask {
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
    Ok(Some(pieces))
}

/// First address and items of the object that has that address.
fn object_around(table: Table, address: u16) -> Option<(u16, u16)> {
    let (first, object) = [address, address.saturating_sub(1)]
        .into_iter()
        .find_map(|first| Some((first, Object::at(table, first)?)))?;
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
