//! Every metric with its name, help, labels and values, as tables: a row is a family, and says which series a drive, a bus
//! or the gateway has in it. Metrics of the common drive model are listed in `model`; counters of the servers come from
//! `NorthState`.

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant, SystemTime};

use super::drive::{self, DriveFigures};
use super::process::{self, ProcessStats};
use super::series::{Families, Labels, Row, SeriesValue, rows};
use crate::stats::BacnetFigures;
use crate::{NorthState, ServerKind};
use drivegate_core::history::TriggerKind;
use drivegate_core::plant::{BusHandle, Plant};
use drivegate_core::process_image::BusHealth;
use drivegate_core::version::{self, VERSION};
use drivegate_model::drive::PollClass;

/// All metric series, with the series of one family next to each other.
pub(super) fn collect(plant: &Plant, north: &NorthState, now: Instant) -> Families {
    let mut all = Families::default();
    let drives: Vec<_> = plant.drives().collect();
    let drives = drives.iter().map(|drive| DriveFigures::of(drive, north, now));
    all.fill(&drive::families(), drives.map(|drive| (drive.labels.clone(), drive)));
    let buses = plant.buses.iter().map(|handle| Bus {
        handle,
        health: handle.image.health(),
    });
    let labels = |bus: &Bus<'_>| Labels::of([("bus", &bus.handle.image.spec.name)]);
    all.fill(&bus_families(), buses.map(|bus| (labels(&bus), bus)));
    let gateway = Gateway {
        plant,
        north,
        bacnet: north.bacnet.get(),
        reload: north.reload.last(),
        pauses: plant.events.pauses().total(),
    };
    let [commands, servers, own] = [command_families(), server_families(), own_families()];
    let tables = commands.into_iter().chain(servers).chain(own).collect::<Vec<_>>();
    all.fill(&tables, [(Labels::default(), gateway)]);
    all.fill(&process_families(), [(Labels::default(), process::read())]);
    all.sort();
    all
}

/// A bus, read once for all families.
struct Bus<'a> {
    handle: &'a BusHandle,
    health: BusHealth,
}

fn bus_families<'a>() -> Vec<Row<Bus<'a>>> {
    rows! { Bus<'a>;
        Gauge "drivegate_bus_up" "Whether the port of the bus is open: 1, else 0."
            => |bus, series| series.add(bus.health.up);
        Gauge "drivegate_bus_load_ratio"
            "Share of the last second that the line was in use, 0 to 1; absent until the port was open for a second."
            => |bus, series| series.add_some(bus.health.load);
        Histogram "drivegate_bus_cycle_seconds"
            "Achieved cycle: time from the start of a poll round to the start of the next, by poll class."
            => |bus, series| {
                let image = &bus.handle.image;
                for (class, times) in [(PollClass::Fast, &image.fast_cycles), (PollClass::Slow, &image.slow_cycles)] {
                    series.with("class", class.name(), times.snapshot());
                }
            };
        Histogram "drivegate_bus_transaction_seconds" "Duration of transactions on the bus."
            => |bus, series| series.add(bus.handle.image.transactions.snapshot());
        Gauge "drivegate_bus_queue_depth" "Commands and forwarded reads waiting for the bus."
            => |bus, series| series.add(bus.handle.queue.lock().len() as f64);
        Counter "drivegate_port_reconnects_total"
            "Connections that a device server closed after replies and that were reopened at once."
            => |bus, series| series.add(bus.health.reconnects);
        Gauge "drivegate_line_diagnosis"
            "Diagnosis of the line: 1 for each active verdict; drive is empty if it concerns the whole line."
            => |bus, series| for verdict in &bus.handle.image.diagnosis.load().verdicts {
                let drive = verdict.drive.clone().unwrap_or_default();
                series.with_both(("drive", drive.into()), ("verdict", verdict.verdict.name().into()), true);
            };
    }
}

/// The gateway, with the figures that several families share.
struct Gateway<'a> {
    plant: &'a Plant,
    north: &'a NorthState,
    bacnet: Option<BacnetFigures>,
    /// Whether the last reload was applied, and its end.
    reload: (bool, SystemTime),
    /// Number and time of the pauses.
    pauses: (u64, Duration),
}

impl Gateway<'_> {
    /// Counters of the BACnet server, while it runs.
    fn bacnet(&self) -> Option<&drivegate_bacnet::Counters> {
        self.bacnet.as_ref().map(|figures| &figures.counters)
    }
}

fn command_families<'a>() -> Vec<Row<Gateway<'a>>> {
    rows! { Gateway<'a>;
        Counter "drivegate_writes_total" "Completed commands, by source and result."
            => |gateway, series| for ((source, result), count) in gateway.plant.command_log.results() {
                series.with_both(("source", source.name().into()), ("result", result.into()), count);
            };
        Histogram "drivegate_write_seconds" "Time from the acceptance of a command to its result."
            => |gateway, series| series.add(gateway.plant.command_log.seconds());
        Counter "drivegate_audit_lost_total" "Records missing from the audit file because the disk did not accept them."
            => |gateway, series| if let Some(file) = gateway.plant.command_log.audit().file() {
                let (sent, not_sent) = file.lost();
                series.with("kind", "sent", sent);
                series.with("kind", "not_sent", not_sent);
            };
        Counter "drivegate_recordings_total" "Recordings made since the start, by trigger."
            => |gateway, series| {
                let counts = gateway.north.recordings.made();
                for kind in TriggerKind::ALL {
                    series.with("trigger", kind.name(), counts.get(&kind).copied().unwrap_or_default());
                }
            };
        Counter "drivegate_parameters_changed_total"
            "Parameters of the drive that changed between two readings without being written by the gateway."
            => |gateway, series| {
                let counts = gateway.north.parameters.changed();
                for drive in gateway.plant.drives() {
                    let key = (drive.image.spec.bus.clone(), drive.image.spec.name.clone());
                    let count = counts.get(&key).copied().unwrap_or_default();
                    series.labelled(drive::labels(&drive.image), count);
                }
            };
    }
}

fn server_families<'a>() -> Vec<Row<Gateway<'a>>> {
    rows! { Gateway<'a>;
        Gauge "drivegate_modbus_tcp_connections" "Currently connected Modbus TCP clients."
            => |gateway, series| series.add(gateway.north.modbus_tcp.connections() as f64);
        Counter "drivegate_modbus_tcp_requests_total" "Modbus TCP requests answered, by function code and outcome."
            => |gateway, series| for (function, outcome, count) in gateway.north.modbus_tcp.requests() {
                series.with_both(("function", function.into()), ("outcome", outcome.into()), count);
            };
        Counter "drivegate_slot_requests_total" "Requests of tools at the slots, by outcome."
            => |gateway, series| for (bus, outcome, count) in gateway.north.slots.requests() {
                series.with_both(("bus", bus.into()), ("outcome", outcome.name().into()), count);
            };
        Counter "drivegate_bacnet_requests_total" "BACnet requests answered, by outcome."
            => |gateway, series| if let Some(counters) = gateway.bacnet() {
                series.with("outcome", "ok", counters.done);
                series.with("outcome", "refused", counters.refused);
            };
        Counter "drivegate_bacnet_datagrams_total"
            "BACnet datagrams: received, discarded (invalid, or not allowed), dropped (the address had used up its share \
             of answers)."
            => |gateway, series| if let Some(counters) = gateway.bacnet() {
                series.with("fate", "received", counters.received);
                series.with("fate", "discarded", counters.discarded);
                series.with("fate", "dropped", counters.dropped);
            };
        Counter "drivegate_bacnet_notifications_total" "Changes of value sent to BACnet clients."
            => |gateway, series| series.add_some(gateway.bacnet().map(|counters| counters.notifications));
        Gauge "drivegate_bacnet_subscriptions" "Current subscriptions of BACnet clients."
            => |gateway, series| series.add_some(gateway.bacnet().map(|counters| counters.subscriptions as f64));
        Gauge "drivegate_bacnet_bbmd_registered" "Whether the gateway is registered at the BBMD: 1, else 0."
            => |gateway, series| {
                let bbmd = gateway.bacnet.as_ref().and_then(|figures| figures.bbmd.as_ref());
                series.add_some(bbmd.map(|(_, registered)| *registered == drivegate_bacnet::Registration::Registered));
            };
        Gauge "drivegate_listener_up"
            "Whether a server listens on all its addresses: 1, else 0; /readyz names the one that fails."
            => |gateway, series| for (server, up) in gateway.north.listeners.up() {
                series.with("server", server.name(), up);
            };
        Counter "drivegate_connections_refused_total"
            "Connections refused, or closed in favour of others, by server and reason."
            => |gateway, series| for server in ServerKind::ALL {
                for (reason, count) in gateway.north.refused.of(server).filter(|(_, count)| *count > 0) {
                    series.with_both(("server", server.name().into()), ("reason", reason.name().into()), count);
                }
            };
        Gauge "drivegate_mqtt_configured" "Whether an MQTT broker is configured: 1, else 0."
            => |gateway, series| series.add(gateway.north.mqtt.configured.load(Ordering::Relaxed));
        Gauge "drivegate_mqtt_connected"
            "Whether the gateway is connected to its MQTT broker: 1, else 0 (also without one configured)."
            => |gateway, series| series.add(gateway.north.mqtt.connected.load(Ordering::Relaxed));
        Counter "drivegate_mqtt_published_total" "Messages sent to the MQTT broker; with QoS 1, those it acknowledged."
            => |gateway, series| series.add(gateway.north.mqtt.published.load(Ordering::Relaxed));
        Gauge "drivegate_mqtt_buffered_messages" "Messages waiting for the MQTT broker."
            => |gateway, series| series.add(gateway.north.mqtt.buffered.load(Ordering::Relaxed) as f64);
        Counter "drivegate_mqtt_lost_total"
            "Lost MQTT messages, by kind: the buffer was full or damaged, or the broker refused them."
            => |gateway, series| for (kind, count) in gateway.north.mqtt.losses() {
                series.with("kind", kind.name(), count);
            };
    }
}

fn own_families<'a>() -> Vec<Row<Gateway<'a>>> {
    rows! { Gateway<'a>;
        Gauge "drivegate_config_last_reload_successful"
            "Whether the last reload of the configuration was applied: 1; 0 if it was refused."
            => |gateway, series| series.add(gateway.reload.0);
        Gauge "drivegate_config_last_reload_timestamp_seconds"
            "When the last reload of the configuration ended, applied or refused; startup counts as one."
            => |gateway, series| {
                let since_epoch = gateway.reload.1.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
                series.add((since_epoch.as_secs_f64() * 1e3).round() / 1e3);
            };
        Counter "drivegate_pauses_total"
            "Times for which the gateway, or a thread of it, stood still for longer than a second."
            => |gateway, series| series.add(gateway.pauses.0);
        Counter "drivegate_paused_seconds_total" "How long it stood still in them."
            => |gateway, series| series.add(SeriesValue::Total(gateway.pauses.1.as_secs_f64()));
        Gauge "drivegate_build_info" "Always 1; version and commit of the build, and the name of the gateway."
            => |gateway, series| {
                let commit = version::commit().unwrap_or("unknown");
                let labels = [("version", VERSION), ("commit", commit), ("gateway", gateway.plant.gateway.as_str())];
                series.labelled(Labels::of(labels), true);
            };
    }
}

fn process_families() -> Vec<Row<ProcessStats>> {
    rows! { ProcessStats;
        Counter "process_cpu_seconds_total" "Processor time of the process, user and system."
            => |process, series| series.add_some(process.cpu_seconds.map(SeriesValue::Total));
        Gauge "process_open_fds" "Open file descriptors of the process."
            => |process, series| series.add_some(process.open_fds);
        Gauge "process_max_fds" "File descriptors that the process may open."
            => |process, series| series.add_some(process.max_fds);
        Gauge "process_virtual_memory_bytes" "Virtual memory of the process."
            => |process, series| series.add_some(process.virtual_bytes);
        Gauge "process_resident_memory_bytes" "Resident memory of the process."
            => |process, series| series.add_some(process.resident_bytes);
        Gauge "process_start_time_seconds" "Start of the process, Unix time."
            => |process, series| series.add_some(process.start_seconds);
        Gauge "process_threads" "Threads of the process." => |process, series| series.add_some(process.threads);
    }
}
