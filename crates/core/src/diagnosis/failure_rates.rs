//! The failure rates of the drives of a line that were polled often enough, and how much worse one is than the others.

use super::Drive;
use super::figures::Sign;
use drivegate_model::drive::DriveIndex;

/// Transactions in the last minute from which on the failure rate of a drive is known.
const KNOWN: u32 = 15;
/// Anything seen in fewer steps of 5 s is a passing disturbance.
pub(super) const LASTING: usize = 3;
/// Number in a minute below which a sign counts as chance.
pub(super) const FEW: u32 = 5;
/// Number of standard deviations that rule out chance.
pub(super) const SIGNIFICANT: f64 = 5.0;
/// Errors that a drive as bad as another one would have had in its transactions; with this many expected and none
/// seen, the drive is good: chance gives that less than once in 400 times.
pub(super) const ENOUGH: f64 = 6.0;
/// A drive is bad if its errors are this many times as frequent as those of the other drives.
const TIMES: f64 = 5.0;

/// The known failure rates of one drive.
#[derive(Debug, Clone, Copy)]
pub(super) struct FailureRates {
    pub(super) place: DriveIndex,
    pub(super) asked: u32,
    pub(super) failed: u32,
    pub(super) silent: u32,
    pub(super) damaged: u32,
    pub(super) lasting: bool,
}

impl FailureRates {
    pub(super) fn share(&self) -> f64 {
        share(self.failed, self.asked)
    }

    pub(super) fn is_bad(&self) -> bool {
        self.failed >= FEW && self.share() >= 0.02
    }
}

pub(super) fn share(part: u32, of: u32) -> f64 {
    f64::from(part) / f64::from(of.max(1))
}

pub(super) fn sums<'k>(drives: impl IntoIterator<Item = &'k FailureRates>) -> (u32, u32) {
    drives
        .into_iter()
        .fold((0, 0), |(failed, asked), one| (failed + one.failed, asked + one.asked))
}

/// Whether `failed` of `asked` requests are more than chance allows at the usual `rate`.
pub(super) fn exceeds(failed: u32, asked: u32, rate: f64) -> bool {
    let expected = f64::from(asked) * rate;
    f64::from(failed) > expected + SIGNIFICANT * expected.max(1.0).sqrt()
}

/// Whether the first `count` of these drives, sorted from the worst, are all bad and much worse than the others.
pub(super) fn stand_out(known: &[FailureRates], count: usize) -> bool {
    let Some((bad, good)) = known.split_at_checked(count) else {
        return false;
    };
    let (failed, asked) = sums(good);
    let usual = share(failed, asked).max(0.5 / f64::from(asked.max(1)));
    let stands_out =
        |one: &FailureRates| one.is_bad() && one.share() >= TIMES * usual && exceeds(one.failed, one.asked, usual);
    good.len() >= 2 && asked >= 60 && bad.iter().all(stands_out)
}

impl FailureRates {
    /// The known failure rates of the drive at this index, if it was polled often enough.
    pub(super) fn of(place: DriveIndex, drive: &Drive) -> Option<FailureRates> {
        let (silent, damaged) = (drive.sum(Sign::Silent), drive.sum(Sign::Damaged));
        let others = drive.sum(Sign::Answered) + drive.sum(Sign::StartLost) + drive.sum(Sign::CutEcho);
        let asked = others + silent + damaged;
        // A bad drive is polled less often over time, so a few failures are enough.
        (asked >= KNOWN || silent + damaged >= FEW).then(|| FailureRates {
            place,
            asked,
            failed: silent + damaged,
            silent,
            damaged,
            lasting: drive.steps(&[Sign::Silent, Sign::Damaged]) >= LASTING,
        })
    }
}
