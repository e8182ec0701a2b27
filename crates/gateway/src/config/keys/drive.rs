//! `[[bus.drive]]` and its tables.

use super::bus::{LONGEST_TIMEOUT, MOST_SILENCE, SHORTEST_TIMEOUT};
use super::forms::*;
use drivegate_core::process_image::{Access, LeaseAction, OnShutdown, ParamsAccess};
use drivegate_core::start_guard::MOST_STARTS;

/// Most that `frequency_range` may contain, Hz.
pub(in crate::config) const MOST_HERTZ: f64 = 10_000.0;
const BROADCAST: Option<(i64, &str)> = Some((0, "address 0 is the broadcast, not a drive"));
/// Addresses on a Modbus line.
pub(in crate::config) const MODBUS_ADDRESSES: Number = Number(1..=247, BROADCAST);
/// The first address that the Modbus specification reserves.
pub(in crate::config) const RESERVED: u8 = 248;
/// Addresses on a Modbus line with that one.
pub(in crate::config) const WITH_RESERVED: Number = Number(1..=RESERVED as i64, BROADCAST);
/// Unit ids behind `modbus-tcp://`.
pub(in crate::config) const UNIT_IDS: Number = Number(0..=255, None);
/// Addresses on an N2 line; each drive family has its own range within these.
pub(in crate::config) const N2_ADDRESSES: Number = Number(1..=255, BROADCAST);
/// The actions that are words.
pub(in crate::config) const ACTIONS: Words<LeaseAction> =
    Words(&[("stop", LeaseAction::Stop), ("hold", LeaseAction::LeaveRunning)]);

keys! {
    /// One drive.
    DRIVE: Drive {
        /// Name of the drive, unique in the gateway; used in topics and labels.
        name: String = Name("-_"), required;
        /// Address on the line, unique on the bus: 1 to 247 on Modbus (248 for the only device of a line that answers at any
        /// address), 1 to 255 on N2; behind `modbus-tcp://` the unit id, 0 to 255. The profile may allow fewer.
        address: u8 = UNIT_IDS, required;
        /// Family of the drive: its points and limits; `drivegate profiles` lists them.
        profile: String = Text("^[a-z][a-z0-9-]*$", "the name of a profile"), required;
        /// Modbus TCP unit id, unique on each listener of `[modbus_tcp]`. 255 is the gateway itself.
        unit: u8 = Number(1..=254, Some((255, "unit 255 is the gateway itself"))), or "the address";
        /// Drives that [stop all](commands.md#stop-all) can stop together, and that share a [`stagger`](commands.md#guards).
        group: String = Name("-_"), or "none";
        /// `"monitor"`: every write is refused. `"control"`: writes by authorised clients are passed on.
        access: Access = Words(&[("monitor", Access::Monitor), ("control", Access::Control)]), default "monitor";
        /// Limits for written values by point, in the point's unit, within the drive's own range. A value outside is
        /// refused, never clamped. Limits in percent also apply to commands in Hz and to raw writes, and vice versa.
        limits: Present = Own {
            schema: || json!({ "type": "object", "additionalProperties": number_pair(None, None) }),
            range: "{ point = [lowest, highest] }",
        }, or "none";
        /// Lease of the drive. Not a safety function.
        supervision: Present = Own { schema: Supervision::schema, range: "[bus.drive.supervision]" }, or "none";
        /// How often and how soon the motor may be [started](commands.md#guards).
        guard: Present = Own { schema: GuardTable::schema, range: "[bus.drive.guard]" }, or "none";
        /// Conditions for [starting](commands.md#interlocks) the motor.
        interlocks: Present = Own { schema: || each(InterlockTable::schema()), range: "[[bus.drive.interlocks]]" }, or "none";
        /// What is written at [shutdown](commands.md#shutdown): nothing, or a stop. Nothing is ever written to a
        /// monitored drive.
        on_shutdown: OnShutdown = Words(&[("hold", OnShutdown::LeaveRunning), ("stop", OnShutdown::Stop)]), default "hold";
        /// Time the drive takes to start its reply, used only for the prediction of `check`; the measured value is a
        /// metric.
        turnaround: Duration = Time(Duration::ZERO..=Duration::from_secs(1)), or "the profile's";
        /// Time this drive may take to start its reply; the time on the wire is added.
        response_timeout: Duration = Time(SHORTEST_TIMEOUT..=LONGEST_TIMEOUT), or "that of the bus";
        /// Silence before each request to this drive, and after its reply before a request to another one.
        silence: Duration = Time(Duration::ZERO..=MOST_SILENCE), or "that of the bus";
        /// Retries after the first attempt before this drive counts as offline.
        retries: u32 = Number(0..=10, None), or "that of the bus";
        /// Minimum and maximum frequency, used to convert `frequency_reference` if the drive's own cannot be read, or
        /// were not read [recently](commands.md#limits-and-frequencies).
        frequency_range: Present = Own {
            schema: || number_pair(Some(0.0), Some(MOST_HERTZ)),
            range: "[lowest, highest], Hz",
        }, or "none";
        /// What [raw writes](modbus-tcp.md#what-raw-writes-may-set) may set in addition to the registers of writable
        /// points: nothing, everything that the profile allows (`true`), or ranges of PDU addresses, for registers and
        /// coils alike.
        raw_writes: Present = Own {
            schema: || json!({ "anyOf": [{ "type": "boolean" }, { "type": "array", "items": {
                "type": "array", "items": { "type": "integer", "minimum": 0, "maximum": u16::MAX },
                "minItems": 2, "maxItems": 2,
            } }] }),
            range: "true, false or ranges of PDU addresses such as [[101, 199]]",
        }, or "`false`";
        /// What may be done with its [parameters](parameters.md#restoring): `"read"`, or `"write"`: they may also be
        /// restored, which needs `access = "control"`.
        params: ParamsAccess = Words(&[("read", ParamsAccess::Read), ("write", ParamsAccess::Write)]), default "read";
        /// How often the control word and the reference that a client ordered last are [written
        /// again](commands.md#refresh), for a drive whose own timeout counts only writes. Needs `access = "control"` and
        /// `supervision`.
        refresh: Option<Duration> = REPEATED, or "the profile's where the drive has `supervision`, else `\"off\"`";
        /// Values that trigger a [recording](history.md#recordings), in addition to faults.
        trigger: Present = Own { schema: || each(Trigger::schema()), range: "[[bus.drive.trigger]]" }, or "none";
    }

    /// A value that makes a recording: `above` or `below` a limit, for a time.
    TRIGGER: Trigger {
        /// A polled numeric point of the drive.
        point: String = Text("^[a-z][a-z0-9_]*$", "the name of a point"), required;
        /// The value must be above this, in the point's unit.
        above: f64 = Figure, or "none";
        /// The value must be below this, in the point's unit.
        below: f64 = Figure, or "none";
        /// For how long without interruption.
        r#for: Duration = Time(Duration::ZERO..=HOUR), default "0s";
    }

    /// Lease of the drive: if it expires while the drive runs, the action is executed once. Not a safety function.
    SUPERVISION: Supervision {
        /// Time after which the lease expires. Every command sent on the line and every accepted heartbeat renews it.
        timeout: Duration = Time(Duration::from_millis(50)..=HOUR), required;
        /// Action then, if the drive runs: `"stop"` stops it, `"hold"` only raises the event,
        /// `{ speed_reference = 20.0 }` (percent) writes this reference.
        action: Present = Own {
            schema: || json!({ "anyOf": [ { "enum": ["stop", "hold"] }, Reference::schema() ] }),
            range: "\"stop\", \"hold\" or { speed_reference = 20.0 }",
        }, default "stop";
        /// Whether a drive that is running when the gateway starts gets its [lease](commands.md#leases) immediately;
        /// nothing is written.
        adopt: bool = Flag, default false;
    }

    /// Guard of the motor: starts that come too often or too soon are refused.
    GUARD: GuardTable {
        /// Maximum starts within any hour.
        starts_per_hour: u32 = Number(1..=MOST_STARTS as i64, None), or "any number";
        /// Time the motor must be stopped before a start.
        min_off: Duration = Time(Duration::ZERO..=HOUR), default "0s";
        /// Time the motor must run before an [ordinary stop](commands.md#guards).
        min_run: Duration = Time(Duration::ZERO..=HOUR), default "0s";
        /// Time between two starts in the same `group`; without `group`, on the same bus.
        stagger: Duration = Time(Duration::ZERO..=HOUR), default "0s";
    }

    /// Interlock of the motor: a point of another drive that must hold before a start.
    INTERLOCK: InterlockTable {
        /// Name of the other drive.
        drive: String = Name("-_"), required;
        /// A polled boolean point of it. If it is not good, the interlock is not satisfied.
        point: String = Text("^[a-z][a-z0-9_]*$", "the name of a point"), required;
        /// Required value of the point.
        is: bool = Flag, default true;
        /// Whether the running motor is stopped when the interlock is no longer satisfied.
        trip: bool = Flag, default false;
    }

    /// Speed reference to write.
    REFERENCE: Reference {
        /// Speed reference in percent.
        speed_reference: Present = Own { schema: || json!({ "type": "number" }), range: "a number" }, required;
    }
}

fn number_pair(least: Option<f64>, most: Option<f64>) -> Value {
    let mut item = json!({ "type": "number" });
    for (name, bound) in [("minimum", least), ("maximum", most)] {
        if let (Value::Object(item), Some(bound)) = (&mut item, bound) {
            item.insert(name.into(), bound.into());
        }
    }
    json!({ "type": "array", "items": item, "minItems": 2, "maxItems": 2 })
}
