//! `drivegate replay`: plays a capture of a line through the code that listens, in virtual time.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::broadcast;

use super::failure::{self, Failure};
use super::{ConfigFile, EXIT_CONFIG, EXIT_DATA, report};
use drivegate_bus::listener::ListenCore;
use drivegate_core::event::{Event, Events};
use drivegate_core::history::capture::{self, Packet};
use drivegate_core::plant::BusHandle;
use drivegate_core::process_image::{BusImage, DriveImage, Outcome, public_points, value_or_null};
use drivegate_core::queue::CommandQueue;
use drivegate_gateway::config::{BusSettings, Settings, environment};

/// Largest capture that is read.
const MOST_BYTES: u64 = 1 << 30;
/// Time that passes after the last packet, so that its transaction can end.
const AFTERWARDS: Duration = Duration::from_millis(200);
/// Longest step of virtual time.
const STEP: Duration = Duration::from_millis(100);

/// Replays a capture of a serial line in virtual time, and prints events and final values.
///
/// Reads pcap and pcapng with link type RTAC Serial (250), as `drivegate trace --pcap` and `recordings export --pcap` write them, or
/// a USER link type (147 to 162), whose packets are bare bytes. Opens no port.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate replay line1.pcap --config drivegate.toml
  drivegate replay \
                        trip.pcapng --config drivegate.toml --bus line1

Exit codes: 0 played, 1 failure, 2 wrong \
                        command line, 65 no valid capture, 78 invalid configuration.")]
pub(super) struct Args {
    /// The capture.
    #[arg(value_name = "FILE")]
    capture: PathBuf,
    #[command(flatten)]
    config: ConfigFile,
    /// The bus of the configuration that it was captured on [default: the only one].
    #[arg(long, value_name = "NAME")]
    bus: Option<String>,
}

pub(super) fn run(args: &Args) -> failure::Outcome {
    let loaded = Settings::load(&args.config.path, environment());
    let Some(settings) = &loaded.settings else {
        report::problems(&loaded);
        return Err(Failure::Reported(EXIT_CONFIG));
    };
    let bus = chosen(settings, args.bus.as_deref()).map_err(Failure::Misused)?;
    let file = read(&args.capture)?;
    let packets = match capture::read(&file) {
        Ok(capture) => {
            if let Some(error) = capture.broken {
                report::warning(&format!(
                    "the capture is read up to a damaged part: {error}; {}; the rest is ignored",
                    args.capture.display()
                ));
            }
            capture.packets
        }
        Err(error) => {
            report::error(&format!(
                "cannot read the capture: {error}; {}; make it with `drivegate trace --pcap`, or in the same format",
                args.capture.display()
            ));
            return Err(Failure::Reported(EXIT_DATA));
        }
    };
    Ok(report::print(&play(bus, &packets, settings.stale_after.limit)?))
}

fn read(path: &Path) -> Result<Vec<u8>, String> {
    let failed = |error: &dyn std::fmt::Display| format!("cannot read the capture: {error}; {}", path.display());
    let size = std::fs::metadata(path).map_err(|error| failed(&error))?.len();
    if size > MOST_BYTES {
        return Err(failed(&format!("it has {size} bytes; cut it to {MOST_BYTES} or less")));
    }
    std::fs::read(path).map_err(|error| failed(&error))
}

fn chosen<'s>(settings: &'s Settings, name: Option<&str>) -> Result<&'s BusSettings, String> {
    let names = || {
        let names: Vec<&str> = settings.buses.iter().map(|bus| bus.spec.name.as_str()).collect();
        names.join(", ")
    };
    match (name, settings.buses.as_slice()) {
        (None, [only]) => Ok(only),
        (None, _) => Err(format!(
            "the configuration has several buses; --bus; name one of {}",
            names()
        )),
        (Some(name), buses) => buses
            .iter()
            .find(|bus| bus.spec.name == name)
            .ok_or_else(|| format!("there is no bus `{name}`; --bus; name one of {}", names())),
    }
}

/// A capture in progress.
struct Player {
    core: ListenCore,
    image: Arc<BusImage>,
    events: broadcast::Receiver<Arc<Event>>,
    began: Instant,
    text: String,
}

/// Replays the packets; returns the events as they occur, then the last values.
fn play(bus: &BusSettings, packets: &[Packet], stale_after: Duration) -> Result<String, String> {
    let began = Instant::now();
    let image = |spec| Arc::new(DriveImage::new(spec, Duration::ZERO));
    let drives = bus.drives.iter().cloned().map(image).collect();
    let image = Arc::new(BusImage::new(bus.spec.clone(), drives));
    let queue = CommandQueue::new().map_err(|error| format!("cannot start: {error}; free file descriptors"))?;
    let handle = BusHandle::new(image.clone(), Arc::new(queue), Arc::default());
    let events = Events::default();
    let receiver = events.subscribe();
    let core = ListenCore::new(handle, &bus.options, events, began);
    let mut player = Player {
        core,
        image,
        events: receiver,
        began,
        text: String::new(),
    };
    player.core.opened(began);
    let first = packets.first().map_or(Duration::ZERO, |packet| packet.at);
    let mut now = Duration::ZERO;
    for packet in packets {
        // For a request, the capture has the time when the port accepted it, so the wire time is added.
        let wire = if packet.sent {
            bus.spec.format.chars(packet.bytes.len())
        } else {
            Duration::ZERO
        };
        let at = packet.at.saturating_sub(first) + wire;
        player.wait(&mut now, at);
        player.core.on_bytes(&packet.bytes, began + now);
        player.report(now);
    }
    let end = now;
    player.wait(&mut now, end + AFTERWARDS);
    player.values(end, stale_after);
    Ok(player.text)
}

impl Player {
    /// Advances the time from `now` to `until`; the time never goes back, whatever the capture contains.
    fn wait(&mut self, now: &mut Duration, until: Duration) {
        while *now < until {
            let wake = self
                .core
                .on_time(self.began + *now)
                .saturating_duration_since(self.began);
            *now = wake.clamp(*now + Duration::from_micros(1), *now + STEP).min(until);
            self.report(*now);
        }
        self.core.on_time(self.began + *now);
        self.report(*now);
    }

    fn report(&mut self, now: Duration) {
        while let Ok(event) = self.events.try_recv() {
            // Writing to a string cannot fail.
            let _ = writeln!(
                self.text,
                "{:>12.6} s  {}: {}",
                now.as_secs_f64(),
                event.kind.name(),
                event.text
            );
        }
    }

    fn values(&mut self, at: Duration, stale_after: Duration) {
        let mut table = report::table(["drive", "point", "value", "unit", "quality"]);
        for drive in &self.image.drives {
            let reading = drive.reading(self.began + at, stale_after);
            let profile = &drive.spec.profile;
            for (index, name) in public_points(profile) {
                let sample = reading.sample(index);
                // Points that were never received get no row.
                let Some(value) = sample.value else { continue };
                let unit = profile.points.get(index).map_or("", |point| point.unit.as_str());
                table.add_row([
                    drive.spec.name.clone(),
                    name.to_string(),
                    value_or_null(Some(value)).to_string(),
                    unit.to_string(),
                    sample.quality.name().to_string(),
                ]);
            }
        }
        table.align_right(2);
        let counted = |outcome| {
            self.image
                .drives
                .iter()
                .map(|drive| drive.counted(outcome))
                .sum::<u64>()
        };
        let health = self.image.health();
        let _ = write!(self.text, "\n{}", report::lines(&table));
        let _ = writeln!(
            self.text,
            "\n{:.3} s: {} answered, {} refused, {} unanswered, {} damaged or doubtful, {} fragments outside \
             transactions",
            at.as_secs_f64(),
            counted(Outcome::Ok),
            counted(Outcome::Exception),
            counted(Outcome::Timeout),
            counted(Outcome::Corrupt),
            health.foreign,
        );
        let unknown: Vec<String> = health.unknown.iter().flatten().map(u8::to_string).collect();
        if !unknown.is_empty() {
            let _ = writeln!(
                self.text,
                "addresses without an entry that answer: {}",
                unknown.join(", ")
            );
        }
    }
}
