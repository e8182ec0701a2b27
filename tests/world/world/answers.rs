//! The answers that clients get: each client gets exactly one, and each answer is true.

use super::*;

/// Results of orders that the drive took.
const DONE: [&str; 2] = ["acknowledged", "confirmed"];
/// Results of orders that never reached the wire.
const UNSENT: [&str; 8] = [
    "expired",
    "replaced",
    "purged",
    "queue_full",
    "offline",
    "bus_down",
    "shutting_down",
    "withdrawn",
];

impl World {
    pub(super) fn collect(&mut self) {
        for client in 0..self.clients.len() {
            self.collect_client(client, true);
        }
    }

    /// Collects answers after a step: clients that wait for a write are checked only when one was answered.
    pub(super) fn collect_news(&mut self) {
        let before = std::mem::replace(&mut self.answered, self.command_log.seconds().count);
        for client in 0..self.clients.len() {
            self.collect_client(client, self.answered != before);
        }
    }

    /// Processes the answers to orders that a newer order replaced. This happens before the newer order is recorded,
    /// because its record replaces theirs.
    pub(super) fn replaced(&mut self) {
        self.collect();
        let Some((newest, before)) = self.records.split_last_mut() else {
            return;
        };
        let now = self.now;
        let of_drive = |record: &&mut Record| (record.bus, record.drive) == (newest.bus, newest.drive);
        let just_replaced = |record: &&mut Record| {
            let answer = record.answer.as_ref();
            !record.succeeded
                && newest.wish.replaces(record.wish)
                // The rest of an order with a stop waits as a separate reference.
                && answer.is_some_and(|(code, at)| (code == "replaced" || code == "stop_only") && *at == now)
        };
        let recent = before.iter_mut().rev().take(1_000);
        let mut replaced = recent.filter(of_drive).filter(just_replaced);
        if newest.wish.replaces(newest.wish)
            && let Some(older) = replaced.next()
        {
            older.succeeded = true;
            newest.earliest = older.earliest;
            // The rest of a stop may have been removed by another stop instead.
            if older.answer.as_ref().is_some_and(|(code, _)| code == "replaced") {
                newest.place = older.place;
            }
        }
        let stops = |record: &&Record| record.wish == Wish::StopAtReference && record.answer.is_none();
        let of_drive = |record: &&Record| (record.bus, record.drive) == (newest.bus, newest.drive);
        let recent = before.iter().rev().take(1_000).filter(of_drive);
        if newest.wish.replaces(Wish::StopAtReference)
            && let Some(stop) = recent.into_iter().find(stops)
        {
            newest.earliest = newest.earliest.min(stop.place);
        }
    }

    pub(super) fn collect_client(&mut self, client: usize, writes: bool) {
        let now = self.now;
        match &mut self.clients[client].way {
            Way::Plain(waiting) => {
                let mut answered = Vec::new();
                waiting.retain_mut(|Waiting { id, placed, is_read }| {
                    let asked = writes || *is_read;
                    let answer = asked.then(|| placed.answer()).flatten();
                    let waits = answer.is_none();
                    answered.extend(answer.map(|answer| (*id, answer)));
                    waits
                });
                for (id, answer) in answered {
                    if self.records[id].answer.is_none() {
                        self.answered(id, answer.outcome.code(), Some(&answer.outcome));
                        self.clients[client].open = self.clients[client].open.saturating_sub(1);
                    }
                }
            }
            Way::Mqtt(offline, _) => {
                for message in offline.poll(now) {
                    let json: serde_json::Value = serde_json::from_slice(&message.payload).unwrap();
                    let id = json["id"].as_u64().expect("the id of an order") as usize;
                    let code = json["result"].as_str().unwrap().to_string();
                    if self.is_of_repetition(id, &code) {
                        continue;
                    }
                    self.answered(id, &code, None);
                    self.clients[client].open = self.clients[client].open.saturating_sub(1);
                }
            }
            Way::ModbusTcp(_, open, _) if open.is_empty() || !writes => {}
            Way::ModbusTcp(offline, ..) => {
                let bytes = offline.receive(&[], now);
                self.take_answers(client, &bytes);
            }
        }
    }

    /// Whether a result belongs to a message that the broker delivered again: the first result, or a refusal, which
    /// is required after a stop.
    fn is_of_repetition(&mut self, id: usize, code: &str) -> bool {
        let record = &self.records[id];
        let Some(left) = self.repeats.get_mut(&id).filter(|left| **left > 0) else {
            return false;
        };
        let Some((first, _)) = &record.answer else {
            // A repeated stop is a separate command, which may end before the first one is confirmed.
            let without_rest = UNSENT.contains(&code) || code == "stop_only";
            let is_second = record.wish.is_stop() && record.sent.is_some() && without_rest;
            *left -= u32::from(is_second);
            return is_second;
        };
        *left -= 1;
        let done = |later: &Record| matches!(&later.answer, Some((code, _)) if DONE.contains(&code.as_str()));
        let same = |later: &Record| (later.bus, later.drive) == (record.bus, record.drive);
        let stopped = self.records[id..]
            .iter()
            .any(|later| same(later) && later.wish.is_stop() && done(later));
        assert!(
            record.wish.is_stop() || code == "not_allowed" || (first == code && !stopped),
            "order {id} was answered {first}, and its repetition {code}, stopped since: {stopped}"
        );
        true
    }

    pub(super) fn take_answers(&mut self, client: usize, bytes: &[u8]) {
        for (transaction, exception) in answers(bytes) {
            let Way::ModbusTcp(_, open, _) = &mut self.clients[client].way else {
                return;
            };
            let id = open.remove(&transaction).expect("an answer to a request");
            let code = match exception {
                None => "acknowledged".to_string(),
                Some(code) => format!("exception {code:02X}"),
            };
            self.answered(id, &code, None);
            self.clients[client].open = self.clients[client].open.saturating_sub(1);
        }
    }

    /// Checks that the answer to an order is true.
    pub(super) fn answered(&mut self, id: usize, code: &str, outcome: Option<&Outcome>) {
        let now = self.now;
        let text = code.to_string();
        self.note(move || format!("order {id} is answered {text}"));
        assert!(self.records[id].answer.is_none(), "order {id} was answered twice");
        self.records[id].answer = Some((code.to_string(), now));
        let record = &self.records[id];
        assert!(
            self.stopping || !record.wish.is_stop() || code != "shutting_down",
            "a reload dropped stop {id}"
        );
        if let Some(open) = self.open.get_mut(&(record.bus, record.drive)) {
            open.retain(|open| *open != id);
            if open.is_empty() {
                self.open.remove(&(record.bus, record.drive));
            }
        }
        let truth = &mut self.truths[record.bus][record.drive];
        let begun = [
            "acknowledged",
            "confirmed",
            "timeout",
            "garbled",
            "unknown",
            "refused_by_drive",
            "interrupted",
            "stop_only",
        ];
        // Over MQTT the answer comes with the confirmation, long after the order ended.
        let writes = record.wish != Wish::RawRead && self.clients[record.client].habit != Habit::Mqtt;
        if writes && (begun.contains(&code) || code.starts_with("exception")) {
            truth.maybe_heard(now);
        }
        if record.wish.is_stop() || record.wish == Wish::Reset {
            truth.last_stop_over = Some(now);
        }
        if UNSENT.contains(&code) {
            assert!(record.sent.is_none(), "order {id} was sent, and its answer is {code}");
        }
        let truth = &self.truths[record.bus][record.drive];
        assert!(
            code != "purged" || self.stopping || now >= record.expires || truth.last_stop.is_some_and(|stop| stop > id),
            "order {id} was removed for a stop, and no client gave one"
        );
        assert!(
            !(code == "queue_full" && record.wish.is_stop()),
            "a stop was refused for want of room"
        );
        assert!(
            !(code == "not_writable" && record.wish.is_stop()),
            "a stop was refused for the registers that it sets"
        );
        assert!(
            !(code == "offline" && record.wish.is_stop()),
            "a stop was refused because the drive was away: it is the probe"
        );
        match code {
            "acknowledged" | "confirmed" => self.check_done(id, record, code, outcome),
            "expired" => self.check_expired(id, record),
            "refused_by_drive" => self.check_refused(id, record, outcome),
            "stop_only" => self.check_stop_only(id, record, outcome),
            _ => {}
        }
        if code == "confirmed" && self.records[id].wish == Wish::Stop {
            self.check_stands(id);
        }
        self.figures.confirmed += u64::from(code == "confirmed");
    }

    /// Checks an order of which only the stop was carried out: that the stop happened, and that the answer reports
    /// the rest.
    fn check_stop_only(&self, id: usize, record: &Record, outcome: Option<&Outcome>) {
        let (profile, truth) = (&self.buses[record.bus].profile, &self.truths[record.bus][record.drive]);
        let stops = |did: &RequestPdu, _: Option<&Vec<u16>>| run_command(profile, did) == Some(false);
        assert!(
            truth.did(record.accepted, stops) || !truth.run,
            "order {id}: its stop is acknowledged, and none reached the drive"
        );
        let rest = match outcome {
            Some(Outcome::StopOnly(rest)) => rest.code(),
            _ => return,
        };
        assert!(
            !DONE.contains(&rest),
            "order {id}: only the stop was done, and the rest too"
        );
        assert!(
            !UNSENT.contains(&rest) || record.sent.is_none(),
            "order {id}: its rest was sent, and is answered {rest}"
        );
    }

    /// Checks a confirmed stop: the motor does not run, or is at standstill.
    pub(super) fn check_stands(&mut self, id: usize) {
        let record = &self.records[id];
        let (sim, troubled) = (
            self.now - self.began,
            self.truths[record.bus][record.drive].is_troubled(record.accepted),
        );
        let bus = &mut self.buses[record.bus];
        let late = bus.late;
        let Some(drive) = bus.wire.slaves().drive(record.drive as u8 + 1) else {
            return;
        };
        drive.advance(sim);
        let state = drive.state();
        assert!(
            troubled || late || !state.running || state.output.abs() < 2.0,
            "order {id}: the stop is confirmed, and the motor turns with {:.1} Hz",
            state.output
        );
    }

    /// Checks a refusal: a busy drive was tried until the time expired, and an exception that leaves the result of a write
    /// open is not a refusal.
    fn check_refused(&self, id: usize, record: &Record, outcome: Option<&Outcome>) {
        let Some(Outcome::Exception(code)) = outcome.filter(|_| record.wish != Wish::RawRead) else {
            return;
        };
        // An order that was not sent because the state of the drive was unknown counts as refused.
        assert!(
            record.sent.is_none() || !matches!(code.code(), 0x05 | 0x0A | 0x0B),
            "order {id} is told to be refused, and the answer was {code}"
        );
        assert!(
            code.code() != 0x06 || self.now >= record.expires,
            "order {id} was given up {:?} before its time, because the drive was busy",
            record.expires - self.now
        );
    }

    /// Checks that an acknowledged order was carried out.
    pub(super) fn check_done(&self, id: usize, record: &Record, code: &str, outcome: Option<&Outcome>) {
        let bus = &self.buses[record.bus];
        let (profile, truth) = (&bus.profile, &self.truths[record.bus][record.drive]);
        let since = record.accepted;
        if let Some((pdu, _)) = &record.read {
            let Some(Outcome::Acknowledged(reply)) = outcome else {
                return;
            };
            let words = reply.words();
            let read = |did: &RequestPdu, answered: Option<&Vec<u16>>| did == pdu && answered == words.as_ref();
            assert!(
                truth.did(since, read),
                "order {id} read what the drive did not say: {reply:?}"
            );
            return;
        }
        let run = |on: bool| move |did: &RequestPdu, _: Option<&Vec<u16>>| run_command(profile, did) == Some(on);
        let n2 = profile.name.ends_with("n2");
        if record.wish.is_stop() {
            assert!(
                truth.did(since, run(false)) || !truth.run,
                "order {id}: {code}, but no stop reached the drive"
            );
        } else if record.wish.is_run() && !n2 {
            assert!(
                truth.did(since, run(true)),
                "order {id}: {code}, but no run reached the drive"
            );
        }
        if record.wish == Wish::Converted && profile.name != "vacon-cx" {
            self.check_converted(id, record);
        }
        let shows = record.wish == Wish::Parameter || (!n2 && profile.name != "vacon-cx");
        if let Some(unique) = record.unique.as_ref().filter(|_| shows) {
            let wrote = |did: &RequestPdu, _: Option<&Vec<u16>>| sets(did, unique);
            let has = |did: &RequestPdu, words: Option<&Vec<u16>>| has_already(did, words, unique);
            let done = truth.did(since, wrote) || truth.did(since, has) || truth.was_set_last(unique);
            assert!(done, "order {id}: {code}, but the drive did not take it");
        }
    }

    /// Checks that a converted order used a maximum frequency that the drive had recently.
    fn check_converted(&self, id: usize, record: &Record) {
        let (bus, truth) = (&self.buses[record.bus], &self.truths[record.bus][record.drive]);
        let image = &bus.handle.image.drives[record.drive];
        let age = image.reading(self.now, Duration::ZERO).parameter_age() + Duration::from_millis(500);
        let until = truth.maxima.iter().skip(1).map(|(since, _)| Some(*since)).chain([None]);
        let recent = truth.maxima.iter().zip(until).filter(|((since, _), until)| {
            *since <= record.accepted && until.is_none_or(|until| until + age >= record.accepted)
        });
        let mut words = recent.flat_map(|((_, maximum), _)| converted(&bus.profile, id, *maximum));
        let done = words.any(|words| {
            let wrote =
                |did: &RequestPdu, answered: Option<&Vec<u16>>| sets(did, &words) || has_already(did, answered, &words);
            truth.did(record.accepted, wrote)
        });
        assert!(
            done || truth.maxima.is_empty(),
            "order {id} rests on an old frequency range; the drive had {:?}",
            truth
                .maxima
                .iter()
                .map(|(since, hz)| (*since - self.began, *hz))
                .collect::<Vec<_>>()
        );
    }

    /// A steady client on a calm line is always served.
    pub(super) fn check_expired(&self, id: usize, record: &Record) {
        let truth = &self.truths[record.bus][record.drive];
        let calm = self.scenario.incidents.is_none() && !self.buses[record.bus].line.is_noisy();
        if self.clients[record.client].habit == Habit::Steady && calm && !self.stopping {
            // The older orders to its drive go first, each after all drives of the crowd were served once; polls have half of
            // the line, and a reset has two writes.
            let bus = &self.buses[record.bus];
            let turn = 2 * bus.line.turnaround + bus.handle.image.spec.format.chars(100);
            let turns = u32::from(bus.line.drives) * u32::try_from(record.before + 1).unwrap_or(u32::MAX);
            let is_slow = 3 * turn * turns > record.expires - record.accepted;
            assert!(
                record.before > 4
                    || is_slow
                    || truth.is_troubled(record.accepted)
                    || !self.is_alive(record.bus, record.drive),
                "order {id} of a steady client expired behind {} others",
                record.before
            );
        }
    }

    pub(super) fn is_alive(&self, bus: usize, drive: usize) -> bool {
        !self.buses[bus].line.dead.contains(&(drive as u8 + 1))
    }
}

fn has_already(did: &RequestPdu, words: Option<&Vec<u16>>, (table, address, wanted): &Unique) -> bool {
    let (RequestPdu::Read { table: of, start, .. }, Some(words)) = (did, words) else {
        return false;
    };
    let Some(offset) = address.checked_sub(*start).filter(|_| of == table) else {
        return false;
    };
    words.get(usize::from(offset)..usize::from(offset) + wanted.len()) == Some(wanted.as_slice())
}
