//! The reports on the whole gateway to the service manager, the metrics and the events.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use sd_notify::NotifyState;
use tokio::time::{Interval, MissedTickBehavior};

use super::notify;
use crate::log::LogHandle;
use crate::printable;
use drivegate_core::event::{Event, EventKind};
use drivegate_core::plant::{Plant, SharedPlant};
use drivegate_gateway::daemon::{BusHeartbeats, Daemon};
use drivegate_http::messages::ReloadOutcome;
use drivegate_north::NorthState;

/// Longest status in characters, for one line of `systemctl status`.
const LONGEST_STATUS: usize = 300;

/// Serves the systemd watchdog and updates the status of the service.
#[derive(Debug)]
pub(super) struct Watch<'l> {
    log: &'l LogHandle,
    pulse: BusHeartbeats,
    plant: SharedPlant,
    stats: Arc<NorthState>,
    is_watched: bool,
    feed: Interval,
    /// When the last reload was refused, and why.
    refused: Option<(SystemTime, String)>,
    /// Status text that was sent to systemd last.
    status: String,
}

impl Watch<'_> {
    /// Watches a running gateway for systemd.
    pub(super) fn new<'l>(daemon: &Daemon, log: &'l LogHandle) -> Watch<'l> {
        let watchdog = sd_notify::watchdog_enabled();
        let every = watchdog.map_or(Duration::from_secs(5), |time| time / 2);
        let mut feed = tokio::time::interval(every.max(Duration::from_millis(500)));
        // Two looks right behind each other, after a pause of the machine, would take the buses for stalled.
        feed.set_missed_tick_behavior(MissedTickBehavior::Delay);
        Watch {
            log,
            pulse: daemon.pulse(),
            plant: daemon.plant(),
            stats: daemon.stats(),
            is_watched: watchdog.is_some(),
            feed,
            refused: None,
            status: String::new(),
        }
    }

    /// Waits for the next beat of the watchdog and handles it; cancel safe.
    pub(super) async fn tick(&mut self) {
        self.feed.tick().await;
        self.log.report_lost();
        if self.pulse.is_moving() && self.is_watched {
            notify(&[NotifyState::Watchdog]);
        }
        let status = status(&self.plant.load(), self.refused.as_ref());
        if status != self.status {
            notify(&[NotifyState::Status(&status)]);
            self.status = status;
        }
    }

    /// Notifies systemd that a reload begins.
    pub(super) fn reloading(&mut self) {
        let mut states = vec![NotifyState::Reloading];
        states.extend(NotifyState::monotonic_usec_now());
        notify(&states);
    }

    /// Notifies systemd that a reload has ended.
    pub(super) fn reloaded(&mut self, outcome: &ReloadOutcome) {
        let now = SystemTime::now();
        let why = summary(&outcome.errors);
        self.stats.reload.ended(why.is_none(), now);
        if let Some(why) = &why {
            self.plant.load().events.publish(Event::new(
                EventKind::ReloadRefused,
                now,
                format!("the configuration was not applied, the previous one stays: {why}"),
            ));
        }
        self.refused = why.map(|why| (now, why));
        self.status = status(&self.plant.load(), self.refused.as_ref());
        notify(&[NotifyState::Ready, NotifyState::Status(&self.status)]);
    }
}

/// The first error, and the number of further ones.
fn summary(errors: &[String]) -> Option<String> {
    let (first, others) = errors.split_first()?;
    Some(match others.len() {
        0 => first.clone(),
        more => format!("{first} (and {more} more)"),
    })
}

/// The status of the gateway in one line.
fn status(plant: &Plant, refused: Option<&(SystemTime, String)>) -> String {
    let up = plant.buses.iter().filter(|bus| bus.image.health().up).count();
    let images = || plant.buses.iter().flat_map(|bus| &bus.image.drives);
    let online = images().filter(|drive| drive.snapshot().link.is_online()).count();
    let mut text = format!(
        "{up} of {} buses up, {online} of {} drives online",
        plant.buses.len(),
        images().count()
    );
    if let Some((at, why)) = refused {
        let at = humantime::format_rfc3339_seconds(*at);
        text += &format!("; reload refused at {at}: {why}");
    }
    printable::line(&text).chars().take(LONGEST_STATUS).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refused_reload_stays_in_the_status() {
        let errors = ["`baud` is missing\nx", "b", "c"].map(str::to_string);
        assert_eq!(summary(&errors[1..2]), Some("b".to_string()));
        let plant = Plant::new("test", Duration::from_secs(1), Vec::new());
        assert_eq!(status(&plant, None), "0 of 0 buses up, 0 of 0 drives online");
        let refused = (SystemTime::UNIX_EPOCH, summary(&errors).unwrap());
        let text = status(&plant, Some(&refused));
        assert!(
            text.contains("; reload refused at 1970-01-01T00:00:00Z: `baud`"),
            "{text}"
        );
        assert!(text.ends_with("(and 2 more)") && !text.contains('\n'), "{text}");
        let endless = (SystemTime::UNIX_EPOCH, "x".repeat(1000));
        assert_eq!(status(&plant, Some(&endless)).chars().count(), LONGEST_STATUS);
    }
}
