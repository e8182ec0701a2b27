//! The requests that read a drive: points that lie together become one request.

use std::collections::BTreeSet;
use std::time::Duration;

use super::profile::{PollClass, Profile};
use crate::codec::{LineFormat, Protocol, RequestPdu, Table};

/// One request of the plan.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct PlannedRead {
    /// How often it is sent.
    pub class: PollClass,
    /// Table.
    pub table: Table,
    /// First PDU address.
    pub start: u16,
    /// Items.
    pub count: u16,
}

impl PlannedRead {
    /// The request.
    pub fn pdu(&self) -> RequestPdu {
        RequestPdu::Read {
            table: self.table,
            start: self.start,
            count: self.count,
        }
    }

    /// Whether it reads that address.
    pub fn covers(&self, table: Table, address: u16) -> bool {
        self.table == table
            && address >= self.start
            && u32::from(address) < u32::from(self.start) + u32::from(self.count)
    }
}

/// All requests of one drive, fast ones first.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Plan {
    /// In the order class, table, address.
    pub reads: Vec<PlannedRead>,
}

impl Plan {
    /// Merges the points of a profile into few requests: addresses of one class that lie together
    /// in one range of the drive, up to the limit of the range. A gap is covered only where the
    /// range allows holes. An address needed by two classes is read in the faster one only.
    pub fn of(profile: &Profile) -> Plan {
        let mut taken: BTreeSet<(Table, u16)> = BTreeSet::new();
        let mut reads = Vec::new();
        for class in [PollClass::Fast, PollClass::Slow, PollClass::Once] {
            let mut wanted: BTreeSet<(Table, u16)> = BTreeSet::new();
            for raw in profile
                .points
                .iter()
                .filter(|p| p.class == class)
                .filter_map(|p| p.raw())
            {
                for item in 0..raw.form.items() {
                    if let Some(address) = raw
                        .address
                        .checked_add(item)
                        .filter(|a| !taken.contains(&(raw.table, *a)))
                    {
                        wanted.insert((raw.table, address));
                    }
                }
            }
            reads.extend(merge(profile, class, &wanted));
            taken.extend(wanted);
        }
        Plan { reads }
    }

    /// Splits a refused request in two halves; a single item cannot be split.
    pub fn halves(read: PlannedRead) -> Option<(PlannedRead, PlannedRead)> {
        if read.count < 2 {
            return None;
        }
        let first = read.count / 2;
        let low = PlannedRead { count: first, ..read };
        let high = PlannedRead {
            start: read.start.checked_add(first)?,
            count: read.count - first,
            ..read
        };
        Some((low, high))
    }
}

fn merge(profile: &Profile, class: PollClass, wanted: &BTreeSet<(Table, u16)>) -> Vec<PlannedRead> {
    let mut reads: Vec<PlannedRead> = Vec::new();
    for &(table, address) in wanted {
        let Some(range) = profile.range(table, address) else {
            continue;
        };
        // The last read of another table may lie above this address.
        if let Some(last) = reads.last_mut().filter(|last| last.table == table) {
            let end = u32::from(last.start) + u32::from(last.count);
            let joined = u32::from(address) + 1 - u32::from(last.start);
            let adjacent = u32::from(address) == end || range.holes;
            let fits = joined <= u32::from(range.read);
            if range.addresses.contains(&last.start) && adjacent && fits {
                last.count = joined as u16;
                continue;
            }
        }
        reads.push(PlannedRead {
            class,
            table,
            start: address,
            count: 1,
        });
    }
    reads
}

/// What an exchange costs on the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WireTime {
    /// Characters of the request.
    pub request: Duration,
    /// Silence by which the drive knows that the request is over (Modbus RTU: 3.5 characters); its turnaround
    /// begins behind it.
    pub recognition: Duration,
    /// Characters of the regular reply.
    pub reply: Duration,
}

impl WireTime {
    /// Wire time of an exchange.
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
        assert_eq!(of(PollClass::Slow), [(7, 2), (2000, 3)]);
        assert_eq!(of(PollClass::Once), [(100, 4), (732, 2)]);
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
        let two = format!("{}\n{}", range(0, 9, 10, false), range(10, 19, 10, false));
        assert_eq!(
            spans(&profile(&two, &[8, 9, 10, 11])),
            [(8, 2), (10, 2)],
            "never across a border"
        );
        assert_eq!(spans(&profile(&range(0, 99, 1, false), &[1, 2])), [(1, 1), (2, 1)]);
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
            let pdu = RequestPdu::Read {
                table: Table::Holding,
                start: 2100,
                count: 11,
            };
            let time = WireTime::of(Protocol::ModbusRtu, &format, &pdu);
            let total = time
                .total(Duration::from_micros(500), format.silence_chars())
                .as_secs_f64();
            assert!((1.0 / total - rate).abs() < 0.1, "{baud}: {}", 1.0 / total);
        }
    }
}
