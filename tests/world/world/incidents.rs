//! Incidents of drives and ports, and reloads of the gateway.

use super::*;

impl World {
    pub(super) fn incidents(&mut self) {
        let now = self.now;
        for bus in 0..self.buses.len() {
            if self.away[bus].is_some_and(|until| until <= now) {
                self.away[bus] = None;
                self.note(move || format!("the port of line{bus} is back"));
                self.buses[bus].set_open(true, now);
            }
        }
        let back: Vec<_> = self.off.iter().filter(|(_, _, until)| *until <= now).copied().collect();
        self.off.retain(|(_, _, until)| *until > now);
        for (bus, address, _) in back {
            self.note(move || format!("line{bus} drive {address} is on again"));
            let sim = now - self.began;
            if let Some(drive) = self.buses[bus].wire.slaves().drive(address) {
                drive.advance(sim);
                drive.power_on(sim);
                drive.set_alive(true);
            }
        }
        if let Some(index) = self.restarts.filter(|index| self.buses[*index].core.asked().is_none()) {
            self.restarts = None;
            self.restart(index);
        }
        if self.next_reload.is_some_and(|at| at <= now) {
            self.next_reload = Some(now + Duration::from_millis(self.dice.within(3_000..=12_000)));
            self.reload();
        }
        if self.next_incident.is_some_and(|at| at <= now) && !self.stopping {
            let mean = self.scenario.incidents.unwrap_or(Duration::from_secs(1));
            self.next_incident = Some(now + mean.mul_f64(0.2 + 1.6 * self.dice.unit()));
            self.incident();
        }
    }

    pub(super) fn incident(&mut self) {
        let now = self.now;
        let bus = self.dice.within(0..=self.buses.len() as u64 - 1) as usize;
        let address = self.dice.within(1..=u64::from(self.buses[bus].line.drives)) as u8;
        let kind = self.dice.within(0..=9);
        let off = now + Duration::from_millis(self.dice.within(50..=5_000));
        if !self.is_alive(bus, usize::from(address) - 1) || self.off.iter().any(|(b, a, _)| (*b, *a) == (bus, address))
        {
            return;
        }
        if kind >= 8 {
            return self.at_the_panel(bus, address);
        }
        let sim = now - self.began;
        let all: Vec<usize> = (0..usize::from(self.buses[bus].line.drives)).collect();
        let befell = |truths: &mut Vec<Truth>, which: &[usize]| {
            which.iter().for_each(|index| truths[*index].trouble(now + AFTERMATH));
        };
        befell(&mut self.truths[bus], &[usize::from(address) - 1]);
        let words = match kind {
            0 => {
                let until = now + Duration::from_millis(self.dice.within(20..=3_000));
                self.away[bus] = Some(until);
                self.buses[bus].set_open(false, now);
                befell(&mut self.truths[bus], &all);
                self.collect();
                "the port goes"
            }
            1 => {
                self.off.push((bus, address, off));
                self.truths[bus][usize::from(address) - 1].run = false;
                self.truths[bus][usize::from(address) - 1].lost_word = Some(now);
                let drive = self.buses[bus].wire.slaves().drive(address).unwrap();
                drive.advance(sim);
                drive.power_off();
                "loses its supply"
            }
            2 => {
                let drive = self.buses[bus].wire.slaves().drive(address).unwrap();
                let alive = !drive.answers();
                drive.set_alive(alive);
                "comes off the line, or back"
            }
            3 | 4 => {
                let drive = self.buses[bus].wire.slaves().drive(address).unwrap();
                drive.advance(sim);
                drive.trip(1);
                "trips"
            }
            7 if self.buses[bus].line.refresh.is_some() => {
                let drive = self.buses[bus].wire.slaves().drive(address).unwrap();
                drive.advance(sim);
                self.other_master(bus, address)
            }
            _ => {
                let drive = self.buses[bus].wire.slaves().drive(address).unwrap();
                drive.advance(sim);
                let remote = drive.state().remote;
                drive.set_remote(!remote);
                "is switched to its panel, or back"
            }
        };
        self.note(move || format!("line{bus} drive {address} {words}"));
    }

    /// Changes the maximum frequency of a drive, as a person at its panel does.
    fn at_the_panel(&mut self, bus: usize, address: u8) {
        let hertz = [50.0, 60.0, 80.0, 100.0][self.dice.within(0..=3) as usize];
        if let Some(hertz) = self.buses[bus].maximum_frequency(address, Some(hertz), self.now) {
            self.truths[bus][usize::from(address) - 1]
                .maxima
                .push((self.now, hertz));
            self.note(move || format!("line{bus} drive {address} has a maximum frequency of {hertz} Hz now"));
        }
    }

    /// The gateway takes a new configuration, in which a bus has changed.
    pub(super) fn reload(&mut self) {
        let index = self.dice.within(0..=self.buses.len() as u64 - 1) as usize;
        self.restarts = Some(index);
    }

    /// Restarts the bus, which a reload has changed, when the transaction on its line has ended.
    pub(super) fn restart(&mut self, index: usize) {
        self.note(move || format!("a reload starts line{index} anew"));
        self.buses[index].restart(index, &self.events, self.now);
        for truth in &mut self.truths[index] {
            truth.online_since = None;
        }
        let plant = plant_of(&self.buses, &self.events, &self.command_log);
        self.plant.store(Arc::new(plant));
        let timeout = self.buses[index]
            .line
            .supervision
            .as_ref()
            .map(|supervision| supervision.timeout);
        for truth in &mut self.truths[index] {
            truth.found_anew_until = Some(self.now + AFTERMATH);
            let held = truth
                .heard
                .0
                .zip(timeout)
                .is_some_and(|(heard, timeout)| heard + timeout > self.now);
            if held && truth.running_since.is_some() {
                truth.carried = Some(self.now);
            }
        }
        self.collect();
    }
}
