//! Replies that a drive may still owe: a late one must not be taken for the answer to the next request. Pure.
//!
//! An RTU reply names neither register nor request. After an exchange without a believable answer, the reply may come
//! during a later exchange. It is told apart by address, function and length; only a request to the same drive whose
//! reply would look the same could be answered wrongly. Such a request waits until the debt is forgotten. The same
//! request may be sent again at once: whichever reply comes, it tells the truth about the same registers.

use std::time::{Duration, Instant};

use crate::codec::RequestPdu;

/// A reply that has not come by then will not come.
const FORGOTTEN_AFTER: Duration = Duration::from_secs(1);

/// What the drives of a bus owe.
#[derive(Debug, Default)]
pub struct Debts(Vec<Debt>);

#[derive(Debug)]
struct Debt {
    drive: usize,
    pdu: RequestPdu,
    until: Instant,
}

impl Debts {
    /// No believable answer to `pdu` came.
    pub fn given_up(&mut self, drive: usize, pdu: &RequestPdu, now: Instant) {
        self.0
            .retain(|debt| debt.until > now && !(debt.drive == drive && debt.pdu == *pdu));
        self.0.push(Debt {
            drive,
            pdu: pdu.clone(),
            until: now + FORGOTTEN_AFTER,
        });
    }

    /// Until when `pdu` must wait because a reply that is owed could pass for its own.
    pub fn blocks(&self, drive: usize, pdu: &RequestPdu, now: Instant) -> Option<Instant> {
        let blocking = |debt: &&Debt| {
            debt.drive == drive && debt.until > now && debt.pdu != *pdu && Look::of(&debt.pdu) == Look::of(pdu)
        };
        self.0.iter().filter(blocking).map(|debt| debt.until).max()
    }
}

/// All that a reply shows of its request.
#[derive(Debug, PartialEq, Eq)]
enum Look<'r> {
    /// Function and length of a read.
    Read(u8, usize),
    /// Function, first address and count of a write of several items.
    Several(u8, u16, usize),
    /// Everything: the request comes back whole.
    Whole(&'r RequestPdu),
}

impl Look<'_> {
    fn of(pdu: &RequestPdu) -> Look<'_> {
        match pdu {
            RequestPdu::Read { .. } | RequestPdu::ReadWrite { .. } => Look::Read(pdu.function(), pdu.reply_len()),
            RequestPdu::WriteRegisters { start, values } => Look::Several(16, *start, values.len()),
            RequestPdu::WriteCoils { start, bits } => Look::Several(15, *start, bits.len()),
            other => Look::Whole(other),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec::Table;

    fn read(start: u16, count: u16) -> RequestPdu {
        RequestPdu::Read {
            table: Table::Holding,
            start,
            count,
        }
    }

    #[test]
    fn only_what_could_be_mistaken_waits() {
        let now = Instant::now();
        let mut debts = Debts::default();
        debts.given_up(1, &read(2100, 11), now);
        assert_eq!(debts.blocks(1, &read(2100, 11), now), None, "the same request");
        assert_eq!(debts.blocks(1, &read(2000, 3), now), None, "another length");
        assert_eq!(debts.blocks(2, &read(0, 11), now), None, "another drive");
        assert_eq!(
            debts.blocks(1, &RequestPdu::WriteRegister { address: 0, value: 1 }, now),
            None,
            "another function"
        );
        assert_eq!(
            debts.blocks(1, &read(0, 11), now),
            Some(now + FORGOTTEN_AFTER),
            "looks the same"
        );
        assert_eq!(debts.blocks(1, &read(0, 11), now + FORGOTTEN_AFTER), None, "forgotten");
    }

    #[test]
    fn echoes_of_writes() {
        let now = Instant::now();
        let mut debts = Debts::default();
        debts.given_up(
            0,
            &RequestPdu::WriteRegister {
                address: 2000,
                value: 1,
            },
            now,
        );
        assert_eq!(
            debts.blocks(
                0,
                &RequestPdu::WriteRegister {
                    address: 2000,
                    value: 0
                },
                now
            ),
            None
        );
        debts.given_up(
            0,
            &RequestPdu::WriteRegisters {
                start: 2000,
                values: vec![1, 2],
            },
            now,
        );
        let other = RequestPdu::WriteRegisters {
            start: 2000,
            values: vec![0, 2],
        };
        assert!(debts.blocks(0, &other, now).is_some());
    }
}
