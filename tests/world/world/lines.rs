//! Traffic on the lines: each request and each reply is checked.

use super::*;

impl World {
    pub(super) fn step_bus(&mut self, index: usize) {
        let mut seen = Vec::new();
        self.buses[index].step(self.now, &mut seen);
        for one in seen {
            match one {
                Seen::Sent(asked) => self.sent(index, &asked),
                Seen::Acted(asked) => self.acted(index, &asked),
                Seen::Over(asked) => self.over(index, &asked),
                Seen::Heard(bytes) if self.history.is_long() => {
                    self.note(move || format!("line{index} -> {bytes:02X?}"))
                }
                Seen::Heard(_) => {}
            }
        }
        let line = &self.buses[index].wire;
        let statistics = line.statistics();
        assert_eq!(
            statistics.silence_violations, 0,
            "a request came before the line was silent"
        );
        // After a late reply was accepted in place of the present one, the present one is still to come: that
        // cannot be known.
        if !self.buses[index].late {
            assert_eq!(statistics.collisions, 0, "a request met a reply");
            assert_eq!(statistics.provoked_overlaps, 0, "a request met noise");
        }
    }

    /// Checks a request that is on the wire.
    pub(super) fn sent(&mut self, bus: usize, asked: &Asked) {
        let (drive, pdu, now) = (asked.drive, &asked.pdu, self.now);
        assert!(
            !asked.is_poll || !self.buses[bus].ending,
            "a poll goes out while the gateway stops"
        );
        if !(asked.is_poll || (asked.is_refresh && !pdu.is_write())) || self.history.is_long() {
            let text = pdu.clone();
            self.note(move || format!("line{bus} drive {} <- {text:?}", drive.wrapping_add(1)));
        }
        if drive == NO_DRIVE {
            return self.line_stopped(bus, pdu);
        }
        self.truths[bus][drive].asked = Some(now);
        if !pdu.is_write() {
            // A lease begins with any frame of an order, also of one that only reads and writes nothing. A raw read is none.
            let open = self.open.get(&(bus, drive)).into_iter().flatten();
            let mut of_order = open.clone().map(|id| &self.records[*id]);
            let reads = of_order.any(|record| matches!(record.wish, Wish::Reverse | Wish::Reset));
            let mut raw_reads = open.filter_map(|id| self.records[*id].read.as_ref());
            let is_raw = raw_reads.any(|(raw, _)| raw == pdu);
            if reads && !is_raw && !asked.is_poll && !asked.is_refresh && matches!(pdu, RequestPdu::Read { .. }) {
                self.truths[bus][drive].maybe_heard(now);
            }
            return;
        }
        self.check_raw_rule(bus, drive, pdu);
        if asked.is_refresh {
            return self.check_refresh(bus, drive, pdu);
        }
        let profile = self.buses[bus].profile.clone();
        let open = self.open.get(&(bus, drive)).cloned().unwrap_or_default();
        let client_waits = !open.is_empty();
        let truth = &mut self.truths[bus][drive];
        truth.action.take_if(|action| action.pdu != *pdu);
        if let Some(run) = run_command(&profile, pdu) {
            // The run command was lost with the supply: a value read just before still shows it.
            let lost = truth.lost_word.is_some_and(|at| now - at < Duration::from_secs(1));
            if run && !truth.run && !lost {
                let until = truth
                    .may_run
                    .unwrap_or_else(|| panic!("a run went out behind a stop, drive {}", drive + 1));
                assert!(now < until, "an expired run went out");
            }
            if !run {
                truth.stop_sent = Some(now);
            }
            if run {
                self.no_stop_is_overtaken(bus, drive);
            }
            let truth = &self.truths[bus][drive];
            if !run && truth.run {
                let ours = |id: &usize| {
                    let wish = self.records[*id].wish;
                    // If the word cannot be read, a motor that was last seen standing is left standing.
                    wish.is_stop() || matches!(wish, Wish::Reset | Wish::Reverse)
                };
                let repeated = truth.repeated_until.is_some_and(|until| now < until);
                let recently = repeated || truth.last_stop_over.is_some_and(|at| now - at < LAST_STEPS);
                if !open.iter().any(ours) && !recently && !self.stopping {
                    self.supervision_acts(bus, drive, pdu);
                }
            }
        }
        // No order has this reference, so the write shows no client, not even one whose answer over MQTT still waits for the
        // confirmation.
        if self.is_reference_of_supervision(bus, drive, pdu) {
            self.supervision_acts(bus, drive, pdu);
            return self.check_unique(bus, drive, pdu);
        }
        let truth = &mut self.truths[bus][drive];
        let repeated = truth.repeated_until.is_some_and(|until| now < until);
        if client_waits || repeated {
            truth.maybe_heard(now);
            let certain = open.iter().any(|id| {
                let unique = self.records[*id].unique.as_ref();
                unique.is_some_and(|unique| sets(pdu, unique))
            });
            if certain {
                truth.heard_for_certain(now);
            }
        }
        self.check_unique(bus, drive, pdu);
    }

    /// The only broadcast that the gateway sends of its own accord: the stop of a line on which all drives must be stopped.
    fn line_stopped(&mut self, bus: usize, pdu: &RequestPdu) {
        let stops = run_command(&self.buses[bus].profile, pdu) == Some(false);
        assert!(self.buses[bus].ending && stops, "a broadcast {pdu:?}");
        let drives = &self.buses[bus].handle.image.drives;
        let all = drives.iter().all(|drive| drive.spec.on_shutdown == OnShutdown::Stop);
        assert!(all, "a drive that is to go on is stopped with the others");
        for truth in &mut self.truths[bus] {
            truth.stop_sent = Some(self.now);
        }
    }

    /// A write contains the control word, or sets only what writable points and the configuration name.
    fn check_raw_rule(&self, bus: usize, drive: usize, pdu: &RequestPdu) {
        let spec = &self.buses[bus].handle.image.drives[drive].spec;
        let profile = &spec.profile;
        let (table, items) = written(pdu).expect("a write that the drives have");
        if run_command(profile, pdu).is_some() {
            return;
        }
        for (address, _) in items {
            let is_admitted = match &spec.raw_writes {
                RawWrites::All => true,
                RawWrites::Ranges(ranges) => ranges.iter().any(|range| range.contains(&address)),
                RawWrites::Points => false,
            };
            assert!(
                is_admitted || is_of_writable_point(profile, table, address),
                "{table} {address} of a {} goes out, which raw_writes does not admit: {pdu:?}",
                profile.name
            );
        }
    }

    /// Checks, when a run command is sent, that no stop accepted before it is still unanswered.
    pub(super) fn no_stop_is_overtaken(&mut self, bus: usize, drive: usize) {
        self.collect();
        let now = self.now;
        let open: Vec<&Record> = self
            .open
            .get(&(bus, drive))
            .into_iter()
            .flatten()
            .map(|id| &self.records[*id])
            .collect();
        let Some(run) = open
            .iter()
            .filter(|record| record.wish.is_run())
            .map(|record| record.place)
            .max()
        else {
            return;
        };
        for stop in open.iter().filter(|record| record.wish.is_stop() && record.place < run) {
            // Over MQTT the answer of a completed order waits for its confirmation.
            let by_mqtt = self.clients[stop.client].habit == Habit::Mqtt;
            assert!(
                by_mqtt || stop.accepted == now,
                "a run goes out before an older stop: {stop:?}"
            );
        }
    }

    /// Whether a write sets the reference that supervision sets when a lease runs out.
    pub(super) fn is_reference_of_supervision(&self, bus: usize, drive: usize, pdu: &RequestPdu) -> bool {
        let bus = &self.buses[bus];
        let Some(LeaseAction::SpeedReference(percent)) = bus.line.supervision.as_ref().map(|s| &s.action) else {
            return false;
        };
        let maxima = self.truths[bus.index][drive].maxima.iter().map(|(_, maximum)| *maximum);
        let mut words = maxima.filter_map(|maximum| percent_reference(&bus.profile, *percent, maximum));
        words.any(|words| sets(pdu, &words))
    }

    /// Checks a write that no client ordered: the lease must have expired, and no client be back.
    pub(super) fn supervision_acts(&mut self, bus: usize, drive: usize, pdu: &RequestPdu) {
        let now = self.now;
        // An order that ended in this step no longer waits.
        self.collect();
        let supervision = self.buses[bus].line.supervision.clone();
        let supervision = supervision.unwrap_or_else(|| panic!("a stop that nobody ordered, drive {}", drive + 1));
        assert!(
            supervision.action == LeaseAction::Stop || run_command(&self.buses[bus].profile, pdu).is_none(),
            "a stop went out where the action is {:?}",
            supervision.action
        );
        // On N2 an attempt whose reply may be a late one to an earlier request is not counted, nor is one that a busy drive
        // did not take.
        let line = &self.buses[bus].line;
        let retries = if line.protocol == Protocol::N2 || line.faults.contains("busy") {
            u32::MAX
        } else {
            line.retries
        };
        let truth = &mut self.truths[bus][drive];
        // An action that is on the wire when a client returns is not withdrawn, lost or not: its attempts continue.
        let began = truth.action_began(pdu, retries, now);
        if let Some(heard) = truth.heard.0 {
            assert!(
                now - heard >= supervision.timeout || heard > began,
                "the action came {:?} after the client",
                now - heard
            );
        } else {
            assert!(
                supervision.adopt || truth.heard.1.is_some(),
                "the action came though nobody was ever heard of"
            );
        }
        for id in self.open.get(&(bus, drive)).into_iter().flatten() {
            let record = &self.records[*id];
            // Over MQTT the answer of a completed order waits for its confirmation.
            let by_mqtt = self.clients[record.client].habit == Habit::Mqtt;
            let before = record.accepted <= began;
            let waits = record.wish != Wish::RawRead && record.expires > now && !by_mqtt && before;
            assert!(
                !waits || now - record.accepted < Duration::from_millis(2),
                "the action overrides a client that is back: {record:?}"
            );
        }
    }

    /// Checks words that only one order writes: which of them may be sent, and in which order.
    pub(super) fn check_unique(&mut self, bus: usize, drive: usize, pdu: &RequestPdu) {
        let now = self.now;
        let waiting = self.open.get(&(bus, drive)).into_iter().flatten();
        let profile = &self.buses[bus].profile;
        let is_converted = |id: &usize| {
            let maxima = self.truths[bus][drive].maxima.iter();
            let mut words = maxima.flat_map(|(_, maximum)| converted(profile, *id, *maximum));
            self.records[*id].wish == Wish::Converted && words.any(|words| sets(pdu, &words))
        };
        if waiting.into_iter().any(is_converted) {
            return;
        }
        let Some(id) = self.truths[bus][drive].order_of(pdu) else {
            return;
        };
        let record = &mut self.records[id];
        if let Some((code, at)) = &record.answer {
            panic!(
                "order {id} was answered {code} {:?} ago, and goes out: {record:?}",
                now - *at
            );
        }
        assert!(
            now < record.expires || record.wish.is_stop(),
            "an expired order goes out: {record:?}"
        );
        let first = record.sent.is_none();
        record.sent.get_or_insert(now);
        // The words of an order that stops and does more are its rest, which overtakes nothing.
        if first {
            let (place, earliest) = (record.place, record.earliest);
            let truth = &mut self.truths[bus][drive];
            assert!(
                place > truth.last_place,
                "order {id} of place {place} goes out behind place {}",
                truth.last_place
            );
            truth.last_place = truth.last_place.max(earliest);
        }
    }

    /// Notes a request that a drive carried out.
    pub(super) fn acted(&mut self, bus: usize, asked: &Asked) {
        let profile = self.buses[bus].profile.clone();
        let refused = matches!(asked.reply, Some(Reply::Exception(_)));
        let words = asked.reply.as_ref().and_then(Reply::words);
        let drive = match asked.drive {
            NO_DRIVE => usize::from(asked.acted) - 1,
            drive => drive,
        };
        let truth = &mut self.truths[bus][drive];
        if refused {
            return;
        }
        if let Some(run) = run_command(&profile, &asked.pdu) {
            truth.run = run;
        }
        truth.act(self.now, asked.pdu.clone(), words);
        self.note_counted(bus, drive, &asked.pdu);
        self.note_ordered(bus, drive, asked);
    }

    /// Checks, after an exchange, that the process image contains the values that the drive answered.
    pub(super) fn over(&mut self, bus: usize, asked: &Asked) {
        let (Some(RequestPdu::Read { table, start, count }), true) = (Some(asked.pdu.clone()), asked.is_poll) else {
            return;
        };
        let image = &self.buses[bus].handle.image.drives[asked.drive];
        let snapshot = image.snapshot();
        let Some(at) = snapshot.read_at(table, start) else {
            return;
        };
        let untouched = asked.last_read == Some(at);
        if untouched {
            return;
        }
        let stored: Vec<u16> = (0..count)
            .map(|i| snapshot.word(table, start + i).unwrap_or(0))
            .collect();
        // Simulated late replies may overtake each other; those of a real drive do not.
        let slack = if self.buses[bus].late {
            Duration::from_secs(1)
        } else {
            Duration::ZERO
        };
        let from = at.min(asked.at).checked_sub(slack).unwrap_or(at);
        let settled = self.healing.is_some_and(|healing| asked.at > healing.settled);
        assert!(
            !settled || at >= asked.at,
            "drive {} at {table} {start}: the answer to a request of {:?} ago is dated {:?} back",
            asked.drive + 1,
            self.now - asked.at,
            self.now - at
        );
        let truth = &self.truths[bus][asked.drive];
        // The drive may have sent this answer to an earlier attempt; the image then has that time. The checksums of N2 and
        // Modbus ASCII do not detect two flipped bits that compensate each other.
        let in_digits = self.buses[bus].line.protocol != Protocol::ModbusRtu;
        let flipped = in_digits && self.buses[bus].line.flips_bits();
        let alike = |words: &Vec<u16>| *words == stored || (flipped && bits_in_digits(words, &stored) <= 2);
        let said = |did: &RequestPdu, words: Option<&Vec<u16>>| *did == asked.pdu && words.is_some_and(alike);
        assert!(
            truth.did(from, said),
            "drive {} at {table} {start}: it did not say {stored:?} in the last {:?}",
            asked.drive + 1,
            self.now - at
        );
    }
}

/// Bits in which the values differ on a wire on which each digit is a character: one of its bits may change several of the
/// digit.
fn bits_in_digits(said: &[u16], stored: &[u16]) -> u32 {
    let digits = |words: &[u16]| -> String { words.iter().map(|word| format!("{word:04X}")).collect() };
    let (said, stored) = (digits(said), digits(stored));
    if said.len() == stored.len() {
        said.bytes()
            .zip(stored.bytes())
            .map(|(a, b)| (a ^ b).count_ones())
            .sum()
    } else {
        u32::MAX
    }
}
