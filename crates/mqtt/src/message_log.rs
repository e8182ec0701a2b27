//! Keeps messages on disk until the broker has acknowledged them, across restarts and crashes. Blocking: runs on
//! the thread of the [`store`](super::store).
//!
//! Segment files `{name}-{segment}.log` in one directory, each a sequence of records ([`super::record`]): messages with
//! ascending numbers, and marks up to which number all messages are acknowledged. Records are only appended. A segment
//! whose messages are all acknowledged is deleted (the last one: truncated). When the buffer or the disk is full, the
//! oldest segment is deleted. Damaged parts are copied to `{name}-{segment}-{offset}.damaged`; reading continues at the
//! next valid record.
//!
//! Messages that cannot be written wait in memory behind those on disk, so that the order is kept, and are written
//! as soon as the disk accepts them.

use std::collections::VecDeque;
use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

mod segments;

use self::segments::{SegmentNumber, is_deleted, is_full, lock, remove_old_quarantine, segment_size, segments};
use super::number::MessageNumber;
use super::outbox::{KEPT_BYTES, LOADED_BYTES, Message};
use super::record::{self, Entry, Record};
use drivegate_core::files;

/// Largest and smallest size of a segment, bytes; between them a 64th of the buffer.
const SEGMENT: (u64, u64) = (4 << 10, 256 << 10);
/// Maximum number of messages that wait in memory because the disk does not accept them; their size is at most
/// [`KEPT_BYTES`].
const UNWRITTEN: usize = drivegate_core::event::BURST;
/// Files with damaged records that are kept.
const QUARANTINED: usize = 16;

#[derive(Debug)]
struct Segment {
    number: SegmentNumber,
    path: PathBuf,
    file: File,
    /// Position after the last record.
    end: u64,
    /// Up to here the records were loaded.
    read: u64,
    /// Numbers of the first and the last message in the segment.
    numbers: Option<(MessageNumber, MessageNumber)>,
}

/// The messages on disk, and after them the messages in memory.
#[derive(Debug)]
pub(super) struct MessageLog {
    /// The directory; `None` keeps everything in memory.
    place: Option<MessageLogDir>,
    segments: VecDeque<Segment>,
    next_segment: SegmentNumber,
    /// Messages loaded from disk and not taken yet.
    loaded: VecDeque<(MessageNumber, Message)>,
    unwritten: VecDeque<(MessageNumber, Message)>,
    unwritten_bytes: usize,
    /// The last number given to a message.
    pub(super) last: MessageNumber,
    /// Up to here messages were loaded, taken or lost.
    passed: MessageNumber,
    /// Number up to which all messages are acknowledged; the mark on disk may be older.
    acknowledged: MessageNumber,
    marked: MessageNumber,
    unsynced: bool,
    lost: u64,
    /// Messages already counted as lost in the gaps that are still to be passed.
    pub(super) counted: u64,
    /// Number up to which no messages are kept, because the buffer was full. Messages up to this number that were
    /// taken and not acknowledged are lost.
    pub(super) lost_up_to: MessageNumber,
    /// The files were deleted since the last call of [`MessageLog::take_wiped`].
    wiped: bool,
}

#[derive(Debug)]
struct MessageLogDir {
    dir: PathBuf,
    /// First part of the names of the journal's files.
    name: &'static str,
    max_bytes: u64,
    /// Function that creates the file of a segment.
    create: fn(&Path) -> io::Result<File>,
    /// Locked while the journal is open, since two gateways would damage each other's files.
    lock: File,
}

impl MessageLog {
    /// A journal that is not written to disk.
    pub(super) fn in_memory() -> MessageLog {
        MessageLog {
            place: None,
            segments: VecDeque::new(),
            next_segment: SegmentNumber::FIRST,
            loaded: VecDeque::new(),
            unwritten: VecDeque::new(),
            unwritten_bytes: 0,
            last: MessageNumber::NONE,
            passed: MessageNumber::NONE,
            acknowledged: MessageNumber::NONE,
            marked: MessageNumber::NONE,
            unsynced: false,
            lost: 0,
            counted: 0,
            lost_up_to: MessageNumber::NONE,
            wiped: false,
        }
    }

    /// Opens the journal in `dir`, which is created if necessary, and finds the waiting messages.
    ///
    /// # Errors
    /// If the directory cannot be used, or another process uses it (`WouldBlock`).
    pub(super) fn open(dir: &Path, name: &'static str, max_bytes: u64) -> io::Result<MessageLog> {
        fs::create_dir_all(dir)?;
        let lock = lock(dir, name)?;
        let mut journal = MessageLog {
            place: Some(MessageLogDir {
                dir: dir.to_path_buf(),
                name,
                max_bytes,
                create: |path| OpenOptions::new().read(true).write(true).create_new(true).open(path),
                lock,
            }),
            ..MessageLog::in_memory()
        };
        for (number, path) in segments(dir, name)? {
            journal.next_segment = number.next();
            journal.adopt(number, path)?;
        }
        journal.marked = journal.acknowledged;
        // Messages missing before the first one were lost or acknowledged in an earlier run.
        let first = journal.segments.iter().find_map(|s| s.numbers);
        let before = first.map_or(MessageNumber::NONE, |(first, _)| first.previous());
        journal.passed = journal.acknowledged.max(before).min(journal.last);
        journal.remove_acknowledged()?;
        Ok(journal)
    }

    /// Finds the records of a file that is there when the journal is opened.
    fn adopt(&mut self, number: SegmentNumber, path: PathBuf) -> io::Result<()> {
        let file = OpenOptions::new().read(true).write(true).open(&path)?;
        let bytes = fs::read(&path)?;
        if let Some(version) = record::other_version(&bytes) {
            tracing::warn!(
                target: "drivegate::north::mqtt", "{} was written by another version of drivegate (form {:?}, this \
                                                   one reads 'J'); it is left as it is; that version publishes its \
                                                   messages, or remove it",
                path.display(),
                char::from(version),
            );
            return Ok(());
        }
        let mut numbers: Option<(MessageNumber, MessageNumber)> = None;
        let mut end = 0;
        for Record { entry, range } in record::records(&bytes).flatten() {
            end = range.end as u64;
            match entry {
                Entry::Message(n, _) => numbers = Some((numbers.map_or(n, |(first, _)| first), n)),
                Entry::Acknowledged(n) => self.acknowledged = self.acknowledged.max(n),
            }
        }
        if end < bytes.len() as u64 {
            // No valid record follows, only data that was being written when the process ended or the disk was full.
            if let Err(error) = self.quarantine(number, end, bytes.get(end as usize..).unwrap_or_default())
                && end == 0
                && !is_full(&error)
            {
                // The gateway can neither read the file nor move it aside.
                let path = path.display();
                tracing::warn!(target: "drivegate::north::mqtt", "{path}: nothing in it is valid; it is left as it \
                                                                  is, and nothing from it is published");
                return Ok(());
            }
            self.lost += 1;
            file.set_len(end)?;
        }
        let last = numbers.map_or(MessageNumber::NONE, |(_, last)| last);
        self.last = self.last.max(last).max(self.acknowledged);
        self.segments.push_back(Segment {
            number,
            path,
            file,
            end,
            read: 0,
            numbers,
        });
        Ok(())
    }

    /// Number of messages that wait to be taken.
    pub(super) fn waiting(&self) -> u64 {
        self.loaded.len() as u64 + self.last.since(self.passed)
    }

    /// Number of the last message that was taken, or lost before the next one.
    pub(super) fn through(&self) -> MessageNumber {
        self.loaded.front().map_or(self.passed, |(number, _)| number.previous())
    }

    /// Number of messages lost since the previous call because the buffer was full or they were damaged.
    pub(super) fn take_lost(&mut self) -> u64 {
        std::mem::take(&mut self.lost)
    }

    /// Number of messages that are neither acknowledged nor on disk: they are lost if the process ends now.
    pub(super) fn unkept(&self) -> u64 {
        match self.place {
            Some(_) => self
                .unwritten
                .iter()
                .filter(|(number, _)| *number > self.acknowledged)
                .count() as u64,
            None => self.last.since(self.acknowledged).saturating_sub(self.counted),
        }
    }

    /// Whether the files were deleted since the last call.
    pub(super) fn take_wiped(&mut self) -> bool {
        std::mem::take(&mut self.wiped)
    }

    /// Appends a message; [`MessageLog::write`] writes it. A message that is already `taken` is kept only until it is
    /// acknowledged.
    pub(super) fn append(&mut self, message: Message, taken: bool) {
        self.last = self.last.next();
        if taken {
            self.passed = self.last;
            if self.place.is_none() {
                return;
            }
        }
        let bytes = message.bytes();
        while (self.unwritten.len() == UNWRITTEN || self.unwritten_bytes + bytes > KEPT_BYTES)
            && let Some(number) = self.drop_unwritten()
        {
            if number > self.passed {
                self.lost += 1;
                self.counted += 1;
            }
        }
        self.unwritten_bytes += bytes;
        self.unwritten.push_back((self.last, message));
    }

    /// Drops the first message that waits to be written; returns its number.
    fn drop_unwritten(&mut self) -> Option<MessageNumber> {
        let (number, message) = self.unwritten.pop_front()?;
        self.unwritten_bytes -= message.bytes();
        Some(number)
    }

    /// Removes and returns messages in order with their numbers: at most `most`, and none after the first
    /// [`LOADED_BYTES`] bytes.
    pub(super) fn take(&mut self, most: usize) -> Vec<(MessageNumber, Message)> {
        let (mut taken, mut bytes) = (Vec::new(), 0);
        let all_of_disk = loop {
            if taken.len() >= most || bytes >= LOADED_BYTES {
                break false;
            } else if let Some((number, message)) = self.loaded.pop_front() {
                bytes += message.bytes();
                taken.push((number, message));
            } else if !self.load() {
                break true;
            }
        };
        if all_of_disk {
            let passed = self.passed;
            let fits = |(_, message): &&(MessageNumber, Message)| {
                let fits = bytes < LOADED_BYTES;
                bytes += message.bytes();
                fits
            };
            let rest = self.unwritten.iter().filter(|(number, _)| *number > passed);
            let rest: Vec<_> = rest.take(most - taken.len()).take_while(fits).cloned().collect();
            for (number, message) in rest {
                self.pass(number);
                taken.push((number, message));
            }
        }
        while self.place.is_none() && self.unwritten.front().is_some_and(|(number, _)| *number <= self.passed) {
            self.drop_unwritten();
        }
        taken
    }

    /// Loads the next segment with records that were not loaded; returns false if there is none.
    fn load(&mut self) -> bool {
        let Some(segment) = self.segments.iter_mut().find(|s| s.read < s.end) else {
            return false;
        };
        let (from, end) = (std::mem::replace(&mut segment.read, segment.end), segment.end);
        let number = segment.number;
        let last = segment.numbers.map_or(MessageNumber::NONE, |(_, last)| last);
        let mut bytes = vec![0; (end - from) as usize];
        let read = segment.file.read_exact_at(&mut bytes, from);
        if let Err(error) = read {
            tracing::error!(target: "drivegate::north::mqtt", "{}: {error}; its messages are lost", segment.path.display());
            bytes.clear();
        }
        for found in record::records(&bytes) {
            match found {
                Ok(Record { entry, .. }) => {
                    if let Entry::Message(n, message) = entry
                        && n > self.passed
                    {
                        self.pass(n);
                        self.loaded.push_back((n, message));
                    }
                }
                Err(range) => {
                    let damaged = bytes.get(range.clone()).unwrap_or_default();
                    // Damaged bytes that cannot be copied are in the log, and stay in their segment until that is
                    // acknowledged.
                    let _ = self.quarantine(number, from + range.start as u64, damaged);
                }
            }
        }
        self.pass_all(last);
        true
    }

    /// Notes that the messages up to this number are passed; those that were not taken are lost.
    fn pass_all(&mut self, last: MessageNumber) {
        if last > self.passed {
            self.pass(last);
            self.lost += 1;
        }
    }

    /// Notes that the next message has this number; the messages in between are lost.
    fn pass(&mut self, number: MessageNumber) {
        if number <= self.passed {
            return;
        }
        let gap = number.previous().since(self.passed);
        let known = gap.min(self.counted);
        self.counted -= known;
        self.lost += gap - known;
        self.passed = number;
    }

    /// Notes that all messages up to this number are acknowledged.
    pub(super) fn acknowledge(&mut self, number: MessageNumber) {
        self.acknowledged = self.acknowledged.max(number.min(self.last));
    }

    /// Writes appended messages and acknowledgements; returns whether there was anything to write.
    ///
    /// # Errors
    /// If the disk does not accept the data, which then stay in memory until the next call.
    pub(super) fn write(&mut self) -> io::Result<bool> {
        let mut written = false;
        if self.place.is_none() {
            return Ok(written);
        }
        self.restore_wiped()?;
        self.remove_acknowledged()?;
        while let Some((number, _)) = self.unwritten.front() {
            if *number <= self.acknowledged {
                self.drop_unwritten();
                continue;
            }
            match self.write_some() {
                Err(error) if is_full(&error) && self.drop_oldest()? => {}
                other => other?,
            }
            written = true;
        }
        if self.marked < self.acknowledged && self.segments.iter().any(|s| s.end > 0) {
            let (mark, acknowledged) = (record::mark(self.acknowledged), self.acknowledged);
            match self.write_at_end(&mark) {
                Ok(()) => (self.marked, written) = (acknowledged, true),
                // The messages are delivered again after a restart; a full disk drops nothing.
                Err(error) if is_full(&error) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(written)
    }

    /// Writes messages into the last segment until it is full.
    fn write_some(&mut self) -> io::Result<()> {
        let Some(place) = &self.place else { return Ok(()) };
        let (max_bytes, full) = (place.max_bytes, segment_size(place.max_bytes));
        let room = |s: &Segment| full.saturating_sub(s.end);
        let first = self.unwritten.front().map_or(0, |(_, m)| record::length(m));
        if self.segments.back().is_none_or(|s| s.end > 0 && room(s) < first) {
            self.begin_segment()?;
        }
        let room = self.segments.back().map_or(0, room).max(first);
        let mut bytes = Vec::new();
        let mut count = 0;
        for (number, message) in &self.unwritten {
            if bytes.len() as u64 + record::length(message) > room {
                break;
            }
            record::message(*number, message, &mut bytes);
            count += 1;
        }
        while self.bytes() + bytes.len() as u64 > max_bytes && self.segments.len() > 1 {
            self.drop_oldest()?;
        }
        self.write_at_end(&bytes)?;
        let written: Vec<MessageNumber> = (0..count).filter_map(|_| self.drop_unwritten()).collect();
        if let (Some(segment), Some(first), Some(last)) = (self.segments.back_mut(), written.first(), written.last()) {
            segment.numbers = Some((segment.numbers.map_or(*first, |(first, _)| first), *last));
            if *last <= self.passed {
                segment.read = segment.end;
            }
        }
        Ok(())
    }

    fn write_at_end(&mut self, bytes: &[u8]) -> io::Result<()> {
        let Some(segment) = self.segments.back_mut() else {
            return Ok(());
        };
        segment.file.write_all_at(bytes, segment.end)?;
        segment.end += bytes.len() as u64;
        self.unsynced = true;
        Ok(())
    }

    fn begin_segment(&mut self) -> io::Result<()> {
        let Some(place) = &self.place else { return Ok(()) };
        let number = self.next_segment;
        let path = place.dir.join(number.file(place.name));
        let file = (place.create)(&path)?;
        self.next_segment = number.next();
        self.segments.push_back(Segment {
            number,
            path,
            file,
            end: 0,
            read: 0,
            numbers: None,
        });
        Ok(())
    }

    /// Deletes the oldest segment with its messages to free its room; returns false if there is none.
    fn drop_oldest(&mut self) -> io::Result<bool> {
        if self.segments.front().is_none_or(|oldest| oldest.end == 0) {
            return Ok(false);
        }
        let Some(oldest) = self.segments.pop_front() else {
            return Ok(false);
        };
        if let Some((_, last)) = oldest.numbers {
            self.pass_all(last);
            self.lost_up_to = self.lost_up_to.max(last);
        }
        fs::remove_file(&oldest.path)?;
        Ok(true)
    }

    /// Writes the files again if someone deleted them; their content exists as long as they are open.
    fn restore_wiped(&mut self) -> io::Result<()> {
        let Some(place) = &mut self.place else { return Ok(()) };
        let files = self.segments.iter().map(|s| &s.file).chain([&place.lock]);
        if !files.map(is_deleted).fold(false, |any, one| any | one) {
            return Ok(());
        }
        fs::create_dir_all(&place.dir)?;
        if is_deleted(&place.lock) {
            place.lock = lock(&place.dir, place.name)?;
        }
        let mut kept = 0;
        for segment in self.segments.iter_mut().filter(|segment| is_deleted(&segment.file)) {
            let mut bytes = vec![0; segment.end as usize];
            segment.file.read_exact_at(&mut bytes, 0)?;
            let file = (place.create)(&segment.path)?;
            if let Err(error) = file.write_all_at(&bytes, 0) {
                // The next attempt creates the file again.
                let _ = fs::remove_file(&segment.path);
                return Err(error);
            }
            segment.file = file;
            kept += segment.end;
        }
        (self.wiped, self.unsynced) = (true, true);
        tracing::error!(
            target: "drivegate::north::mqtt", "the files of {} in {} were deleted while the gateway was running: \
                                               rewritten, {kept} bytes; do not clean this directory, or stop the \
                                               gateway first",
            place.name,
            place.dir.display()
        );
        Ok(())
    }

    fn remove_acknowledged(&mut self) -> io::Result<()> {
        let acknowledged = self.acknowledged;
        let done = |s: &Segment| s.numbers.is_none_or(|(_, last)| last <= acknowledged);
        while self.segments.len() > 1 && self.segments.front().is_some_and(done) {
            if let Some(segment) = self.segments.pop_front() {
                fs::remove_file(&segment.path)?;
            }
        }
        if self.segments.len() == 1
            && let Some(segment) = self.segments.back_mut()
            && segment.end > 0
            && done(segment)
        {
            segment.file.set_len(0)?;
            (segment.end, segment.read, segment.numbers) = (0, 0, None);
            // The numbers begin again after a restart, and an old mark would be above them.
            self.marked = acknowledged;
        }
        Ok(())
    }

    fn bytes(&self) -> u64 {
        self.segments.iter().map(|s| s.end).sum()
    }

    /// A file to be synced to disk, if anything was written since the last call.
    pub(super) fn unsynced(&mut self) -> Option<&File> {
        std::mem::take(&mut self.unsynced)
            .then(|| self.segments.back().map(|s| &s.file))
            .flatten()
    }

    /// Keeps a copy of bytes that are not valid records.
    fn quarantine(&self, segment: SegmentNumber, offset: u64, bytes: &[u8]) -> io::Result<()> {
        let Some(MessageLogDir { dir, name, .. }) = &self.place else {
            return Ok(());
        };
        let path = dir.join(segment.damaged(name, offset));
        let kept = remove_old_quarantine(dir, name).and_then(|()| files::replace(&path, bytes));
        let shown = match &kept {
            Err(error) => format!("they cannot be saved: {error}"),
            Ok(()) => format!("kept in {}", path.display()),
        };
        tracing::warn!(
            target: "drivegate::north::mqtt", "{} bytes of {name} in {} are damaged; {shown}; the other records are read",
            bytes.len(),
            dir.display()
        );
        kept
    }
}

#[cfg(test)]
mod tests;
