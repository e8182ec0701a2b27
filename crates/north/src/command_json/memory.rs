//! Remembers executed commands so that repetitions are recognised. Time is an argument.

use std::collections::{BTreeMap, VecDeque};
use std::hash::{BuildHasher, RandomState};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Number of recent commands whose results are kept, and whose repetition is recognised by the mark of the broker.
const RECENT: usize = 1024;
/// Minimum time for which a command with an `id` is remembered.
pub const REMEMBERED: Duration = Duration::from_secs(600);
/// Longest time that a command is remembered, whatever the expiry of its message.
const LONGEST: Duration = Duration::from_secs(86_400);
/// Maximum number of commands with an `id` that are remembered.
const MOST_COMMANDS: usize = 1 << 18;

/// The parts of a command by which its repetition is recognised.
#[derive(Debug, Clone, Copy, Default)]
pub struct Taken<'t> {
    /// Where the command arrived: its topic, or the user and the drive.
    pub topic: &'t str,
    /// Payload of the command.
    pub payload: &'t [u8],
    /// Where the command's result is sent: response topic and correlation data.
    pub answer_to: (Option<&'t str>, Option<&'t [u8]>),
    /// Whether the broker marks the command as a repetition.
    pub dup: bool,
    /// MQTT packet id, which identifies a repetition.
    pub packet: u16,
    /// Remaining life of the command's message, s.
    pub expiry: Option<u32>,
}

/// The commands taken so far, and their results `R`.
#[derive(Debug)]
pub struct Memory<R> {
    hasher: RandomState,
    /// Recent commands, oldest first.
    recent: VecDeque<Recent<R>>,
    /// Commands by a fingerprint of topic, `id` and payload. Trees are used because entries are added and removed
    /// all day: a hash table would double when removals have used up its free places, and keep the size that a
    /// flood required.
    known: BTreeMap<u64, RememberedCommand>,
    /// The remembered commands by the time until which they are remembered.
    ends: BTreeMap<(Instant, u64), u64>,
    /// The last command by topic and `id`.
    last_of: BTreeMap<u64, u64>,
    /// Number of commands taken so far.
    taken: u64,
    /// Commands up to this number that have no result yet never get one.
    abandoned: u64,
}

/// Memory shared by the clients of one broker, or by the connections of the HTTP server, also across reloads: a
/// repeated command may arrive over a new connection. Results sent through a broker are payloads.
#[derive(Debug)]
pub struct SharedMemory<R = Arc<[u8]>>(Arc<Mutex<Memory<R>>>);

impl<R> Clone for SharedMemory<R> {
    fn clone(&self) -> SharedMemory<R> {
        SharedMemory(self.0.clone())
    }
}

impl<R> Default for SharedMemory<R> {
    fn default() -> SharedMemory<R> {
        SharedMemory(Arc::default())
    }
}

impl<R> SharedMemory<R> {
    pub fn lock(&self) -> MutexGuard<'_, Memory<R>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<R> Default for Memory<R> {
    fn default() -> Memory<R> {
        Memory {
            hasher: RandomState::default(),
            recent: VecDeque::new(),
            known: BTreeMap::new(),
            ends: BTreeMap::new(),
            last_of: BTreeMap::new(),
            taken: 0,
            abandoned: 0,
        }
    }
}

#[derive(Debug)]
struct Recent<R> {
    number: u64,
    packet: u16,
    fingerprint: u64,
    stops: u64,
    answer_to: u64,
    /// The result; `None` until the command is finished.
    result: Option<R>,
}

#[derive(Debug, Clone, Copy)]
struct RememberedCommand {
    number: u64,
    stops: u64,
    /// Hash of topic and `id`.
    identity: u64,
    /// Hash of the address to which the result of the command is sent.
    answer_to: u64,
}

/// The fingerprint of a message.
#[derive(Debug, Clone, Copy)]
pub struct Fingerprint {
    /// Fingerprint of everything except the packet id.
    whole: u64,
    /// Hash of topic and `id`, if the command has an `id`; and hash with the payload.
    identity: Option<(u64, u64)>,
    answer_to: u64,
}

/// Whether and how a message repeats a command.
#[derive(Debug, PartialEq)]
pub enum Repetition<R> {
    /// A command whose result is already known.
    Answered(R),
    /// A command whose result is pending and goes to the same address.
    Pending,
    /// A command whose result does not answer this message, and why.
    Outdated(&'static str),
}

impl<R: Clone> Memory<R> {
    /// The fingerprint that identifies a command with this `id`.
    pub fn fingerprint(&self, taken: &Taken<'_>, id: Option<&str>) -> Fingerprint {
        let Taken { topic, payload, .. } = taken;
        let answer_to = self.hasher.hash_one(taken.answer_to);
        let identity = id.map(|id| self.hasher.hash_one((topic, id)));
        Fingerprint {
            whole: self.hasher.hash_one((topic, payload, answer_to)),
            identity: identity.map(|identity| (identity, self.hasher.hash_one((identity, payload)))),
            answer_to,
        }
    }

    /// The earlier command that a message repeats: the broker marks the message as repeated, or the message has the
    /// topic, payload and `id` of the earlier one. `stops` is the present number of stops of the drive.
    pub fn repeated(
        &mut self,
        taken: &Taken<'_>,
        print: Fingerprint,
        stops: u64,
        now: Instant,
    ) -> Option<Repetition<R>> {
        self.forget(now);
        let marked = |known: &&Recent<R>| taken.dup && known.packet == taken.packet && known.fingerprint == print.whole;
        let by_id = print
            .identity
            .and_then(|(_, content)| self.known.get(&content).copied());
        let by_mark = || {
            let recent = self.recent.iter().rev().find(marked)?;
            Some(RememberedCommand {
                number: recent.number,
                stops: recent.stops,
                identity: 0,
                answer_to: recent.answer_to,
            })
        };
        let known = by_id.or_else(by_mark)?;
        let recent = self.recent.iter().find(|recent| recent.number == known.number);
        let result = recent.map(|recent| &recent.result);
        if matches!(result, Some(None)) && known.number > self.abandoned && known.answer_to == print.answer_to {
            return Some(Repetition::Pending);
        }
        if known.stops != stops {
            return Some(Repetition::Outdated(
                "but the drive has been stopped since, or added again by a reload",
            ));
        }
        if let Some(last) = self.last_of.get(&known.identity)
            && *last != known.number
        {
            return Some(Repetition::Outdated("but its `id` was used for another command since"));
        }
        Some(match result {
            Some(Some(result)) => Repetition::Answered(result.clone()),
            Some(None) if known.number > self.abandoned => Repetition::Outdated("whose result is pending"),
            Some(None) | None => Repetition::Outdated("whose result is no longer known"),
        })
    }

    /// Whether another command with an `id` can be remembered.
    pub fn has_room(&mut self, now: Instant) -> bool {
        self.forget(now);
        self.known.len() < MOST_COMMANDS
    }

    fn forget(&mut self, now: Instant) {
        while let Some(end) = self.ends.first_entry().filter(|end| end.key().0 <= now) {
            if let Some(known) = self.known.remove(&end.remove())
                && self.last_of.get(&known.identity) == Some(&known.number)
            {
                self.last_of.remove(&known.identity);
            }
        }
    }

    /// Remembers a command taken at `now`; returns the command's number.
    pub fn remember(&mut self, taken: &Taken<'_>, print: Fingerprint, stops: u64, now: Instant) -> u64 {
        self.taken += 1;
        let number = self.taken;
        if self.recent.len() == RECENT {
            self.recent.pop_front();
        }
        self.recent.push_back(Recent {
            number,
            packet: taken.packet,
            fingerprint: print.whole,
            stops,
            answer_to: print.answer_to,
            result: None,
        });
        if let Some((identity, content)) = print.identity {
            let expiry = Duration::from_secs(taken.expiry.unwrap_or_default().into());
            let until = now + expiry.clamp(REMEMBERED, LONGEST);
            let known = RememberedCommand {
                number,
                stops,
                identity,
                answer_to: print.answer_to,
            };
            self.known.insert(content, known);
            self.ends.insert((until, number), content);
            self.last_of.insert(identity, number);
        }
        number
    }

    /// Notes that pending results are no longer awaited by anyone and will not come.
    pub fn abandon(&mut self) {
        self.abandoned = self.taken;
    }

    /// Stores the result of a command.
    pub fn finished(&mut self, number: u64, result: &R) {
        // The numbers are consecutive.
        let first = self.recent.front().map_or(0, |recent| recent.number);
        let place = number.checked_sub(first).and_then(|place| usize::try_from(place).ok());
        if let Some(recent) = place.and_then(|place| self.recent.get_mut(place)) {
            recent.result = Some(result.clone());
        }
    }
}
