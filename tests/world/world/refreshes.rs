//! Refreshes for a drive's own timeout: only ordered values, and only while the order is in force.

use super::*;
use crate::orders::is_counted;
use drivegate_proto::Table;

/// What a drive showed this long ago is no longer known: the reads right before a refresh are behind it.
const SHOWN: Duration = Duration::from_millis(500);

impl World {
    /// Checks the frame of a refresh: only values that an order wrote, only the stop word after a stop, and no run
    /// word for a motor at standstill.
    pub(super) fn check_refresh(&mut self, bus: usize, drive: usize, pdu: &RequestPdu) {
        self.collect();
        let now = self.now;
        let simulated = self.buses[bus].wire.slaves().drive(drive as u8 + 1);
        let turns = simulated.is_some_and(|drive| drive.state().running);
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
        let repeats = profile.repeats().expect("a family whose orders are written again");
        let is_over = |at: Option<Instant>| at.is_none_or(|at| now - at > SHOWN);
        // The word that the drive has now, if another master wrote it behind the last order.
        let foreign = truth
            .foreign
            .filter(|at| Some(*at) > truth.commanded && is_over(Some(*at)));
        let reads = profile.control.as_ref().is_some_and(|control| control.is_read());
        // A reference at a place of its own goes before the reads.
        let is_word = profile.control.as_ref().is_some_and(|control| {
            let at = (control.at.table, control.at.address);
            written(pdu).is_some_and(|(table, items)| items.iter().any(|(address, _)| (table, *address) == at))
        });
        assert!(
            foreign.is_none() || !repeats.word || !reads || !is_word,
            "drive {} gets its word again over that of another master",
            drive + 1
        );
        let runs = run_command(&profile, pdu) == Some(true);
        if !runs && (repeats.word || !truth.run) {
            return;
        }
        let local = profile.model_index(ModelPoint::Remote).is_some() && is_over(truth.remote_at);
        assert!(!local, "drive {} is fed under its local control", drive + 1);
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
        // A run command that was lost after the reads before this frame.
        assert!(
            truth.run || !is_over(truth.lost_word),
            "drive {} gets a run command again that it does not have",
            drive + 1
        );
        assert!(
            turns || !is_over(truth.turned_at),
            "drive {} stands, and its run command is repeated",
            drive + 1
        );
        if let Some(supervision) = &self.buses[bus].line.supervision {
            let last = truth.heard.1.expect("a client whose order is written again");
            // The refresh begins again with the reference that supervision wrote, which may come long after the lease
            // expired, if the reference could not be calculated before. It needs no lease until another write.
            let speed = matches!(supervision.action, LeaseAction::SpeedReference(_));
            let acted = speed && truth.acted;
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
        for (bus, truths) in self.buses.iter().zip(&self.truths) {
            let Some(every) = bus.line.refresh else { continue };
            // All other drives may have their turn before this one.
            let round = bus.handle.image.health().fast.last.unwrap_or(bus.round);
            let most = 4 * every + 3 * round + 2 * self.exchange(bus) * u32::from(bus.line.drives);
            for (drive, truth) in truths.iter().enumerate() {
                let fed = truth.fed.is_some_and(|at| self.now - at <= most);
                assert!(
                    fed || !self.is_owed_a_feeding(bus.index, drive, most),
                    "line{} drive {} got its run command last {:?} ago, {most:?} at most",
                    bus.index,
                    drive + 1,
                    truth.fed.map(|at| self.now - at)
                );
            }
        }
    }

    /// Whether a drive must have been fed in the last `time`: it runs by an order, its client is there, and nothing has been in
    /// the way since.
    pub(super) fn is_owed_a_feeding(&self, bus: usize, drive: usize, time: Duration) -> bool {
        let (line, truth, now) = (&self.buses[bus].line, &self.truths[bus][drive], self.now);
        let profile = &self.buses[bus].profile;
        // Where the reference feeds the timeout, an order must have set one.
        let is_reference = |at: &(Table, u16)| at.0 == Table::Holding && profile.is_repeated_reference(at.1);
        let has_reference = truth.ordered.keys().any(is_reference);
        if profile.repeats().is_ok_and(|repeats| !repeats.word) && !has_reference {
            return false;
        }
        let sound = self.scenario.incidents.is_none() && !line.is_noisy() && self.buses[bus].open;
        let (Some(supervision), Some(ordered), Some(heard)) = (&line.supervision, truth.ran_by_order, truth.heard.0)
        else {
            return false;
        };
        let alive = now - heard < supervision.timeout / 2;
        // After a lease expired, only an order begins a new lease, a heartbeat does not.
        let expired = truth.supervised.is_some_and(|at| at >= ordered);
        let runs = truth.run && truth.running_since.is_some_and(|since| now - since > time);
        let waits = self.open.contains_key(&(bus, drive)) || truth.waited_until.is_some_and(|at| now - at <= time);
        let is_disturbed = expired || truth.is_troubled(ordered) || line.refuses.is_some();
        sound && alive && runs && !waits && !is_disturbed && now - ordered >= time
    }

    /// Records the effects of a write that a drive acted upon: what an order set, and what fed the drive's timeout.
    pub(super) fn note_ordered(&mut self, bus: usize, drive: usize, asked: &Asked) {
        let (profile, now) = (self.buses[bus].profile.clone(), self.now);
        let truth = &mut self.truths[bus][drive];
        let Some((table, items)) = written(&asked.pdu) else {
            return;
        };
        if !asked.is_refresh {
            truth.commanded = Some(now);
            truth.acted = truth.action.as_ref().is_some_and(|action| action.pdu == asked.pdu);
            truth
                .ordered
                .extend(items.iter().map(|(address, word)| ((table, *address), *word)));
        }
        let runs = run_command(&profile, &asked.pdu);
        if asked.is_refresh && runs.is_some() {
            // Another master's word that came between the last read and this write is overwritten.
            truth.foreign = None;
        }
        let by_reference = profile.repeats().is_ok_and(|repeats| !repeats.word);
        // The reference of a client's order feeds the timeout as its refresh does, and puts that off.
        if runs == Some(true) || (by_reference && is_counted(&profile, &asked.pdu)) {
            truth.fed = Some(now);
        }
        match runs {
            Some(true) if !asked.is_refresh => truth.ran_by_order = Some(now),
            Some(false) => truth.ran_by_order = None,
            _ => {}
        }
    }
}
