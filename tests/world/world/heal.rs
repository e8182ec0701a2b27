//! The second half of a world: every fault ends, and after a computed time all is as good as in a world that never had one.

use drivegate_bus::master::Remains;
use drivegate_model::drive::PollClass;
use drivegate_proto::Table;

use super::*;
use crate::bus::Parts;

/// Time within which a late reply may arrive; requests that it could be mistaken for wait.
const FORGOTTEN: Duration = Duration::from_secs(1);
/// A slow request that was not answered on a troubled line is tried again after that.
const MUTE: Duration = Duration::from_secs(4);
/// The time of a lease, at most, and of a confirmation that is still waited for.
const COMMANDED: Duration = Duration::from_secs(11);
/// Longest pause between two stops of a flood to a drive that does not answer.
const FLOODED: Duration = Duration::from_secs(2);
/// Time after which a read is whole again that a fault let the gateway read in parts.
const WHOLE_AGAIN: Duration = Duration::from_secs(60);
/// Granularity of the measurements.
const STEP: Duration = Duration::from_millis(10);

/// The oldest values of each read of a drive in a time of observation.
type Ages = Vec<Vec<((Table, u16, PollClass), Option<Duration>)>>;

/// State of the second half, in which all faults have ended.
#[derive(Debug, Clone, Copy)]
pub struct Healing {
    /// When the last fault ended.
    since: Instant,
    /// Time from which on no reply can be outstanding that the gateway may mistake for another.
    pub settled: Instant,
}

/// A stop that was given when the faults ended.
struct StopAtOnce {
    bus: usize,
    drive: usize,
    order: usize,
    /// When it must be on the wire.
    due: Instant,
    /// Whether the client has given it again.
    again: bool,
}

impl World {
    /// Ends every fault, after which everything must recover.
    pub(super) fn heal(&mut self) {
        let online = self.end_faults();
        let unread: Vec<bool> = self.buses.iter().map(WorldBus::has_unread).collect();
        let client = self.new_client();
        let mut stops = self.stop_at_once(client);
        let longest = (0..self.buses.len())
            .map(|bus| self.rounds(bus))
            .max()
            .unwrap_or_default();
        let end = self.now + longest;
        while self.now < end {
            self.step();
            self.check_stops(client, &mut stops);
        }
        self.check_back(&online, Some(&unread), "drives that answered go on");
        let slow = self
            .buses
            .iter()
            .map(|bus| 2 * bus.first_slow_round)
            .max()
            .unwrap_or_default();
        let away = PROBED + longest + COMMANDED.max(slow);
        self.look_until(self.now + away);
        self.look_until_whole(longest + slow);
        let all: Vec<_> = self.drives_that_answer().collect();
        self.check_back(&all, None, "every drive is back");
        self.check_remains();
        self.check_as_good_as_new();
    }

    /// Waits for reads in parts to be joined, and then as long as the line needs to be as before: an exception names no
    /// request, so the late exception to one request looks like the refusal of the next read.
    fn look_until_whole(&mut self, settles: Duration) {
        if !self.reads_in_parts() {
            return;
        }
        let since = self.healing.map_or(self.now, |healing| healing.since);
        let last = since + WHOLE_AGAIN + settles;
        while self.now < last && self.reads_in_parts() {
            self.look_until(last.min(self.now + Duration::from_secs(1)));
        }
        self.look_until(self.now + settles);
    }

    fn reads_in_parts(&self) -> bool {
        self.buses.iter().any(|bus| bus.core.remains(self.now).parts > 0)
    }

    /// Time after which a drive that answers is as before: late replies, repeated requests, three rounds.
    fn rounds(&self, bus: usize) -> Duration {
        let bus = &self.buses[bus];
        let round = bus.round.max(bus.line.cycle);
        self.late(bus) + MUTE + 3 * round + self.exchange(bus)
    }

    /// Time within which the replies to requests from before may arrive.
    fn late(&self, bus: &WorldBus) -> Duration {
        match bus.line.protocol {
            Protocol::N2 => 4 * bus.line.response_timeout,
            Protocol::ModbusRtu | Protocol::ModbusAscii => 2 * FORGOTTEN,
        }
    }

    /// Duration of the longest transaction on a line.
    pub(super) fn exchange(&self, bus: &WorldBus) -> Duration {
        let report = if bus.line.protocol == Protocol::N2 { 2 } else { 1 };
        report * bus.line.response_timeout + bus.handle.image.spec.format.chars(160)
    }

    /// From now on, drives, ports, lines, clients and brokers have no faults. Returns the drives that are online in
    /// the gateway.
    fn end_faults(&mut self) -> Vec<(usize, usize)> {
        let now = self.now;
        self.note(|| "every fault ends".to_string());
        (self.next_incident, self.next_reload) = (None, None);
        for until in &mut self.off {
            until.2 = now;
        }
        for until in self.away.iter_mut().flatten() {
            *until = now;
        }
        self.incidents();
        let sim = now - self.began;
        for bus in &mut self.buses {
            let parts = Parts::of(bus.index, &bus.line, 0);
            bus.wire.set_faults(parts.faults.without_faults());
            bus.flips = 0.0;
            for address in 1..=bus.line.drives {
                if let Some(drive) = bus.wire.slaves().drive(address) {
                    drive.advance(sim);
                    drive.set_alive(true);
                }
            }
        }
        for client in 0..self.clients.len() {
            if let Way::Mqtt(_, broker) = &mut self.clients[client].way
                && broker.away_until.is_some()
            {
                broker.away_until = Some(now);
                self.by_broker(client, 0, 0);
            }
        }
        // A slow read with a reply of another form settles whether answers belong to the previous request.
        let settled = (0..self.buses.len())
            .map(|bus| self.rounds(bus) + 2 * self.buses[bus].first_slow_round)
            .max();
        self.healing = Some(Healing {
            since: now,
            settled: now + settled.unwrap_or_default(),
        });
        let online = |(bus, drive): &(usize, usize)| {
            let image = &self.buses[*bus].handle.image.drives[*drive];
            image.snapshot().link.is_online()
        };
        self.drives_that_answer().filter(online).collect()
    }

    pub(super) fn drives_that_answer(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        let drives =
            |(bus, line): (usize, &WorldBus)| (0..usize::from(line.line.drives)).map(move |drive| (bus, drive));
        let all = self.buses.iter().enumerate().flat_map(drives);
        all.filter(|(bus, drive)| self.is_alive(*bus, *drive))
    }

    /// Stops one drive of each line: whatever happened before, the stop is on the wire soon.
    fn stop_at_once(&mut self, client: usize) -> Vec<StopAtOnce> {
        let mut stops = Vec::new();
        for bus in 0..self.buses.len() {
            let drive = self.dice.within(0..=u64::from(self.buses[bus].line.drives) - 1) as usize;
            if self.is_alive(bus, drive) {
                stops.push(self.order_stop(client, bus, drive));
            }
        }
        stops
    }

    fn order_stop(&mut self, client: usize, bus: usize, drive: usize) -> StopAtOnce {
        let order = self.records.len();
        self.plain(client, bus, drive, Wish::Stop, Duration::from_millis(400));
        // If a slow acknowledgement is being waited for, that wait is added for this stop.
        let waiting = self
            .open
            .values()
            .flatten()
            .filter(|id| self.records[**id].wish.is_stop());
        let others = waiting.count() as u32;
        let flooded = match self.buses[bus].core.remains(self.now).held_stops {
            0 => Duration::ZERO,
            _ => FLOODED,
        };
        // A restarted bus sends nothing until no late reply can arrive.
        let rests = if self.scenario.reloads {
            FORGOTTEN
        } else {
            Duration::ZERO
        };
        let within = self.exchange(&self.buses[bus]) * (3 + others) + flooded + rests;
        StopAtOnce {
            bus,
            drive,
            order,
            due: self.now + within,
            again: false,
        }
    }

    /// A client with plain orders of its own; its number.
    pub(super) fn new_client(&mut self) -> usize {
        self.clients.push(Client {
            habit: Habit::Plain,
            next: self.now,
            way: Way::Plain(Vec::new()),
            open: 0,
            silent_until: self.now,
            burst: (0, 0, 0),
        });
        self.clients.len() - 1
    }

    /// Checks that the stops are on the wire in time. One that failed because of a reply to a request from before the
    /// faults ended is reported to its client, which gives it again, once.
    fn check_stops(&mut self, client: usize, stops: &mut [StopAtOnce]) {
        let since = self.healing.map_or(self.now, |healing| healing.since);
        for stop in stops {
            let truth = &self.truths[stop.bus][stop.drive];
            let bus = &self.buses[stop.bus];
            let stops = |did: &RequestPdu, _: Option<&Vec<u16>>| run_command(&bus.profile, did) == Some(false);
            // On N2, an output is written only when it changes.
            let reached = truth.did(since, stops) || !truth.run;
            let disturbed = |(code, at): &(String, Instant)| {
                ["timeout", "garbled"].contains(&code.as_str()) && *at < since + self.late(bus)
            };
            let fails = self.records[stop.order].answer.as_ref().is_some_and(disturbed);
            if !reached && fails && !stop.again {
                *stop = StopAtOnce {
                    again: true,
                    ..self.order_stop(client, stop.bus, stop.drive)
                };
                continue;
            }
            assert!(
                reached || self.now < stop.due,
                "line{} drive {}: its stop is not on the wire {:?} after it listens again",
                stop.bus,
                stop.drive + 1,
                self.now - since
            );
        }
    }

    pub(super) fn look_until(&mut self, end: Instant) {
        while self.now < end {
            self.step();
        }
    }

    /// Checks that the drives answer, their process data is fresh, and their state is known once slow values are back
    /// too. Until then, `unread` names the lines on which values are read for the first time: their slow polls have half of the
    /// line, so that a round takes twice as long.
    fn check_back(&mut self, drives: &[(usize, usize)], unread: Option<&[bool]>, what: &str) {
        for (bus, drive) in drives {
            let rounds = if unread.is_some_and(|unread| unread[*bus]) {
                4
            } else {
                2
            };
            let bus = &self.buses[*bus];
            let image = &bus.handle.image.drives[*drive];
            let snapshot = image.snapshot();
            let name = &image.spec.name;
            assert!(snapshot.link.is_online(), "{what}: {name} is away");
            let age = snapshot.fast_at.map(|at| self.now - at);
            let most = rounds * bus.round.max(bus.line.cycle) + self.exchange(bus);
            assert!(
                age.is_some_and(|age| age <= most),
                "{what}: the process data of {name} is {age:?} old, {most:?} at most"
            );
            let refuses = unread.is_some() || (*drive == 0 && bus.line.refuses.is_some());
            let reading = image.reading(self.now, most.max(Duration::from_secs(1)));
            assert!(
                refuses || reading.state().is_some(),
                "{what}: the state of {name} is unknown"
            );
        }
    }

    /// Checks that nothing is left of faults and commands.
    fn check_remains(&mut self) {
        self.collect();
        let open: Vec<usize> = self.open.values().flatten().copied().collect();
        assert!(
            open.is_empty(),
            "orders without an answer long after the last fault: {open:?}"
        );
        for bus in &self.buses {
            let remains = bus.core.remains(self.now);
            let wanted = Remains {
                away: bus.line.dead.len(),
                // Probes of silent drives may leave late replies open.
                late_replies: if bus.line.dead.is_empty() {
                    0
                } else {
                    remains.late_replies
                },
                // On N2 the late reply to a probe could be mistaken for a state.
                held_reads: if bus.line.dead.is_empty() || bus.line.protocol != Protocol::N2 {
                    0
                } else {
                    remains.held_reads
                },
                ..Remains::default()
            };
            assert_eq!(remains, wanted, "line{}: left long after the last fault", bus.index);
        }
    }

    /// Checks that process data comes as often as on such a line without a past, and slow values as often as predicted.
    fn check_as_good_as_new(&mut self) {
        let window = self.buses.iter().map(|bus| 4 * bus.round.max(bus.line.cycle)).max();
        let window = window.unwrap_or_default();
        let began = self.now;
        let mut healed: Vec<Ages> = self.buses.iter().map(|bus| ages_of(&bus.handle)).collect();
        while self.now < began + window {
            let next = self.now + STEP;
            self.look_until(next);
            for (ages, bus) in healed.iter_mut().zip(&self.buses) {
                note_ages(ages, &bus.handle, self.now);
            }
        }
        for (bus, healed) in self.buses.iter().zip(&healed) {
            let (sound, probed) = sound_ages(bus, window);
            let (round, cycle) = (bus.round.max(bus.line.cycle), bus.line.slow_cycle);
            // The probe of a silent drive, and on N2 the requests that wait for its late reply, come at other moments than
            // in the world without faults, where the time of observation may have none.
            let probe = match bus.line.protocol {
                _ if bus.line.dead.is_empty() => Duration::ZERO,
                Protocol::N2 => bus.line.response_timeout + self.exchange(bus),
                Protocol::ModbusRtu | Protocol::ModbusAscii if probed => Duration::ZERO,
                Protocol::ModbusRtu | Protocol::ModbusAscii => self.exchange(bus),
            };
            for ((drive, healed), sound) in healed.iter().enumerate().zip(&sound) {
                if !self.is_alive(bus.index, drive) {
                    continue;
                }
                for ((read, age), (_, best)) in healed.iter().zip(sound) {
                    let Some(best) = best else { continue };
                    let most = match read.2 {
                        PollClass::Fast => *best + round + probe + self.exchange(bus) / 2 + STEP,
                        // Monitoring registers are read in between, once in a slow round.
                        _ => bus.slow_round.max(cycle) + bus.first_slow_round.max(cycle) + 2 * round,
                    };
                    // The world without faults has no orders and no refresh.
                    let most = if bus.line.refresh.is_some() { 3 * most / 2 } else { most };
                    assert!(
                        age.is_some_and(|age| age <= most),
                        "line{} drive {}: {read:?} is up to {age:?} old, {most:?} at most",
                        bus.index,
                        drive + 1
                    );
                }
            }
        }
    }
}

fn ages_of(handle: &drivegate_core::plant::BusHandle) -> Ages {
    let reads = |image: &Arc<drivegate_core::process_image::DriveImage>| {
        let reads = image.plan.reads.iter().map(|read| (read.table, read.start, read.class));
        let polled = reads.filter(|(.., class)| matches!(class, PollClass::Fast | PollClass::Slow));
        polled.map(|read| (read, Some(Duration::ZERO))).collect()
    };
    handle.image.drives.iter().map(reads).collect()
}

/// Records the age of each value; a value that was never read has no age.
fn note_ages(ages: &mut Ages, handle: &drivegate_core::plant::BusHandle, now: Instant) {
    for (ages, image) in ages.iter_mut().zip(&handle.image.drives) {
        let snapshot = image.snapshot();
        for ((table, start, _), oldest) in ages {
            let at = snapshot.read_at(*table, *start);
            *oldest = oldest.zip(at).map(|(oldest, at)| oldest.max(now - at));
        }
    }
}

/// Ages of the reads on a line of equal drives that never had a fault, and whether a silent drive was probed meanwhile.
fn sound_ages(bus: &WorldBus, window: Duration) -> (Ages, bool) {
    let line = crate::scenario::Line {
        faults: String::new(),
        flips: 0.0,
        ..bus.line.clone()
    };
    let (events, command_log, mut now) = (Events::default(), Arc::new(CommandLog::default()), Instant::now());
    let parts = Parts::of(bus.index, &line, 0);
    let mut twin = WorldBus::new(bus.index, &line, parts, &events, &command_log, now);
    let warm = now + PROBED;
    let (mut ages, mut probed) = (ages_of(&twin.handle), false);
    let is_dead = |drive: usize| line.dead.iter().any(|address| usize::from(*address) == drive + 1);
    while now < warm + window {
        let until = now + STEP;
        let mut seen = Vec::new();
        while twin.wake_at() <= until {
            now = twin.wake_at().max(now);
            twin.step(now, &mut seen);
        }
        now = until;
        if now >= warm {
            note_ages(&mut ages, &twin.handle, now);
            let is_probe = |seen: &Seen| matches!(seen, Seen::Sent(asked) if is_dead(asked.drive));
            probed |= seen.iter().any(is_probe);
        }
    }
    (ages, probed)
}
