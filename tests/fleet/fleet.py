#!/usr/bin/env python3
"""Many gateways on one machine: what a site costs the broker, Prometheus and itself, and what happens when the broker restarts.

Starts one mosquitto, one Prometheus, one process that simulates all lines without wire time, and GATEWAYS processes of
`drivegate run` with DRIVES simulated drives each. Everything listens on loopback and lives in a temporary directory.
Prints the figures; ends with 1 if a gateway was not back within BOUND seconds of the broker's return, or ended by itself.
"""

import argparse
import collections
import json
import os
import pathlib
import sys
import threading
import time

import paho.mqtt.client as paho

from plant import MOSQUITTO, PROMETHEUS, ROOT, Processes, attempt, free_ports, listens, memory, processor_seconds, query_api, until

# docs/mqtt.md: the gateway tries again at intervals of up to 5 s; the rest is for the connection itself.
BOUND = 8.0


def gateway_name(number):
    return f"site-{number:04}"


def bus(directory, number, options):
    lines = [
        "[[bus]]",
        f'name = "line{number}"',
        f'port = "{directory}/line{number}"',
        'protocol = "modbus-rtu"',
        "baud = 115200",
        f'cycle = "{options.cycle}"',
        'slow_cycle = "10s"',
    ]
    for drive in range(1, options.drives + 1):
        lines += ["[[bus.drive]]", f'name = "drive{number}-{drive}"', f"address = {drive}", 'profile = "vacon-nx"']
    return lines


def write(path, text):
    path.write_text(text + "\n")
    return path


def configurations(directory, options, broker_port):
    """One file with all lines for the simulation, one for each gateway; the HTTP ports of the gateways."""
    numbers = range(options.gateways)
    lines = [line for number in numbers for line in bus(directory, number, options)]
    everything = ["[gateway]", 'name = "all-lines"', *lines]
    write(directory / "lines.toml", "\n".join(everything))
    ports = free_ports(options.gateways)
    for number, port in zip(numbers, ports):
        own = [
            "[gateway]",
            f'name = "{gateway_name(number)}"',
            *bus(directory, number, options),
            "[mqtt]",
            f'url = "mqtt://127.0.0.1:{broker_port}"',
            f"topics = {json.dumps(options.topics.split(','))}",
            "[http]",
            f'listen = "127.0.0.1:{port}"',
            "[recordings]",
            "max_count = 0",
        ]
        write(directory / f"{gateway_name(number)}.toml", "\n".join(own))
    return ports


class Subscriber:
    """Counts what arrives, and when each gateway says that it is online."""

    def __init__(self, port, topics):
        self.messages = 0
        self.payload = 0
        self.online = {}
        self.lock = threading.Lock()
        self.client = paho.Client(paho.CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
        self.client.reconnect_delay_set(0.05, 0.05)
        self.client.on_connect = lambda client, *_: client.subscribe(topics, 0)
        self.client.on_message = self.received
        self.client.connect("127.0.0.1", port)
        self.client.loop_start()

    def received(self, _client, _data, message):
        with self.lock:
            self.messages += 1
            self.payload += len(message.topic) + len(message.payload)
            parts = message.topic.split("/")
            if parts[-1] == "status" and message.payload == b"online":
                self.online[parts[1]] = time.monotonic()

    def end(self):
        self.client.disconnect()
        self.client.loop_stop()

    def restart_count(self):
        with self.lock:
            self.online = {}

    def names_online(self):
        with self.lock:
            return dict(self.online)

    def counts(self):
        with self.lock:
            return self.messages, self.payload


def start_broker(processes, directory, port):
    text = f"listener {port} 127.0.0.1\nallow_anonymous true\npersistence false\nset_tcp_nodelay true\n"
    text += "max_queued_messages 100000\n"
    return processes.start("mosquitto", [MOSQUITTO, "-c", write(directory / "mosquitto.conf", text)])


def start_prometheus(processes, directory, ports):
    port = free_ports(1)[0]
    targets = json.dumps([f"127.0.0.1:{each}" for each in ports])
    text = "global:\n  scrape_interval: 5s\n  scrape_timeout: 5s\nscrape_configs:\n- job_name: drivegate\n"
    text += f"  static_configs:\n  - targets: {targets}\n"
    config = write(directory / "prometheus.yml", text)
    process = processes.start(
        "prometheus",
        [
            PROMETHEUS,
            f"--config.file={config}",
            f"--storage.tsdb.path={directory}/prometheus",
            f"--web.listen-address=127.0.0.1:{port}",
        ],
    )
    return process, port


def query(port, expression):
    result = query_api(port, "query", query=expression)["result"]
    return float(result[0]["value"][1]) if result else float("nan")


def steady(options, subscriber, broker, gateways, simulation, prometheus, prometheus_port):
    """Rates and costs while nothing happens."""
    watched = {"broker": [broker], "prometheus": [prometheus], "lines": [simulation], "gateways": gateways}
    before = {name: sum(processor_seconds(p.pid) for p in group) for name, group in watched.items()}
    messages, payload = subscriber.counts()
    began = time.monotonic()
    time.sleep(options.seconds)
    took = time.monotonic() - began
    used = {
        name: (sum(processor_seconds(p.pid) for p in group) - before[name]) / took for name, group in watched.items()
    }
    after_messages, after_payload = subscriber.counts()
    resident = sorted(memory(p.pid)[0] for p in gateways)
    proportional = sum(memory(p.pid)[1] for p in gateways) / len(gateways)
    rate = (after_messages - messages) / took
    count = len(gateways)
    print(f"messages: {rate:.0f}/s, {(after_payload - payload) / took / 1000:.0f} kB/s of topics and payloads; "
          f"a gateway: {rate / count:.1f}/s, {(after_payload - payload) / took / count:.0f} B/s")
    print(f"broker: {100 * used['broker']:.1f} % of a core (one subscriber to everything), "
          f"{1e6 * used['broker'] / max(rate, 1):.0f} us a message, RSS {memory(broker.pid)[0]:.1f} MiB")
    print(f"gateway: {100 * used['gateways'] / count:.2f} % of a core, RSS {resident[len(resident) // 2]:.1f} MiB, "
          f"proportional {proportional:.1f} MiB, threads {len(os.listdir(f'/proc/{gateways[0].pid}/task'))}, "
          f"files {len(os.listdir(f'/proc/{gateways[0].pid}/fd'))}")
    print(f"lines (simulated): {100 * used['lines']:.1f} % of a core")
    for name, expression in [
        ("scrape, median s", "quantile(0.5, avg_over_time(scrape_duration_seconds{job='drivegate'}[1m]))"),
        ("scrape, slowest s", "max(max_over_time(scrape_duration_seconds{job='drivegate'}[1m]))"),
        ("series a gateway", "avg(scrape_samples_scraped{job='drivegate'})"),
        ("gateways up", "sum(up{job='drivegate'})"),
        ("drives online", "sum(drivegate_drive_up)"),
    ]:
        print(f"prometheus: {name}: {query(prometheus_port, expression):.4g}")
    print(f"prometheus: {100 * used['prometheus']:.1f} % of a core, RSS {memory(prometheus.pid)[0]:.0f} MiB")


def storm(options, processes, directory, subscriber, broker, broker_port, gateways):
    """The broker is killed and comes back; when each gateway is online again. The new broker and whether all was well."""
    broker.kill()
    broker.wait()
    subscriber.restart_count()
    time.sleep(options.outage)
    broker = start_broker(processes, directory, broker_port)
    until("the broker's return", lambda: listens(broker_port), 20)
    back = time.monotonic()
    used = processor_seconds(broker.pid)
    while len(subscriber.names_online()) < len(gateways) and time.monotonic() - back < 4 * BOUND:
        time.sleep(0.05)
    online = sorted(at - back for at in subscriber.names_online().values())
    busy = processor_seconds(broker.pid) - used
    if not online:
        print("storm: no gateway came back")
        return broker, False
    buckets = collections.Counter(int(max(at, 0) * 10) for at in online)
    print(f"storm after {options.outage} s: {len(online)} of {len(gateways)} back; half after {online[len(online) // 2]:.2f} s, "
          f"the last after {online[-1]:.2f} s; at most {max(buckets.values())} in 0.1 s; the broker took {busy:.2f} s of a core")
    well = len(online) == len(gateways) and online[-1] <= BOUND
    if not well:
        print(f"storm: a gateway was away for more than {BOUND} s")
    return broker, well


def tried(processes, options):
    directory, binary = processes.directory, options.binary
    broker_port = free_ports(1)[0]
    broker = start_broker(processes, directory, broker_port)
    until("the broker's start", lambda: listens(broker_port), 20)
    ports = configurations(directory, options, broker_port)
    simulation = processes.start(
        "lines", [binary, "simulate", "--config", directory / "lines.toml", "--speed", "max", "--autopilot"]
    )
    until("the simulated lines", lambda: all((directory / f"line{n}").exists() for n in range(options.gateways)), 60)
    statuses = Subscriber(broker_port, "drivegate/+/status")
    began = time.monotonic()
    gateways = []
    for number in range(options.gateways):
        state = directory / f"state{number}"
        state.mkdir()
        command = [binary, "run", "--config", directory / f"{gateway_name(number)}.toml"]
        runtime = {"STATE_DIRECTORY": str(state), "RUNTIME_DIRECTORY": str(state)}
        gateways.append(processes.start(gateway_name(number), command, **runtime))
    until("all gateways online", lambda: len(statuses.names_online()) == options.gateways, 120)
    print(f"start: all gateways online after {time.monotonic() - began:.1f} s", flush=True)
    prometheus, prometheus_port = start_prometheus(processes, directory, ports)
    everything = Subscriber(broker_port, "drivegate/#")
    time.sleep(70)
    steady(options, everything, broker, gateways, simulation, prometheus, prometheus_port)
    everything.end()
    sys.stdout.flush()
    broker, well = storm(options, processes, directory, statuses, broker, broker_port, gateways)
    lost = [gateway_name(n) for n, process in enumerate(gateways) if process.poll() is not None]
    if lost:
        print(f"fleet: ended by themselves: {', '.join(lost)}")
        well = False
    return well


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--gateways", type=int, default=100)
    parser.add_argument("--drives", type=int, default=10, help="drives of each gateway")
    parser.add_argument("--cycle", default="1s", help="fast cycle of each line")
    parser.add_argument("--topics", default="state,points", help="`topics` of [mqtt]")
    parser.add_argument("--seconds", type=float, default=60, help="how long the quiet state is measured")
    parser.add_argument("--outage", type=float, default=10, help="how long the broker is away, s")
    parser.add_argument("--binary", type=pathlib.Path, default=ROOT / "target/release/drivegate")
    options = parser.parse_args()
    if not options.binary.is_file():
        sys.exit(f"fleet: no program at {options.binary}; `make build` builds it")
    attempt("fleet", options, lambda directory, _: Processes(directory), lambda processes: tried(processes, options))


if __name__ == "__main__":
    main()
