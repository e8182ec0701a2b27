//! What the bus tells: health and figures of the image, and events.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use super::confirm::NotConfirmed;
use super::tap::{self, Tap};
use super::transaction::{Ended, Transaction};
use super::watchdog::{OwnResponse, own_response};
use crate::cache::{Access, BusImage, Link, Outcome as Counted, PollCycle};
use crate::codec::{Exception, Reply, Request};
use crate::drive::{ModelPoint, PlannedRead, Value};
use crate::event::{Event, EventKind, Events};

/// The load of the line is reckoned over this time.
const LOAD_WINDOW: Duration = Duration::from_secs(1);

/// Tells what a bus does.
#[derive(Debug)]
pub(super) struct Report {
    image: Arc<BusImage>,
    events: Events,
    window: Instant,
    busy: Duration,
    /// Fault code of each drive as last told; `None` is no fault.
    faults: Vec<Option<i64>>,
    /// Drives whose own response to a silent master was looked at since they came online.
    looked_at: Vec<bool>,
    up: bool,
    reason: String,
}

impl Report {
    pub(super) fn new(image: Arc<BusImage>, events: Events) -> Report {
        let faults = vec![None; image.drives.len()];
        Report {
            image,
            events,
            window: Instant::now(),
            busy: Duration::ZERO,
            looked_at: vec![false; faults.len()],
            faults,
            up: false,
            reason: String::new(),
        }
    }

    fn tell(&self, kind: EventKind, drive: Option<usize>, fault_code: Option<i64>, text: String) {
        let drive = drive
            .and_then(|i| self.image.drives.get(i))
            .map(|d| d.spec.name.clone());
        let bus = self.image.spec.name.clone();
        self.events.tell(Event {
            id: 0,
            time: SystemTime::now(),
            kind,
            bus,
            drive,
            fault_code,
            text,
        });
    }

    pub(super) fn bus_up(&mut self) {
        self.up = true;
        self.reason.clear();
        self.window = Instant::now();
        self.busy = Duration::ZERO;
        self.image.update_health(|h| {
            h.up = true;
            h.tried = true;
            h.since = Some(SystemTime::now());
            h.reason = None;
            h.opened += 1;
        });
        let text = format!("port {} of bus {} is open", self.image.spec.port, self.image.spec.name);
        self.tell(EventKind::BusUp, None, None, text);
    }

    /// Told once a reason, not at every try.
    pub(super) fn bus_down(&mut self, why: &str) {
        let news = self.up || self.reason != why;
        self.image.update_health(|h| {
            if h.up || !h.tried {
                h.since = Some(SystemTime::now());
            }
            h.up = false;
            h.tried = true;
            h.load = 0.0;
            h.reason = Some(why.to_string());
        });
        self.up = false;
        if news {
            self.reason = why.to_string();
            let name = &self.image.spec.name;
            self.tell(
                EventKind::BusDown,
                None,
                None,
                format!("bus {name} is down: {why}; trying again every 3 s at the latest"),
            );
        }
    }

    pub(super) fn online(&mut self, index: usize) {
        let Some(drive) = self.image.drives.get(index) else {
            return;
        };
        drive.update(|s| s.link = Link::Online(SystemTime::now()));
        if let Some(looked_at) = self.looked_at.get_mut(index) {
            *looked_at = false;
        }
        self.tell(
            EventKind::Online,
            Some(index),
            None,
            format!("drive {} answers", drive.spec.name),
        );
    }

    pub(super) fn offline(&mut self, index: usize, why: &str) {
        let Some(drive) = self.image.drives.get(index) else {
            return;
        };
        if matches!(drive.snapshot().link, Link::Offline(_)) {
            return;
        }
        drive.update(|s| {
            s.link = Link::Offline(SystemTime::now());
            s.outlive();
        });
        let text = format!(
            "drive {} is offline: {why}; it is asked again with pauses up to 10 s",
            drive.spec.name
        );
        self.tell(EventKind::Offline, Some(index), None, text);
    }

    pub(super) fn restarted(&self, index: usize) {
        let Some(drive) = self.image.drives.get(index) else {
            return;
        };
        let text = format!(
            "drive {} has started anew; it is read again, and takes only commands that come from now on",
            drive.spec.name
        );
        self.tell(EventKind::Restarted, Some(index), None, text);
    }

    /// A drive told another device type than its profile expects.
    pub(super) fn unlike(&self, index: usize, device: u8) {
        let Some(drive) = self.image.drives.get(index) else {
            return;
        };
        let text = format!(
            "drive {} says that it is a device of type {device:02X}h, its profile `{}` expects {:02X}h; check address and \
             profile, or set device_type in [n2] of the profile",
            drive.spec.name, drive.spec.profile.name, drive.spec.profile.n2.device_type
        );
        self.tell(EventKind::UnlikeProfile, Some(index), None, text);
    }

    pub(super) fn not_confirmed(&self, late: &NotConfirmed) {
        let Some(drive) = self.image.drives.get(late.drive) else {
            return;
        };
        let text = format!("drive {} {}", drive.spec.name, late.text);
        self.tell(EventKind::NotConfirmed, Some(late.drive), None, text);
    }

    pub(super) fn unavailable(&self, index: usize, read: &PlannedRead, exception: Exception) {
        let Some(drive) = self.image.drives.get(index) else {
            return;
        };
        drive.update(|s| s.refuse(read.table, read.start, read.count, exception));
        tracing::warn!(
            bus = %self.image.spec.name, drive = %drive.spec.name,
            "the drive refuses {} {} with {exception}; its points are bad; asked again after 2 s, later every minute",
            read.table, read.start
        );
    }

    /// Tells, once each time it comes online, of a controlled drive that does not respond to a silent master.
    pub(super) fn look_at_supervision(&mut self, index: usize) {
        let (Some(drive), Some(looked_at)) = (self.image.drives.get(index), self.looked_at.get_mut(index)) else {
            return;
        };
        if *looked_at || drive.spec.access == Access::Monitor {
            return;
        }
        let response = own_response(&drive.reading(Instant::now(), Duration::from_secs(60)));
        *looked_at = response != OwnResponse::Unknown;
        let OwnResponse::Off(point) = response else { return };
        let name = &drive.spec.name;
        if drive.spec.supervision.is_some() {
            tracing::warn!(
                bus = %self.image.spec.name, drive = %name,
                "the drive does not respond to a silent master ({point} = 0), its lease stops it only while the gateway \
                 works; set the parameter to a stop if the process allows it"
            );
            return;
        }
        let text = format!(
            "nothing stops drive {name} when whoever commands it falls silent: it has no lease, and its own response to a \
             silent master is off ({point} = 0); configure supervision, and set the parameter if the process allows it"
        );
        self.tell(EventKind::Unsupervised, Some(index), None, text);
    }

    /// Faults that came or went with the last poll.
    pub(super) fn look(&mut self, index: usize) {
        let Some(drive) = self.image.drives.get(index) else {
            return;
        };
        let reading = drive.reading(Instant::now(), Duration::from_secs(60));
        let Some(fault) = reading.model(ModelPoint::Fault).good() else {
            return;
        };
        let told = reading.model(ModelPoint::FaultCode);
        let code = match told.good() {
            Some(Value::Integer(code)) => code,
            _ => 0,
        };
        // A code that was read before the fault came, in a request of its own, is not that of the fault.
        let before_the_fault = told.at < reading.model(ModelPoint::Fault).at;
        if fault.as_bool() && code == 0 && told.good().is_some() && before_the_fault {
            return;
        }
        let now = fault.as_bool().then_some(code);
        let Some(before) = self.faults.get_mut(index) else {
            return;
        };
        if *before == now {
            return;
        }
        *before = now;
        let name = &drive.spec.name;
        match now {
            Some(code) => {
                let text = format!("drive {name} has fault {code}: {}", drive.spec.profile.fault_text(code));
                self.tell(EventKind::Fault, Some(index), Some(code), text);
            }
            None => self.tell(
                EventKind::FaultEnd,
                Some(index),
                None,
                format!("the fault of drive {name} is gone"),
            ),
        }
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

    pub(super) fn slow_round(&self, cycle: Option<Duration>) {
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

    /// Looks at an exchange for whoever listens to the frames; `None` while nobody does. The request was given to the
    /// line at `began`, which had been silent since `quiet_since`.
    pub(super) fn tap<'r>(
        &self,
        index: usize,
        request: &'r Request,
        frame: &'r [u8],
        quiet_since: Instant,
        began: Instant,
    ) -> Option<Tap<'r>> {
        if !self.image.trace.wanted() {
            return None;
        }
        let tap = Tap::new(self.image.clone(), index, request, frame, began);
        tap.sent(quiet_since, began);
        Some(tap)
    }

    /// Bytes that are nobody's answer came in an exchange.
    pub(super) fn foreign(&self) {
        self.image.update_health(|h| h.foreign += 1);
    }

    /// Bytes that nobody asked for came at `now`, on a line that had been silent since `quiet_since`.
    pub(super) fn noise(&self, bytes: &[u8], quiet_since: Instant, now: Instant) {
        self.foreign();
        tap::noise(&self.image, bytes, quiet_since, now);
    }

    /// An exchange is over: counters, turnaround, load. `sent` is when the drive knew that the request was over.
    pub(super) fn exchanged(
        &mut self,
        index: usize,
        transaction: &Transaction<'_>,
        ended: &Ended,
        sent: Instant,
        reply_time: Duration,
        took: Duration,
    ) {
        self.busy += took;
        self.image.transactions.observe(took);
        if transaction.foreign() > 0 {
            self.image
                .update_health(|h| h.foreign += u64::from(transaction.foreign()));
        }
        let Some(drive) = self.image.drives.get(index) else {
            return;
        };
        drive.count(counted(ended));
        let now = Instant::now();
        if let (Ended::Reply(reply), Some(first)) = (ended, transaction.first_byte()) {
            // Where the driver hands a reply over whole, its first byte came a reply's time earlier.
            let by_first = first.saturating_duration_since(sent);
            let by_last = now.saturating_duration_since(sent).saturating_sub(reply_time);
            if !matches!(reply, Reply::Exception(_)) {
                drive.set_turnaround(by_first.min(by_last));
            }
        }
    }

    /// Reckons the load once a second.
    pub(super) fn tick(&mut self, now: Instant) {
        let window = now.saturating_duration_since(self.window);
        if window < LOAD_WINDOW {
            return;
        }
        let load = (self.busy.as_secs_f64() / window.as_secs_f64()).min(1.0);
        self.image.update_health(|h| h.load = load);
        self.window = now;
        self.busy = Duration::ZERO;
    }
}

/// What the counters call an exchange that ended so.
fn counted(ended: &Ended) -> Counted {
    match ended {
        Ended::Reply(Reply::Exception(_)) => Counted::Exception,
        Ended::Reply(_) => Counted::Ok,
        Ended::Silent => Counted::Timeout,
        Ended::Corrupt(_) => Counted::Corrupt,
    }
}
