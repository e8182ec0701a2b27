//! A run command that a client repeats while the motor runs: whatever becomes of the repetition, the motor is not stopped.

use super::*;
use drivegate_core::order::written;

/// Families that are started by a sequence of words, with their run word.
const SEQUENCES: [(&str, u16); 5] = [
    ("abb-acs550", 0x047F),
    ("abb-acs580", 0x047F),
    ("schneider-altivar", 0x000F),
    ("siemens-g120", 0x047F),
    ("siemens-v20", 0x047F),
];

/// What becomes of each write of the repetition.
#[derive(Debug, Clone, Copy)]
enum Fate {
    Silent,
    Refused,
    /// The bus sends other requests first, until the order has expired.
    Unsent,
}

/// A running drive whose word is known, and the repetition.
fn repeats(family: &str, word: u16) -> (ObedientDrive, CommandRun) {
    let mut bench = ObedientDrive {
        profile: Profiles::built_in().get(family).unwrap().clone(),
        running: true,
        ..ObedientDrive::new(0)
    };
    let at = bench.profile.control.as_ref().unwrap().at;
    bench.words.learn(at.table, at.address, word);
    let (run, _answer) = bench.begin(&[("run", 1.0)], Urgency::Command);
    (bench, run)
}

#[test]
fn a_repetition_that_fails_stops_no_motor() {
    for (family, word) in SEQUENCES {
        for fate in [Fate::Silent, Fate::Refused, Fate::Unsent] {
            let (mut bench, mut run) = repeats(family, word);
            let mut words = Vec::new();
            for _ in 0..20 {
                let step = match run.next(&bench.words, &bench.profile, true, bench.now) {
                    Next::Done => break,
                    Next::Wait(until) => {
                        bench.now = until;
                        continue;
                    }
                    Next::Send(step) => step,
                };
                if let Some((_, items)) = written(&step.pdu) {
                    words.extend(items.into_iter().map(|(_, word)| word));
                }
                let outcome = match fate {
                    Fate::Unsent => {
                        bench.now += Duration::from_secs(5);
                        continue;
                    }
                    Fate::Silent => {
                        run.sent(&step);
                        run.failed(&step, Outcome::TimedOut, 1)
                    }
                    Fate::Refused => {
                        run.sent(&step);
                        let refused = Reply::Exception(Exception::DEVICE_FAILURE);
                        run.answered(&step, refused, &mut bench.words)
                    }
                };
                if outcome.is_some() {
                    break;
                }
            }
            assert!(
                !words.is_empty() && words.iter().all(|sent| *sent == word),
                "{family}, {fate:?}: {words:04X?}"
            );
        }
    }
}
