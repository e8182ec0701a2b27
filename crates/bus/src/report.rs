//! Applies the master's results to the process image, and converts them to events and log lines.

mod changes;
mod events;
mod selection;

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use self::changes::{WATCHED, Watched};
use super::BusOptions;
use super::line_diagnosis::LineDiagnosis;
use super::line_state::Exchanged;
use super::news::News;
use super::selection::{Findings, Selections};
use super::supervision::{OwnResponse, own_response};
use super::tap::{self, Tap};
use super::transaction::{CONNECTION_CLOSED, Ended};
use drivegate_core::diagnosis::own_timeout::Trip;
use drivegate_core::event::{EventKind, Events};
use drivegate_core::order::CommandLog;
use drivegate_core::plant::BusHandle;
use drivegate_core::process_image::{
    Access, BusImage, DriveImage, Link, Outcome as Counted, PollCycle, Reading, Snapshot, TapedRead, Verdict,
};
use drivegate_core::stalls::Stall;
use drivegate_model::drive::{DriveIndex, ModelPoint, PerDrive, PlannedRead, PointIndex, PollClass, Value};
use drivegate_proto::{Exception, Reply, Request, Table};

/// Time over which the load of the line is calculated.
const LOAD_WINDOW: Duration = Duration::from_secs(1);
/// Older readings show neither faults nor parameters.
const RECENT: Duration = Duration::from_secs(60);

/// Reports the results of a bus to image, events and metrics.
#[derive(Debug)]
pub(super) struct Report {
    image: Arc<BusImage>,
    events: Events,
    command_log: Arc<CommandLog>,
    window: Instant,
    busy: Duration,
    /// Fault code of each drive as last reported; `None` means no fault.
    faults: PerDrive<Option<i64>>,
    /// When each drive acknowledged its last write.
    written: PerDrive<Option<Instant>>,
    /// The other reported states of each drive, in the order of [`WATCHED`].
    watched: PerDrive<[Watched; WATCHED.len()]>,
    /// The known response of each drive to a silent master.
    responses: PerDrive<Response>,
    /// Whether process data matches the profiles.
    selections: Selections,
    /// The diagnosis of the line.
    pub(super) diagnosis: LineDiagnosis,
    up: bool,
    /// Whether the bus is down, and that was reported.
    down_reported: bool,
}

/// Reads that the master must make because of a result.
#[derive(Debug, Default)]
pub(super) struct RequiredReads {
    /// The drive that has a new fault.
    pub(super) fault: Option<DriveIndex>,
    /// Comparisons to make: drive, monitoring point and time.
    pub(super) monitors: Vec<(DriveIndex, PointIndex, Instant)>,
}

/// The known response of a drive to a silent master.
#[derive(Debug, Clone, Copy, Default)]
struct Response {
    /// Whether the response was checked since the drive came online.
    looked_at: bool,
    /// Whether the missing own response was reported.
    told: bool,
}

impl Report {
    pub(super) fn new(bus: &BusHandle, options: &BusOptions, events: Events, now: Instant) -> Report {
        let image = bus.image.clone();
        let drives = image.drives.len();
        let silence = image.spec.protocol.silence(options.silence, &image.spec.format);
        let points = image.drives.iter().map(|drive| &drive.spec.profile.points);
        Report {
            selections: Selections::new(points, now),
            diagnosis: LineDiagnosis::new(image.clone(), silence, options.response_timeout, now),
            image,
            events,
            command_log: bus.command_log.clone(),
            window: now,
            busy: Duration::ZERO,
            responses: vec![Response::default(); drives].into(),
            watched: vec![[Watched::default(); WATCHED.len()]; drives].into(),
            faults: vec![None; drives].into(),
            written: vec![None; drives].into(),
            up: false,
            down_reported: false,
        }
    }

    /// Applies a result of the master.
    pub(super) fn apply(&mut self, news: &News, now: Instant) -> RequiredReads {
        match news {
            News::FastRound(cycle) => self.fast_round(*cycle),
            News::SlowRound(cycle) => self.slow_round(*cycle),
            News::Read { drive, read, words, at } => {
                self.read(*drive, read, words, *at);
                return self.required_after(*drive, read, words, *at, now);
            }
            News::Online(drive) => self.online(*drive),
            News::Offline(drive) => self.offline(*drive),
            News::Restarted(drive) => self.restarted(*drive),
            News::Unlike(drive, device) => self.unlike(*drive, *device),
            News::Unavailable(drive, read, exception) => self.unavailable(*drive, read, *exception, now),
            News::NotConfirmed(drive, late) => self.not_confirmed(*drive, late, now),
            News::LeaseRanOut(drive) => self.lease_ran_out(*drive),
            News::ActionRefused { drive, what, refusal } => {
                self.action_failed(*drive, |name| {
                    Some(format!(
                        "the lease of {name} expired, but {what} cannot be written: {refusal}; retrying every second \
                         until a client commands the drive"
                    ))
                });
            }
            News::ActionFailed { drive, why } => {
                let action = self.action_of(*drive);
                self.action_failed(*drive, |name| {
                    let why = why.as_ref()?;
                    Some(format!(
                        "the lease of {name} expired, but {action} failed: {why}; retrying every second until the \
                         drive acknowledges it or a client commands the drive"
                    ))
                });
            }
            News::ActionTaken { drive, failures } => {
                let action = self.action_of(*drive);
                self.drive_event(*drive, EventKind::Supervision, None, |name| {
                    format!("drive {name} acknowledged {action} of its lease, after {failures} failed attempts")
                });
            }
            News::RunningUnknown(drive) => {
                self.drive_event(*drive, EventKind::Supervision, None, |name| {
                    format!(
                        "drive {name} does not report whether it runs; its supervision follows the run command, and \
                         treats an unknown run command as running"
                    )
                });
            }
            News::RunsUnsupervised(drive, adopted) => self.runs_unsupervised(*drive, *adopted),
            News::Denied(denied) => self.denied(denied, now),
            News::RefreshEnded { drive, why } => self.refresh_ended(*drive, why),
            News::Tripped { drive, why } => self.drive_event(*drive, EventKind::Interlock, None, |name| {
                format!("an interlock of {name} is not satisfied: {why}; the drive is being stopped")
            }),
        }
        RequiredReads::default()
    }

    /// Evaluates what a read has shown of the drive.
    fn required_after(
        &mut self,
        index: DriveIndex,
        read: &PlannedRead,
        words: &[u16],
        at: Instant,
        now: Instant,
    ) -> RequiredReads {
        let drive = self.drive(index);
        let monitors = self.compare_selection(index, &drive, read, words, at);
        let reading = drive.reading(now, RECENT);
        let new_fault = self.check_fault(index, &reading);
        self.report_state(index, &reading);
        self.check_own_response(index, &reading);
        RequiredReads {
            fault: new_fault.then_some(index),
            monitors,
        }
    }

    fn drive(&self, index: DriveIndex) -> Arc<DriveImage> {
        self.image.drives.of(index).clone()
    }

    fn read(&self, index: DriveIndex, read: &PlannedRead, words: &[u16], at: Instant) {
        let drive = self.image.drives.of(index);
        self.image.tape.read(index, || TapedRead {
            at,
            table: read.table,
            start: read.start,
            words: words.into(),
        });
        drive.update(|snapshot: &mut Snapshot| {
            snapshot.store(read.table, read.start, words, at);
            if read.class == PollClass::Fast {
                snapshot.fast_at = Some(at);
            }
        });
    }

    /// Whether a thread that reads orders is blocked.
    pub(super) fn readers_are_blocked(&self, now: Instant) -> bool {
        self.events.pauses().readers_are_blocked(now)
    }

    /// The thread of the bus was stalled.
    pub(super) fn after_stall(&self, stall: Stall) {
        if stall.is_pause() {
            self.events.publish_pause(stall, SystemTime::now());
        }
    }

    pub(super) fn bus_up(&mut self, now: Instant) {
        self.diagnosis.figures().port_opened(now);
        self.up = true;
        self.down_reported = false;
        self.window = now;
        self.busy = Duration::ZERO;
        self.image.update_health(|h| {
            h.up = true;
            h.tried = true;
            h.since = Some(SystemTime::now());
            h.reason = None;
            h.load = None;
            h.opened += 1;
        });
        let text = format!("port {} of bus {} is open", self.image.spec.port, self.image.spec.name);
        self.event(EventKind::BusUp, None, None, text);
    }

    /// A device server closed its connection after replies, and was reconnected.
    pub(super) fn reconnected(&mut self) {
        self.diagnosis.figures().reconnected();
        self.image.update_health(|h| {
            h.opened += 1;
            h.reconnects += 1;
        });
    }

    /// Takes all drives offline before the bus is shown as down, so that no reader of a bus that is down finds good
    /// values. Reported once for each loss of the port: later reasons why it cannot be opened only appear in the
    /// state.
    pub(super) fn bus_down(&mut self, why: &str, now: Instant) {
        self.diagnosis.figures().port_lost(now);
        let news = self.up || !self.down_reported;
        let drives = self.image.drives.enumerate();
        let gone: Vec<DriveIndex> = drives
            .filter(|(_, drive)| goes_offline(drive))
            .map(|(i, _)| i)
            .collect();
        self.image.update_health(|h| {
            if h.up || !h.tried {
                h.since = Some(SystemTime::now());
            }
            h.up = false;
            h.tried = true;
            h.load = Some(0.0);
            h.reason = Some(why.to_string());
        });
        self.up = false;
        self.down_reported = true;
        if news {
            let name = &self.image.spec.name;
            self.event(
                EventKind::BusDown,
                None,
                None,
                format!("bus {name} is down: {why}; retrying at least every 3 s"),
            );
        }
        for index in gone {
            self.offline_event(index, "its bus is down");
        }
    }

    fn online(&mut self, index: DriveIndex) {
        let drive = self.drive(index);
        drive.update(|s| s.link = Link::Online(SystemTime::now()));
        self.responses.of_mut(index).looked_at = false;
        self.drive_event(index, EventKind::Online, None, |name| format!("drive {name} is online"));
    }

    fn offline(&mut self, index: DriveIndex) {
        self.selections.interrupted(index);
        if goes_offline(self.image.drives.of(index)) {
            let bus = &self.image.spec.name;
            let why = format!("it does not reply; check its power, wiring and address (`drivegate diagnose {bus}`)");
            self.offline_event(index, &why);
        }
    }

    fn unavailable(&mut self, index: DriveIndex, read: &PlannedRead, exception: Exception, now: Instant) {
        let drive = self.drive(index);
        drive.update(|s| s.refuse(read.table, read.start, read.count, exception));
        if read.class == PollClass::Monitor {
            return self.monitor_refused(index, &drive, read, exception, now);
        }
        tracing::warn!(
            target: "drivegate::bus::report", bus = %self.image.spec.name, drive = %drive.spec.name,
            "the drive refuses {} {} with {exception}; its points are bad; retrying after 2 s, later every minute",
            read.table, read.start
        );
    }

    /// Reports a controlled drive that does not respond to a silent master: once, and again only if it did respond
    /// in between.
    fn check_own_response(&mut self, index: DriveIndex, reading: &Reading<'_>) {
        let (drive, known) = (self.image.drives.of(index), self.responses.of_mut(index));
        if known.looked_at || drive.spec.access != Access::Control {
            return;
        }
        let response = own_response(reading);
        known.looked_at = response != OwnResponse::Unknown;
        let OwnResponse::Off(point) = response else {
            known.told &= response == OwnResponse::Unknown;
            return;
        };
        if std::mem::replace(&mut known.told, true) {
            return;
        }
        if drive.spec.supervision.is_some() {
            tracing::warn!(
                target: "drivegate::bus::report", bus = %self.image.spec.name, drive = %drive.spec.name,
                "the drive itself does not respond to a silent master ({point}); its lease stops it only while the \
                 gateway works; set the parameter to a stop if the process allows it"
            );
            return;
        }
        self.drive_event(index, EventKind::Unsupervised, None, |name| {
            format!(
                "drive {name} keeps running if its controller goes silent: no supervision, and its own timeout \
                 response is off ({point}); configure supervision, and set the parameter if the process allows it"
            )
        });
    }

    /// Reports faults that appeared or cleared with the last poll. Returns whether one appeared.
    fn check_fault(&mut self, index: DriveIndex, reading: &Reading<'_>) -> bool {
        let now = reading.now;
        let fault = reading.model(ModelPoint::Fault);
        let Some(is_active) = fault.good().map(Value::as_bool) else {
            return false;
        };
        let shown = is_active.then(|| reading.model(ModelPoint::FaultCode));
        let active = match shown.map(|shown| (shown.good(), shown.at)) {
            None => None,
            Some((Some(Value::Integer(code)), _)) if code != 0 => Some(code),
            // A fault code that was read in a separate request before the fault appeared does not belong to the fault.
            Some((Some(_), at)) if at < fault.at => return false,
            Some(_) => Some(0),
        };
        match self.faults.of_mut(index) {
            // The code disappears before its bit, or is sometimes not read: the fault is still the same one.
            Some(before) if active == Some(0) && *before != 0 => return false,
            before if *before != active => *before = active,
            _ => return false,
        }
        if let Some((code, written)) = active.zip(*self.written.of(index)) {
            let trip = Trip {
                fault: code,
                after: now.saturating_duration_since(written),
                repeats: reading.spec.refresh.is_some(),
            };
            self.diagnosis.tripped(index, trip, now);
        }
        match active {
            Some(0) => self.drive_event(index, EventKind::Fault, None, |name| {
                format!("drive {name} has a fault with an unknown code")
            }),
            Some(code) => self.drive_event(index, EventKind::Fault, Some(code), |name| {
                format!(
                    "drive {name} has fault {code}: {}",
                    reading.spec.profile.fault_text(code)
                )
            }),
            None => self.drive_event(index, EventKind::FaultEnd, None, |name| {
                format!("the fault of drive {name} has cleared")
            }),
        }
        active.is_some()
    }

    pub(super) fn fast_round(&self, cycle: Option<Duration>) {
        if let Some(cycle) = cycle {
            self.image.fast_cycles.observe(cycle);
        }
        self.image.update_health(|h| {
            h.fast = PollCycle {
                last: cycle.or(h.fast.last),
                rounds: h.fast.rounds + 1,
            }
        });
    }

    fn slow_round(&self, cycle: Option<Duration>) {
        if let Some(cycle) = cycle {
            self.image.slow_cycles.observe(cycle);
        }
        self.image.update_health(|h| {
            h.slow = PollCycle {
                last: cycle.or(h.slow.last),
                rounds: h.slow.rounds + 1,
            }
        });
    }

    /// Records a request sent at `began`, on a line that had been silent since `quiet_since`, for the recorder and
    /// for trace subscribers; `None` if there is neither.
    pub(super) fn tape_request(
        &self,
        index: Option<DriveIndex>,
        request: &Request,
        frame: &[u8],
        quiet_since: Instant,
        began: Instant,
    ) -> Option<Tap> {
        tap::tape(&self.image, index, frame, Verdict::Sent, began);
        if !self.image.trace.has_listener() {
            return None;
        }
        let tap = Tap::new(self.image.clone(), index, request.clone(), frame.to_vec(), began);
        tap.sent(quiet_since, began);
        Some(tap)
    }

    /// Gives the recorder the bytes received after a request; there may be none.
    pub(super) fn tape_reply(&self, index: Option<DriveIndex>, heard: &[u8], ended: &Ended, now: Instant) {
        tap::tape(&self.image, index, heard, tap::taped(ended), now);
    }

    /// A transaction received bytes that are not a reply.
    fn foreign(&self) {
        self.image.update_health(|h| h.foreign += 1);
    }

    /// Unrequested bytes arrived at `now`, on a line that had been silent since `quiet_since`.
    pub(super) fn noise(&self, bytes: &[u8], quiet_since: Instant, now: Instant) {
        self.foreign();
        tap::noise(&self.image, bytes, quiet_since, now);
    }

    /// A transaction used the line for this time.
    pub(super) fn in_use(&mut self, took: Duration) {
        self.busy += took;
        self.image.transactions.observe(took);
    }

    /// Reports that another master read a drive.
    pub(super) fn foreign_read(
        &mut self,
        index: DriveIndex,
        table: Table,
        start: u16,
        words: &[u16],
        at: Instant,
        now: Instant,
    ) -> bool {
        let drive = self.drive(index);
        self.image.tape.read(index, || TapedRead {
            at,
            table,
            start,
            words: words.into(),
        });
        let mut fast = false;
        drive.update(|snapshot| fast = snapshot.hear(table, start, words, at));
        let reading = drive.reading(now, RECENT);
        self.check_fault(index, &reading);
        self.report_state(index, &reading);
        fast
    }

    /// A transaction has ended: updates counters, turnaround, load.
    pub(super) fn exchanged(&mut self, drive: Option<DriveIndex>, exchanged: &Exchanged, now: Instant) {
        let transaction = &exchanged.transaction;
        self.busy += exchanged.took;
        self.image.transactions.observe(exchanged.took);
        let stray = matches!(exchanged.ended, Ended::Reply(_)) && !transaction.rest().is_empty();
        let foreign = u64::from(transaction.foreign()) + u64::from(stray);
        if foreign > 0 {
            self.image.update_health(|h| h.foreign += foreign);
        }
        let Some(index) = drive else { return };
        let drive = self.image.drives.of(index);
        drive.count(counted(&exchanged.ended));
        if matches!(&exchanged.ended, Ended::Reply(Reply::Written)) {
            *self.written.of_mut(index) = Some(now);
        }
        let mut turnaround = None;
        if let (Ended::Reply(reply), Some(first)) = (&exchanged.ended, transaction.first_byte()) {
            // If the driver delivers a reply as a whole, its first byte arrived earlier by the duration of the reply.
            let by_first = first.saturating_duration_since(exchanged.sent);
            let by_last = now.saturating_duration_since(exchanged.sent);
            let by_last = by_last.saturating_sub(exchanged.reply_time);
            if !matches!(reply, Reply::Exception(_)) {
                let measured = by_first.min(by_last);
                drive.set_turnaround(measured);
                turnaround = Some(measured);
            }
        }
        self.diagnosis.exchanged(index, exchanged, turnaround, now);
    }

    /// Runs the diagnosis every 5 s, with the reads to which drives never reply, and calculates the load once a second.
    pub(super) fn tick(&mut self, unanswered: impl FnOnce() -> PerDrive<Vec<PlannedRead>>, now: Instant) {
        for (drive, text) in self.diagnosis.tick(unanswered, now) {
            let drive = drive.map(|drive| self.image.drives.of(drive).spec.name.clone());
            let about = drive.as_ref().map_or(String::new(), |drive| format!(", drive {drive}"));
            let text = format!("{}{about}: {text}", self.image.spec.name);
            self.event(EventKind::Diagnosis, drive, None, text);
        }
        let window = now.saturating_duration_since(self.window);
        if window < LOAD_WINDOW {
            return;
        }
        let load = (self.busy.as_secs_f64() / window.as_secs_f64()).min(1.0);
        self.image.update_health(|h| h.load = Some(load));
        self.window = now;
        self.busy = Duration::ZERO;
    }
}

/// The counter that a transaction with this result belongs to.
fn counted(ended: &Ended) -> Counted {
    match ended {
        Ended::Reply(Reply::Exception(_)) => Counted::Exception,
        Ended::Reply(_) => Counted::Ok,
        Ended::Silent | Ended::Corrupt(CONNECTION_CLOSED) => Counted::Timeout,
        Ended::Corrupt(_) => Counted::Corrupt,
    }
}

/// Marks a drive as offline, even one that never replied. Returns false if it already is.
fn goes_offline(drive: &DriveImage) -> bool {
    if matches!(drive.snapshot().link, Link::Offline(_)) {
        return false;
    }
    drive.update(|s| {
        s.link = Link::Offline(SystemTime::now());
        s.expire_slow_values();
    });
    true
}

#[cfg(test)]
mod tests;
