//! The frames of a line, for the recorder and the trace: requests, replies, times and meaning.
//!
//! Records frames with their times on the wire, which are calculated from the bytes: a driver may deliver a reply
//! byte by byte, or as a whole when its last byte has arrived.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use super::transaction::{CONNECTION_CLOSED, Ended};
use drivegate_core::process_image::{BusImage, Direction, FrameRecord, TapedFrame, Verdict};
use drivegate_model::drive::DriveIndex;
use drivegate_proto::describe::{self, Kind, Part};
use drivegate_proto::{LineFormat, Reply, Request};

/// Bytes kept of one transaction; of a longer one the start is shown.
const KEPT: usize = 2048;

/// A traced transaction. A trace never begins in the middle of one.
#[derive(Debug)]
pub(super) struct Tap {
    image: Arc<BusImage>,
    drive: Option<String>,
    request: Request,
    frame: Vec<u8>,
    hearing: Hearing,
}

impl Tap {
    /// The record of a transaction whose request was given to the line at `began`.
    pub(super) fn new(
        image: Arc<BusImage>,
        index: Option<DriveIndex>,
        request: Request,
        frame: Vec<u8>,
        began: Instant,
    ) -> Tap {
        let format = image.spec.format;
        let drive = index.map(|index| image.drives.of(index).spec.name.clone());
        Tap {
            image,
            drive,
            request,
            hearing: Hearing::new(format, began + format.chars(frame.len())),
            frame,
        }
    }

    /// Publishes the request to trace subscribers.
    pub(super) fn sent(&self, quiet_since: Instant, began: Instant) {
        self.image.trace.publish(|| FrameRecord {
            time: time_of_day(began),
            gap: Some(began.saturating_duration_since(quiet_since)),
            direction: Direction::Request,
            drive: self.drive.clone(),
            bytes: self.frame.to_vec(),
            decode: describe::request_on(self.image.spec.protocol, &self.request.pdu),
            verdict: String::new(),
        });
    }

    /// Notes received bytes.
    pub(super) fn received(&mut self, bytes: &[u8], now: Instant) {
        self.hearing.add(bytes, now);
    }

    /// Publishes the received bytes, one record per frame.
    pub(super) fn ended(self, ended: &Ended, now: Instant) {
        let protocol = self.image.spec.protocol;
        let answered = matches!(ended, Ended::Reply(_));
        let parts = describe::parts(protocol, &self.request, &self.frame, &self.hearing.bytes, answered);
        // The outcome belongs to the part that is the reply; without such a part (nothing, or only foreign frames
        // arrived), it belongs to none.
        let its_kind = if answered { Kind::Reply } else { Kind::Garbage };
        let its_part = parts.iter().rposition(|part| part.kind == its_kind);
        let mut quiet_since = self.hearing.sent;
        for (place, part) in parts.into_iter().enumerate() {
            let (gap, end) = self.hearing.times(&part, quiet_since);
            quiet_since = end;
            let bytes = self.hearing.bytes.get(part.range).unwrap_or_default();
            let (decode, verdict) = match part.kind {
                _ if its_part == Some(place) => (describe::reply(protocol, &self.request, bytes), verdict(ended)),
                Kind::Echo => ("the request comes back".to_string(), "echo".to_string()),
                _ => (describe::stray(protocol, bytes), "foreign".to_string()),
            };
            self.reply(end, Some(gap), bytes, decode, verdict);
        }
        if its_part.is_none() && !answered {
            self.reply(now, None, &[], String::new(), verdict(ended));
        }
    }

    fn reply(&self, at: Instant, gap: Option<Duration>, bytes: &[u8], decode: String, verdict: String) {
        self.image.trace.publish(|| FrameRecord {
            time: time_of_day(at),
            gap,
            direction: Direction::Reply,
            drive: self.drive.clone(),
            bytes: bytes.to_vec(),
            decode,
            verdict,
        });
    }
}

/// Gives the recorder a request, or all bytes received until its transaction ended.
pub(super) fn tape(image: &BusImage, drive: Option<DriveIndex>, bytes: &[u8], verdict: Verdict, at: Instant) {
    image.tape.frame(|| TapedFrame {
        at,
        drive,
        verdict,
        bytes: bytes.get(..KEPT).unwrap_or(bytes).into(),
    });
}

/// The recorder's verdict for the end of a transaction.
pub(super) fn taped(ended: &Ended) -> Verdict {
    match ended {
        Ended::Reply(Reply::Exception(_)) => Verdict::Exception,
        Ended::Reply(_) => Verdict::Ok,
        Ended::Silent | Ended::Corrupt(CONNECTION_CLOSED) => Verdict::Timeout,
        Ended::Corrupt(_) => Verdict::Corrupt,
    }
}

/// Publishes bytes received between two transactions.
pub(super) fn noise(image: &BusImage, bytes: &[u8], quiet_since: Instant, now: Instant) {
    tape(image, None, bytes, Verdict::Foreign, now);
    image.trace.publish(|| {
        let mut hearing = Hearing::new(image.spec.format, quiet_since);
        hearing.add(bytes, now);
        let part = Part {
            kind: Kind::Foreign,
            range: 0..bytes.len(),
        };
        FrameRecord {
            time: time_of_day(now),
            gap: Some(hearing.times(&part, quiet_since).0),
            direction: Direction::Reply,
            drive: None,
            bytes: bytes.to_vec(),
            decode: describe::stray(image.spec.protocol, bytes),
            verdict: "foreign".to_string(),
        }
    });
}

fn verdict(ended: &Ended) -> String {
    match ended {
        Ended::Reply(Reply::Exception(code)) => code.to_string(),
        Ended::Reply(_) => "ok".to_string(),
        Ended::Silent => "timeout".to_string(),
        Ended::Corrupt(why) => format!("corrupt: {why}"),
    }
}

/// Bytes with the times of their arrival.
#[derive(Debug)]
struct Hearing {
    format: LineFormat,
    /// End of the request on the wire.
    sent: Instant,
    bytes: Vec<u8>,
    /// Number of bytes present at each arrival.
    arrivals: Vec<(usize, Instant)>,
}

impl Hearing {
    fn new(format: LineFormat, sent: Instant) -> Hearing {
        Hearing {
            format,
            sent,
            bytes: Vec::new(),
            arrivals: Vec::new(),
        }
    }

    fn add(&mut self, bytes: &[u8], now: Instant) {
        let room = KEPT.saturating_sub(self.bytes.len());
        self.bytes.extend(bytes.iter().take(room));
        if !bytes.is_empty() && room > 0 {
            self.arrivals.push((self.bytes.len(), now));
        }
    }

    /// Silence before a part, and when its last byte arrived.
    fn times(&self, part: &Part, quiet_since: Instant) -> (Duration, Instant) {
        let last = part.range.end.saturating_sub(1);
        let first = self.arrival(part.range.start).unwrap_or(quiet_since);
        let end = self.arrival(last).unwrap_or(first);
        // The first byte was on the wire for one character before it arrived, and the whole frame for its own duration.
        let by_first = first.checked_sub(self.format.chars(1)).unwrap_or(first);
        let by_last = end.checked_sub(self.format.chars(part.range.len())).unwrap_or(end);
        (by_first.min(by_last).saturating_duration_since(quiet_since), end)
    }

    fn arrival(&self, place: usize) -> Option<Instant> {
        self.arrivals
            .iter()
            .find(|(count, _)| place < *count)
            .map(|(_, at)| *at)
    }
}

/// The time of day of an instant in the near past.
fn time_of_day(at: Instant) -> SystemTime {
    SystemTime::now() - Instant::now().saturating_duration_since(at)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn silence_is_that_of_the_wire() {
        let format = LineFormat::new(9600, "8N1").unwrap();
        let ms = |ms: u64| Duration::from_millis(ms);
        let start = Instant::now();
        let part = |range| Part {
            kind: Kind::Reply,
            range,
        };
        // Byte by byte: ten characters of 1.04 ms from 5 ms on.
        let mut bytewise = Hearing::new(format, start);
        for count in 1..=10 {
            bytewise.add(&[0], start + ms(5) + format.chars(count));
        }
        assert_eq!(
            bytewise.times(&part(0..10), start),
            (ms(5), start + ms(5) + format.chars(10))
        );
        // A frame delivered in one piece gives equal times.
        let mut whole = Hearing::new(format, start);
        whole.add(&[0; 10], start + ms(5) + format.chars(10));
        assert_eq!(
            whole.times(&part(0..10), start),
            (ms(5), start + ms(5) + format.chars(10))
        );
        // Faster than the wire: a line without timing.
        let mut fast = Hearing::new(format, start);
        fast.add(&[0; 10], start);
        assert_eq!(fast.times(&part(0..10), start), (Duration::ZERO, start));
        // A second frame, 3 ms after the end of the first one.
        let end = start + ms(5) + format.chars(10);
        bytewise.add(&[0; 4], end + ms(3) + format.chars(4));
        assert_eq!(bytewise.times(&part(10..14), end).0, ms(3));
    }

    #[test]
    fn a_babble_is_cut() {
        let start = Instant::now();
        let mut hearing = Hearing::new(LineFormat::new(9600, "8N1").unwrap(), start);
        (0..100).for_each(|_| hearing.add(&[0; 512], start));
        assert_eq!((hearing.bytes.len(), hearing.arrivals.len()), (KEPT, 4));
    }
}
