//! Reads `derive`: points derived from other points.

use super::super::derive::{Bound, Derived};
use super::super::model::Kind;
use super::super::profile::{Point, PollClass, Source};
use crate::document::{self, Finding, Reader};
use crate::drive::{PerPoint, Plan, PlannedRead, PointIndex, Profile};
use drivegate_proto::Table;

/// Value of `maximum` for a band that only the configuration of a drive defines: its key there.
const CONFIGURED: &str = "frequency_range";

pub(super) fn read_derived(reader: &Reader<'_>, names: &[String]) -> Option<Source> {
    const KNOWN: [&str; 7] = ["band", "percent", "zero", "equal", "all", "sum", "lowest_bit"];
    let kind = reader.parsed("derive", |text| {
        let known = KNOWN.into_iter().find(|known| *known == text);
        known.ok_or_else(|| {
            Finding::new(
                format!("unknown derivation `{text}`"),
                format!("known: {}", KNOWN.join(", ")),
            )
        })
    })?;
    let index = |key: &str, name: &str| point_of(reader, key, name, names);
    let other = |key: &str| -> Option<PointIndex> { index(key, &reader.required::<String>(key)?) };
    let within = |default: f64| reader.or("within", default);
    let derived = match kind {
        "band" | "percent" => {
            let (of, minimum, maximum) = (
                other("of"),
                read_bound(reader, "minimum", names, Some(Bound::Fixed(0.0))),
                read_bound(reader, "maximum", names, None),
            );
            let (of, minimum, maximum) = (of?, minimum?, maximum?);
            if kind == "band" {
                Derived::Band { of, minimum, maximum }
            } else {
                Derived::Percent { of, minimum, maximum }
            }
        }
        "zero" => Derived::Zero {
            of: other("of")?,
            within: within(0.0),
        },
        "equal" => {
            let (of, to) = (other("of"), other("to"));
            Derived::Equal {
                of: of?,
                to: to?,
                within: within(0.0),
            }
        }
        "all" => {
            let all: Vec<String> = reader.required("of")?;
            let of: Option<Vec<PointIndex>> = all.iter().map(|name| index("of", name)).collect();
            Derived::All { of: of? }
        }
        "sum" => read_sum(reader, names)?,
        _ => Derived::LowestBit { of: other("of")? },
    };
    Some(Source::Derived(derived))
}

/// Reads `of` and `weights` of a sum.
fn read_sum(reader: &Reader<'_>, names: &[String]) -> Option<Derived> {
    let weights: Option<Vec<f64>> = reader.optional("weights");
    let all: Vec<String> = reader.required("of")?;
    let of: Option<Vec<PointIndex>> = all.iter().map(|name| point_of(reader, "of", name, names)).collect();
    let weights = weights.unwrap_or_else(|| vec![1.0; all.len()]);
    if all.len() < 2 {
        reader.problem("of", "a sum has two parts at least", "name the points in a list");
    }
    if weights.len() != all.len() {
        reader.problem(
            "weights",
            format!("{} weights for {} points", weights.len(), all.len()),
            "write one for each, or leave the key out",
        );
        return None;
    }
    Some(Derived::Sum { of: of?, weights })
}

/// Checks that one request of the plan reads all parts of each sum.
pub(super) fn check_sums(tables: &[Reader<'_>], profile: &Profile) {
    let plan = Plan::of(profile);
    for ((_, point), table) in profile.points.enumerate().zip(tables) {
        let Source::Derived(Derived::Sum { of, .. }) = &point.source else {
            continue;
        };
        let places = of.iter().filter_map(|of| profile.points.get(*of)?.raw());
        let places: Vec<(Table, u16)> = places
            .flat_map(|raw| raw.addresses().map(|address| (raw.table, address)))
            .collect();
        let brings_all = |read: &PlannedRead| places.iter().all(|(table, address)| read.covers(*table, *address));
        if !plan.reads.iter().any(brings_all) {
            table.problem(
                "of",
                format!(
                    "no single request reads all parts of `{}`, so they are not of one moment",
                    point.name
                ),
                "give the parts one class, and their registers one [[range]] that is read at once",
            );
        }
    }
}

pub(super) fn point_of(reader: &Reader<'_>, key: &str, name: &str, names: &[String]) -> Option<PointIndex> {
    let index = names.iter().position(|n| n == name).map(PointIndex::new);
    if index.is_none() {
        let near = document::nearest(name, names.iter().map(String::as_str));
        let remedy = near.map_or_else(
            || "name a point of this profile".to_string(),
            |n| format!("did you mean `{n}`?"),
        );
        reader.problem(key, format!("there is no point `{name}`"), remedy);
    }
    index
}

/// The end of a band: the name of a point, or a number.
fn read_bound(reader: &Reader<'_>, key: &str, names: &[String], default: Option<Bound>) -> Option<Bound> {
    match reader.raw(key).map(|node| &node.value) {
        None if default.is_some() => default,
        Some(document::Raw::Float(_) | document::Raw::Integer(_)) => reader.optional(key).map(Bound::Fixed),
        _ => {
            let name: String = reader.required(key)?;
            if key == "maximum" && name == CONFIGURED {
                return Some(Bound::Configured);
            }
            point_of(reader, key, &name, names).map(Bound::Point)
        }
    }
}

/// Makes sure that the ends of bands are polled: they convert and limit commands, and can be changed at the drive.
pub(super) fn keep_ends_fresh(points: &mut PerPoint<Point>) {
    let ends: Vec<PointIndex> = points
        .iter()
        .filter_map(|point| match &point.source {
            Source::Derived(derived) => Some(derived.ends()),
            Source::Raw(_) => None,
        })
        .flatten()
        .collect();
    for end in ends {
        if let Some(point) = points.get_mut(end).filter(|p| p.class == PollClass::Once) {
            point.class = PollClass::Slow;
        }
    }
}

/// Checks that a derived point is made of points that are read from the drive.
pub(super) fn check_derived(reader: &Reader<'_>, index: PointIndex, points: &PerPoint<Point>) {
    let Some(Source::Derived(derived)) = points.get(index).map(|p| &p.source) else {
        return;
    };
    for source in derived.rests_on() {
        if let Some(point) = points.get(source).filter(|p| p.kind() == Kind::Text) {
            reader.problem(
                "derive",
                format!("`{}` is a text", point.name),
                "name points with values",
            );
        }
        if let Some(point) = points.get(source).filter(|p| p.raw().is_none()) {
            reader.problem(
                "derive",
                format!("`{}` is derived itself", point.name),
                "name points that have `at`",
            );
        }
        if let Some(point) = points
            .get(source)
            .filter(|p| p.raw().is_some() && p.class == PollClass::Never)
        {
            reader.problem(
                "derive",
                format!("`{}` is never read", point.name),
                "give it another class",
            );
        }
    }
}
