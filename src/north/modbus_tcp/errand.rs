//! Requests whose answers the cache does not have: they go to the drive.

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;

use super::frame::Header;
use super::shared::{Authority, Shared};
use crate::cache::{Reading, Unavailable};
use crate::codec::n2::Object;
use crate::codec::{Exception, Protocol, Reply, RequestPdu, Table, describe};
use crate::command::{DEFAULT_EXPIRY, Order, Origin, Outcome, Refusal, SourceKind};
use crate::north::register_map;
use crate::plant::DriveHandle;

/// A request that waits for the bus.
pub(super) type Waiting = Pin<Box<dyn Future<Output = Finished> + Send>>;

/// A request whose answer is known.
#[derive(Debug)]
pub(super) struct Finished {
    pub(super) header: Header,
    pub(super) request: RequestPdu,
    pub(super) drive: String,
    pub(super) outcome: Outcome,
}

/// A request on its way to a drive.
pub(super) struct Errand {
    pub(super) drive: DriveHandle,
    pub(super) request: RequestPdu,
    pub(super) work: Work,
    /// The order carries a fault reset that came by 0x8100.
    pub(super) resets: bool,
}

/// What there is to do.
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

impl Errand {
    /// Sends it; the first poll queues its order, or its first one.
    pub(super) fn send(self, header: Header, shared: &Arc<Shared>, authority: &Authority) -> Waiting {
        let origin = Origin {
            kind: SourceKind::ModbusTcp,
            who: authority.who.clone(),
        };
        let may_write = authority.may_write;
        let shared = shared.clone();
        Box::pin(async move {
            let drive = &self.drive;
            let outcome = match self.work {
                Work::Order(order) => drive.order(order, origin, may_write, DEFAULT_EXPIRY).await.outcome,
                Work::Refused(refusal) => drive.refuse(&describe::request(&self.request), refusal, origin).outcome,
                Work::Pieces(pieces) => read(drive, pieces, &origin, &self.request).await,
            };
            let name = self.drive.image.spec.name.clone();
            if self.resets && !outcome.is_ok() {
                shared.with_command_word(&name, |word| *word = word.map(register_map::without_reset));
            }
            Finished {
                header,
                request: self.request,
                drive: name,
                outcome,
            }
        })
    }
}

/// Reads piece by piece; the first one that fails ends it.
async fn read(drive: &DriveHandle, pieces: Vec<Piece>, origin: &Origin, request: &RequestPdu) -> Outcome {
    let mut words = Vec::new();
    for piece in pieces {
        match piece {
            Piece::Known(known) => words.extend(known),
            Piece::Ask { pdu, skip, take } => {
                let order = Order::Read(pdu);
                match drive.order(order, origin.clone(), false, DEFAULT_EXPIRY).await.outcome {
                    Outcome::Acknowledged(Reply::Registers(got)) => words.extend(got.iter().skip(skip).take(take)),
                    Outcome::Acknowledged(Reply::Bits(got)) => {
                        words.extend(got.iter().skip(skip).take(take).map(|bit| u16::from(*bit)));
                    }
                    Outcome::Acknowledged(_) => return Outcome::Exception(Exception::DEVICE_FAILURE),
                    outcome => return outcome,
                }
            }
        }
    }
    Outcome::Acknowledged(match request {
        RequestPdu::Read { table, .. } if table.is_bits() => Reply::Bits(words.iter().map(|word| *word != 0).collect()),
        _ => Reply::Registers(words),
    })
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
