//! Without a gateway: the command opens the port itself and is the master for a moment.

use std::time::{Duration, Instant};

use super::Target;
use super::gateway::NotFound;
use crate::command::{Origin, SourceKind};
use crate::config::{BusSettings, ParamsSettings, Settings};
use crate::daemon::Daemon;
use crate::drive::{Point, PollClass, Profile, Quality, Source};
use crate::north::local::protocol::{Outcome, Request, Word};
use crate::north::local::{SocketPath, answer};
use crate::plant::DriveHandle;
use crate::process_image::{OnShutdown, Reading};

/// Time to open the port, on a machine however busy; and how long one that cannot be opened is tried.
const OPEN: Duration = Duration::from_secs(10);
const TRIED: Duration = Duration::from_millis(750);
/// Time until the drive answers, beyond that of its tries.
const ANSWERS: Duration = Duration::from_secs(2);
/// Time for all points of a slow line.
const READ: Duration = Duration::from_secs(20);
/// Time between two looks at the image.
const LOOK: Duration = Duration::from_millis(5);

/// A bus of its own, with the one drive.
pub(super) struct Direct {
    daemon: Daemon,
    drive: DriveHandle,
}

impl Direct {
    /// Opens the port and waits until the drive answers.
    ///
    /// # Errors
    /// What is wrong, where, and what to do.
    pub(super) async fn start(target: &Target, not_found: &NotFound) -> Result<Direct, String> {
        let mut spec = target.spec.clone();
        // The drive keeps what was commanded when this process ends.
        spec.on_shutdown = OnShutdown::Hold;
        spec.supervision = None;
        let name = spec.name.clone();
        let all = target.settings.buses.iter();
        let all = all.flat_map(|bus| {
            bus.drives
                .iter()
                .map(|drive| (bus.spec.machine(drive), drive.name.clone()))
        });
        let params = ParamsSettings {
            others: all.filter(|(_, other)| *other != name).collect(),
            ..target.settings.params.clone()
        };
        let settings = Settings {
            params,
            buses: vec![BusSettings {
                drives: vec![spec],
                ..target.bus.clone()
            }],
            socket: SocketPath::Off,
            keeps_history: false,
            modbus_tcp: None,
            mqtt: None,
            http: None,
            ..target.settings.clone()
        };
        let daemon = Daemon::start(settings).await.map_err(|e| e.to_string())?;
        let drive = daemon.plant().load().drive(&name);
        let drive = drive.ok_or_else(|| format!("drive `{name}` is not configured; its bus; try again"))?;
        let direct = Direct { daemon, drive };
        match direct.reach(target, not_found).await {
            Ok(()) => Ok(direct),
            Err(why) => {
                direct.stop().await;
                Err(why)
            }
        }
    }

    async fn reach(&self, target: &Target, not_found: &NotFound) -> Result<(), String> {
        let health = || self.drive.bus.image.health();
        let begun = Instant::now();
        until(OPEN, || health().up || (health().tried && begun.elapsed() > TRIED)).await;
        if !health().up {
            let why = health().reason;
            return Err(format!(
                "{}; bus `{}`, port {}; if a gateway has the port: {}",
                why.as_deref().unwrap_or("it cannot be opened in time"),
                target.bus.spec.name,
                target.bus.spec.port,
                not_found.0
            ));
        }
        let options = &target.bus.options;
        let tries = ANSWERS + options.response_timeout * (options.retries + 1) * 4;
        let link = || self.drive.image.snapshot().link;
        until(tries, || link().is_online()).await;
        if !link().is_online() {
            let spec = &target.bus.spec;
            return Err(format!(
                "drive `{}` does not answer at address {}; {} {} on {}; check power, wiring and address, or let \
                 `drivegate scan` look for it",
                target.spec.name,
                target.spec.address,
                spec.protocol.name(),
                spec.format,
                spec.port
            ));
        }
        Ok(())
    }

    /// Carries the request out, once the drive has answered what it rests on.
    pub(super) async fn ask(&self, request: &Request) -> Outcome {
        let profile = &self.drive.image.spec.profile;
        let index = |name: &str| profile.point_index(name);
        let awaited: Vec<usize> = match request {
            Request::Read(request) if !request.points.is_empty() => {
                let of = |name: &String| match (index(name), Word::of(name)) {
                    (Some(index), _) => vec![index],
                    (None, Some(word)) => word
                        .sources()
                        .iter()
                        .filter_map(|point| profile.model_index(*point))
                        .collect(),
                    (None, None) => Vec::new(),
                };
                request.points.iter().flat_map(of).collect()
            }
            Request::Params(_) | Request::ParamsRestore(_) => profile.parameters.identification.clone(),
            // What a command is turned into, and whether it is needed at all, depends on what the drive has.
            Request::Write(request) if !request.points.iter().any(|set| is_derived(profile, index(&set.point))) => {
                Vec::new()
            }
            _ => (0..profile.points.len()).collect(),
        };
        let polled: Vec<usize> = awaited.into_iter().filter(|index| is_polled(profile, *index)).collect();
        until(READ, || {
            let reading = self.drive.reading(Instant::now());
            polled.iter().all(|index| is_settled(&reading, *index))
        })
        .await;
        answer(request, &self.daemon.plant(), origin(), Instant::now()).await
    }

    /// Closes the port.
    pub(super) async fn stop(self) {
        self.daemon.stop().await;
    }
}

fn origin() -> Origin {
    let user = std::env::var("SUDO_USER").or_else(|_| std::env::var("USER"));
    Origin::new(SourceKind::CommandLine, user.unwrap_or_else(|_| "unknown".to_string()))
}

fn is_derived(profile: &Profile, index: Option<usize>) -> bool {
    let point = index.and_then(|index| profile.points.get(index));
    point.is_some_and(|point| point.raw().is_none())
}

/// Whether the plan reads the point, or all that a derived one rests on.
fn is_polled(profile: &Profile, index: usize) -> bool {
    let read = |i: usize| profile.points.get(i).is_some_and(|p| p.class != PollClass::Never);
    match profile.points.get(index).map(|p| &p.source) {
        Some(Source::Derived(derived)) => derived.rests_on().into_iter().all(read),
        Some(Source::Raw(raw)) => read(index) && raw.scale_from.is_none_or(read),
        None => false,
    }
}

/// Whether the drive has answered or refused it.
fn is_settled(reading: &Reading<'_>, index: usize) -> bool {
    let sources = match reading.spec.profile.points.get(index).map(|p| &p.source) {
        Some(Source::Derived(derived)) => derived.rests_on(),
        Some(Source::Raw(raw)) => std::iter::once(index).chain(raw.scale_from).collect(),
        None => Vec::new(),
    };
    sources.into_iter().all(|source| {
        let raw = reading.spec.profile.points.get(source).and_then(Point::raw);
        reading.sample(source).quality == Quality::Good
            || raw.is_none_or(|raw| {
                let words = reading.words(raw.table, raw.address, raw.form.items());
                matches!(words, Ok(_) | Err(crate::process_image::Unavailable::Refused(_)))
            })
    })
}

/// Waits until `done`, for `most` at the longest.
async fn until(most: Duration, done: impl Fn() -> bool) {
    let end = Instant::now() + most;
    while !done() && Instant::now() < end {
        tokio::time::sleep(LOOK).await;
    }
}
