//! Keeps events on disk until the broker has acknowledged them, across restarts and crashes.
//!
//! Segment files `mqtt-events-{number}.log` in one directory, each a sequence of records: state (`L` waiting, `A`
//! acknowledged), length of the body (u32, little endian), CRC-32 of the body (u32, little endian), body: length of the
//! topic (u16, little endian), topic, payload. Records are only appended; an acknowledgement overwrites the state byte.
//! An incomplete or damaged record ends its segment. A segment whose records are all acknowledged is deleted (the last
//! one: truncated); when the directory is full, the oldest segment is deleted.

use std::collections::VecDeque;
use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, flock};

use super::outbox::Message;

const PREFIX: &str = "mqtt-events-";
const SUFFIX: &str = ".log";
const LOCK: &str = "mqtt-events.lock";
const WAITS: u8 = b'L';
const ACKNOWLEDGED: u8 = b'A';
const HEADER: usize = 9;
/// Maximum length of a record; a longer one is damaged.
const LONGEST: usize = 1 << 20;
/// Number of segments in a full directory; the oldest one is dropped.
const SEGMENTS: u64 = 8;

/// Position of a record.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct RecordId {
    segment: u64,
    offset: u64,
}

#[derive(Debug)]
struct Segment {
    number: u64,
    path: PathBuf,
    file: File,
    /// End of the last complete record.
    end: u64,
    /// Number of records that are not acknowledged.
    waiting: u64,
    /// Position of the next record to be loaded, and the number of waiting records from there on.
    cursor: u64,
    unloaded: u64,
}

/// The events on disk.
#[derive(Debug)]
pub(super) struct Journal {
    dir: PathBuf,
    max_bytes: u64,
    segments: VecDeque<Segment>,
    next_number: u64,
    unsynced: bool,
    dropped: u64,
    /// Locked while the journal is open, since two gateways would damage each other's files.
    _lock: File,
}

impl Journal {
    /// Opens the journal in `dir`, which is created if necessary, and finds the waiting events.
    ///
    /// # Errors
    /// The directory cannot be used, or another process uses it (`WouldBlock`).
    pub(super) fn open(dir: &Path, max_bytes: u64) -> io::Result<Journal> {
        fs::create_dir_all(dir)?;
        let lock = OpenOptions::new()
            .create(true)
            .truncate(false)
            .write(true)
            .open(dir.join(LOCK))?;
        flock(&lock, FlockOperation::NonBlockingLockExclusive).map_err(|_| {
            let text = "another process uses this directory; give each gateway its own";
            io::Error::new(io::ErrorKind::WouldBlock, text)
        })?;
        let mut found: Vec<(u64, PathBuf)> = Vec::new();
        for entry in fs::read_dir(dir)? {
            let path = entry?.path();
            if let Some(number) = segment_number(&path) {
                found.push((number, path));
            }
        }
        found.sort();
        let mut journal = Journal {
            dir: dir.to_path_buf(),
            max_bytes,
            segments: VecDeque::new(),
            next_number: found.last().map_or(1, |(number, _)| number.saturating_add(1)),
            unsynced: false,
            dropped: 0,
            _lock: lock,
        };
        for (number, path) in found {
            let segment = Segment::scan(number, path)?;
            if segment.waiting == 0 {
                fs::remove_file(&segment.path)?;
            } else {
                journal.segments.push_back(segment);
            }
        }
        Ok(journal)
    }

    /// Appends an event.
    ///
    /// # Errors
    /// The event cannot be written, or exceeds the size of the buffer; the journal is unchanged.
    pub(super) fn append(&mut self, message: &Message) -> io::Result<()> {
        let record = encode(message)?;
        let length = record.len() as u64;
        if length > self.max_bytes {
            return Err(io::Error::other("the event is larger than the buffer"));
        }
        let full = (self.max_bytes / SEGMENTS).max(1);
        if self.segments.back().is_none_or(|s| s.end > 0 && s.end + length > full) {
            self.begin_segment()?;
        }
        while self.bytes() + length > self.max_bytes && self.segments.len() > 1 {
            if let Some(oldest) = self.segments.pop_front() {
                self.dropped += oldest.unloaded;
                fs::remove_file(&oldest.path)?;
            }
        }
        let Some(segment) = self.segments.back_mut() else {
            return Err(io::Error::other("no segment"));
        };
        segment.file.write_all_at(&record, segment.end)?;
        segment.end += length;
        segment.waiting += 1;
        segment.unloaded += 1;
        self.unsynced = true;
        Ok(())
    }

    /// Whether half of the room is taken.
    pub(super) fn is_busy(&self) -> bool {
        self.bytes() >= self.max_bytes / 2
    }

    fn begin_segment(&mut self) -> io::Result<()> {
        let number = self.next_number;
        let path = self.dir.join(format!("{PREFIX}{number:012}{SUFFIX}"));
        let file = OpenOptions::new().read(true).write(true).create_new(true).open(&path)?;
        self.next_number = number.saturating_add(1);
        self.segments.push_back(Segment {
            number,
            path,
            file,
            end: 0,
            waiting: 0,
            cursor: 0,
            unloaded: 0,
        });
        Ok(())
    }

    fn bytes(&self) -> u64 {
        self.segments.iter().map(|s| s.end).sum()
    }

    /// Loads the oldest waiting event that is not loaded yet.
    pub(super) fn load(&mut self) -> Option<(RecordId, Message)> {
        let segment = self.segments.iter_mut().find(|s| s.unloaded > 0)?;
        match segment.load() {
            Ok(Some(loaded)) => Some(loaded),
            other => {
                let lost = std::mem::take(&mut segment.unloaded);
                segment.waiting = segment.waiting.saturating_sub(lost);
                segment.cursor = segment.end;
                self.dropped += lost;
                tracing::warn!(
                    file = %segment.path.display(),
                    "{lost} buffered events are damaged and lost: {}",
                    other.err().map_or_else(|| "a record is damaged".to_string(), |e| e.to_string())
                );
                None
            }
        }
    }

    /// Number of waiting events that are not loaded.
    pub(super) fn unloaded(&self) -> u64 {
        self.segments.iter().map(|s| s.unloaded).sum()
    }

    /// Number of events dropped because the buffer was full or damaged.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Marks an event as acknowledged by the broker.
    ///
    /// # Errors
    /// The mark cannot be written; the event is delivered again after a restart.
    pub(super) fn acknowledge(&mut self, record: RecordId) -> io::Result<()> {
        let Some(index) = self.segments.iter().position(|s| s.number == record.segment) else {
            return Ok(()); // dropped in the meantime, because the buffer was full
        };
        let last = index + 1 == self.segments.len();
        let Some(segment) = self.segments.get_mut(index) else {
            return Ok(());
        };
        segment.file.write_all_at(&[ACKNOWLEDGED], record.offset)?;
        segment.waiting = segment.waiting.saturating_sub(1);
        if segment.waiting > 0 {
            return Ok(());
        }
        if last {
            segment.file.set_len(0)?;
            (segment.end, segment.cursor) = (0, 0);
            return Ok(());
        }
        if let Some(done) = self.segments.remove(index) {
            fs::remove_file(&done.path)?;
        }
        Ok(())
    }

    /// A file to be synced to disk, if anything was written since the last call.
    pub(super) fn unsynced(&mut self) -> Option<File> {
        std::mem::take(&mut self.unsynced)
            .then(|| self.segments.back()?.file.try_clone().ok())
            .flatten()
    }
}

impl Segment {
    /// Finds the complete records of a segment and truncates the rest.
    fn scan(number: u64, path: PathBuf) -> io::Result<Segment> {
        let file = OpenOptions::new().read(true).write(true).open(&path)?;
        let bytes = fs::read(&path)?;
        let (mut end, mut waiting) = (0, 0);
        for record in records(&bytes) {
            waiting += u64::from(record.waits);
            end += record.length;
        }
        if end < bytes.len() {
            tracing::warn!(file = %path.display(), "ignoring {} bytes of an incomplete or damaged record", bytes.len() - end);
            file.set_len(end as u64)?;
        }
        Ok(Segment {
            number,
            path,
            file,
            end: end as u64,
            waiting,
            cursor: 0,
            unloaded: waiting,
        })
    }

    /// The next waiting record; `None` if a record is damaged.
    fn load(&mut self) -> io::Result<Option<(RecordId, Message)>> {
        while self.cursor < self.end {
            let mut header = [0; HEADER];
            self.file.read_exact_at(&mut header, self.cursor)?;
            let Some(body) = body_length(&header) else {
                return Ok(None);
            };
            let mut bytes = vec![0; HEADER + body];
            self.file.read_exact_at(&mut bytes, self.cursor)?;
            let Some(record) = Record::decode(&bytes) else {
                return Ok(None);
            };
            let offset = self.cursor;
            self.cursor += record.length as u64;
            if record.waits {
                self.unloaded -= 1;
                let id = RecordId {
                    segment: self.number,
                    offset,
                };
                return Ok(Some((id, record.message)));
            }
        }
        Ok(None)
    }
}

/// The whole records at the beginning of a segment.
fn records(bytes: &[u8]) -> impl Iterator<Item = Record> {
    let mut rest = bytes;
    std::iter::from_fn(move || {
        let record = Record::decode(rest)?;
        rest = rest.get(record.length..)?;
        Some(record)
    })
}

/// Number and bytes of the whole records at the beginning of a segment, for the fuzzer.
pub fn whole_records(segment: &[u8]) -> (usize, usize) {
    records(segment).fold((0, 0), |(count, bytes), record| (count + 1, bytes + record.length))
}

struct Record {
    waits: bool,
    message: Message,
    /// Length of the whole record, bytes.
    length: usize,
}

impl Record {
    /// The record at the beginning of `bytes`, if it is complete and undamaged.
    fn decode(bytes: &[u8]) -> Option<Record> {
        let (header, rest) = bytes.split_first_chunk::<HEADER>()?;
        let body = rest.get(..body_length(header)?)?;
        let [state, _, _, _, _, c0, c1, c2, c3] = *header;
        let waits = state == WAITS;
        if !(waits || state == ACKNOWLEDGED) || crc32(body) != u32::from_le_bytes([c0, c1, c2, c3]) {
            return None;
        }
        let (topic_length, rest) = body.split_first_chunk::<2>()?;
        let (topic, payload) = rest.split_at_checked(usize::from(u16::from_le_bytes(*topic_length)))?;
        Some(Record {
            waits,
            message: Message::not_retained(std::str::from_utf8(topic).ok()?, payload.to_vec()),
            length: HEADER + body.len(),
        })
    }
}

fn body_length(header: &[u8; HEADER]) -> Option<usize> {
    let [_, l0, l1, l2, l3, ..] = *header;
    let length = usize::try_from(u32::from_le_bytes([l0, l1, l2, l3])).ok()?;
    (length <= LONGEST).then_some(length)
}

fn encode(message: &Message) -> io::Result<Vec<u8>> {
    let too_long = || io::Error::other("the event is too long for the buffer");
    let topic_length = u16::try_from(message.topic.len()).map_err(|_| too_long())?;
    let mut body = topic_length.to_le_bytes().to_vec();
    body.extend_from_slice(message.topic.as_bytes());
    body.extend_from_slice(&message.payload);
    if body.len() > LONGEST {
        return Err(too_long());
    }
    let length = u32::try_from(body.len()).map_err(|_| too_long())?;
    let mut record = vec![WAITS];
    record.extend_from_slice(&length.to_le_bytes());
    record.extend_from_slice(&crc32(&body).to_le_bytes());
    record.extend_from_slice(&body);
    Ok(record)
}

fn segment_number(path: &Path) -> Option<u64> {
    let name = path.file_name()?.to_str()?;
    name.strip_prefix(PREFIX)?.strip_suffix(SUFFIX)?.parse().ok()
}

/// CRC-32 (reflected polynomial 0xEDB88320, initial value and final XOR 0xFFFFFFFF), as in zip files.
fn crc32(bytes: &[u8]) -> u32 {
    let step = |crc: u32, _| {
        if crc & 1 == 1 {
            (crc >> 1) ^ 0xEDB8_8320
        } else {
            crc >> 1
        }
    };
    !bytes
        .iter()
        .fold(u32::MAX, |crc, byte| (0..8).fold(crc ^ u32::from(*byte), step))
}

#[cfg(test)]
mod tests {
    use super::*;

    const BIG: u64 = 1 << 20;

    fn event(n: usize) -> Message {
        Message::not_retained("b/hall/drive/p1/event", format!("{{\"n\":{n}}}").into_bytes())
    }

    fn number(message: &Message) -> usize {
        let text = std::str::from_utf8(&message.payload).unwrap();
        text.trim_matches(|c: char| !c.is_ascii_digit()).parse().unwrap()
    }

    fn load_all(journal: &mut Journal) -> Vec<(RecordId, usize)> {
        let mut loaded = Vec::new();
        while journal.unloaded() > 0 {
            loaded.extend(journal.load().map(|(record, message)| (record, number(&message))));
        }
        loaded
    }

    fn numbers(loaded: &[(RecordId, usize)]) -> Vec<usize> {
        loaded.iter().map(|(_, n)| *n).collect()
    }

    fn segments(dir: &Path) -> Vec<PathBuf> {
        let paths = fs::read_dir(dir).unwrap().map(|e| e.unwrap().path());
        let mut found: Vec<_> = paths.filter(|p| segment_number(p).is_some()).collect();
        found.sort();
        found
    }

    #[test]
    fn unacknowledged_events_survive_a_restart() {
        let dir = tempfile::tempdir().unwrap();
        let mut journal = Journal::open(dir.path(), BIG).unwrap();
        (1..=4).for_each(|n| journal.append(&event(n)).unwrap());
        let loaded = load_all(&mut journal);
        assert_eq!(numbers(&loaded), [1, 2, 3, 4]);
        journal.acknowledge(loaded[0].0).unwrap();
        journal.acknowledge(loaded[2].0).unwrap();
        drop(journal); // nothing is written at the end: the same as a killed process
        let mut journal = Journal::open(dir.path(), BIG).unwrap();
        journal.append(&event(5)).unwrap();
        let (_, message) = journal.load().unwrap();
        assert_eq!(message, event(2), "topic and payload as they were");
        assert_eq!(numbers(&load_all(&mut journal)), [4, 5]);
        assert_eq!(segments(dir.path()).len(), 1);
    }

    #[test]
    fn a_journal_without_waiting_events_is_empty() {
        let dir = tempfile::tempdir().unwrap();
        let mut journal = Journal::open(dir.path(), BIG).unwrap();
        for round in 0..3 {
            journal.append(&event(round)).unwrap();
            for (record, n) in load_all(&mut journal) {
                assert_eq!(n, round);
                journal.acknowledge(record).unwrap();
            }
            let path = segments(dir.path()).pop().unwrap();
            assert_eq!(fs::metadata(path).unwrap().len(), 0);
        }
        drop(journal);
        let journal = Journal::open(dir.path(), BIG).unwrap();
        assert_eq!((journal.unloaded(), segments(dir.path()).len()), (0, 0));
    }

    #[test]
    fn an_incomplete_or_damaged_tail_is_truncated() {
        let whole = encode(&event(9)).unwrap();
        let mut damaged = whole.clone();
        damaged[HEADER + 4] ^= 1;
        let mut endless = whole.clone();
        endless[4] = 0xFF;
        let tails = (1..whole.len()).map(|n| whole[..n].to_vec());
        for tail in tails.chain([damaged, endless, vec![0; 4096], b"X".repeat(100)]) {
            let dir = tempfile::tempdir().unwrap();
            let mut journal = Journal::open(dir.path(), BIG).unwrap();
            (1..=2).for_each(|n| journal.append(&event(n)).unwrap());
            drop(journal);
            let path = segments(dir.path()).pop().unwrap();
            let mut bytes = fs::read(&path).unwrap();
            bytes.extend_from_slice(&tail);
            fs::write(&path, &bytes).unwrap();
            let mut journal = Journal::open(dir.path(), BIG).unwrap();
            journal.append(&event(3)).unwrap();
            assert_eq!(numbers(&load_all(&mut journal)), [1, 2, 3]);
        }
    }

    #[test]
    fn a_full_buffer_drops_its_oldest_segment() {
        let dir = tempfile::tempdir().unwrap();
        let max = 4000;
        let mut journal = Journal::open(dir.path(), max).unwrap();
        for n in 0..1000 {
            journal.append(&event(n)).unwrap();
            assert!(journal.bytes() <= max);
        }
        let on_disk: u64 = segments(dir.path())
            .iter()
            .map(|p| fs::metadata(p).unwrap().len())
            .sum();
        assert!(on_disk <= max);
        let loaded = load_all(&mut journal);
        assert_eq!(journal.dropped() as usize + loaded.len(), 1000);
        assert!(loaded.len() as u64 > max / 2 / encode(&event(999)).unwrap().len() as u64);
        let first = 1000 - loaded.len();
        assert_eq!(
            numbers(&loaded),
            (first..1000).collect::<Vec<_>>(),
            "the newest, in order"
        );
        for (record, _) in loaded {
            journal.acknowledge(record).unwrap();
        }
        assert_eq!((journal.bytes(), segments(dir.path()).len()), (0, 1));
        assert!(journal.append(&Message::not_retained("t", vec![0; 5000])).is_err());
    }

    #[test]
    fn an_acknowledgement_for_a_dropped_segment_is_ignored() {
        let dir = tempfile::tempdir().unwrap();
        let mut journal = Journal::open(dir.path(), 500).unwrap();
        journal.append(&event(0)).unwrap();
        let (record, _) = journal.load().unwrap();
        (1..100).for_each(|n| journal.append(&event(n)).unwrap());
        journal.acknowledge(record).unwrap();
        assert_eq!(
            journal.dropped() + journal.unloaded(),
            99,
            "the loaded one was not dropped"
        );
    }

    #[test]
    fn a_directory_belongs_to_one_process() {
        let dir = tempfile::tempdir().unwrap();
        let _journal = Journal::open(dir.path(), BIG).unwrap();
        let error = Journal::open(dir.path(), BIG).unwrap_err();
        assert!(error.to_string().contains("another process"), "{error}");
    }

    #[test]
    fn crc_32_check_value() {
        assert_eq!(crc32(b"123456789"), 0xCBF4_3926);
    }
}
