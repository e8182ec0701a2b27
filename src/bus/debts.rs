//! Replies that a drive may still owe: a late one must not be taken for the answer to the next request. Pure.
//!
//! An RTU reply names neither register nor request. After an exchange without a believable answer, the reply may come
//! during a later exchange. It is told apart by address, function and length; only a request to the same drive whose
//! reply would look the same could be answered wrongly. Such a request waits until the debt is forgotten. The same
//! request may be sent again at once: whichever reply comes, it tells the truth about the same registers.
//!
//! But the reply that comes then may be the older one, and the newer is owed in its place: a drive that is always a
//! little slower than the deadline stays one reply behind as long as the same request follows upon itself. So while a
//! look-alike waits, the request that is in debt is held back too after a while: the drive gets the time to pay.
//!
//! A write acknowledged late is worth nothing once the drive may have taken another write in between: the same
//! write then waits as a look-alike does. A stop does not wait. So the first acknowledgement of such a stop proves nothing:
//! it may be that of the earlier stop, and the stop is sent once more, which does no harm. Where nothing was
//! written in between, either acknowledgement tells the truth: the drive's last word is a stop.
//!
//! Nor does a stop wait for look-alikes. The acknowledgement of a write of several registers or coils has first address and
//! count, not the values. So a stop by such a write is sent once more for each acknowledgement of another one that may
//! still come. From then on it is the stop that owes an acknowledgement, in place of the other write.

use std::time::{Duration, Instant};

use crate::codec::RequestPdu;

/// A reply that has not come by then will not come.
const FORGOTTEN_AFTER: Duration = Duration::from_secs(1);
/// A look-alike waits no longer than that before the request in debt is held back for it.
const PATIENCE: Duration = Duration::from_secs(1);
/// No more tries of one write than that are acknowledged late: neither the drive nor what is before it keeps more.
const KEPT: u32 = 3;

/// What the drives of a bus owe.
#[derive(Debug, Default)]
pub struct Debts {
    owed: Vec<Debt>,
    /// What was answered last.
    last: Option<(usize, RequestPdu)>,
}

#[derive(Debug)]
struct Debt {
    drive: usize,
    pdu: RequestPdu,
    /// When the first of the exchanges that were given up in a row began; `None` once the request was answered.
    since: Option<Instant>,
    until: Instant,
    /// How late the answer was, if it was the older reply.
    late: Duration,
    /// Until when the newer reply may come.
    newer: Option<Instant>,
    /// Since when a look-alike waits.
    wanted: Option<Instant>,
    /// Replies that may still come.
    unpaid: u32,
    /// How many of them are of tries before another write, which the drive may have taken.
    overtaken: u32,
}

impl Debt {
    fn new(drive: usize, pdu: &RequestPdu, began: Instant, until: Instant) -> Debt {
        Debt {
            drive,
            pdu: pdu.clone(),
            since: Some(began),
            until,
            late: Duration::ZERO,
            newer: None,
            wanted: None,
            unpaid: 1,
            overtaken: 0,
        }
    }

    fn ends(&self) -> Instant {
        self.newer.map_or(self.until, |newer| newer.max(self.until))
    }

    fn blocks(&self, pdu: &RequestPdu, now: Instant) -> bool {
        if self.pdu == *pdu {
            self.overtaken > 0 || self.wanted.is_some_and(|since| now >= since + PATIENCE)
        } else {
            Look::of(&self.pdu) == Look::of(pdu)
        }
    }
}

impl Debts {
    /// No believable answer to `pdu` came in an exchange from `began` to `now`.
    pub fn given_up(&mut self, drive: usize, pdu: &RequestPdu, began: Instant, now: Instant) {
        self.owed.retain(|debt| debt.ends() > now);
        self.overtake(drive, pdu);
        let until = now + FORGOTTEN_AFTER;
        match self.of(drive, pdu) {
            Some(debt) => {
                debt.until = until;
                debt.since.get_or_insert(began);
                // Reads tell the truth in any order.
                if pdu.is_write() {
                    debt.unpaid = (debt.unpaid + 1).min(KEPT);
                }
            }
            None => self.owed.push(Debt::new(drive, pdu, began, until)),
        }
    }

    fn of(&mut self, drive: usize, pdu: &RequestPdu) -> Option<&mut Debt> {
        self.owed
            .iter_mut()
            .find(|debt| debt.drive == drive && debt.pdu == *pdu)
    }

    /// An answer to `pdu` came.
    pub fn answered(&mut self, drive: usize, pdu: &RequestPdu, now: Instant) {
        self.last = Some((drive, pdu.clone()));
        self.owed.retain(|debt| debt.ends() > now);
        for debt in self.owed.iter_mut().filter(|debt| debt.drive == drive) {
            if debt.pdu == *pdu {
                // The newer reply will be about as late as the older one was, if it was the older one.
                if let Some(since) = debt.since.take() {
                    debt.late = now.saturating_duration_since(since).max(debt.late).min(FORGOTTEN_AFTER);
                }
                debt.newer = Some(now + debt.late);
            }
        }
        self.overtake(drive, pdu);
    }

    /// The drive may have taken `pdu`: an acknowledgement of another write from before does not tell how it is now.
    fn overtake(&mut self, drive: usize, pdu: &RequestPdu) {
        let others = self
            .owed
            .iter_mut()
            .filter(|debt| debt.drive == drive && debt.pdu != *pdu);
        for debt in others.filter(|debt| pdu.is_write() && debt.pdu.is_write()) {
            debt.overtaken = debt.unpaid;
        }
    }

    /// Whether the reply to `pdu`, sent at `sent`, may be that to an earlier request: to another one that looks the same,
    /// or to the same write before another one. To be asked before [`Debts::answered`]; told once for each
    /// reply that is owed, and `pdu`, which is to be sent once more, owes one in its place.
    pub fn proves_nothing(&mut self, drive: usize, pdu: &RequestPdu, sent: Instant, now: Instant) -> bool {
        let owed = |debt: &Debt| debt.drive == drive && debt.ends() > sent;
        let same = |debt: &&mut Debt| owed(debt) && debt.pdu == *pdu && debt.overtaken > 0;
        if let Some(debt) = self.owed.iter_mut().find(same) {
            debt.overtaken -= 1;
            return true;
        }
        let alike = |debt: &Debt| owed(debt) && debt.pdu != *pdu && Look::of(&debt.pdu) == Look::of(pdu);
        let Some(index) = self.owed.iter().position(alike) else {
            return false;
        };
        if let Some(debt) = self.owed.get_mut(index).filter(|debt| debt.unpaid > 1) {
            debt.unpaid -= 1;
        } else {
            self.owed.swap_remove(index);
        }
        self.given_up(drive, pdu, sent, now);
        true
    }

    /// Whether the last reply, if it came once more, could pass for the reply to `pdu`.
    pub fn could_be_doubled(&self, drive: usize, pdu: &RequestPdu) -> bool {
        let last = self.last.as_ref().filter(|(of, _)| *of == drive);
        last.is_some_and(|(_, last)| Look::of(last) == Look::of(pdu))
    }

    /// Whether a drive owes anything.
    pub fn owes(&self, drive: usize, now: Instant) -> bool {
        self.owed.iter().any(|debt| debt.drive == drive && debt.ends() > now)
    }

    /// Until when `pdu` must wait because a reply that is owed could pass for its own.
    pub fn blocks(&mut self, drive: usize, pdu: &RequestPdu, now: Instant) -> Option<Instant> {
        let mut until = None;
        let owed = self
            .owed
            .iter_mut()
            .filter(|debt| debt.drive == drive && debt.ends() > now);
        for debt in owed {
            if debt.blocks(pdu, now) {
                until = until.max(Some(debt.ends()));
                if debt.pdu != *pdu {
                    debt.wanted.get_or_insert(now);
                }
            }
        }
        until
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

    const DEADLINE: Duration = Duration::from_millis(105);

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
        debts.given_up(1, &read(2100, 11), now - DEADLINE, now);
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
            now - DEADLINE,
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
            now - DEADLINE,
            now,
        );
        let other = RequestPdu::WriteRegisters {
            start: 2000,
            values: vec![0, 2],
        };
        assert!(debts.blocks(0, &other, now).is_some());
    }

    /// A drive that answers each request 110 ms after it was sent, where the deadline is 105 ms: it is one reply behind
    /// all the time. Two reads that look alike are due all the time.
    #[test]
    fn a_drive_that_is_one_reply_behind_is_never_misunderstood() {
        let (a, b) = (read(2100, 3), read(2104, 3));
        let late = Duration::from_millis(110);
        let start = Instant::now();
        let (mut now, mut debts) = (start, Debts::default());
        let mut coming: std::collections::VecDeque<(Instant, RequestPdu)> = std::collections::VecDeque::new();
        let mut answered = [0, 0];
        let mut turn = 0;
        while now < start + Duration::from_secs(20) {
            turn += 1;
            let order = if turn % 2 == 0 { [&a, &b] } else { [&b, &a] };
            let Some(asked) = order.into_iter().find(|pdu| debts.blocks(0, pdu, now).is_none()) else {
                now += Duration::from_millis(1);
                coming.retain(|(at, _)| *at > now);
                continue;
            };
            // What came while nobody listened is noise.
            coming.retain(|(at, _)| *at > now);
            coming.push_back((now + late, asked.clone()));
            let deadline = now + DEADLINE;
            match coming.front().cloned().filter(|(at, _)| *at <= deadline) {
                Some((at, of)) => {
                    coming.pop_front();
                    now = at;
                    assert_eq!(&of, asked, "after {:?}", now - start);
                    answered[usize::from(of == b)] += 1;
                    debts.answered(0, asked, now);
                }
                None => {
                    now = deadline;
                    debts.given_up(0, asked, now - DEADLINE, now);
                }
            }
            now += Duration::from_millis(2);
        }
        assert!(answered.iter().all(|count| *count > 5), "both are read: {answered:?}");
    }

    #[test]
    fn a_request_in_debt_is_not_held_back_for_ever() {
        let start = Instant::now();
        let mut debts = Debts::default();
        let (a, b) = (read(2100, 3), read(2104, 3));
        debts.given_up(0, &a, start - DEADLINE, start);
        let ms = Duration::from_millis;
        let mut longest = Duration::ZERO;
        let (mut last_a, mut first_b) = (start, None);
        for millisecond in 0..5000 {
            let now = start + ms(millisecond);
            if first_b.is_none() && debts.blocks(0, &b, now).is_none() {
                first_b = Some(now - start);
            }
            if millisecond % 12 == 0 && debts.blocks(0, &a, now).is_none() {
                longest = longest.max(now - last_a);
                last_a = now;
                debts.answered(0, &a, now);
            }
        }
        assert!(first_b.is_some_and(|at| at < ms(2200)), "{first_b:?}");
        assert!(longest < ms(1200), "{longest:?}");
        assert!(start + ms(5000) - last_a < ms(20), "the debt is forgotten");
    }

    #[test]
    fn a_late_acknowledgement_does_not_stand_for_a_write_that_another_overtook() {
        let now = Instant::now();
        let write = |value| RequestPdu::WriteRegister { address: 2000, value };
        let mut debts = Debts::default();
        debts.given_up(0, &write(1), now - DEADLINE, now);
        assert_eq!(debts.blocks(0, &write(1), now), None, "tried again at once");
        debts.answered(0, &write(0), now);
        assert_eq!(debts.blocks(0, &write(1), now), Some(now + FORGOTTEN_AFTER));
        assert_eq!(debts.blocks(0, &write(0), now), None);
    }

    #[test]
    fn the_first_acknowledgement_of_a_stop_that_was_overtaken_proves_nothing() {
        let now = Instant::now();
        let write = |value| RequestPdu::WriteRegister { address: 2000, value };
        let (stop, run) = (write(0), write(1));
        let mut debts = Debts::default();
        debts.given_up(0, &stop, now - DEADLINE, now);
        assert!(!debts.proves_nothing(0, &stop, now, now), "nothing came in between");
        debts.answered(0, &run, now);
        assert!(!debts.proves_nothing(1, &stop, now, now) && !debts.proves_nothing(0, &run, now, now));
        assert!(debts.proves_nothing(0, &stop, now, now));
        debts.answered(0, &stop, now);
        assert!(!debts.proves_nothing(0, &stop, now, now), "the second one counts");
        debts.answered(0, &stop, now);
        assert_eq!(debts.blocks(0, &run, now), None);
        // Forgotten: it will not come any more.
        debts.given_up(0, &stop, now - DEADLINE, now);
        debts.answered(0, &run, now);
        let later = now + FORGOTTEN_AFTER;
        assert!(!debts.proves_nothing(0, &stop, later, later));
    }

    #[test]
    fn an_acknowledgement_that_may_be_that_of_a_look_alike_proves_nothing() {
        let now = Instant::now();
        let registers = |value| RequestPdu::WriteRegisters {
            start: 2000,
            values: vec![value, 0],
        };
        let coils = |on| RequestPdu::WriteCoils {
            start: 0,
            bits: vec![on, false],
        };
        for (run, stop) in [(registers(1), registers(0)), (coils(true), coils(false))] {
            let mut debts = Debts::default();
            debts.given_up(0, &run, now - DEADLINE, now);
            assert!(!debts.proves_nothing(1, &stop, now, now), "another drive");
            assert!(debts.proves_nothing(0, &stop, now, now));
            assert!(!debts.proves_nothing(0, &stop, now, now), "the second one counts");
            debts.answered(0, &stop, now);
            // The stop went out twice and was acknowledged once.
            assert!(debts.blocks(0, &run, now).is_some());
            let later = now + FORGOTTEN_AFTER;
            assert_eq!(debts.blocks(0, &run, later), None);

            debts.given_up(0, &run, later, later);
            debts.given_up(0, &run, later, later);
            assert!(debts.proves_nothing(0, &stop, later, later) && debts.proves_nothing(0, &stop, later, later));
            assert!(!debts.proves_nothing(0, &stop, later, later), "one for each try");
            let forgotten = later + FORGOTTEN_AFTER;
            debts.given_up(0, &run, later, later);
            assert!(!debts.proves_nothing(0, &stop, forgotten, forgotten));
        }
    }

    #[test]
    fn a_drive_that_never_answers_does_not_hold_up_a_stop() {
        let now = Instant::now();
        let write = |value| RequestPdu::WriteRegisters {
            start: 2000,
            values: vec![value],
        };
        let mut debts = Debts::default();
        for _ in 0..100 {
            debts.given_up(0, &write(1), now - DEADLINE, now);
            debts.given_up(0, &read(1500, 1), now - DEADLINE, now);
        }
        let doubts = |debts: &mut Debts, pdu: &RequestPdu| {
            (0..100).take_while(|_| debts.proves_nothing(0, pdu, now, now)).count()
        };
        assert_eq!(doubts(&mut debts, &write(0)), 3);
        assert_eq!(doubts(&mut debts, &read(2000, 1)), 1);
    }

    #[test]
    fn a_write_that_was_not_answered_may_have_been_taken_all_the_same() {
        let now = Instant::now();
        let write = |value| RequestPdu::WriteRegister { address: 2000, value };
        let mut debts = Debts::default();
        debts.given_up(0, &write(0), now - DEADLINE, now);
        debts.given_up(0, &write(1), now - DEADLINE, now);
        assert!(debts.proves_nothing(0, &write(0), now, now));
        assert!(!debts.proves_nothing(0, &write(0), now, now));
    }
}
