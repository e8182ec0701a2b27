//! `drivegate check`: reports errors in a configuration and predicts the load of its buses.

mod as_service;
mod privileged;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, SystemTime};

use serde::Serialize;

pub(crate) use as_service::group_remedy;

use super::failure::{Failure, Outcome};
use super::{EXIT_CONFIG, NamedConfig, report};
use drivegate_bus::predict::{PredictedRequest, Prediction};
use drivegate_bus::proof;
use drivegate_core::drill::{Kind, SavedDrills, ways};
use drivegate_core::files::State as _;
use drivegate_core::files::names::DRILLS;
use drivegate_core::history::trend::Reach;
use drivegate_core::process_image::{Access, DriveSpec};
use drivegate_gateway::config::memory::{BusMemory, Memory};
use drivegate_gateway::config::{BusSettings, Loaded, Settings, environment};
use drivegate_model::document::format_duration;
use drivegate_model::document::{Finding, Problem};
use drivegate_model::drive::raw_writes;
use drivegate_north::parameter_jobs::orphans;
use drivegate_north::slot::Slot;

/// Checks a configuration and predicts wire times, cycles and load of each bus.
///
/// Opens only the files that the configuration names, and the journals of restores in the state directory. Errors and
/// warnings go to stderr, with --json to stdout with everything else.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  drivegate check --config /etc/drivegate/drivegate.toml\n  \
    sudo drivegate check --as-service\n  \
    drivegate check --config drivegate.toml --json | jq '.buses[] | {name, load_ratio, fast_cycle_ms}'"
)]
pub(super) struct Args {
    #[command(flatten)]
    config: NamedConfig,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
    /// Also report the files that the user of the systemd service could not read, by permissions and groups.
    #[arg(long)]
    as_service: bool,
}

#[derive(Serialize)]
struct Report<'a> {
    ok: bool,
    errors: &'a [Problem],
    warnings: &'a [Problem],
    /// Memory that the gateway takes at most, with every ring full.
    memory_bytes: Option<usize>,
    buses: Vec<Bus<'a>>,
}

#[derive(Serialize)]
struct Bus<'a> {
    name: &'a str,
    load_ratio: f64,
    fast_cycle_ms: Option<f64>,
    slow_cycle_ms: Option<f64>,
    /// Share of the line that refreshes take; absent if the line has no refreshes.
    #[serde(skip_serializing_if = "Option::is_none")]
    refresh_ratio: Option<f64>,
    /// Duration of the stops at shutdown if all drives reply, and if none does.
    shutdown_ms: f64,
    shutdown_worst_ms: f64,
    /// Memory that the recorder takes at most.
    recorder_bytes: usize,
    /// Memory that the trends of its drives and the last hour of the line take at most.
    trend_bytes: usize,
    /// Addresses of drives that may be commanded which `raw_writes` excludes.
    raw_writes_refused: Vec<Refused<'a>>,
    requests: Vec<Request<'a>>,
}

#[derive(Serialize)]
struct Refused<'a> {
    drive: &'a str,
    table: &'static str,
    first: u16,
    last: u16,
}

#[derive(Serialize)]
struct Request<'a> {
    drive: &'a str,
    class: &'static str,
    function: u8,
    address: u16,
    count: u16,
    wire_ms: f64,
}

pub(super) fn run(args: &Args) -> Outcome {
    let path = args.config.path();
    let mut loaded = Settings::load_proved(path, environment());
    if args.as_service {
        loaded.errors.extend(as_service::problems(path));
        loaded.settings = loaded.settings.filter(|_| loaded.errors.is_empty());
    }
    if let Some(settings) = &loaded.settings {
        loaded.warnings.extend(orphaned_journals(settings));
        loaded.warnings.extend(unproven_stops(settings));
        let capable = if args.as_service {
            as_service::may_listen_on_privileged_ports()
        } else {
            privileged::may()
        };
        loaded.warnings.extend(privileged::problems(path, settings, capable));
    }
    let printed = if args.json {
        report::print(&json(&loaded))
    } else {
        report::problems(&loaded);
        match &loaded.settings {
            Some(settings) => report::print(&text(path, settings, loaded.warnings.len())),
            None => ExitCode::SUCCESS,
        }
    };
    match loaded.settings {
        Some(_) => Ok(printed),
        None => Err(Failure::Reported(EXIT_CONFIG)),
    }
}

/// Restores of parameters that were interrupted and belong to no drive of this configuration. A state directory that only the gateway
/// may read is not an error of the configuration.
fn orphaned_journals(settings: &Settings) -> Vec<Problem> {
    let orphans = orphans(&settings.params.dir, settings.drives())
        .unwrap_or_default()
        .into_iter();
    let problem = |(path, what, remedy): (PathBuf, String, &str)| {
        Problem::of_file(path.display().to_string(), "", Finding::new(what, remedy))
    };
    orphans.map(problem).collect()
}

/// Warns about drives with drills whose stops were not proven by a drill, or not recently.
fn unproven_stops(settings: &Settings) -> Option<Problem> {
    let options = settings.drill?;
    let path = settings.state_dir.join(DRILLS);
    let problem =
        |what: String, remedy: String| Problem::of_file(path.display().to_string(), "", Finding::new(what, remedy));
    let saved = match SavedDrills::load(&path) {
        Ok(saved) => saved.unwrap_or_default(),
        Err(why) => {
            return Some(problem(
                format!("the results of drills cannot be read: {why}"),
                "run check as the gateway's user".to_string(),
            ));
        }
    };
    let unproven: Vec<String> = settings
        .drives()
        .filter_map(|(bus, drive)| {
            let missing = saved.unproven(&bus.machine(drive), &ways(drive), options.every, SystemTime::now());
            let missing: Vec<&str> = missing.into_iter().map(Kind::name).collect();
            (!missing.is_empty()).then(|| format!("{} ({})", drive.name, missing.join(", ")))
        })
        .collect();
    let first = unproven.first()?.split(' ').next().unwrap_or_default().to_string();
    let what = format!("stops not proven by a drill within `every`: {}", unproven.join(", "));
    Some(problem(
        what,
        format!("run `drivegate drill {first}`, and so on, at the machine"),
    ))
}

fn json(loaded: &Loaded) -> String {
    let memory = loaded
        .settings
        .as_ref()
        .map(|settings| (settings, Memory::of(settings)));
    let buses = memory.iter().flat_map(|(settings, memory)| {
        let buses = settings.buses.iter().zip(&memory.buses);
        buses.map(|(bus, memory)| bus_report(bus, memory))
    });
    let report = Report {
        ok: loaded.settings.is_some(),
        errors: &loaded.errors,
        warnings: &loaded.warnings,
        memory_bytes: memory.as_ref().map(|(settings, memory)| memory.total(settings)),
        buses: buses.collect(),
    };
    // Serializing can only fail for maps whose keys are not strings, which the report does not contain.
    serde_json::to_string_pretty(&report).unwrap_or_default() + "\n"
}

fn bus_report<'a>(bus: &'a BusSettings, memory: &BusMemory) -> Bus<'a> {
    let (prediction, shutdown) = (bus.predict(), bus.shutdown_time());
    let request = |request: &PredictedRequest| Request {
        drive: drive_name(bus, request),
        class: request.read.class.name(),
        function: request.read.table.read_function(),
        address: request.read.start,
        count: request.read.count,
        wire_ms: milliseconds(request.wire),
    };
    Bus {
        name: &bus.spec.name,
        load_ratio: prediction.load,
        fast_cycle_ms: prediction.fast_cycle.map(milliseconds),
        slow_cycle_ms: prediction.slow_cycle.map(milliseconds),
        refresh_ratio: (prediction.refreshes > 0.0).then_some(prediction.refreshes),
        shutdown_ms: milliseconds(shutdown.answered),
        shutdown_worst_ms: milliseconds(shutdown.unanswered),
        recorder_bytes: memory.recorder.total(),
        trend_bytes: memory.trends,
        raw_writes_refused: commanded(bus).flat_map(refused).collect(),
        requests: prediction.requests.iter().map(request).collect(),
    }
}

/// The drives that may be commanded; for all others every write is refused.
fn commanded(bus: &BusSettings) -> impl Iterator<Item = &DriveSpec> {
    bus.drives.iter().filter(|drive| drive.access == Access::Control)
}

fn refused(drive: &DriveSpec) -> impl Iterator<Item = Refused<'_>> {
    let ranges = drive.raw_writes.refused_ranges(&drive.profile);
    ranges.into_iter().map(|(table, range)| Refused {
        drive: &drive.name,
        table: table.name(),
        first: *range.start(),
        last: *range.end(),
    })
}

/// Maximum number of drives that one line of output names.
const NAMED: usize = 4;

/// Values that raw writes may not set, one line for the drives that have them in common; empty without Modbus TCP,
/// the only interface for raw writes.
fn raw_writes(bus: &BusSettings, settings: &Settings) -> String {
    let mut alike: Vec<(&DriveSpec, Vec<&str>)> = Vec::new();
    for drive in commanded(bus).filter(|_| settings.modbus_tcp.is_some()) {
        let same = |other: &DriveSpec| other.profile == drive.profile && other.raw_writes == drive.raw_writes;
        match alike.iter_mut().find(|(other, _)| same(other)) {
            Some((_, names)) => names.push(&drive.name),
            None => alike.push((drive, vec![&drive.name])),
        }
    }
    let mut text = String::new();
    for (drive, names) in alike {
        let ranges = drive.raw_writes.refused_ranges(&drive.profile);
        if ranges.is_empty() {
            continue;
        }
        let first = names.iter().take(NAMED).copied().collect::<Vec<_>>().join(", ");
        let more = match names.len().saturating_sub(NAMED) {
            0 => String::new(),
            more => format!(" and {more} more"),
        };
        let refused = raw_writes::in_words(&ranges);
        // Writing to a String cannot fail.
        let _ = writeln!(
            text,
            "  raw writes  {first}{more}: refused for {refused} (see `raw_writes`)"
        );
    }
    text
}

/// The profiles by which drives are commanded in the language of `[control]`, and how many cases were proved of each. One that
/// fails is an error of the configuration, and one of the program cannot fail.
fn proved(settings: &Settings) -> BTreeMap<&str, usize> {
    let drives = settings.buses.iter().flat_map(commanded);
    let mut proved = BTreeMap::new();
    for profile in drives.map(|drive| &drive.profile) {
        if profile.control_table().is_some() && !proved.contains_key(profile.name.as_str()) {
            let cases = proof::prove(profile).map_or(0, |proof| proof.commands);
            proved.insert(profile.name.as_str(), cases);
        }
    }
    proved
}

/// The profiles in use that are not tested on hardware.
fn unverified(settings: &Settings) -> BTreeSet<&str> {
    let drives = settings.buses.iter().flat_map(|bus| &bus.drives);
    let profiles = drives.map(|drive| &drive.profile).filter(|profile| !profile.verified);
    profiles.map(|profile| profile.name.as_str()).collect()
}

fn drive_name<'a>(bus: &'a BusSettings, request: &PredictedRequest) -> &'a str {
    bus.drives.get(request.drive.place()).map_or("", |drive| &drive.name)
}

fn milliseconds(time: Duration) -> f64 {
    time.as_nanos() as f64 / 1e6
}

fn text(path: &Path, settings: &Settings, warnings: usize) -> String {
    // Writing to a String cannot fail.
    let mut text = String::new();
    let taken = Memory::of(settings);
    for (bus, past) in settings.buses.iter().zip(&taken.buses) {
        text += &bus_text(bus, settings, &memory(past, taken.reach));
        text.push('\n');
    }
    for (profile, cases) in proved(settings) {
        let _ = writeln!(text, "profile {profile}: commands proved, {cases} cases\n");
    }
    for profile in unverified(settings) {
        let _ = writeln!(
            text,
            "profile {profile}: not verified on hardware, see docs/verifying.md\n"
        );
    }
    let total = taken.total(settings).div_ceil(1 << 20);
    let _ = writeln!(text, "memory at most {total} MiB for the gateway\n");
    let drives: usize = settings.buses.iter().map(|bus| bus.drives.len()).sum();
    if let Some(prefix) = settings.mqtt.as_ref().and_then(|mqtt| mqtt.home_assistant.as_ref()) {
        let drives = counted(drives, "drive", "drives");
        let _ = writeln!(text, "Home Assistant: {drives} announced below {prefix}/device\n");
    }
    text += &bacnet(settings);
    let warnings = match warnings {
        0 => "no warnings".to_string(),
        some => counted(some, "warning", "warnings"),
    };
    let _ = writeln!(
        text,
        "{}: ok, {}, {}, {warnings}",
        path.display(),
        counted(settings.buses.len(), "bus", "buses"),
        counted(drives, "drive", "drives"),
    );
    text
}

fn counted(count: usize, one: &str, many: &str) -> String {
    format!("{count} {}", if count == 1 { one } else { many })
}

fn bus_text(bus: &BusSettings, settings: &Settings, memory: &str) -> String {
    let spec = &bus.spec;
    let there = spec.port.contains("://") || Path::new(&spec.port).exists();
    let mut text = format!(
        "Bus {}: {}{}, {}, {}, silence {:.2} ms\n\n",
        spec.name,
        spec.port,
        if there { "" } else { " (not present)" },
        spec.protocol.name(),
        spec.format,
        milliseconds(spec.protocol.silence(bus.options.silence, &spec.format)),
    );
    if bus.listens() {
        return text + "  listens only: another master polls these drives, and the gateway sends nothing\n" + memory;
    }
    let prediction = bus.predict();
    let mut table = report::table(["drive", "class", "function", "address", "count", "wire ms"]);
    for request in &prediction.requests {
        let read = &request.read;
        table.add_row([
            drive_name(bus, request).to_string(),
            read.class.name().to_string(),
            format!("{:02} read {}", read.table.read_function(), read.table),
            read.start.to_string(),
            read.count.to_string(),
            format!("{:.2}", milliseconds(request.wire)),
        ]);
    }
    (3..6).for_each(|column| table.align_right(column));
    text += &report::lines(&table);
    text.push('\n');
    text + &summary(bus, &prediction) + memory + &slots(bus, settings) + &raw_writes(bus, settings) + &functions(bus)
}

/// The write functions of drives that may be commanded, where they differ from the usual ones.
fn functions(bus: &BusSettings) -> String {
    let line = |drive: &DriveSpec| {
        let notes = drive.profile.functions.notes();
        (!notes.is_empty()).then(|| format!("  writes      {}: {}\n", drive.name, notes.join("; ")))
    };
    commanded(bus).filter_map(line).collect()
}

/// Octets of a notification of a change, with the headers of UDP, IP and Ethernet.
const NOTIFICATION: usize = 120;

/// The devices and objects that BACnet shows, and the size of one notification of all of them; BACnet adds no requests
/// to the lines of the drives.
fn bacnet(settings: &Settings) -> String {
    let (Some(options), Some(devices)) = (&settings.bacnet, super::map::bacnet::devices(settings)) else {
        return String::new();
    };
    let objects: usize = devices.iter().map(|shown| shown.device.objects().len()).sum();
    format!(
        "BACnet/IP on {}: {} with {}; a change of all of them takes {} kB of notifications per subscriber, and \
         nothing on the lines\n\n",
        options.listen,
        counted(devices.len(), "device", "devices"),
        counted(objects, "object", "objects"),
        (objects * NOTIFICATION).div_ceil(1000),
    )
}

/// Where tools can connect to the line, one line of text for each slot.
fn slots(bus: &BusSettings, settings: &Settings) -> String {
    let all = settings.slots.iter().flat_map(|slots| &slots.slots);
    let of_bus = all.filter(|slot| slot.bus == bus.spec.name);
    let line = |slot: &Slot| {
        let ways = [
            slot.listen.map(|address| format!("{address} (bare frames)")),
            slot.rfc2217.map(|address| format!("{address} (RFC 2217)")),
            slot.pty.as_ref().map(|path| path.display().to_string()),
        ];
        let ways: Vec<String> = ways.into_iter().flatten().collect();
        format!("  tool slot   {}: {}\n", ways.join(", "), slot.access.meaning())
    };
    of_bus.map(line).collect()
}

/// Drives whose commands are written again, and the share of the line that this takes.
fn refreshes(bus: &BusSettings, prediction: &Prediction) -> String {
    let refreshed: Vec<String> = bus
        .drives
        .iter()
        .filter_map(|drive| Some(format!("{} every {}", drive.name, format_duration(drive.refresh?))))
        .collect();
    if refreshed.is_empty() {
        return String::new();
    }
    let first = refreshed.iter().take(NAMED).cloned().collect::<Vec<_>>().join(", ");
    let more = match refreshed.len().saturating_sub(NAMED) {
        0 => String::new(),
        more => format!(" and {more} more"),
    };
    let share = prediction.refreshes * 100.0;
    format!("  refresh     {first}{more}: {share:.1} % of the line while all of them are commanded\n")
}

fn summary(bus: &BusSettings, prediction: &Prediction) -> String {
    let cycle = |name: &str, achieved: Option<Duration>, wanted: Duration| match achieved {
        Some(achieved) => format!(
            "  {name} cycle  {:.1} ms (target {:.1} ms)\n",
            milliseconds(achieved),
            milliseconds(wanted)
        ),
        None => format!("  {name} cycle  none, nothing to read\n"),
    };
    let wanted = match prediction.demand {
        demand if demand > 1.0 => format!(" (the configured cycles would need {:.0} %)", demand * 100.0),
        _ => String::new(),
    };
    let behind = if bus.spec.port.starts_with("tcp://") {
        "  baud        used only for timing, not set in the device server; `drivegate diagnose` reports replies \
         that come\n              too soon, and which rate fits\n"
    } else {
        ""
    };
    cycle("fast", prediction.fast_cycle, bus.spec.cycle)
        + &cycle("slow", prediction.slow_cycle, bus.spec.slow_cycle)
        + &format!("  line load   {:.1} %{wanted}\n", prediction.load * 100.0)
        + &refreshes(bus, prediction)
        + &shutdown(bus)
        + behind
}

/// Memory of trends and of the recorder, which may be off.
fn memory(memory: &BusMemory, reach: Reach) -> String {
    let kilobytes = |bytes: usize| bytes.div_ceil(1000);
    let trends = format!(
        "  trends      {} kB of memory at most: {} kB a drive{}\n",
        kilobytes(memory.trends),
        kilobytes(memory.drive_trends),
        reaches(reach)
    );
    let budget = &memory.recorder;
    if budget.total() == 0 {
        return trends;
    }
    let drive = budget.samples.iter().max().map_or(0, |samples| samples + budget.notes);
    trends
        + &format!(
            "  recorder    {} kB of memory at most: {} kB a drive, {} kB for the line\n",
            kilobytes(budget.total()),
            kilobytes(drive),
            kilobytes(budget.frames)
        )
}

/// How far back trends reach, if that is less than usual.
fn reaches(reach: Reach) -> String {
    if reach == Reach::FULL {
        return String::new();
    }
    let spans = reach.ranges().map(|range| format!("{} min", range.span.as_secs() / 60));
    format!("; they reach back {} (many drives share the memory)", spans.join(", "))
}

/// Duration of the stops at shutdown, as text; empty if there are none.
fn shutdown(bus: &BusSettings) -> String {
    let time = bus.shutdown_time();
    if time.drives == 0 {
        return String::new();
    }
    format!(
        "  shutdown    {} in {:.2} s, {:.2} s if none replies\n",
        counted(time.drives, "drive stopped", "drives stopped"),
        time.answered.as_secs_f64(),
        time.unanswered.as_secs_f64()
    )
}
