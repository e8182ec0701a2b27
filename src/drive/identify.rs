//! How a drive shows its family: reads whose outcome differs between families. Pure.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::profile::{Profile, Profiles};
use crate::codec::{Protocol, RequestPdu, Table};
use crate::document::Reader;

/// A read that tells families apart; nothing is ever written for that.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Probe {
    /// Table.
    pub table: Table,
    /// First PDU address.
    pub start: u16,
    /// Items.
    pub count: u16,
}

/// What a family does with a probe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Expected {
    /// The read.
    pub probe: Probe,
    /// It is answered with values; else it is refused.
    pub values: bool,
}

impl Probe {
    /// The request.
    pub fn pdu(&self) -> RequestPdu {
        RequestPdu::Read {
            table: self.table,
            start: self.start,
            count: self.count,
        }
    }
}

/// All probes of the profiles that speak `protocol`.
pub fn probes(profiles: &Profiles, protocol: Protocol) -> Vec<Probe> {
    let speaking = profiles.iter().filter(|p| p.protocols.contains(&protocol));
    let mut probes: Vec<Probe> = speaking.flat_map(|p| p.identify.iter().map(|e| e.probe)).collect();
    probes.sort();
    probes.dedup();
    probes
}

/// The profiles that fit all outcomes, those that say most of themselves. `outcomes` holds whether a probe was
/// answered with values; one that got no answer is absent and fits nothing.
pub fn fitting(profiles: &Profiles, protocol: Protocol, outcomes: &BTreeMap<Probe, bool>) -> Vec<Arc<Profile>> {
    let fits = |profile: &&Arc<Profile>| {
        profile.protocols.contains(&protocol)
            && !profile.identify.is_empty()
            && profile
                .identify
                .iter()
                .all(|e| outcomes.get(&e.probe) == Some(&e.values))
    };
    let fitting: Vec<&Arc<Profile>> = profiles.iter().filter(fits).collect();
    let most = fitting.iter().map(|p| p.identify.len()).max().unwrap_or(0);
    fitting
        .into_iter()
        .filter(|p| p.identify.len() == most)
        .cloned()
        .collect()
}

/// `[[identify]]`: `read = "holding 2100 11"`, `answer = "values"` or `"refused"`.
pub(super) fn read(reader: &Reader<'_>) -> Vec<Expected> {
    reader.tables("identify").iter().filter_map(read_one).collect()
}

fn read_one(reader: &Reader<'_>) -> Option<Expected> {
    let form = "write table, first PDU address and count, such as \"holding 2100 11\"";
    let probe = reader.parsed("read", |text| {
        let mut words = text.split(' ');
        let table = words.next().and_then(Table::from_name);
        let mut number = || words.next().and_then(super::profile::parse_address);
        match (table, number(), number()) {
            (Some(table), Some(start), Some(count)) if (1..=table.max_read()).contains(&count) => {
                Ok(Probe { table, start, count })
            }
            _ => Err(format!("`{text}` is no read; {form}")),
        }
    });
    if !reader.has("read") {
        reader.problem("read", format!("`read` is missing; {form}"));
    }
    let values = reader.parsed("answer", |text| match text {
        "values" => Ok(true),
        "refused" => Ok(false),
        other => Err(format!("unknown answer `{other}`; write \"values\" or \"refused\"")),
    });
    reader.finish();
    Some(Expected {
        probe: probe?,
        values: values.unwrap_or(true),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn profiles() -> Profiles {
        let mut profiles = Profiles::default();
        let one = |name: &str, identify: &str| {
            let text = format!(
                "name = \"{name}\"\nprotocols = [\"modbus-rtu\"]\n{identify}\n[[range]]\ntable = \"holding\"\n\
                 first = 0\nlast = 9\n[[point]]\nname = \"a\"\nat = \"holding 0\"\n"
            );
            Profile::parse("p.toml", &text, false).unwrap()
        };
        let expect = |read: &str, answer: &str| format!("[[identify]]\nread = \"{read}\"\nanswer = \"{answer}\"\n");
        profiles.insert(one("plain", &expect("holding 0 1", "values")));
        profiles.insert(one(
            "special",
            &(expect("holding 0 1", "values") + &expect("coil 0x10 2", "refused")),
        ));
        profiles.insert(one("silent", ""));
        profiles
    }

    #[test]
    fn the_profile_that_says_most_wins() {
        let profiles = profiles();
        let [coil, holding] = probes(&profiles, Protocol::ModbusRtu)[..] else {
            panic!()
        };
        assert_eq!((coil.table, coil.start, coil.count), (Table::Coil, 16, 2));
        let names = |outcomes: &[(Probe, bool)]| -> Vec<String> {
            let outcomes = outcomes.iter().copied().collect();
            let fitting = fitting(&profiles, Protocol::ModbusRtu, &outcomes);
            fitting.iter().map(|p| p.name.clone()).collect()
        };
        assert_eq!(names(&[(holding, true), (coil, false)]), ["special"]);
        assert_eq!(names(&[(holding, true), (coil, true)]), ["plain"]);
        assert_eq!(names(&[(holding, true)]), ["plain"], "no answer to the other");
        assert!(names(&[(holding, false), (coil, false)]).is_empty());
        assert!(fitting(&profiles, Protocol::N2, &BTreeMap::from([(holding, true)])).is_empty());
    }

    #[test]
    fn mistakes_are_told() {
        let text = "name = \"p\"\nprotocols = [\"modbus-rtu\"]\n[[identify]]\nread = \"holding x\"\nanswer = \"yes\"\n\
            [[identify]]\nanswer = \"values\"\n[[range]]\ntable = \"holding\"\nfirst = 0\nlast = 9\n\
            [[point]]\nname = \"a\"\nat = \"holding 0\"\n";
        let found = Profile::parse("p.toml", text, false).unwrap_err();
        let all: Vec<String> = found.iter().map(ToString::to_string).collect();
        let all = all.join("\n");
        for wanted in [
            "p.toml:4, identify[0].read",
            "p.toml:5, identify[0].answer",
            "identify[1].read",
        ] {
            assert!(all.contains(wanted), "{wanted} is missing in\n{all}");
        }
    }
}
