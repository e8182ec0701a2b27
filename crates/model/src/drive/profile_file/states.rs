//! `[[state]]`: points of the common model that are masked states of a status word.

use super::super::control::Mask;
use super::super::derive::Derived;
use super::super::model::ModelPoint;
use super::super::profile::{Point, Source};
use super::control::{Around, read_mask};
use crate::document::{Finding, Reader};

const KINDS: [ModelPoint; 6] = [
    ModelPoint::Ready,
    ModelPoint::Running,
    ModelPoint::Fault,
    ModelPoint::Warning,
    ModelPoint::AtReference,
    ModelPoint::Remote,
];

/// Reads the points that the states make, in the order of the first state of each.
pub(super) fn read(reader: &Reader<'_>, around: &Around<'_>) -> Vec<Point> {
    let mut made: Vec<Point> = Vec::new();
    let mut seen: Vec<(ModelPoint, Mask)> = Vec::new();
    for table in reader.tables("state") {
        let kind = table.parsed("is", |text| {
            let known = KINDS.into_iter().find(|kind| kind.name() == text);
            known.ok_or_else(|| {
                let names = KINDS.map(ModelPoint::name).join(", ");
                Finding::new(format!("unknown state `{text}`"), format!("known: {names}"))
            })
        });
        if !table.has("is") {
            table.problem("is", "`is` is missing", "write which state it is, such as \"running\"");
        }
        let mask = read_mask(&table, around, "value");
        table.finish();
        let (Some(kind), Some(mask)) = (kind, mask) else {
            continue;
        };
        let same = |(other, of): &&(ModelPoint, Mask)| *other != kind && *of == mask;
        if let Some((other, _)) = seen.iter().find(same) {
            table.problem(
                "value",
                format!("`{}` is the same state as `{}`", kind.name(), other.name()),
                "write the bits that distinguish the two",
            );
        }
        seen.push((kind, mask));
        match made
            .iter_mut()
            .find(|point| point.model == Some(kind))
            .map(|point| &mut point.source)
        {
            Some(Source::Derived(Derived::State { any })) => any.push(mask),
            _ => made.push(point(kind, mask, around)),
        }
    }
    made
}

fn point(kind: ModelPoint, mask: Mask, around: &Around<'_>) -> Point {
    Point {
        verified: around.points.get(mask.point).is_none_or(|point| point.verified),
        ..Point::of_model(kind, Source::Derived(Derived::State { any: vec![mask] }))
    }
}
