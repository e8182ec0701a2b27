//! The built-in profiles against the tables of the reference (reference/drives.md 13.1, 13.2, 3 to 6), written from those tables
//! and not from the profiles; and worked replies of the manuals, decoded.

mod doubts;
mod limits;
mod maps;
mod values;

use super::derive::{Bound, Derived};
use super::profile::{Form, Profiles};
use super::{ModelPoint, Plan, PollClass, Profile, Source, Step, Value};
use drivegate_proto::{Protocol, Table};

fn profile(name: &str) -> std::sync::Arc<Profile> {
    Profiles::built_in().get(name).unwrap().clone()
}

/// A point as text: `table address[.bit] x scale`, `!` for an inverted bit, `derive` for a derived point, `-` for no point.
fn place(profile: &Profile, name: &str) -> String {
    let Some(point) = profile.point_index(name).and_then(|i| profile.points.get(i)) else {
        return "-".to_string();
    };
    let raw = match &point.source {
        Source::Derived(derived) => return format!("derive {}", derived.name()),
        Source::Raw(raw) => raw,
    };
    let table = match raw.table {
        Table::Holding => "HR",
        Table::Input => "IR",
        Table::Coil => "CO",
        Table::DiscreteInput => "DI",
    };
    match raw.form {
        Form::Bit { invert, .. } if raw.table.is_bits() => {
            format!("{table} {}{}", raw.address, if invert { "!" } else { "" })
        }
        Form::Bit { bit, invert } => format!("{table} {}.{bit}{}", raw.address, if invert { "!" } else { "" }),
        _ if raw.scale == 1.0 => format!("{table} {}", raw.address),
        _ => format!("{table} {} x {}", raw.address, raw.scale),
    }
}
