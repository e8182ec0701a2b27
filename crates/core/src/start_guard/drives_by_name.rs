//! The drives that interlocks depend on, also across reloads. Pure: time is an argument.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::process_image::{DriveImage, Machine};

/// Time for which a drive keeps its earlier state here after its bus was restarted, until it is read for the first time.
const FIRST_READ: Duration = Duration::from_secs(10);

/// The drives of all buses, by name.
#[derive(Debug, Clone, Default)]
pub(super) struct DrivesByName {
    drives: BTreeMap<String, Watched>,
    pub(super) stale_after: Duration,
}

/// A drive on which interlocks depend.
#[derive(Debug, Clone)]
pub(super) struct Watched {
    machine: Machine,
    pub(super) image: Arc<DriveImage>,
    anew: Option<BusRestart>,
}

/// The last restart of the drive's bus.
#[derive(Debug, Clone)]
pub(super) struct BusRestart {
    /// When the previous bus had ended.
    pub(super) since: Instant,
    /// The previous state of the machine; `None` if it was not configured before.
    pub(super) before: Option<Arc<Watched>>,
}

impl DrivesByName {
    /// The state after a change to these drives.
    pub(super) fn follow(
        &self,
        drives: impl IntoIterator<Item = (Machine, Arc<DriveImage>)>,
        stale_after: Duration,
        now: Instant,
    ) -> DrivesByName {
        let watched = |(machine, image): (Machine, Arc<DriveImage>)| {
            let before = self.drives.values().find(|before| before.machine == machine);
            let anew = match before {
                Some(before) if Arc::ptr_eq(&before.image, &image) => before.anew.clone(),
                Some(before) => Some(before.expected().cloned().unwrap_or_else(|| before.left(now))),
                None => Some(BusRestart {
                    since: now,
                    before: None,
                }),
            };
            (image.spec.name.clone(), Watched { machine, image, anew })
        };
        DrivesByName {
            drives: drives.into_iter().map(watched).collect(),
            stale_after,
        }
    }

    /// The state while the buses of these drives are restarted.
    pub(super) fn expecting(&self, drives: &[Arc<DriveImage>], now: Instant) -> DrivesByName {
        let mut next = self.clone();
        let is_meant = |watched: &&mut Watched| drives.iter().any(|image| Arc::ptr_eq(image, &watched.image));
        for watched in next.drives.values_mut().filter(is_meant) {
            watched.anew = Some(watched.left(now));
        }
        next
    }

    pub(super) fn drive(&self, name: &str) -> Option<&Watched> {
        self.drives.get(name)
    }
}

impl Watched {
    /// The state that a bus leaves to the bus that replaces it.
    fn left(&self, now: Instant) -> BusRestart {
        let anew = self.anew.clone().filter(|anew| anew.is_recent(now));
        let before = Watched { anew, ..self.clone() };
        BusRestart {
            since: now,
            before: Some(Arc::new(before)),
        }
    }

    /// The announced end of the drive's bus, if another bus will replace it.
    fn expected(&self) -> Option<&BusRestart> {
        let is_same = |before: &Arc<Watched>| Arc::ptr_eq(&before.image, &self.image);
        self.anew
            .as_ref()
            .filter(|anew| anew.before.as_ref().is_some_and(is_same))
    }

    /// Whether another bus will replace the drive's bus.
    pub(super) fn is_leaving(&self) -> bool {
        self.expected().is_some()
    }

    /// The last restart of its bus, while the first reading after it may still be expected.
    pub(super) fn anew(&self, now: Instant) -> Option<&BusRestart> {
        self.anew.as_ref().filter(|anew| anew.is_recent(now))
    }
}

impl BusRestart {
    fn is_recent(&self, now: Instant) -> bool {
        now < self.since + FIRST_READ
    }
}
