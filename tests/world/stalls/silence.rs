//! The last client falls silent while the process stalls again and again. Its lease is prolonged by the stalls, during
//! which nobody could be received, and by one timeout at most: no motor is stopped because the gateway stood still,
//! and none runs without its client longer than twice the timeout.

use drivegate_core::event::EventKind;

use super::*;

/// Time in which a motor starts.
const STARTS: Duration = Duration::from_millis(600);
/// Time in which the bus runs between two stalls.
const RUNS: Duration = Duration::from_millis(150);
/// Time from the end of a lease to its action, on a bus that runs.
const ACTS: Duration = Duration::from_secs(2);
/// Difference between the end of an order and its answer.
const ANSWERED: Duration = Duration::from_millis(200);

impl World {
    /// A client starts the motor of a drive with a lease and falls silent; then the process stalls.
    pub(super) fn fall_silent(&mut self) {
        let Some(timeout) = self.bus.line.supervision.as_ref().map(|lease| lease.timeout) else {
            return;
        };
        let Some((machine, started)) = self.start_last() else {
            return;
        };
        let mut drives = self.bus.handle.image.drives.iter();
        let name = drives.find_map(|drive| (drive.spec.address == machine).then(|| drive.spec.name.clone()));
        let mut events = self.plant.load().events.subscribe();
        let mut has_acted = move || {
            let mut events = std::iter::from_fn(|| events.try_recv().ok());
            events.any(|event| event.kind == EventKind::Supervision && event.drive == name)
        };
        let mut stalled = Duration::ZERO;
        while stalled < 2 * timeout {
            let time = self.ms(600..=900);
            let until = self.now + time;
            (self.standing.readers, self.standing.bus) = (Some(until), Some(until));
            self.run_until(until + RUNS);
            if self.promised.befell_since(machine, started) {
                return;
            }
            if has_acted() {
                let least = started + timeout + stalled.min(timeout);
                assert!(
                    self.now + ANSWERED >= least,
                    "the lease of drive {machine} acts {:?} behind its last order, of which the process stalled for {stalled:?}",
                    self.now - started
                );
                return;
            }
            stalled += time;
        }
        self.run_until(self.now + ACTS);
        assert!(
            has_acted() || self.promised.befell_since(machine, started),
            "drive {machine} runs {:?} behind its last order; its lease is {timeout:?} long",
            self.now - started
        );
    }

    /// Starts the drive at unit 1 over a new connection; returns the machine, and when it was started. `None` if its
    /// motor does not run by that.
    fn start_last(&mut self) -> Option<(u8, Instant)> {
        self.calm = true;
        let standing = self.standing.readers.max(self.standing.bus);
        self.run_until(standing.max(Some(self.now))? + Duration::from_secs(2));
        self.connect();
        // Connections that were closed are forgotten meanwhile, so that the place of the last one changes.
        let last = |world: &World| world.connections.len() - 1;
        self.write(last(self), 1, 0x8100, 0, false);
        self.run_until(self.now + Duration::from_secs(3));
        let id = self.write(last(self), 1, 0x8100, 1, false);
        self.run_until(self.now + STARTS);
        let order = self.promised.orders[id];
        let (answered, exception) = order.answer?;
        let runs = self.bus.wire.slaves().drive(order.machine)?.state().running;
        (runs && exception.is_none()).then_some((order.machine, answered))
    }
}
