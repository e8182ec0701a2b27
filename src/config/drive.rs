//! `[[bus.drive]]`: one drive, checked against its profile.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Duration;

use super::values;
use crate::cache::{Access, DriveSpec, LeaseAction, OnShutdown, Supervision};
use crate::codec::Protocol;
use crate::document::{Place, Raw as Node, Reader, nearest};
use crate::drive::model::Kind;
use crate::drive::profile::Profiles;
use crate::drive::{ModelPoint, Plan, PlannedRead, Point, PollClass, Profile, Value};

/// Words of `access`.
pub(super) const ACCESS: [(&str, Access); 2] = [("monitor", Access::Monitor), ("control", Access::Control)];
/// Words of `on_shutdown`.
pub(super) const ON_SHUTDOWN: [(&str, OnShutdown); 2] = [("hold", OnShutdown::Hold), ("stop", OnShutdown::Stop)];
/// Words of `supervision.action`.
pub(super) const ACTIONS: [(&str, LeaseAction); 2] = [("stop", LeaseAction::Stop), ("hold", LeaseAction::Hold)];
/// Units of Modbus TCP that a drive can have; 255 is the gateway itself.
pub(super) const UNITS: RangeInclusive<u8> = 1..=254;
/// Addresses on a Modbus line; 0 is broadcast.
pub(super) const ADDRESSES: RangeInclusive<u8> = 1..=247;
/// Addresses on a line of N2; each family has its own range within.
pub(super) const N2_ADDRESSES: RangeInclusive<u8> = 1..=255;
/// Points that a message names.
const MOST_NAMED: usize = 4;
/// Most that a frequency of `frequency_range` can be, Hz.
pub(super) const MOST_HERTZ: f64 = 10_000.0;

const TURNAROUND: RangeInclusive<Duration> = Duration::ZERO..=Duration::from_secs(1);
const LEASE: RangeInclusive<Duration> = Duration::from_millis(50)..=Duration::from_secs(3600);

/// What is known of a drive even when a part of it is wrong.
pub(super) struct Found {
    pub(super) name: Option<(String, Place)>,
    pub(super) address: Option<(u8, Place)>,
    pub(super) unit: Option<(u8, Place)>,
    pub(super) access: (Access, Place),
    /// Where `supervision` and a stop `on_shutdown` are written.
    pub(super) lease: Option<Place>,
    pub(super) shutdown_stop: Option<Place>,
    pub(super) spec: Option<DriveSpec>,
}

/// What a drive takes from its surroundings.
pub(super) struct Surroundings<'a> {
    pub(super) bus: &'a str,
    pub(super) protocol: Protocol,
    pub(super) profiles: &'a Profiles,
    pub(super) profiles_broken: bool,
}

pub(super) fn read(reader: &Reader<'_>, around: &Surroundings<'_>) -> Found {
    let name = values::name(reader, "-_");
    let address = read_address(reader, around.protocol);
    let unit = read_unit(reader, address);
    let profile = read_profile(reader, around, address);
    let access = values::choice(reader, "access", Access::Monitor, &ACCESS);
    let frequency_range = reader
        .has("frequency_range")
        .then(|| read_frequencies(reader))
        .flatten();
    let limits = read_limits(reader, profile.as_deref(), frequency_range.as_ref());
    let supervision = read_supervision(reader, profile.as_deref(), &limits);
    let on_shutdown = values::choice(reader, "on_shutdown", OnShutdown::Hold, &ON_SHUTDOWN);
    let turnaround = values::optional_duration(reader, "turnaround", &TURNAROUND);
    reader.finish();
    let spec = match (&name, address, unit, profile) {
        (Some((name, _)), Some(address), Some(unit), Some(profile)) => Some(DriveSpec {
            name: name.clone(),
            bus: around.bus.to_string(),
            address,
            unit,
            turnaround: turnaround.unwrap_or(profile.turnaround),
            profile,
            access,
            limits,
            supervision,
            on_shutdown,
            frequency_range,
        }),
        _ => None,
    };
    Found {
        name,
        address: address.map(|a| (a, reader.place_of("address"))),
        unit: unit.map(|u| (u, reader.place_of("unit"))),
        access: (access, reader.place_of("access")),
        lease: reader.has("supervision").then(|| reader.place_of("supervision")),
        shutdown_stop: (on_shutdown == OnShutdown::Stop).then(|| reader.place_of("on_shutdown")),
        spec,
    }
}

/// Addresses that a drive can have on a line of that protocol.
pub(crate) fn addresses(protocol: Protocol) -> RangeInclusive<u8> {
    match protocol {
        Protocol::ModbusRtu | Protocol::ModbusAscii => ADDRESSES,
        Protocol::N2 => N2_ADDRESSES,
    }
}

fn read_address(reader: &Reader<'_>, protocol: Protocol) -> Option<u8> {
    let allowed = addresses(protocol);
    let most = *allowed.end();
    if !reader.has("address") {
        reader.problem(
            "address",
            format!("`address` is missing; write the drive's address, 1 to {most}"),
        );
    }
    let address: i64 = reader.optional("address")?;
    let found = u8::try_from(address).ok().filter(|a| allowed.contains(a));
    if found.is_none() {
        let what = match address {
            0 => "address 0 is the broadcast, not a drive".to_string(),
            _ => format!("{address} is no address of the protocol"),
        };
        reader.problem("address", format!("{what}; write 1 to {most}"));
    }
    found
}

/// The unit id; without one the address serves.
fn read_unit(reader: &Reader<'_>, address: Option<u8>) -> Option<u8> {
    if !reader.has("unit") {
        if let Some(address) = address.filter(|address| !UNITS.contains(address)) {
            reader.problem(
                "address",
                format!("unit {address} is the gateway itself, so the drive needs another one; add `unit`, 1 to 254"),
            );
        }
        return address;
    }
    let unit: i64 = reader.optional("unit")?;
    let found = u8::try_from(unit).ok().filter(|u| UNITS.contains(u));
    if found.is_none() {
        let what = match unit {
            255 => "unit 255 is the gateway itself".to_string(),
            _ => format!("{unit} is no unit of a drive"),
        };
        reader.problem("unit", format!("{what}; write 1 to 254"));
    }
    found
}

fn read_profile(reader: &Reader<'_>, around: &Surroundings<'_>, address: Option<u8>) -> Option<Arc<Profile>> {
    let name: String = reader.required("profile")?;
    let Some(profile) = around.profiles.get(&name) else {
        reader.problem(
            "profile",
            unknown_profile(&name, around.profiles, around.profiles_broken),
        );
        return None;
    };
    if !profile.protocols.contains(&around.protocol) {
        let spoken: Vec<&str> = profile.protocols.iter().map(|p| p.name()).collect();
        reader.problem(
            "profile",
            format!(
                "profile `{name}` speaks {}, the bus {}; use another profile or put the drive on another bus",
                spoken.join(", "),
                around.protocol.name()
            ),
        );
    }
    if let Some(address) = address.filter(|a| !profile.addresses.contains(a)) {
        let (least, most) = profile.addresses.clone().into_inner();
        reader.problem(
            "address",
            format!("a drive of profile `{name}` cannot have address {address}; write {least} to {most}"),
        );
    }
    let polled = |read: &PlannedRead| matches!(read.class, PollClass::Fast | PollClass::Slow);
    if !Plan::of(profile).reads.iter().any(polled) {
        reader.problem(
            "profile",
            format!(
                "profile `{name}` has no point that is polled, so nobody could tell whether the drive answers; give a point of \
                 it class = \"fast\" or \"slow\""
            ),
        );
    }
    Some(profile.clone())
}

/// ``unknown profile `x`; did you mean `y`? Known: …``.
pub(crate) fn unknown_profile(name: &str, profiles: &Profiles, some_broken: bool) -> String {
    let near = match nearest(name, profiles.names()) {
        Some(near) => format!("did you mean `{near}`? "),
        None => String::new(),
    };
    let known: Vec<&str> = profiles.names().collect();
    let broken = if some_broken {
        ", besides those of profile_dirs that have errors"
    } else {
        ""
    };
    format!("unknown profile `{name}`; {near}known are {}{broken}", known.join(", "))
}

fn read_frequencies(reader: &Reader<'_>) -> Option<RangeInclusive<f64>> {
    let pair: Vec<f64> = reader.optional("frequency_range")?;
    match pair.as_slice() {
        [low, high] if *low >= 0.0 && low < high && *high <= MOST_HERTZ => Some(*low..=*high),
        _ => {
            reader.problem(
                "frequency_range",
                format!(
                    "that is no range of frequencies in Hz; write [minimum, maximum] between 0 and \
                 {MOST_HERTZ}, the lower one first"
                ),
            );
            None
        }
    }
}

fn read_limits(
    reader: &Reader<'_>,
    profile: Option<&Profile>,
    frequencies: Option<&RangeInclusive<f64>>,
) -> BTreeMap<String, RangeInclusive<f64>> {
    let mut limits = BTreeMap::new();
    let Some(table) = reader.table("limits") else {
        return limits;
    };
    for key in table.keys() {
        let pair: Option<Vec<f64>> = table.optional(key);
        let checked = pair.and_then(|pair| {
            check_limits(&pair, key, profile, frequencies)
                .map_err(|m| table.problem(key, m))
                .ok()
        });
        if let Some(range) = checked {
            limits.insert(key.to_string(), range);
        }
    }
    table.finish();
    limits
}

fn check_limits(
    pair: &[f64],
    key: &str,
    profile: Option<&Profile>,
    frequencies: Option<&RangeInclusive<f64>>,
) -> Result<RangeInclusive<f64>, String> {
    let point = profile.map(|profile| limited_point(profile, key)).transpose()?;
    let range = match pair {
        [low, high] if low <= high => *low..=*high,
        [low, high] => {
            return Err(format!(
                "the limits {low} and {high} are the wrong way round; write [{high}, {low}]"
            ));
        }
        _ => return Err("limits are two numbers; write [lowest, highest]".to_string()),
    };
    let Some(point) = point else { return Ok(range) };
    let own = match point.model {
        Some(ModelPoint::FrequencyReference) => point.range.as_ref().or(frequencies),
        _ => point.range.as_ref(),
    };
    if let Some(own) = own.filter(|own| !own.contains(range.start()) || !own.contains(range.end())) {
        let (low, high) = own.clone().into_inner();
        return Err(format!(
            "the limits of `{key}` go beyond the drive's own range; write [lowest, highest] within {low} and {high} {}",
            point.unit
        ));
    }
    for bound in [*range.start(), *range.end()] {
        if let Some(Err(why)) = point.raw().map(|raw| raw.encode(Value::Number(bound), 0)) {
            return Err(format!("{why}; write limits that the register can hold"));
        }
    }
    Ok(range)
}

/// The point that limits can be set for.
fn limited_point<'p>(profile: &'p Profile, key: &str) -> Result<&'p Point, String> {
    let writable = || {
        profile
            .points
            .iter()
            .filter(|p| p.write && p.kind() != Kind::Bool)
            .map(|p| p.name.as_str())
    };
    let known = || {
        let first = writable().take(MOST_NAMED).collect::<Vec<_>>().join(", ");
        match writable().count().saturating_sub(MOST_NAMED) {
            0 => first,
            more => format!(
                "{first} and {more} more, see `drivegate profiles show {}`",
                profile.name
            ),
        }
    };
    let Some(point) = profile.point_index(key).and_then(|i| profile.points.get(i)) else {
        let near = nearest(key, writable()).map_or_else(
            || format!("limits can be set for {}", known()),
            |near| format!("did you mean `{near}`?"),
        );
        return Err(format!("profile `{}` has no point `{key}`; {near}", profile.name));
    };
    if !point.write {
        return Err(format!(
            "`{key}` cannot be written, so it has no limits; limits can be set for {}",
            known()
        ));
    }
    if point.kind() == Kind::Bool {
        return Err(format!(
            "`{key}` is true or false, so it has no limits; limits can be set for {}",
            known()
        ));
    }
    Ok(point)
}

fn read_supervision(
    reader: &Reader<'_>,
    profile: Option<&Profile>,
    limits: &BTreeMap<String, RangeInclusive<f64>>,
) -> Option<Supervision> {
    let table = reader.table("supervision")?;
    if !table.has("timeout") {
        table.problem("timeout", "`timeout` is missing; write a duration such as \"5s\"");
    }
    let timeout = values::optional_duration(&table, "timeout", &LEASE);
    let action = read_action(&table, profile, limits);
    let adopt = table.or("adopt", false);
    table.finish();
    if let Some(profile) = profile.filter(|profile| !tells_whether_it_runs(profile)) {
        reader.problem(
            "supervision",
            format!(
                "profile `{}` has neither `running` nor a run command that is read, so nobody could tell whether a drive whose \
                 lease ran out is to be stopped; add one of them to the profile, or leave supervision out",
                profile.name
            ),
        );
    }
    Some(Supervision {
        timeout: timeout?,
        action: action?,
        adopt,
    })
}

/// Whether drives of that profile tell that they run, or at least that they were told to.
fn tells_whether_it_runs(profile: &Profile) -> bool {
    let plan = Plan::of(profile);
    let is_told = |point| {
        profile
            .model_index(point)
            .is_some_and(|index| plan.tells(profile, index))
    };
    is_told(ModelPoint::Running) || is_told(ModelPoint::Run)
}

fn read_action(
    table: &Reader<'_>,
    profile: Option<&Profile>,
    limits: &BTreeMap<String, RangeInclusive<f64>>,
) -> Option<LeaseAction> {
    let action = match table.raw("action").map(|node| &node.value) {
        None => LeaseAction::Stop,
        Some(Node::Table(_)) => {
            let inner = table.table("action")?;
            let reference: Option<f64> = inner.required("speed_reference");
            inner.finish();
            LeaseAction::SpeedReference(reference?)
        }
        Some(_) => table.parsed("action", |text| {
            let known = ACTIONS.into_iter().find(|(word, _)| *word == text);
            known.map(|(_, action)| action).ok_or_else(|| {
                format!("unknown action `{text}`; write \"stop\", \"hold\" or {{ speed_reference = 20.0 }}")
            })
        })?,
    };
    let Some(profile) = profile else { return Some(action) };
    match check_action(&action, profile, limits) {
        Ok(()) => Some(action),
        Err(message) => {
            table.problem("action", message);
            None
        }
    }
}

fn check_action(
    action: &LeaseAction,
    profile: &Profile,
    limits: &BTreeMap<String, RangeInclusive<f64>>,
) -> Result<(), String> {
    let needed = match action {
        LeaseAction::Hold => return Ok(()),
        LeaseAction::Stop => ModelPoint::Run,
        LeaseAction::SpeedReference(_) => ModelPoint::SpeedReference,
    };
    let Some(point) = profile.model_point(needed).filter(|p| p.write) else {
        return Err(format!(
            "profile `{}` cannot write `{}`; use \"hold\" or another action",
            profile.name,
            needed.name()
        ));
    };
    let LeaseAction::SpeedReference(reference) = action else {
        return Ok(());
    };
    let range = limits.get(&point.name).or(point.range.as_ref());
    match range.filter(|range| !range.contains(reference)) {
        Some(range) => Err(format!(
            "speed_reference = {reference} is outside the limits; write {} to {} percent",
            range.start(),
            range.end()
        )),
        None => Ok(()),
    }
}
