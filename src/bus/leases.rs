//! Leases: a gateway that polls keeps a drive's own watchdog content even when nobody commands the drive any more.
//! So a drive can have a lease, renewed by accepted writes and heartbeats of a commanding client; when it runs out
//! while the drive runs, the configured action is written once. Not a safety function.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use tokio::sync::oneshot::Receiver;

use crate::cache::LeaseAction;
use crate::command::{Answer, Command, Order, Origin, SourceKind, Ticket, Urgency, WriteStats};
use crate::drive::{ModelPoint, Value};
use crate::event::{Event, EventKind, Events};
use crate::plant::BusHandle;

/// How long an action that was not acknowledged waits before it is written again.
const AGAIN: Duration = Duration::from_secs(1);

/// Process data older than this does not tell whether the motor runs.
const FRESH: Duration = Duration::from_secs(2);

/// Watches the leases of one bus.
#[derive(Debug)]
pub struct Leases {
    events: Events,
    stats: Arc<WriteStats>,
    owed: Vec<Owed>,
}

/// An action that is not acknowledged yet.
#[derive(Debug)]
struct Owed {
    drive: usize,
    answer: Option<Receiver<Answer>>,
    next_try: Instant,
}

impl Leases {
    /// Watches with these listeners and counters.
    pub fn new(events: Events, stats: Arc<WriteStats>) -> Leases {
        Leases {
            events,
            stats,
            owed: Vec::new(),
        }
    }

    /// Looks for leases that ran out and for actions that are still owed.
    pub fn look(&mut self, bus: &BusHandle, now: Instant) {
        for (index, drive) in bus.image.drives.iter().enumerate() {
            // Of a drive that does not answer nobody knows whether it runs: its lease stays until it is back.
            let Some(running) = drive.reading(now, FRESH).model(ModelPoint::Running).good() else {
                continue;
            };
            if drive.lease_ran_out(now) && running.as_bool() {
                drive.count_supervision();
                self.ran_out(bus, index, now);
            }
        }
        let mut owed = std::mem::take(&mut self.owed);
        owed.retain_mut(|item| !item.settled(now));
        for item in owed
            .iter_mut()
            .filter(|item| item.answer.is_none() && item.next_try <= now)
        {
            item.answer = self.submit(bus, item.drive, now);
        }
        self.owed = owed;
    }

    fn ran_out(&mut self, bus: &BusHandle, index: usize, now: Instant) {
        let Some(drive) = bus.image.drives.get(index) else {
            return;
        };
        let Some(supervision) = &drive.spec.supervision else {
            return;
        };
        let action = match supervision.action {
            LeaseAction::Stop => "the drive is stopped".to_string(),
            LeaseAction::Hold => "nothing is written".to_string(),
            LeaseAction::SpeedReference(percent) => format!("the speed reference is set to {percent} %"),
        };
        self.events.tell(Event {
            id: 0,
            time: SystemTime::now(),
            kind: EventKind::Supervision,
            bus: drive.spec.bus.clone(),
            drive: Some(drive.spec.name.clone()),
            fault_code: None,
            text: format!(
                "no commanding client of {} for {:?}: {action}",
                drive.spec.name, supervision.timeout
            ),
        });
        if supervision.action != LeaseAction::Hold && !self.owed.iter().any(|o| o.drive == index) {
            self.owed.push(Owed {
                drive: index,
                answer: None,
                next_try: now,
            });
        }
    }

    fn submit(&self, bus: &BusHandle, index: usize, now: Instant) -> Option<Receiver<Answer>> {
        let drive = bus.image.drives.get(index)?;
        let (point, value, urgency) = match drive.spec.supervision.as_ref()?.action {
            LeaseAction::Stop => (ModelPoint::Run, Value::Bool(false), Urgency::Stop),
            LeaseAction::SpeedReference(percent) => {
                (ModelPoint::SpeedReference, Value::Number(percent), Urgency::Command)
            }
            LeaseAction::Hold => return None,
        };
        let point_index = drive.spec.profile.model_index(point)?;
        let origin = Origin {
            kind: SourceKind::Supervision,
            who: "lease".to_string(),
        };
        let what = format!("{}={value}", point.name());
        let (ticket, answer) = Ticket::new(origin, &drive.spec.name, what, true, now, self.stats.clone());
        let order = Order::Points(vec![(point_index, value)]);
        let expires = now + crate::command::DEFAULT_EXPIRY;
        bus.queue.submit(
            Command {
                drive: index,
                order,
                urgency,
                reference_only: false,
                expires,
                ticket,
            },
            now,
        );
        Some(answer)
    }
}

impl Owed {
    /// Whether the action was acknowledged; one that failed is owed again after a pause.
    fn settled(&mut self, now: Instant) -> bool {
        let Some(answer) = &mut self.answer else { return false };
        match answer.try_recv() {
            Ok(answer) if answer.outcome.is_ok() => true,
            Err(tokio::sync::oneshot::error::TryRecvError::Empty) => false,
            Ok(_) | Err(_) => {
                self.answer = None;
                self.next_try = now + AGAIN;
                false
            }
        }
    }
}

#[cfg(test)]
mod tests {

    use super::*;
    use crate::cache::{Access, BusImage, BusSpec, DriveImage, DriveSpec, Link, Supervision};
    use crate::codec::{Exception, LineFormat, Protocol, Reply, Table};
    use crate::command::{CommandQueue, Outcome};
    use crate::drive::profile::Profiles;

    struct Bench {
        bus: BusHandle,
        leases: Leases,
        now: Instant,
    }

    impl Bench {
        fn new(action: LeaseAction) -> Bench {
            let spec = DriveSpec {
                access: Access::Control,
                supervision: Some(Supervision {
                    timeout: Duration::from_secs(5),
                    action,
                }),
                turnaround: Duration::ZERO,
                ..DriveSpec::new("d", "b", 1, Profiles::built_in().get("vacon-nx").unwrap().clone())
            };
            let bus = BusSpec {
                name: "b".to_string(),
                port: "none".to_string(),
                protocol: Protocol::ModbusRtu,
                format: LineFormat::new(38_400, "8N1").unwrap(),
                cycle: Duration::from_millis(10),
                slow_cycle: Duration::from_secs(1),
            };
            let drive = DriveImage::new(spec, bus.slow_cycle);
            drive.update(|s| s.link = Link::Online(SystemTime::now()));
            Bench {
                bus: BusHandle {
                    image: Arc::new(BusImage::new(bus, vec![Arc::new(drive)])),
                    queue: Arc::new(CommandQueue::new().unwrap()),
                },
                leases: Leases::new(Events::default(), Arc::default()),
                now: Instant::now(),
            }
        }

        /// `ms` later the drive says whether it runs, and the leases are looked at: the rank of the action that is
        /// written then, and where its answer goes.
        fn after(&mut self, ms: u64, runs: bool) -> Option<Command> {
            self.now += Duration::from_millis(ms);
            let now = self.now;
            let word = u16::from(runs) << 1;
            self.bus.image.drives[0].update(|s| s.store(Table::Holding, 2100, &[word], now));
            self.leases.look(&self.bus, now);
            assert!(self.bus.queue.lock().len() <= 1, "one at a time");
            self.bus.queue.lock().pop(Urgency::Read, now)
        }

        fn told(&self) -> usize {
            self.leases.events.recent().len()
        }
    }

    #[test]
    fn the_action_is_written_once_and_again_until_it_is_acknowledged() {
        for (action, urgency) in [
            (LeaseAction::Stop, Urgency::Stop),
            (LeaseAction::SpeedReference(20.0), Urgency::Command),
        ] {
            let mut bench = Bench::new(action);
            assert!(bench.after(60_000, true).is_none(), "nobody commanded it");
            bench.bus.image.drives[0].renew_lease(bench.now);
            assert!(bench.after(4_900, true).is_none());
            for failed in [
                Outcome::TimedOut,
                Outcome::Exception(Exception::BUSY),
                Outcome::QueueFull,
            ] {
                let command = bench.after(1_000, true).expect("the action");
                assert_eq!(command.urgency, urgency);
                assert!(bench.after(10, true).is_none(), "not while its answer is waited for");
                command.ticket.answer(failed, bench.now);
                assert!(bench.after(10, true).is_none(), "a pause first");
            }
            // Also when the drive was seen to stand meanwhile: nobody knows why.
            let command = bench.after(1_000, false).expect("the action");
            command.ticket.answer(Outcome::Acknowledged(Reply::Written), bench.now);
            for _ in 0..20 {
                assert!(bench.after(1_000, true).is_none(), "once");
            }
            assert_eq!(bench.told(), 1);
            assert_eq!(bench.bus.image.drives[0].supervisions(), 1);
        }
    }

    #[test]
    fn a_drive_that_stands_and_one_that_is_held_are_left_alone() {
        let mut bench = Bench::new(LeaseAction::Stop);
        bench.bus.image.drives[0].renew_lease(bench.now);
        assert!(bench.after(10_000, false).is_none());
        assert_eq!(bench.told(), 0);
        let mut bench = Bench::new(LeaseAction::Hold);
        bench.bus.image.drives[0].renew_lease(bench.now);
        assert!(bench.after(10_000, true).is_none());
        assert_eq!(bench.told(), 1);
    }
}
