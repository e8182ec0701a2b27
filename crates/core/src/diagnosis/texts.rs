//! Texts of the causes and remedies.

use std::collections::BTreeSet;

use super::Cause;
use drivegate_model::drive::commissioning::{Shared, gather};
use drivegate_model::drive::{Profile, Step};

/// Maximum number of steps reported with a verdict.
const MOST_STEPS: usize = 96;

impl Cause {
    /// Meaning of the cause, in a few words.
    pub const fn meaning(self) -> &'static str {
        match self {
            Cause::AllSilent => "no drive answers",
            Cause::OneDrive => "one drive is badly connected or slow, the others are fine",
            Cause::FromAddress => "all drives from one address upwards have errors",
            Cause::NeverAnswered => "it has never answered, while other drives do",
            Cause::AddressTwice => "two drives answer to one address",
            Cause::WhileRunning => "errors occur only while drives run",
            Cause::Mains => "errors follow the mains frequency",
            Cause::Bias => "stray bytes while the line is idle",
            Cause::ReplyStartLost => "the start of replies is lost",
            Cause::RequestEndLost => "requests arrive truncated",
            Cause::Echo => "the adapter receives its own requests",
            Cause::LatencyTimer => "the adapter delivers replies in steps of 16 ms",
            Cause::SilenceTooShort => "requests sent soon after a reply are ignored",
            Cause::PortResets => "the adapter keeps disconnecting",
            Cause::ConnectionCloses => "the device server keeps closing its connection",
            Cause::FasterThanBaud => "replies arrive faster than the configured baud rate allows",
            Cause::RegisterUnanswered => "the drive answers, but never reads of certain registers",
            Cause::OwnTimeout => "the drive's own timeout tripped it soon after a command",
            Cause::Noise => "errors without a pattern",
        }
    }

    /// Remedy for the cause.
    pub const fn remedy(self) -> &'static str {
        match self {
            Cause::AllSilent => {
                "check the drives' power supply, A and B (try swapping them), baud rate, format and protocol, and \
                 that the fieldbus is enabled in the drives; `sudo fuser -v PORT` names a program that takes the \
                 replies; `drivegate scan` tries other settings"
            }
            Cause::OneDrive => {
                "check this drive's cable, terminals and power supply, and that no other drive has its address; if \
                 its replies are late, raise its response_timeout"
            }
            Cause::FromAddress => {
                "if addresses follow the cable, check cable and terminals just before the first of these drives; \
                 check the termination at both ends of the line"
            }
            Cause::NeverAnswered => {
                "check its power supply, that its fieldbus is enabled, and at its panel address, protocol, baud rate \
                 and format; `drivegate scan` shows which addresses answer; then check its cable and terminals; \
                 remove it from the configuration if it does not exist"
            }
            Cause::AddressTwice => {
                "switch this drive off: if its address still answers, change the address of the other drive"
            }
            Cause::WhileRunning => {
                "use shielded twisted pair, earth the shield as the drives' manual says, and keep it away from motor \
                 cables (30 cm or more); earth the motor cable shields at both ends"
            }
            Cause::Mains => {
                "look for an earth loop: connect the reference conductor of the line, the shield as the drives' \
                 manual says, and keep the line away from mains cables; an isolated adapter helps"
            }
            Cause::Bias => {
                "bias the line at one point (pull-up on one conductor, pull-down on the other, often switches on the \
                 adapter), terminate both ends, and connect the reference conductor"
            }
            Cause::ReplyStartLost => {
                "the adapter switches from sending to receiving too late: use one that switches by itself, or with \
                 rs485 = \"kernel\" a shorter delay after sending; or increase the reply delay of the drive"
            }
            Cause::RequestEndLost => {
                "if the adapter is switched by RTS, it stops sending too early: lengthen the RTS delay or use an \
                 adapter that switches by itself; otherwise look for interference on the way to the drives"
            }
            Cause::Echo => {
                "harmless, but it costs bytes and hides collisions: a four-wire adapter is wired for two wires; \
                 switch on its echo suppression"
            }
            Cause::LatencyTimer => {
                "set the latency timer of the USB adapter to 1 ms: docs/performance.md, real \
                                    adapters"
            }
            Cause::SilenceTooShort => "set a longer silence for the bus, such as silence = \"10ms\"",
            Cause::PortResets => {
                "check the USB cable, plug and hub, and the adapter's power supply; an isolated adapter withstands \
                 interference from drives; the log has the reasons"
            }
            Cause::ConnectionCloses => {
                "set the device server to keep its connection: switch off its idle or inactivity timeout and any mode \
                 that closes after each request, and make sure that no second program connects to it; each new \
                 connection takes time from the line"
            }
            Cause::FasterThanBaud => {
                "set baud of the bus to the rate of the line behind the device server: the time on the wire, and what \
                 counts as a late reply, are calculated from it"
            }
            Cause::RegisterUnanswered => "leave the registers out of the profile, or correct their addresses",
            Cause::OwnTimeout => "compare the drive's own timeout with what the gateway writes and polls",
            Cause::Noise => {
                "check termination at both ends, the reference conductor, and the cable's shield and route; trying a \
                 lower baud rate shows whether it is the cable"
            }
        }
    }

    /// The commissioning steps to check for this cause.
    pub const fn steps(self) -> &'static [Step] {
        match self {
            Cause::AllSilent | Cause::NeverAnswered => &[Step::Lamps, Step::Settings],
            Cause::OwnTimeout => &[Step::Timeout],
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
            | Cause::FasterThanBaud
            | Cause::RegisterUnanswered => &[],
        }
    }

    /// The steps of the cause from the profiles of these drives: what to check and what to set.
    pub fn steps_of<'p>(self, profiles: impl IntoIterator<Item = &'p Profile>) -> Vec<String> {
        step_lines(profiles, self.steps())
    }
}

/// The text lines of these steps, each after the names of the profiles that have it, without repetition.
pub fn step_lines<'p>(profiles: impl IntoIterator<Item = &'p Profile>, steps: &[Step]) -> Vec<String> {
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
    use drivegate_model::drive::profile::Profiles;
    use drivegate_proto::Protocol;

    /// Every family with a manual has its checks for a silent drive in the text, and no check is cut off.
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
