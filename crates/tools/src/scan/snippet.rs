//! The configuration of the drives that `scan`, `try` or `listen` found: it passes `check`, and the line can carry
//! it. Pure.

use std::path::{Path, PathBuf};
use std::time::Duration;

use super::found::Found;
use super::settings::Setting;
use drivegate_bus::{Mode, predict};
use drivegate_core::process_image::DriveSpec;
use drivegate_gateway::config::{BusSettings, Settings};
use drivegate_model::document::format_duration;
use drivegate_model::drive::profile::Profiles;
use drivegate_proto::LineFormat;

/// Address of the status page.
const HTTP: &str = "127.0.0.1:9488";

/// The parts of a configuration snippet.
pub(crate) struct Snippet<'a> {
    /// The port as written in a configuration.
    pub(crate) port: &'a str,
    /// Drives that answered the scan.
    pub(crate) found: &'a [Found],
    /// All known profiles.
    pub(crate) profiles: &'a Profiles,
    /// Absolute directories of the user's profiles.
    pub(crate) profile_dirs: Vec<PathBuf>,
    /// Time limit for the first byte of a reply, if the user chose one.
    pub(crate) timeout: Option<Duration>,
    /// Whether the gateway is to poll the drives or only to listen.
    pub(crate) mode: Mode,
}

/// The absolute path of a port, since relative paths in a configuration start at its own directory.
pub(crate) fn absolute(port: &str) -> String {
    if port.contains("://") {
        return port.to_string();
    }
    std::path::absolute(Path::new(port)).map_or_else(|_| port.to_string(), |path| path.display().to_string())
}

impl Snippet<'_> {
    /// The text of the snippet.
    pub(crate) fn text(&self) -> String {
        let draft = self.with_cadence("");
        if self.mode == Mode::Listen {
            return draft;
        }
        let loaded = Settings::parse("found.toml", &draft, std::iter::empty());
        let bus = loaded.settings.as_ref().and_then(|settings| settings.buses.first());
        self.with_cadence(&bus.map_or_else(String::new, cadence))
    }

    /// The first drive of the configuration.
    pub(super) fn first_drive(&self) -> Option<DriveSpec> {
        let loaded = Settings::parse("found.toml", &self.with_cadence(""), std::iter::empty());
        let bus = loaded.settings?.buses.into_iter().next()?;
        bus.drives.into_iter().next()
    }

    fn with_cadence(&self, cadence: &str) -> String {
        let mut text = "# Names to fill in (a-z, 0-9, -): of the gateway, the line and the drives.\n[gateway]\nname = \"gateway\"\n".to_string();
        if !self.profile_dirs.is_empty() {
            let dirs: Vec<String> = self
                .profile_dirs
                .iter()
                .map(|dir| format!("{:?}", dir.display().to_string()))
                .collect();
            text += &format!("profile_dirs = [{}]\n", dirs.join(", "));
        }
        let mut settings: Vec<Setting> = self.found.iter().map(|found| found.setting).collect();
        settings.dedup();
        let mut number = 0;
        for (index, setting) in settings.iter().enumerate() {
            let other = index > 0;
            if other {
                text += "\n# Drives also replied with other settings; a line has only one, so choose.\n";
            }
            let cadence = if other { "" } else { cadence };
            text += &commented(other, &self.bus(*setting, index + 1, cadence));
            for drive in self.found.iter().filter(|found| found.setting == *setting) {
                number += 1;
                text += &commented(other, &self.drive(drive, number));
            }
        }
        text + &format!("\n[http]\nlisten = \"{HTTP}\"    # status page, metrics\n")
    }

    fn bus(&self, Setting { protocol, format }: Setting, number: usize, cadence: &str) -> String {
        let port = self.port;
        let mode = match self.mode {
            Mode::Master => "",
            Mode::Listen => "mode = \"listen\"\n",
        };
        let mut text = format!("\n[[bus]]\nname = \"line{number}\"\nport = {port:?}\n{mode}");
        if format != LineFormat::NETWORK {
            text += &format!("protocol = \"{}\"\n", protocol.name());
            if ["tcp://", "udp://"].iter().any(|scheme| port.starts_with(scheme)) {
                text += "# The device server sets up the line itself: enter its settings here.\n";
            }
            text += &format!("baud = {}\nformat = \"{}\"\n", format.baud, format.characters());
        }
        text += cadence;
        if let Some(timeout) = self.timeout {
            text += &format!("response_timeout = \"{}\"\n", format_duration(timeout));
        }
        text
    }

    /// The unit id of a drive with address 255, which cannot be its unit id: unit 255 is the gateway itself.
    fn unit_of(&self, drive: &Found) -> Option<u8> {
        let taken = |unit: &u8| self.found.iter().any(|other| other.address == *unit);
        (1..=254)
            .rev()
            .find(|unit| !taken(unit))
            .filter(|_| drive.address == 255)
    }

    fn drive(&self, drive: &Found, number: usize) -> String {
        let unit = self
            .unit_of(drive)
            .map(|unit| format!("unit = {unit}\n"))
            .unwrap_or_default();
        let head = format!(
            "[[bus.drive]]\nname = \"drive-{number}\"\naddress = {}\n{unit}",
            drive.address
        );
        let first = match drive.profiles.as_slice() {
            [] => {
                let why = match drive.unanswered {
                    0 => "No read shows the family of this device: --profile NAME names it, `drivegate profiles` lists the names."
                        .to_string(),
                    _ => format!(
                        "The family of this drive is unknown, because {}: scan again with --tries 3.",
                        drive.silence()
                    ),
                };
                return format!("\n# {why}\n") + &commented(true, &format!("{head}profile = \"\"\n"));
            }
            [first, ..] => first,
        };
        let note = match drive.profiles.as_slice() {
            [_, others @ ..] if !others.is_empty() => format!(
                "# By reading alone {first} cannot be distinguished from {}: check the nameplate.\n",
                others.join(" and ")
            ),
            _ => String::new(),
        };
        let note = if drive.chosen {
            "# Named, not identified: compare its values with the drive's panel.\n".to_string()
        } else {
            note
        };
        let identified = drive.identified(self.profiles);
        let note = note + &identified.map_or(String::new(), |text| format!("# This is {text}.\n"));
        let functions = self.profiles.get(first).map(|profile| profile.functions.notes());
        let functions = functions.filter(|notes| !notes.is_empty());
        let functions = functions.map(|notes| format!("# Before commanding it: {}.\n", notes.join("; ")));
        let note = note + &functions.unwrap_or_default();
        let turnaround = self.profiles.get(first).map(|profile| profile.turnaround);
        let slower = drive
            .turnaround
            .zip(turnaround)
            .and_then(|(measured, usual)| slower_than(measured, usual));
        let turnaround = slower.map(|time| format!("turnaround = \"{}\"    # measured\n", format_duration(time)));
        format!(
            "\n{note}{head}profile = \"{first}\"\n{}",
            turnaround.unwrap_or_default()
        )
    }
}

/// A measured time to begin a reply, in whole milliseconds, if it is longer than the usual time.
fn slower_than(measured: Duration, usual: Duration) -> Option<Duration> {
    let whole = Duration::from_millis(u64::try_from(measured.as_micros().div_ceil(1000)).unwrap_or(u64::MAX));
    let whole = whole.min(Duration::from_secs(1));
    (measured > usual + Duration::from_millis(1)).then_some(whole)
}

/// The lines `cycle` and `slow_cycle`, with values that the line can keep.
fn cadence(bus: &BusSettings) -> String {
    let Some((cycle, slow_cycle)) = predict::carried(&bus.spec, bus.options.silence, &bus.drives) else {
        return String::new();
    };
    let mut settled = bus.clone();
    (settled.spec.cycle, settled.spec.slow_cycle) = (cycle, slow_cycle);
    format!(
        "cycle = \"{}\"    # takes {:.0} % of the line, with slow_cycle\nslow_cycle = \"{}\"\n",
        format_duration(cycle),
        settled.predict().demand * 100.0,
        format_duration(slow_cycle)
    )
}

fn commented(comment: bool, text: &str) -> String {
    if !comment {
        return text.to_string();
    }
    let line = |line: &str| match line {
        "" => String::new(),
        line if line.starts_with('#') => line.to_string(),
        line => format!("# {line}"),
    };
    let lines: Vec<String> = text.split('\n').map(line).collect();
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_proto::{LineFormat, Protocol};

    fn found(protocol: Protocol, address: u8, profiles: &[&str]) -> Found {
        let format = LineFormat::new(9600, "8N1").unwrap();
        Found {
            setting: Setting { protocol, format },
            address,
            profiles: profiles.iter().map(ToString::to_string).collect(),
            chosen: false,
            nameplate: String::new(),
            unanswered: 0,
            turnaround: None,
        }
    }

    fn text_of(port: &str, found: &[Found]) -> String {
        text_in(Mode::Master, port, found)
    }

    fn text_in(mode: Mode, port: &str, found: &[Found]) -> String {
        let snippet = Snippet {
            port,
            found,
            profiles: &Profiles::built_in(),
            profile_dirs: Vec::new(),
            timeout: None,
            mode,
        };
        snippet.text()
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
        let modes = [Mode::Master, Mode::Listen];
        for (case, mode) in cases.iter().flat_map(|case| modes.map(|mode| (case, mode))) {
            let text = text_in(mode, "/dev/serial/by-id/usb-\"x\"", case);
            let loaded = Settings::parse("found.toml", &text, std::iter::empty());
            let problems: Vec<String> = [&loaded.errors, &loaded.warnings]
                .into_iter()
                .flatten()
                .map(ToString::to_string)
                .collect();
            assert_eq!(problems, [""; 0], "{text}");
            let settings = loaded.settings.unwrap();
            assert!(
                settings.buses.iter().all(|bus| bus.listens() == (mode == Mode::Listen)),
                "{text}"
            );
            let drives = settings.buses.iter().flat_map(|b| &b.drives);
            let known = case
                .iter()
                .filter(|f| !f.profiles.is_empty() && f.setting.protocol == case[0].setting.protocol);
            assert_eq!(
                drives.map(|d| d.address).collect::<Vec<_>>(),
                known.map(|f| f.address).collect::<Vec<_>>()
            );
        }
    }

    #[test]
    fn what_it_says_of_the_drives() {
        let rtu = Protocol::ModbusRtu;
        let mut drives = [
            found(rtu, 1, &["eaton-hvx", "eaton-svx"]),
            found(rtu, 2, &[]),
            found(rtu, 3, &[]),
            found(rtu, 4, &["vacon-nx"]),
        ];
        drives[2].unanswered = 2;
        drives[3].turnaround = Some(Duration::from_micros(15_300));
        let text = text_of("/dev/x", &drives);
        for wanted in [
            "\n# By reading alone eaton-hvx cannot be distinguished from eaton-svx: check the nameplate.\n# This is \
             an older OPT-C2 board: an Eaton, or a Vacon NX with an older board.\n[[bus.drive]]\nname = \"drive-1\"\n",
            "\n# This is a Vacon NX or Eaton with an OPT-C2 board of 2012 or later, or a Vacon 10.\n[[bus.drive]]\nname = \"drive-4\"\n",
            "\n# No read shows the family of this device: --profile NAME names it, `drivegate profiles` lists the names.\n# [[bus.drive]]\n",
            "\n# The family of this drive is unknown, because 2 reads got no reply: scan again with --tries 3.\n# [[bus.drive]]\n",
            "profile = \"vacon-nx\"\nturnaround = \"16ms\"    # measured\n",
            "\ncycle = \"",
            "\n[http]\nlisten = \"127.0.0.1:9488\"",
        ] {
            assert!(text.contains(wanted), "{wanted} is not in\n{text}");
        }
        assert!(text_of("tcp://server:4001", &drives).contains("enter its settings here"));
    }

    #[test]
    fn what_was_chosen_stands_in_it() {
        let snippet = Snippet {
            port: "/dev/x",
            found: &[found(Protocol::ModbusRtu, 1, &["vacon-nx"])],
            profiles: &Profiles::built_in(),
            profile_dirs: vec![PathBuf::from("/etc/profiles")],
            timeout: Some(Duration::from_millis(500)),
            mode: Mode::Master,
        };
        let text = snippet.with_cadence("");
        assert!(
            text.contains("profile_dirs = [\"/etc/profiles\"]\n") && text.contains("response_timeout = \"500ms\"\n")
        );
    }
}
