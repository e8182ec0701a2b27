//! A bus that only listens, without its thread: the traffic of another master and its drives is recorded in the
//! process image, events and the audit. Pure: bytes and time are arguments, and nothing is ever sent.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::commands::{Commanded, Commands};
use super::decoder::{Decoder, Exchange, Traffic};
use crate::BusOptions;
use crate::core::Closed;
use crate::news::News;
use crate::report::Report;
use crate::transaction::Ended;
use drivegate_core::event::{EventKind, Events};
use drivegate_core::order::{Origin, Outcome, Refusal, SourceKind, Ticket};
use drivegate_core::plant::BusHandle;
use drivegate_core::process_image::{Cadence, Outcome as Counted};
use drivegate_model::drive::{DriveIndex, PerDrive, Profile};
use drivegate_proto::{Exception, Protocol, Reply, RequestPdu, Table};

/// Time without a reply after which a drive is offline, or three of its usual pauses if that is longer.
const SILENT: Duration = Duration::from_secs(5);
/// Longest pause between two looks at the time.
const LOOK: Duration = Duration::from_millis(100);

/// The state of one drive apart from its image.
#[derive(Debug)]
struct DriveRecord {
    address: u8,
    /// Requests in a row that got no reply.
    unanswered: u32,
    /// When the drive was last received; before the first time, the opening of the port.
    heard: Instant,
    /// Longest recent pause between two replies of the drive: a whole round of the other master, where that polls drive
    /// after drive.
    pause: Duration,
    commands: Commands,
    /// First addresses of values with two registers, which are never stored by halves.
    wide: Vec<(Table, u16)>,
}

/// A bus that only listens, without its thread.
#[derive(Debug)]
pub struct ListenCore {
    bus: BusHandle,
    decoder: Decoder,
    report: Report,
    drives: PerDrive<DriveRecord>,
    /// Tries of the other master, after the first, before a drive is offline.
    retries: u32,
    /// Reads of process data in the present round of the other master, and when the round began.
    round: (Vec<(DriveIndex, Table, u16)>, Option<Instant>),
    heard: Vec<Traffic>,
    /// Something was received since the port was opened or reconnected.
    heard_any: bool,
}

impl ListenCore {
    /// A bus whose port is not open yet.
    pub fn new(bus: BusHandle, options: &BusOptions, events: Events, now: Instant) -> ListenCore {
        let known = |drive: &Arc<drivegate_core::process_image::DriveImage>| {
            drive.update(|snapshot| snapshot.heard = Some(Cadence::default()));
            DriveRecord {
                address: drive.spec.address,
                unanswered: 0,
                heard: now,
                pause: Duration::ZERO,
                commands: Commands::default(),
                wide: wide(&drive.spec.profile),
            }
        };
        ListenCore {
            drives: bus.image.drives.iter().map(known).collect(),
            decoder: decoder(&bus),
            report: Report::new(&bus, options, events, now),
            bus,
            retries: options.retries,
            round: (Vec::new(), None),
            heard: Vec::new(),
            heard_any: false,
        }
    }

    /// Notes that the port was opened.
    pub fn opened(&mut self, now: Instant) {
        self.decoder = decoder(&self.bus);
        self.heard_any = false;
        for known in &mut self.drives {
            (known.unanswered, known.heard) = (0, now);
        }
        self.round = (Vec::new(), None);
        self.report.bus_up(now);
        self.bus.image.update_health(|health| health.unknown = Some(Vec::new()));
        self.refuse_all(now);
    }

    /// Handles a device server that closed the connection. If bytes were received over it, the gateway connects
    /// again at once.
    pub fn closed(&mut self) -> Closed {
        if std::mem::take(&mut self.heard_any) {
            Closed::Reconnect
        } else {
            Closed::Lost
        }
    }

    /// The port was reconnected: the traffic in between is not known.
    pub fn reconnected(&mut self) {
        self.decoder = decoder(&self.bus);
        self.report.reconnected();
    }

    /// The port has disappeared or cannot be opened.
    pub fn lost(&mut self, why: &str, now: Instant) {
        self.refuse_all(now);
        self.report.bus_down(why, now);
    }

    /// Answers commands that entered the queue although [`drivegate_core::permit::admit`] prevents it, and a gateway that is
    /// about to end: there is nothing to stop.
    pub(crate) fn refuse_all(&mut self, now: Instant) {
        let name = &self.bus.image.spec.name;
        let refusal = Refusal::NotAllowed(format!("bus `{name}` only listens; nothing is sent"));
        self.bus.queue.close(Outcome::Refused(refusal), now);
        if let Some(stopping) = self.bus.queue.lock().take_stopping() {
            stopping.report(Vec::new());
        }
    }

    /// Processes bytes received at `now`.
    pub fn on_bytes(&mut self, bytes: &[u8], now: Instant) {
        self.heard_any |= !bytes.is_empty();
        let mut heard = std::mem::take(&mut self.heard);
        self.decoder.on_bytes(bytes, now, &mut heard);
        self.take(&mut heard, now);
        self.heard = heard;
    }

    /// Time went by; until when nothing else is to be done.
    pub fn on_time(&mut self, now: Instant) -> Instant {
        let mut heard = std::mem::take(&mut self.heard);
        self.decoder.on_time(now, &mut heard);
        self.take(&mut heard, now);
        self.heard = heard;
        for index in self.drives.indexes() {
            let known = self.drives.of_mut(index);
            let silent = SILENT.max(known.pause * 3);
            let is_silent = now.saturating_duration_since(known.heard) > silent;
            let due = known.commands.due(now);
            if is_silent {
                let why = format!("no reply from it for {} s", silent.as_secs());
                self.report.gone(index, &why);
            }
            if let Some(commanded) = due {
                self.report_command(index, commanded);
            }
        }
        self.report.tick(PerDrive::default, now);
        let due = self.drives.iter().filter_map(|known| known.commands.due_at());
        let wake = due.chain(self.decoder.wake_at()).min();
        wake.unwrap_or(now + LOOK).clamp(now, now + LOOK)
    }

    fn take(&mut self, heard: &mut Vec<Traffic>, now: Instant) {
        for one in heard.drain(..) {
            match one {
                Traffic::Stray { bytes, at, quiet_since } => {
                    self.report.noise(&bytes, quiet_since, at);
                    self.report.diagnosis.figures().stray(&bytes);
                }
                Traffic::Exchange(exchange) => self.exchange(&exchange, now),
            }
        }
    }

    fn exchange(&mut self, exchange: &Exchange, now: Instant) {
        let index = self.drives.position(|known| known.address == exchange.address);
        self.show(index, exchange);
        self.report
            .in_use(exchange.at.saturating_duration_since(exchange.began).min(LOOK * 10));
        if exchange.address == 0 {
            self.drives.indexes().for_each(|drive| self.commanded(drive, exchange));
            return;
        }
        match index {
            Some(index) => self.of_drive(index, exchange, now),
            None if matches!(exchange.ended, Some(Ended::Reply(_))) => self.unknown(exchange.address),
            None => {}
        }
    }

    /// The frames, for the trace and the recorder.
    fn show(&self, index: Option<DriveIndex>, exchange: &Exchange) {
        let Some(request) = &exchange.request else {
            self.report.noise(&exchange.frame, exchange.quiet_since, exchange.sent);
            if !exchange.heard.is_empty() {
                self.report.noise(&exchange.heard, exchange.sent, exchange.at);
            }
            return;
        };
        let (quiet_since, began) = (exchange.quiet_since, exchange.began);
        let tap = self
            .report
            .tape_request(index, request, &exchange.frame, quiet_since, began);
        let doubted = exchange.doubt.map(Ended::Corrupt);
        let ended = match &exchange.ended {
            Some(Ended::Reply(_)) => doubted.as_ref().or(exchange.ended.as_ref()),
            ended => ended.as_ref(),
        };
        let Some(ended) = ended else { return };
        self.report.tape_reply(index, &exchange.heard, ended, exchange.at);
        if let Some(mut tap) = tap {
            tap.received(&exchange.heard, exchange.at);
            tap.ended(ended, exchange.at);
        }
    }

    fn unknown(&mut self, address: u8) {
        let mut new = false;
        self.bus.image.update_health(|health| {
            let unknown = health.unknown.get_or_insert_default();
            if let Err(place) = unknown.binary_search(&address) {
                unknown.insert(place, address);
                new = true;
            }
        });
        if new {
            tracing::info!(
                target: "drivegate::bus::listener", bus = %self.bus.image.spec.name, address,
                "a drive without an entry answers the other master at address {address}; add a [[bus.drive]] for it \
                 to see its values; `drivegate listen` shows what is read from it"
            );
        }
    }

    fn of_drive(&mut self, index: DriveIndex, exchange: &Exchange, now: Instant) {
        let (image, known) = (self.bus.image.drives.of(index), self.drives.of_mut(index));
        self.report.diagnosis.foreign_exchange(index, exchange);
        let no_answer = matches!(&exchange.ended, Some(Ended::Reply(Reply::Exception(code))) if code.is_no_answer());
        let answered = matches!(exchange.ended, Some(Ended::Reply(_))) && !no_answer;
        // Bytes after an unknown command may be its reply.
        let is_known = exchange.request.is_some();
        if let Some(ended) = exchange.ended.as_ref().filter(|_| is_known) {
            image.count(match ended {
                _ if exchange.doubt.is_some() => Counted::Corrupt,
                Ended::Reply(Reply::Exception(_)) => Counted::Exception,
                Ended::Reply(_) => Counted::Ok,
                Ended::Silent => Counted::Timeout,
                Ended::Corrupt(_) => Counted::Corrupt,
            });
        }
        // A Modbus reply contains the address of its drive, so any reply proves that the drive is alive.
        let is_alive = exchange.doubt.is_none() || self.bus.image.spec.protocol != Protocol::N2;
        if answered && is_alive {
            let interval = exchange.at.saturating_duration_since(known.heard);
            known.pause = pause_after(known.pause, interval);
            (known.unanswered, known.heard) = (0, exchange.at);
            if !image.snapshot().link.is_online() {
                self.report.apply(&News::Online(index), now);
            }
            if exchange.doubt.is_none() {
                let spec = &self.bus.image.spec;
                let replied = exchange.replied.unwrap_or(exchange.at);
                // The silence that marks the end of a request is not part of the drive's turnaround.
                let recognition = spec.protocol.recognition(&spec.format);
                image.set_turnaround(replied.saturating_duration_since(exchange.sent + recognition));
            }
        } else if is_known && (no_answer || exchange.ended == Some(Ended::Silent)) {
            known.unanswered = known.unanswered.saturating_add(1);
            if known.unanswered > self.retries {
                let times = known.unanswered;
                self.report.gone(
                    index,
                    &format!("it left {times} requests of the other master unanswered"),
                );
            }
        }
        if let Some((request, reply)) = exchange.believed() {
            self.believed(index, &request.pdu, reply, exchange, now);
        }
        self.commanded(index, exchange);
    }

    fn believed(&mut self, index: DriveIndex, pdu: &RequestPdu, reply: &Reply, exchange: &Exchange, now: Instant) {
        let (table, start) = match pdu {
            RequestPdu::Read { table, start, .. } => (*table, *start),
            RequestPdu::ReadWrite { read_start, .. } => (Table::Holding, *read_start),
            _ => return,
        };
        match reply {
            Reply::Exception(Exception::N2_RESTARTED) => {
                self.report.apply(&News::Restarted(index), now);
            }
            reply => {
                if let Some(words) = reply.words() {
                    self.read(index, (table, start), &words, exchange.asked_by, now);
                }
            }
        }
    }

    /// Stores the values that were read. Values of which only a part was read are not stored.
    fn read(&mut self, index: DriveIndex, (table, start): (Table, u16), words: &[u16], at: Instant, now: Instant) {
        let (image, known) = (self.bus.image.drives.of(index), self.drives.of(index));
        let table = image.spec.profile.canonical(table);
        let mut words = words;
        let mut start = start;
        let is_wide = |address: Option<u16>| address.is_some_and(|address| known.wide.contains(&(table, address)));
        // The read begins with the second half of a value.
        if is_wide(start.checked_sub(1)) {
            let Some(next) = start.checked_add(1) else { return };
            (start, words) = (next, words.get(1..).unwrap_or_default());
        }
        let last = u16::try_from(words.len())
            .ok()
            .and_then(|count| start.checked_add(count.checked_sub(1)?));
        if is_wide(last) {
            words = words.get(..words.len() - 1).unwrap_or_default();
        }
        if words.is_empty() || !self.report.foreign_read(index, table, start, words, at, now) {
            return;
        }
        let key = (index, table, start);
        let (seen, began) = &mut self.round;
        if seen.contains(&key) || began.is_none() {
            let cycle = began.replace(at).map(|before| at.saturating_duration_since(before));
            seen.clear();
            self.report.fast_round(cycle);
        }
        // If the reads of the other master never repeat, the master has no cycle.
        if self.round.0.len() < 4096 {
            self.round.0.push(key);
        }
    }

    /// Reports a write of the other master.
    fn commanded(&mut self, index: DriveIndex, exchange: &Exchange) {
        let Some(request) = exchange.request.as_ref().filter(|request| request.pdu.is_write()) else {
            return;
        };
        let (image, known) = (self.bus.image.drives.of(index), self.drives.of_mut(index));
        let protocol = self.bus.image.spec.protocol;
        let commanded = known
            .commands
            .process_write(&image.spec, protocol, &request.pdu, exchange);
        if let Some(commanded) = commanded {
            self.report_command(index, commanded);
        }
    }

    fn report_command(&self, index: DriveIndex, commanded: Commanded) {
        let image = self.bus.image.drives.of(index);
        let Commanded {
            what,
            changes,
            outcome,
            began,
            at,
        } = commanded;
        self.report.drive_event(index, EventKind::ForeignCommand, None, |name| {
            format!("the other master commands {name}: {what}; {outcome}")
        });
        let origin = Origin::new(SourceKind::OtherMaster, self.bus.image.spec.name.clone());
        let (ticket, _) = Ticket::new(
            origin,
            &image.spec.name,
            what,
            true,
            began,
            self.bus.command_log.clone(),
        );
        ticket.with_changes(changes).answer(outcome, at);
    }
}

/// The longest recent pause, updated by one more. A longer one counts as at most four times the previous, so that a
/// rest of the other master does not delay later notices; a long one is reduced by an eighth of the time since,
/// however many replies arrived in it.
fn pause_after(last: Duration, pause: Duration) -> Duration {
    let most = last.max(Duration::from_secs(1)) * 4;
    let left = last.saturating_sub(pause / 8);
    pause.min(Cadence::LONGEST).min(most).max(left)
}

fn decoder(bus: &BusHandle) -> Decoder {
    let spec = &bus.image.spec;
    let drives = bus.image.drives.iter();
    let n2: BTreeMap<_, _> = drives.map(|d| (d.spec.address, d.spec.profile.n2)).collect();
    Decoder::new(spec.protocol, spec.format, n2)
}

/// First addresses of all values with two registers.
fn wide(profile: &Profile) -> Vec<(Table, u16)> {
    let raw = profile.points.iter().filter_map(|point| point.raw());
    raw.filter(|raw| raw.form.items() == 2)
        .map(|raw| (raw.table, raw.address))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_pause_of_a_round_outlasts_the_reads_of_one_drive() {
        let seconds = Duration::from_secs;
        let mut pause = Duration::ZERO;
        // The other master reads this drive forty times, then other drives for forty seconds.
        for _ in 0..4 {
            pause = pause_after(pause, seconds(40));
            pause = (0..40).fold(pause, |pause, _| pause_after(pause, Duration::from_millis(30)));
        }
        assert!(pause > seconds(39) && pause <= seconds(40), "{pause:?}");
        // The drive is read continuously after a rest of an hour.
        let rested = pause_after(Duration::from_millis(30), seconds(3600));
        assert_eq!(rested, seconds(4));
        let later = (0..2000).fold(rested, |pause, _| pause_after(pause, Duration::from_millis(30)));
        assert_eq!(later, Duration::from_millis(30));
    }
}
