//! The requests that read a drive: neighbouring points are read in one request.

use crate::drive::PointIndex;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use super::model::ModelPoint;
use super::profile::{PollClass, Profile, Source};
use drivegate_proto::{LineFormat, Protocol, RequestPdu, Table};

/// A read request of a drive's plan.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct PlannedRead {
    /// Poll class of the request.
    pub class: PollClass,
    /// Modbus table of the request.
    pub table: Table,
    /// First PDU address.
    pub start: u16,
    /// Number of registers or bits.
    pub count: u16,
    /// Bit i is set if item i is the second register of a value: no request begins there.
    pub wide: u128,
}

impl PlannedRead {
    /// The request to send.
    pub fn pdu(&self) -> RequestPdu {
        RequestPdu::Read {
            table: self.table,
            start: self.start,
            count: self.count,
        }
    }

    /// Whether the request includes this address.
    pub fn covers(&self, table: Table, address: u16) -> bool {
        self.table == table
            && address >= self.start
            && u32::from(address) < u32::from(self.start) + u32::from(self.count)
    }
}

/// The points that decide the drive's state.
const DECIDING: [ModelPoint; 3] = [ModelPoint::Fault, ModelPoint::Running, ModelPoint::Ready];

/// All read requests for one drive, the fast ones first.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Plan {
    /// The reads in the order of class, table, address.
    pub reads: Vec<PlannedRead>,
    /// Reads after a new fault that no fast read covers: once per fault, among the slow reads.
    pub on_fault: Vec<PlannedRead>,
    /// Reads of monitoring registers for process data that no other read covers: see
    /// [`super::profile::Point::monitor`].
    pub monitors: Vec<PlannedRead>,
    /// Requests of `reads` that are longer than a manual states: bits that are read singly until a reply proves the
    /// whole.
    pub trials: Vec<PlannedRead>,
    /// The reads of process data that decide the drive's state: fault, running, ready.
    pub behind_state: Vec<PlannedRead>,
    /// The slow reads of the remaining bits of the status word, which precede other slow reads when the drive comes online.
    pub behind_status_word: Vec<PlannedRead>,
}

impl Plan {
    /// Merges the points of a profile into few requests: neighbouring addresses of one class in one range of the drive,
    /// up to the limit of the range. A gap is read only where the range allows holes. An address that two classes need,
    /// or that the faster one reads as such a gap, is read in the faster one only.
    pub fn of(profile: &Profile) -> Plan {
        let pieces = pieces_of(profile);
        let mut taken: BTreeSet<(Table, u16)> = BTreeSet::new();
        let is_open = |taken: &BTreeSet<(Table, u16)>, &(table, address, items): &Piece| {
            addresses(address, items).any(|at| !taken.contains(&(table, at)))
        };
        let mut reads = Vec::new();
        for class in [PollClass::Fast, PollClass::Slow, PollClass::Once] {
            let of_class = pieces.iter().filter(|(_, of)| **of == class);
            let wanted: BTreeSet<Piece> = of_class
                .map(|(piece, _)| *piece)
                .filter(|piece| is_open(&taken, piece))
                .collect();
            let merged = merge(profile, class, &wanted);
            for read in &merged {
                taken.extend(addresses(read.start, read.count).map(|at| (read.table, at)));
            }
            reads.extend(merged);
        }
        let monitors = profile.points.iter().filter_map(|point| point.monitor);
        let monitors = monitors.filter_map(|monitor| profile.points.get(monitor)?.raw());
        let monitors: BTreeSet<Piece> = monitors
            .filter(|raw| raw.addresses().any(|a| !taken.contains(&(raw.table, a))))
            .map(|raw| (raw.table, raw.address, raw.form.items()))
            .collect();
        let monitors = merge(profile, PollClass::Monitor, &monitors);
        for read in &monitors {
            taken.extend((read.start..).take(usize::from(read.count)).map(|a| (read.table, a)));
        }
        let on_fault = profile.on_fault.iter().filter_map(|index| profile.points.get(*index));
        let on_fault: BTreeSet<Piece> = on_fault
            .filter(|point| point.class == PollClass::Never)
            .filter_map(|point| point.raw())
            .map(|raw| (raw.table, raw.address, raw.form.items()))
            .filter(|piece| is_open(&taken, piece))
            .collect();
        let on_fault = merge(profile, PollClass::Fault, &on_fault);
        let mut plan = Plan {
            reads,
            on_fault,
            monitors,
            trials: Vec::new(),
            behind_state: Vec::new(),
            behind_status_word: Vec::new(),
        };
        plan.behind_state = plan.behind(profile, &DECIDING, PollClass::Fast);
        let others: Vec<ModelPoint> = ModelPoint::STATUS_WORD
            .into_iter()
            .filter(|point| !DECIDING.contains(point))
            .collect();
        plan.behind_status_word = plan.behind(profile, &others, PollClass::Slow);
        let is_trial = |read: &&PlannedRead| {
            let range = profile.range(read.table, read.start);
            read.class == PollClass::Fast && range.is_some_and(|range| read.count > range.read)
        };
        plan.trials = plan.reads.iter().filter(is_trial).copied().collect();
        plan
    }

    /// The reads of a class that any of the points needs.
    fn behind(&self, profile: &Profile, points: &[ModelPoint], class: PollClass) -> Vec<PlannedRead> {
        let points = points.iter().filter_map(|point| profile.model_index(*point));
        let points: Vec<PointIndex> = points.flat_map(|point| profile.raw_points_of(point)).collect();
        let raws = || points.iter().filter_map(|point| profile.points.get(*point)?.raw());
        let shows =
            |read: &&PlannedRead| raws().any(|raw| raw.addresses().any(|address| read.covers(raw.table, address)));
        let of_class = self.reads.iter().filter(|read| read.class == class);
        of_class.filter(shows).copied().collect()
    }

    /// All requests: those of the poll classes, those after a fault, and those for comparisons.
    pub fn all(&self) -> impl Iterator<Item = &PlannedRead> {
        self.reads.iter().chain(&self.monitors).chain(&self.on_fault)
    }

    /// Whether these requests read a point of this profile, including everything it is derived from.
    pub fn shows(&self, profile: &Profile, point: PointIndex) -> bool {
        match profile.points.get(point).map(|point| &point.source) {
            Some(Source::Raw(raw)) => {
                let is_read = |address| self.reads.iter().any(|read| read.covers(raw.table, address));
                raw.addresses().all(is_read) && raw.scaled_by().all(|scale| self.shows(profile, scale))
            }
            Some(Source::Derived(derived)) => derived.rests_on().into_iter().all(|of| self.shows(profile, of)),
            None => false,
        }
    }

    /// Splits a refused request into halves, never within a value; a single value cannot be split.
    pub fn halves(read: PlannedRead) -> Option<(PlannedRead, PlannedRead)> {
        let middle = read.count / 2;
        let joint = |at: &u16| *at >= 1 && *at < read.count && !is_wide(read.wide, *at);
        let first = (middle..read.count).chain((0..middle).rev()).find(joint)?;
        let low = PlannedRead {
            count: first,
            wide: read.wide & low_bits(first),
            ..read
        };
        let high = PlannedRead {
            start: read.start.checked_add(first)?,
            count: read.count - first,
            wide: read.wide.checked_shr(u32::from(first)).unwrap_or(0),
            ..read
        };
        Some((low, high))
    }
}

impl PlannedRead {
    /// Appends the read of the addresses that follow.
    pub fn append(&mut self, next: &PlannedRead) {
        self.wide |= next.wide.checked_shl(u32::from(self.count)).unwrap_or(0);
        self.count = self.count.saturating_add(next.count);
    }
}

/// Whether the item is a further register of a value.
pub fn is_wide(wide: u128, item: u16) -> bool {
    wide.checked_shr(u32::from(item)).is_some_and(|rest| rest & 1 == 1)
}

fn low_bits(count: u16) -> u128 {
    1u128.checked_shl(u32::from(count)).map_or(u128::MAX, |bit| bit - 1)
}

/// Registers of one value, which are read together: table, first address, count.
type Piece = (Table, u16, u16);

fn addresses(start: u16, items: u16) -> impl Iterator<Item = u16> {
    (0..items).filter_map(move |item| start.checked_add(item))
}

/// The values that the plan reads, each in the fastest class among those that share its registers: overlapping
/// values form one piece, so that no value is put together from two reads.
fn pieces_of(profile: &Profile) -> BTreeMap<Piece, PollClass> {
    let polled = profile.points.iter().filter(|point| point.class < PollClass::Fault);
    let raws = polled.filter_map(|point| Some((point.raw()?, point.class)));
    let mut all: Vec<(Piece, PollClass)> = raws
        .map(|(raw, class)| ((raw.table, raw.address, raw.form.items()), class))
        .collect();
    all.sort();
    let mut pieces: Vec<(Piece, PollClass)> = Vec::new();
    for ((table, address, items), class) in all {
        let end = |start: u16, items: u16| u32::from(start) + u32::from(items);
        let most = profile.range(table, address).map_or(0, |range| range.read);
        let joined = pieces.last_mut().filter(|((of, start, count), _)| {
            let whole = end(address, items).max(end(*start, *count)) - u32::from(*start);
            *of == table && u32::from(address) < end(*start, *count) && whole <= u32::from(most)
        });
        match joined {
            Some(((_, start, count), fastest)) => {
                let whole = end(address, items).max(end(*start, *count)) - u32::from(*start);
                *count = u16::try_from(whole).unwrap_or(*count);
                *fastest = class.min(*fastest);
            }
            None => pieces.push(((table, address, items), class)),
        }
    }
    pieces.into_iter().collect()
}

fn merge(profile: &Profile, class: PollClass, wanted: &BTreeSet<Piece>) -> Vec<PlannedRead> {
    let mut reads: Vec<PlannedRead> = Vec::new();
    for &(table, address, items) in wanted {
        let Some(range) = profile.range(table, address) else {
            continue;
        };
        let piece_end = u32::from(address) + u32::from(items);
        // These are the registers of a value after its first one.
        let inner = low_bits(items) & !1;
        // The last read of another table may be above this address.
        if let Some(last) = reads.last_mut().filter(|last| last.table == table) {
            let end = u32::from(last.start) + u32::from(last.count);
            let joined = piece_end.max(end) - u32::from(last.start);
            let adjacent = u32::from(address) <= end || range.holes;
            // Trials are made for bits only, which a drive that ignores the number of items reports as 0.
            let tried = if class == PollClass::Fast && table.is_bits() {
                range.try_read
            } else {
                0
            };
            let fits = joined <= u32::from(range.read.max(tried));
            if range.addresses.contains(&last.start) && adjacent && fits {
                let at = u32::from(address) - u32::from(last.start);
                last.wide |= inner.checked_shl(at).unwrap_or(0);
                last.count = joined as u16;
                continue;
            }
        }
        reads.push(PlannedRead {
            class,
            table,
            start: address,
            count: items,
            wide: inner,
        });
    }
    reads
}

/// Time a transaction takes on the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WireTime {
    /// Wire time of the request.
    pub request: Duration,
    /// Silence by which the drive detects the end of the request (Modbus RTU: 3.5 characters); its turnaround
    /// begins after that.
    pub recognition: Duration,
    /// Wire time of the regular reply.
    pub reply: Duration,
}

impl WireTime {
    /// Wire time of a transaction.
    pub fn of(protocol: Protocol, format: &LineFormat, pdu: &RequestPdu) -> WireTime {
        WireTime {
            request: format.chars(protocol.request_chars(pdu)),
            recognition: protocol.recognition(format),
            reply: format.chars(protocol.reply_chars(pdu)),
        }
    }

    /// The whole transaction: request, recognition, turnaround, reply, silence.
    pub fn total(&self, turnaround: Duration, silence: Duration) -> Duration {
        self.request + self.recognition + turnaround + self.reply + silence
    }
}

#[cfg(test)]
mod tests {
    use super::super::profile::Profiles;
    use super::*;

    /// 17 and 75 characters of 10 bits (reference/drives.md 5.2), 15 ms of a TECO drive, 3.5 characters of silence.
    #[test]
    fn an_ascii_exchange_by_hand() {
        let format = LineFormat::new(9600, "7E1").unwrap();
        let pdu = RequestPdu::read(Table::Holding, 0x20, 16);
        let time = WireTime::of(Protocol::ModbusAscii, &format, &pdu);
        let us = |time: Duration| time.as_micros();
        assert_eq!(
            (us(time.request), us(time.recognition), us(time.reply)),
            (17_708, 0, 78_125)
        );
        let total = time.total(Duration::from_millis(15), format.silence_spec());
        assert_eq!(us(total), 114_479);
    }

    #[test]
    fn process_data_is_one_request() {
        let profiles = Profiles::built_in();
        let plan = Plan::of(profiles.get("vacon-nx").unwrap());
        let of = |class| -> Vec<(u16, u16)> {
            plan.reads
                .iter()
                .filter(|r| r.class == class)
                .map(|r| (r.start, r.count))
                .collect()
        };
        assert_eq!(of(PollClass::Fast), [(2100, 11)]);
        assert_eq!(of(PollClass::Slow), [(7, 2), (100, 2), (2000, 3)]);
        assert_eq!(of(PollClass::Once), [(102, 2), (732, 2)]);
    }

    fn profile(range: &str, addresses: &[u16]) -> Profile {
        let mut text = format!("name = \"p\"\nprotocols = [\"modbus-rtu\"]\n{range}\n");
        for address in addresses {
            text += &format!("[[point]]\nname = \"p{address}\"\nat = \"holding {address}\"\nclass = \"fast\"\n");
        }
        Profile::parse("p.toml", &text, false).unwrap()
    }

    fn spans(profile: &Profile) -> Vec<(u16, u16)> {
        Plan::of(profile).reads.iter().map(|r| (r.start, r.count)).collect()
    }

    #[test]
    fn limits_holes_and_borders() {
        let range = |first, last, read, holes| {
            format!("[[range]]\ntable = \"holding\"\nfirst = {first}\nlast = {last}\nread = {read}\nholes = {holes}")
        };
        assert_eq!(
            spans(&profile(&range(0, 99, 2, false), &[1, 2, 3, 4, 5])),
            [(1, 2), (3, 2), (5, 1)]
        );
        assert_eq!(spans(&profile(&range(0, 99, 10, false), &[1, 3])), [(1, 1), (3, 1)]);
        assert_eq!(spans(&profile(&range(0, 99, 10, true), &[1, 3, 20])), [(1, 3), (20, 1)]);
        let text = "[[point]]\nname = \"s\"\nat = \"holding 2\"\nclass = \"slow\"\n";
        let source = profile(&range(0, 99, 10, true), &[1, 3]).text + text;
        let with_slow = Profile::parse("p.toml", &source, false).unwrap();
        assert_eq!(spans(&with_slow), [(1, 3)], "a slow point in a gap of a fast read");
        let two = format!("{}\n{}", range(0, 9, 10, false), range(10, 19, 10, false));
        assert_eq!(
            spans(&profile(&two, &[8, 9, 10, 11])),
            [(8, 2), (10, 2)],
            "never across a border"
        );
        assert_eq!(spans(&profile(&range(0, 99, 1, false), &[1, 2])), [(1, 1), (2, 1)]);
    }

    #[test]
    fn a_wide_value_is_never_torn() {
        let text = "name = \"p\"\nprotocols = [\"modbus-rtu\"]\n\
            [[range]]\ntable = \"input\"\nfirst = 0\nlast = 99\nread = 3\n\
            [[point]]\nname = \"a\"\nat = \"input 0\"\ntype = \"f32\"\nclass = \"fast\"\n\
            [[point]]\nname = \"b\"\nat = \"input 2\"\ntype = \"f32\"\nclass = \"fast\"\n\
            [[point]]\nname = \"c\"\nat = \"input 4\"\nclass = \"fast\"\n\
            [[point]]\nname = \"d\"\nat = \"input 3\"\nclass = \"fast\"\n";
        let plan = Plan::of(&Profile::parse("p.toml", text, false).unwrap());
        assert_eq!(
            plan.reads.iter().map(|r| (r.start, r.count)).collect::<Vec<_>>(),
            [(0, 2), (2, 3)]
        );
        let read = PlannedRead {
            count: 6,
            wide: 0b10_1010,
            ..plan.reads[0]
        };
        let (low, high) = Plan::halves(read).unwrap();
        assert_eq!(
            (low.count, low.wide, high.start, high.count, high.wide),
            (4, 0b1010, 4, 2, 0b10)
        );
        let (low, mut first) = (high, low);
        assert_eq!(Plan::halves(low), None, "one value");
        first.append(&low);
        assert_eq!(first, read);
    }

    /// Values that share registers are read together, in the class of the fastest, however they would be cut otherwise.
    #[test]
    fn values_that_overlap_are_one_read() {
        let plan_of = |points: &[(&str, u16, &str)]| {
            let mut text = "name = \"p\"\nprotocols = [\"modbus-rtu\"]\n[[range]]\ntable = \"holding\"\nfirst = 0\n\
                            last = 99\nread = 4\n"
                .to_string();
            for (place, (kind, address, class)) in points.iter().enumerate() {
                text += &format!(
                    "[[point]]\nname = \"p{place}\"\nat = \"holding {address}\"\ntype = \"{kind}\"\nclass = \"{class}\"\n"
                );
            }
            let plan = Plan::of(&Profile::parse("p.toml", &text, false).unwrap());
            let reads = plan.reads.iter().map(|r| (r.class, r.start, r.count));
            reads.collect::<Vec<_>>()
        };
        use PollClass::{Fast, Slow};
        let split = [
            ("u16", 0, "fast"),
            ("u16", 1, "fast"),
            ("u16", 2, "fast"),
            ("u64", 3, "fast"),
        ];
        assert_eq!(plan_of(&split), [(Fast, 0, 3), (Fast, 3, 4)]);
        let torn = [("u32", 1, "slow"), ("u16", 1, "fast"), ("u16", 9, "slow")];
        assert_eq!(plan_of(&torn), [(Fast, 1, 2), (Slow, 9, 1)]);
        let chain = [("u64", 0, "slow"), ("u64", 2, "slow")];
        assert_eq!(plan_of(&chain), [(Slow, 0, 4), (Slow, 2, 4)], "each whole");
        assert_eq!(plan_of(&[("string:4", 8, "slow")]), [(Slow, 8, 4)]);
    }

    #[test]
    fn tables_are_never_mixed() {
        let text = "name = \"p\"\nprotocols = [\"modbus-rtu\"]\n\
            [[range]]\ntable = \"input\"\nfirst = 0\nlast = 9\nread = 10\n\
            [[range]]\ntable = \"holding\"\nfirst = 0\nlast = 9\nread = 10\n\
            [[point]]\nname = \"a\"\nat = \"input 5\"\nclass = \"fast\"\n\
            [[point]]\nname = \"b\"\nat = \"holding 0\"\nclass = \"fast\"\n\
            [[point]]\nname = \"c\"\nat = \"holding 6\"\nclass = \"fast\"\n";
        let plan = Plan::of(&Profile::parse("p.toml", text, false).unwrap());
        let reads: Vec<_> = plan.reads.iter().map(|r| (r.table, r.start, r.count)).collect();
        assert_eq!(
            reads,
            [(Table::Input, 5, 1), (Table::Holding, 0, 1), (Table::Holding, 6, 1)]
        );
    }

    #[test]
    fn wire_times_of_the_known_figures() {
        // 11 registers, 8N1, a drive that answers 0.5 ms after it has recognised the end of the request
        // by 3.5 characters of silence: 87.4 and 241.2 reads a second.
        for (baud, rate) in [(38_400, 87.4), (115_200, 241.2)] {
            let format = LineFormat::new(baud, "8N1").unwrap();
            let pdu = RequestPdu::read(Table::Holding, 2100, 11);
            let time = WireTime::of(Protocol::ModbusRtu, &format, &pdu);
            let total = time
                .total(Duration::from_micros(500), format.silence_chars())
                .as_secs_f64();
            assert!((1.0 / total - rate).abs() < 0.1, "{baud}: {}", 1.0 / total);
        }
    }
}
