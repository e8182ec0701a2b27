//! Refreshes for a drive's own timeout: only ordered values, and only while the order is in force.

use super::*;

impl World {
    /// Checks the frame of a refresh: only values that an order wrote, only the stop word after a stop, and no run
    /// word for a motor at standstill.
    pub(super) fn check_refresh(&mut self, bus: usize, drive: usize, pdu: &RequestPdu) {
        self.collect();
        let now = self.now;
        let profile = self.buses[bus].profile.clone();
        let truth = &self.truths[bus][drive];
        let (table, items) = written(pdu).expect("a write that the drives have");
        for (address, word) in items {
            let ordered = truth.ordered.get(&(table, address)).copied();
            let released = ordered.map(|ordered| {
                let control = profile.control.as_ref().filter(|control| control.at.address == address);
                control.map_or(ordered, |control| control.without_reset(ordered))
            });
            assert_eq!(
                released,
                Some(word),
                "drive {}: {table} {address} was not ordered",
                drive + 1
            );
        }
        assert!(!self.buses[bus].ending, "a refresh goes out while the gateway ends");
        if run_command(&profile, pdu) != Some(true) {
            return;
        }
        let open = self.open.get(&(bus, drive)).into_iter().flatten();
        let stops = |id: &&usize| {
            let record = &self.records[**id];
            // Over MQTT the answer of a completed order waits for its confirmation.
            record.wish.is_stop() && record.accepted < now && self.clients[record.client].habit != Habit::Mqtt
        };
        assert!(
            open.clone().find(stops).is_none(),
            "a run command is repeated behind a stop of drive {}",
            drive + 1
        );
        assert!(
            truth.run,
            "drive {} gets a run command again that it does not have",
            drive + 1
        );
        // State that the drive showed directly before.
        let within = Duration::from_millis(500);
        assert!(
            truth.turned_at.is_some_and(|at| now - at <= within),
            "drive {} stands, and its run command is repeated",
            drive + 1
        );
        if let Some(supervision) = &self.buses[bus].line.supervision {
            let last = truth.heard.1.unwrap_or(now);
            let speed = matches!(supervision.action, LeaseAction::SpeedReference(_));
            let acted = speed && truth.supervised.is_some_and(|at| at >= last);
            assert!(
                acted || now - last <= supervision.timeout + ACTION,
                "drive {} is fed {:?} after its client fell silent",
                drive + 1,
                now - last
            );
        }
        self.figures.refreshed += 1;
    }

    /// Checks that the timeout of a drive that counts only writes is kept from expiring while its motor runs by an
    /// order whose client is present.
    pub(super) fn check_feeding(&self) {
        if self.scenario.incidents.is_some() {
            return;
        }
        for (bus, truths) in self.buses.iter().zip(&self.truths) {
            let (Some(every), Some(supervision)) = (bus.line.refresh, &bus.line.supervision) else {
                continue;
            };
            if bus.line.is_noisy() || !bus.open || bus.line.refuses.is_some() {
                continue;
            }
            // All other drives may be served before this one.
            let round = bus.handle.image.health().fast.last.unwrap_or(bus.round);
            let most = 4 * every + 3 * round + 2 * self.exchange(bus) * u32::from(bus.line.drives);
            for (drive, truth) in truths.iter().enumerate() {
                let (Some(ordered), Some(heard)) = (truth.ran_by_order, truth.heard.0) else {
                    continue;
                };
                let alive = self.now - heard < supervision.timeout / 2;
                // After a lease expired, only an order begins a new lease; a heartbeat does not.
                let expired = truth.supervised.is_some_and(|at| at >= ordered);
                let waits = expired || self.open.contains_key(&(bus.index, drive)) || truth.is_troubled(ordered);
                let runs = truth.run && truth.running_since.is_some_and(|since| self.now - since > most);
                if !alive || waits || !runs || self.now - ordered < most {
                    continue;
                }
                let free = truth.waited_until.is_none_or(|at| self.now - at > most);
                let fed = truth.fed.is_some_and(|at| self.now - at <= most);
                assert!(
                    fed || !free,
                    "line{} drive {} got its run command last {:?} ago, {most:?} at most",
                    bus.index,
                    drive + 1,
                    truth.fed.map(|at| self.now - at)
                );
            }
        }
    }

    /// Records the effects of a write that a drive carried out: the values set by an order, and what restarted the
    /// drive's timeout.
    pub(super) fn note_ordered(&mut self, bus: usize, drive: usize, asked: &Asked) {
        let (profile, now) = (self.buses[bus].profile.clone(), self.now);
        let truth = &mut self.truths[bus][drive];
        let Some((table, items)) = written(&asked.pdu) else {
            return;
        };
        if !asked.is_refresh {
            truth
                .ordered
                .extend(items.iter().map(|(address, word)| ((table, *address), *word)));
        }
        let runs = run_command(&profile, &asked.pdu);
        let by_reference = profile.repeats().is_ok_and(|repeats| !repeats.word);
        if runs == Some(true) || (asked.is_refresh && by_reference) {
            truth.fed = Some(now);
        }
        match runs {
            Some(true) if !asked.is_refresh => truth.ran_by_order = Some(now),
            Some(false) => truth.ran_by_order = None,
            _ => {}
        }
    }
}
