//! The records of the [`journal`](super::journal): mark, kind, number (u64), length of the body (u32), CRC-32 of all that
//! but the mark, and of the body; body of a message: length of the topic (u16), topic, payload. Numbers are little endian.

use std::ops::Range;

use super::number::MessageNumber;
use super::outbox::Message;

/// Start mark of a record, which no UTF-8 text contains. The third byte is the version of the format: `J` is the
/// first; any format that this version cannot read needs another letter.
const MARK: [u8; 4] = [0xD7, b'G', b'J', 0xFE];
const HEADER: usize = 21;
/// Maximum length of a body; a longer one is damaged.
const LONGEST: usize = 1 << 20;
const MESSAGE: u8 = b'M';
const ACKNOWLEDGED: u8 = b'A';

/// The content of a record.
#[derive(Debug, PartialEq)]
pub(super) enum Entry {
    /// A message with its number.
    Message(MessageNumber, Message),
    /// All messages up to this number were acknowledged.
    Acknowledged(MessageNumber),
}

/// A record of the journal, with its position in the file.
#[derive(Debug, PartialEq)]
pub(super) struct Record {
    pub(super) entry: Entry,
    pub(super) range: Range<usize>,
}

/// Length of the record of `message`.
pub(super) fn length(message: &Message) -> u64 {
    (HEADER + 2 + message.topic.len() + message.payload.len()) as u64
}

/// Appends the record of a message, whose topic has at most 65535 bytes, as MQTT requires.
pub(super) fn message(number: MessageNumber, message: &Message, bytes: &mut Vec<u8>) {
    let topic = message.topic.as_bytes();
    let length = u16::try_from(topic.len()).unwrap_or(u16::MAX);
    encode(
        MESSAGE,
        number,
        &[&length.to_le_bytes(), topic, &message.payload],
        bytes,
    );
}

/// The record of an acknowledgement up to this number.
pub(super) fn mark(number: MessageNumber) -> Vec<u8> {
    let mut bytes = Vec::new();
    encode(ACKNOWLEDGED, number, &[], &mut bytes);
    bytes
}

fn encode(kind: u8, number: MessageNumber, body: &[&[u8]], bytes: &mut Vec<u8>) {
    let length = body.iter().map(|part| part.len()).sum::<usize>() as u32;
    let mut head = vec![kind];
    head.extend_from_slice(&number.get().to_le_bytes());
    head.extend_from_slice(&length.to_le_bytes());
    let sum = body.iter().fold(crc32(u32::MAX, &head), |sum, part| crc32(sum, part));
    bytes.extend_from_slice(&MARK);
    bytes.extend_from_slice(&head);
    bytes.extend_from_slice(&(!sum).to_le_bytes());
    body.iter().for_each(|part| bytes.extend_from_slice(part));
}

/// The records of `bytes` in order; the ranges between them that are not records are returned as errors.
pub(super) fn records(bytes: &[u8]) -> impl Iterator<Item = Result<Record, Range<usize>>> {
    let mut at = 0;
    let mut next = None;
    std::iter::from_fn(move || {
        if let Some(record) = next.take() {
            return Some(Ok(record));
        }
        let damaged = at;
        while at < bytes.len() {
            if let Some((entry, length)) = bytes.get(at..).and_then(decode) {
                let range = at..at + length;
                at = range.end;
                let record = Record { entry, range };
                if damaged < record.range.start {
                    let skipped = damaged..record.range.start;
                    next = Some(record);
                    return Some(Err(skipped));
                }
                return Some(Ok(record));
            }
            let rest = bytes.get(at + 1..).unwrap_or_default();
            let skip = rest.windows(MARK.len()).position(|window| window == MARK);
            at = skip.map_or(bytes.len(), |skip| at + 1 + skip);
        }
        (damaged < at).then_some(Err(damaged..at))
    })
}

/// The version of the records at the start of `bytes`, if this program cannot read it.
pub(super) fn other_version(bytes: &[u8]) -> Option<u8> {
    match bytes {
        [0xD7, b'G', version, 0xFE, ..] if *version != b'J' => Some(*version),
        _ => None,
    }
}

/// Number and bytes of the whole records of a file, for the fuzzer.
pub fn whole_records(bytes: &[u8]) -> (usize, usize) {
    let whole = records(bytes).flatten();
    whole.fold((0, 0), |(count, sum), record| (count + 1, sum + record.range.len()))
}

/// The record at the start of `bytes` and its length, if it is complete and undamaged.
fn decode(bytes: &[u8]) -> Option<(Entry, usize)> {
    let (header, rest) = bytes.split_first_chunk::<HEADER>()?;
    let head = header.strip_prefix(&MARK)?;
    let (head, sum) = head.split_at_checked(13)?;
    let (kind, numbers) = head.split_first()?;
    let (number, length) = numbers.split_first_chunk::<8>()?;
    let length = usize::try_from(u32::from_le_bytes(length.try_into().ok()?)).ok()?;
    let body = rest.get(..length).filter(|_| length <= LONGEST)?;
    let expected = u32::from_le_bytes(sum.try_into().ok()?);
    if !crc32(crc32(u32::MAX, head), body) != expected {
        return None;
    }
    let number = MessageNumber::new(u64::from_le_bytes(*number));
    let entry = match *kind {
        ACKNOWLEDGED => Entry::Acknowledged(number),
        MESSAGE => {
            let (topic, rest) = body.split_first_chunk::<2>()?;
            let (topic, payload) = rest.split_at_checked(usize::from(u16::from_le_bytes(*topic)))?;
            let topic = std::str::from_utf8(topic).ok()?;
            Entry::Message(number, Message::not_retained(topic, payload.to_vec()))
        }
        _ => return None,
    };
    Some((entry, HEADER + length))
}

/// CRC-32 (reflected polynomial 0xEDB88320), continued from `crc`, which begins as all ones; inverted at the end.
fn crc32(crc: u32, bytes: &[u8]) -> u32 {
    let step = |crc: u32, _| {
        if crc & 1 == 1 {
            (crc >> 1) ^ 0xEDB8_8320
        } else {
            crc >> 1
        }
    };
    bytes
        .iter()
        .fold(crc, |crc, byte| (0..8).fold(crc ^ u32::from(*byte), step))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn three() -> Vec<u8> {
        let mut bytes = Vec::new();
        for number in 1..=3 {
            message(
                MessageNumber::new(number),
                &Message::not_retained("a/b", vec![number as u8; 40]),
                &mut bytes,
            );
        }
        bytes.extend(mark(MessageNumber::new(2)));
        bytes
    }

    fn numbers(bytes: &[u8]) -> Vec<u64> {
        let number = |found: Result<Record, _>| match found.ok()?.entry {
            Entry::Message(number, _) => Some(number.get()),
            Entry::Acknowledged(number) => Some(100 + number.get()),
        };
        records(bytes).filter_map(number).collect()
    }

    #[test]
    fn records_are_read_as_they_were_written() {
        let bytes = three();
        assert_eq!(numbers(&bytes), [1, 2, 3, 102]);
        let first = records(&bytes).next().unwrap().unwrap();
        assert_eq!(
            first.entry,
            Entry::Message(MessageNumber::new(1), Message::not_retained("a/b", vec![1; 40]))
        );
        assert_eq!(
            first.range.len() as u64,
            length(&Message::not_retained("a/b", vec![1; 40]))
        );
    }

    /// Bytes that do not come from this code, since files of earlier versions are read.
    #[test]
    fn the_form_of_the_first_version_is_read_and_written() {
        let first_version = [
            &b"\xD7GJ\xFEM\x07\0\0\0\0\0\0\0\x06\0\0\0e\xDC\x11s\x03\0a/bx"[..],
            b"\xD7GJ\xFEA\x06\0\0\0\0\0\0\0\0\0\0\0L\xABR\x80",
        ]
        .concat();
        let mut bytes = Vec::new();
        message(
            MessageNumber::new(7),
            &Message::not_retained("a/b", b"x".to_vec()),
            &mut bytes,
        );
        bytes.extend(mark(MessageNumber::new(6)));
        assert_eq!(bytes, first_version);
        assert_eq!(numbers(&first_version), [7, 106]);
    }

    #[test]
    fn one_flipped_bit_costs_one_record() {
        let whole = three();
        for bit in 0..whole.len() * 8 {
            let mut bytes = whole.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(numbers(&bytes).len(), 3, "bit {bit}");
            let ranges: Vec<_> = records(&bytes).filter_map(Result::err).collect();
            assert_eq!(ranges.len(), 1, "bit {bit}");
            assert!(ranges[0].contains(&(bit / 8)));
        }
    }

    #[test]
    fn whatever_precedes_or_follows_records_are_found() {
        let whole = three();
        for junk in [
            vec![],
            vec![0; 4096],
            b"X".repeat(100),
            MARK.to_vec(),
            whole[..30].to_vec(),
        ] {
            let bytes = [&junk[..], &whole, &junk].concat();
            assert_eq!(numbers(&bytes), [1, 2, 3, 102]);
        }
        for cut in 0..whole.len() {
            assert!(numbers(&whole[..cut]).len() < 4);
        }
    }

    #[test]
    fn crc_32_check_value() {
        assert_eq!(!crc32(u32::MAX, b"123456789"), 0xCBF4_3926);
    }
}
