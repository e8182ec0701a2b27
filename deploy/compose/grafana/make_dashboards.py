#!/usr/bin/env python3
"""Writes the Grafana dashboards in dashboards/ from the panels below; with --check it only compares.

Every query keeps the label instance, so that gateways with equal bus names stay apart. Only the totals of the
fleet add gateways up; its other panels show the worst.
"""

import json
import sys
from pathlib import Path

FOLDER = Path(__file__).with_name("dashboards")
SOURCE = {"type": "prometheus", "uid": "${datasource}"}

INSTANCE = 'instance=~"$instance"'
BUS = f'{INSTANCE}, bus=~"$bus"'
DRIVE = f'{BUS}, drive=~"$drive"'
OF_INSTANCE, OF_BUS, OF_DRIVE = "{{instance}}", "{{instance}} {{bus}}", "{{instance}} {{drive}}"

OPEN = [{"color": "red", "value": None}, {"color": "green", "value": 1}]
LOAD = [{"color": "green", "value": None}, {"color": "yellow", "value": 0.85}, {"color": "orange", "value": 0.97}]
AGE = [{"color": "green", "value": None}, {"color": "yellow", "value": 1}, {"color": "red", "value": 5}]
NONE_IS_GOOD = [{"color": "green", "value": None}, {"color": "red", "value": 1}]
PLAIN = [{"color": "text", "value": None}]
STATES = [("offline", "dark-red"), ("not_ready", "yellow"), ("ready", "blue"), ("running", "green"), ("fault", "red")]

# Names of the dashboards by uid; each links to the others.
TITLES = {
    "drivegate-fleet": "drivegate: fleet",
    "drivegate-gateway": "drivegate: gateway",
    "drivegate-line": "drivegate: line",
    "drivegate-drive": "drivegate: drive",
}


def query(expression, legend, table=False):
    return {"expr": expression, "legendFormat": legend, "table": table}


def targets(queries):
    made = []
    for number, one in enumerate(queries):
        how = {"instant": True, "range": False, "format": "table"} if one["table"] else {"range": True}
        made.append(
            {
                "datasource": SOURCE,
                "editorMode": "code",
                "expr": one["expr"],
                "legendFormat": one["legendFormat"],
                "refId": chr(ord("A") + number),
                **how,
            }
        )
    return made


def panel(kind, title, description, queries, width, height, defaults, options, **more):
    return {
        "type": kind,
        "title": title,
        "description": description,
        "datasource": SOURCE,
        "gridPos": {"x": 0, "y": 0, "w": width, "h": height},
        "fieldConfig": {"defaults": defaults, "overrides": more.pop("overrides", [])},
        "options": options,
        "targets": targets(queries),
        **more,
    }


def row(title):
    return {"type": "row", "title": title, "collapsed": False, "panels": [], "gridPos": {"x": 0, "y": 0, "w": 24, "h": 1}}


def link_to(uid, label, variables):
    """A link of a value to another dashboard that keeps the time range and takes the variables from the labels."""
    chosen = "&".join(f"var-{name}=${{__field.labels.{name}}}" for name in variables)
    return {"title": label, "url": f"/d/{uid}?${{__url_time_range}}&{chosen}", "targetBlank": False}


TO_GATEWAY = link_to("drivegate-gateway", "This gateway", ["instance"])
TO_LINE = link_to("drivegate-line", "This line", ["instance", "bus"])
TO_DRIVE = link_to("drivegate-drive", "This drive", ["instance", "bus", "drive"])


def mappings(texts):
    options = {
        str(value): {"text": text, "color": colour, "index": value} for value, (text, colour) in enumerate(texts)
    }
    return [{"type": "value", "options": options}]


def stat(title, description, expression, legend, width, thresholds, unit="short", texts=None, links=(), decimals=None):
    defaults = {"unit": unit, "thresholds": {"mode": "absolute", "steps": thresholds}, "links": list(links)}
    if texts:
        defaults["mappings"] = mappings(texts)
    if decimals is not None:
        defaults["decimals"] = decimals
    options = {
        "reduceOptions": {"calcs": ["lastNotNull"], "fields": "", "values": False},
        "colorMode": "background",
        "graphMode": "none",
        "textMode": "auto",
        "justifyMode": "auto",
        "orientation": "auto",
    }
    return panel("stat", title, description, [query(expression, legend)], width, 4, defaults, options)


def graph(title, description, unit, *queries, width=12, links=()):
    defaults = {
        "unit": unit,
        "links": list(links),
        "custom": {
            "drawStyle": "line",
            "lineWidth": 1,
            "fillOpacity": 0,
            "showPoints": "never",
            "spanNulls": False,
        },
    }
    options = {
        "legend": {"displayMode": "table", "placement": "right", "showLegend": True, "calcs": ["lastNotNull"]},
        "tooltip": {"mode": "multi", "sort": "none"},
    }
    return panel("timeseries", title, description, list(queries), width, 7, defaults, options)


def timeline(title, description, expression, legend, texts, height=6, links=()):
    defaults = {
        "unit": "short",
        "mappings": mappings(texts),
        "thresholds": {"mode": "absolute", "steps": PLAIN},
        "links": list(links),
        "custom": {"lineWidth": 0, "fillOpacity": 80},
    }
    options = {
        "showValue": "auto",
        "mergeValues": True,
        "rowHeight": 0.8,
        "alignValue": "left",
        "legend": {"showLegend": False, "displayMode": "list", "placement": "bottom", "calcs": []},
        "tooltip": {"mode": "single", "sort": "none"},
    }
    return panel("state-timeline", title, description, [query(expression, legend)], 24, height, defaults, options)


def table(title, description, expression, shown, width=12, link=None, unit="short"):
    """The series of a query as rows; `shown` names its labels in the order of the columns, and `Value`."""
    order = {name: place for place, name in enumerate(shown)}
    hidden = ["Time", "__name__", "job", "gateway", "commit", "instance", "bus", "drive", "text", "reason", "verdict", "Value"]
    organize = {
        "id": "organize",
        "options": {
            "indexByName": order,
            "excludeByName": {name: True for name in hidden if name not in shown},
            "renameByName": {"instance": "gateway"} if "gateway" not in shown else {},
        },
    }
    overrides = []
    if link:
        # In a table labels are columns.
        links = [{"id": "links", "value": [link | {"url": link["url"].replace("__field.labels.", "__data.fields.")}]}]
        overrides = [{"matcher": {"id": "byName", "options": shown[-1] if shown[-1] != "Value" else shown[-2]}, "properties": links}]
    defaults = {"unit": unit, "custom": {"align": "auto", "cellOptions": {"type": "auto"}, "inspect": False}}
    options = {"showHeader": True, "cellHeight": "sm"}
    queries = [query(expression, "", table=True)]
    return panel(
        "table", title, description, queries, width, 8, defaults, options, overrides=overrides, transformations=[organize]
    )


def quantiles(metric, labels, selector, legend):
    def one(share):
        rate = f"rate({metric}_bucket{{{selector}}}[$__rate_interval])"
        name = f"p{round(share * 100)}"
        return query(f"histogram_quantile({share}, sum by ({labels}, le) ({rate}))", f"{legend} {name}")

    return [one(0.5), one(0.95), one(0.99)]


def rate(metric, labels, selector):
    summed = f"rate({metric}{{{selector}}}[$__rate_interval])"
    return f"sum by ({labels}) ({summed})" if labels else summed


def state(selector):
    terms = [f'{value} * drivegate_drive_state{{{selector}, state="{name}"}}' for value, (name, _) in enumerate(STATES)]
    return "sum by (instance, bus, drive) (\n  " + "\n  or ".join(terms) + "\n)"


def of_drive(title, description, unit, metric):
    return graph(title, description, unit, query(f"drivegate_drive_{metric}{{{DRIVE}}}", OF_DRIVE))


def up(metric, selector, legend, title, description, width, links=()):
    texts = [("down", "red"), ("up", "green")]
    return stat(title, description, f"{metric}{{{selector}}}", legend, width, OPEN, texts=texts, links=links)


def load(width):
    text = "Share of time the line is in use. Near 100 %: the configured cycle is not reached."
    links = [TO_LINE]
    return stat("Load", text, f"drivegate_bus_load_ratio{{{BUS}}}", OF_BUS, width, LOAD, "percentunit", links=links, decimals=1)


def fleet():
    """Worst first, and never one line for each gateway: there may be a thousand. Reads what prometheus/recording.yml records."""

    def of(name):
        return f"instance:drivegate_{name}{{{INSTANCE}}}"

    def total(title, description, expression, thresholds=PLAIN):
        return stat(title, description, expression, "", 4, thresholds)

    def worst(title, description, unit, expression):
        return graph(title, f"The ten gateways with the most. {description}", unit, query(f"topk(10, {expression})", OF_INSTANCE), links=[TO_GATEWAY])

    gateways = f'up{{job="drivegate", {INSTANCE}}}'
    drives = f"{{{INSTANCE}}}"
    count, online, running = (of(name) for name in ("drives:count", "drives_online:sum", "drives_running:sum"))
    return [
        row("All gateways"),
        total("Gateways up", "Gateways that Prometheus scrapes successfully.", f"sum({gateways})"),
        total("Gateways down", "Gateways that Prometheus cannot scrape.", f"count({gateways}) - sum({gateways})", NONE_IS_GOOD),
        total("Drives online", "Drives that reply.", f"sum({online})"),
        total("Drives offline", "Drives that do not reply.", f"sum({count}) - sum({online})", NONE_IS_GOOD),
        total("Motors running", "Drives whose motor is running.", f"sum({running})"),
        total("Faults", "Drives with an active fault.", f"sum({of('drives_fault:sum')})", NONE_IS_GOOD),
        row("Worst first"),
        table(
            "Gateways with problems",
            "Drives offline, with a fault or running without a lease; buses down; servers not listening; a disconnected broker; a refused reload.",
            f"topk(50, {of('problems:sum')}) > 0",
            ["instance", "Value"],
            link=TO_GATEWAY,
        ),
        table("Gateways down", "At most 50.", f"bottomk(50, {gateways}) == 0", ["instance"], link=TO_GATEWAY),
        table(
            "Faults",
            "Drives with an active fault, with its text; at most 100.",
            f"topk(100, drivegate_drive_fault_info{drives}) == 1",
            ["instance", "bus", "drive", "text"],
            link=TO_DRIVE,
        ),
        table(
            "Why motors do not run",
            "What keeps the motor of a drive from running; motors that are stopped by command are listed, too. At most 100.",
            f"topk(100, drivegate_drive_blocked{drives}) == 1",
            ["instance", "bus", "drive", "reason"],
            link=TO_DRIVE,
        ),
        table("Buses down", "At most 50.", f"bottomk(50, drivegate_bus_up{drives}) == 0", ["instance", "bus"], link=TO_LINE),
        table(
            "Versions",
            "Number of gateways per version.",
            f"count by (version, commit) (drivegate_build_info{drives})",
            ["version", "commit", "Value"],
        ),
        worst("Drives offline", "Drives that do not reply.", "short", f"{count} - {online}"),
        worst("Failed transactions", "The drive with the largest share.", "percentunit", of("transactions_failed:max_ratio_rate5m")),
        worst("Oldest sample", "The drive with the oldest process data.", "s", of("sample_age_seconds:max")),
        worst("Load of the busiest line", "Near 100 %: the configured cycle is not reached.", "percentunit", of("bus_load:max")),
        worst("Failed commands", "Commands that were not acknowledged.", "ops", of("writes_failed:rate5m")),
        graph("Drives", "Of all gateways.", "short", query(f"sum({count})", "all"), query(f"sum({online})", "online"), query(f"sum({running})", "running")),
    ]


def gateway():
    of_instance = f"{{{INSTANCE}}}"
    return [
        row("Now"),
        up("drivegate_drive_up", INSTANCE, OF_DRIVE, "Drives", "Whether each drive is online.", 8, [TO_DRIVE]),
        up("drivegate_bus_up", INSTANCE, OF_BUS, "Buses", "Whether the port of each bus is open.", 4, [TO_LINE]),
        up("drivegate_mqtt_connected", INSTANCE, OF_INSTANCE, "MQTT", "Connection to the broker; down also without one.", 4),
        stat(
            "Last reload",
            "Whether the last configuration reload was applied.",
            f"drivegate_config_last_reload_successful{of_instance}",
            OF_INSTANCE,
            4,
            OPEN,
            texts=[("refused", "red"), ("applied", "green")],
        ),
        stat("Uptime", "Time since the gateway started.", f"time() - process_start_time_seconds{of_instance}", OF_INSTANCE, 4, PLAIN, "s"),
        timeline("Drive states", "State of each drive.", state(INSTANCE), OF_DRIVE, STATES, 8, [TO_DRIVE]),
        row("Commands"),
        graph("Commands", "By source and result.", "ops", query(rate("drivegate_writes_total", "instance, source, result", INSTANCE), OF_INSTANCE + " {{source}} {{result}}")),
        graph("Command latency", "From acceptance of a command to its result.", "s", *quantiles("drivegate_write_seconds", "instance", INSTANCE, OF_INSTANCE)),
        graph("Supervision actions", "Leases that expired while the motor was running.", "short", query(f"sum by (instance, bus, drive) (increase(drivegate_supervision_actions_total{of_instance}[$__rate_interval]))", OF_DRIVE), links=[TO_DRIVE]),
        graph("Waiting commands", "Commands and forwarded reads waiting for the line.", "none", query(f"drivegate_bus_queue_depth{of_instance}", OF_BUS), links=[TO_LINE]),
        row("Clients"),
        graph("Modbus TCP requests", "By function code and outcome.", "reqps", query(rate("drivegate_modbus_tcp_requests_total", "instance, function, outcome", INSTANCE), OF_INSTANCE + " {{function}} {{outcome}}")),
        graph("Modbus TCP connections", "Clients connected now.", "none", query(f"drivegate_modbus_tcp_connections{of_instance}", OF_INSTANCE)),
        graph("MQTT messages", "Messages acknowledged by the broker.", "ops", query(rate("drivegate_mqtt_published_total", "", INSTANCE), OF_INSTANCE)),
        graph("MQTT buffer", "Messages waiting for the broker.", "none", query(f"drivegate_mqtt_buffered_messages{of_instance}", OF_INSTANCE)),
        row("The process"),
        graph("CPU", "Share of one processor.", "percentunit", query(rate("process_cpu_seconds_total", "", 'job="drivegate", ' + INSTANCE), OF_INSTANCE)),
        graph("Memory", "Resident memory, pages shared with other processes included.", "bytes", query(f'process_resident_memory_bytes{{job="drivegate", {INSTANCE}}}', OF_INSTANCE)),
        graph("File descriptors", "Open files, ports and connections.", "none", query(f'process_open_fds{{job="drivegate", {INSTANCE}}}', OF_INSTANCE)),
        graph("Recordings", "Recordings written, by trigger, since the start.", "none", query(f"drivegate_recordings_total{of_instance}", OF_INSTANCE + " {{trigger}}")),
    ]


def line():
    failed = 'outcome!~"ok|exception"'
    return [
        row("Now"),
        up("drivegate_bus_up", BUS, OF_BUS, "Port", "Whether the port is open.", 6),
        load(6),
        up("drivegate_drive_up", BUS, OF_DRIVE, "Drives", "Whether each drive is online.", 12, [TO_DRIVE]),
        table(
            "Diagnosis",
            "Probable causes of line errors; `drivegate diagnose` shows evidence and remedy.",
            f"drivegate_line_diagnosis{{{BUS}}} == 1",
            ["instance", "bus", "drive", "verdict"],
            width=24,
        ),
        row("The line"),
        graph("Load", "Share of time the line is in use.", "percentunit", query(f"drivegate_bus_load_ratio{{{BUS}}}", OF_BUS)),
        graph("Cycle", "Time from the start of one cycle of a poll class to the start of the next: median, 95th and 99th percentile.", "s", *quantiles("drivegate_bus_cycle_seconds", "instance, bus, class", BUS, OF_BUS + " {{class}}")),
        graph("Transaction", "Time of one transaction: request, turnaround, reply.", "s", *quantiles("drivegate_bus_transaction_seconds", "instance, bus", BUS, OF_BUS)),
        graph("Waiting commands", "Commands and forwarded reads waiting for the line.", "none", query(f"drivegate_bus_queue_depth{{{BUS}}}", OF_BUS)),
        graph("Tool slots", "Requests of vendors' programs by outcome.", "ops", query(rate("drivegate_slot_requests_total", "instance, bus, outcome", BUS), OF_BUS + " {{outcome}}")),
        graph("Transactions by outcome", "Check the line if there are outcomes other than ok.", "ops", query(rate("drivegate_drive_transactions_total", "instance, bus, outcome", BUS), OF_BUS + " {{outcome}}")),
        row("Drives"),
        graph(
            "Share of failed transactions by drive",
            "Timeouts and corrupt replies. One drive: its cable or address. All from one drive onwards: cable or termination there.",
            "percentunit",
            query(
                f"sum by (instance, bus, drive) (rate(drivegate_drive_transactions_total{{{BUS}, {failed}}}[$__rate_interval]))"
                f" / sum by (instance, bus, drive) (rate(drivegate_drive_transactions_total{{{BUS}}}[$__rate_interval]))",
                OF_DRIVE,
            ),
            links=[TO_DRIVE],
        ),
        graph("Turnaround", "Measured time from the end of a request to the first byte of its reply.", "s", query(f"drivegate_drive_turnaround_seconds{{{BUS}}}", OF_DRIVE), links=[TO_DRIVE]),
        graph("Age of process data", "Time since the last sample.", "s", query(f"drivegate_drive_sample_age_seconds{{{BUS}}}", OF_DRIVE), links=[TO_DRIVE]),
        timeline("Drive states", "State of each drive.", state(BUS), OF_DRIVE, STATES, 8, [TO_DRIVE]),
    ]


def drive():
    return [
        timeline("State", "State of each drive.", state(DRIVE), OF_DRIVE, STATES, 5),
        table("Active fault", "The text of the active fault.", f"drivegate_drive_fault_info{{{DRIVE}}} == 1", ["instance", "bus", "drive", "text"], width=8),
        table("Why the motor does not run", "What keeps the motor from running; empty while it runs.", f"drivegate_drive_blocked{{{DRIVE}}} == 1", ["instance", "bus", "drive", "reason"], width=8),
        stat("Oldest sample", "Age of the process data.", f"max by (instance, bus, drive) (drivegate_drive_sample_age_seconds{{{DRIVE}}})", OF_DRIVE, 8, AGE, "s"),
        row("Process data"),
        of_drive("Speed", "Actual speed, percent of the speed range.", "percent", "actual_speed_percent"),
        of_drive("Speed reference", "The reference as read from the drive.", "percent", "speed_reference_percent"),
        of_drive("Output frequency", "", "hertz", "output_frequency_hertz"),
        of_drive("Motor speed", "", "rotrpm", "motor_speed_rpm"),
        of_drive("Current", "Motor current.", "amp", "motor_current_amperes"),
        of_drive("Torque", "Percent of nominal torque.", "percent", "motor_torque_percent"),
        of_drive("Power", "Percent of nominal power.", "percent", "motor_power_percent"),
        of_drive("Motor voltage", "", "volt", "motor_voltage_volts"),
        of_drive("DC link voltage", "", "volt", "dc_link_voltage_volts"),
        of_drive("Heatsink temperature", "", "celsius", "heatsink_temperature_celsius"),
        row("Counters and faults"),
        graph("Starts in an hour", "Starts seen by the gateway; frequent starts wear contactors and motors.", "none", query(f"increase(drivegate_drive_starts_total{{{DRIVE}}}[1h])", OF_DRIVE)),
        graph("Running time", "Running time seen by the gateway; kept over restarts.", "s", query(f"drivegate_drive_running_seconds_total{{{DRIVE}}}", OF_DRIVE)),
        of_drive("Energy", "Energy counter of the drive.", "kwatth", "energy_kilowatthours"),
        of_drive("Operating hours", "Operating hours counter of the drive.", "h", "operating_hours"),
        of_drive("Fault code", "0: no fault.", "none", "fault_code"),
        graph("Changed parameters", "Changed between two readings, not by this gateway.", "none", query(f"drivegate_parameters_changed_total{{{DRIVE}}}", OF_DRIVE)),
        graph("Warning", "1 while the drive has a warning.", "none", query(f"drivegate_drive_warning{{{DRIVE}}}", OF_DRIVE)),
        row("Communication"),
        graph("Transactions", "By outcome.", "ops", query(rate("drivegate_drive_transactions_total", "instance, bus, drive, outcome", DRIVE), OF_DRIVE + " {{outcome}}"), links=[TO_LINE]),
        of_drive("Turnaround", "Measured time from the end of a request to the first byte of its reply.", "s", "turnaround_seconds"),
    ]


def annotation(name, colour, expression, title, text):
    return {
        "datasource": SOURCE,
        "enable": True,
        "hide": False,
        "iconColor": colour,
        "name": name,
        "expr": expression,
        "titleFormat": title,
        "textFormat": text,
        "step": "15s",
    }


def annotations(selector, most=None):
    """At most so many of a kind at a time."""

    def some(expression):
        return f"topk({most}, {expression})" if most else expression

    return [
        annotation("Faults", "red", some(f"drivegate_drive_fault_info{{{selector}}}") + " == 1", "{{drive}}: fault", "{{text}}"),
        annotation(
            "Supervision",
            "orange",
            some(f"changes(drivegate_supervision_actions_total{{{selector}}}[30s])") + " > 0",
            "{{drive}}: supervision action",
            "its client went silent while the motor ran",
        ),
        annotation(
            "Gateway starts",
            "blue",
            some(f'changes(process_start_time_seconds{{job="drivegate", {INSTANCE}}}[30s])') + " > 0",
            "{{instance}} started",
            "",
        ),
    ]


def variable(name, label, definition, multi=True):
    chosen = {"selected": True, "text": ["All"], "value": ["$__all"]} if multi else {}
    return {
        "name": name,
        "label": label,
        "type": "query",
        "datasource": SOURCE,
        "query": {"qryType": 1, "query": definition, "refId": "v"},
        "definition": definition,
        "refresh": 2,
        "sort": 1,
        "multi": multi,
        "includeAll": multi,
        **({"allValue": ".*"} if multi else {}),
        "current": chosen,
        "hide": 0,
        "regex": "",
        "options": [],
    }


VARIABLES = [
    variable("instance", "Gateway", "label_values(drivegate_build_info, instance)"),
    variable("bus", "Bus", f"label_values(drivegate_bus_up{{{INSTANCE}}}, bus)"),
    variable("drive", "Drive", f"label_values(drivegate_drive_up{{{BUS}}}, drive)"),
]


def placed(panels):
    """Sets the panels from left to right, in rows as high as their highest panel, and numbers them."""
    x = y = height = 0
    for number, one in enumerate(panels, 1):
        place = one["gridPos"]
        if x + place["w"] > 24:
            x, y, height = 0, y + height, 0
        one["id"] = number
        one["gridPos"] = {**place, "x": x, "y": y}
        x, height = x + place["w"], max(height, place["h"])
    return panels


def dashboard(uid, panels, variables, selector):
    source = {
        "name": "datasource",
        "label": "Data source",
        "type": "datasource",
        "query": "prometheus",
        "current": {"selected": True, "text": "Prometheus", "value": "prometheus"},
        "hide": 0,
        "regex": "",
        "refresh": 1,
        "options": [],
        "multi": False,
        "includeAll": False,
    }
    links = [
        {
            "title": title.removeprefix("drivegate: "),
            "type": "link",
            "url": f"/d/{other}",
            "icon": "dashboard",
            "tooltip": title,
            "tags": [],
            "asDropdown": False,
            "targetBlank": False,
            "includeVars": True,
            "keepTime": True,
        }
        for other, title in TITLES.items()
        if other != uid
    ]
    return {
        "uid": uid,
        "title": TITLES[uid],
        "tags": ["drivegate"],
        "schemaVersion": 39,
        "version": 1,
        "editable": True,
        "graphTooltip": 1,
        "refresh": "5s",
        "time": {"from": "now-30m", "to": "now"},
        "timezone": "browser",
        "timepicker": {},
        "annotations": {"list": annotations(selector, 20 if uid == "drivegate-fleet" else None)},
        "links": links,
        "templating": {"list": [source, *variables]},
        "panels": placed(panels),
    }


DASHBOARDS = {
    "fleet.json": dashboard("drivegate-fleet", fleet(), VARIABLES[:1], INSTANCE),
    "gateway.json": dashboard("drivegate-gateway", gateway(), VARIABLES[:1], INSTANCE),
    "line.json": dashboard("drivegate-line", line(), VARIABLES[:2], BUS),
    "drive.json": dashboard("drivegate-drive", drive(), VARIABLES, DRIVE),
}


def main():
    check = sys.argv[1:] == ["--check"]
    if not check and sys.argv[1:]:
        sys.exit("usage: make_dashboards.py [--check]")
    for name, content in DASHBOARDS.items():
        text = json.dumps(content, indent=1) + "\n"
        path = FOLDER / name
        if not check:
            path.write_text(text)
        elif not path.exists() or path.read_text() != text:
            sys.exit(f"error: {name} differs from what make_dashboards.py writes; run it")
    extra = {path.name for path in FOLDER.glob("*.json")} - set(DASHBOARDS)
    if extra:
        sys.exit(f"error: no dashboard is written to {', '.join(sorted(extra))}; remove it")


if __name__ == "__main__":
    main()
