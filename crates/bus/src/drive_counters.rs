//! The line counters of the drives themselves (function 08), read while transactions with them fail: they show
//! which direction is disturbed. The reads use only a negligible share of the line.

use std::time::{Duration, Instant};

use tokio::sync::oneshot::Receiver;
use tokio::sync::oneshot::error::TryRecvError;

use crate::line_diagnosis::LineDiagnosis;
use drivegate_core::diagnosis::CountedByDrive;
use drivegate_core::order::{Answer, BackgroundRequest, Origin, Outcome, Pace, SourceKind, Ticket};
use drivegate_core::plant::BusHandle;
use drivegate_model::drive::DriveIndex;
use drivegate_proto::Reply;

/// Pause between two readings of a drive.
const PAUSE: Duration = Duration::from_secs(30);
/// Pause before a counter whose reply was lost is read again.
const AGAIN: Duration = Duration::from_secs(1);
/// Time after which the request is not sent.
const EXPIRY: Duration = Duration::from_secs(20);

/// The readings of all drives of a bus.
#[derive(Debug)]
pub(super) struct DriveCounters {
    drives: Vec<(DriveIndex, State)>,
    /// When a drive is looked at next.
    due: Instant,
}

#[derive(Debug)]
enum State {
    /// Idle until this time, with the counters read so far.
    Idle(Instant, Vec<u16>),
    /// The counters read so far, and the answer that is waited for.
    Reading(Vec<u16>, Receiver<Answer>),
}

impl DriveCounters {
    /// The counters of those drives of a bus that count.
    pub(super) fn new(bus: &BusHandle, now: Instant) -> DriveCounters {
        let drives = bus.image.drives.enumerate();
        let counting = drives.filter(|(_, drive)| drive.spec.profile.counts_messages);
        DriveCounters {
            drives: counting
                .map(|(index, _)| (index, State::Idle(now, Vec::new())))
                .collect(),
            due: now,
        }
    }

    /// Requests the counters that are due, and processes what was read.
    pub(super) fn poll(&mut self, bus: &BusHandle, diagnosis: &mut LineDiagnosis, now: Instant) {
        if self.drives.is_empty() || now < self.due {
            return;
        }
        self.due = now + Duration::from_millis(50);
        for (drive, state) in &mut self.drives {
            let next = match state {
                State::Idle(at, _) if now < *at => continue,
                State::Idle(_, counted) => {
                    let online = bus.image.drives.of(*drive).snapshot().link.is_online();
                    let counted = std::mem::take(counted);
                    if online && diagnosis.has_errors(*drive) {
                        let answer = ask(bus, *drive, &counted, now);
                        State::Reading(counted, answer)
                    } else {
                        State::Idle(now + AGAIN, counted)
                    }
                }
                State::Reading(counted, answer) => match answer.try_recv() {
                    Err(TryRecvError::Empty) => continue,
                    Ok(Answer {
                        outcome: Outcome::Acknowledged(Reply::Diagnostics(count)),
                        ..
                    }) => {
                        counted.push(count);
                        match CountedByDrive::complete(counted) {
                            Some(all) => {
                                diagnosis.counted_by_drive(*drive, all);
                                State::Idle(now + PAUSE, Vec::new())
                            }
                            None => {
                                let answer = ask(bus, *drive, counted, now);
                                State::Reading(std::mem::take(counted), answer)
                            }
                        }
                    }
                    // A drive that refuses the counters is left alone for a long time; a request that was lost on
                    // the line is repeated sooner.
                    Ok(Answer {
                        outcome: Outcome::Exception(_),
                        ..
                    }) => State::Idle(now + PAUSE * 20, Vec::new()),
                    Ok(_) | Err(TryRecvError::Closed) => State::Idle(now + AGAIN, std::mem::take(counted)),
                },
            };
            *state = next;
        }
    }
}

/// Requests the counter that follows those already read.
fn ask(bus: &BusHandle, drive: DriveIndex, so_far: &[u16], now: Instant) -> Receiver<Answer> {
    let name = &bus.image.drives.of(drive).spec.name;
    let origin = Origin::new(SourceKind::Schedule, "diagnosis");
    let (ticket, answer) = Ticket::new(
        origin,
        name,
        "a counter of the drive".to_string(),
        false,
        now,
        bus.command_log.clone(),
    );
    let request = BackgroundRequest {
        target: drive.into(),
        pdu: CountedByDrive::request(so_far),
        pace: Pace::Slow,
        expires: now + EXPIRY,
        ticket,
        passed_on: None,
    };
    bus.queue.submit_background(request, now);
    answer
}
