//! The reader of one connection, which dates the bytes that it reads.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use super::Watch;
use drivegate_core::order::{Arrival, Connection};
use drivegate_core::stalls::Dated;

/// The reader of a connection.
#[derive(Debug)]
pub struct Reader {
    watch: Arc<Watch>,
    connection: Connection,
    state: Mutex<State>,
}

/// How the bytes of a read end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameEnd {
    /// With the end of a message.
    Whole,
    /// Within a message that they begin.
    Begun,
    /// Within a message that earlier bytes began.
    Continued,
}

#[derive(Debug)]
struct State {
    /// Time before which no unread byte arrived.
    floor: Instant,
    /// Whether the reader found nothing, and waits.
    waited: bool,
    /// Arrival time of the last read bytes.
    last: Dated,
    /// Date of the first read since nothing was left, or of the message that was incomplete then.
    first: Dated,
    /// Date of the first bytes of a message that is incomplete.
    begun: Option<Dated>,
    /// Whether nothing was left after the last read.
    fresh: bool,
}

impl Reader {
    /// The reader of a connection that was opened at `opened`, on the runtime observed by this watch.
    pub(crate) fn new(watch: Arc<Watch>, opened: Instant) -> Reader {
        let dated = Dated {
            earliest: opened,
            stall: None,
            pause: None,
        };
        Reader {
            watch,
            connection: Connection::opened(opened),
            state: Mutex::new(State {
                floor: opened,
                waited: false,
                last: dated,
                first: dated,
                begun: None,
                fresh: true,
            }),
        }
    }

    /// A reader on the runtime of this thread, for a connection opened now.
    pub fn here() -> Reader {
        Reader::new(Watch::of_this_thread(), Instant::now())
    }

    /// The reader of a connection that this one accepted last.
    pub fn accepted(&self) -> Reader {
        Reader::new(self.watch.clone(), self.state().last.earliest)
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes that the reader found nothing to read at `now` and waits. The runtime may not have checked the socket
    /// since a stall; `is_there` then returns whether there are bytes.
    pub fn nothing(&self, now: Instant, is_there: impl FnOnce() -> bool) {
        let matters = self.watch.turn(now, None);
        let left = matters && self.watch.just_stalled(now) && is_there();
        let mut state = self.state();
        (state.waited, state.fresh) = (true, true);
        if !left {
            state.floor = state.floor.max(now);
        }
    }

    /// Notes that the reader does not read for some time, whatever arrives.
    pub fn ceased(&self) {
        self.state().waited = false;
    }

    /// The reader read bytes at `now`; `all`: and nothing is left. `has_gone` returns whether the client has closed or
    /// reset the connection since.
    pub fn note_read(&self, now: Instant, all: bool, has_gone: impl FnOnce() -> bool) {
        let mut state = self.state();
        let boot = state.waited.then(|| self.watch.since_boot());
        let dated = if self.watch.turn(now, boot) {
            self.watch.date(state.floor, state.waited, now)
        } else {
            Dated {
                earliest: if state.waited { now } else { state.floor.min(now) },
                stall: None,
                pause: None,
            }
        };
        if dated.stall.is_some() && has_gone() {
            self.connection.hang_up();
        }
        state.floor = if all { now } else { state.floor.max(dated.earliest) };
        state.waited = false;
        state.last = dated;
        if std::mem::take(&mut state.fresh) {
            state.first = state.begun.map_or(dated, |begun| Dated {
                earliest: begun.earliest,
                stall: dated.stall.or(begun.stall),
                pause: dated.pause.or(begun.pause),
            });
        }
    }

    /// How the bytes that were read last end; a reader without frames does not know.
    pub(super) fn note_end(&self, end: FrameEnd) {
        let mut state = self.state();
        state.begun = match end {
            FrameEnd::Whole => None,
            FrameEnd::Begun => Some(state.last),
            FrameEnd::Continued => state.begun.or(Some(state.last)),
        };
    }

    /// The client has closed or reset the connection.
    pub(crate) fn ended(&self) {
        self.connection.hang_up();
    }

    /// How the bytes that were read last arrived.
    pub fn last(&self) -> Arrival {
        self.arrival(self.state().last)
    }

    /// The earliest arrival among all bytes that were read and not taken yet. Where the reader knows the frames, the first
    /// part of a message that was completed later is among them.
    pub fn first(&self) -> Arrival {
        self.arrival(self.state().first)
    }

    fn arrival(&self, dated: Dated) -> Arrival {
        Arrival {
            asked: dated.earliest,
            connection: self.connection.clone(),
            stall: dated.stall,
            pause: dated.pause,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    const MS: Duration = Duration::from_millis(1);

    struct Rig {
        reader: Reader,
        start: Instant,
    }

    impl Rig {
        fn new() -> Rig {
            let start = Instant::now();
            Rig {
                reader: Reader::new(Watch::new(true), start),
                start,
            }
        }

        fn nothing(&self, ms: u32) {
            self.reader.nothing(self.start + MS * ms, || false);
        }

        /// Reads bytes at this time; returns their date.
        fn note_read(&self, ms: u32, all: bool) -> u128 {
            self.reader.note_read(self.start + MS * ms, all, || false);
            self.ms(&self.reader.last())
        }

        fn ms(&self, arrival: &Arrival) -> u128 {
            arrival.asked.duration_since(self.start).as_millis()
        }
    }

    #[test]
    fn what_is_read_dates_from_when_it_came() {
        let rig = Rig::new();
        assert_eq!(
            rig.note_read(5, true),
            0,
            "it may have been there since the connection was opened"
        );
        assert_eq!(rig.note_read(7, true), 5, "and this since the read before");
        rig.nothing(10);
        assert_eq!(
            rig.note_read(1000, false),
            1000,
            "what is waited for comes when it is read"
        );
        assert_eq!(rig.note_read(1001, true), 1000, "the rest of it");
        assert_eq!(rig.ms(&rig.reader.first()), 1000);
        assert_eq!(rig.note_read(1010, true), 1001);
        assert_eq!(rig.ms(&rig.reader.first()), 1000, "all since nothing was left");
        rig.nothing(1011);
        rig.reader.ceased();
        assert_eq!(rig.note_read(5000, true), 1011, "it did not read meanwhile");
        assert_eq!(rig.ms(&rig.reader.first()), 1011);
    }

    /// A stop over another connection may come between the two parts.
    #[test]
    fn a_message_in_several_parts_dates_from_its_first_byte() {
        let rig = Rig::new();
        let read = |ms, end| {
            rig.nothing(ms - 1);
            rig.note_read(ms, true);
            rig.reader.note_end(end);
            rig.ms(&rig.reader.first())
        };
        assert_eq!(read(100, FrameEnd::Begun), 100);
        assert_eq!(read(200, FrameEnd::Continued), 100);
        assert_eq!(
            read(300, FrameEnd::Begun),
            100,
            "the end of one and the begin of another"
        );
        assert_eq!(read(400, FrameEnd::Whole), 300);
        assert_eq!(read(500, FrameEnd::Whole), 500);
    }

    #[test]
    fn what_came_during_a_stall_is_as_old_as_that() {
        let watch = Watch::new(true);
        let reader = Reader::new(watch.clone(), Instant::now());
        let start = Instant::now() + MS;
        watch.begin_at(start);
        reader.nothing(start + MS, || false);
        let now = start + 2000 * MS;
        reader.nothing(now, || true);
        reader.note_read(now + MS, false, || true);
        let first = reader.last();
        assert_eq!(first.asked, start + MS);
        assert!(first.stall.is_some() && first.pause.is_some());
        assert!(first.connection.is_gone(), "its client gave up");
        reader.note_read(now + 2 * MS, true, || false);
        assert_eq!(reader.last().asked, start + MS, "the rest of it");
        reader.note_read(now + 3 * MS, true, || false);
        let since = reader.last();
        assert_eq!((since.asked, since.stall), (now + 2 * MS, None), "nothing was left");
        assert!(since.pause.is_some(), "its connection is older than the pause");
    }
}
