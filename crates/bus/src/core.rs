//! A bus without its thread: the line, the master and their reports. Pure: bytes and time are arguments;
//! [`BusCore::poll`] returns what to do with the port.

use std::time::{Duration, Instant};

use super::BusOptions;
use super::closing_server::ClosingServer;
use super::drive_counters::DriveCounters;
use super::line_state::{Exchanged, LineState};
use super::master::{Handover, Master, Purpose, Remains, Turn, TurnEnd};
use super::n2_late_replies::N2LateReplies;
use super::news::News;
use super::report::Report;
use super::tap::Tap;
use super::transaction::Ended;
use drivegate_core::event::Events;
use drivegate_core::order::{Outcome, Target, Urgency};
use drivegate_core::plant::BusHandle;
use drivegate_core::process_image::Taping;
use drivegate_core::stalls::Stalls;
use drivegate_proto::{Exception, Reply, Request};

/// What the bus does next with the port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Action {
    /// Read the received bytes; if there are none, write the frame that [`BusCore::sending`] returns to the port.
    Send,
    /// Wait for bytes, or until this time.
    Wait {
        /// Latest time at which the caller must call again.
        until: Instant,
        /// Whether an arriving command ends the wait.
        commands: bool,
        /// Whether the wake-up must be exact to some tens of microseconds.
        precise: bool,
    },
}

/// Reaction to a device server that closed the connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Closed {
    /// Reconnect at once: the server has replied over this connection, or a reply may still arrive over the next one.
    Reconnect,
    /// Reconnect when there is something to send.
    ReconnectToAsk,
    /// The port must be given up as lost.
    Lost,
}

/// Events since the port was opened or reconnected.
#[derive(Debug, Default)]
struct Connection {
    /// Whether the connection replaced one over which the server had replied.
    anew: bool,
    /// Whether the connection was made to send something.
    to_ask: bool,
    asked: bool,
    answered: bool,
    /// Number of previous connections that ended during a transaction, with no reply since.
    vain: u32,
}

/// Maximum number of consecutive connections that may end during a transaction. A server may have a shorter time limit
/// for a drive that is off, or close after one request; but a server that never replies does not reach the drives.
const MAX_BROKEN_CONNECTIONS: u32 = 3;

/// Interval of the checks whether a thread that reads orders is stalled; short beside the stall that counts.
const DEAF_CHECK: Duration = Duration::from_millis(20);

/// The request to send when the line is clear.
#[derive(Debug)]
struct Chosen {
    turn: Turn,
    request: Request,
    frame: Vec<u8>,
    since: Instant,
}

/// The transaction on the line.
#[derive(Debug)]
struct OnLine {
    turn: Turn,
    tap: Option<Tap>,
    /// Whether the thread was stalled since the request was sent.
    stood: bool,
}

/// A bus without the thread that runs it.
#[derive(Debug)]
pub struct BusCore {
    bus: BusHandle,
    line: LineState,
    master: Master,
    report: Report,
    chosen: Option<Chosen>,
    /// Until when a reply to a request of the previous bus may arrive; nothing is sent before.
    quiet_until: Option<Instant>,
    /// The transaction on the line.
    asked: Option<OnLine>,
    connection: Connection,
    server: ClosingServer,
    counters: DriveCounters,
    /// An empty list, kept to reuse its memory.
    news: Vec<News>,
    /// Stalls of the bus thread; `None` before it runs.
    stalls: Option<Stalls>,
    /// When the threads that read orders were last checked for a stall.
    deaf_checked: Instant,
}

impl BusCore {
    /// A bus whose port is not open yet; `before` is the handover of the previous bus.
    pub fn new(bus: BusHandle, options: &BusOptions, events: Events, before: &Handover, now: Instant) -> BusCore {
        let spec = &bus.image.spec;
        let silence = spec.protocol.silence(options.silence, &spec.format);
        let mut line = LineState::new(spec.protocol, spec.format, silence, now);
        if let Some(learned) = before.learned {
            line.take_over(learned);
        }
        BusCore {
            line,
            master: Master::new(bus.clone(), options, silence, before, now),
            report: Report::new(&bus, options, events, now),
            counters: DriveCounters::new(&bus, now),
            bus,
            chosen: None,
            quiet_until: before.quiet_until,
            asked: None,
            connection: Connection::default(),
            server: ClosingServer::default(),
            news: Vec::new(),
            stalls: None,
            deaf_checked: now,
        }
    }

    /// Records that the thread runs at `now`; `boot` is the time since the machine was started, including
    /// suspensions. Returns whether the thread was stalled since it last ran: bytes that arrived meanwhile must
    /// then be read before anything else.
    pub fn note_run(&mut self, now: Instant, boot: Duration) -> bool {
        let stalls = self.stalls.get_or_insert_with(|| Stalls::new(now, boot));
        let Some(stall) = stalls.observe(now, boot) else {
            self.prolong_while_deaf(now);
            return false;
        };
        self.deaf_checked = now;
        if let Some(asked) = &mut self.asked {
            asked.stood = true;
        }
        self.master.after_stall(stall, now);
        self.report.after_stall(stall);
        // The chosen frame may rest on what was read before the stall.
        self.command_came();
        true
    }

    /// Prolongs the leases while a thread that reads orders is stalled.
    fn prolong_while_deaf(&mut self, now: Instant) {
        let since = now.saturating_duration_since(self.deaf_checked);
        if since >= DEAF_CHECK {
            self.deaf_checked = now;
            if self.report.readers_are_blocked(now) {
                self.master.prolong(since);
            }
        }
    }

    /// Records that the thread was not stalled but did other work since it last ran, such as opening the port.
    pub fn runs_on(&mut self, now: Instant, boot: Duration) {
        self.deaf_checked = now;
        match &mut self.stalls {
            Some(stalls) => stalls.go_on(now, boot),
            None => self.stalls = Some(Stalls::new(now, boot)),
        }
    }

    /// Notes that the port was opened.
    pub fn opened(&mut self, now: Instant) {
        self.line.reset(now);
        self.connection = Connection::default();
        self.server.connected();
        if let Some(until) = self.quiet_until.take() {
            self.line.leave_alone(until);
        }
        self.master.opened(now);
        self.bus.queue.open();
        self.report.bus_up(now);
    }

    /// Handles a device server that closed the connection. If the server replies, this is not a line fault: the
    /// drives' states do not change, and pending requests keep waiting. Returns what to do with the port.
    pub fn closed(&mut self, now: Instant) -> Closed {
        self.server.closed(self.line.is_underway(), now);
        self.line.cut();
        let Connection {
            anew,
            to_ask,
            asked,
            answered,
            vain,
        } = self.connection;
        if answered {
            return Closed::Reconnect;
        }
        if asked && !self.line.is_underway() {
            // No reply arrived, but the connection lasted as long as a reply may take.
            return Closed::ReconnectToAsk;
        }
        if asked && anew && vain + 1 < MAX_BROKEN_CONNECTIONS {
            self.connection.vain = vain + 1;
            return Closed::Reconnect;
        }
        if !asked && anew && !to_ask {
            self.connection.to_ask = true;
            return Closed::ReconnectToAsk;
        }
        Closed::Lost
    }

    /// Notes that the port was reconnected.
    pub fn reconnected(&mut self) {
        let Connection { to_ask, vain, .. } = self.connection;
        self.connection = Connection {
            anew: true,
            to_ask,
            vain,
            ..Connection::default()
        };
        self.server.connected();
        self.report.reconnected();
        // Commands that arrived meanwhile did not wake the bus.
        self.command_came();
    }

    /// Handles a port that was lost or cannot be opened: all values are stale at once, and all pending requests end.
    pub fn lost(&mut self, why: &str, now: Instant) {
        self.bus.queue.close(Outcome::BusDown, now);
        self.forget_late_replies();
        (self.chosen, self.asked) = (None, None);
        self.master.lost(now);
        self.server.lost();
        self.report.bus_down(why, now);
    }

    /// The bus ends: all pending requests end. Returns the handover for the next bus; the reply to an aborted
    /// transaction may still arrive.
    pub fn ended(&mut self, now: Instant) -> Handover {
        let broken_off = self.asked.as_ref().and(self.line.deadline());
        self.forget_late_replies();
        Handover {
            learned: Some(self.line.learned()),
            ..self.master.ended(broken_off, now)
        }
    }

    /// Late replies of N2 are no longer expected after a broken-off transaction: a later reply would be taken for one of them.
    fn forget_late_replies(&mut self) {
        if self.asked.is_some() {
            *self.master.n2_late() = N2LateReplies::default();
        }
    }

    /// What to do with the port now.
    pub fn poll(&mut self, now: Instant) -> Action {
        loop {
            if self.line.is_underway() {
                match self.line.on_time(now) {
                    Ok(exchanged) => self.over(exchanged, now),
                    Err(until) => return wait(until.unwrap_or(now), false, false),
                }
            }
            let Some(chosen) = &self.chosen else {
                if let Some(until) = self.choose(now) {
                    return wait(until, true, true);
                }
                continue;
            };
            let clear = self.line.clear_at(chosen.since, self.master.silence_of(&chosen.turn));
            let clear = self.server.closes_until().map_or(clear, |until| clear.max(until));
            if now < clear {
                return wait(clear, !chosen.turn.is_stop(), true);
            }
            // Commands that expired while the line went silent are not sent.
            if self.master.is_still_due(&chosen.turn, now) {
                return Action::Send;
            }
            self.chosen = None;
        }
    }

    /// Chooses the next frame to send; otherwise returns the time until which nothing is sent.
    fn choose(&mut self, now: Instant) -> Option<Instant> {
        let mut news = std::mem::take(&mut self.news);
        let next = self.master.next(now, &mut news);
        self.report_all(news, now);
        self.report.tick(|| self.master.unanswered(), now);
        self.counters.poll(&self.bus, &mut self.report.diagnosis, now);
        let turn = match next {
            Ok(turn) => turn,
            Err(until) => return Some(until),
        };
        let request = match turn.target() {
            Target::Address(address) => Request::new(address, turn.pdu().clone()),
            Target::Drive(drive) => {
                let image = self.bus.image.drives.of(drive);
                Request {
                    address: image.spec.address,
                    pdu: turn.pdu().clone(),
                    n2: image.spec.profile.n2,
                }
            }
        };
        let mut frame = self.line.take_frame();
        self.bus.image.spec.protocol.encode(&request, &mut frame);
        if frame.is_empty() {
            // The protocol has no such request, so the result is as if the drive had no such address.
            let refused = Ended::Reply(Reply::Exception(Exception::ADDRESS));
            self.done(
                &turn,
                TurnEnd {
                    ended: refused,
                    began: now,
                    at: now,
                    stood: false,
                    took: Duration::ZERO,
                    mangled: false,
                    doubted: false,
                    frame: Vec::new(),
                },
                now,
            );
            return None;
        }
        self.chosen = Some(Chosen {
            turn,
            request,
            frame,
            since: now,
        });
        None
    }

    /// State left over from faults and commands, for tests.
    pub fn remains(&self, now: Instant) -> Remains {
        self.master.remains(now)
    }

    /// The turn whose transaction is on the line.
    pub fn asked(&self) -> Option<&Turn> {
        self.asked.as_ref().map(|asked| &asked.turn)
    }

    /// A command arrived while the line was idle: the next request is chosen again, unless it is a stop.
    pub fn command_came(&mut self) {
        if self.chosen.as_ref().is_some_and(|chosen| !chosen.turn.is_stop()) {
            self.chosen = None;
        }
    }

    /// Notes that the chosen frame is written to the port at `now`. Must be called before writing, since the effect
    /// of a failed write is unknown.
    pub fn sending(&mut self, now: Instant) -> &[u8] {
        let Some(Chosen {
            turn,
            request,
            frame,
            since,
        }) = self.chosen.take()
        else {
            return &[];
        };
        if self.line.babbles(since) {
            tracing::warn!(target: "drivegate::bus::core", bus = %self.bus.image.spec.name, "the line does not fall \
                                                                                             silent; sending anyway");
        }
        let quiet_since = self.line.quiet_since();
        // Extra silence that a drive needs beyond that of the bus is not a pause of the line.
        let needed = self.line.silence_before(self.master.silence_of(&turn));
        let paused = now.saturating_duration_since(quiet_since + needed.saturating_sub(self.line.silence()));
        self.report.diagnosis.sending(paused);
        let tap = self
            .report
            .tape_request(turn.drive(), &request, &frame, quiet_since, now);
        let sending = self.master.sending(&turn, now);
        self.line.send(request, frame, sending, now);
        self.connection.asked = true;
        self.asked = Some(OnLine {
            turn,
            tap,
            stood: false,
        });
        self.line.frame()
    }

    /// Processes received bytes.
    pub fn received(&mut self, bytes: &[u8], now: Instant) {
        if !self.line.is_underway() {
            if !bytes.is_empty() {
                self.report.noise(bytes, self.line.quiet_since(), now);
                self.report.diagnosis.figures().stray(bytes);
                self.line.received(bytes, self.master.n2_late(), now);
            }
            return;
        }
        if let Some(tap) = self.asked.as_mut().and_then(|asked| asked.tap.as_mut()) {
            tap.received(bytes, now);
        }
        if let Some(exchanged) = self.line.received(bytes, self.master.n2_late(), now) {
            self.over(exchanged, now);
        }
    }

    fn over(&mut self, exchanged: Exchanged, now: Instant) {
        let Some(OnLine { turn, tap, stood }) = self.asked.take() else {
            return;
        };
        if matches!(exchanged.ended, Ended::Reply(_)) {
            self.connection = Connection {
                answered: true,
                ..Connection::default()
            };
            self.server.replied(now);
        }
        let drive = turn.drive();
        self.report.exchanged(drive, &exchanged, now);
        let heard = exchanged.transaction.seen();
        self.report.tape_reply(drive, heard, &exchanged.ended, now);
        if let Some(tap) = tap {
            tap.ended(&exchanged.ended, now);
        }
        let mangled = exchanged.transaction.is_mangled_reply();
        let doubted = exchanged.transaction.only_doubted();
        let frame = match turn.purpose {
            Purpose::Background(_) => exchanged.transaction.reply_frame().to_vec(),
            Purpose::Poll(_) | Purpose::Refresh(_) | Purpose::Session(..) | Purpose::Command { .. } => Vec::new(),
        };
        let Exchanged {
            transaction,
            ended,
            began,
            at,
            took,
            ..
        } = exchanged;
        self.line.keep_buffers(transaction);
        let end = TurnEnd {
            ended,
            began,
            at,
            stood,
            took,
            mangled,
            doubted,
            frame,
        };
        self.done(&turn, end, now);
    }

    fn done(&mut self, turn: &Turn, end: TurnEnd, now: Instant) {
        let mut news = std::mem::take(&mut self.news);
        self.master.done(turn, end, now, &mut news);
        self.report_all(news, now);
    }

    fn report_all(&mut self, mut news: Vec<News>, now: Instant) {
        for one in news.drain(..) {
            let wanted = self.report.apply(&one, now);
            if let Some(drive) = wanted.fault
                && self.bus.image.tape.records(Taping::Everything)
            {
                self.master.fault_came(drive, now);
            }
            for (drive, point, at) in wanted.monitors {
                self.master.monitor(drive, point, at);
            }
        }
        self.news = news;
    }
}

fn wait(until: Instant, commands: bool, precise: bool) -> Action {
    Action::Wait {
        until,
        commands,
        precise,
    }
}

impl Turn {
    fn is_stop(&self) -> bool {
        self.rank() == Some(Urgency::Stop)
    }
}
