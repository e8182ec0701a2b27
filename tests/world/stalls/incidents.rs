//! Random incidents of threads, drives and names.

use super::*;

impl World {
    /// A client begins a request before a stall, and completes it during the stall or after it.
    fn begins_a_request(&mut self, stall: Duration) {
        let idle =
            |connection: &Connection| connection.open && connection.closed.is_none() && connection.rest.is_none();
        let Some(index) = self.connections.iter().position(idle) else {
            return;
        };
        let unit = self.dice.within(1..=u64::from(self.bus.line.drives)) as u8;
        self.write(index, unit, 0x8100, 1, true);
        self.run_readers();
        let later = self.now + stall.mul_f64(self.dice.unit() * 1.1);
        if let Some((at, ..)) = &mut self.connections[index].rest {
            *at = later;
        }
    }

    /// Lets random incidents happen to threads, drives and names.
    pub(super) fn incidents(&mut self) {
        let now = self.now;
        if self.calm {
            (self.next_stall, self.next_incident) = (now + HEALED, now + HEALED);
            return;
        }
        if self.next_stall <= now {
            self.stall();
        }
        if self.next_incident <= now {
            self.next_incident = now + self.ms(300..=5_000);
            if !self.healthy {
                self.incident();
            }
        }
        // An order read late after an unnoticed hiccup has the meaning of its name at the reading.
        let unnoticed = self.standing.readers.is_some() && self.stalled_for <= promised::UNNOTICED;
        if self.wants_reload && !unnoticed && self.standing.bus.is_none() && self.bus.core.asked().is_none() {
            self.wants_reload = false;
            self.swap();
        }
    }

    fn stall(&mut self) {
        let now = self.now;
        let time = match (self.healthy, self.dice.within(0..=9)) {
            (true, _) => self.ms(20..=290),
            (_, 0..=3) => self.ms(20..=300),
            (_, 4..=6) => self.ms(300..=1_500),
            (_, 7 | 8) => self.ms(1_000..=8_000),
            _ => self.ms(8_000..=60_000),
        };
        self.stalled_for = time;
        if !self.healthy && self.chance(0.4) {
            self.begins_a_request(time);
        }
        let until = Some(now + time);
        let who = match self.dice.within(0..=3) {
            0 => {
                self.standing.readers = until;
                "the readers"
            }
            1 => {
                self.standing.bus = self.standing.bus.max(until);
                "the bus"
            }
            _ => {
                // The threads do not continue at the same moment.
                self.standing.readers = until.map(|until| until + Duration::from_millis(self.dice.within(0..=4)));
                self.standing.bus = self.standing.bus.max(until);
                "the process"
            }
        };
        self.next_stall = now + time + self.ms(500..=6_000);
        self.note(move || format!("{who} stands still for {time:?}"));
    }

    fn incident(&mut self) {
        let machine = self.dice.within(1..=u64::from(self.bus.line.drives)) as u8;
        let sim = self.bus.sim(self.now);
        let kind = self.dice.within(0..=3);
        let drive = self.bus.wire.slaves().drive(machine).unwrap();
        drive.advance(sim);
        let what = match kind {
            0 => {
                drive.power_off();
                drive.power_on(sim);
                "restarts"
            }
            2 if self.number.is_multiple_of(2) => {
                drive.trip(1);
                "trips"
            }
            1 | 2 => {
                let reference = 0;
                drive.command(Command {
                    run: false,
                    reverse: false,
                    reference,
                });
                "is stopped by somebody else"
            }
            _ => {
                self.wants_reload = self.reloads;
                return;
            }
        };
        drive.advance(sim);
        self.promised.runs(machine, drive.state().running, self.now);
        self.befell(machine);
        self.note(move || format!("drive {machine} {what}"));
    }

    /// A drive was stopped by something other than a command on the line, so its run command is gone.
    pub(super) fn befell(&mut self, machine: u8) {
        self.promised.befell(machine, self.now);
        self.resets.befell(machine);
    }

    /// A reload gives the names and units of the drives to the machines in the opposite order.
    fn swap(&mut self) {
        let now = self.now;
        self.bus.line.swapped = !self.bus.line.swapped;
        let plant = self.plant.load_full();
        let before = self.bus.handle.clone();
        self.bus.restart(0, &plant.events, now);
        let after = std::slice::from_ref(&self.bus.handle);
        self.unused_names.follow(&[before], after, now);
        self.plant.store(Arc::new(Plant {
            gateway: plant.gateway.clone(),
            stale_after: plant.stale_after,
            buses: vec![self.bus.handle.clone()],
            events: plant.events.clone(),
            command_log: plant.command_log.clone(),
        }));
        self.note(|| "a reload swaps names and units".to_string());
    }
}
