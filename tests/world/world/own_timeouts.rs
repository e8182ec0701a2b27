//! Drives that trip by a timeout of their own, which counts only writes of what the family says, and a gateway that is gone.

use drivegate_core::start_guard::Guards;
use drivegate_sim::simulated_drive::Command;

use super::*;
use crate::orders::is_counted;

/// Longest own timeout that is tried at the end of a world; the longer ones of full slow lines would take minutes each.
const TRIED: Duration = Duration::from_secs(25);
/// Time for an order to each drive of a line.
const ORDERED: Duration = Duration::from_secs(30);

impl World {
    /// Records a write that a drive carried out, as far as its own timeout counts it.
    pub(super) fn note_counted(&mut self, bus: usize, drive: usize, pdu: &RequestPdu) {
        if is_counted(&self.buses[bus].profile, pdu) {
            self.truths[bus][drive].counted = Some(self.now);
        }
    }

    /// Trips each drive whose motor runs by the bus, and that has got no write which its timeout counts. On a sound line that
    /// does not happen while a client is there.
    pub(super) fn own_timeouts(&mut self) {
        let (now, sim) = (self.now, self.now - self.began);
        for index in 0..self.buses.len() {
            let Some(timeout) = self.buses[index].line.own_timeout else {
                continue;
            };
            for place in 0..self.truths[index].len() {
                let Some(drive) = self.buses[index].wire.slaves().drive(place as u8 + 1) else {
                    continue;
                };
                let state = drive.state();
                let truth = &mut self.truths[index][place];
                truth.obeys_since = (state.running && state.remote).then(|| truth.obeys_since.unwrap_or(now));
                let Some(since) = truth
                    .obeys_since
                    .max(truth.counted)
                    .filter(|_| truth.obeys_since.is_some())
                else {
                    continue;
                };
                if now - since <= timeout {
                    continue;
                }
                drive.advance(sim);
                drive.trip(1);
                (truth.timed_out, truth.obeys_since) = (Some(now), None);
                self.figures.timed_out += 1;
                self.note(move || format!("line{index} drive {} trips by its own timeout", place + 1));
                assert!(
                    !self.is_owed_a_feeding(index, place, timeout),
                    "line{index} drive {} trips {timeout:?} after its last write, and its client is there",
                    place + 1
                );
                self.truths[index][place].trouble(now + AFTERMATH);
            }
        }
    }

    /// Another master commands a drive: the opposite of what it does, or another reference.
    pub(super) fn other_master(&mut self, bus: usize, address: u8) -> &'static str {
        let (now, place) = (self.now, usize::from(address) - 1);
        let runs = self.truths[bus][place].run;
        let run = if self.dice.chance(0.7) { !runs } else { runs };
        let reference = self.dice.within(1_000..=9_000) as i16;
        let drive = self.buses[bus].wire.slaves().drive(address).unwrap();
        drive.command(Command {
            run,
            reverse: false,
            reference,
        });
        let truth = &mut self.truths[bus][place];
        (truth.counted, truth.lost_word) = (Some(now), Some(now));
        if std::mem::replace(&mut truth.run, run) != run {
            // Twice the opposite is the word of the last order again.
            let once = truth.foreign.is_none_or(|at| Some(at) < truth.commanded);
            truth.foreign = once.then_some(now);
        }
        if run {
            "is run by another master"
        } else {
            "is stopped by another master"
        }
    }

    /// Runs drives with a timeout of their own for longer than that while their client is there: none trips. Then the gateway is
    /// killed: each trips in its time, also if the gateway is started again before, and nothing is written for a client that is
    /// gone with it.
    pub(super) fn try_own_timeouts(&mut self) {
        let drives: Vec<(usize, usize)> = self.drives_that_answer().filter(|at| self.is_tried(*at)).collect();
        let timeouts = drives.iter().filter_map(|(bus, _)| self.buses[*bus].line.own_timeout);
        let Some(longest) = timeouts.max() else { return };
        self.note(|| "own timeouts are tried".to_string());
        self.switch_on(&drives);
        self.run_all(&drives);
        let began = self.now;
        while self.now < began + longest.mul_f64(1.3) {
            self.client_is_there(&drives);
            self.look_until(self.now + Duration::from_millis(90));
        }
        for (bus, drive) in &drives {
            let truth = &self.truths[*bus][*drive];
            assert!(
                truth.timed_out.is_none_or(|at| at < began) && truth.obeys_since.is_some(),
                "line{bus} drive {} does not run on while its client is there: {:?}",
                drive + 1,
                self.buses[*bus]
                    .wire
                    .slaves()
                    .drive(*drive as u8 + 1)
                    .map(|drive| drive.state())
            );
        }
        self.is_killed(&drives, longest);
    }

    /// Renews the leases of drives.
    fn client_is_there(&mut self, drives: &[(usize, usize)]) {
        for (bus, drive) in drives {
            self.buses[*bus].handle.image.drives[*drive].renew_lease(self.now);
            self.truths[*bus][*drive].heard_for_certain(self.now);
            self.buses[*bus].command_came(self.now);
        }
    }

    /// Whether the own timeout of a drive is tried: its state can be read, and the timeout is not too long.
    fn is_tried(&self, (bus, drive): (usize, usize)) -> bool {
        let line = &self.buses[bus].line;
        let is_seen = drive > 0 || line.refuses.is_none();
        is_seen && line.own_timeout.is_some_and(|timeout| timeout <= TRIED)
    }

    /// Switches drives off and on, after which they have no fault and obey the bus, and waits until the gateway knows that.
    fn switch_on(&mut self, drives: &[(usize, usize)]) {
        let sim = self.now - self.began;
        for (bus, place) in drives {
            let drive = self.buses[*bus].wire.slaves().drive(*place as u8 + 1).unwrap();
            drive.advance(sim);
            drive.power_off();
        }
        // Requests to them are not answered: late replies are possible again.
        if let Some(healing) = &mut self.healing {
            healing.settled = self.now + TRIED * 60;
        }
        // Whatever was on its way to the drives is lost.
        self.look_until(self.now + Duration::from_secs(1));
        let (now, sim) = (self.now, self.now - self.began);
        for (bus, place) in drives {
            let drive = self.buses[*bus].wire.slaves().drive(*place as u8 + 1).unwrap();
            drive.power_on(sim);
            drive.set_remote(true);
            let truth = &mut self.truths[*bus][*place];
            truth.run = false;
            truth.lost_word = Some(now);
            truth.trouble(now + AFTERMATH);
        }
        let rounds = drives
            .iter()
            .map(|(bus, _)| 2 * self.buses[*bus].first_slow_round)
            .max();
        self.look_until(now + PROBED + rounds.unwrap_or_default());
    }

    /// A client runs all these drives.
    fn run_all(&mut self, drives: &[(usize, usize)]) {
        let (client, first) = (self.new_client(), self.records.len());
        for (bus, drive) in drives {
            self.plain(client, *bus, *drive, Wish::RunAtReference, ORDERED);
        }
        let until = self.now + ORDERED;
        while self.records[first..].iter().any(|record| record.answer.is_none()) {
            assert!(self.now < until, "orders to run that nobody answers");
            self.client_is_there(drives);
            self.look_until(self.now + Duration::from_millis(90));
        }
        for record in &self.records[first..] {
            let answer = record.answer.as_ref().map(|(code, _)| code.as_str());
            assert!(
                matches!(answer, Some("acknowledged" | "confirmed")),
                "a drive that was switched on is not run: {record:?}"
            );
        }
        // A slow motor is seen to run after the confirmation.
        self.client_is_there(drives);
    }

    /// The process is killed, and started again after a while.
    fn is_killed(&mut self, drives: &[(usize, usize)], longest: Duration) {
        let killed = self.now;
        self.note(|| "the gateway is killed".to_string());
        for bus in &mut self.buses {
            bus.vanish();
        }
        let soon = longest.mul_f64(self.dice.unit());
        let away = if self.dice.chance(0.5) { longest + ACTION } else { soon };
        self.look_until(killed + away);
        self.note(|| "the gateway is started again".to_string());
        for bus in &mut self.buses {
            bus.open = true;
            bus.kill(Guards::default(), &self.events, self.now);
        }
        self.plant
            .store(Arc::new(plant_of(&self.buses, &self.events, &self.command_log)));
        for truth in self.truths.iter_mut().flatten() {
            truth.forget_the_gateway(self.now);
        }
        let leases = self.buses.iter().filter_map(|bus| bus.line.supervision.as_ref());
        let lease = leases.map(|supervision| supervision.timeout).max().unwrap_or_default();
        // An adopted motor gets one more write, which its drive counts: the action of the lease.
        self.look_until(self.now + 2 * longest + lease + PROBED);
        for (bus, drive) in drives {
            let truth = &self.truths[*bus][*drive];
            let stopped = truth.stop_sent.is_some_and(|at| at > killed);
            assert!(
                truth.obeys_since.is_none() && (stopped || truth.timed_out.is_some_and(|at| at > killed)),
                "line{bus} drive {} runs on though its gateway is gone",
                drive + 1
            );
        }
    }
}
