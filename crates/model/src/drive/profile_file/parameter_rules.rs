//! The keys of `[parameters]` about writing parameters back: `only_by_name`, `nameplate`, `ratings`, `volatile`, `limits`, `save`,
//! `lock`, `note`. A parameter is named by its id, several by `FIRST..LAST`.

use crate::drive::PerPoint;
use std::ops::RangeInclusive;

use super::super::model::Kind;
use super::super::parameters::{Addresses, Limit, Lock, ParameterList, WriteRules};
use super::super::profile::{AddressRange, Point};
use super::place::parse_address;
use crate::document::{Reader, nearest};
use drivegate_proto::Table;

/// Reads the rules of `table`; the parameters in them are those of `list` and, in parts that come from a base, also
/// those of `bases`.
pub(super) fn read(
    table: &Reader<'_>,
    list: &ParameterList,
    bases: &[&ParameterList],
    points: &PerPoint<Point>,
    ranges: &[AddressRange],
) -> WriteRules {
    let rules = Rules { table, list, bases };
    WriteRules {
        only_by_name: rules.only_by_name(),
        nameplate: rules.addresses("nameplate"),
        ratings: rules.addresses("ratings"),
        volatile: rules.addresses("volatile"),
        limits: rules.limits(),
        save: read_save(table, ranges),
        lock: read_lock(table, &rules, points),
        note: table.or("note", String::new()),
    }
}

/// Whether the key is that of the base.
fn is_inherited(table: &Reader<'_>, key: &str) -> bool {
    table.place_of(key).env.is_some()
}

/// A table whose keys are parameter names.
struct Rules<'a, 'd> {
    table: &'a Reader<'d>,
    list: &'a ParameterList,
    /// Parameters of the base, of the base's base, and so on.
    bases: &'a [&'a ParameterList],
}

impl Rules<'_, '_> {
    fn only_by_name(&self) -> Vec<(RangeInclusive<u16>, String)> {
        const KEY: &str = "only_by_name";
        let rows: Vec<String> = self.table.or(KEY, Vec::new());
        let read = rows.iter().filter_map(|row| {
            let (ids, why) = row.split_once(',').unwrap_or((row, ""));
            if why.trim().is_empty() {
                let what = format!("`{row}` does not say why");
                self.table
                    .problem(KEY, what, "write \"id, reason\", such as \"Sn-23, station address\"");
                return None;
            }
            Some((self.span(KEY, ids)?, why.trim().to_string()))
        });
        read.collect()
    }

    fn addresses(&self, key: &str) -> Addresses {
        let ids: Vec<String> = self.table.or(key, Vec::new());
        ids.iter().filter_map(|ids| self.span(key, ids)).collect()
    }

    /// Parses a span such as `Cn-02` or `On-20..On-24`.
    fn span(&self, key: &str, ids: &str) -> Option<RangeInclusive<u16>> {
        let (first, last) = ids.split_once("..").unwrap_or((ids, ids));
        let (first, last) = (self.address(key, first)?, self.address(key, last)?);
        if first > last {
            let what = format!("`{}` ends before it begins", ids.trim());
            self.table
                .problem(key, what, "write the one with the lower address first");
            return None;
        }
        Some(first..=last)
    }

    fn address(&self, key: &str, id: &str) -> Option<u16> {
        let id = id.trim();
        let of_bases = || {
            // A profile with its own list keeps the addresses of its base.
            let bases = self.bases.iter().filter(|_| is_inherited(self.table, key));
            bases.filter_map(|base| base.address(id)).next()
        };
        let address = self.list.address(id).or_else(of_bases);
        if address.is_none() {
            let named = self.list.named.iter().map(|parameter| parameter.id.as_str());
            let near = nearest(id, named).map(|near| format!("did you mean `{near}`?"));
            let remedy = near.unwrap_or_else(|| "name one of `list`, or one that lies in `spans`".to_string());
            self.table.problem(key, format!("there is no parameter `{id}`"), remedy);
        }
        address
    }

    fn limits(&self) -> Vec<Limit> {
        const KEY: &str = "limits";
        let rows: Vec<String> = self.table.or(KEY, Vec::new());
        let read = rows.iter().filter_map(|row| {
            let Some((upper, lower)) = row.split_once(">=") else {
                let what = format!("`{row}` is not a limit");
                self.table.problem(KEY, what, "write for example \"Cn-14 >= Cn-15\"");
                return None;
            };
            let limit = Limit {
                upper: self.address(KEY, upper)?,
                lower: self.address(KEY, lower)?,
            };
            let label = |address| {
                self.list
                    .by_address(address)
                    .map(|parameter| (&parameter.label.unit, parameter.label.scale))
            };
            if label(limit.upper) != label(limit.lower) {
                if !is_inherited(self.table, KEY) {
                    let what = format!("the parameters of `{row}` differ in unit or scale");
                    self.table
                        .problem(KEY, what, "limit parameters whose counts can be compared");
                }
                return None;
            }
            Some(limit)
        });
        let limits: Vec<Limit> = read.collect();
        if let Some(limit) = in_circle(&limits) {
            let id = self.list.id(limit.upper).unwrap_or_default();
            let what = format!("the limits of `{id}` are circular");
            self.table.problem(KEY, what, "leave one of them out");
        }
        limits
    }
}

/// A limit that is part of a circle; `None` if there is none.
fn in_circle(limits: &[Limit]) -> Option<Limit> {
    let mut left = limits.to_vec();
    // A limit with nothing below it or nothing above it is not part of a circle; removing such limits repeatedly
    // leaves only circles.
    loop {
        let (uppers, lowers): (Vec<u16>, Vec<u16>) = left.iter().map(|limit| (limit.upper, limit.lower)).unzip();
        let before = left.len();
        left.retain(|limit| uppers.contains(&limit.lower) && lowers.contains(&limit.upper));
        if left.len() == before {
            return left.first().copied();
        }
    }
}

/// `save = "0x0900 = 0"`.
fn read_save(table: &Reader<'_>, ranges: &[AddressRange]) -> Option<(u16, u16)> {
    let text: String = table.optional("save")?;
    let save = text
        .split_once('=')
        .and_then(|(address, value)| Some((parse_address(address.trim())?, parse_address(value.trim())?)));
    let Some((address, value)) = save else {
        table.problem(
            "save",
            format!("`{text}` is not a write"),
            "write for example \"0x0900 = 0\"",
        );
        return None;
    };
    let range = ranges
        .iter()
        .find(|range| range.table == Table::Holding && range.addresses.contains(&address));
    if range.is_none_or(|range| range.write == 0) {
        if !is_inherited(table, "save") {
            let what = format!("holding {address} cannot be written");
            table.problem("save", what, "name a register that lies in a [[range]] with `write`");
        }
        return None;
    }
    Some((address, value))
}

/// `[parameters.lock]`: parameters that the drive takes in one mode only.
fn read_lock(parent: &Reader<'_>, rules: &Rules<'_, '_>, points: &PerPoint<Point>) -> Option<Lock> {
    let table = parent.table("lock")?;
    let rules = Rules {
        table: &table,
        ..*rules
    };
    let of = rules.addresses("of");
    if of.is_empty() {
        table.problem(
            "of",
            "no parameter is named",
            "name parameters, such as [\"Sn-01..Sn-38\"]",
        );
    }
    let name: Option<String> = table.required("while");
    let exception = table.optional("exception");
    let remedy: Option<String> = table.required("remedy");
    table.finish();
    let name = name?;
    let is_it = |point: &Point| point.name == name && point.kind() == Kind::Bool;
    let Some(point) = points.position(is_it) else {
        let states = points.iter().filter(|point| point.kind() == Kind::Bool);
        let near = nearest(&name, states.map(|point| point.name.as_str()));
        let near = near.map(|near| format!("did you mean `{near}`?"));
        let remedy = near.unwrap_or_else(|| "name a point of the profile that is true or false".to_string());
        if !is_inherited(&table, "while") {
            table.problem("while", format!("there is no state `{name}`"), remedy);
        }
        return None;
    };
    Some(Lock {
        of,
        point,
        exception,
        remedy: remedy?,
    })
}

#[cfg(test)]
mod tests {
    use super::super::super::Profile;
    use super::super::super::parameters::Limit;

    /// A drive with three parameters and a state; more keys of `[parameters]` from line 19 on.
    const HEAD: &str = r#"
name = "p"
protocols = ["modbus-rtu"]
[[range]]
table = "holding"
first = 0
last = 99
write = 1
[[range]]
table = "holding"
first = 100
last = 199
[[point]]
name = "ready"
at = "holding 1.0"
[parameters]
spans = ["id 0 49"]
list = ["A-1, 50, Upper, Hz, 0.1, 0, 50", "A-2, 51, Lower, Hz, 0.1", "A-3, 52, Other, s, 0.1"]
"#;

    fn read(keys: &str) -> Result<Profile, String> {
        let profile = Profile::parse("p.toml", &format!("{HEAD}{keys}"), false);
        profile.map_err(|found| found.iter().map(|problem| format!("{problem}\n")).collect())
    }

    #[test]
    fn rules() {
        let profile = read(
            "only_by_name = [\"A-3, address\", \"7..9 , speed, and format\"]\nnameplate = [\"1\"]\nratings = [\"2\"]\nvolatile = [\"A-2..A-3\"]\n\
             limits = [\"A-1 >= A-2\", \"3 >= 4\"]\nsave = \"0x10 = 1\"\nnote = \"n\"\n\
             [parameters.lock]\nof = [\"5..6\", \"A-1\"]\nwhile = \"ready\"\nexception = 0x22\nremedy = \"switch\"\n",
        )
        .unwrap();
        let rules = &profile.parameters.rules;
        let held_back = [0, 1, 5, 6, 8, 9, 52].map(|address| rules.held_back(address));
        assert_eq!(
            held_back,
            [
                Some("it describes the drive itself"),
                None,
                None,
                Some("speed, and format"),
                Some("speed, and format"),
                None,
                Some("address")
            ]
        );
        assert_eq!((&rules.ratings, &rules.volatile), (&vec![1..=1], &vec![51..=52]));
        let limits = [(50, 51), (2, 3)].map(|(upper, lower)| Limit { upper, lower });
        assert_eq!(
            (rules.limits.as_slice(), rules.save),
            (limits.as_slice(), Some((16, 1)))
        );
        let lock = rules.lock.as_ref().unwrap();
        assert_eq!(
            (&lock.of, lock.point, lock.exception),
            (&vec![4..=5, 50..=50], crate::drive::PointIndex::new(0), Some(0x22))
        );
        assert_eq!(profile.parameters.by_address(50).unwrap().range, Some(0.0..=50.0));
        assert_eq!(read("").unwrap().parameters.rules, Default::default());
    }

    #[test]
    fn rules_of_the_base_hold_for_what_is_left_of_it() {
        let keys = "name = \"p\"\nbase = \"teco-7300pa\"\n[parameters]\nlist = [\"Cn-14, 0x020D, Upper, %, 1\", \
                    \"Cn-15, 0x020E, Lower, %, 0.1\", \"Sn-23, 0x0117, Address, , 1\"]\n";
        let profile = Profile::parse("p.toml", keys, false).unwrap();
        let rules = &profile.parameters.rules;
        assert_eq!(rules.held_back(0x0117), Some("station address"));
        assert_eq!(rules.held_back(0x0105), Some("source of run command and reference"));
        assert_eq!(rules.lock.as_ref().map(|lock| lock.of.len()), Some(3));
        assert_eq!(
            (rules.limits.len(), rules.ratings.len(), rules.save),
            (6, 3, Some((0x0900, 0)))
        );
        let keys = keys.replace("[parameters]", "remove = [\"ready\"]\n[parameters]");
        let profile = Profile::parse("p.toml", &keys, false).unwrap();
        assert_eq!(profile.parameters.rules.lock, None);
        let own = format!("{keys}ratings = [\"Cn-09\"]\n");
        let found = Profile::parse("p.toml", &own, false).unwrap_err();
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(
            found[0].to_string().contains("p.toml:6, parameters.ratings"),
            "{}",
            found[0]
        );
    }

    #[test]
    fn each_mistake() {
        let cases = [
            (
                "only_by_name = [\"A-1\"]",
                "`A-1` does not say why; p.toml:19, parameters.only_by_name",
            ),
            (
                "nameplate = [\"A-9\"]",
                "there is no parameter `A-9`; p.toml:19, parameters.nameplate; did you mean `A-1`?",
            ),
            (
                "ratings = [\"77\"]",
                "there is no parameter `77`; p.toml:19, parameters.ratings; name one of `list`",
            ),
            (
                "volatile = [\"A-2..A-1\"]",
                "`A-2..A-1` ends before it begins; p.toml:19, parameters.volatile",
            ),
            (
                "limits = [\"A-1 > A-2\"]",
                "`A-1 > A-2` is not a limit; p.toml:19, parameters.limits",
            ),
            (
                "limits = [\"A-1 >= A-3\"]",
                "`A-1 >= A-3` differ in unit or scale; p.toml:19, parameters.limits",
            ),
            (
                "limits = [\"1 >= 2\", \"2 >= 3\", \"3 >= 4\", \"4 >= 2\"]",
                "the limits of `2` are circular; p.toml:19, parameters.limits",
            ),
            ("limits = [\"1 >= 1\"]", "the limits of `1` are circular"),
            ("save = \"16\"", "`16` is not a write; p.toml:19, parameters.save"),
            (
                "save = \"150 = 1\"",
                "holding 150 cannot be written; p.toml:19, parameters.save",
            ),
            (
                "[parameters.lock]\nof = [\"1\"]\nwhile = \"redy\"\nremedy = \"x\"",
                "there is no state `redy`; p.toml:21, parameters.lock.while; did you mean `ready`?",
            ),
            (
                "[parameters.lock]\nwhile = \"ready\"\nremedy = \"x\"",
                "no parameter is named; p.toml:19, parameters.lock.of",
            ),
            (
                "[parameters.lock]\nof = [\"1\"]\nwhile = \"ready\"",
                "parameters.lock.remedy",
            ),
        ];
        for (keys, wanted) in cases {
            let found = read(keys).unwrap_err();
            assert!(found.contains(wanted), "{keys}: {wanted} is not in\n{found}");
        }
        let rows = HEAD
            .replace("0, 50\"", "50, 0\"")
            .replace("A-3, 52, Other, s, 0.1", "A-3, 52, Other, s, 0.1, 7");
        let found: String = Profile::parse("p.toml", &rows, false)
            .unwrap_err()
            .iter()
            .map(|problem| format!("{problem}\n"))
            .collect();
        assert!(
            found.contains("`50` to `0` is not a range") && found.contains("6 fields instead of 5 or 7"),
            "{found}"
        );
        let counts = HEAD.replace("A-3, 52, Other, s, 0.1", "A-3, 52, Other, s, 0.1, 0, 9990");
        let found = Profile::parse("p.toml", &counts, false).unwrap_err();
        let wanted = "9990 s is more than a register holds at a scale of 0.1; the range is in the unit";
        assert!(
            found.iter().any(|problem| problem.to_string().contains(wanted)),
            "{found:?}"
        );
    }
}
