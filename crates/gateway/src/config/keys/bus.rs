//! `[[bus]]` and `[[bus.slot]]`.

use super::drive::Drive;
use super::forms::*;
use crate::config::capped::Capped;
use drivegate_bus::Mode;
use drivegate_line::{Level, MOST_RTS_DELAY, Rs485, Spin};
use drivegate_model::document::format_duration;
use drivegate_north::slot::SlotAccess;
use drivegate_proto::wire::Silence;
use drivegate_proto::{Protocol, n2};

/// Longest fixed silence that a bus can have.
pub(super) const MOST_SILENCE: Duration = Duration::from_secs(1);
pub(super) const SHORTEST_TIMEOUT: Duration = Duration::from_millis(1);
pub(super) const LONGEST_TIMEOUT: Duration = Duration::from_secs(5);
/// `response_timeout`: an hour was allowed before. A master that waits so long for an absent drive serves no other
/// drive.
const RESPONSE_TIMEOUTS: Capped = Capped {
    range: SHORTEST_TIMEOUT..=LONGEST_TIMEOUT,
    before: HOUR,
    why: "is longer than any drive takes to start its reply",
    until: "0.2",
};
/// Range of the delays of RS-485 by the kernel, in whole milliseconds.
const RTS_DELAYS: Time = Time(Duration::ZERO..=MOST_RTS_DELAY);
const PROTOCOLS: Words<Protocol> = Words(&[
    (Protocol::ModbusRtu.name(), Protocol::ModbusRtu),
    (Protocol::ModbusAscii.name(), Protocol::ModbusAscii),
    (Protocol::N2.name(), Protocol::N2),
]);
/// Levels of RTS and DTR.
const LEVELS: Words<Level> = Words(&[("driver", Level::Driver), ("on", Level::On), ("off", Level::Off)]);

keys! {
    /// One line with its drives.
    BUS: Bus {
        /// Name of the bus, unique; metric label, MQTT topic.
        name: String = Name("-_"), required;
        /// Serial port, preferably by its name under `/dev/serial/by-id`; or a device server that passes bytes through
        /// (`tcp://`: raw serial over TCP), or one whose port drivegate sets up with `baud` and `format` (`rfc2217://`);
        /// or [another way](installation.md#ports): `modbus-tcp://`, `udp://`, `tcp-listen://`. Each port belongs to one
        /// bus.
        port: String = Text("", "a path or an address such as \"tcp://host:port\""), required;
        /// With `tcp-listen://`: who may dial in.
        allow: Vec<IpNet> = NETWORKS, default ["127.0.0.0/8", "::1/128"];
        /// `"listen"`: another master owns the line; the gateway sends nothing and shows what that master reads, see
        /// [Listening](troubleshooting.md#listening-to-a-line-that-another-master-owns). Its drives cannot have `access
        /// = "control"`, `supervision` or `on_shutdown = "stop"`.
        mode: Mode = Words(&[("master", Mode::Master), ("listen", Mode::Listen)]), default "master";
        /// Protocol of the drives; every drive's profile must support it.
        protocol: Protocol = PROTOCOLS, default "modbus-rtu";
        /// Bits per second. N2 always uses 9600 8N1; a rate that the profile does not list causes a warning.
        baud: u32 = Number(300..=4_000_000, None), default 9600;
        /// Data bits 7 or 8, parity `N`, `E` or `O`, stop bits 1 or 2, as set on the drives. Modbus RTU needs 8 data
        /// bits; Modbus ASCII usually has 7 (`"7N2"`: a TECO card with all switches off). A format that the profile
        /// does not list causes a warning.
        format: String = Text("^[78][NEOneo][12]$", "a format such as \"8N1\""),
            by_protocol |protocol| format!("\"{}\"", default_format(protocol));
        /// What switches the direction of the line: the adapter itself, as nearly all do (`"off"`), or the port driver
        /// with RTS high (`"kernel"`) or low (`"kernel-inverted"`) while sending.
        rs485: Rs485 = Words(&[
            ("off", Rs485::Off), ("kernel", Rs485::Kernel), ("kernel-inverted", Rs485::KernelInverted),
        ]), default "off";
        /// With `rs485 = "kernel"`: time between switching to sending and the first bit, in whole milliseconds.
        /// Settings that the driver does not accept, of this and the next three keys, are logged when the port is
        /// opened.
        rts_before_send: Duration = RTS_DELAYS, default "0ms";
        /// With `rs485 = "kernel"`: time between the last bit and switching back; a reply that starts earlier is lost.
        rts_after_send: Duration = RTS_DELAYS, default "0ms";
        /// With `rs485 = "kernel"`: whether the port receives what it sends. Only for drivers that otherwise receive
        /// nothing.
        rx_during_tx: bool = Flag, default false;
        /// With `rs485 = "kernel"`: whether the driver switches on the board's terminating resistor.
        termination: bool = Flag, default false;
        /// Level of RTS, for adapters that are powered or enabled by it; also with `rfc2217://`. `"driver"`: on, as Linux leaves
        /// it. Not with `rs485 = "kernel"`.
        rts: Level = LEVELS, default "driver";
        /// Level of DTR, likewise.
        dtr: Level = LEVELS, default "driver";
        /// Whether the end of a short wait is spent watching the clock, so that requests leave on time. `"auto"`: with
        /// more than one processor. `"off"` saves processor time on small boxes; requests leave up to 0.1 ms later.
        spin: Spin = Words(&[("auto", Spin::Auto), ("on", Spin::On), ("off", Spin::Off)]), default "auto";
        /// Target poll cycle of process data (poll class fast). If the line cannot carry it, cycles follow one another
        /// without a pause.
        cycle: Duration = TIMES, default "10ms";
        /// Target poll cycle of class slow. A motor speed that is slow in its profile is read every `cycle` if the line
        /// has time for it (`fast_if_carried`).
        slow_cycle: Duration = TIMES, default "1s";
        /// Time a drive may take to start its reply; the time on the wire is added. Each attempt to reach an absent
        /// drive takes the line for that time.
        response_timeout: Duration = RESPONSE_TIMEOUTS,
            by_protocol |protocol| format!("\"{}\"", format_duration(protocol.usual_timeout()));
        /// Retries after the first attempt before a drive counts as offline.
        retries: u32 = Number(0..=10, None), by_protocol |protocol| default_retries(protocol).to_string();
        /// Silence before each request. `"spec"`: 3.5 characters, fixed at 1.75 ms above 19200 baud, as in the Modbus
        /// specification. `"chars"`: 3.5 characters at any baud rate, which is faster at 38400 and above and enough for
        /// most drives. A duration: for drives that need more. N2: `"5ms"`.
        silence: Silence = Parsed {
            parse: parse_silence, words: &["spec", "chars"], pattern: DURATION,
            range: "\"spec\", \"chars\" or a duration up to \"1s\"",
        }, default "spec";
        /// The drives on the line.
        drive: Present = Own { schema: || each(Drive::schema()), range: "[[bus.drive]]" }, or "none";
        /// Access to the line for vendors' tools, see [Tool slot](tool-slot.md).
        slot: Present = Own { schema: || each(SlotTable::schema()), range: "[[bus.slot]]" }, or "none";
    }

    /// A slot for vendors' tools: a program that speaks the protocol of the line, as if it were alone on it.
    SLOT: SlotTable {
        /// Address for the bare frames of the line: Modbus RTU or ASCII over TCP (not Modbus TCP), or N2.
        listen: SocketAddr = SOCKET, or "none";
        /// Address of a COM port by RFC 2217, for programs on Windows behind a COM port redirector.
        rfc2217: SocketAddr = SOCKET, or "none";
        /// Path of a serial port (a link to a pseudo-terminal, mode 0660) that a program on this machine opens.
        pty: PathBuf = PATH, or "none";
        /// `"read"`: every request that may write is refused. `"write"`: writes are passed on like those of a Modbus
        /// TCP client that may write. `"raw"`: also what cannot be checked: broadcasts, functions that drivegate does
        /// not decode, writes to addresses without a configured drive.
        access: SlotAccess = Words(&[
            ("read", SlotAccess::Read), ("write", SlotAccess::Write), ("raw", SlotAccess::Raw),
        ]), default "read";
        /// Who may connect to `listen` and `rfc2217`.
        allow: Vec<IpNet> = NETWORKS, default ["127.0.0.0/8", "::1/128"];
        /// A connection without a request for this time is closed.
        idle_timeout: Option<Duration> = IDLE_TIMEOUT, default "10min";
    }
}

/// N2 tries three times (reference/n2.md 4).
fn default_retries(protocol: Protocol) -> u32 {
    match protocol {
        Protocol::ModbusRtu | Protocol::ModbusAscii => 1,
        Protocol::N2 => n2::RETRIES,
    }
}

/// Character format of a bus without `format`. That of Modbus ASCII is that of TECO's card with all switches off
/// (reference/drives.md 2).
pub fn default_format(protocol: Protocol) -> &'static str {
    match protocol {
        Protocol::ModbusAscii => "7N2",
        Protocol::ModbusRtu | Protocol::N2 => "8N1",
    }
}

/// `spec`, `chars` or a duration.
fn parse_silence(text: &str) -> Result<Silence, Finding> {
    match text.parse::<Silence>() {
        Ok(Silence::Fixed(time)) if time > MOST_SILENCE => Err(Finding::new(
            format!("{} of silence is out of range", format_duration(time)),
            format!("write at most \"{}\"", format_duration(MOST_SILENCE)),
        )),
        Ok(silence) => Ok(silence),
        Err(_) => Err(Finding::new(
            format!("`{text}` is not a silence"),
            "write \"spec\", \"chars\" or a duration such as \"2ms\"",
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::RESPONSE_TIMEOUTS;

    #[test]
    fn a_longer_duration_is_accepted_no_longer_than_was_promised() {
        let number = |text: &str| -> (u32, u32) {
            let mut parts = text.split('.').map(|part| part.parse().unwrap());
            (parts.next().unwrap(), parts.next().unwrap())
        };
        let (this, until) = (number(env!("CARGO_PKG_VERSION")), number(RESPONSE_TIMEOUTS.until));
        assert!(this < until, "make RESPONSE_TIMEOUTS a plain range");
    }
}
