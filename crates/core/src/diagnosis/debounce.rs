//! A verdict is published when its rule has held for some time, and withdrawn when the rule has not held for a minute.

use super::{Cause, Certainty, Finding};

/// Steps of 5 s after which a verdict whose rule no longer holds is withdrawn.
const GOES_AFTER: u32 = 12;
/// Maximum number of verdicts of one line that are kept at a time.
const MOST_VERDICTS: usize = 24;

/// A finding with the time for which its rule holds.
#[derive(Debug, Clone, PartialEq)]
struct Debounced {
    finding: Finding,
    /// Steps in which the rule held, minus steps in which it did not.
    holds: u32,
    /// Steps since the rule last held.
    missing: u32,
    shown: bool,
}

/// A change of the shown verdicts.
#[derive(Debug, Clone, PartialEq)]
pub enum Change {
    /// The finding is shown from now on.
    Came(Finding),
    /// The finding is more certain than before.
    Firmer(Finding),
    /// The finding is no longer shown.
    Went(Finding),
}

/// The findings of a line and how long they hold.
#[derive(Debug, Clone, Default)]
pub struct Debounce {
    held: Vec<Debounced>,
}

/// Steps for which a rule must hold, in addition to those in which it did not. Causes that only say that nothing
/// else was recognised wait until any other cause would have been recognised.
fn patience(cause: Cause) -> u32 {
    match cause {
        Cause::Noise | Cause::RequestEndLost => 5,
        Cause::OneDrive | Cause::FromAddress => 3,
        Cause::PortResets | Cause::OwnTimeout => 1,
        _ => 2,
    }
}

impl Debounce {
    /// Takes the findings of the rules in this step; returns the changes.
    pub fn take(&mut self, found: Vec<Finding>) -> Vec<Change> {
        let mut changes = Vec::new();
        for held in &mut self.held {
            held.missing += 1;
        }
        for finding in found {
            self.found(finding, &mut changes);
        }
        for held in &mut self.held {
            if held.missing > 0 {
                held.holds = held.holds.saturating_sub(1);
            }
        }
        self.held.retain(|held| {
            let goes = held.missing >= GOES_AFTER || (!held.shown && held.holds == 0);
            if goes && held.shown {
                changes.push(Change::Went(held.finding.clone()));
            }
            !goes
        });
        changes
    }

    fn found(&mut self, finding: Finding, changes: &mut Vec<Change>) {
        let same = |held: &&mut Debounced| held.finding.cause == finding.cause && held.finding.drive == finding.drive;
        let Some(held) = self.held.iter_mut().find(same) else {
            if self.held.len() < MOST_VERDICTS {
                let shown = patience(finding.cause) <= 1;
                if shown {
                    changes.push(Change::Came(finding.clone()));
                }
                self.held.push(Debounced {
                    finding,
                    holds: 1,
                    missing: 0,
                    shown,
                });
            }
            return;
        };
        let before = held.finding.certainty;
        // A published finding keeps its certainty in a step that has less evidence.
        let certainty = if held.shown {
            before.max(finding.certainty)
        } else {
            finding.certainty
        };
        held.finding = Finding { certainty, ..finding };
        (held.holds, held.missing) = (held.holds + 1, 0);
        if !held.shown && held.holds >= patience(held.finding.cause) {
            held.shown = true;
            changes.push(Change::Came(held.finding.clone()));
        } else if held.shown && certainty > before {
            changes.push(Change::Firmer(held.finding.clone()));
        }
    }

    /// The present verdicts, most certain first.
    pub fn shown(&self) -> impl Iterator<Item = &Finding> {
        let mut shown: Vec<&Finding> = self
            .held
            .iter()
            .filter(|held| held.shown)
            .map(|held| &held.finding)
            .collect();
        shown.sort_by_key(|finding| {
            (
                std::cmp::Reverse::<Certainty>(finding.certainty),
                finding.cause,
                finding.drive,
            )
        });
        shown.into_iter()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn finding(cause: Cause, certainty: Certainty) -> Finding {
        Finding {
            cause,
            drive: None,
            certainty,
            evidence: String::new(),
            remedy: None,
        }
    }

    #[test]
    fn a_verdict_comes_by_lasting_evidence_and_goes_without_it() {
        let fits = || vec![finding(Cause::Bias, Certainty::Fits)];
        let likely = || vec![finding(Cause::Bias, Certainty::Likely)];
        let mut debounce = Debounce::default();
        // A finding in a single step is chance, even if such single steps repeat.
        for _ in 0..10 {
            assert_eq!(debounce.take(fits()), []);
            assert_eq!(debounce.take(Vec::new()), []);
        }
        assert_eq!(debounce.take(fits()), []);
        assert_eq!(
            debounce.take(fits()),
            [Change::Came(finding(Cause::Bias, Certainty::Fits))]
        );
        assert_eq!(
            debounce.take(likely()),
            [Change::Firmer(finding(Cause::Bias, Certainty::Likely))]
        );
        assert_eq!(debounce.take(fits()), [], "it does not become less certain");
        for step in 1..GOES_AFTER {
            assert_eq!(debounce.take(Vec::new()), [], "{step}");
            assert_eq!(debounce.shown().count(), 1);
        }
        assert_eq!(
            debounce.take(Vec::new()),
            [Change::Went(finding(Cause::Bias, Certainty::Likely))]
        );
        assert_eq!(debounce.shown().count(), 0);
    }

    #[test]
    fn what_only_fits_because_nothing_else_does_waits() {
        let mut debounce = Debounce::default();
        let steps = (1..).find(|_| !debounce.take(vec![finding(Cause::Noise, Certainty::Likely)]).is_empty());
        assert_eq!(steps, Some(5));
    }
}
