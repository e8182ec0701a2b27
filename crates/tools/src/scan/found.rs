//! The facts known of a drive that answered. Pure.

use std::time::Duration;

use super::settings::Setting;
use drivegate_model::drive::profile::Profiles;

/// A drive that answered the scan.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Found {
    /// Settings of the line.
    pub(crate) setting: Setting,
    /// Address of the drive.
    pub(crate) address: u8,
    /// Profiles that match its answers: none, one, or several that cannot be distinguished by reading.
    pub(crate) profiles: Vec<String>,
    /// The command line or a person named the profile.
    pub(crate) chosen: bool,
    /// What a device calls itself that no read identifies; empty if nothing.
    pub(crate) nameplate: String,
    /// Reads that tell families apart and got no answer: neither values nor a refusal.
    pub(crate) unanswered: usize,
    /// Median of the time until the drive begins a reply; `None` if it returned no values.
    pub(crate) turnaround: Option<Duration>,
}

impl Found {
    /// Gives the drive the profile that was named for it.
    pub(crate) fn choose(&mut self, profile: &str) {
        self.profiles = vec![profile.to_string()];
        self.chosen = true;
    }

    /// Description of the drive for people.
    pub(crate) fn title(&self, profiles: &Profiles) -> String {
        let names = self.profiles.join(" or ");
        if self.chosen {
            return format!("{names} (as named, not identified)");
        }
        let more = [
            (self.profiles.len() > 1).then(|| "indistinguishable by reading".to_string()),
            self.identified(profiles),
        ];
        let more: Vec<String> = more.into_iter().flatten().collect();
        match (names.as_str(), more.as_slice()) {
            ("", _) if self.unanswered > 0 => format!("family unknown, because {}", self.silence()),
            ("", _) if self.nameplate.is_empty() => "a device whose family no read shows".to_string(),
            ("", _) => format!("a device whose family no read shows; its nameplate: {}", self.nameplate),
            (names, []) => names.to_string(),
            (names, more) => format!("{names} ({})", more.join("; ")),
        }
    }

    /// Meaning of the matching answers, where they do not prove the family.
    pub(super) fn identified(&self, profiles: &Profiles) -> Option<String> {
        let text = |name: &String| profiles.get(name).map(|profile| profile.identified.clone());
        if self.chosen {
            return None;
        }
        self.profiles.iter().filter_map(text).find(|text| !text.is_empty())
    }

    /// Remark such as `2 reads got no reply`.
    pub(super) fn silence(&self) -> String {
        match self.unanswered {
            1 => "1 read got no reply".to_string(),
            more => format!("{more} reads got no reply"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_proto::{LineFormat, Protocol};

    #[test]
    fn silence_is_no_refusal() {
        let found = |profiles: &[&str], unanswered| Found {
            setting: Setting {
                protocol: Protocol::ModbusRtu,
                format: LineFormat::new(9600, "8N1").unwrap(),
            },
            address: 1,
            profiles: profiles.iter().map(ToString::to_string).collect(),
            chosen: false,
            nameplate: String::new(),
            unanswered,
            turnaround: None,
        };
        let profiles = Profiles::built_in();
        let title = |names: &[&str], unanswered| found(names, unanswered).title(&profiles);
        assert_eq!(title(&[], 0), "a device whose family no read shows");
        assert_eq!(title(&[], 2), "family unknown, because 2 reads got no reply");
        assert_eq!(title(&["a", "b"], 0), "a or b (indistinguishable by reading)");
        assert_eq!(title(&["vacon-cx"], 1), "vacon-cx");
        // The board's answers do not prove the make of the drive.
        let board = title(&["vacon-nx"], 0);
        assert!(
            board.ends_with("nx (a Vacon NX or Eaton with an OPT-C2 board of 2012 or later, or a Vacon 10)"),
            "{board}"
        );
        let board = title(&["eaton-hvx", "eaton-svx"], 0);
        assert!(
            board.starts_with("eaton-hvx or eaton-svx (indistinguishable by reading; an older OPT-C2 board: "),
            "{board}"
        );
    }
}
