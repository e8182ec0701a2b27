//! How causes are told to people.

use std::collections::BTreeSet;

use super::Cause;
use crate::drive::commissioning::{Shared, gather};
use crate::drive::{Profile, Step};

/// Most steps that are told with a verdict.
const MOST_STEPS: usize = 96;

impl Cause {
    /// What it means, in a few words.
    pub const fn meaning(self) -> &'static str {
        match self {
            Cause::AllSilent => "no drive answers",
            Cause::OneDrive => "one drive is badly connected or slow, the others are good",
            Cause::FromAddress => "all drives are bad from one address on",
            Cause::NeverAnswered => "it has never answered, and other drives do",
            Cause::AddressTwice => "two drives answer to one address",
            Cause::WhileRunning => "errors come only while drives run",
            Cause::Mains => "errors come in step with the mains",
            Cause::Bias => "stray bytes come while nobody speaks",
            Cause::ReplyStartLost => "the beginning of replies is lost",
            Cause::RequestEndLost => "requests arrive truncated",
            Cause::Echo => "the adapter hears its own requests",
            Cause::LatencyTimer => "the adapter hands replies over in steps of 16 ms",
            Cause::SilenceTooShort => "requests sent soon after a reply are ignored",
            Cause::PortResets => "the adapter goes and comes back",
            Cause::ConnectionCloses => "the device server closes its connection again and again",
            Cause::FasterThanBaud => "replies come sooner than the configured baud rate allows",
            Cause::Noise => "errors without a pattern",
        }
    }

    /// What to do.
    pub const fn remedy(self) -> &'static str {
        match self {
            Cause::AllSilent => {
                "check the supply of the drives, A and B (swap them), baud, format and protocol, and that the bus is enabled at \
                 the drives; `drivegate scan` tries other settings"
            }
            Cause::OneDrive => {
                "check the cable and terminals of this drive, that no other drive has its address, and its supply; where its \
                 replies come late, raise response_timeout of the bus"
            }
            Cause::FromAddress => {
                "check the cable and terminals before the first of these drives, if addresses follow the cable, and the \
                 termination at both ends of the line"
            }
            Cause::NeverAnswered => {
                "check its supply and that its bus is enabled, and, at its panel, address, protocol, baud and format; `drivegate scan` shows \
                 which addresses answer; then its cable and terminals; take it out of the configuration if it is not there"
            }
            Cause::AddressTwice => {
                "switch this drive off: if its address still answers, give the other drive another one"
            }
            Cause::WhileRunning => {
                "use shielded twisted pair, earth the shield as the drives' manual says, and keep it away from motor cables (30 cm \
                 or more); earth the motor cables at both ends"
            }
            Cause::Mains => {
                "look for a loop through earth: connect the reference conductor of the line, the shield as the drives' manual \
                 says, and keep the line away from mains cables; an isolated adapter helps"
            }
            Cause::Bias => {
                "bias the line at one place (pull-up at one conductor, pull-down at the other, often switches of the adapter), \
                 terminate both ends, and connect the reference conductor"
            }
            Cause::ReplyStartLost => {
                "the adapter turns from sending to receiving too late: use one that turns by itself, or with rs485 = \"kernel\" a \
                 shorter delay after sending; at the drive, raise the delay before its reply"
            }
            Cause::RequestEndLost => {
                "if the adapter is turned by RTS, it stops sending too early: lengthen the RTS delay or use an adapter that turns \
                 by itself; else look for what disturbs the way to the drives"
            }
            Cause::Echo => {
                "harmless, but it costs bytes and hides collisions: two-wire wiring of a four-wire adapter, switch its echo \
                 suppression on"
            }
            Cause::LatencyTimer => "set the latency timer of the USB adapter to 1 ms: docs/performance.md, adapters",
            Cause::SilenceTooShort => "set a longer silence of the bus, such as silence = \"10ms\"",
            Cause::PortResets => {
                "check the USB cable, plug and hub, and the supply of the adapter; an isolated adapter survives what drives \
                 induce; the log has the reasons"
            }
            Cause::ConnectionCloses => {
                "set the device server to keep its connection: switch off its idle or inactivity timeout, and a mode that closes \
                 after each request; that no second program connects to it in turn; each new connection takes time from the line"
            }
            Cause::FasterThanBaud => {
                "set baud of the bus to the rate of the line behind the device server: it decides how long a request \
                 and its reply are on the wire, and what a late reply is"
            }
            Cause::Noise => {
                "check termination at both ends, the reference conductor, and shield and course of the cable; a lower baud rate \
                 shows whether it is the cable"
            }
        }
    }

    /// The steps of the commissioning that it questions.
    pub const fn steps(self) -> &'static [Step] {
        match self {
            Cause::AllSilent | Cause::NeverAnswered => &[Step::Lamps, Step::Settings],
            Cause::OneDrive | Cause::WhileRunning => &[Step::Connect],
            Cause::FromAddress | Cause::Bias | Cause::RequestEndLost | Cause::Noise => &[Step::Terminate],
            Cause::AddressTwice
            | Cause::Mains
            | Cause::ReplyStartLost
            | Cause::Echo
            | Cause::LatencyTimer
            | Cause::SilenceTooShort
            | Cause::PortResets
            | Cause::ConnectionCloses
            | Cause::FasterThanBaud => &[],
        }
    }

    /// Those steps in the words of these profiles: what to look at and to set at their drives.
    pub fn steps_of<'p>(self, profiles: impl IntoIterator<Item = &'p Profile>) -> Vec<String> {
        told(profiles, self.steps())
    }
}

/// The lines of these steps, each behind the names of its profiles, without repetition.
pub fn told<'p>(profiles: impl IntoIterator<Item = &'p Profile>, steps: &[Step]) -> Vec<String> {
    let mut seen = BTreeSet::new();
    let profiles: Vec<&Profile> = profiles.into_iter().filter(|one| seen.insert(&one.name)).collect();
    let line = |Shared { profiles, line }: Shared<'_>| format!("{}: {line}", profiles.join(", "));
    gather(&profiles, steps)
        .into_iter()
        .take(MOST_STEPS)
        .map(line)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec::Protocol;
    use crate::drive::profile::Profiles;

    /// Of every family whose manual is at hand, what a silent one has to be looked at for, and nothing is cut off.
    #[test]
    fn steps_are_those_of_the_families_on_the_line() {
        let all = Profiles::built_in();
        let families = || {
            all.iter()
                .map(AsRef::as_ref)
                .filter(|one: &&Profile| one.base.is_none() && one.verified)
        };
        for (cause, protocol) in Cause::ALL
            .into_iter()
            .flat_map(|cause| Protocol::ALL.map(|protocol| (cause, protocol)))
        {
            let steps = cause.steps_of(families().filter(|one| one.protocols.contains(&protocol)));
            assert!(steps.len() < MOST_STEPS, "{cause:?}: {}", steps.len());
            assert_eq!(steps.is_empty(), cause.steps().is_empty(), "{cause:?}");
        }
        let silent = Cause::NeverAnswered.steps_of(families());
        for (name, part) in [
            ("vacon-nx", "has seen no message yet"),
            ("eaton-hvx", "menu M4"),
            ("vacon-cx", "8N1 by table 2-2"),
            ("teco-7300pa", "SW2-1 and SW2-2"),
        ] {
            let is = |step: &String| {
                step.split_once(": ")
                    .is_some_and(|(names, line)| names.split(", ").any(|one| one == name) && line.contains(part))
            };
            assert!(silent.iter().any(is), "{name}: {silent:#?}");
        }
        let one = Cause::FromAddress.steps_of([all.get("vacon-cx").unwrap().as_ref(); 3]);
        assert_eq!(one.len(), 1, "{one:?}");
        assert!(one[0].starts_with("vacon-cx: last drive: jumper X12"), "{one:?}");
    }
}
