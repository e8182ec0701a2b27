//! Without a gateway: the command opens the port itself and is the master for a moment.

use std::time::{Duration, Instant};

use super::{Row, Target};
use crate::cache::{OnShutdown, Reading};
use crate::codec::{Reply, RequestPdu};
use crate::command::{Answer, Authority, DEFAULT_EXPIRY, Order, Origin, Outcome, SourceKind};
use crate::config::{BusSettings, Settings};
use crate::daemon::Daemon;
use crate::drive::{Point, PollClass, Profile, Quality, Sample, Value};
use crate::plant::{DriveHandle, Placed};

/// Time to open the port.
const OPEN: Duration = Duration::from_millis(1500);
/// Time until the drive is seen, beyond that of its tries.
const SEEN: Duration = Duration::from_secs(2);
/// Time for all points of a slow line.
const READ: Duration = Duration::from_secs(20);
/// How often is looked.
const LOOK: Duration = Duration::from_millis(5);

/// A bus of its own, with the one drive.
pub(in crate::cli) struct Alone {
    daemon: Daemon,
    drive: DriveHandle,
}

impl Alone {
    /// Opens the port and waits until the drive answers.
    ///
    /// # Errors
    /// What is wrong, where, and what to do.
    pub(in crate::cli) async fn start(target: &Target) -> Result<Alone, String> {
        let mut spec = target.spec.clone();
        // What was commanded stays as it is when the command ends.
        spec.on_shutdown = OnShutdown::Hold;
        spec.supervision = None;
        let name = spec.name.clone();
        let settings = Settings {
            buses: vec![BusSettings {
                drives: vec![spec],
                ..target.bus.clone()
            }],
            modbus_tcp: None,
            mqtt: None,
            http: None,
            ..target.settings.clone()
        };
        let daemon = Daemon::start(settings).await.map_err(|e| e.to_string())?;
        let drive = daemon
            .plant()
            .load()
            .drive(&name)
            .ok_or("the drive is gone; its bus; try again")?;
        let alone = Alone { daemon, drive };
        match alone.reach(target).await {
            Ok(()) => Ok(alone),
            Err(why) => {
                alone.stop().await;
                Err(why)
            }
        }
    }

    async fn reach(&self, target: &Target) -> Result<(), String> {
        let health = || self.drive.bus.image.health();
        let begun = Instant::now();
        until(OPEN, || health().up || (health().tried && begun.elapsed() > OPEN / 2)).await;
        if !health().up {
            let why = health()
                .reason
                .unwrap_or_else(|| "it cannot be opened in time".to_string());
            return Err(format!(
                "{why}; bus `{}`, port {}; where a gateway owns the port, {}",
                target.bus.spec.name,
                target.bus.spec.port,
                through_the_gateway(target)
            ));
        }
        let options = &target.bus.options;
        let tries = SEEN + options.response_timeout * (options.retries + 1) * 4;
        let seen = || self.drive.image.snapshot().link;
        until(tries, || seen().is_online()).await;
        if !seen().is_online() {
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

    /// The points with their values: polled ones as they come, others by a request each.
    pub(in crate::cli) async fn read(&self, points: &[usize]) -> Vec<Row> {
        let profile = self.drive.image.spec.profile.clone();
        let polled = |index: &usize| is_polled(&profile, *index);
        until(READ, || {
            let reading = self.reading();
            points.iter().filter(|p| polled(p)).all(|p| is_settled(&reading, *p))
        })
        .await;
        let mut rows = Vec::with_capacity(points.len());
        for &index in points {
            let Some(point) = profile.points.get(index) else {
                continue;
            };
            rows.push(match (point.raw(), polled(&index)) {
                (Some(raw), false) => {
                    let pdu = RequestPdu::Read {
                        table: raw.table,
                        start: raw.address,
                        count: raw.form.items(),
                    };
                    let answer = self.order(Order::Read(pdu)).await;
                    asked(point, raw, answer)
                }
                _ => Row::new(
                    point,
                    &self.reading().sample(index),
                    Some("the drive does not tell it".to_string()),
                ),
            });
        }
        rows
    }

    fn reading(&self) -> Reading<'_> {
        self.drive.reading(Instant::now())
    }

    async fn order(&self, order: Order) -> Answer {
        self.place(order, READ).answered().await
    }

    fn place(&self, order: Order, expiry: Duration) -> Placed {
        self.drive
            .place(order, origin(), Authority::Write, expiry, Instant::now())
    }

    /// Commands the points as one command.
    pub(in crate::cli) async fn write(&self, values: Vec<(usize, Value)>) -> (Answer, Option<Duration>) {
        let points: Vec<usize> = values.iter().map(|(index, _)| *index).collect();
        // What a command is turned into, and whether it is needed at all, depends on what the drive has.
        self.read_bases(&points).await;
        let mut placed = self.place(Order::Points(values), DEFAULT_EXPIRY);
        (placed.answered().await, placed.confirmed().await)
    }

    /// Waits for what derived points rest on, such as the frequency range.
    async fn read_bases(&self, points: &[usize]) {
        let profile = &self.drive.image.spec.profile;
        let all: Vec<usize> = (0..profile.points.len()).filter(|p| is_polled(profile, *p)).collect();
        let derived = points
            .iter()
            .any(|p| profile.points.get(*p).is_some_and(|point| point.raw().is_none()));
        if derived {
            until(READ, || {
                let reading = self.reading();
                all.iter().all(|p| is_settled(&reading, *p))
            })
            .await;
        }
    }

    /// Closes the port.
    pub(in crate::cli) async fn stop(self) {
        self.daemon.stop().await;
    }
}

/// What lets the command go through the gateway that owns the port.
fn through_the_gateway(target: &Target) -> String {
    let bus = &target.bus.spec.name;
    let listens = target.listens();
    let Some(options) = &target.settings.modbus_tcp else {
        return "give it [modbus_tcp]: then this command goes through it".to_string();
    };
    if let Some(address) = listens.first() {
        return format!("name its file by --config: no gateway answers at {address}, where that of this file would");
    }
    if options.listeners.is_empty() {
        return "give [modbus_tcp] a `listen`: then this command goes through it; it cannot be asked over TLS"
            .to_string();
    }
    format!("let a listener of [modbus_tcp] without TLS show `{bus}` (`buses`): then this command goes through it")
}

fn origin() -> Origin {
    let user = std::env::var("SUDO_USER").or_else(|_| std::env::var("USER"));
    Origin::new(SourceKind::CommandLine, user.unwrap_or_else(|_| "unknown".to_string()))
}

/// Whether the plan reads the point, or all that a derived one rests on.
fn is_polled(profile: &Profile, index: usize) -> bool {
    let read = |i: usize| profile.points.get(i).is_some_and(|p| p.class != PollClass::Never);
    match profile.points.get(index).map(|p| &p.source) {
        Some(crate::drive::Source::Derived(derived)) => derived.rests_on().into_iter().all(read),
        Some(crate::drive::Source::Raw(_)) => read(index),
        None => false,
    }
}

/// Whether the drive has told it, or has refused to.
fn is_settled(reading: &Reading<'_>, index: usize) -> bool {
    let sources = match reading.spec.profile.points.get(index).map(|p| &p.source) {
        Some(crate::drive::Source::Derived(derived)) => derived.rests_on(),
        _ => vec![index],
    };
    sources.into_iter().all(|source| {
        let raw = reading.spec.profile.points.get(source).and_then(Point::raw);
        reading.sample(source).quality == Quality::Good
            || raw.is_none_or(|raw| {
                let words = reading.words(raw.table, raw.address, raw.form.items());
                matches!(words, Ok(_) | Err(crate::cache::Unavailable::Refused(_)))
            })
    })
}

fn asked(point: &Point, raw: &crate::drive::Raw, answer: Answer) -> Row {
    let words: Option<Vec<u16>> = match &answer.outcome {
        Outcome::Acknowledged(Reply::Registers(words)) => Some(words.clone()),
        Outcome::Acknowledged(Reply::Bits(bits)) => Some(bits.iter().map(|b| u16::from(*b)).collect()),
        _ => None,
    };
    let value = words.and_then(|words| raw.decode(&words, point.kind()));
    let sample = Sample {
        value,
        quality: if value.is_some() { Quality::Good } else { Quality::Bad },
        at: None,
    };
    Row::new(point, &sample, Some(answer.outcome.to_string()))
}

/// Waits until `done`, for `most` at the longest.
async fn until(most: Duration, done: impl Fn() -> bool) {
    let end = Instant::now() + most;
    while !done() && Instant::now() < end {
        tokio::time::sleep(LOOK).await;
    }
}
