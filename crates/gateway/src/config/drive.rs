//! `[[bus.drive]]`: one drive, checked against its profile.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Duration;

use super::key::{Key, Number};
use super::keys::{DRIVE, MODBUS_ADDRESSES, MOST_HERTZ, N2_ADDRESSES, RESERVED, TRIGGER, UNIT_IDS, WITH_RESERVED};
use super::start_guard::Guards;
use super::{raw_writes, start_guard, supervision};
use drivegate_core::process_image::{
    Access, DriveSpec, OnShutdown, ParamsAccess, PointTrigger, Supervision, Timing, TriggerLimit,
};
use drivegate_model::document::{Finding, Place, Raw as Node, Reader, nearest};
use drivegate_model::drive::model::Kind;
use drivegate_model::drive::profile::Profiles;
use drivegate_model::drive::{ModelPoint, Plan, PlannedRead, Point, PointIndex, PollClass, Profile, Value};
use drivegate_proto::Protocol;

/// Maximum number of points that a message names.
const MOST_NAMED: usize = 4;

/// Allowed values of points, by the name of the point.
pub(super) type Limits = BTreeMap<String, RangeInclusive<f64>>;

/// The valid settings of a `[[bus.drive]]`.
pub(super) struct Found {
    pub(super) name: Option<(String, Place)>,
    pub(super) address: Option<(u8, Place)>,
    pub(super) unit: Option<(u8, Place)>,
    /// The configuration states no unit, so the unit is the address.
    pub(super) unit_is_address: bool,
    pub(super) access: (Access, Place),
    /// Places of the keys `limits`, `supervision` and a stop `on_shutdown` in the file.
    pub(super) limits: Place,
    pub(super) lease: Option<Place>,
    pub(super) shutdown_stop: Option<Place>,
    /// Place of a configured `refresh` that is not off.
    pub(super) refresh: Option<Place>,
    pub(super) guards: Guards,
    pub(super) spec: Option<DriveSpec>,
}

/// Settings that a drive inherits from its bus and gateway.
pub(super) struct Surroundings<'a> {
    pub(super) bus: &'a str,
    pub(super) protocol: Protocol,
    pub(super) is_modbus_tcp: bool,
    pub(super) profiles: &'a Profiles,
    /// Names of the profiles in files with faults.
    pub(super) faulty: &'a BTreeSet<String>,
}

pub(super) fn read(reader: &Reader<'_>, around: &Surroundings<'_>) -> Found {
    let name = DRIVE.name.placed(reader);
    let address = Key {
        form: if around.is_modbus_tcp {
            &UNIT_IDS
        } else if is_reserved(reader) && around.protocol != Protocol::N2 {
            &WITH_RESERVED
        } else {
            address_form(around.protocol)
        },
        ..DRIVE.address
    };
    let address = address.read(reader);
    let unit = read_unit(reader, address);
    let profile = read_profile(reader, around, address);
    let group = DRIVE.group.read(reader);
    let access = DRIVE.access.get(reader);
    let guards = start_guard::read(reader, access, profile.as_deref());
    let frequency_range = read_frequencies(reader);
    let limits = read_limits(reader, profile.as_deref(), frequency_range.as_ref());
    let supervision = supervision::read(reader, profile.as_deref(), &limits);
    let timing = Timing {
        response_timeout: DRIVE.response_timeout.read(reader),
        silence: DRIVE.silence.read(reader),
        retries: DRIVE.retries.read(reader),
    };
    let refresh = read_refresh(reader, profile.as_deref(), access, supervision.as_ref());
    let on_shutdown = read_on_shutdown(reader, profile.as_deref());
    let turnaround = DRIVE.turnaround.read(reader);
    let triggers = read_triggers(reader, profile.as_deref());
    let raw_writes = raw_writes::read(reader, profile.as_deref());
    let params = read_params(reader, access);
    reader.finish();
    let spec = match (&name, address, unit, profile) {
        (Some((name, _)), Some(address), Some(unit), Some(profile)) => Some(DriveSpec {
            name: name.clone(),
            bus: around.bus.to_string(),
            address,
            unit,
            turnaround: turnaround.unwrap_or(profile.turnaround),
            profile,
            group,
            guard: guards.guard,
            interlocks: guards
                .interlocks
                .iter()
                .map(|(interlock, ..)| interlock.clone())
                .collect(),
            staggers: false,
            access,
            limits,
            supervision,
            on_shutdown,
            frequency_range,
            triggers,
            raw_writes,
            params,
            refresh,
            timing,
        }),
        _ => None,
    };
    if let Some(spec) = &spec {
        supervision::check_limits(reader, spec);
    }
    Found {
        name,
        address: address.map(|a| (a, DRIVE.address.place(reader))),
        unit: unit.map(|u| (u, DRIVE.unit.place(reader))),
        unit_is_address: !reader.has(DRIVE.unit.name),
        access: (access, DRIVE.access.place(reader)),
        limits: reader.place_of(DRIVE.limits.name),
        lease: reader
            .has(DRIVE.supervision.name)
            .then(|| DRIVE.supervision.place(reader)),
        shutdown_stop: (on_shutdown == OnShutdown::Stop).then(|| DRIVE.on_shutdown.place(reader)),
        refresh: refresh
            .filter(|_| reader.has(DRIVE.refresh.name))
            .map(|_| DRIVE.refresh.place(reader)),
        guards,
        spec,
    }
}

/// Reads the interval at which an order is written again: as configured, or as the profile requires for a drive
/// that has a lease.
fn read_refresh(
    reader: &Reader<'_>,
    profile: Option<&Profile>,
    access: Access,
    supervision: Option<&Supervision>,
) -> Option<Duration> {
    let key = DRIVE.refresh.name;
    let repeats = profile.map(Profile::repeats);
    if !reader.has(key) {
        let may = access == Access::Control && supervision.is_some() && repeats.is_some_and(|repeats| repeats.is_ok());
        return profile?.control.as_ref()?.refresh.filter(|_| may);
    }
    let every = DRIVE.refresh.read(reader).flatten()?;
    if access != Access::Control {
        reader.problem(
            key,
            "nothing is written to a drive that is only monitored, so nothing is written again",
            "set access = \"control\" for the drive, or leave `refresh` out",
        );
    } else if !reader.has(DRIVE.supervision.name) {
        reader.problem(
            key,
            "what feeds the drive's own timeout needs a lease of its own, or the motor would run on without its client",
            "add [bus.drive.supervision], or leave `refresh` out",
        );
    }
    if let (Some(Err(why)), Some(profile)) = (repeats, profile) {
        reader.problem(
            key,
            format!("nothing can be written again for profile `{}`: {why}", profile.name),
            "leave `refresh` out",
        );
    }
    Some(every)
}

/// Action when the gateway stops: the drive cannot be stopped where its profile does not write `run`.
fn read_on_shutdown(reader: &Reader<'_>, profile: Option<&Profile>) -> OnShutdown {
    let on_shutdown = DRIVE.on_shutdown.get(reader);
    let stops = |profile: &Profile| profile.model_point(ModelPoint::Run).is_some_and(|run| run.write);
    if on_shutdown == OnShutdown::Stop
        && let Some(profile) = profile.filter(|profile| !stops(profile))
    {
        reader.problem(
            DRIVE.on_shutdown.name,
            format!(
                "the profile `{}` writes no `run`, so nothing can stop the drive",
                profile.name
            ),
            "write on_shutdown = \"hold\", or give the point `run` of the profile `write = true`",
        );
    }
    on_shutdown
}

const fn address_form(protocol: Protocol) -> &'static Number {
    match protocol {
        Protocol::ModbusRtu | Protocol::ModbusAscii => &MODBUS_ADDRESSES,
        Protocol::N2 => &N2_ADDRESSES,
    }
}

/// Whether parameters may be restored, which is a command like any other.
fn read_params(reader: &Reader<'_>, access: Access) -> ParamsAccess {
    let params = DRIVE.params.get(reader);
    if params == ParamsAccess::Write && access != Access::Control {
        reader.problem(
            DRIVE.params.name,
            "params = \"write\" allows restoring parameters, but nothing is written to a drive that is only monitored",
            "set access = \"control\" for the drive, or params = \"read\"",
        );
    }
    params
}

/// Whether the drive has the address that the Modbus specification reserves.
fn is_reserved(reader: &Reader<'_>) -> bool {
    let address = reader.raw(DRIVE.address.name).map(|node| &node.value);
    matches!(address, Some(Node::Integer(address)) if *address == i64::from(RESERVED))
}

/// Addresses that a drive can have on a line of that protocol.
pub fn addresses(protocol: Protocol) -> RangeInclusive<u8> {
    let Number(range, _) = address_form(protocol);
    *range.start() as u8..=*range.end() as u8
}

/// The unit id; if absent, the address.
fn read_unit(reader: &Reader<'_>, address: Option<u8>) -> Option<u8> {
    if !reader.has(DRIVE.unit.name)
        && let Some(address @ (0 | 255)) = address
    {
        reader.problem(
            DRIVE.address.name,
            format!("unit {address} is the gateway itself, so the drive needs another one"),
            "add `unit`, 1 to 254",
        );
    }
    if reader.has(DRIVE.unit.name) {
        DRIVE.unit.read(reader)
    } else {
        address
    }
}

fn read_profile(reader: &Reader<'_>, around: &Surroundings<'_>, address: Option<u8>) -> Option<Arc<Profile>> {
    let key = DRIVE.profile.name;
    let name = DRIVE.profile.read(reader)?;
    let known = around.profiles.get(&name);
    let profile = known.ok_or_else(|| {
        if around.faulty.contains(&name) {
            Finding::new(
                format!("the file of profile `{name}` has errors"),
                "correct it: its errors are listed here, too",
            )
        } else {
            unknown_profile(&name, around.profiles)
        }
    });
    let profile = reader.accept(key, profile)?;
    if !profile.protocols.contains(&around.protocol) {
        let spoken: Vec<&str> = profile.protocols.iter().map(|p| p.name()).collect();
        reader.problem(
            key,
            format!(
                "profile `{name}` is for {}, but the bus uses {}",
                spoken.join(", "),
                around.protocol.name()
            ),
            "use another profile or put the drive on another bus",
        );
    }
    // A device on a network may have any unit id, and one that answers at 248 has no individual address.
    let takes = |address: &u8| {
        let is_modbus = around.protocol != Protocol::N2;
        let has_none = is_modbus && *address == RESERVED && *profile.addresses.end() == 247;
        around.is_modbus_tcp || has_none || profile.addresses.contains(address)
    };
    if let Some(address) = address.filter(|address| !takes(address)) {
        let (least, most) = profile.addresses.clone().into_inner();
        reader.problem(
            DRIVE.address.name,
            format!("a drive of profile `{name}` cannot have address {address}"),
            format!("write {least} to {most}"),
        );
    }
    let polled = |read: &PlannedRead| matches!(read.class, PollClass::Fast | PollClass::Slow);
    if !Plan::of(profile).reads.iter().any(polled) {
        reader.problem(
            key,
            format!("profile `{name}` has no polled point, so the gateway could not detect whether the drive replies"),
            "give one of its points class = \"fast\" or \"slow\"",
        );
    }
    Some(profile.clone())
}

/// ``unknown profile `x` ``, with the nearest one and all known ones.
pub fn unknown_profile(name: &str, profiles: &Profiles) -> Finding {
    let near = match nearest(name, profiles.names()) {
        Some(near) => format!("did you mean `{near}`? "),
        None => String::new(),
    };
    let known: Vec<&str> = profiles.names().collect();
    Finding::new(
        format!("unknown profile `{name}`"),
        format!("{near}known profiles: {}", known.join(", ")),
    )
}

/// `[[bus.drive.trigger]]`: values that make a recording.
fn read_triggers(reader: &Reader<'_>, profile: Option<&Profile>) -> Vec<PointTrigger> {
    let tables = DRIVE.trigger.tables(reader);
    let triggers = tables.iter().filter_map(|table| {
        let trigger = read_trigger(table, profile);
        table.finish();
        trigger
    });
    triggers.collect()
}

fn read_trigger(table: &Reader<'_>, profile: Option<&Profile>) -> Option<PointTrigger> {
    let name = TRIGGER.point.read(table)?;
    let hold = TRIGGER.r#for.get(table);
    let limit = match (TRIGGER.above.written(table), TRIGGER.below.written(table)) {
        (Some(limit), None) => Some(TriggerLimit::Above(limit)),
        (None, Some(limit)) => Some(TriggerLimit::Below(limit)),
        (None, None) if table.has(TRIGGER.above.name) || table.has(TRIGGER.below.name) => None,
        _ => {
            table.problem(
                TRIGGER.above.name,
                "a trigger has either `above` or `below`",
                "write one of them; for both, write two triggers",
            );
            None
        }
    };
    let profile = profile?;
    let point = table.accept(TRIGGER.point.name, trigger_point(&name, profile))?;
    Some(PointTrigger {
        point,
        limit: limit?,
        lasts: hold,
    })
}

/// Checks that a trigger's point is numeric and polled.
fn trigger_point(name: &str, profile: &Profile) -> Result<PointIndex, Finding> {
    let plan = Plan::of(profile);
    let is_number = |index: PointIndex| {
        let point = profile.points.get(index);
        point.is_some_and(|point| !point.hidden && !matches!(point.kind(), Kind::Bool | Kind::Text))
            && plan.shows(profile, index)
    };
    let index = profile.point_index(name);
    index.filter(|index| is_number(*index)).ok_or_else(|| {
        let names = profile.points.enumerate().filter(|(index, _)| is_number(*index));
        let near = nearest(name, names.map(|(_, point)| point.name.as_str()));
        let remedy = near.map(|near| format!("did you mean `{near}`?"));
        let list = || {
            format!(
                "`drivegate profiles show {}` lists the points and their classes",
                profile.name
            )
        };
        Finding::new(
            format!(
                "profile `{}` has no numeric point `{name}` that is polled",
                profile.name
            ),
            remedy.unwrap_or_else(list),
        )
    })
}

fn read_frequencies(reader: &Reader<'_>) -> Option<RangeInclusive<f64>> {
    let key = DRIVE.frequency_range.name;
    let pair: Vec<f64> = reader.optional(key)?;
    let range = match pair.as_slice() {
        [low, high] if *low >= 0.0 && low < high && *high <= MOST_HERTZ => Ok(*low..=*high),
        _ => Err(Finding::new(
            "not a range of frequencies in Hz",
            format!("write [minimum, maximum] between 0 and {MOST_HERTZ}, the lower one first"),
        )),
    };
    reader.accept(key, range)
}

fn read_limits(reader: &Reader<'_>, profile: Option<&Profile>, frequencies: Option<&RangeInclusive<f64>>) -> Limits {
    let mut limits = Limits::new();
    let Some(table) = DRIVE.limits.table(reader) else {
        return limits;
    };
    for key in table.keys() {
        let pair: Option<Vec<f64>> = table.optional(key);
        let range = pair.and_then(|pair| {
            let checked = match table.raw(key).and_then(|node| decimal_commas(&node.value)) {
                Some(meant) => Err(Finding::new(
                    "a comma separates numbers, and limits are two",
                    format!("write the decimals with a point: {meant}"),
                )),
                None => check_limits(&pair, key, profile, frequencies),
            };
            table.accept(key, checked)
        });
        limits.extend(range.map(|range| (key.to_string(), range)));
    }
    table.finish();
    limits
}

/// The limits that are meant by numbers with commas in place of points: `[0.0, 80.5]` by `[0.0, 80,5]`.
fn decimal_commas(list: &Node) -> Option<String> {
    let Node::Array(items) = list else { return None };
    let joined = |whole: &Node, decimals: &Node| match (whole, decimals) {
        (Node::Integer(whole), Node::Integer(decimals @ 0..)) => format!("{whole}.{decimals}").parse::<f64>().ok(),
        _ => None,
    };
    let number = |node: &Node| match node {
        Node::Integer(number) => Some(*number as f64),
        Node::Float(number) => Some(*number),
        _ => None,
    };
    let items: Vec<&Node> = items.iter().map(|item| &item.value).collect();
    let pairs = match items.as_slice() {
        [a, b, c] => [(number(a), joined(b, c)), (joined(a, b), number(c))],
        [a, b, c, d] => [(joined(a, b), joined(c, d)), (None, None)],
        _ => return None,
    };
    let meant = pairs.into_iter().filter_map(|(low, high)| Some((low?, high?)));
    // Where either number can have the comma, the wider limits are meant: [0, 0, 80] is not 0 to 0.8.
    let (low, high) = meant
        .filter(|(low, high)| low < high)
        .max_by(|a, b| a.1.total_cmp(&b.1))?;
    Some(format!("[{low:?}, {high:?}]"))
}

fn check_limits(
    pair: &[f64],
    key: &str,
    profile: Option<&Profile>,
    frequencies: Option<&RangeInclusive<f64>>,
) -> Result<RangeInclusive<f64>, Finding> {
    let point = profile.map(|profile| limited_point(profile, key)).transpose()?;
    let range = match pair {
        [low, high] if low <= high => *low..=*high,
        [low, high] => {
            return Err(Finding::new(
                format!("the limits {low} and {high} are in the wrong order"),
                format!("write [{high}, {low}]"),
            ));
        }
        _ => {
            return Err(Finding::new(
                "limits are two numbers",
                "write [lowest, highest], decimals with a point, such as [0.0, 80.5]",
            ));
        }
    };
    let Some(point) = point else { return Ok(range) };
    let own = match point.model {
        Some(ModelPoint::FrequencyReference) => point.range.as_ref().or(frequencies),
        _ => point.range.as_ref(),
    };
    if let Some(own) = own.filter(|own| !own.contains(range.start()) || !own.contains(range.end())) {
        let (low, high) = own.clone().into_inner();
        return Err(Finding::new(
            format!("the limits of `{key}` exceed the drive's own range"),
            format!("write [lowest, highest] within {low} and {high} {}", point.unit),
        ));
    }
    for bound in [*range.start(), *range.end()] {
        if let Some(Err(why)) = point.raw().map(|raw| raw.encode(Value::Number(bound), 0)) {
            return Err(Finding::new(why.to_string(), "write limits that fit the register"));
        }
    }
    Ok(range)
}

/// The point that limits can be set for.
fn limited_point<'p>(profile: &'p Profile, key: &str) -> Result<&'p Point, Finding> {
    let writable = || {
        let points = profile
            .points
            .iter()
            .filter(|p| p.is_commanded() && !matches!(p.kind(), Kind::Bool | Kind::Text));
        points.map(|p| p.name.as_str())
    };
    let known = || {
        let first = writable().take(MOST_NAMED).collect::<Vec<_>>().join(", ");
        let more = match writable().count().saturating_sub(MOST_NAMED) {
            0 => String::new(),
            more => format!(" and {more} more, see `drivegate profiles show {}`", profile.name),
        };
        format!("limits can be set for {first}{more}")
    };
    let Some(point) = profile.point_index(key).and_then(|i| profile.points.get(i)) else {
        let near = nearest(key, writable()).map(|near| format!("did you mean `{near}`?"));
        return Err(Finding::new(
            format!("profile `{}` has no point `{key}`", profile.name),
            near.unwrap_or_else(known),
        ));
    };
    let what = match point {
        _ if !point.write => "cannot be written",
        _ if point.kind() == Kind::Bool => "is true or false",
        _ => return Ok(point),
    };
    Err(Finding::new(format!("`{key}` {what}, so it has no limits"), known()))
}
