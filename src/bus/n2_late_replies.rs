//! Late replies on an N2 line. Pure: time is an argument.
//!
//! An N2 reply names neither drive nor request; it shows only its form. After an exchange without a believable answer,
//! the reply may come during a later exchange, of whichever drive. So the line remembers which forms may still come.
//! The first frame that could be one of them is passed over as nobody's, and the exchange goes on until its deadline: if it
//! was the late one, the true reply follows; if not, the exchange fails and the request is sent again. No request has to wait.

use std::time::{Duration, Instant};

use crate::codec::RequestPdu;
use crate::codec::n2::command::Answer;
use crate::codec::n2::{Form, form};

/// A reply that has not come by then will not come.
const FORGOTTEN_AFTER: Duration = Duration::from_secs(1);
/// Late replies remembered; beyond that the oldest is forgotten.
const KEPT: usize = 16;

/// The replies that may still come on one line.
#[derive(Debug, Default)]
pub struct N2LateReplies(Vec<Late>);

#[derive(Debug, Clone, Copy)]
struct Late {
    form: Form,
    /// The device type that an identity would show.
    device: u8,
    until: Instant,
}

impl N2LateReplies {
    /// No believable answer to `pdu` came until `now`. `device` is the type by which the drive identifies itself.
    pub fn given_up(&mut self, pdu: &RequestPdu, device: u8, now: Instant) {
        self.0.retain(|late| late.until > now);
        if self.0.len() >= KEPT {
            self.0.remove(0);
        }
        if let Some(form) = form(pdu) {
            let until = now + FORGOTTEN_AFTER;
            self.0.push(Late { form, device, until });
        }
    }

    /// Whether any reply may still come.
    pub fn may_come(&self, now: Instant) -> bool {
        self.0.iter().any(|late| late.until > now)
    }

    /// Forgets all: the port was lost.
    pub fn clear(&mut self) {
        self.0.clear();
    }

    /// The length of the frame at the beginning of `bytes`, if it could be a late reply, which is then not expected any
    /// more.
    pub fn pass_over(&mut self, bytes: &[u8], now: Instant) -> Option<usize> {
        self.0.retain(|late| late.until > now);
        if self.0.is_empty() {
            return None;
        }
        let begin = bytes.iter().position(u8::is_ascii_graphic)?;
        let frame = bytes.get(begin..)?;
        let length = frame.iter().position(|byte| *byte == b'\r')?;
        let answer = Answer::decode(frame.get(..length)?).ok()?;
        let index = self.0.iter().position(|late| late.could_be(&answer))?;
        self.0.remove(index);
        Some(begin + length + 1)
    }
}

impl Late {
    fn could_be(&self, answer: &Answer) -> bool {
        let digits = match answer {
            // Whatever was asked may have been refused.
            Answer::Nak(_) => return true,
            Answer::Ack => &[][..],
            Answer::Data(digits) => digits.as_slice(),
        };
        match self.form {
            Form::Acknowledgement => digits.is_empty(),
            Form::State => digits.len() == 2,
            Form::Identity => digits.eq_ignore_ascii_case(format!("{:02X}", self.device).as_bytes()),
            Form::Integer => matches!(digits.len(), 4 | 6),
            Form::Float => matches!(digits.len(), 8 | 10),
            // Records have five digits or thirteen.
            Form::Changes => digits.is_empty() || digits.len() >= 5,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec::Table;
    use crate::codec::n2::Session;

    fn read(table: Table, start: u16, count: u16) -> RequestPdu {
        RequestPdu::Read { table, start, count }
    }

    #[test]
    fn the_first_frame_of_that_form_is_passed_over_once() {
        let now = Instant::now();
        let mut late = N2LateReplies::default();
        assert_eq!(late.pass_over(b"A4248000092\r", now), None);
        late.given_up(&read(Table::Input, 0, 2), 0x10, now);
        assert_eq!(late.pass_over(b"A0060\r", now), None, "a byte is no float");
        assert_eq!(late.pass_over(b"A424800", now), None, "not whole");
        assert_eq!(late.pass_over(b"A4248000093\r", now), None, "a wrong checksum");
        assert_eq!(late.pass_over(b"A4248000092\r", now), Some(12));
        assert_eq!(late.pass_over(b"A4248000092\r", now), None, "it came");
        late.given_up(&read(Table::Input, 0, 2), 0x10, now);
        assert_eq!(late.pass_over(b"N01\r", now), Some(4), "a refusal may be that of any request");
        late.given_up(&read(Table::Input, 0, 2), 0x10, now);
        assert!(late.may_come(now) && !late.may_come(now + FORGOTTEN_AFTER));
        assert_eq!(late.pass_over(b"A4248000092\r", now + FORGOTTEN_AFTER), None, "forgotten");
    }

    #[test]
    fn the_late_identity_of_a_dead_drive_costs_the_others_nothing() {
        let now = Instant::now();
        let mut late = N2LateReplies::default();
        late.given_up(&RequestPdu::N2(Session::Identify), 0x10, now);
        for reply in [&b"A0060\r"[..], b"A4064\r", b"A4248000092\r", b"A\r"] {
            assert_eq!(late.pass_over(reply, now), None);
        }
        assert_eq!(late.pass_over(b"A1061\r", now), Some(6));
    }
}
