//! What is known of a drive that answered. Pure.

use std::time::Duration;

use super::settings::Setting;

/// A drive that answered.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Found {
    /// Settings of the line.
    pub(crate) setting: Setting,
    /// Address of the drive.
    pub(crate) address: u8,
    /// Profiles that match its answers; none, one, or some that cannot be distinguished by reading.
    pub(crate) profiles: Vec<String>,
    /// Reads that tell families apart and got no answer: neither values nor a refusal.
    pub(crate) unanswered: usize,
    /// Time that it takes to begin a reply, the median; absent if it gave no values.
    pub(crate) turnaround: Option<Duration>,
}

impl Found {
    /// For people.
    pub(crate) fn title(&self) -> String {
        match self.profiles.as_slice() {
            [] if self.unanswered > 0 => format!("family not known, because {}", self.silence()),
            [] => "no known profile".to_string(),
            [one] => one.clone(),
            some => format!("{} (indistinguishable by reading)", some.join(" or ")),
        }
    }

    /// `2 reads got no answer`.
    pub(super) fn silence(&self) -> String {
        match self.unanswered {
            1 => "1 read got no answer".to_string(),
            more => format!("{more} reads got no answer"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec::{LineFormat, Protocol};

    #[test]
    fn silence_is_no_refusal() {
        let found = |profiles: &[&str], unanswered| Found {
            setting: Setting {
                protocol: Protocol::ModbusRtu,
                format: LineFormat::new(9600, "8N1").unwrap(),
            },
            address: 1,
            profiles: profiles.iter().map(ToString::to_string).collect(),
            unanswered,
            turnaround: None,
        };
        assert_eq!(found(&[], 0).title(), "no known profile");
        assert_eq!(found(&[], 2).title(), "family not known, because 2 reads got no answer");
        assert_eq!(found(&["a", "b"], 0).title(), "a or b (indistinguishable by reading)");
        assert_eq!(found(&["a"], 1).title(), "a");
    }
}
