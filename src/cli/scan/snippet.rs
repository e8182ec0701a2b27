//! The configuration that `scan` and `listen` print. Pure.

use std::path::Path;

use crate::bus::Mode;
use crate::codec::{LineFormat, Protocol};

/// A drive that answered.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::cli) struct Found {
    pub(in crate::cli) protocol: Protocol,
    pub(in crate::cli) format: LineFormat,
    pub(in crate::cli) address: u8,
    /// Profiles that match its answers; none, one, or some that cannot be distinguished by reading.
    pub(in crate::cli) profiles: Vec<String>,
}

impl Found {
    /// For people.
    pub(in crate::cli) fn title(&self) -> String {
        match self.profiles.as_slice() {
            [] => "no known profile".to_string(),
            [one] => one.clone(),
            some => format!("{} (indistinguishable by reading)", some.join(" or ")),
        }
    }
}

/// Buses and drives as a configuration file has them.
pub(in crate::cli) fn snippet(port: &str, found: &[Found], mode: Mode) -> String {
    // A configuration is read from its own directory.
    let port = if port.contains("://") {
        port.to_string()
    } else {
        std::path::absolute(Path::new(port)).map_or_else(|_| port.to_string(), |p| p.display().to_string())
    };
    let mut text = "[gateway]\nname = \"gateway\"\n".to_string();
    let mut settings: Vec<(Protocol, LineFormat)> = found.iter().map(|f| (f.protocol, f.format)).collect();
    settings.dedup();
    let mut number = 0;
    let mode = match mode {
        Mode::Master => "",
        Mode::Listen => "mode = \"listen\"\n",
    };
    for (index, (protocol, format)) in settings.iter().enumerate() {
        if index > 0 {
            text += "\n# Drives also answered with other settings; a line has one, so choose.\n";
        }
        let written = format.to_string();
        let characters = written.split_once(' ').map_or("8N1", |(_, characters)| characters);
        text += &commented(
            index > 0,
            &format!(
                "\n[[bus]]\nname = \"line{}\"\nport = {port:?}\n{mode}protocol = \"{}\"\nbaud = {}\nformat = \"{characters}\"\n",
                index + 1,
                protocol.name(),
                format.baud
            ),
        );
        for drive in found.iter().filter(|f| (f.protocol, f.format) == (*protocol, *format)) {
            number += 1;
            text += &commented(index > 0, &entry(drive, number, unit_of(drive, found)));
        }
    }
    text
}

/// The unit of a drive whose address cannot be one: 255 is the gateway itself.
fn unit_of(drive: &Found, found: &[Found]) -> Option<u8> {
    let taken = |unit: &u8| found.iter().any(|other| other.address == *unit);
    (1..=254)
        .rev()
        .find(|unit| !taken(unit))
        .filter(|_| drive.address == 255)
}

fn entry(drive: &Found, number: usize, unit: Option<u8>) -> String {
    let unit = unit.map(|unit| format!("unit = {unit}\n")).unwrap_or_default();
    let head = format!(
        "\n[[bus.drive]]\nname = \"drive-{number}\"\naddress = {}\n{unit}",
        drive.address
    );
    match drive.profiles.as_slice() {
        [] => {
            commented(true, &format!("{head}profile = \"\""))
                + "    # no profile matches; see docs/profiles.md to write one\n"
        }
        [one] => format!("{head}profile = \"{one}\"\n"),
        [first, others @ ..] => format!("{head}profile = \"{first}\"    # or {}\n", others.join(", or ")),
    }
}

fn commented(comment: bool, text: &str) -> String {
    if !comment {
        return text.to_string();
    }
    let line = |line: &str| {
        if line.is_empty() {
            String::new()
        } else {
            format!("# {line}")
        }
    };
    let lines: Vec<String> = text.split('\n').map(line).collect();
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Settings;

    fn found(protocol: Protocol, address: u8, profiles: &[&str]) -> Found {
        Found {
            protocol,
            format: LineFormat::new(9600, "8N1").unwrap(),
            address,
            profiles: profiles.iter().map(ToString::to_string).collect(),
        }
    }

    #[test]
    fn check_accepts_it() {
        let rtu = Protocol::ModbusRtu;
        let far = [254, 255].map(|address| found(Protocol::N2, address, &["teco-7300pa-n2"]));
        let cases = [
            far.to_vec(),
            vec![
                found(rtu, 1, &["vacon-nx"]),
                found(rtu, 7, &[]),
                found(rtu, 9, &["vacon-nx", "eaton-svx"]),
            ],
            vec![found(rtu, 1, &["vacon-nx"]), found(Protocol::N2, 1, &["vacon-nx-n2"])],
        ];
        for case in cases {
            let text = snippet("/dev/serial/by-id/usb-\"x\"", &case, Mode::Listen);
            let loaded = Settings::parse("found.toml", &text, std::iter::empty());
            let errors: Vec<String> = loaded.errors.iter().map(ToString::to_string).collect();
            let settings = loaded.settings.unwrap_or_else(|| panic!("{errors:?}\n{text}"));
            let drives = settings.buses.iter().flat_map(|b| &b.drives);
            let known = case
                .iter()
                .filter(|f| !f.profiles.is_empty() && f.protocol == case[0].protocol);
            assert_eq!(
                drives.map(|d| d.address).collect::<Vec<_>>(),
                known.map(|f| f.address).collect::<Vec<_>>()
            );
        }
    }
}
