//! Late replies on an N2 line. Pure: time is an argument.
//!
//! An N2 reply names neither drive nor request; it shows only its form. After a transaction without a valid reply,
//! the reply may arrive during a later transaction with any drive. So the line remembers which forms may still
//! arrive, and for how long. Meanwhile no request is sent whose reply has such a form; other requests continue. A
//! frame of a form that cannot be the reply of the present transaction is the late one, and is no longer expected.
//! A reply whose form a late one may share by chance, such as a refusal, is not accepted. A slow drive answers one request
//! after the other, so after a late reply the next one may take as long again.
//!
//! Two things end the wait early. A drive answers in order: once it has answered a later request whose reply has
//! another form, no reply to an earlier request can arrive. Process data may be requested again at once if the
//! request was not answered since: whichever reply arrives belongs to the same object of the same drive. The value
//! then gets the time of the first of these requests.

use std::time::{Duration, Instant};

use drivegate_model::drive::{PlannedRead, PollClass};
use drivegate_proto::n2::command::Answer;
use drivegate_proto::n2::{Form, form};
use drivegate_proto::{Exception, RequestPdu};

/// Late replies remembered; beyond that the oldest is forgotten.
const KEPT: usize = 16;

/// The late replies that may still arrive on one line.
#[derive(Debug, Clone, Default)]
pub struct N2LateReplies(Vec<Late>);

/// A request to a drive whose reply may come late.
#[derive(Debug, Clone, Copy)]
pub struct LateRequest<'r> {
    /// The address of the drive.
    pub address: u8,
    /// The request that was sent.
    pub pdu: &'r RequestPdu,
    /// The device type with which the drive identifies itself.
    pub device: u8,
    /// When the request was sent.
    pub at: Instant,
}

#[derive(Debug, Clone)]
struct Late {
    address: u8,
    pdu: RequestPdu,
    form: Form,
    /// The device type that an identity would show.
    device: u8,
    /// When the first request was sent whose late reply may arrive.
    asked: Instant,
    until: Instant,
    /// How long the drive may still take after a transaction, or after its previous late reply.
    window: Duration,
    /// Number of replies that may still arrive: the request was sent that often without success.
    count: u32,
    /// Whether an equal request was answered since, by an unknown one of the replies.
    answered: bool,
}

/// The meaning of a valid frame in a transaction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Taken {
    /// The frame can only be the reply: no late reply has its form.
    Reply,
    /// The frame is a late reply: this many bytes are to be dropped.
    Late(usize),
    /// The frame may be the reply or a late one. The number of expected late replies stays, since the reply itself
    /// may still arrive.
    Doubtful,
}

impl N2LateReplies {
    /// Notes that no valid reply arrived until `now`; a late one can only arrive within `window`.
    pub fn given_up(&mut self, asked: LateRequest<'_>, window: Duration, now: Instant) {
        self.0.retain(|late| late.until > now);
        let Some(form) = form(asked.pdu) else { return };
        let until = now + window;
        if let Some(late) = self.of(asked.address, asked.pdu) {
            (late.until, late.window, late.answered) = (until, window, false);
            late.count = late.count.saturating_add(1);
            return;
        }
        if self.0.len() >= KEPT {
            self.0.remove(0);
        }
        self.0.push(Late {
            address: asked.address,
            pdu: asked.pdu.clone(),
            form,
            device: asked.device,
            asked: asked.at,
            until,
            window,
            count: 1,
            answered: false,
        });
    }

    fn of(&mut self, address: u8, pdu: &RequestPdu) -> Option<&mut Late> {
        self.0.iter_mut().find(|late| late.is_of(address, pdu))
    }

    /// The drive answered a request. Replies of another form to earlier requests will not arrive any more. Another
    /// reply to the same request may arrive within `window`; if the request was sent before, replies to requests that
    /// were sent in between may arrive too.
    pub fn answered(&mut self, address: u8, pdu: &RequestPdu, window: Duration, now: Instant) {
        let Some(form) = form(pdu) else { return };
        let first = self.of(address, pdu).map(|late| late.asked);
        let is_behind = |late: &Late| first.is_some_and(|first| late.asked > first);
        self.0.retain(|late| {
            late.address != address || late.form.is_like(form) || form.is_like(late.form) || is_behind(late)
        });
        if let Some(late) = self.of(address, pdu).filter(|late| !late.answered) {
            late.answered = true;
            self.take_as_long_again(&[address], now + window);
        }
    }

    /// Another reply of these drives came, perhaps a late one: each of the replies behind it may take as long again, and
    /// arrive until then.
    fn take_as_long_again(&mut self, addresses: &[u8], until: Instant) {
        for late in self.0.iter_mut().filter(|late| addresses.contains(&late.address)) {
            late.until = late.until.max(until);
        }
    }

    /// The time at which the object in the present reply was requested.
    pub(crate) fn asked_by(&self, address: u8, pdu: &RequestPdu, now: Instant) -> Option<Instant> {
        let late = self.0.iter().find(|late| late.is_of(address, pdu) && late.until > now);
        late.map(|late| late.asked)
    }

    /// Number of late replies that may still arrive.
    pub(super) fn owed(&self, now: Instant) -> usize {
        self.0.iter().filter(|late| late.until > now).count()
    }

    /// Whether any late reply may still arrive.
    pub fn may_come(&self, now: Instant) -> bool {
        self.0.iter().any(|late| late.until > now)
    }

    /// Time until which any late reply may arrive.
    pub fn until(&self) -> Option<Instant> {
        self.0.iter().map(|late| late.until).max()
    }

    /// Until when a request must wait because a late reply could be mistaken for its own.
    pub fn blocks(&self, pdu: &RequestPdu, now: Instant) -> Option<Instant> {
        let wanted = form(pdu)?;
        self.alike(wanted, now).map(|late| late.until).max()
    }

    /// Until when a poll is blocked: process data may be requested again, unless it was answered since.
    pub(super) fn blocks_poll(&self, address: u8, read: &PlannedRead, now: Instant) -> Option<Instant> {
        let pdu = read.pdu();
        let again = |late: &Late| read.class == PollClass::Fast && !late.answered && late.is_of(address, &pdu);
        let others = self.alike(form(&pdu)?, now).filter(|late| !again(late));
        others.map(|late| late.until).max()
    }

    fn alike(&self, wanted: Form, now: Instant) -> impl Iterator<Item = &Late> {
        self.0.iter().filter(move |late| late.could_pass_for(wanted, now))
    }

    /// The meaning of the complete frame at the start of `bytes`, received at `now` in the transaction of `pdu` with
    /// the drive at that address.
    pub fn take(&mut self, address: u8, pdu: &RequestPdu, bytes: &[u8], now: Instant) -> Taken {
        self.0.retain(|late| late.until > now);
        let Some((used, answer)) = frame(bytes).filter(|_| !self.0.is_empty()) else {
            return Taken::Reply;
        };
        let Some(index) = self.0.iter().position(|late| late.could_be(&answer)) else {
            return Taken::Reply;
        };
        let mut alike = self.0.iter().filter(|late| late.could_be(&answer));
        let is_own = match &answer {
            // Any request may be refused like this while the drive waits for Identify.
            Answer::Nak(code) if Exception::N2(*code) == Exception::N2_RESTARTED => {
                alike.all(|late| late.address == address)
            }
            // An acknowledgement could be that of a write before another one.
            _ => !pdu.is_write() && alike.all(|late| late.is_of(address, pdu)),
        };
        match answer {
            _ if is_own => Taken::Reply,
            Answer::Nak(_) => Taken::Doubtful,
            answer if form(pdu).is_some_and(|form| has_form(form, &answer)) => Taken::Doubtful,
            answer => {
                self.one_came(index, &answer, now);
                Taken::Late(used)
            }
        }
    }

    /// The late reply `answer` came, probably that of the request with this index: each drive that may have sent it may take
    /// as long again.
    fn one_came(&mut self, index: usize, answer: &Answer, now: Instant) {
        self.may_take_as_long_again(answer, now);
        let Some(late) = self.0.get_mut(index) else { return };
        late.count = late.count.saturating_sub(1);
        if late.count == 0 {
            self.0.remove(index);
        }
    }

    fn may_take_as_long_again(&mut self, answer: &Answer, now: Instant) {
        let senders = self.0.iter().filter(|late| late.could_be(answer));
        let senders: Vec<u8> = senders.map(|late| late.address).collect();
        for late in self.0.iter_mut().filter(|late| senders.contains(&late.address)) {
            late.until = late.until.max(now + late.window);
        }
    }

    /// Notes a frame that is equal to the one before it: a duplicate of that, or another late reply.
    pub(super) fn came_again(&mut self, frame: &[u8], now: Instant) {
        if let Some((_, answer)) = self::frame(frame) {
            self.may_take_as_long_again(&answer, now);
        }
    }

    /// Notes that the frame, which arrived by `now`, was a late reply; that one is then no longer expected.
    pub fn has_arrived(&mut self, frame: &[u8], now: Instant) {
        let Some((_, answer)) = self::frame(frame) else { return };
        if let Some(index) = self.0.iter().position(|late| late.could_be(&answer)) {
            self.one_came(index, &answer, now);
        }
    }

    /// Notes a doubtful answer: if it was a late one, the reply itself may still arrive; otherwise the late one may.
    pub(crate) fn doubted(&mut self, asked: LateRequest<'_>, window: Duration, now: Instant) {
        let has_form = |late: &&Late| Some(late.form) == form(asked.pdu);
        // A refusal may be that of any request.
        let is_refusal = !self.0.iter().any(|late| has_form(&late));
        let from = self.0.iter().filter(|late| is_refusal || has_form(late));
        let from: Vec<u8> = from.map(|late| late.address).collect();
        self.take_as_long_again(&from, now + window);
        self.given_up(asked, window, now);
    }
}

/// Whether the reply to one of these requests could be mistaken for the reply to the other.
pub fn n2_look_alike(a: &RequestPdu, b: &RequestPdu) -> bool {
    let forms = form(a).zip(form(b));
    forms.is_none_or(|(a, b)| a.is_like(b) || b.is_like(a))
}

/// The first complete, valid frame, and the bytes up to its end.
fn frame(bytes: &[u8]) -> Option<(usize, Answer)> {
    let begin = bytes.iter().position(u8::is_ascii_graphic)?;
    let frame = bytes.get(begin..)?;
    let length = frame.iter().position(|byte| *byte == b'\r')?;
    let answer = Answer::decode(frame.get(..length)?).ok()?;
    Some((begin + length + 1, answer))
}

fn has_form(form: Form, answer: &Answer) -> bool {
    let digits = match answer {
        Answer::Nak(_) => return false,
        Answer::Ack => 0,
        Answer::Data(digits) => digits.len(),
    };
    match form {
        Form::Acknowledgement => digits == 0,
        Form::State | Form::Identity => digits == 2,
        Form::Integer => matches!(digits, 4 | 6),
        Form::Float => matches!(digits, 8 | 10),
        // Change records have five digits or thirteen.
        Form::Changes => digits == 0 || digits >= 5,
        Form::Any => true,
    }
}

impl Late {
    fn is_of(&self, address: u8, pdu: &RequestPdu) -> bool {
        self.address == address && self.pdu == *pdu
    }

    /// Whether the late reply may still arrive and be mistaken for a reply of this form.
    fn could_pass_for(&self, wanted: Form, now: Instant) -> bool {
        self.until > now && self.form.is_like(wanted)
    }

    fn could_be(&self, answer: &Answer) -> bool {
        match (self.form, answer) {
            // Any request may have been refused.
            (_, Answer::Nak(_)) => true,
            (Form::Identity, Answer::Data(digits)) => {
                digits.eq_ignore_ascii_case(format!("{:02X}", self.device).as_bytes())
            }
            (form, answer) => has_form(form, answer),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_proto::Table;
    use drivegate_proto::n2::Session;

    const WINDOW: Duration = Duration::from_millis(750);

    fn read(table: Table, start: u16, count: u16) -> RequestPdu {
        RequestPdu::read(table, start, count)
    }

    fn asked(address: u8, pdu: &RequestPdu, at: Instant) -> LateRequest<'_> {
        LateRequest {
            address,
            pdu,
            device: 0x10,
            at,
        }
    }

    #[test]
    fn what_could_be_mistaken_waits_and_another_form_settles_it() {
        let now = Instant::now();
        let float = read(Table::Input, 0, 2);
        let state = read(Table::DiscreteInput, 0, 1);
        let mut late = N2LateReplies::default();
        assert_eq!(late.take(1, &float, b"A4248000092\r", now), Taken::Reply);
        late.given_up(asked(2, &float, now), WINDOW, now);
        assert_eq!(late.blocks(&read(Table::Input, 8, 2), now), Some(now + WINDOW));
        assert_eq!(late.blocks(&state, now), None);
        assert_eq!(
            late.take(1, &state, b"A0060\r", now),
            Taken::Reply,
            "a byte is no float"
        );
        assert_eq!(late.take(1, &state, b"A424800", now), Taken::Reply, "not whole");
        assert_eq!(
            late.take(1, &state, b"A4248000093\r", now),
            Taken::Reply,
            "a wrong checksum"
        );
        assert_eq!(
            late.take(1, &state, b"N01\r", now),
            Taken::Doubtful,
            "whose refusal is it?"
        );
        assert_eq!(late.take(1, &float, b"A4248000092\r", now), Taken::Doubtful);
        assert_eq!(late.take(1, &state, b"A4248000092\r", now), Taken::Late(12));
        assert_eq!(late.blocks(&float, now), None, "it came");
        late.given_up(asked(2, &float, now), WINDOW, now);
        assert!(late.may_come(now) && !late.may_come(now + WINDOW));
        assert_eq!(
            late.take(1, &float, b"A4248000092\r", now + WINDOW),
            Taken::Reply,
            "forgotten"
        );
    }

    #[test]
    fn the_late_identity_of_a_dead_drive_costs_the_others_nothing() {
        let now = Instant::now();
        let state = read(Table::DiscreteInput, 0, 1);
        let mut late = N2LateReplies::default();
        late.given_up(asked(2, &RequestPdu::N2(Session::Identify), now), WINDOW, now);
        for pdu in [read(Table::Input, 0, 2), state.clone(), read(Table::Input, 0x4000, 1)] {
            assert_eq!(late.blocks(&pdu, now), None);
        }
        assert_eq!(late.take(1, &state, b"A4064\r", now), Taken::Reply);
        assert_eq!(late.take(1, &state, b"A1061\r", now), Taken::Doubtful);
        assert_eq!(late.take(1, &read(Table::Input, 0, 2), b"A1061\r", now), Taken::Late(6));
    }

    #[test]
    fn a_drive_answers_in_order() {
        let (now, soon) = (Instant::now(), Instant::now() + Duration::from_millis(50));
        let (float, other) = (read(Table::Input, 0, 2), read(Table::Input, 2, 2));
        let state = read(Table::DiscreteInput, 0, 1);
        let mut late = N2LateReplies::default();
        late.given_up(asked(1, &float, now), WINDOW, now);
        late.answered(2, &state, WINDOW, now);
        assert!(
            late.blocks(&float, now).is_some(),
            "another drive says nothing of this one"
        );
        late.answered(1, &other, WINDOW, now);
        assert!(late.blocks(&float, now).is_some(), "it may have been the late one");
        late.answered(1, &state, WINDOW, soon);
        assert_eq!(late.blocks(&float, soon), None);
        assert_eq!(late.owed(soon), 0);
    }

    #[test]
    fn a_request_that_was_sent_twice_in_vain_may_be_answered_twice() {
        let now = Instant::now();
        let (float, state) = (read(Table::Input, 0, 2), read(Table::DiscreteInput, 0, 1));
        let mut late = N2LateReplies::default();
        late.given_up(asked(2, &float, now), WINDOW, now);
        late.given_up(asked(2, &float, now), WINDOW, now);
        for _ in 0..2 {
            assert!(late.blocks(&float, now).is_some());
            assert_eq!(late.take(1, &state, b"A4248000092\r", now), Taken::Late(12));
        }
        assert_eq!(late.blocks(&float, now), None);
    }

    #[test]
    fn the_second_late_reply_may_come_as_long_after_the_first() {
        let now = Instant::now();
        let (float, state) = (read(Table::Input, 0, 2), read(Table::DiscreteInput, 0, 1));
        let mut late = N2LateReplies::default();
        late.given_up(asked(1, &float, now), WINDOW, now);
        late.given_up(asked(1, &float, now), WINDOW, now);
        let first = now + WINDOW * 9 / 10;
        assert_eq!(late.take(2, &state, b"A4248000092\r", first), Taken::Late(12));
        let second = first + WINDOW * 9 / 10;
        assert_eq!(late.asked_by(1, &float, second), Some(now), "it may be a value of then");
        assert!(late.may_come(second) && !late.may_come(first + WINDOW));
    }

    #[test]
    fn a_drive_takes_as_long_again_for_its_next_request() {
        let now = Instant::now();
        let (float, state) = (read(Table::Input, 8, 2), read(Table::Coil, 1, 1));
        let release = RequestPdu::N2(Session::Release {
            table: Table::Holding,
            address: 0,
        });
        let mut late = N2LateReplies::default();
        late.given_up(asked(1, &release, now), WINDOW, now);
        late.given_up(asked(1, &float, now), WINDOW, now);
        late.given_up(asked(2, &state, now), WINDOW, now);
        let came = now + WINDOW * 9 / 10;
        assert_eq!(late.take(3, &state, b"A\r", came), Taken::Late(2));
        assert_eq!(late.blocks(&float, came), Some(came + WINDOW));
        assert_eq!(
            late.blocks(&state, came),
            Some(now + WINDOW),
            "another drive is not slower"
        );
    }

    #[test]
    fn every_drive_that_may_have_sent_a_late_reply_takes_as_long_again() {
        let now = Instant::now();
        let came = now + WINDOW * 9 / 10;
        let on = RequestPdu::WriteCoil { address: 0, on: true };
        let state = read(Table::Coil, 1, 1);
        let mut late = N2LateReplies::default();
        late.given_up(asked(1, &on, now), WINDOW, now);
        late.given_up(asked(2, &on, now), WINDOW, now);
        late.given_up(asked(2, &state, now), WINDOW, now);
        assert_eq!(late.take(3, &state, b"A\r", came), Taken::Late(2));
        assert_eq!(late.blocks(&state, came), Some(came + WINDOW), "of drive 1 or 2");
    }

    #[test]
    fn replies_behind_one_that_may_have_been_late_take_as_long_again() {
        let now = Instant::now();
        let came = now + WINDOW * 9 / 10;
        let (state, on) = (
            read(Table::DiscreteInput, 1, 1),
            RequestPdu::WriteCoil { address: 0, on: true },
        );
        let owed = || {
            let mut late = N2LateReplies::default();
            late.given_up(asked(1, &on, now), WINDOW, now);
            late.given_up(asked(1, &state, now), WINDOW, now);
            late.given_up(asked(2, &read(Table::Input, 0, 2), now), WINDOW, now);
            late
        };
        // The acknowledgement may be that of the write before, or a refusal that of any request.
        let (mut acknowledged, mut refused, mut answered) = (owed(), owed(), owed());
        acknowledged.doubted(asked(1, &on, came), WINDOW, came);
        refused.doubted(asked(3, &read(Table::Input, 0x4000, 1), came), WINDOW, came);
        answered.answered(1, &state, WINDOW, came);
        for (mut late, others) in [(acknowledged, now), (refused, came), (answered, now)] {
            assert_eq!(late.of(1, &state).unwrap().until, came + WINDOW);
            let float = read(Table::Input, 0, 2);
            assert_eq!(late.of(2, &float).unwrap().until, others + WINDOW, "another drive");
        }
    }

    #[test]
    fn the_answer_to_the_first_of_two_equal_requests_settles_nothing_sent_between_them() {
        let at = |ms| Instant::now() + Duration::from_millis(ms);
        let (first, between, answered) = (at(0), at(300), at(700));
        let (float, state) = (read(Table::Input, 0, 2), read(Table::DiscreteInput, 0, 1));
        let mut late = N2LateReplies::default();
        late.given_up(asked(1, &float, first), WINDOW, between);
        late.given_up(asked(1, &state, between), WINDOW, answered);
        assert_eq!(late.take(1, &float, b"A4248000092\r", answered), Taken::Reply);
        late.answered(1, &float, WINDOW, answered);
        assert!(late.blocks(&state, answered).is_some(), "its reply is still to come");
    }

    #[test]
    fn process_data_is_asked_for_again_until_it_is_answered() {
        let now = Instant::now();
        let soon = now + Duration::from_millis(50);
        let fast = |start| PlannedRead {
            class: PollClass::Fast,
            table: Table::Input,
            start,
            count: 2,
            wide: 0,
        };
        let (read, reply) = (fast(0), b"A4248000092\r".as_slice());
        let pdu = read.pdu();
        let mut late = N2LateReplies::default();
        late.given_up(asked(1, &pdu, now), WINDOW, now);
        assert_eq!(late.blocks_poll(1, &read, now), None);
        assert!(
            late.blocks_poll(2, &read, now).is_some(),
            "the same object of another drive"
        );
        assert!(late.blocks_poll(1, &fast(2), now).is_some(), "another object");
        let slow = PlannedRead {
            class: PollClass::Slow,
            ..read
        };
        assert!(
            late.blocks_poll(1, &slow, now).is_some(),
            "it would keep the others waiting"
        );
        assert_eq!(late.take(1, &pdu, reply, soon), Taken::Reply);
        assert_eq!(late.take(2, &pdu, reply, soon), Taken::Doubtful);
        assert_eq!(
            late.asked_by(1, &pdu, soon),
            Some(now),
            "perhaps the reply to the first request"
        );
        late.answered(1, &pdu, WINDOW, soon);
        assert_eq!(
            late.blocks_poll(1, &read, soon),
            Some(soon + WINDOW),
            "once more, and the wait would never end"
        );
        late.answered(1, &pdu, WINDOW, soon + WINDOW / 2);
        assert_eq!(
            late.blocks_poll(1, &read, soon),
            Some(soon + WINDOW),
            "nor is it renewed"
        );
        assert_eq!(late.asked_by(1, &pdu, soon + WINDOW), None);
    }

    #[test]
    fn a_refusal_is_believed_where_nobody_else_can_have_sent_it() {
        let now = Instant::now();
        let (float, state) = (read(Table::Input, 0, 2), read(Table::DiscreteInput, 0, 1));
        let mut late = N2LateReplies::default();
        late.given_up(asked(1, &float, now), WINDOW, now);
        assert_eq!(
            late.take(1, &state, b"N00\r", now),
            Taken::Reply,
            "whatever it refuses, it waits for Identify"
        );
        assert_eq!(late.take(1, &state, b"N11\r", now), Taken::Doubtful, "of which object?");
        assert_eq!(late.take(1, &float, b"N11\r", now), Taken::Reply);
        late.given_up(asked(2, &float, now), WINDOW, now);
        assert_eq!(late.take(1, &state, b"N00\r", now), Taken::Doubtful, "of which drive?");
    }
}
