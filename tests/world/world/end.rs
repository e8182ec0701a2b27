//! The end of the gateway in a world.

use drivegate_core::queue::NotStopped;

use super::*;

impl World {
    /// Stops the gateway: every online drive that must be stopped is stopped, and each client gets one answer.
    pub(super) fn stop(&mut self) {
        self.stopping = true;
        self.note(|| "the gateway stops".to_string());
        let deadline = self.now + Duration::from_secs(30);
        let mut reports: Vec<(usize, oneshot::Receiver<Vec<NotStopped>>)> = Vec::new();
        for (index, bus) in self.buses.iter_mut().enumerate() {
            if bus.open {
                reports.push((index, bus.handle.queue.begin_shutdown(deadline, self.now)));
                bus.ending = true;
                bus.command_came(self.now);
            }
        }
        let mut missing: BTreeMap<usize, Vec<NotStopped>> = BTreeMap::new();
        let begun = self.now;
        self.next_incident = None;
        self.next_reload = None;
        self.restarts = None;
        while !reports.is_empty() {
            assert!(
                self.now < deadline + Duration::from_secs(1),
                "the shutdown does not end"
            );
            self.step();
            reports.retain_mut(|(index, report)| match report.try_recv() {
                Ok(drives) => {
                    missing.insert(*index, drives);
                    false
                }
                Err(_) => self.away[*index].is_none(),
            });
        }
        for (index, bus) in self.buses.iter_mut().enumerate() {
            let on_shutdown = bus.line.on_shutdown == drivegate_core::process_image::OnShutdown::Stop;
            let Some(missing) = missing.get(&index).filter(|_| on_shutdown) else {
                continue;
            };
            for (drive, truth) in self.truths[index].iter().enumerate() {
                let spec = &bus.handle.image.drives[drive].spec;
                let answers = bus
                    .wire
                    .slaves()
                    .drive(spec.address)
                    .is_some_and(|drive| drive.answers());
                if answers && !truth.is_troubled(begun) {
                    assert!(!truth.run, "{} was not stopped with the gateway", spec.name);
                    assert!(!missing.iter().any(|missing| missing.drive == spec.name), "{missing:?}");
                }
            }
        }
        for bus in &mut self.buses {
            bus.handle.queue.close(Outcome::ShuttingDown, self.now);
            bus.core.ended(self.now);
        }
        self.collect();
        let open: Vec<usize> = self.open.values().flatten().copied().collect();
        assert!(open.is_empty(), "orders without an answer at the end: {open:?}");
        let reported: u64 = self.command_log.results().values().sum();
        let reads = self.records.iter().filter(|record| record.read.is_some()).count();
        assert!(
            reported >= (self.records.len() - reads) as u64,
            "each order is counted once"
        );
    }
}
