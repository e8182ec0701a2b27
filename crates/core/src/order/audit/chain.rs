//! The lines of an audit file. Each line has the SHA-256 of the line before it, so that an edit or a removed line
//! is noticed on reading; a cut at the end is noticed by comparing with a hash that was noted elsewhere. Pure.

use std::fmt;
use std::str::FromStr;
use std::time::SystemTime;

use ring::digest::{Context, SHA256, digest};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::AuditRecord;
use crate::hex;

/// A SHA-256.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Hash([u8; 32]);

impl Hash {
    /// The hash of `bytes`.
    pub fn of(bytes: &[u8]) -> Hash {
        Hash::from(digest(&SHA256, bytes))
    }
}

impl From<ring::digest::Digest> for Hash {
    fn from(digest: ring::digest::Digest) -> Hash {
        // The conversion cannot fail: digest and hash both have the length of a SHA-256.
        Hash(digest.as_ref().try_into().unwrap_or_default())
    }
}

impl fmt::Display for Hash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&hex::encode(&self.0))
    }
}

impl FromStr for Hash {
    type Err = String;

    fn from_str(text: &str) -> Result<Hash, String> {
        let bytes = hex::decode(text).and_then(|bytes| bytes.try_into().ok());
        bytes.map(Hash).ok_or("a hash has 64 hexadecimal digits".to_string())
    }
}

impl Serialize for Hash {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for Hash {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Hash, D::Error> {
        String::deserialize(deserializer)?
            .parse()
            .map_err(serde::de::Error::custom)
    }
}

/// The content of a line of the audit.
#[derive(Debug, Serialize)]
#[serde(tag = "entry", rename_all = "snake_case")]
pub enum Entry<'e> {
    /// A command that was sent to a drive.
    Sent(&'e AuditRecord),
    /// A command that was not sent, or refusals of one client.
    NotSent(&'e AuditRecord),
    /// A notice of records that could not be written.
    Lost {
        /// When the loss was noticed.
        #[serde(serialize_with = "crate::event::rfc3339")]
        time: SystemTime,
        /// Number of lost records of sent commands.
        sent: u64,
        /// Records of commands that were not sent.
        not_sent: u64,
    },
    /// The bytes between the last entry and this one are the rest of a line that a crash cut off.
    Fragment {
        /// When the bytes of the fragment were found.
        #[serde(serialize_with = "crate::event::rfc3339")]
        time: SystemTime,
        /// Number of the bytes, without the line end.
        bytes: u64,
        /// Hash of the fragment's bytes.
        sha256: Hash,
    },
}

/// The end of a chain: number and hash of its last line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Chain {
    /// Number of the last line, from 1; 0 if the file is empty.
    pub seq: u64,
    /// Hash of the last line; zero if the file is empty.
    pub last: Hash,
}

impl Chain {
    /// The line of an entry, with its line end, and the state of the chain after it.
    ///
    /// # Errors
    /// If the entry cannot be written as JSON; every entry can.
    pub fn line(&self, entry: &Entry<'_>) -> serde_json::Result<(Vec<u8>, Chain)> {
        #[derive(Serialize)]
        struct Line<'e> {
            seq: u64,
            prev: Hash,
            #[serde(flatten)]
            entry: &'e Entry<'e>,
        }
        let seq = self.seq.saturating_add(1);
        let prev = self.last;
        let mut line = serde_json::to_vec(&Line { seq, prev, entry })?;
        let last = Hash::of(&line);
        line.push(b'\n');
        Ok((line, Chain { seq, last }))
    }
}

/// The fields of a line that a reader needs.
#[derive(Debug, Deserialize)]
struct Head {
    seq: u64,
    prev: Hash,
    entry: String,
    bytes: Option<u64>,
    sha256: Option<Hash>,
}

impl Head {
    fn read(line: &[u8]) -> Option<Head> {
        serde_json::from_slice(line).ok()
    }
}

/// The sequence number of a line, if the line is an entry.
pub fn seq(line: &[u8]) -> Option<u64> {
    Head::read(line).map(|head| head.seq)
}

/// The end of an audit file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tail {
    /// Chain after the last entry.
    pub chain: Chain,
    /// Number and hash of the bytes after the last entry, if there are any.
    pub fragment: Option<(u64, Hash)>,
    /// Whether the file ends with a line end.
    pub ended: bool,
}

/// The end of the chain in a file whose last bytes are `window`; `None` if they contain no entry.
pub fn tail(window: &[u8], is_whole: bool) -> Option<Tail> {
    let of = |line: &[u8], head: &Head| Chain {
        seq: head.seq,
        last: Hash::of(line),
    };
    let after = window.iter().rposition(|byte| *byte == b'\n').map(|place| place + 1);
    let last = window.get(after.or(is_whole.then_some(0))?..)?;
    if let Some(head) = Head::read(last) {
        // A complete line without its line end is taken.
        return Some(Tail {
            chain: of(last, &head),
            fragment: None,
            ended: false,
        });
    }
    let mut end = window.len();
    // Bytes before the first line end may be the end of a longer line, so they count only if the window covers the
    // whole file.
    while let Some(line_end) = window.get(..end)?.iter().rposition(|byte| *byte == b'\n') {
        let before = window.get(..line_end)?;
        let begin = before.iter().rposition(|byte| *byte == b'\n').map(|place| place + 1);
        let line = before.get(begin.or(is_whole.then_some(0))?..)?;
        if let Some(head) = Head::read(line) {
            let chain = of(line, &head);
            let (fragment, ended) = fragment(window.get(line_end + 1..)?);
            let ended = ended || fragment.is_none();
            return Some(Tail { chain, fragment, ended });
        }
        end = line_end;
    }
    None
}

/// The fragment that a crash left after the last entry, without its line end, and whether it has one.
pub fn fragment(rest: &[u8]) -> (Option<(u64, Hash)>, bool) {
    let (bytes, ended) = match rest.strip_suffix(b"\n") {
        Some(bytes) => (bytes, true),
        None => (rest, false),
    };
    let found = (!rest.is_empty()).then(|| (bytes.len() as u64, Hash::of(bytes)));
    (found, ended)
}

/// A place at which the file was changed, and the kind of the change.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fault {
    /// Whether the fault concerns the line before.
    pub before: bool,
    /// The fault, as text.
    pub why: String,
}

/// Reads the lines of a chain and finds changes to them.
#[derive(Default)]
pub struct Verifier {
    chain: Option<Chain>,
    /// Number and hash of the bytes read so far that belong to lines which are not entries.
    fragment: Option<(u64, Context)>,
    wanted: Option<Hash>,
}

impl fmt::Debug for Verifier {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Verifier")
            .field("chain", &self.chain)
            .finish_non_exhaustive()
    }
}

impl Verifier {
    /// A verifier that looks for a line with the hash `last`.
    pub fn new(last: Option<Hash>) -> Verifier {
        Verifier {
            wanted: last,
            ..Verifier::default()
        }
    }

    /// The end of the chain read so far; `None` before the first entry.
    pub fn chain(&self) -> Option<Chain> {
        self.chain
    }

    /// Processes the next line, given without its line end.
    ///
    /// # Errors
    /// If the line is at fault: contains the fault. The next line can still be checked.
    pub fn line(&mut self, line: &[u8]) -> Result<(), Fault> {
        let Some(head) = Head::read(line) else {
            let (bytes, hash) = self.fragment.get_or_insert_with(|| (0, Context::new(&SHA256)));
            if *bytes > 0 {
                *bytes += 1;
                hash.update(b"\n");
            }
            *bytes += line.len() as u64;
            hash.update(line);
            return Ok(());
        };
        let now = Chain {
            seq: head.seq,
            last: Hash::of(line),
        };
        self.wanted = self.wanted.filter(|wanted| *wanted != now.last);
        let before = self.chain.replace(now);
        let fragment = self
            .fragment
            .take()
            .map(|(bytes, hash)| (bytes, Hash::from(hash.finish())));
        let named = head.bytes.zip(head.sha256).filter(|_| head.entry == "fragment");
        if fragment != named {
            let why = match fragment {
                Some(_) => "the line is not an entry, and no entry declares it as left by a crash",
                None => "a fragment left by a crash before this line was removed",
            };
            return Err(Fault {
                before: fragment.is_some(),
                why: why.to_string(),
            });
        }
        // The first line may continue the chain of another file.
        let before = before.or((head.seq <= 1).then(Chain::default));
        before.map_or(Ok(()), |before| follows(&head, before))
    }

    /// Checks the end of the file after all lines were read.
    ///
    /// # Errors
    /// If the last line is at fault: contains the fault.
    pub fn finish(&self) -> Result<(), String> {
        if self.fragment.is_some() {
            return Err("the last line is incomplete: truncated by a crash or by someone".to_string());
        }
        match self.wanted {
            Some(wanted) => Err(format!(
                "no line has the hash {wanted}: the end was cut off, or this is another file"
            )),
            None => Ok(()),
        }
    }
}

/// Checks whether a line continues the chain of the line before it.
fn follows(head: &Head, before: Chain) -> Result<(), Fault> {
    if head.prev == before.last && head.seq == before.seq + 1 {
        return Ok(());
    }
    let step = head.seq.checked_sub(before.seq);
    let why = match step {
        Some(1) => "the line was changed: its hash is not the one in the next line".to_string(),
        Some(0) | None => format!("entry {} follows entry {}: out of order", head.seq, before.seq),
        Some(step) => format!(
            "entries {} to {} before this line are missing",
            before.seq + 1,
            before.seq + step - 1
        ),
    };
    Err(Fault {
        before: step == Some(1),
        why,
    })
}

#[cfg(test)]
mod tests {
    use super::super::tests::record;
    use super::*;

    /// Joins `count` lines to the chain and returns them.
    fn lines(chain: &mut Chain, count: usize) -> Vec<Vec<u8>> {
        let record = record("a", 1);
        let mut next = || {
            let (line, after) = chain.line(&Entry::Sent(&record)).unwrap();
            *chain = after;
            line[..line.len() - 1].to_vec()
        };
        (0..count).map(|_| next()).collect()
    }

    fn faults(lines: &[Vec<u8>], last: Option<Hash>) -> Vec<(usize, String)> {
        let mut verifier = Verifier::new(last);
        let mut faults = Vec::new();
        for (number, line) in lines.iter().enumerate() {
            let fault = verifier.line(line).err();
            faults.extend(fault.map(|fault| (number + usize::from(!fault.before), fault.why)));
        }
        faults.extend(verifier.finish().err().map(|why| (lines.len(), why)));
        faults
    }

    #[test]
    fn every_edit_and_every_cut_shows() {
        let mut chain = Chain::default();
        let whole = lines(&mut chain, 6);
        assert_eq!(faults(&whole, Some(chain.last)), []);
        assert_eq!(faults(&whole[2..], None), [], "a rotated file");
        for place in 0..5 {
            for at in 0..whole[place].len() {
                let mut edited = whole.clone();
                edited[place][at] ^= 1;
                assert!(!faults(&edited, None).is_empty(), "line {place}, byte {at}");
            }
            let mut cut = whole.clone();
            cut.remove(place);
            let expected = if place == 0 { vec![] } else { vec![place + 1] };
            let found: Vec<usize> = faults(&cut, None).into_iter().map(|(line, _)| line).collect();
            assert_eq!(found, expected, "the first may be in another file");
            let mut twice = whole.clone();
            twice.insert(place, whole[place].clone());
            assert_eq!(faults(&twice, None).len(), 1);
        }
        assert_eq!(faults(&whole[..5], None), [], "a cut end does not show by itself");
        let found = faults(&whole[..5], Some(chain.last));
        assert!(found.len() == 1 && found[0].1.contains("the end was cut"), "{found:?}");
        let mut forged = whole.clone();
        forged[5] = whole[4].clone();
        assert!(faults(&forged, None)[0].1.contains("out of order"));
        let mut changed = whole.clone();
        changed[2] = String::from_utf8(whole[2].clone())
            .unwrap()
            .replace("\"a\"", "\"b\"")
            .into_bytes();
        let expected = "the line was changed: its hash is not the one in the next line";
        assert_eq!(faults(&changed, None), [(3, expected.to_string())]);
    }

    #[test]
    fn a_cut_line_is_named_and_the_chain_goes_on() {
        let mut chain = Chain::default();
        let whole = lines(&mut chain, 3);
        let joined = [whole.join(&b'\n'), b"\n".to_vec()].concat();
        let third = whole[2].clone();
        for cut in joined.len() - third.len() - 1..joined.len() {
            let tail = tail(&joined[..cut], true).unwrap();
            let rest = &joined[joined.len() - third.len() - 1..cut];
            if rest == third {
                assert_eq!(
                    tail,
                    Tail {
                        chain,
                        fragment: None,
                        ended: false
                    },
                    "only its line end is missing"
                );
                continue;
            }
            assert_eq!((tail.chain.seq, tail.ended), (2, rest.is_empty()));
            let Some((bytes, sha256)) = tail.fragment else {
                assert!(rest.is_empty());
                continue;
            };
            let time = SystemTime::UNIX_EPOCH;
            let (line, _) = tail.chain.line(&Entry::Fragment { time, bytes, sha256 }).unwrap();
            let line = line[..line.len() - 1].to_vec();
            let repaired = vec![whole[0].clone(), whole[1].clone(), rest.to_vec(), line];
            assert_eq!(faults(&repaired, None), [], "{}", String::from_utf8_lossy(rest));
            let mut edited = repaired.clone();
            edited[2].push(b'x');
            assert_eq!(faults(&edited, None).len(), 1);
            edited.remove(2);
            assert_eq!(faults(&edited, None).len(), 1, "it is not there");
            assert_eq!(
                faults(&[&repaired[..3], &whole[2..]].concat(), None).len(),
                1,
                "nobody names it"
            );
        }
        assert_eq!(tail(b"garbage\n\0\0", true), None);
        let found = tail(&joined, true).unwrap();
        assert_eq!(
            found,
            Tail {
                chain,
                fragment: None,
                ended: true
            }
        );
        for window in 0..joined.len() {
            let part = tail(&joined[window..], false);
            assert!(part.is_none_or(|part| part == found));
        }
    }

    #[test]
    fn hashes_as_sha256sum_has_them() {
        let empty = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855";
        assert_eq!(Hash::of(b"").to_string(), empty);
        assert_eq!(empty.parse(), Ok(Hash::of(b"")));
        for bad in ["", "00", &"g".repeat(64), &"é".repeat(32), &empty[1..]] {
            assert!(bad.parse::<Hash>().is_err(), "{bad}");
        }
    }
}
