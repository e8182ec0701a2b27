//! A round of a refresh: a reference at a separate address, the reads, the write. Pure: time is an argument.

use std::time::{Duration, Instant};

use super::ordered::{Ordered, Reference, reference_of};
use super::pace::{self, Pace};
use super::{End, InForce, Refresh};
use crate::command_run::StateRead;
use drivegate_core::permit::Motor;
use drivegate_model::drive::Profile;
use drivegate_model::drive::control::Control;
use drivegate_proto::{Exception, Reply, RequestPdu, Table};

/// How often stops to other drives may go between the frames of a round before they no longer make it begin its reads again:
/// clients that stop a drive in a loop must not keep another drive from its refresh.
const MOST_OVERTAKEN: u32 = 8;

/// A step of a refresh round.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    /// A reference that is not adjacent to the control word.
    Reference,
    /// The control word of the drive, with the reference in the next registers.
    Own,
    /// The state of the motor is read.
    Look,
    Write,
}

/// A refresh round in progress.
#[derive(Debug)]
pub(super) struct Round {
    stage: Stage,
    look: StateRead,
    /// Number of transactions with others that went between its reads.
    overtaken: u32,
}

/// Whether the values in the drive are those that were written.
enum Fits {
    Yes,
    No,
    /// A reset is set in the word.
    NotNow,
}

impl Refresh {
    /// Postpones the next round until this time.
    pub(crate) fn put_off(&mut self, until: Instant) {
        self.round = None;
        if let Some(going) = &mut self.repeated.going {
            going.due = going.due.max(until);
        }
    }

    /// Whether a round has started, so that its next step must follow at once.
    pub(crate) fn is_under_way(&self) -> bool {
        self.round.is_some()
    }

    /// Lets another transaction go first: the round must then repeat its reads, unless transactions with other drives did
    /// that too often.
    pub(crate) fn others_go_first(&mut self, of_another: bool, profile: &Profile) {
        if let Some(round) = self.round.as_mut().filter(|round| round.stage != Stage::Reference) {
            round.overtaken = round.overtaken.saturating_add(1);
            if !of_another || round.overtaken <= MOST_OVERTAKEN {
                round.stage = first_read(profile);
                round.look.begin_again();
            }
        }
    }

    /// Whether the round was overtaken so often that its write follows its last read even before a stop to another drive.
    pub(crate) fn is_owed_its_write(&self) -> bool {
        let round = self.round.as_ref();
        round.is_some_and(|round| round.stage == Stage::Write && round.overtaken > MOST_OVERTAKEN)
    }

    /// The request of the present step of the round. Begins a round if none is in progress.
    pub(crate) fn request(&mut self, profile: &Profile) -> Option<RequestPdu> {
        let control = profile.control.as_ref()?;
        if self.round.is_none() {
            let apart = self.reference_apart(profile, control);
            self.round = Some(Round {
                stage: apart.map_or(first_read(profile), |_| Stage::Reference),
                look: reads_of_motor(profile)?,
                overtaken: 0,
            });
        }
        let round = self.round.as_ref()?;
        match round.stage {
            Stage::Reference => self
                .reference_apart(profile, control)
                .map(|r| write(profile, r.start, r.words())),
            Stage::Own => Some(self.read_own(profile, control)),
            Stage::Look => Some(round.look.request()),
            Stage::Write => self.write(profile, control),
        }
    }

    /// The write of the round that the rules of the gate judge: word and reference.
    pub(crate) fn writes(&self, profile: &Profile) -> Option<RequestPdu> {
        let control = profile.control.as_ref()?;
        match self.reference_apart(profile, control) {
            Some(reference) => Some(write(profile, reference.start, reference.words())),
            None => self.write(profile, control),
        }
    }

    /// The write that follows the reads of the round.
    fn write(&self, profile: &Profile, control: &Control) -> Option<RequestPdu> {
        let (_, repeats) = self.settings?;
        let ordered = &self.repeated.ordered;
        if self.is_fed_by_reference(control, repeats) {
            return ordered.reference.map(|r| write(profile, r.start, r.words()));
        }
        let word = ordered.word?;
        Some(match self.together(profile, control) {
            None => write(profile, control.at.address, &[word]),
            Some(r) if r.start > control.at.address => {
                let words: Vec<u16> = [word].iter().chain(r.words()).copied().collect();
                write(profile, control.at.address, &words)
            }
            Some(r) => {
                let words: Vec<u16> = r.words().iter().copied().chain([word]).collect();
                write(profile, r.start, &words)
            }
        })
    }

    /// The reference, if it is adjacent to the control word so that one request writes both.
    fn together(&self, profile: &Profile, control: &Control) -> Option<Reference> {
        let at = control.at.address;
        let reference = self.repeated.ordered.reference?;
        let beside = reference.start == at.wrapping_add(1) || reference.start.wrapping_add(reference.count) == at;
        let first = reference.start.min(at);
        (beside && !self.apart && profile.writes_together(first, reference.count + 1)).then_some(reference)
    }

    /// The reference that is written before the control word.
    fn reference_apart(&self, profile: &Profile, control: &Control) -> Option<Reference> {
        let (_, repeats) = self.settings?;
        let alone = self.is_fed_by_reference(control, repeats);
        let reference = self.repeated.ordered.reference?;
        (!alone && self.together(profile, control).is_none()).then_some(reference)
    }

    /// The read of the control word of the drive, with the adjacent reference.
    fn read_own(&self, profile: &Profile, control: &Control) -> RequestPdu {
        let at = control.at.address;
        let beside = self.together(profile, control).filter(|r| r.start > at);
        let count = 1 + beside.map_or(0, |r| r.count);
        let may = profile
            .ranges
            .iter()
            .any(|range| range.table == Table::Holding && range.addresses.contains(&at) && range.read >= count);
        RequestPdu::Read {
            table: Table::Holding,
            start: at,
            count: if may { count } else { 1 },
        }
    }

    /// Processes the drive's reply to `pdu`, the request of the present step.
    ///
    /// # Errors
    /// If the refresh must end; contains the reason.
    pub(crate) fn answered(
        &mut self,
        profile: &Profile,
        pdu: &RequestPdu,
        reply: &Reply,
        now: Instant,
    ) -> Result<(), End> {
        let (Some((every, _)), Some(control)) = (self.settings, profile.control.as_ref()) else {
            return Ok(());
        };
        let stage = match self.round.as_ref().map(|round| round.stage) {
            None => return Ok(()),
            // A stall while the write was on the line began the reads of the round again.
            Some(Stage::Own | Stage::Look) if pdu.is_write() => Stage::Write,
            Some(stage) => stage,
        };
        if let Reply::Exception(code) = reply {
            if *code == Exception::FUNCTION && stage == Stage::Write && !self.apart {
                self.apart = true;
                self.round = None;
                return Ok(());
            }
            if code.is_busy() || code.leaves_open() || code.is_no_answer() {
                self.not_answered(now);
                return Ok(());
            }
            return Err(End::Refused(format!("the drive refused it with {code}")));
        }
        let next = match stage {
            Stage::Reference => first_read(profile),
            Stage::Own => match self.judge_own(control, reply) {
                Fits::Yes => Stage::Look,
                Fits::NotNow => {
                    self.put_off(now + every);
                    return Ok(());
                }
                Fits::No => return Err(End::Foreign),
            },
            Stage::Look => {
                let Some(round) = &mut self.round else { return Ok(()) };
                if !round.look.take_reply(reply) {
                    return Ok(());
                }
                let (motor, speed) = (round.look.motor(), round.look.speed());
                self.note_speed(profile, speed);
                match self.judge_motor(motor) {
                    Ok(true) => Stage::Write,
                    Ok(false) => {
                        self.not_answered(now);
                        return Ok(());
                    }
                    Err(end) => return Err(end),
                }
            }
            Stage::Write => {
                if let Some(going) = &mut self.repeated.going {
                    (going.due, going.lost) = (now + every, None);
                }
                self.round = None;
                return Ok(());
            }
        };
        if let Some(round) = &mut self.round {
            round.stage = next;
        }
        Ok(())
    }

    /// Whether the drive has the word, and the reference, that were written.
    fn judge_own(&mut self, control: &Control, reply: &Reply) -> Fits {
        let words = reply.words().unwrap_or_default();
        let (Some(read), Some(word)) = (words.first().copied(), self.repeated.ordered.word) else {
            return Fits::NotNow;
        };
        let released = control.without_reset(read);
        if released != word {
            return Fits::No;
        }
        let reference = words.get(1..).unwrap_or_default();
        let told = self.repeated.ordered.matches_written(reference);
        match (read == released, told) {
            (_, false) => Fits::No,
            (false, true) => Fits::NotNow,
            (true, true) => Fits::Yes,
        }
    }

    /// Notes the speed that the drive showed in this round.
    fn note_speed(&mut self, profile: &Profile, speed: Option<f64>) {
        let reference = self
            .repeated
            .ordered
            .reference
            .and_then(|reference| pace::value(profile, reference));
        if let (Some(going), Some(speed), Some(reference)) = (&mut self.repeated.going, speed, reference) {
            going.pace = going.pace.after(speed, reference);
        }
    }

    /// Whether the motor is in the state that the word requires: only then is the word written.
    fn judge_motor(&mut self, motor: Motor) -> Result<bool, End> {
        let Some(going) = &mut self.repeated.going else {
            return Ok(false);
        };
        match (going.does, motor) {
            (_, Motor::RunsElsewise) => Err(End::Local),
            (_, Motor::NotShown) => Ok(false),
            (InForce::Run, Motor::Runs) => {
                going.seen = true;
                // A motor that another master stops by its ramp still runs.
                Ok(!matches!(going.pace, Pace::Falls(_)))
            }
            (InForce::Run, Motor::Stands) => Err(End::Stands),
            (InForce::Stop, Motor::Runs) if going.seen => Err(End::Starts),
            // The motor is still slowing down after the stop.
            (InForce::Stop, Motor::Runs) => Ok(true),
            (InForce::Stop, Motor::Stands) => {
                going.seen = true;
                Ok(true)
            }
        }
    }

    /// Handles a step without an accepted reply: the refresh continues with the next period, based on what the
    /// drive then shows.
    pub(crate) fn not_answered(&mut self, now: Instant) {
        self.round = None;
        let Some((every, _)) = self.settings else { return };
        if let Some(going) = &mut self.repeated.going {
            going.lost.get_or_insert(now);
            going.due = now + every;
        }
    }

    /// Notes that the thread was stalled for this time, during which nothing was written.
    pub(crate) fn after_stall(&mut self, time: Duration, now: Instant) {
        self.round = None;
        if let Some(going) = &mut self.repeated.going {
            going.lost.get_or_insert(now.checked_sub(time).unwrap_or(now));
        }
    }
}

/// The reads that show the motor; with its speed where the drive's word, which is repeated, cannot be read.
fn reads_of_motor(profile: &Profile) -> Option<StateRead> {
    let is_hidden = first_read(profile) == Stage::Look && profile.repeats().is_ok_and(|repeats| repeats.word);
    let speed = pace::compared(profile).filter(|_| is_hidden);
    StateRead::at_refresh(profile, speed.map(|[_, shown]| shown))
}

/// The first read of a refresh round.
fn first_read(profile: &Profile) -> Stage {
    if profile.control.as_ref().is_some_and(Control::is_read) && profile.repeats().is_ok_and(|r| r.word) {
        Stage::Own
    } else {
        Stage::Look
    }
}

fn write(profile: &Profile, start: u16, words: &[u16]) -> RequestPdu {
    match words {
        [word] => profile.functions.write_register(start, *word),
        words => RequestPdu::WriteRegisters {
            start,
            values: words.to_vec(),
        },
    }
}

/// The requests of a round of a drive of that profile, with a reference of one register, for the prediction.
pub(crate) fn requests(profile: &Profile) -> Vec<RequestPdu> {
    let (Ok(repeats), Some(control)) = (profile.repeats(), profile.control.as_ref()) else {
        return Vec::new();
    };
    let mut refresh = Refresh {
        settings: Some((Duration::from_secs(1), repeats)),
        ..Refresh::default()
    };
    let address = (0..=u16::MAX).find(|address| profile.is_repeated_reference(*address));
    refresh.repeated.ordered = Ordered {
        word: repeats.word.then_some(0),
        reference: address.and_then(|address| reference_of(&[(address, 0)])),
        ..Ordered::default()
    };
    let apart = refresh.reference_apart(profile, control);
    let own = (first_read(profile) == Stage::Own).then(|| refresh.read_own(profile, control));
    let looks = reads_of_motor(profile).map(|look| look.requests().cloned().collect::<Vec<_>>());
    apart
        .map(|r| write(profile, r.start, r.words()))
        .into_iter()
        .chain(own)
        .chain(looks.into_iter().flatten())
        .chain(refresh.write(profile, control))
        .collect()
}
