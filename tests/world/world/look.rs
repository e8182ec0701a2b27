//! Conditions that must hold at any time.

use super::*;

impl World {
    pub(super) fn look(&mut self) {
        let now = self.now;
        loop {
            match self.heard_events.try_recv() {
                Ok(event) => self.on_event(&event),
                Err(broadcast::error::TryRecvError::Lagged(_)) => {}
                Err(_) => break,
            }
        }
        for (bus, truths) in self.buses.iter_mut().zip(&mut self.truths) {
            let waiting = bus.handle.queue.lock();
            assert!(
                waiting.len() <= CAPACITY + 2 * bus.handle.image.drives.len(),
                "{} commands wait",
                waiting.len()
            );
            drop(waiting);
            for (index, truth) in truths.iter_mut().enumerate() {
                let sim = now - self.began;
                let Some(drive) = bus.wire.slaves().drive(index as u8 + 1) else {
                    continue;
                };
                drive.advance(sim);
                let image = &bus.handle.image.drives[index];
                let seen = image.reading(now, Duration::from_secs(5)).is_set(ModelPoint::Running);
                // If the drive refuses to report whether it runs, its run command counts instead.
                let blind = index == 0 && bus.line.refuses.is_some() && truth.run && image.snapshot().link.is_online();
                if drive.state().remote {
                    truth.remote_at = Some(now);
                }
                let running = drive.state().running && drive.answers() && (seen || blind);
                if drive.state().running {
                    truth.turned_at = Some(now);
                }
                truth.running_since = running.then(|| truth.running_since.unwrap_or(now));
                if running {
                    truth.ran_at = Some(now);
                }
                let online = bus.handle.image.drives[index].snapshot().link.is_online();
                truth.online_since = online.then(|| truth.online_since.unwrap_or(now));
                let offline = bus.open && image.snapshot().link.is_tried() && !online;
                truth.offline_since = offline.then(|| truth.offline_since.unwrap_or(now));
            }
        }
        for key in self.open.keys() {
            self.truths[key.0][key.1].waited_until = Some(self.now);
        }
        self.own_timeouts();
        self.check_answered_in_time();
        if !self.stopping {
            self.check_leases();
            self.check_feeding();
            self.check_polls();
            self.check_probes();
        }
        self.check_states();
        self.read_by_http();
    }

    pub(super) fn on_event(&mut self, event: &drivegate_core::event::Event) {
        let text = format!("event {}: {}", event.kind.name(), event.text);
        self.note(move || text);
        let Some(name) = &event.drive else { return };
        for bus in 0..self.buses.len() {
            let drives = &self.buses[bus].handle.image.drives;
            if let Some(drive) = drives.iter().position(|drive| drive.spec.name == *name)
                && event.kind == EventKind::Supervision
            {
                self.truths[bus][drive].supervised = Some(self.now);
                self.figures.supervised += 1;
            }
        }
    }

    /// Checks that no order waits longer than its time and its last steps.
    pub(super) fn check_answered_in_time(&self) {
        for id in self.open.values().flatten() {
            let record = &self.records[*id];
            // Over MQTT the answer waits for the confirmation, 5 s at most.
            let by_mqtt = self.clients[record.client].habit == Habit::Mqtt;
            let most = if by_mqtt { 2 * LAST_STEPS } else { LAST_STEPS };
            // The end of a reset pulse is repeated until the drive accepts it.
            let noisy = self.buses[record.bus].line.is_noisy();
            let most = if noisy { 3 * most } else { most };
            // A stop does not expire: its time limit begins at its turn.
            let expires = if record.wish.is_stop() {
                record.expires.max(record.accepted + 2 * STOP_TIME)
            } else {
                record.expires
            };
            assert!(
                self.now < expires + most,
                "order {id} has no answer {:?} after its time: {record:?}",
                self.now - expires
            );
        }
    }

    /// Checks that supervision acts on a running drive whose client went silent.
    pub(super) fn check_leases(&self) {
        for (index, bus) in self.buses.iter().enumerate() {
            let Some(supervision) = &bus.line.supervision else {
                continue;
            };
            for (drive, truth) in self.truths[index].iter().enumerate() {
                let (Some(heard), Some(running), Some(online)) =
                    (truth.heard.0, truth.running_since, truth.online_since)
                else {
                    continue;
                };
                let last = truth.heard.1.unwrap_or(heard);
                // A new bus halves a read with a refused register four times before it has read the state of the drive.
                let rounds = if bus.line.refuses.is_some() { 3 + 4 } else { 3 };
                let round = rounds * bus.handle.image.health().fast.last.unwrap_or(bus.round);
                let due = last.max(running).max(online) + supervision.timeout + ACTION + round;
                let repeated = truth.repeated_until.is_some_and(|until| self.now < until);
                let waits = repeated || self.open.contains_key(&(index, drive));
                // Until the motor was seen to run, the lease of a motor that was standing has ended.
                let armed = running <= last + supervision.timeout || truth.carried.is_some_and(|at| at >= last);
                let noisy = bus.line.is_noisy();
                let late = if noisy { due + Duration::from_secs(2) } else { due };
                if waits || !bus.open || !armed || self.now <= late || truth.befell_since(last) {
                    continue;
                }
                assert!(
                    truth.supervised.is_some_and(|at| at + ACTION >= last),
                    "line{index} drive {} runs {:?} after its client fell silent",
                    drive + 1,
                    self.now - last
                );
                let tried = truth.stop_sent.map_or(late, |at| at.max(late));
                assert!(
                    supervision.action != LeaseAction::Stop || !truth.run || self.now - tried < REPEATED + round,
                    "line{index} drive {} has its run command {:?} after its client fell silent, and no stop goes out",
                    drive + 1,
                    self.now - last
                );
            }
        }
    }

    /// Checks that on a healthy line the process data of a drive that answers stays fresh, whichever client commands.
    pub(super) fn check_polls(&self) {
        let sound = |bus: &&WorldBus| bus.open && !bus.line.is_noisy() && self.scenario.incidents.is_none();
        for bus in self.buses.iter().filter(sound) {
            // Until two rounds have begun, the predicted cycle counts.
            let round = bus.handle.image.health().fast.last.unwrap_or(bus.round);
            for (drive, truth) in bus.handle.image.drives.iter().zip(&self.truths[bus.index]) {
                let settled = |at: Instant| self.now - at > Duration::from_secs(3);
                let age = drive.snapshot().fast_at.map(|at| self.now - at);
                assert!(
                    !truth.online_since.is_some_and(settled)
                        || age.is_some_and(|age| age < Duration::from_secs(2) + 3 * round),
                    "the process data of {} is {age:?} old",
                    drive.spec.name
                );
            }
        }
    }

    /// Checks that a drive that does not answer is probed again within 10 s plus the other traffic on the line.
    pub(super) fn check_probes(&self) {
        for (bus, truths) in self.buses.iter().zip(&self.truths) {
            let round = bus.handle.image.health().fast.last.unwrap_or_default();
            // On N2, the bus waits for a missing report as long as the longest report takes. This happens twice: for
            // the report of this drive before the pause, and for the report of another drive after it.
            let reports = 2 * (bus.line.response_timeout + Duration::from_secs(1));
            let duels = self.clients.iter().any(|client| client.habit == Habit::Duels);
            let reports = match bus.line.protocol {
                // Polls for reports also wait for the acknowledgements of stops without end, which may come late.
                Protocol::N2 if duels => PROBED + reports,
                Protocol::N2 => reports,
                Protocol::ModbusRtu | Protocol::ModbusAscii => Duration::ZERO,
            };
            for (drive, truth) in truths.iter().enumerate() {
                let Some(since) = truth.offline_since else { continue };
                let silent = self.now - truth.asked.max(Some(since)).unwrap_or(since);
                assert!(
                    silent < PROBED + 3 * round + reports,
                    "line{} drive {} was not asked for {silent:?}",
                    bus.index,
                    drive + 1
                );
            }
        }
    }

    /// Checks that a state is known only while all its sources are known.
    pub(super) fn check_states(&self) {
        let plant = self.plant.load();
        for drive in plant.drives() {
            let reading = drive.reading(self.now);
            let profile = &drive.image.spec.profile;
            let bad = |point: ModelPoint| {
                profile.model_index(point).is_some() && reading.model(point).quality != Quality::Good
            };
            use drivegate_model::drive::State;
            match reading.state() {
                Some(State::Running) => assert!(!bad(ModelPoint::Running), "running though nobody knows"),
                Some(State::Ready | State::NotReady) => {
                    let unknown = bad(ModelPoint::Running) || bad(ModelPoint::Fault) || bad(ModelPoint::Ready);
                    assert!(
                        !unknown,
                        "{}: a state that rests on what is not known",
                        drive.image.spec.name
                    );
                }
                _ => {}
            }
        }
    }
}
