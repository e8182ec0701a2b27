//! A ring of entries packed into bytes, bounded by bytes and by age. A line with 10 ms cycle has thousands of
//! entries, each smaller than the allocation that it would need by itself.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::marker::PhantomData;
use std::time::{Duration, Instant};

use crate::process_image::{TapedFrame, TapedRead, Verdict};
use drivegate_model::drive::DriveIndex;
use drivegate_proto::Table;

/// Bytes before each entry: length and time of the entry.
const HEAD: usize = 4 + 8;
/// Number of steps in which the memory grows to its limit.
pub(super) const STEPS: usize = 16;
/// Index that stands for no drive.
const NO_DRIVE: u32 = u32::MAX;

/// Something with a time that can be packed into bytes.
pub(super) trait Packed: Sized {
    /// Time of the entry.
    fn at(&self) -> Instant;
    /// Appends everything except the time.
    fn pack(&self, bytes: &mut Vec<u8>);
    /// Restores an entry from the bytes that [`Packed::pack`] appended.
    fn unpack(at: Instant, bytes: &[u8]) -> Option<Self>;
}

/// Bytes that a packed read of `words` words takes.
pub(super) const fn packed_read(words: usize) -> usize {
    HEAD + 3 + 2 * words
}

/// Bytes of memory that a frame of `bytes` bytes takes.
pub(super) const fn packed_frame(bytes: usize) -> usize {
    HEAD + 5 + bytes
}

impl Packed for TapedRead {
    fn at(&self) -> Instant {
        self.at
    }

    fn pack(&self, bytes: &mut Vec<u8>) {
        bytes.push(self.table.read_function());
        bytes.extend(self.start.to_le_bytes());
        bytes.extend(self.words.iter().flat_map(|word| word.to_le_bytes()));
    }

    fn unpack(at: Instant, bytes: &[u8]) -> Option<TapedRead> {
        let ([function, low, high], words) = bytes.split_first_chunk()?;
        let tables = [Table::Coil, Table::DiscreteInput, Table::Input, Table::Holding];
        let (words, _) = words.as_chunks();
        Some(TapedRead {
            at,
            table: tables.into_iter().find(|table| table.read_function() == *function)?,
            start: u16::from_le_bytes([*low, *high]),
            words: words.iter().map(|word| u16::from_le_bytes(*word)).collect(),
        })
    }
}

impl Packed for TapedFrame {
    fn at(&self) -> Instant {
        self.at
    }

    fn pack(&self, bytes: &mut Vec<u8>) {
        let drive = self.drive.and_then(|drive| u32::try_from(drive.place()).ok());
        let verdict = Verdict::ALL.iter().position(|verdict| *verdict == self.verdict);
        bytes.extend(drive.unwrap_or(NO_DRIVE).to_le_bytes());
        bytes.push(verdict.and_then(|place| u8::try_from(place).ok()).unwrap_or(u8::MAX));
        bytes.extend_from_slice(&self.bytes);
    }

    fn unpack(at: Instant, bytes: &[u8]) -> Option<TapedFrame> {
        let (drive, rest) = bytes.split_first_chunk()?;
        let (verdict, bytes) = rest.split_first()?;
        let drive = u32::from_le_bytes(*drive);
        Some(TapedFrame {
            at,
            drive: usize::try_from(drive)
                .ok()
                .filter(|_| drive != NO_DRIVE)
                .map(DriveIndex::new),
            verdict: *Verdict::ALL.get(usize::from(*verdict))?,
            bytes: bytes.into(),
        })
    }
}

/// The newest entries, oldest first.
#[derive(Debug)]
pub(super) struct PackedRing<T> {
    /// The time of the very first entry, by which all are counted.
    start: Option<Instant>,
    bytes: VecDeque<u8>,
    most_bytes: usize,
    /// Age from which an entry is removed, in nanoseconds like the times of the entries, which are only compared.
    window: i64,
    /// The entry that is packed; kept for its memory.
    entry: Vec<u8>,
    of: PhantomData<T>,
}

impl<T: Packed> PackedRing<T> {
    /// A ring of that many bytes, and of entries that are not older than `window`.
    pub(super) fn new(most_bytes: usize, window: Duration) -> PackedRing<T> {
        PackedRing {
            start: None,
            bytes: VecDeque::new(),
            most_bytes,
            window: count(window),
            entry: Vec::new(),
            of: PhantomData,
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    /// Adds the newest entry; `gone` receives the packed entries that are removed for it.
    pub(super) fn push(&mut self, entry: &T, mut gone: impl FnMut(Instant, &[u8])) {
        let now = entry.at();
        let start = *self.start.get_or_insert(now);
        self.entry.clear();
        self.entry.extend([0; HEAD]);
        entry.pack(&mut self.entry);
        let Some((head, packed)) = self.entry.split_first_chunk_mut::<HEAD>() else {
            return;
        };
        let Ok(length) = u32::try_from(packed.len()) else {
            return;
        };
        let (of_length, of_time) = head.split_at_mut(size_of_val(&length));
        of_length.copy_from_slice(&length.to_le_bytes());
        let now = nanoseconds(start, now);
        of_time.copy_from_slice(&now.to_le_bytes());
        let size = self.entry.len();
        self.make_room(size, now, &mut gone);
        if self.bytes.capacity() - self.bytes.len() < size {
            self.bytes.reserve_exact(size.max(self.most_bytes / STEPS));
        }
        self.bytes.extend(&self.entry);
    }

    /// Limits the ring to this number of bytes; `gone` receives the packed entries that are removed for this.
    pub(super) fn limit(&mut self, most_bytes: usize, mut gone: impl FnMut(Instant, &[u8])) {
        self.most_bytes = most_bytes;
        self.make_room(0, 0, &mut gone);
        self.bytes.shrink_to(most_bytes);
    }

    /// Removes the oldest entries until no entry is older than the window at `now`, nanoseconds since the very first entry,
    /// and `size` more bytes fit.
    fn make_room(&mut self, size: usize, now: i64, gone: &mut impl FnMut(Instant, &[u8])) {
        let Some(start) = self.start else { return };
        while let Some((oldest, at)) = self.head(0) {
            let is_old = now.saturating_sub(at) > self.window;
            if !is_old && self.bytes.len() + size <= self.most_bytes {
                break;
            }
            gone(instant(start, at), &self.slice(HEAD, oldest));
            self.bytes.drain(..(HEAD + oldest).min(self.bytes.len()));
        }
    }

    /// The entries, oldest first.
    pub(super) fn iter(&self) -> impl Iterator<Item = T> {
        let mut place = 0;
        std::iter::from_fn(move || {
            let (length, at) = self.head(place)?;
            let entry = T::unpack(instant(self.start?, at), &self.slice(place + HEAD, length));
            place += HEAD + length;
            entry
        })
    }

    /// Length of the entry at this position, and its time in nanoseconds since the very first entry.
    fn head(&self, place: usize) -> Option<(usize, i64)> {
        let head = self.slice(place, HEAD);
        let (length, time) = head.split_first_chunk()?;
        let length = usize::try_from(u32::from_le_bytes(*length)).ok()?;
        let at = i64::from_le_bytes(*time.first_chunk()?);
        (self.bytes.len() >= place + HEAD + length).then_some((length, at))
    }

    /// Up to `length` bytes from `place` on, fewer if the ring ends before; copied only if they wrap around.
    fn slice(&self, place: usize, length: usize) -> Cow<'_, [u8]> {
        let (first, second) = self.bytes.as_slices();
        match place.checked_sub(first.len()) {
            Some(place) => Cow::Borrowed(
                second
                    .get(place..)
                    .and_then(|rest| rest.get(..length))
                    .unwrap_or_default(),
            ),
            None => match first.get(place..place + length) {
                Some(bytes) => Cow::Borrowed(bytes),
                None => Cow::Owned(self.bytes.range(place..).take(length).copied().collect()),
            },
        }
    }
}

/// Nanoseconds in a duration, at most as many as an entry can state.
fn count(duration: Duration) -> i64 {
    i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX)
}

/// Nanoseconds from `start` to `at`, which may be before `start`.
fn nanoseconds(start: Instant, at: Instant) -> i64 {
    match at.checked_duration_since(start) {
        Some(after) => count(after),
        None => -count(start.saturating_duration_since(at)),
    }
}

fn instant(start: Instant, nanoseconds: i64) -> Instant {
    let apart = Duration::from_nanos(nanoseconds.unsigned_abs());
    let at = if nanoseconds < 0 {
        start.checked_sub(apart)
    } else {
        start.checked_add(apart)
    };
    at.unwrap_or(start)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn read(at: Instant, words: &[u16]) -> TapedRead {
        TapedRead {
            at,
            table: Table::Input,
            start: 2100,
            words: words.into(),
        }
    }

    #[test]
    fn what_is_old_or_too_much_goes_oldest_first() {
        let start = Instant::now();
        let at = |second| start + Duration::from_secs(second);
        let mut ring = PackedRing::new(11 * packed_read(2), Duration::from_secs(10));
        let mut gone = Vec::new();
        for second in 0..20 {
            ring.push(&read(at(second), &[1, second as u16]), |at, bytes| {
                gone.push(TapedRead::unpack(at, bytes).expect("a read").words[1])
            });
        }
        assert_eq!((ring.iter().count(), gone.len()), (11, 9), "by age");
        assert_eq!(gone, (0..9).collect::<Vec<u16>>());
        let most = (11 * packed_read(2) - packed_read(0)) / 2;
        ring.push(&read(at(20), &vec![7; most]), |_, _| ());
        assert_eq!(
            ring.iter().map(|entry| entry.at).collect::<Vec<_>>(),
            [at(20)],
            "by bytes"
        );
        ring.push(&read(at(20), &vec![7; 9999]), |_, _| ());
        assert_eq!(
            ring.iter().next().map(|entry| entry.words.len()),
            Some(9999),
            "the newest always stays"
        );
    }

    #[test]
    fn memory_grows_with_what_is_in_it_and_no_further() {
        let mut ring = PackedRing::new(1 << 20, Duration::from_secs(3600));
        let start = Instant::now();
        ring.push(&read(start, &[0; 11]), |_, _| ());
        assert!(ring.bytes.capacity() <= (1 << 20) / STEPS + 64);
        for count in 0..100_000 {
            ring.push(
                &read(start + Duration::from_millis(count), &[count as u16; 11]),
                |_, _| (),
            );
        }
        let most = (1 << 20) + (1 << 20) / STEPS + 64;
        assert!(ring.bytes.capacity() <= most, "{}", ring.bytes.capacity());
        let kept = (1 << 20) / packed_read(11);
        let newest = (100_000 - kept as u64..100_000)
            .map(|count| read(start + Duration::from_millis(count), &[count as u16; 11]));
        assert!(ring.iter().eq(newest), "entries that wrap around, too");
    }

    #[test]
    fn a_smaller_limit_gives_memory_back_and_keeps_the_newest() {
        let start = Instant::now();
        let mut ring = PackedRing::new(1 << 20, Duration::from_secs(3600));
        for count in 0..10_000 {
            ring.push(&read(start + Duration::from_millis(count), &[count as u16]), |_, _| ());
        }
        let mut gone = 0;
        ring.limit(100 * packed_read(1), |_, _| gone += 1);
        assert_eq!((ring.iter().count(), gone), (100, 9900));
        assert_eq!(ring.iter().next().map(|entry| entry.words[0]), Some(9900));
        assert!(
            ring.bytes.capacity() <= 200 * packed_read(1),
            "{}",
            ring.bytes.capacity()
        );
    }

    proptest! {
        #[test]
        fn everything_comes_back_as_it_was(
            frames in proptest::collection::vec((any::<Option<u16>>(), 0..Verdict::ALL.len(), any::<Vec<u8>>(), -1000..1000i64), 0..50)
        ) {
            let start = Instant::now() + Duration::from_secs(3600);
            let frames: Vec<TapedFrame> = frames.into_iter().map(|(drive, verdict, bytes, at)| TapedFrame {
                at: instant(start, at * 1_000_003),
                drive: drive.map(|drive| DriveIndex::new(usize::from(drive))),
                verdict: Verdict::ALL[verdict],
                bytes: bytes.into(),
            }).collect();
            let mut ring = PackedRing::new(1 << 20, Duration::from_secs(10));
            frames.iter().for_each(|frame| ring.push(frame, |_, _| unreachable!("all fit")));
            prop_assert_eq!(ring.iter().collect::<Vec<_>>(), frames.clone());
            let size: usize = frames.iter().map(|frame| packed_frame(frame.bytes.len())).sum();
            prop_assert_eq!(ring.bytes.len(), size);
        }
    }
}
