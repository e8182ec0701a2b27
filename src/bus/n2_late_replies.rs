//! Late replies on an N2 line. Pure: time is an argument.
//!
//! An N2 reply names neither drive nor request; it shows only its form. After an exchange without a believable answer,
//! the reply may come during a later exchange, of whichever drive. So the line remembers which forms may still come, and
//! for how long. Meanwhile no request goes out whose reply has such a form; others go on. A frame of a form that cannot be
//! the reply of the present exchange is the late one, which is not expected any more from then on. What a reply shares
//! with a late one by chance, such as a refusal, is not believed.

use std::time::{Duration, Instant};

use crate::codec::RequestPdu;
use crate::codec::n2::command::Answer;
use crate::codec::n2::{Form, form};

/// Late replies remembered; beyond that the oldest is forgotten.
const KEPT: usize = 16;

/// The replies that may still come on one line.
#[derive(Debug, Clone, Default)]
pub struct N2LateReplies(Vec<Late>);

#[derive(Debug, Clone, Copy)]
struct Late {
    form: Form,
    /// The device type that an identity would show.
    device: u8,
    until: Instant,
}

/// What a sound frame is in an exchange.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Taken {
    /// As far as late replies are concerned it may be the reply.
    Reply,
    /// It is a late reply: so many bytes are to be dropped.
    Late(usize),
    /// It may be the reply or a late one. As many are to come as before, perhaps the reply itself.
    Doubtful,
}

impl N2LateReplies {
    /// No believable answer to `pdu` came until `now`, and none will later than in the time of `window`. `device` is the
    /// type by which the drive identifies itself.
    pub fn given_up(&mut self, pdu: &RequestPdu, device: u8, window: Duration, now: Instant) {
        self.0.retain(|late| late.until > now);
        if self.0.len() >= KEPT {
            self.0.remove(0);
        }
        if let Some(form) = form(pdu) {
            let until = now + window;
            self.0.push(Late { form, device, until });
        }
    }

    /// How many replies may still come.
    pub(super) fn owed(&self, now: Instant) -> usize {
        self.0.iter().filter(|late| late.until > now).count()
    }

    /// Whether any reply may still come.
    pub fn may_come(&self, now: Instant) -> bool {
        self.0.iter().any(|late| late.until > now)
    }

    /// Until when any reply may still come.
    pub fn until(&self) -> Option<Instant> {
        self.0.iter().map(|late| late.until).max()
    }

    /// Until when a request must wait because a late reply could pass for its own.
    pub fn blocks(&self, pdu: &RequestPdu, now: Instant) -> Option<Instant> {
        let wanted = form(pdu)?;
        let alike = |late: &&Late| late.until > now && late.form.is_like(wanted);
        self.0.iter().filter(alike).map(|late| late.until).max()
    }

    /// What the whole frame at the beginning of `bytes` is, received at `now` in the exchange of `pdu`.
    pub fn take(&mut self, pdu: &RequestPdu, bytes: &[u8], now: Instant) -> Taken {
        self.0.retain(|late| late.until > now);
        let Some((used, answer)) = frame(bytes).filter(|_| !self.0.is_empty()) else {
            return Taken::Reply;
        };
        let Some(index) = self.0.iter().position(|late| late.could_be(&answer)) else {
            return Taken::Reply;
        };
        if form(pdu).is_some_and(|form| has_form(form, &answer)) || matches!(answer, Answer::Nak(_)) {
            return Taken::Doubtful;
        }
        self.0.remove(index);
        Taken::Late(used)
    }

    /// The frame was a late reply: it is not expected any more.
    pub fn came(&mut self, frame: &[u8]) {
        let answer = self::frame(frame).map(|(_, answer)| answer);
        let index = answer.and_then(|answer| self.0.iter().position(|late| late.could_be(&answer)));
        if let Some(index) = index {
            self.0.remove(index);
        }
    }

    /// The answer to `pdu` was doubtful: if it was a late one, the reply itself may still come. So may the late one, if it
    /// was not.
    pub fn doubted(&mut self, pdu: &RequestPdu, device: u8, window: Duration, now: Instant) {
        match self.0.iter_mut().find(|late| Some(late.form) == form(pdu)) {
            Some(late) => late.until = late.until.max(now + window),
            None => self.given_up(pdu, device, window, now),
        }
    }
}

/// Whether the reply to one of these requests could pass for the reply to the other.
pub fn n2_look_alike(a: &RequestPdu, b: &RequestPdu) -> bool {
    let forms = form(a).zip(form(b));
    forms.is_none_or(|(a, b)| a.is_like(b) || b.is_like(a))
}

/// The first whole and sound frame, and the bytes up to its end.
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
        // Records have five digits or thirteen.
        Form::Changes => digits == 0 || digits >= 5,
        Form::Any => true,
    }
}

impl Late {
    fn could_be(&self, answer: &Answer) -> bool {
        match (self.form, answer) {
            // Whatever was asked may have been refused.
            (_, Answer::Nak(_)) => true,
            (Form::Identity, Answer::Data(digits)) => {
                digits.eq_ignore_ascii_case(format!("{:02X}", self.device).as_bytes())
            }
            (form, answer) => has_form(form, answer),
        }
    }
}

impl Form {
    /// Whether a late reply of this form could pass for one of that. A late identity is distinguished from a state by its value.
    fn is_like(self, wanted: Form) -> bool {
        use Form::{Acknowledgement, Any, Changes, Float, Identity, Integer, State};
        matches!(
            (self, wanted),
            (Acknowledgement | Changes, Acknowledgement | Changes)
                | (Changes, Float | Integer)
                | (Float | Integer, Changes)
                | (State, State | Identity)
                | (Identity, Identity)
                | (Integer, Integer)
                | (Float, Float)
                | (Any, _)
                | (_, Any)
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec::Table;
    use crate::codec::n2::Session;

    const WINDOW: Duration = Duration::from_millis(750);

    fn read(table: Table, start: u16, count: u16) -> RequestPdu {
        RequestPdu::Read { table, start, count }
    }

    #[test]
    fn what_could_be_mistaken_waits_and_another_form_settles_it() {
        let now = Instant::now();
        let float = read(Table::Input, 0, 2);
        let state = read(Table::DiscreteInput, 0, 1);
        let mut late = N2LateReplies::default();
        assert_eq!(late.take(&float, b"A4248000092\r", now), Taken::Reply);
        late.given_up(&float, 0x10, WINDOW, now);
        assert_eq!(late.blocks(&read(Table::Input, 8, 2), now), Some(now + WINDOW));
        assert_eq!(late.blocks(&state, now), None);
        assert_eq!(late.take(&state, b"A0060\r", now), Taken::Reply, "a byte is no float");
        assert_eq!(late.take(&state, b"A424800", now), Taken::Reply, "not whole");
        assert_eq!(
            late.take(&state, b"A4248000093\r", now),
            Taken::Reply,
            "a wrong checksum"
        );
        assert_eq!(
            late.take(&state, b"N01\r", now),
            Taken::Doubtful,
            "whose refusal is it?"
        );
        assert_eq!(late.take(&float, b"A4248000092\r", now), Taken::Doubtful);
        assert_eq!(late.take(&state, b"A4248000092\r", now), Taken::Late(12));
        assert_eq!(late.blocks(&float, now), None, "it came");
        late.given_up(&float, 0x10, WINDOW, now);
        assert!(late.may_come(now) && !late.may_come(now + WINDOW));
        assert_eq!(
            late.take(&float, b"A4248000092\r", now + WINDOW),
            Taken::Reply,
            "forgotten"
        );
    }

    #[test]
    fn the_late_identity_of_a_dead_drive_costs_the_others_nothing() {
        let now = Instant::now();
        let state = read(Table::DiscreteInput, 0, 1);
        let mut late = N2LateReplies::default();
        late.given_up(&RequestPdu::N2(Session::Identify), 0x10, WINDOW, now);
        for pdu in [read(Table::Input, 0, 2), state.clone(), read(Table::Input, 0x4000, 1)] {
            assert_eq!(late.blocks(&pdu, now), None);
        }
        assert_eq!(late.take(&state, b"A4064\r", now), Taken::Reply);
        assert_eq!(late.take(&state, b"A1061\r", now), Taken::Doubtful);
        assert_eq!(late.take(&read(Table::Input, 0, 2), b"A1061\r", now), Taken::Late(6));
    }
}
