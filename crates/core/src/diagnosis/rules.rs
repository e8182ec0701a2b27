//! One rule for each cause. Counts are compared with chance, and a comparison between drives needs figures of most of them.

mod timing;

use std::time::{Duration, Instant};

use super::counters::{Contrast, MAINS, STEPS};
use super::failure_rates::{ENOUGH, FEW, FailureRates, LASTING, SIGNIFICANT, share, stand_out, sums};
use super::figures::{Figures, Sign};
use super::{Cause, Certainty, Finding};
use drivegate_model::drive::DriveIndex;

/// Failures that a verdict about the whole line needs at least.
const FEW_OF_LINE: u32 = 10;
/// Requests after which a drive that never replied is reported.
const IN_VAIN: u16 = 6;
/// Maximum number of silent drives that are reported one by one.
const NAMED: usize = 6;
/// Share of transactions below which a drive is good.
const GOOD: f64 = 0.003;

/// The rules, over the figures of one line.
#[derive(Debug)]
pub struct Rules<'f> {
    figures: &'f Figures,
    names: &'f [String],
    now: Instant,
    known: Vec<FailureRates>,
    /// Failures of other drives that are explained by a drive that replies to requests for others.
    disturbed: u32,
    /// Drives that are neither known nor absent.
    waiting: usize,
    found: Vec<Finding>,
}

/// The findings at `now`, most significant first; `names` are the names of the drives.
pub fn find(figures: &Figures, names: &[String], now: Instant) -> Vec<Finding> {
    let known: Vec<FailureRates> = figures
        .drives
        .enumerate()
        .filter_map(|(place, drive)| FailureRates::of(place, drive))
        .collect();
    let heard = [Sign::Answered, Sign::Damaged, Sign::StartLost, Sign::CutEcho, Sign::Led];
    let is_absent = |drive: &&super::Drive| drive.steps(&heard) == 0 && drive.sum(Sign::Tried) > 1;
    let absent = figures.drives.iter().filter(is_absent).count();
    let mut rules = Rules {
        waiting: figures.drives.len().saturating_sub(known.len() + absent),
        disturbed: 0,
        figures,
        names,
        now,
        known,
        found: Vec::new(),
    };
    rules.all();
    rules.found
}

impl Rules<'_> {
    fn all(&mut self) {
        if self.all_silent() {
            self.port_resets();
            self.connection_closes();
            return;
        }
        self.address_twice();
        self.while_running();
        self.mains();
        self.single_drives();
        self.never_answered();
        self.silence_too_short();
        self.bias();
        self.reply_start_lost();
        self.request_end_lost();
        self.echo();
        self.latency_timer();
        self.port_resets();
        self.connection_closes();
        self.faster_than_baud();
        self.noise();
    }

    fn add(&mut self, cause: Cause, drive: Option<DriveIndex>, certainty: Certainty, evidence: String) {
        self.found.push(Finding {
            cause,
            drive,
            certainty,
            evidence,
            remedy: None,
        });
    }

    fn has(&self, cause: Cause) -> bool {
        self.found.iter().any(|found| found.cause == cause)
    }

    fn is_reported(&self, place: DriveIndex) -> bool {
        self.found.iter().any(|found| found.drive == Some(place))
    }

    fn name(&self, place: DriveIndex) -> &str {
        self.names.get(place.place()).map_or("?", String::as_str)
    }

    fn names_of(&self, places: impl IntoIterator<Item = DriveIndex>) -> String {
        let names: Vec<&str> = places.into_iter().map(|place| self.name(place)).collect();
        match names.as_slice() {
            [first, second, third, _, rest @ ..] => format!("{first}, {second}, {third} and {} more", rest.len() + 1),
            few => few.join(", "),
        }
    }

    fn sum(&self, place: DriveIndex, sign: Sign) -> u32 {
        self.figures.drives.get(place).map_or(0, |drive| drive.sum(sign))
    }

    fn steps(&self, signs: &[Sign]) -> usize {
        self.figures
            .drives
            .iter()
            .map(|drive| drive.steps(signs))
            .max()
            .unwrap_or(0)
    }

    /// Transactions of the known drives, and how many of them failed.
    fn exchanges(&self) -> (u32, u32) {
        sums(&self.known)
    }

    fn all_silent(&mut self) -> bool {
        let figures = self.figures;
        let open = figures.open_for(self.now).unwrap_or_default();
        if open < Duration::from_secs(20) || figures.sum(Sign::Answered) > 0 {
            return false;
        }
        let drives = figures.drives.len();
        let (tried, damaged) = (
            figures.sum(Sign::Tried),
            figures.sum(Sign::Damaged) + figures.sum(Sign::Overlong),
        );
        let explained = figures.sum(Sign::StartLost) + figures.sum(Sign::CutEcho) + figures.sum(Sign::Led);
        let each = figures
            .drives
            .iter()
            .all(|drive| drive.sum(Sign::Tried) + drive.sum(Sign::Damaged) >= 2);
        // A single drive that has answered before is just switched off, which its offline event reports.
        let is_one = drives < 2 && figures.answered_since_opened();
        if !each || is_one || tried + damaged < 6 || explained > (tried + damaged) / 4 {
            return false;
        }
        let heard = match (damaged, figures.sum(Sign::Echoed)) {
            (0, 0) => "not a single byte came back".to_string(),
            (0, echoes) => {
                format!("{echoes} came back as the adapter's own echo and nothing else, so the adapter does send")
            }
            (_, _) => format!("{damaged} replies are not valid frames: baud rate, format or protocol probably differ"),
        };
        let certainty = if figures.answered_since_opened() || drives < 3 {
            Certainty::Fits
        } else {
            Certainty::Likely
        };
        let evidence = format!(
            "{} requests to {drives} drives in the last minute got no reply; {heard}",
            tried + damaged
        );
        self.add(Cause::AllSilent, None, certainty, evidence);
        true
    }

    fn address_twice(&mut self) {
        let seconds = self.figures.sum(Sign::Second) + self.figures.sum(Sign::Overlong);
        for known in self.known.clone() {
            let (second, overlong) = (
                self.sum(known.place, Sign::Second),
                self.sum(known.place, Sign::Overlong),
            );
            let shows = [Sign::Second, Sign::Overlong];
            let lasts = self
                .figures
                .drives
                .get(known.place)
                .is_some_and(|drive| drive.steps(&shows) >= LASTING);
            let of_others = seconds - second - overlong;
            let enough = second >= FEW || (second + overlong >= FEW - 1 && overlong * 5 >= known.damaged * 3);
            // Duplicate replies from more than one drive mean that the line repeats everything, not that two drives
            // share an address.
            if !lasts
                || !enough
                || of_others * 5 > second + overlong
                || self.known.len() < 2.min(self.figures.drives.len())
            {
                continue;
            }
            let certainty = if second >= FEW {
                Certainty::Likely
            } else {
                Certainty::Fits
            };
            let name = self.name(known.place);
            let evidence = format!(
                "{second} times in the last minute a second valid reply followed that of {name}, and {overlong} \
                 replies were longer than requested; {of_others} times for all other drives"
            );
            self.disturbed += second + overlong;
            self.add(Cause::AddressTwice, Some(known.place), certainty, evidence);
        }
    }

    /// Whether transactions fail under the second condition and not under the first.
    fn contrast(contrast: &Contrast) -> bool {
        let [asked, others] = contrast.transactions;
        let [failed, of_others] = contrast.failed;
        if asked < 100.0 || others < 40.0 || of_others < 10.0 {
            return false;
        }
        let (usual, now) = ((failed / asked).max(0.5 / asked), of_others / others);
        let expected = usual * others;
        now > 0.01 && now > 5.0 * usual && of_others > expected + SIGNIFICANT as f32 * expected.max(1.0).sqrt()
    }

    fn while_running(&mut self) {
        let running = *self.figures.while_running();
        let (failed, _) = self.exchanges();
        if !Self::contrast(&running) || failed < FEW || self.steps(&[Sign::Silent, Sign::Damaged]) < 2 {
            return;
        }
        let [standing, runs] = running.failed.map(f32::round);
        let [of_standing, of_runs] = running.transactions.map(f32::round);
        let evidence = format!(
            "recently, {runs} of {of_runs} transactions failed while a drive ran, {standing} of {of_standing} while \
             all were stopped"
        );
        let certainty = if runs >= 30.0 && of_standing >= 300.0 {
            Certainty::Likely
        } else {
            Certainty::Fits
        };
        self.add(Cause::WhileRunning, None, certainty, evidence);
    }

    fn mains(&mut self) {
        let phases = self.figures.in_phase();
        let best = MAINS
            .into_iter()
            .zip(phases)
            .max_by(|(_, a), (_, b)| a.1.total_cmp(&b.1));
        let Some((hertz, (count, closer))) = best else { return };
        // The standard deviation of the difference of two mean cosines: each deviates by the root of one half over
        // its number.
        if count < 40.0 || closer < 0.25 || closer < SIGNIFICANT as f32 / count.sqrt() {
            return;
        }
        let evidence = format!(
            "{count:.0} recent damaged replies came at the same phase of the {hertz:.0} Hz period, which valid ones \
             avoid"
        );
        let certainty = if closer > 0.5 {
            Certainty::Likely
        } else {
            Certainty::Fits
        };
        self.add(Cause::Mains, None, certainty, evidence);
    }

    /// Finds one bad drive, or a line that is bad from one address on.
    fn single_drives(&mut self) {
        if self.has(Cause::WhileRunning) || self.has(Cause::Mains) || self.may_be_of_running() {
            return;
        }
        self.answers_late();
        let mut known: Vec<FailureRates> = self
            .known
            .iter()
            .filter(|one| !self.is_reported(one.place))
            .copied()
            .collect();
        if self.waiting * 10 > self.figures.drives.len() || known.len() < 3 || sums(&known).0 <= self.disturbed {
            return;
        }
        known.sort_by(|a, b| b.share().total_cmp(&a.share()));
        let Some(count) = (1..known.len() - 1).rev().find(|count| stand_out(&known, *count)) else {
            return;
        };
        let (bad, good) = known.split_at(count);
        // Whether one drive or several are bad is decided only after all bad drives have been bad for some time and
        // every other drive had enough requests to show the same failures.
        let least = bad.iter().map(FailureRates::share).fold(1.0, f64::min);
        let is_good = |one: &FailureRates| {
            f64::from(one.asked) * least >= ENOUGH && (one.failed < 2 || one.share() * 4.0 < least)
        };
        if !bad.iter().all(|one| one.lasting) || !good.iter().all(is_good) {
            return;
        }
        let (failed, asked) = sums(good);
        let mut bad = bad.to_vec();
        let address = |one: &FailureRates| self.figures.drives.get(one.place).map(|drive| drive.address);
        bad.sort_by_key(address);
        let is_tail = good.iter().map(address).max() < bad.first().map(address);
        if bad.len() > 1 && is_tail {
            self.bad_tail(&bad, (failed, asked));
        } else if bad.len() * 2 < self.known.len() && bad.len() <= 3 {
            bad.iter().for_each(|one| self.one_drive(one, (failed, asked)));
        }
    }

    /// Finds a configured drive that is absent or has other settings. Such a drive gets a request only every ten
    /// seconds, so its failures are not compared with those of others.
    fn never_answered(&mut self) {
        let silent = |(place, drive): (DriveIndex, &super::Drive)| {
            let asked = drive.in_vain().filter(|asked| *asked >= IN_VAIN)?;
            Some((place, asked, drive.address))
        };
        let silent: Vec<_> = self.figures.drives.enumerate().filter_map(silent).collect();
        let answering = self
            .figures
            .drives
            .iter()
            .filter(|drive| drive.sum(Sign::Answered) > 0)
            .count();
        if silent.is_empty() || answering == 0 || self.has(Cause::FromAddress) {
            return;
        }
        let others = format!("{answering} of {} drives on the line do", self.figures.drives.len());
        if silent.len() > NAMED {
            let names = self.names_of(silent.iter().map(|(place, ..)| *place));
            let evidence = format!("{names} have never answered since the bus was started; {others}");
            self.add(Cause::NeverAnswered, None, Certainty::Certain, evidence);
            return;
        }
        for (place, asked, address) in silent {
            if self.is_reported(place) {
                continue;
            }
            let evidence = format!(
                "{} (address {address}) has never answered since the bus was started, {asked} requests so far; {others}",
                self.name(place)
            );
            self.add(Cause::NeverAnswered, Some(place), Certainty::Certain, evidence);
        }
    }

    fn one_drive(&mut self, bad: &FailureRates, (failed, asked): (u32, u32)) {
        let slow = self.sum(bad.place, Sign::Slow);
        let tail = if slow >= FEW && bad.silent > bad.damaged {
            let slowest = self.figures.drives.get(bad.place).map_or(0.0, super::Drive::slowest_ms);
            format!("; its replies start after up to {slowest:.1} ms")
        } else {
            String::new()
        };
        let evidence = format!(
            "{} of {} transactions with {} failed in the last minute ({} without a reply, {} damaged), {failed} of \
             {asked} with the \
             others{tail}",
            bad.failed,
            bad.asked,
            self.name(bad.place),
            bad.silent,
            bad.damaged
        );
        let certainty = if bad.failed >= 15 && share(failed, asked) < GOOD {
            Certainty::Likely
        } else {
            Certainty::Fits
        };
        self.add(Cause::OneDrive, Some(bad.place), certainty, evidence);
    }

    fn bad_tail(&mut self, bad: &[FailureRates], (failed, asked): (u32, u32)) {
        let (of_bad, asked_bad) = sums(bad);
        let Some(first) = bad.first() else { return };
        let address = self.figures.drives.get(first.place).map_or(0, |drive| drive.address);
        let evidence = format!(
            "{of_bad} of {asked_bad} transactions with {} failed in the last minute, {failed} of {asked} with the \
             drives below \
             address {address}",
            self.names_of(bad.iter().map(|one| one.place)),
        );
        let certainty = if bad.len() > 2 && share(failed, asked) < GOOD {
            Certainty::Likely
        } else {
            Certainty::Fits
        };
        self.add(Cause::FromAddress, None, certainty, evidence);
    }

    /// Whether errors appeared about when a drive started, so that they may be caused by running drives.
    fn may_be_of_running(&self) -> bool {
        let Contrast { transactions, failed } = *self.figures.while_running();
        let (now, of) = self.exchanges();
        let [usual, _] = failed;
        let [standing, running] = transactions;
        self.figures.runs()
            && standing >= 100.0
            && running < 100.0
            && f64::from(usual / standing) < 0.5 * share(now, of)
    }

    /// Known drives whose errors no verdict explains.
    fn unexplained(&self) -> Vec<FailureRates> {
        if self.may_be_of_running() {
            return Vec::new();
        }
        let of_line = [
            Cause::WhileRunning,
            Cause::Mains,
            Cause::SilenceTooShort,
            Cause::FromAddress,
        ];
        if of_line.iter().any(|cause| self.has(*cause)) {
            return Vec::new();
        }
        let rest: Vec<FailureRates> = self
            .known
            .iter()
            .filter(|one| !self.is_reported(one.place))
            .copied()
            .collect();
        if sums(&rest).0 <= self.disturbed {
            Vec::new()
        } else {
            rest
        }
    }

    /// Whether errors are lasting, frequent, and of more than one drive: of half of those that should show some.
    fn is_of_line(&self, rest: &[FailureRates]) -> bool {
        let (failed, asked) = sums(rest);
        let rate = share(failed, asked);
        let expected_some = |one: &&FailureRates| f64::from(one.asked) * rate >= 3.0;
        let (some, with) = (
            rest.iter().filter(expected_some).count(),
            rest.iter().filter(expected_some).filter(|one| one.failed > 0).count(),
        );
        let lasts = rest.iter().any(|one| one.lasting) || self.steps_of_line() >= LASTING;
        let several = rest.iter().filter(|one| one.failed > 0).count() >= 2.min(rest.len());
        let comparable = self.waiting * 5 <= self.figures.drives.len();
        comparable && lasts && several && failed >= FEW_OF_LINE && rate >= 0.005 && with * 2 >= some
    }

    /// Steps, at most, in which any drive had errors.
    fn steps_of_line(&self) -> usize {
        let steps: usize = self
            .figures
            .drives
            .iter()
            .map(|drive| drive.steps(&[Sign::Silent, Sign::Damaged]))
            .sum();
        (steps / 2).min(STEPS)
    }

    fn noise(&mut self) {
        let rest = self.unexplained();
        let (_, asked) = sums(&rest);
        let damaged: u32 = rest.iter().map(|one| one.damaged).sum();
        let silent: u32 = rest.iter().map(|one| one.silent).sum();
        if !self.is_of_line(&rest) || damaged < FEW_OF_LINE || damaged * 4 < silent {
            return;
        }
        let with = rest.iter().filter(|one| one.failed > 0).map(|one| one.place);
        let evidence = format!(
            "{damaged} of {asked} replies in the last minute were damaged and {silent} requests got none, without a pattern ({})",
            self.names_of(with)
        );
        let certainty = if rest.len() > 2 {
            Certainty::Likely
        } else {
            Certainty::Fits
        };
        self.add(Cause::Noise, None, certainty, evidence);
    }
}

/// A number of replies and their verb.
fn damaged_replies(count: u32) -> String {
    match count {
        1 => "1 reply was damaged".to_string(),
        more => format!("{more} replies were damaged"),
    }
}
