//! Rules about time and the adapter: late replies, pauses, direction, echo, port.

use super::{FEW_OF_LINE, Rules, damaged_replies};
use crate::diagnosis::counters::Contrast;
use crate::diagnosis::failure_rates::{FEW, LASTING, share, sums};
use crate::diagnosis::figures::Sign;
use crate::diagnosis::{Cause, Certainty};
use drivegate_proto::wire::BAUDS;

/// Longest `response_timeout` that a verdict proposes, ms.
const MOST_PROPOSED: u32 = 5000;

impl Rules<'_> {
    /// Finds a drive whose replies come after the time limit. This is measured directly, so the other drives do not matter.
    pub(super) fn answers_late(&mut self) {
        let late = self.figures.sum(Sign::Late);
        let figures = self.figures;
        for (place, drive) in figures.drives.enumerate() {
            let own = self.sum(place, Sign::Late);
            let lasts = drive.steps(&[Sign::Late]) >= LASTING;
            if own < FEW || !lasts || self.is_reported(place) || own * 2 <= late {
                continue;
            }
            let latest = drive.slowest_ms();
            // Room for a reply that is a quarter later than all so far, in steps of 50 ms.
            let enough = ((latest * 1.25) as u32).next_multiple_of(50).min(MOST_PROPOSED);
            let evidence = format!(
                "{own} replies of {} came after the timeout of {} ms in the last minute, the latest after {latest:.0} ms, {} of \
                 the others; response_timeout = \"{enough}ms\" of this drive would wait for them",
                self.name(place),
                drive.response_timeout.as_millis(),
                late - own
            );
            self.disturbed += own;
            self.add(Cause::OneDrive, Some(place), Certainty::Likely, evidence);
        }
    }

    pub(super) fn silence_too_short(&mut self) {
        let [close, paused] = [0, 1].map(|place: usize| {
            let of = |counts: [f32; 2]| counts.get(place).copied().unwrap_or_default();
            (of(self.figures.pause.failed), of(self.figures.pause.transactions))
        });
        let turned = Contrast {
            transactions: [paused.1, close.1],
            failed: [paused.0, close.0],
        };
        let silent = self.figures.sum(Sign::Silent);
        let mut few = turned;
        // Pauses are rare on a busy line. Most of them follow a request without a reply.
        few.transactions[0] = few.transactions[0].max(if few.transactions[0] >= 15.0 { 100.0 } else { 0.0 });
        let rate = close.0 / close.1.max(1.0);
        let chance = (1.0 - rate).max(0.0).powf(paused.1);
        if !Self::contrast(&few) || paused.0 > 0.2 * rate * paused.1 || chance > 1e-4 || silent < FEW_OF_LINE {
            return;
        }
        if self.figures.sum(Sign::Damaged) * 5 > silent || self.steps(&[Sign::Silent]) < LASTING {
            return;
        }
        let places = self.known.iter().filter(|one| one.silent > 0).map(|one| one.place);
        let evidence = format!(
            "{:.0} of {:.0} requests sent soon after a reply got none ({}), {:.0} of {:.0} after a pause",
            close.0,
            close.1,
            self.names_of(places),
            paused.0,
            paused.1
        );
        self.found
            .retain(|found| !matches!(found.cause, Cause::OneDrive | Cause::FromAddress));
        self.add(Cause::SilenceTooShort, None, Certainty::Likely, evidence);
    }

    pub(super) fn bias(&mut self) {
        let (led, zero, idle) = (
            self.figures.sum(Sign::Led),
            self.figures.sum(Sign::LedZero),
            self.figures.sum(Sign::Idle),
        );
        let with = self
            .figures
            .drives
            .iter()
            .filter(|drive| drive.sum(Sign::Led) + drive.sum(Sign::Idle) > 0)
            .count();
        let answered = self.figures.sum(Sign::Answered) + led;
        let lasts = self.steps(&[Sign::Led, Sign::Idle]) >= LASTING;
        if !lasts || led + idle < FEW_OF_LINE || share(led + idle, answered) < 0.01 || with < 2.min(self.known.len()) {
            return;
        }
        let evidence = format!(
            "{led} of {answered} replies in the last minute had stray bytes before them ({zero} times only zeros), \
             and {idle} times stray bytes came while the line should have been idle"
        );
        let certainty = if zero * 2 > led || (led > 0 && idle > 0) {
            Certainty::Likely
        } else {
            Certainty::Fits
        };
        self.add(Cause::Bias, None, certainty, evidence);
    }

    pub(super) fn reply_start_lost(&mut self) {
        let lost = self.figures.sum(Sign::StartLost);
        let damaged = self.figures.sum(Sign::Damaged) + lost;
        if lost < FEW || self.steps(&[Sign::StartLost]) < LASTING || share(lost, damaged) < 0.4 {
            return;
        }
        let with = self
            .figures
            .drives
            .enumerate()
            .filter(|(_, drive)| drive.sum(Sign::StartLost) > 0);
        let evidence = format!(
            "{lost} of {damaged} damaged replies in the last minute are valid once their first bytes are restored ({})",
            self.names_of(with.map(|(place, _)| place))
        );
        let certainty = if lost >= 20 && share(lost, damaged) > 0.8 {
            Certainty::Certain
        } else {
            Certainty::Likely
        };
        self.add(Cause::ReplyStartLost, None, certainty, evidence);
    }

    pub(super) fn request_end_lost(&mut self) {
        let cut = self.figures.sum(Sign::CutEcho);
        if cut >= FEW && self.steps(&[Sign::CutEcho]) >= LASTING {
            let evidence =
                format!("{cut} requests in the last minute came back as an echo without their end, and got no reply");
            self.add(Cause::RequestEndLost, None, Certainty::Certain, evidence);
            return;
        }
        let rest = self.unexplained();
        let (failed, asked) = sums(&rest);
        let silent: u32 = rest.iter().map(|one| one.silent).sum();
        if !self.is_of_line(&rest) || silent < FEW_OF_LINE || (failed - silent) * 5 > silent {
            return;
        }
        let evidence = format!(
            "{silent} of {asked} requests in the last minute got no reply, from all drives alike, and only {}",
            damaged_replies(failed - silent)
        );
        self.add(Cause::RequestEndLost, None, Certainty::Fits, evidence);
    }

    pub(super) fn echo(&mut self) {
        let (echoed, shown) = (self.figures.sum(Sign::Echoed), self.figures.sum(Sign::EchoShown));
        if echoed < 20 || share(echoed, shown) < 0.5 || self.steps(&[Sign::Echoed]) < LASTING {
            return;
        }
        let evidence = format!("{echoed} of {shown} requests in the last minute came back before the reply");
        self.add(Cause::Echo, None, Certainty::Certain, evidence);
    }

    pub(super) fn latency_timer(&mut self) {
        let [(lock, arrivals), (paced_lock, paced)] = self.figures.in_steps();
        // A request interval of a whole number of steps would give the same picture.
        let by_cadence = paced * 5 >= arrivals && paced_lock > 0.5;
        let enough = arrivals >= 100 && self.steps(&[Sign::Answered]) >= 2 * LASTING;
        if lock < 0.85 || !enough || by_cadence {
            return;
        }
        let evidence = format!(
            "{arrivals} replies in the last minute arrived in steps of 16 ms ({:.0} % in step), for all drives and \
             lengths",
            lock * 100.0
        );
        self.add(Cause::LatencyTimer, None, Certainty::Likely, evidence);
    }

    pub(super) fn port_resets(&mut self) {
        let losses = self.figures.losses(self.now);
        if losses >= 3 {
            let evidence = format!("the port was lost {losses} times within 10 minutes");
            self.add(Cause::PortResets, None, Certainty::Certain, evidence);
        }
    }

    pub(super) fn connection_closes(&mut self) {
        let (closed, steps) = self.figures.reconnects();
        if closed < FEW || steps < LASTING {
            return;
        }
        let answered = self.figures.sum(Sign::Answered);
        let evidence = format!(
            "the device server closed the connection {closed} times in the last minute, in which {answered} replies \
             came; each time it was reopened at once, and no drive went offline"
        );
        self.add(Cause::ConnectionCloses, None, Certainty::Certain, evidence);
    }

    /// Replies that are whole before the wire could have carried them.
    pub(super) fn faster_than_baud(&mut self) {
        let by_baud = self.figures.early();
        let early: u32 = by_baud.iter().sum();
        let answered = self.figures.sum(Sign::Answered);
        if early < 20 || share(early, answered) < 0.5 || self.steps(&[Sign::Answered]) < LASTING {
            return;
        }
        let mut fit = 0;
        // A few replies that are too early may be late or duplicate replies.
        let place = by_baud.iter().position(|count| {
            fit += count;
            fit * 20 >= early * 19
        });
        let fits = match place.and_then(|place| BAUDS.get(place)) {
            Some(baud) => format!("{baud} baud is the lowest standard rate that fits"),
            None => format!(
                "no standard rate fits, so there seems to be no serial line behind it; {} comes closest",
                BAUDS.last().copied().unwrap_or_default()
            ),
        };
        let configured = self.figures.line.format.baud;
        let evidence = format!(
            "{early} of {answered} replies in the last minute came sooner than the configured {configured} baud could \
             carry them; {fits}"
        );
        self.add(Cause::FasterThanBaud, None, Certainty::Certain, evidence);
    }
}
