//! The configured stops when the gateway ends, and what is said of drives that did not get theirs.

use std::time::{Duration, Instant, SystemTime};

use super::Daemon;
use drivegate_core::event::{Event, EventKind};
use drivegate_core::plant::BusHandle;
use drivegate_core::process_image::{Access, DriveSpec, OnShutdown};
use drivegate_core::queue::NotStopped;

/// Additional time for a bus to report the result of its stop commands at shutdown.
const STOP_SLACK: Duration = Duration::from_millis(300);

impl Daemon {
    /// Stops the drives with `on_shutdown = "stop"`; each bus has the time that its line needs for this.
    pub(super) async fn stop_drives(&self) {
        let now = Instant::now();
        let stops = self.buses.iter().map(|(settings, task)| {
            let time = settings.shutdown_time().unanswered;
            let missing = task.handle().queue.begin_shutdown(now + time, now);
            async move {
                // A bus whose port is closed does not report, nor one whose line is in use until the end.
                let missing = tokio::time::timeout(time + STOP_SLACK, missing).await;
                let missing: Vec<NotStopped> = missing.ok().and_then(Result::ok).unwrap_or_else(|| {
                    let stop = |d: &&DriveSpec| d.on_shutdown == OnShutdown::Stop && d.access == Access::Control;
                    let wanted = settings.drives.iter().filter(stop);
                    let why = if task.handle().image.is_up() {
                        "did not acknowledge its stop in time"
                    } else {
                        "was not sent its stop command: its bus is down"
                    };
                    wanted
                        .map(|d| NotStopped {
                            drive: d.name.clone(),
                            why: why.to_string(),
                        })
                        .collect()
                });
                missing.iter().for_each(|one| self.stop_failed(task.handle(), one));
                missing
            }
        });
        let missing: Vec<NotStopped> = futures_util::future::join_all(stops)
            .await
            .into_iter()
            .flatten()
            .collect();
        if !missing.is_empty() {
            tracing::error!(
                target: "drivegate::daemon", "not every drive acknowledged its stop command in time; shutting down anyway: {}",
                missing.iter().map(NotStopped::to_string).collect::<Vec<_>>().join(", ")
            );
        }
    }

    /// Publishes and counts that a drive was not stopped.
    fn stop_failed(&self, bus: &BusHandle, missing: &NotStopped) {
        let NotStopped { drive, why } = missing;
        let image = bus.image.drives.iter().find(|image| image.spec.name == *drive);
        image.into_iter().for_each(|image| image.count_supervision_failure());
        let text = format!("the gateway is shutting down, and drive {drive} {why}; nothing stops it from now on");
        self.events.publish(Event {
            bus: bus.image.spec.name.clone(),
            drive: Some(drive.clone()),
            ..Event::new(EventKind::SupervisionFailed, SystemTime::now(), text)
        });
    }
}
