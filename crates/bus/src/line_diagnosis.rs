//! Feeds the diagnosis of a line with its transactions, and publishes the verdicts. Uses no clock except for the
//! time of day of verdicts.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use super::line_state::Exchanged;
use super::listener::Exchange as Overheard;
use super::transaction::{CONNECTION_CLOSED, Ended, MAY_BE_LATE};
use drivegate_core::diagnosis::debounce::{Change, Debounce};
use drivegate_core::diagnosis::figures::Sign;
use drivegate_core::diagnosis::{
    Cause, Counted, CountedByDrive, Diagnosis, End, Exchange, Figures, Finding, Line, Verdict, own_timeout, rules,
    unanswered,
};
use drivegate_core::process_image::BusImage;
use drivegate_model::drive::{DriveIndex, PerDrive, PlannedRead};
use drivegate_proto::{Reply, RequestPdu};

/// Time for which a trip by a drive's own communication timeout is shown.
const TRIP_SHOWN: Duration = Duration::from_secs(600);
/// A line with one failed request in this number is unsound: an unanswered request there may simply have been lost.
const UNSOUND: u32 = 20;

#[derive(Debug)]
pub(super) struct LineDiagnosis {
    image: Arc<BusImage>,
    names: PerDrive<String>,
    figures: Figures,
    debounce: Debounce,
    /// Silence before the request that is on the line.
    gap: Duration,
    /// The counters of each drive itself: at the start of the present series of errors, and at the last reading.
    by_drive: PerDrive<Option<(CountedByDrive, CountedByDrive)>>,
    /// The last trip of each drive by its own communication timeout, kept for [`TRIP_SHOWN`].
    trips: PerDrive<Option<(Instant, Finding)>>,
    /// Reads to which each drive never replies, as of the last step.
    unanswered: PerDrive<Vec<PlannedRead>>,
    /// Since when each current verdict holds.
    since: Vec<(Cause, Option<DriveIndex>, SystemTime)>,
}

impl LineDiagnosis {
    /// The diagnosis of a line whose port is not open yet, with this silence before requests and this time for the
    /// first byte of a reply.
    pub(super) fn new(
        image: Arc<BusImage>,
        silence: Duration,
        response_timeout: Duration,
        now: Instant,
    ) -> LineDiagnosis {
        let line = Line {
            protocol: image.spec.protocol,
            format: image.spec.format,
            silence,
            response_timeout,
        };
        let mut figures = Figures::new(line, image.drives.iter().map(|drive| drive.spec.address), now);
        for (drive, image) in figures.drives.iter_mut().zip(&image.drives) {
            drive.response_timeout = image.spec.timing.response_timeout.unwrap_or(response_timeout);
        }
        LineDiagnosis {
            names: image.drives.iter().map(|drive| drive.spec.name.clone()).collect(),
            figures,
            debounce: Debounce::default(),
            by_drive: vec![None; image.drives.len()].into(),
            gap: Duration::ZERO,
            trips: vec![None; image.drives.len()].into(),
            unanswered: vec![Vec::new(); image.drives.len()].into(),
            since: Vec::new(),
            image,
        }
    }

    /// The figures, to be updated about the port, running drives and unrequested bytes.
    pub(super) fn figures(&mut self) -> &mut Figures {
        &mut self.figures
    }

    /// Whether transactions with that drive failed in the last minute.
    pub(super) fn has_errors(&self, drive: DriveIndex) -> bool {
        let failed = [Sign::Damaged, Sign::StartLost, Sign::CutEcho, Sign::Silent];
        let drive = self.figures.drives.of(drive);
        failed.iter().any(|sign| drive.sum(*sign) > 0)
    }

    /// Notes counters that were read from a drive.
    pub(super) fn counted_by_drive(&mut self, drive: DriveIndex, counted: CountedByDrive) {
        let known = self.by_drive.of_mut(drive);
        // A drive that was switched off counts from 0 again.
        let goes_on = |before: &CountedByDrive| counted.since(before).messages < u16::MAX / 2;
        let first = known.map(|(_, before)| before).filter(goes_on).unwrap_or(counted);
        *known = Some((first, counted));
    }

    /// The disturbed direction, as far as the counters of the drives of a finding show it.
    fn directions(&self, finding: &Finding) -> String {
        let about = self.figures.drives.enumerate().zip(&self.names).zip(&self.by_drive);
        let about = about.filter(|(((index, _), _), _)| finding.drive.is_none_or(|drive| drive == *index));
        let directions = about.filter_map(|(((_, drive), name), counted)| {
            let (before, last) = counted.as_ref()?;
            let here = drive.sum(Sign::Damaged) + drive.sum(Sign::StartLost);
            last.since(before).direction(name, here)
        });
        directions.take(3).map(|direction| format!("; {direction}")).collect()
    }

    /// A request is sent after that much silence on the line.
    pub(super) fn sending(&mut self, gap: Duration) {
        self.gap = gap;
    }

    /// A transaction of the gateway has ended.
    pub(super) fn exchanged(
        &mut self,
        drive: DriveIndex,
        exchanged: &Exchanged,
        turnaround: Option<Duration>,
        at: Instant,
    ) {
        let transaction = &exchanged.transaction;
        // A drive may ignore a request of a tool with an unknown function, so that is no evidence.
        if matches!(transaction.request().pdu, RequestPdu::Other(_)) {
            return;
        }
        // Silence to a register that the drive never answers shows nothing of the line.
        if end(&exchanged.ended) == End::Silent && self.is_unanswered(drive, &transaction.request().pdu) {
            return;
        }
        if let Some(baud) = exchanged.beats {
            self.figures.note_too_early(baud);
        }
        self.figures.exchange(&Exchange {
            drive,
            request: transaction.request(),
            frame: transaction.frame(),
            seen: transaction.seen(),
            behind: if matches!(exchanged.ended, Ended::Reply(_)) {
                transaction.rest()
            } else {
                &[]
            },
            foreign: transaction.foreign() > 0,
            end: end(&exchanged.ended),
            gap: self.gap,
            began: exchanged.began,
            at,
            heard_at: exchanged.heard_at,
            turnaround,
        });
    }

    /// A transaction of another master has ended.
    pub(super) fn foreign_exchange(&mut self, drive: DriveIndex, exchange: &Overheard) {
        let (Some(request), Some(ended)) = (&exchange.request, &exchange.ended) else {
            return;
        };
        let answered = exchange
            .replied
            .filter(|_| matches!(ended, Ended::Reply(reply) if !matches!(reply, Reply::Exception(_))));
        self.figures.exchange(&Exchange {
            drive,
            request,
            frame: &exchange.frame,
            seen: &exchange.heard,
            behind: &[],
            foreign: false,
            end: if exchange.doubt.is_some() {
                End::Doubtful
            } else {
                end(ended)
            },
            gap: exchange.began.saturating_duration_since(exchange.quiet_since),
            began: exchange.began,
            at: exchange.at,
            heard_at: exchange.at,
            turnaround: answered.map(|replied| replied.saturating_duration_since(exchange.sent)),
        });
    }

    fn is_unanswered(&self, drive: DriveIndex, pdu: &RequestPdu) -> bool {
        let reads = self.unanswered.get(drive);
        reads.is_some_and(|reads| reads.iter().any(|read| read.pdu() == *pdu))
    }

    /// Notes a new fault of a drive, if the drive's own communication timeout seems to be the cause.
    pub(super) fn tripped(&mut self, drive: DriveIndex, trip: own_timeout::Trip, now: Instant) {
        let profile = &self.image.drives.of(drive).spec.profile;
        if let Some(found) = own_timeout::finding(drive, profile, trip) {
            *self.trips.of_mut(drive) = Some((now, found));
        }
    }

    /// A verdict for each drive that never replies to some of its reads.
    fn registers(&self) -> impl Iterator<Item = Finding> {
        let all = self.unanswered.enumerate().zip(&self.image.drives);
        let with = all.filter(|((_, reads), _)| !reads.is_empty());
        with.filter_map(|((drive, reads), image)| {
            let [answered, failed] = self.answered_and_failed(drive);
            let sound = failed * UNSOUND <= answered;
            sound.then(|| unanswered::finding(drive, &image.spec.profile, reads, answered))
        })
    }

    /// Answered and failed requests to this drive in the last minute, except those for registers that it never answers.
    fn answered_and_failed(&self, drive: DriveIndex) -> [u32; 2] {
        let sum = |signs: &[Sign]| {
            let counts = self.figures.drives.of(drive);
            signs.iter().map(|sign| counts.sum(*sign)).sum()
        };
        [
            sum(&[Sign::Answered]),
            sum(&[Sign::Silent, Sign::Damaged, Sign::StartLost, Sign::CutEcho]),
        ]
    }

    /// Applies the rules when a step has passed; `unanswered` are the reads to which drives never reply. Returns the changes, as
    /// text.
    pub(super) fn tick(
        &mut self,
        unanswered: impl FnOnce() -> PerDrive<Vec<PlannedRead>>,
        now: Instant,
    ) -> Vec<(Option<DriveIndex>, String)> {
        if !self.figures.is_step_over(now) {
            return Vec::new();
        }
        self.unanswered = unanswered();
        let mut found = rules::find(&self.figures, &self.names, now);
        found.extend(self.registers());
        let recent = |(at, _): &&(Instant, Finding)| now.saturating_duration_since(*at) < TRIP_SHOWN;
        let trips = self.trips.iter().filter_map(|trip| trip.as_ref().filter(recent));
        found.extend(trips.map(|(_, finding)| finding.clone()));
        let changes = self.debounce.take(found);
        self.show();
        self.figures.next_step(now);
        let tell = |change: &Change| match change {
            Change::Came(finding) => (finding.drive, text_of(finding)),
            Change::Firmer(finding) => (finding.drive, format!("now {}", text_of(finding))),
            Change::Went(finding) => (finding.drive, format!("cleared: {}", finding.cause.meaning())),
        };
        changes.iter().map(tell).collect()
    }

    fn show(&mut self) {
        let now = SystemTime::now();
        let shown: Vec<Finding> = self.debounce.shown().cloned().collect();
        let is = |finding: &Finding, (cause, drive, _): &(Cause, Option<DriveIndex>, SystemTime)| {
            finding.cause == *cause && finding.drive == *drive
        };
        self.since.retain(|one| shown.iter().any(|finding| is(finding, one)));
        let directions: Vec<String> = shown.iter().map(|finding| self.directions(finding)).collect();
        let mut directions = directions.into_iter();
        let verdicts = shown.iter().map(|finding| {
            let known = self
                .since
                .iter()
                .find(|one| is(finding, one))
                .map(|(_, _, since)| *since);
            let since = known.unwrap_or(now);
            if known.is_none() {
                self.since.push((finding.cause, finding.drive, since));
            }
            Verdict {
                verdict: finding.cause,
                drive: finding.drive.map(|drive| self.names.of(drive).clone()),
                certainty: finding.certainty,
                meaning: finding.cause.meaning().to_string(),
                evidence: format!("{}{}", finding.evidence, directions.next().unwrap_or_default()),
                remedy: finding.remedy().to_string(),
                steps: steps_of(&self.image, finding),
                since: humantime::format_rfc3339_millis(since).to_string(),
            }
        });
        let verdicts = verdicts.collect();
        let counted =
            self.figures
                .drives
                .iter()
                .zip(&self.names)
                .zip(&self.by_drive)
                .map(|((drive, name), by_drive)| Counted {
                    by_drive: by_drive.map(|(_, last)| last),
                    drive: name.clone(),
                    answered: drive.sum(Sign::Answered),
                    silent: drive.sum(Sign::Tried),
                    damaged: drive.sum(Sign::Damaged) + drive.sum(Sign::StartLost) + drive.sum(Sign::CutEcho),
                    stray_before: drive.sum(Sign::Led),
                    start_lost: drive.sum(Sign::StartLost),
                    late: drive.sum(Sign::Late),
                    second: drive.sum(Sign::Second),
                    slowest_ms: drive.slowest_ms(),
                });
        let drives = counted.collect();
        self.image.diagnosis.store(Arc::new(Diagnosis {
            at: Some(now),
            verdicts,
            wrong_address: self.figures.wrong_address(),
            drives,
        }));
    }
}

/// The commissioning steps to check for a finding, from the profiles of its drives.
fn steps_of(image: &BusImage, finding: &Finding) -> Vec<String> {
    let about = (0..)
        .zip(&image.drives)
        .filter(|(place, _)| finding.drive.is_none_or(|drive| drive == *place));
    finding
        .cause
        .steps_of(about.map(|(_, drive)| drive.spec.profile.as_ref()))
}

fn end(ended: &Ended) -> End {
    match ended {
        // A gateway in between answered, and the drive did not.
        Ended::Reply(Reply::Exception(code)) if code.is_no_answer() => End::Silent,
        Ended::Reply(_) => End::Answered,
        Ended::Silent => End::Silent,
        Ended::Corrupt(MAY_BE_LATE | CONNECTION_CLOSED) => End::Doubtful,
        Ended::Corrupt(_) => End::Damaged,
    }
}

fn text_of(finding: &Finding) -> String {
    let Finding {
        cause,
        certainty,
        evidence,
        ..
    } = finding;
    format!(
        "{} ({}): {evidence}; {}",
        cause.meaning(),
        certainty.name(),
        finding.remedy()
    )
}
