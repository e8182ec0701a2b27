//! Access without a gateway: the command opens the port itself and is the master for a short time.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::Configured;
use crate::client::{Client, Door};
use drivegate_core::history::RecorderOptions;
use drivegate_core::plant::DriveHandle;
use drivegate_core::process_image::{OnShutdown, Reading};
use drivegate_gateway::config::{BusSettings, ParamsSettings, Settings, StateFiles, WithoutGateway};
use drivegate_gateway::daemon::Daemon;
use drivegate_http::InProcess;
use drivegate_http::local::SocketPath;
use drivegate_http::messages::Word;
use drivegate_model::drive::{Point, PointIndex, PollClass, Profile, Quality, Source};

/// Time to open the port, on a machine however busy; and how long one that cannot be opened is tried.
const OPEN: Duration = Duration::from_secs(10);
const TRIED: Duration = Duration::from_millis(750);
/// Time until the drive answers, in addition to the time of its tries.
const ANSWERS: Duration = Duration::from_secs(2);
/// Time for all points of a slow line.
const READ: Duration = Duration::from_secs(20);
/// Time between two looks at the image.
const LOOK: Duration = Duration::from_millis(5);

/// Cycle of process data while the line is needed for parameters.
const RESTFUL: Duration = Duration::from_secs(1);

/// Values of the drive that the bus must have read before a request is carried out.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Needs<'n> {
    /// All points that are polled.
    All,
    /// The points with these names.
    Points(&'n [String]),
    /// The points into which commands of the named points are translated: all polled points, if a command is derived.
    Commands(&'n [String]),
    /// The identification of the drive, needed for its parameters.
    Identification,
}

/// A bus that only this command uses, with the one drive.
pub(super) struct Direct {
    daemon: Daemon,
    drive: DriveHandle,
}

impl Direct {
    /// Opens the port and waits until the drive has answered and the values that the request needs have been read.
    ///
    /// # Errors
    /// If the bus cannot be started: contains the message with place and remedy.
    pub(super) async fn start(target: &Configured, needs: Needs<'_>, not_found: &str) -> Result<Direct, String> {
        let mut spec = target.spec.clone();
        let mut bus = target.bus.clone();
        if let Needs::Identification = needs {
            // No process data is shown, so the cycle may be slow.
            bus.spec.cycle = RESTFUL.max(bus.spec.cycle);
        }
        // The drive keeps its last command when this process ends.
        spec.on_shutdown = OnShutdown::LeaveRunning;
        spec.supervision = None;
        let name = spec.name.clone();
        let all = target.settings.buses.iter();
        let all = all.flat_map(|bus| {
            bus.drives
                .iter()
                .map(|drive| (bus.spec.machine(drive), drive.name.clone()))
        });
        let params = ParamsSettings {
            every: None,
            others: all.filter(|(_, other)| *other != name).collect(),
            ..target.settings.params.clone()
        };
        let settings = Settings {
            params,
            buses: vec![BusSettings {
                drives: vec![spec],
                ..bus
            }],
            ..serving_nobody(&target.settings, matches!(needs, Needs::Commands(_)))
        };
        let daemon = Daemon::start(settings).await.map_err(|e| e.to_string())?;
        let drive = daemon.plant().load().drive(&name);
        let drive = drive.ok_or_else(|| format!("drive `{name}` is not configured; its bus; try again"))?;
        let direct = Direct { daemon, drive };
        match direct.reach(target, not_found).await {
            Ok(()) => {
                direct.settled(needs).await;
                Ok(direct)
            }
            Err(why) => {
                direct.stop().await;
                Err(why)
            }
        }
    }

    async fn reach(&self, target: &Configured, not_found: &str) -> Result<(), String> {
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
                not_found
            ));
        }
        let options = &target.bus.options;
        let tries = ANSWERS + options.response_timeout * (options.retries + 1) * 4;
        let link = || self.drive.image.snapshot().link;
        until(tries, || link().is_online()).await;
        if !link().is_online() {
            let spec = &target.bus.spec;
            return Err(format!(
                "drive `{}` does not reply at address {}; {} {} on {}; check power, wiring and address, or let \
                 `drivegate scan --port {}` look for it",
                target.spec.name,
                target.spec.address,
                spec.protocol.name(),
                spec.format,
                spec.port,
                spec.port
            ));
        }
        Ok(())
    }

    async fn settled(&self, needs: Needs<'_>) {
        let profile = &self.drive.image.spec.profile;
        let index = |name: &str| profile.point_index(name);
        let awaited: Vec<PointIndex> = match needs {
            Needs::Points(names) if !names.is_empty() => {
                let of = |name: &String| match (index(name), Word::of(name)) {
                    (Some(index), _) => vec![index],
                    (None, Some(word)) => word
                        .sources()
                        .iter()
                        .filter_map(|point| profile.model_index(*point))
                        .collect(),
                    (None, None) => Vec::new(),
                };
                names.iter().flat_map(of).collect()
            }
            Needs::Identification => profile.parameters.identification.clone(),
            Needs::Commands(names) if !names.iter().any(|name| is_derived(profile, index(name))) => Vec::new(),
            _ => profile.points.indexes().collect(),
        };
        let polled: Vec<PointIndex> = awaited.into_iter().filter(|index| is_polled(profile, *index)).collect();
        until(READ, || {
            let reading = self.drive.reading(Instant::now());
            polled.iter().all(|index| is_settled(&reading, *index))
        })
        .await;
    }

    /// A client for this bus.
    pub(super) fn client(&self) -> Client {
        let user = std::env::var("SUDO_USER").or_else(|_| std::env::var("USER"));
        let user = user.unwrap_or_else(|_| "unknown".to_string());
        let door = InProcess::new(&self.daemon.plant(), &self.daemon.stats(), &user);
        Client::through(Door::InProcess(Arc::new(door)))
    }

    /// Closes the port and ends the bus.
    pub(super) async fn stop(self) {
        self.daemon.stop().await;
    }
}

/// The configuration without servers, drills and recordings: the command is the only client, and what the gateway left
/// on disk stays for the gateway.
fn serving_nobody(settings: &Settings, starts: bool) -> Settings {
    let is_any_guarded = settings.drives().any(|(_, drive)| drive.guard.is_some());
    let counted = settings
        .drives()
        .filter(|(_, drive)| is_any_guarded && drive.counts_starts());
    let rest = WithoutGateway {
        bacnet: settings.bacnet.clone(),
        groups: counted
            .map(|(bus, drive)| (bus.machine(drive), drive.starts_with()))
            .collect(),
        starts,
    };
    Settings {
        socket: SocketPath::Off,
        state_files: StateFiles::Obeyed(Box::new(rest)),
        recordings: RecorderOptions {
            max_count: 0,
            ..settings.recordings.clone()
        },
        slots: None,
        modbus_tcp: None,
        mqtt: None,
        http: None,
        bacnet: None,
        drill: None,
        ..settings.clone()
    }
}

fn is_derived(profile: &Profile, index: Option<PointIndex>) -> bool {
    let point = index.and_then(|index| profile.points.get(index));
    point.is_some_and(|point| point.raw().is_none())
}

/// Whether the plan reads the point, or all that a derived one rests on.
fn is_polled(profile: &Profile, index: PointIndex) -> bool {
    let read = |i: PointIndex| profile.points.get(i).is_some_and(|p| p.class != PollClass::Never);
    match profile.points.get(index).map(|p| &p.source) {
        Some(Source::Derived(derived)) => derived.rests_on().into_iter().all(read),
        Some(Source::Raw(raw)) => read(index) && raw.scaled_by().all(read),
        None => false,
    }
}

/// Whether the drive has answered or refused the read of the point.
fn is_settled(reading: &Reading<'_>, index: PointIndex) -> bool {
    let sources = match reading.spec.profile.points.get(index).map(|p| &p.source) {
        Some(Source::Derived(derived)) => derived.rests_on(),
        Some(Source::Raw(raw)) => std::iter::once(index).chain(raw.scaled_by()).collect(),
        None => Vec::new(),
    };
    sources.into_iter().all(|source| {
        let raw = reading.spec.profile.points.get(source).and_then(Point::raw);
        reading.sample(source).quality == Quality::Good
            || raw.is_none_or(|raw| {
                let words = reading.words(raw.table, raw.address, raw.form.items());
                matches!(
                    words,
                    Ok(_) | Err(drivegate_core::process_image::Unavailable::Refused(_))
                )
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
