//! Replies that a drive may still send after its transaction was given up: such a late reply must not be mistaken
//! for the reply to a later request. Pure: time is an argument.
//!
//! A Modbus reply names neither register nor request. After a transaction without a valid reply, the reply may
//! arrive during a later transaction. Address, function and length distinguish it from most replies; only a request
//! to the same drive with a reply of equal form could be answered wrongly. Such a look-alike request waits until no
//! late reply can arrive any more. The identical request may be sent again at once: whichever reply arrives is true
//! for the same registers.
//!
//! The reply that then arrives may be the older one, with the newer one still to come: a drive that is always
//! slightly slower than the deadline stays one reply behind as long as a request is repeated. Until this is
//! settled, samples get the time of the previous request. A reply that cannot be one of these settles it: a drive
//! answers in order, so after a reply to a request of another form no earlier reply can arrive. A plan has such
//! requests: its slow reads.
//!
//! Look-alike requests do not rely on that order: they only wait for the time to pass. While one waits, the request
//! whose reply is late is also held back after a while, so that the drive can catch up.
//!
//! A late acknowledgement of a write proves nothing once the drive may have received another write in between: the
//! same write then waits like a look-alike. A stop does not wait, so the first acknowledgement of such a stop
//! proves nothing: it may belong to the earlier stop, and the stop is sent once more, which does no harm. If
//! nothing was written in between, either acknowledgement is true: the drive's last word is a stop.
//!
//! A stop does not wait for look-alikes either. The acknowledgement of a write of several registers or coils
//! contains first address and count, not the values. So a stop by such a write is sent again for each
//! acknowledgement of another write that may still arrive. From then on, late acknowledgements are expected for the
//! stop instead of the other write.

use std::time::{Duration, Instant};

use drivegate_proto::RequestPdu;

/// Time after which a missing reply is no longer expected.
pub const FORGOTTEN_AFTER: Duration = Duration::from_secs(1);
/// How long a look-alike request waits before the request whose reply is late is held back for it.
const PATIENCE: Duration = Duration::from_secs(1);
/// Maximum number of attempts of one write that may be acknowledged late: neither the drive nor any device in between
/// buffers more.
const KEPT: u32 = 3;

/// Late replies of one drive that may still arrive.
#[derive(Debug, Default)]
pub struct LateReplies {
    expected: Vec<LateReply>,
}

#[derive(Debug)]
struct LateReply {
    pdu: RequestPdu,
    /// When the first in the present series of failed transactions began; `None` once the request was answered.
    since: Option<Instant>,
    until: Instant,
    /// How late the last reply was, if it was the older one.
    late: Duration,
    /// When the last answered request was sent: if its reply was the older one, the next reply belongs to that request.
    before: Option<Instant>,
    /// Time until which the newer of two replies may arrive.
    newer: Option<Instant>,
    /// Whether each reply certainly belongs to its own request, because the drive has replied to another request since.
    settled: bool,
    /// Since when a request with a reply of equal form has been waiting.
    wanted: Option<Instant>,
    /// Number of replies that may still arrive.
    count: u32,
    /// How many of these replies belong to attempts before another write that the drive may have received.
    overtaken: u32,
}

impl LateReply {
    fn new(pdu: &RequestPdu, began: Instant, until: Instant) -> LateReply {
        LateReply {
            pdu: pdu.clone(),
            since: Some(began),
            until,
            late: Duration::ZERO,
            before: None,
            newer: None,
            settled: false,
            wanted: None,
            count: 1,
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
            are_alike(&self.pdu, pdu)
        }
    }
}

impl LateReplies {
    /// No valid reply to `pdu` arrived in a transaction from `began` to `now`.
    pub fn given_up(&mut self, pdu: &RequestPdu, began: Instant, now: Instant) {
        self.expected.retain(|late| late.ends() > now);
        self.overtake(pdu);
        let until = now + FORGOTTEN_AFTER;
        match self.of(pdu) {
            Some(late) => {
                late.until = until;
                late.since.get_or_insert(began);
                late.settled = false;
                // The replies to reads are true in any order.
                if pdu.is_write() {
                    late.count = (late.count + 1).min(KEPT);
                }
            }
            None => self.expected.push(LateReply::new(pdu, began, until)),
        }
    }

    fn of(&mut self, pdu: &RequestPdu) -> Option<&mut LateReply> {
        self.expected.iter_mut().find(|late| late.pdu == *pdu)
    }

    /// A reply to `pdu`, sent at `sent`, arrived.
    pub fn answered(&mut self, pdu: &RequestPdu, sent: Instant, now: Instant) {
        self.expected.retain(|late| late.ends() > now);
        for late in &mut self.expected {
            if late.pdu == *pdu {
                // If the reply was the older one, the newer one will be about as late.
                if let Some(since) = late.since.take() {
                    late.late = now.saturating_duration_since(since).max(late.late).min(FORGOTTEN_AFTER);
                }
                late.before = Some(sent);
                if !late.settled {
                    late.newer = Some(now + late.late);
                }
            }
        }
        self.overtake(pdu);
    }

    /// Notes a reply to `pdu` that is not an exception: no reply to an earlier request of another form can arrive
    /// any more. It proves nothing if it may itself be a late reply to an earlier request. Must be called before
    /// [`LateReplies::answered`].
    pub(crate) fn settled_by(&mut self, pdu: &RequestPdu, now: Instant) {
        let owed = |late: &&LateReply| late.ends() > now && are_alike(&late.pdu, pdu);
        if self.expected.iter().any(|late| owed(&late)) {
            return;
        }
        for late in &mut self.expected {
            (late.settled, late.since) = (true, None);
        }
    }

    /// Notes that the drive may have received `pdu`: an acknowledgement of an earlier write no longer shows its
    /// present state.
    fn overtake(&mut self, pdu: &RequestPdu) {
        let others = self.expected.iter_mut().filter(|late| late.pdu != *pdu);
        for late in others.filter(|late| pdu.is_write() && late.pdu.is_write()) {
            late.overtaken = late.count;
        }
    }

    /// Whether the reply to `pdu`, sent at `sent`, may belong to an earlier request: to another one of equal form,
    /// or to an identical write before another write. True once for each late reply; `pdu` must then be sent again,
    /// and its reply is expected instead. Must be called before [`LateReplies::answered`].
    pub(crate) fn proves_nothing(&mut self, pdu: &RequestPdu, sent: Instant, now: Instant) -> bool {
        let owed = |late: &LateReply| late.ends() > sent;
        let same = |late: &&mut LateReply| owed(late) && late.pdu == *pdu && late.overtaken > 0;
        if let Some(late) = self.expected.iter_mut().find(same) {
            late.overtaken -= 1;
            return true;
        }
        let alike = |late: &LateReply| owed(late) && late.pdu != *pdu && are_alike(&late.pdu, pdu);
        let Some(index) = self.expected.iter().position(alike) else {
            return false;
        };
        if let Some(late) = self.expected.get_mut(index).filter(|late| late.count > 1) {
            late.count -= 1;
        } else {
            self.expected.swap_remove(index);
        }
        self.given_up(pdu, sent, now);
        true
    }

    /// The earliest time at which the request answered at `now` by a reply to `pdu` may have been sent: before the
    /// present request while a late reply to an identical request may arrive. Must be called before
    /// [`LateReplies::answered`].
    pub(crate) fn asked_by(&self, pdu: &RequestPdu, now: Instant) -> Instant {
        let doubtful = |late: &LateReply| late.ends() > now && !late.settled;
        let same = self.expected.iter().find(|late| late.pdu == *pdu && doubtful(late));
        same.map_or(now, |late| late.since.or(late.before).unwrap_or(now))
    }

    /// Time until which any late reply may arrive.
    pub fn until(&self) -> Option<Instant> {
        self.expected.iter().map(LateReply::ends).max()
    }

    /// Number of requests whose replies may still arrive.
    pub(super) fn owed(&self, now: Instant) -> usize {
        self.expected.iter().filter(|late| late.ends() > now).count()
    }

    /// Whether any late reply may still arrive.
    pub fn may_come(&self, now: Instant) -> bool {
        self.expected.iter().any(|late| late.ends() > now)
    }

    /// Until when `pdu` must wait because a late reply could be mistaken for its own.
    pub fn blocks(&mut self, pdu: &RequestPdu, now: Instant) -> Option<Instant> {
        let mut until = None;
        for late in self.expected.iter_mut().filter(|late| late.ends() > now) {
            if late.blocks(pdu, now) {
                until = until.max(Some(late.ends()));
                if late.pdu != *pdu {
                    late.wanted.get_or_insert(now);
                }
            }
        }
        until
    }
}

/// Whether the reply to one of these requests could be mistaken for the reply to the other.
pub fn are_alike(a: &RequestPdu, b: &RequestPdu) -> bool {
    ReplyShape::of(a) == ReplyShape::of(b)
}

/// The part of a request that can be recognised in its reply.
#[derive(Debug, PartialEq, Eq)]
enum ReplyShape<'r> {
    /// A read: its reply shows function and length.
    Read(u8, usize),
    /// Function, first address and count of a write of several items.
    Several(u8, u16, usize),
    /// The whole request, which the reply echoes.
    Function(u8),
    /// Everything: the request is echoed whole.
    Whole(&'r RequestPdu),
}

impl ReplyShape<'_> {
    fn of(pdu: &RequestPdu) -> ReplyShape<'_> {
        match pdu {
            RequestPdu::Read { .. } | RequestPdu::ReadWrite { .. } => ReplyShape::Read(pdu.function(), pdu.reply_len()),
            RequestPdu::WriteRegisters { start, values } => ReplyShape::Several(16, *start, values.len()),
            RequestPdu::WriteCoils { start, bits } => ReplyShape::Several(15, *start, bits.len()),
            RequestPdu::Other(_) => ReplyShape::Function(pdu.function()),
            other => ReplyShape::Whole(other),
        }
    }
}

#[cfg(test)]
mod tests;
