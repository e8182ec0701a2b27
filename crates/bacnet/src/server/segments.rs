//! Segmented answers (clause 5.4).

use std::time::{Duration, Instant};

use crate::apdu::{self, SEGMENT_HEADER};
use crate::types::Address;

/// Maximum number of segments sent without an acknowledgement.
const WINDOW: u8 = 4;
const WAIT: Duration = Duration::from_secs(3);
const TRIES: u8 = 3;
/// Limits of the number of answers in progress: for all hosts, and for one host.
const MOST_ANSWERS: usize = 32;
const MOST_OF_ONE: usize = 8;

/// A segmented answer that is being sent.
#[derive(Debug)]
struct Sending {
    to: Address,
    device: u32,
    invoke: u8,
    service: u8,
    content: Vec<u8>,
    /// Octets of content in each segment.
    size: usize,
    /// The first segment that is not acknowledged yet.
    first: usize,
    /// Number of segments sent so far.
    sent: usize,
    window: u8,
    tries: u8,
    until: Instant,
}

/// Segmented answers in progress.
#[derive(Debug, Default)]
pub(super) struct Segments {
    sending: Vec<Sending>,
}

/// A message for a client, from a device.
pub(super) type Message = (Address, u32, Vec<u8>);

impl Sending {
    fn total(&self) -> usize {
        self.content.len().div_ceil(self.size.max(1)).max(1)
    }

    /// The segments of the window from the first one that is not acknowledged.
    fn fill(&mut self, out: &mut Vec<Message>) {
        let end = (self.first + usize::from(self.window.max(1))).min(self.total());
        for place in self.first..end {
            let from = place * self.size;
            let to = (from + self.size).min(self.content.len());
            let content = self.content.get(from..to).unwrap_or_default();
            let head = ((place & 0xFF) as u8, WINDOW);
            let more = place + 1 < self.total();
            out.push((
                self.to,
                self.device,
                apdu::segment(self.invoke, self.service, head, more, content),
            ));
        }
        self.sent = end;
    }
}

impl Segments {
    /// Begins an answer in segments of this size. Returns false if too many answers are in progress.
    pub(super) fn begin(
        &mut self,
        (to, device): (Address, u32),
        (invoke, service): (u8, u8),
        content: Vec<u8>,
        size: usize,
        now: Instant,
        out: &mut Vec<Message>,
    ) -> bool {
        self.end(to, device, invoke);
        let own = self.sending.iter().filter(|sending| sending.to.ip() == to.ip()).count();
        if self.sending.len() >= MOST_ANSWERS || own >= MOST_OF_ONE {
            return false;
        }
        let mut sending = Sending {
            to,
            device,
            invoke,
            service,
            content,
            size: size.saturating_sub(SEGMENT_HEADER).max(1),
            first: 0,
            sent: 0,
            // The first segment is sent alone: its acknowledgement states how many may follow at once.
            window: 1,
            tries: 1,
            until: now + WAIT,
        };
        sending.fill(out);
        self.sending.push(sending);
        true
    }

    /// Notes segments that the client has acknowledged.
    pub(super) fn acknowledged(
        &mut self,
        (from, device): (Address, u32),
        (invoke, sequence, window): (u8, u8, u8),
        now: Instant,
        out: &mut Vec<Message>,
    ) {
        let is = |s: &Sending| s.to == from && s.device == device && s.invoke == invoke;
        let Some(place) = self.sending.iter().position(is) else {
            return;
        };
        let Some(sending) = self.sending.get_mut(place) else {
            return;
        };
        // An acknowledgement of the segment before `first` means that no segment of the window arrived.
        let base = sending.first;
        let ahead = usize::from(sequence.wrapping_sub((base & 0xFF) as u8).wrapping_add(1));
        if ahead > sending.sent - base {
            return;
        }
        sending.first = base + ahead;
        sending.window = window.clamp(1, WINDOW);
        if ahead > 0 {
            sending.tries = 1;
        } else {
            sending.tries += 1;
        }
        sending.until = now + WAIT;
        if sending.first >= sending.total() || sending.tries > TRIES {
            self.sending.remove(place);
        } else {
            sending.fill(out);
        }
    }

    /// Ends a segmented answer, because the client ended it or starts a new request.
    pub(super) fn end(&mut self, from: Address, device: u32, invoke: u8) {
        self.sending
            .retain(|s| (s.to, s.device, s.invoke) != (from, device, invoke));
    }

    /// Sends again the segments that were not acknowledged in time.
    pub(super) fn poll(&mut self, now: Instant, out: &mut Vec<Message>) {
        self.sending.retain_mut(|sending| {
            if now < sending.until {
                return true;
            }
            sending.tries += 1;
            sending.until = now + WAIT;
            if sending.tries <= TRIES {
                sending.fill(out);
            }
            sending.tries <= TRIES
        });
    }

    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.sending.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn client(last: u8) -> Address {
        Address::local(format!("10.0.0.{last}:47808").parse().unwrap())
    }

    /// Sequence numbers of the segments, and whether more follow the last.
    fn numbers(out: &mut Vec<Message>) -> (Vec<u8>, bool) {
        let more = out.last().is_some_and(|(_, _, bytes)| bytes[0] & 4 != 0);
        (out.drain(..).map(|(_, _, bytes)| bytes[2]).collect(), more)
    }

    #[test]
    fn window_by_window_until_all_arrived() {
        let now = Instant::now();
        let (mut segments, mut out) = (Segments::default(), Vec::new());
        let content: Vec<u8> = (0..=255).cycle().take(45 * 300).map(|n: u8| n).collect();
        assert!(segments.begin((client(1), 5), (7, 14), content.clone(), 50, now, &mut out));
        let mut got = Vec::new();
        let mut next = 0_usize;
        while segments.len() == 1 {
            assert!(!out.is_empty() && out.len() <= 4);
            for (_, _, bytes) in out.drain(..) {
                assert_eq!((bytes[0] & 0xF8, bytes[2], bytes.len()), (0x38, next as u8, 50));
                assert_eq!(bytes[0] & 4 != 0, next + 1 < 300);
                got.extend_from_slice(&bytes[5..]);
                next += 1;
            }
            segments.acknowledged((client(1), 5), (7, (next - 1) as u8, 16), now, &mut out);
        }
        assert_eq!((next, got), (300, content));
    }

    #[test]
    fn lost_segments_are_sent_again_and_a_lost_client_is_given_up() {
        let now = Instant::now();
        let (mut segments, mut out) = (Segments::default(), Vec::new());
        segments.begin((client(1), 5), (7, 14), vec![0; 450], 50, now, &mut out);
        segments.acknowledged((client(1), 5), (7, 0, 4), now, &mut out);
        assert_eq!(numbers(&mut out), (vec![0, 1, 2, 3, 4], true));
        segments.acknowledged((client(1), 5), (7, 2, 4), now, &mut out);
        assert_eq!(
            numbers(&mut out),
            (vec![3, 4, 5, 6], true),
            "behind the last that arrived"
        );
        segments.acknowledged((client(1), 5), (7, 200, 4), now, &mut out);
        segments.acknowledged((client(2), 5), (7, 3, 4), now, &mut out);
        assert!(out.is_empty());
        for tries in 1..=3 {
            segments.poll(now + WAIT * tries, &mut out);
        }
        assert_eq!(out.len(), 8, "twice more");
        assert_eq!(segments.len(), 0);
    }

    #[test]
    fn half_segments_are_bounded() {
        let now = Instant::now();
        let (mut segments, mut out) = (Segments::default(), Vec::new());
        let mut begin =
            |host: u8, invoke: u8| segments.begin((client(host), 5), (invoke, 14), vec![0; 450], 50, now, &mut out);
        assert_eq!((0..100).filter(|n| begin(1, *n)).count(), MOST_OF_ONE);
        assert!(begin(1, 0), "the same question again");
        assert_eq!((0..200).filter(|n| begin(*n, 200)).count(), MOST_ANSWERS - MOST_OF_ONE);
    }
}
