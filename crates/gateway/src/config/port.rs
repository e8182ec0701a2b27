//! `port` of `[[bus]]`: a serial device or a device on the network, and the keys that have no meaning there.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use super::keys::BUS;
use super::{drive, values};
use drivegate_bus::Mode;
use drivegate_core::process_image::Access;
use drivegate_line::{LONGEST_ID, split_dial_in};
use drivegate_model::document::{Finding, Reader};
use drivegate_proto::Protocol;

/// Remedy with all kinds of ports.
const KINDS: &str = "write the path of a serial device, or \"tcp://host:port\" (raw serial over TCP), \"rfc2217://host:port\", \
                     \"modbus-tcp://host:port\", \"udp://host:port\", \"tcp-listen://address:port\"";

/// Path of a device, relative to the directory of the file, or the address of a device server.
///
/// # Errors
/// If the text is neither a path nor an address.
pub fn check(text: &str, base: &Path) -> Result<String, Finding> {
    match text.split_once("://") {
        Some((scheme @ ("tcp" | "rfc2217" | "modbus-tcp" | "udp"), server)) => match values::host_port(server, None) {
            Some(_) => Ok(text.to_string()),
            None => Err(Finding::new(
                format!("`{text}` is not the address of a device server"),
                format!("write \"{scheme}://host:port\""),
            )),
        },
        Some(("tcp-listen", place)) => check_place(text, place).map(|()| text.to_string()),
        Some((scheme, _)) => Err(Finding::new(format!("`{scheme}://` is not a kind of port"), KINDS)),
        None if text.is_empty() || text.contains('\0') => Err(Finding::new(
            "the port has no path",
            "write for example \"/dev/serial/by-id/usb-…\"",
        )),
        None if is_windows_name(text) => Err(Finding::new(
            format!("`{text}` is the name of a port on Windows"),
            "write the path of the adapter on this machine, such as \"/dev/serial/by-id/usb-…\"; `ls /dev/serial/by-id` lists them",
        )),
        None if values::host_port(text, None).is_some() => Err(Finding::new(
            format!("`{text}` is not a path of a serial device"),
            format!(
                "did you mean \"tcp://{text}\", \"rfc2217://{text}\" for a server that sets up its port over the network, or \
                 \"modbus-tcp://{text}\"?"
            ),
        )),
        None => {
            let path = values::resolved(base, PathBuf::from(text));
            // What is kept about the machine at this port is found again wherever the next process is started.
            let whole = if path.is_absolute() {
                Ok(path.clone())
            } else {
                std::path::absolute(&path)
            };
            Ok(whole.unwrap_or(path).display().to_string())
        }
    }
}

/// Checks `address:port`, with the text that the device sends first.
fn check_place(text: &str, place: &str) -> Result<(), Finding> {
    let (address, id) = split_dial_in(place);
    if address
        .parse::<SocketAddr>()
        .map_or(true, |address| address.port() == 0)
    {
        return Err(Finding::new(
            format!("`{text}` has no address of this machine to listen at"),
            "write for example \"tcp-listen://0.0.0.0:5020?id=USR-0001\"",
        ));
    }
    let is_sound = id.len() <= LONGEST_ID && id.chars().all(|c| c.is_ascii_graphic());
    if !is_sound || place.ends_with("?id=") {
        return Err(Finding::new(
            format!("`{id}` is not a text that a device says first"),
            format!("write 1 to {LONGEST_ID} visible characters of ASCII behind `?id=`"),
        ));
    }
    Ok(())
}

/// `COM3`.
fn is_windows_name(text: &str) -> bool {
    let number = text
        .get(..3)
        .filter(|start| start.eq_ignore_ascii_case("com"))
        .and_then(|_| text.get(3..));
    let number = number.map(|number| number.trim_end_matches(':')).unwrap_or_default();
    !number.is_empty() && number.chars().all(|c| c.is_ascii_digit())
}

/// Keys of the bus that need another kind of port.
pub(super) fn check_keys(reader: &Reader<'_>, port: &str, protocol: Protocol) {
    let scheme = port.split_once("://").map_or("", |(scheme, _)| scheme);
    if matches!(scheme, "modbus-tcp" | "udp") {
        if protocol != Protocol::ModbusRtu {
            reader.problem(
                BUS.protocol.name,
                format!("{scheme}:// carries Modbus, not {}", protocol.name()),
                "leave `protocol` out",
            );
        }
        if BUS.mode.get(reader) == Mode::Listen {
            reader.problem(
                BUS.mode.name,
                format!("a {scheme}:// port carries only the gateway's own requests and their replies"),
                "leave `mode` out",
            );
        }
    }
    if scheme == "modbus-tcp" {
        let keys = [
            BUS.baud.name,
            BUS.format.name,
            BUS.rs485.name,
            BUS.silence.name,
            BUS.slot.name,
        ];
        for key in keys.into_iter().filter(|key| reader.has(key)) {
            reader.problem(
                key,
                format!(
                    "`{key}` is of a serial line, and behind modbus-tcp:// there is none that the gateway speaks on"
                ),
                "leave the key out",
            );
        }
    }
    if scheme != "tcp-listen" && reader.has(BUS.allow.name) {
        reader.warning(
            BUS.allow.name,
            "`allow` is where the device of a bus may dial in from, and has no effect on this port",
            "leave the key out, or write port = \"tcp-listen://address:port\"",
        );
    }
}

/// A bus whose drives are commanded needs a text: without one, any device that dials in would get their orders.
pub(super) fn check_dial_in(reader: &Reader<'_>, port: &str, drives: &[drive::Found]) {
    let Some(place) = port.strip_prefix("tcp-listen://") else {
        return;
    };
    let (address, id) = split_dial_in(place);
    let is_controlled = drives.iter().any(|drive| drive.access.0 == Access::Control);
    if id.is_empty() && is_controlled {
        reader.problem(
            BUS.port.name,
            "drives are commanded on this bus, and any device that dials in would get their orders",
            format!("write port = \"tcp-listen://{address}?id=TEXT\" with the text that the device says first"),
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_of_ports() {
        let base = Path::new("/etc/drivegate");
        for sound in [
            "tcp://server:4001",
            "rfc2217://[::1]:4001",
            "modbus-tcp://10.0.0.7:502",
            "udp://10.0.0.7:4001",
            "tcp-listen://0.0.0.0:5020",
            "tcp-listen://[::]:5020?id=USR-0001",
        ] {
            assert_eq!(check(sound, base).unwrap(), sound);
        }
        for bad in [
            "http://server:80",
            "modbus-tcp://server",
            "udp://server:0",
            "tcp-listen://server:5020",
            "tcp-listen://0.0.0.0:0",
            "tcp-listen://0.0.0.0:5020?id=",
            "tcp-listen://0.0.0.0:5020?id=A B",
            "COM3",
            "10.0.0.7:502",
            "",
        ] {
            assert!(check(bad, base).is_err(), "{bad}");
        }
        assert_eq!(check("line1", base).unwrap(), "/etc/drivegate/line1");
        let here = std::env::current_dir().unwrap().join("line1");
        assert_eq!(check("line1", Path::new("")).unwrap(), here.display().to_string());
    }
}
