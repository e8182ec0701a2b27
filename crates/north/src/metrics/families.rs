//! Every metric with its name, help, labels and values. Those of the common drive model are listed in `model`; counters
//! of the servers come from `NorthState`.

use std::sync::atomic::Ordering;
use std::time::{Instant, SystemTime};

use super::model::MODEL;
use super::process;
use super::series::{Families, FamilyId, Kind, Labels, SeriesValue};
use crate::{NorthState, ServerKind};
use drivegate_core::history::TriggerKind;
use drivegate_core::permit::HoldState;
use drivegate_core::plant::{BusHandle, Plant};
use drivegate_core::process_image::{BusHealth, BusImage, DriveImage, Outcome, Reading, public_points};
use drivegate_core::start_guard::Reason;
use drivegate_core::version::{self, VERSION};
use drivegate_model::drive::{ModelPoint, PollClass, State, Value};

/// All metric series, with the series of one family next to each other.
pub(super) fn collect(plant: &Plant, north: &NorthState, now: Instant) -> Families {
    let mut all = Families::default();
    drives(plant, north, now, &mut all);
    runs(plant, north, &mut all);
    buses(&plant.buses, &mut all);
    writes(plant, &mut all);
    recordings(north, &mut all);
    parameters(plant, north, &mut all);
    servers(north, &mut all);
    reload(north, &mut all);
    pauses(plant, &mut all);
    build(plant, &mut all);
    process(&process::read(), &mut all);
    all.sort();
    all
}

fn drives(plant: &Plant, north: &NorthState, now: Instant, all: &mut Families) {
    let up = all.gauge(
        "drivegate_drive_up",
        "Whether the drive replies: 1, else 0 (also before its first reply).",
    );
    let state = all.gauge(
        "drivegate_drive_state",
        "State of the drive: 1 for the state it is in, 0 for the others; absent while it is unknown.",
    );
    let blocked = all.gauge(
        "drivegate_drive_blocked",
        "Why the motor does not run: 1 for each cause; absent while it runs.",
    );
    let fault_info = all.gauge(
        "drivegate_drive_fault_info",
        "Text of the active fault: 1; absent without a fault.",
    );
    let age = all.gauge(
        "drivegate_drive_sample_age_seconds",
        "Age of the drive's process data; absent while it was never read.",
    );
    let model = MODEL.map(|(_, name, help)| all.gauge(name, help));
    let point = all.gauge(
        "drivegate_point_value",
        "Points of a drive that have no metric of their own, in their unit; true is 1.",
    );
    let transactions = all.counter(
        "drivegate_drive_transactions_total",
        "Transactions with the drive by outcome.",
    );
    let turnaround = all.gauge(
        "drivegate_drive_turnaround_seconds",
        "Time from the end of the last request to the start of the drive's reply.",
    );
    let refused = all.counter(
        "drivegate_starts_refused_total",
        "Starts of a guarded drive that were refused, by reason.",
    );
    let supervision = all.counter(
        "drivegate_supervision_actions_total",
        "Leases that expired while the drive ran or had its run command set.",
    );
    let failed = all.counter(
        "drivegate_supervision_failed_total",
        "Failed attempts at the action of a lease, or at the stop at shutdown.",
    );
    let unsupervised = all.gauge(
        "drivegate_drive_unsupervised",
        "1 if a drive with supervision runs without a lease, else 0.",
    );
    let refresh_writes = all.counter(
        "drivegate_refresh_writes_total",
        "Write requests by which what was ordered is written again for the drive's own timeout.",
    );
    let held = all.gauge(
        "drivegate_drive_held",
        "1 for the rank of the client that holds the drive; no series while nobody does.",
    );
    let unheld = all.counter(
        "drivegate_orders_unheld_total",
        "Commands from clients that did not hold the drive, executed in advisory mode.",
    );
    let drill_age = all.gauge(
        "drivegate_drill_age_seconds",
        "Time since the last completed drill of that kind; no series before the first.",
    );
    let drill_passed = all.gauge(
        "drivegate_drill_passed",
        "1 if the motor stopped in time in that drill.",
    );
    let drills = north.drills.options().is_some();
    for drive in plant.drives() {
        let image = &drive.image;
        let labels = labels_of(image);
        let reading = drive.reading(now);
        let proofs = drills.then(|| north.drills.proofs(&drive.machine()));
        for proof in proofs.into_iter().flatten() {
            let labels = labels.with("kind", proof.kind.name());
            all.add(drill_age, labels.clone(), proof.age(SystemTime::now()).as_secs_f64());
            all.add(drill_passed, labels, proof.passed);
        }
        all.add(supervision, labels.clone(), image.supervisions());
        let failures = image.supervision_failures();
        all.add(failed, labels.clone(), failures);
        if image.spec.supervision.is_some() {
            all.add(unsupervised, labels.clone(), image.is_unsupervised());
        }
        if image.spec.refresh.is_some() {
            all.add(refresh_writes, labels.clone(), image.refresh_writes());
        }
        let guards = drive.bus.queue.guards().filter(|guards| guards.guards(drive.index));
        if let Some(counted) = guards.map(|guards| guards.refused(drive.index)) {
            for reason in Reason::ALL {
                let count = counted.get(&reason).copied().unwrap_or_default();
                all.add(refused, labels.with("reason", reason.name()), count);
            }
        }
        if let Some((view, _)) = drive.hold_view(None, now) {
            if let (HoldState::Held, Some(rank)) = (view.state, &view.rank) {
                all.add(held, labels.with("rank", rank.to_string()), 1.0);
            }
            let count = drive.bus.queue.lock().gate.unheld(drive.index);
            all.add(unheld, labels.clone(), count);
        }
        all.add(up, labels.clone(), reading.snapshot.link.is_online());
        if let Some(current) = reading.state() {
            for one in State::ALL {
                all.add(state, labels.with("state", one.name()), one == current);
            }
        }
        for cause in drive.why(&reading).names() {
            all.add(blocked, labels.with("reason", cause), 1.0);
        }
        let fault_text =
            Some(reading.fault_text()).filter(|text| reading.is_set(ModelPoint::Fault) && !text.is_empty());
        if let Some(text) = fault_text {
            all.add(fault_info, labels.with("text", text), 1.0);
        }
        if let Some(time) = reading.age() {
            all.add(age, labels.clone(), time.as_secs_f64());
        }
        points(&reading, &labels, (&model, point), all);
        for outcome in Outcome::ALL {
            let count = image.counted(outcome);
            all.add(transactions, labels.with("outcome", outcome.name()), count);
        }
        if let Some(time) = image.turnaround() {
            all.add(turnaround, labels, time.as_secs_f64());
        }
    }
}

/// Counters of the drives that report whether they run.
fn runs(plant: &Plant, north: &NorthState, all: &mut Families) {
    let starts = all.counter(
        "drivegate_drive_starts_total",
        "Observed starts of the motor; kept across restarts of the gateway.",
    );
    let running = all.counter(
        "drivegate_drive_running_seconds_total",
        "Observed run time of the motor; kept across restarts of the gateway.",
    );
    for drive in plant.drives() {
        let spec = &drive.image.spec;
        if spec.profile.model_index(ModelPoint::Running).is_some() {
            let totals = north.history.totals(&spec.name);
            let labels = labels_of(&drive.image);
            all.add(starts, labels.clone(), totals.starts);
            all.add(running, labels, SeriesValue::Total(totals.running_seconds));
        }
    }
}

/// The good points of a drive; `model` has the families of [`MODEL`], in its order.
fn points(reading: &Reading<'_>, labels: &Labels, (model, other): (&[FamilyId], FamilyId), all: &mut Families) {
    let profile = &reading.spec.profile;
    for (index, name) in public_points(profile) {
        let Some(value) = reading
            .sample(index)
            .good()
            .and_then(Value::exact_f64)
            .filter(|v| v.is_finite())
        else {
            continue;
        };
        let point = profile.points.get(index);
        let own = point.and_then(|p| p.model).and_then(|m| {
            let place = MODEL.iter().position(|(wanted, ..)| *wanted == m)?;
            model.get(place).copied()
        });
        match own {
            Some(family) => all.add(family, labels.clone(), value),
            None => {
                let unit = point.map(|p| p.unit.clone()).unwrap_or_default();
                let labels = labels.with_both(("point", name.to_string().into()), ("unit", unit.into()));
                all.add(other, labels, value);
            }
        }
    }
}

fn buses(handles: &[BusHandle], all: &mut Families) {
    type Of<T> = fn(&BusImage, &BusHealth) -> T;
    let gauges: [(&str, &str, Of<Option<f64>>); 2] = [
        (
            "drivegate_bus_up",
            "Whether the port of the bus is open: 1, else 0.",
            |_, health| Some(f64::from(u8::from(health.up))),
        ),
        (
            "drivegate_bus_load_ratio",
            "Share of the last second that the line was in use, 0 to 1; absent until the port was open for a second.",
            |_, health| health.load,
        ),
    ];
    let looks: Vec<(Labels, &BusHandle, BusHealth)> = handles
        .iter()
        .map(|h| (Labels::of([("bus", &h.image.spec.name)]), h, h.image.health()))
        .collect();
    for (name, help, value) in gauges {
        let family = all.gauge(name, help);
        for (labels, handle, health) in &looks {
            if let Some(value) = value(&handle.image, health) {
                all.add(family, labels.clone(), value);
            }
        }
    }
    let cycles = all.histogram(
        "drivegate_bus_cycle_seconds",
        "Achieved cycle: time from the start of a poll round to the start of the next, by poll class.",
    );
    let transactions = all.histogram(
        "drivegate_bus_transaction_seconds",
        "Duration of transactions on the bus.",
    );
    let queue = all.gauge(
        "drivegate_bus_queue_depth",
        "Commands and forwarded reads waiting for the bus.",
    );
    let reconnects = all.counter(
        "drivegate_port_reconnects_total",
        "Connections that a device server closed after replies and that were reopened at once.",
    );
    let diagnosis = all.gauge(
        "drivegate_line_diagnosis",
        "Diagnosis of the line: 1 for each active verdict; drive is empty if it concerns the whole line.",
    );
    for (labels, handle, health) in looks {
        let image = &handle.image;
        all.add(reconnects, labels.clone(), health.reconnects);
        for verdict in &image.diagnosis.load().verdicts {
            let drive = verdict.drive.clone().unwrap_or_default();
            let labels = labels.with_both(("drive", drive.into()), ("verdict", verdict.verdict.name().into()));
            all.add(diagnosis, labels, 1.0);
        }
        for (class, times) in [
            (PollClass::Fast, &image.fast_cycles),
            (PollClass::Slow, &image.slow_cycles),
        ] {
            all.add(cycles, labels.with("class", class.name()), times.snapshot());
        }
        all.add(transactions, labels.clone(), image.transactions.snapshot());
        all.add(queue, labels, handle.queue.lock().len() as f64);
    }
}

fn writes(plant: &Plant, all: &mut Families) {
    let results = all.counter("drivegate_writes_total", "Completed commands, by source and result.");
    for ((source, result), count) in plant.writes.results() {
        let labels = Labels::default().with_both(("source", source.name().into()), ("result", result.into()));
        all.add(results, labels, count);
    }
    all.one(
        Kind::Histogram,
        "drivegate_write_seconds",
        "Time from the acceptance of a command to its result.",
        plant.writes.seconds(),
    );
    let lost = all.counter(
        "drivegate_audit_lost_total",
        "Records missing from the audit file because the disk did not accept them.",
    );
    if let Some(file) = plant.writes.audit().file() {
        let (sent, not_sent) = file.lost();
        for (kind, count) in [("sent", sent), ("not_sent", not_sent)] {
            all.add(lost, Labels::default().with("kind", kind), count);
        }
    }
}

fn recordings(north: &NorthState, all: &mut Families) {
    let made = all.counter(
        "drivegate_recordings_total",
        "Recordings made since the start, by trigger.",
    );
    let counts = north.recordings.made();
    for kind in TriggerKind::ALL {
        let count = counts.get(&kind).copied().unwrap_or_default();
        all.add(made, Labels::default().with("trigger", kind.name()), count);
    }
}

fn parameters(plant: &Plant, north: &NorthState, all: &mut Families) {
    let changed = all.counter(
        "drivegate_parameters_changed_total",
        "Parameters of the drive that changed between two readings without being written by the gateway.",
    );
    let counts = north.parameters.changed();
    for drive in plant.drives() {
        let key = (drive.image.spec.bus.clone(), drive.image.spec.name.clone());
        let count = counts.get(&key).copied().unwrap_or_default();
        all.add(changed, labels_of(&drive.image), count);
    }
}

fn bacnet(stats: &NorthState, all: &mut Families) {
    let Some(figures) = stats.bacnet.get() else { return };
    let counters = figures.counters;
    let requests = all.counter(
        "drivegate_bacnet_requests_total",
        "BACnet requests answered, by outcome.",
    );
    for (outcome, count) in [("ok", counters.done), ("refused", counters.refused)] {
        all.add(requests, Labels::of([("outcome", outcome)]), count);
    }
    let datagrams = all.counter(
        "drivegate_bacnet_datagrams_total",
        "BACnet datagrams: received, discarded (invalid, or not allowed), dropped (the address had used up its share \
         of answers).",
    );
    let fates = [
        ("received", counters.received),
        ("discarded", counters.discarded),
        ("dropped", counters.dropped),
    ];
    for (fate, count) in fates {
        all.add(datagrams, Labels::of([("fate", fate)]), count);
    }
    all.one(
        Kind::Counter,
        "drivegate_bacnet_notifications_total",
        "Changes of value sent to BACnet clients.",
        counters.notifications,
    );
    all.one(
        Kind::Gauge,
        "drivegate_bacnet_subscriptions",
        "Current subscriptions of BACnet clients.",
        counters.subscriptions as f64,
    );
    if let Some((_, registration)) = figures.bbmd {
        all.one(
            Kind::Gauge,
            "drivegate_bacnet_bbmd_registered",
            "Whether the gateway is registered at the BBMD: 1, else 0.",
            registration == drivegate_bacnet::Registration::Registered,
        );
    }
}

fn servers(stats: &NorthState, all: &mut Families) {
    all.one(
        Kind::Gauge,
        "drivegate_modbus_tcp_connections",
        "Currently connected Modbus TCP clients.",
        stats.modbus_tcp.connections() as f64,
    );
    let requests = all.counter(
        "drivegate_modbus_tcp_requests_total",
        "Modbus TCP requests answered, by function code and outcome.",
    );
    for (function, outcome, count) in stats.modbus_tcp.requests() {
        let labels = Labels::default().with_both(("function", function.into()), ("outcome", outcome.into()));
        all.add(requests, labels, count);
    }
    let tools = all.counter(
        "drivegate_slot_requests_total",
        "Requests of tools at the slots, by outcome.",
    );
    for (bus, outcome, count) in stats.slots.requests() {
        let labels = Labels::default().with_both(("bus", bus.into()), ("outcome", outcome.name().into()));
        all.add(tools, labels, count);
    }
    bacnet(stats, all);
    let listener_up = all.gauge(
        "drivegate_listener_up",
        "Whether a server listens on all its addresses: 1, else 0; /readyz names the one that fails.",
    );
    for (server, up) in stats.listeners.up() {
        let labels = Labels::of([("server", server.name())]);
        all.add(listener_up, labels, up);
    }
    let refused = all.counter(
        "drivegate_connections_refused_total",
        "Connections refused, or closed in favour of others, by server and reason.",
    );
    for server in ServerKind::ALL {
        for (reason, count) in stats.refused.of(server).filter(|(_, count)| *count > 0) {
            let labels =
                Labels::default().with_both(("server", server.name().into()), ("reason", reason.name().into()));
            all.add(refused, labels, count);
        }
    }
    let mqtt = &stats.mqtt;
    all.one(
        Kind::Gauge,
        "drivegate_mqtt_configured",
        "Whether an MQTT broker is configured: 1, else 0.",
        mqtt.configured.load(Ordering::Relaxed),
    );
    all.one(
        Kind::Gauge,
        "drivegate_mqtt_connected",
        "Whether the gateway is connected to its MQTT broker: 1, else 0 (also without one configured).",
        mqtt.connected.load(Ordering::Relaxed),
    );
    all.one(
        Kind::Counter,
        "drivegate_mqtt_published_total",
        "Messages sent to the MQTT broker; with QoS 1, those it acknowledged.",
        mqtt.published.load(Ordering::Relaxed),
    );
    all.one(
        Kind::Gauge,
        "drivegate_mqtt_buffered_messages",
        "Messages waiting for the MQTT broker.",
        mqtt.buffered.load(Ordering::Relaxed) as f64,
    );
    let lost = all.counter(
        "drivegate_mqtt_lost_total",
        "Lost MQTT messages, by kind: the buffer was full or damaged, or the broker refused them.",
    );
    for (kind, count) in mqtt.losses() {
        all.add(lost, Labels::default().with("kind", kind.name()), count);
    }
}

fn reload(stats: &NorthState, all: &mut Families) {
    let (applied, at) = stats.reload.last();
    let since_epoch = at.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    all.one(
        Kind::Gauge,
        "drivegate_config_last_reload_successful",
        "Whether the last reload of the configuration was applied: 1; 0 if it was refused.",
        applied,
    );
    all.one(
        Kind::Gauge,
        "drivegate_config_last_reload_timestamp_seconds",
        "When the last reload of the configuration ended, applied or refused; startup counts as one.",
        (since_epoch.as_secs_f64() * 1e3).round() / 1e3,
    );
}

fn pauses(plant: &Plant, all: &mut Families) {
    let (count, time) = plant.events.pauses().total();
    all.one(
        Kind::Counter,
        "drivegate_pauses_total",
        "Times for which the gateway, or a thread of it, stood still for longer than a second.",
        SeriesValue::Count(count),
    );
    all.one(
        Kind::Counter,
        "drivegate_paused_seconds_total",
        "How long it stood still in them.",
        SeriesValue::Total(time.as_secs_f64()),
    );
}

fn build(plant: &Plant, all: &mut Families) {
    let labels = Labels::of([
        ("version", VERSION),
        ("commit", version::commit().unwrap_or("unknown")),
        ("gateway", &plant.gateway),
    ]);
    let family = all.gauge(
        "drivegate_build_info",
        "Always 1; version and commit of the build, and the name of the gateway.",
    );
    all.add(family, labels, 1.0);
}

fn process(figures: &process::ProcessStats, all: &mut Families) {
    if let Some(seconds) = figures.cpu_seconds {
        all.one(
            Kind::Counter,
            "process_cpu_seconds_total",
            "Processor time of the process, user and system.",
            SeriesValue::Total(seconds),
        );
    }
    let gauges = [
        (
            "process_open_fds",
            "Open file descriptors of the process.",
            figures.open_fds,
        ),
        (
            "process_max_fds",
            "File descriptors that the process may open.",
            figures.max_fds,
        ),
        (
            "process_virtual_memory_bytes",
            "Virtual memory of the process.",
            figures.virtual_bytes,
        ),
        (
            "process_resident_memory_bytes",
            "Resident memory of the process.",
            figures.resident_bytes,
        ),
        (
            "process_start_time_seconds",
            "Start of the process, Unix time.",
            figures.start_seconds,
        ),
        ("process_threads", "Threads of the process.", figures.threads),
    ];
    for (name, help, value) in gauges {
        if let Some(value) = value {
            all.one(Kind::Gauge, name, help, value);
        }
    }
}

fn labels_of(drive: &DriveImage) -> Labels {
    Labels::of([("bus", &drive.spec.bus), ("drive", &drive.spec.name)])
}
