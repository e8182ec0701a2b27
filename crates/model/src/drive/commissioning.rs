//! The steps for the engineer at the cabinet, as lines of the profile: one source for pages, `profiles show`, `scan`
//! and the verdicts of the diagnosis.

use super::profile::Profile;

/// A step of commissioning a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Step {
    /// Connection: slot, connector, terminals, shield.
    Connect,
    /// Termination and bias of the line.
    Terminate,
    /// Settings for protocol, address, baud rate, parity and timeout, and their factory values.
    Settings,
    /// How to make the drive obey the bus.
    ControlPlace,
    /// Setting for the drive's own timeout, and the messages that restart it.
    Timeout,
    /// Meaning of lamps and panel.
    Lamps,
    /// How to test the drive.
    Test,
}

impl Step {
    /// All commissioning steps in their order.
    pub const ALL: [Step; 7] = [
        Step::Connect,
        Step::Terminate,
        Step::Settings,
        Step::ControlPlace,
        Step::Timeout,
        Step::Lamps,
        Step::Test,
    ];

    /// The key of the step in a profile.
    pub const fn name(self) -> &'static str {
        match self {
            Step::Connect => "connect",
            Step::Terminate => "terminate",
            Step::Settings => "settings",
            Step::ControlPlace => "control_place",
            Step::Timeout => "timeout",
            Step::Lamps => "lamps",
            Step::Test => "test",
        }
    }

    /// The heading of the step.
    pub const fn title(self) -> &'static str {
        match self {
            Step::Connect => "connect",
            Step::Terminate => "terminate and bias",
            Step::Settings => "settings",
            Step::ControlPlace => "control place",
            Step::Timeout => "the drive's own timeout",
            Step::Lamps => "lamps and panel",
            Step::Test => "test",
        }
    }
}

/// The lines of each step; empty without a manual.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Commissioning {
    pub(super) connect: Vec<String>,
    pub(super) terminate: Vec<String>,
    pub(super) settings: Vec<String>,
    pub(super) control_place: Vec<String>,
    pub(super) timeout: Vec<String>,
    pub(super) lamps: Vec<String>,
    pub(super) test: Vec<String>,
}

impl Commissioning {
    /// The text lines of a step.
    pub fn lines(&self, step: Step) -> &[String] {
        match step {
            Step::Connect => &self.connect,
            Step::Terminate => &self.terminate,
            Step::Settings => &self.settings,
            Step::ControlPlace => &self.control_place,
            Step::Timeout => &self.timeout,
            Step::Lamps => &self.lamps,
            Step::Test => &self.test,
        }
    }

    /// Whether no step has a line.
    pub fn is_empty(&self) -> bool {
        Step::ALL.iter().all(|step| self.lines(*step).is_empty())
    }
}

/// A line, with the profiles that contain it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Shared<'p> {
    /// Names of the profiles, in the order given.
    pub profiles: Vec<&'p str>,
    /// The text line.
    pub line: &'p str,
}

/// The text lines of these steps from several profiles: each line once, those of the first profile first.
pub fn gather<'p>(profiles: &[&'p Profile], steps: &[Step]) -> Vec<Shared<'p>> {
    let mut gathered: Vec<Shared<'p>> = Vec::new();
    for step in steps {
        // A line that one profile has in two steps is shown for both.
        let start = gathered.len();
        for profile in profiles {
            for line in profile.commissioning.lines(*step) {
                let known = gathered.iter_mut().skip(start).find(|shared| shared.line == line);
                match known {
                    Some(shared) if shared.profiles.contains(&profile.name.as_str()) => {}
                    Some(shared) => shared.profiles.push(&profile.name),
                    None => gathered.push(Shared {
                        profiles: vec![&profile.name],
                        line,
                    }),
                }
            }
        }
    }
    gathered
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drive::profile::Profiles;

    #[test]
    fn equal_lines_are_told_once() {
        let all = Profiles::built_in();
        let two = [all.get("vacon-nx").unwrap(), all.get("eaton-hvx").unwrap()];
        let two = two.map(|profile| profile.as_ref());
        let lamps = gather(&two, &[Step::Lamps]);
        assert!(lamps.iter().all(|shared| shared.profiles == ["vacon-nx", "eaton-hvx"]));
        assert_eq!(lamps.len(), two[0].commissioning.lines(Step::Lamps).len());
        let settings = gather(&two, &[Step::Settings]);
        let of = |name: &str| settings.iter().filter(|shared| shared.profiles == [name]).count();
        assert!(of("vacon-nx") > 0 && of("eaton-hvx") > 0, "{settings:?}");
    }
}
