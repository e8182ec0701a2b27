#!/usr/bin/env python3
"""A thousand nodes at one broker with TLS: PROCESSES gateways of `drivegate run`, and SESSIONS of the same MQTT and Sparkplug code in one
process (benches/sessions.rs), with DRIVES drives each.

All start at once; a host that starts again asks all nodes for their births at once; the broker is restarted, and later killed, and comes
back after a while. Prints how long it takes until every birth is there, and what that costs. Ends with 1 if it takes longer than BOUND, if
data had an alias that the host does not know, if an event was lost, or if the nodes came back twice in the same order.
"""

import argparse
import collections
import json
import os
import pathlib
import subprocess
import time

import paho.mqtt.client as paho
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from plant import MOSQUITTO, ROOT, Certificates, Processes, ask, attempt, events_of, free_ports, listens, memory, processor_seconds, to_toml, until
from sparkplug_host import Host, rebirth

BOUND = 30.0
GROUP = "fleet"


class Fleet(Processes):
    def __init__(self, directory, options):
        super().__init__(directory)
        self.options = options
        self.certificates = Certificates(directory / "certificates")
        self.port = free_ports(1)[0]
        self.plain = free_ports(1)[0]
        self.gateways = []
        self.host = Host(options.drives)
        self.online = {}
        self.asked = set()
        self.events = collections.Counter()

    def start_broker(self):
        certificates, config = self.certificates, self.directory / "mosquitto.conf"
        config.write_text(f"""listener {self.port} 127.0.0.1
cafile {certificates.path("authority.crt")}
certfile {certificates.path("broker.crt")}
keyfile {certificates.path("broker.key")}
listener {self.plain} 127.0.0.1
allow_anonymous true
persistence true
persistence_location {self.directory}/
max_queued_messages 1000000
max_connections -1
user root
""")
        self.broker = self.start("mosquitto", [MOSQUITTO, "-c", config])
        until("the broker", lambda: listens(self.plain), 20)

    def watch(self):
        """The host, by the listener without TLS: its own decryption is not part of what is measured."""
        client = paho.Client(paho.CallbackAPIVersion.VERSION2, client_id="host", protocol=paho.MQTTv5)
        client.reconnect_delay_set(0.1, 0.1)
        topics = [(f"spBv1.0/{GROUP}/#", 0), ("drivegate/+/status", 1), ("drivegate/+/drive/+/event", 1)]
        client.on_connect = lambda client, *_: client.subscribe(topics)
        client.on_message = self.received
        # The broker keeps the session while it is restarted.
        session = Properties(PacketTypes.CONNECT)
        session.SessionExpiryInterval = 600
        client.connect("127.0.0.1", self.plain, clean_start=False, properties=session)
        client.loop_start()
        self.client = client

    def received(self, _client, _data, message):
        if message.topic.startswith("spBv1.0/"):
            self.host.received(message.topic, message.payload)
            _, _, kind, node, *_ = message.topic.split("/")
            # It was at the broker before the host, which asks the nodes whose own birth it missed.
            is_born = "" in self.host.born.get(node, ())
            if kind in ("DBIRTH", "NDATA", "DDATA") and not is_born and node not in self.asked:
                self.asked.add(node)
                self.client.publish(f"spBv1.0/{GROUP}/NCMD/{node}", rebirth(), 0)
        elif message.topic.endswith("/event"):
            event = json.loads(message.payload)
            self.events[message.topic.split("/")[1], event["boot"], event["id"]] += 1
        elif message.payload == b"online" and not message.retain:
            self.online[message.topic.split("/")[1]] = time.monotonic()

    def names(self):
        options = self.options
        return [f"site-{n:04}" for n in (*range(options.processes), *range(1000, 1000 + options.sessions))]

    def configuration(self, number):
        options, name = self.options, f"site-{number:04}"
        drives = [{"name": f"d{n}", "address": n, "profile": "vacon-nx"} for n in range(1, options.drives + 1)]
        bus = {"name": "line", "port": str(self.directory / f"line{number}"), "baud": 115200, "cycle": options.cycle, "slow_cycle": "30s",
               "response_timeout": "500ms", "retries": 3, "drive": drives}
        return {
            "gateway": {"name": name, "socket": str(self.directory / f"{name}.socket"), "state_dir": str(self.directory / name)},
            "bus": [bus],
            "mqtt": {"url": f"mqtts://localhost:{self.port}", "ca": self.certificates.path("authority.crt"), "topics": ["state"],
                     "publish": {"min_interval": f"{1000 * options.min_interval:.0f}ms"}, "sparkplug": {"group": GROUP}},
            "recordings": {"max_count": 0},
        }

    def run(self):
        options = self.options
        buses = []
        for number in range(options.processes):
            bus = self.configuration(number)["bus"][0]
            for at, drive in enumerate(bus["drive"]):
                drive |= {"name": f"d{number}-{at}"}
            buses.append(bus | {"name": f"line{number}"})
        began = time.monotonic()
        if buses:
            lines = self.directory / "lines.toml"
            lines.write_text(to_toml({"gateway": {"name": "lines"}, "bus": buses}))
            self.lines = self.start("lines", [options.binary, "simulate", "--config", lines, "--speed", "max", "--autopilot"])
            until("the lines", lambda: all(os.path.exists(bus["port"]) for bus in buses), 60)
        command = [options.sessions_binary, "--port", self.port, "--sessions", options.sessions, "--drives", options.drives,
                   "--ca", self.certificates.path("authority.crt"), "--dir", self.directory / "sessions",
                   "--cycle", options.cycle.removesuffix("s"), "--min-interval", options.min_interval]
        self.sessions = self.start("sessions", command, stdin=subprocess.PIPE)
        for number in range(options.processes):
            name = f"site-{number:04}"
            (self.directory / name).mkdir()
            config = self.directory / f"{name}.toml"
            config.write_text(to_toml(self.configuration(number)))
            self.gateways.append(self.start(name, [options.binary, "run", "--config", config]))
        return began

    def births(self, what, began, seconds=120):
        """Waits until every birth is there; whether that was in time."""
        names = set(self.names())
        end = began + seconds
        while time.monotonic() < end and not names <= self.host.whole_at.keys():
            time.sleep(0.05)
        times = sorted(at - began for at in self.host.whole_at.values())
        peak = max(collections.Counter(int(at * 10) for at in times).values(), default=0)
        missing = len(names - self.host.whole_at.keys())
        half = times[len(times) // 2] if times else float("nan")
        last = times[-1] if times else float("nan")
        print(f"{what}: births of {len(times)} of {len(names)} nodes, half after {half:.1f} s, the last after {last:.1f} s, "
              f"at most {peak} in 0.1 s", flush=True)
        return missing == 0 and last <= BOUND

    def costs(self, what, seconds):
        watched = {"broker": [self.broker], "sessions": [self.sessions], "gateways": self.gateways}
        before = {name: sum(processor_seconds(p.pid) for p in group) for name, group in watched.items()}
        data = self.host.data
        began = time.monotonic()
        time.sleep(seconds)
        took = time.monotonic() - began
        used = {name: (sum(processor_seconds(p.pid) for p in group) - before[name]) / took for name, group in watched.items()}
        print(f"{what}: DDATA {(self.host.data - data) / took:.0f}/s; broker {100 * used['broker']:.0f} % of a core, "
              f"{memory(self.broker.pid)[0]:.0f} MiB; {self.options.sessions} sessions {100 * used['sessions']:.0f} %, "
              f"{memory(self.sessions.pid)[0]:.0f} MiB; {len(self.gateways)} gateways {100 * used['gateways']:.0f} %", flush=True)

    def outage(self, what, end):
        """The broker ends and comes back; whether all births were there in time, and when each node was whole."""
        end(self.broker)
        self.broker.wait()
        self.host.forget()
        self.asked.clear()
        self.online.clear()
        time.sleep(self.options.outage)
        self.start_broker()
        began = time.monotonic()
        is_well = self.births(f"the broker {what}, back after {self.options.outage:.0f} s", began)
        print(f"  the broker took {processor_seconds(self.broker.pid):.1f} s of a core", flush=True)
        self.costs("  the 10 s after that", 10)
        unknown = sum(self.host.unknown.values())
        print(f"  status online: {len(self.online)}; data with an unknown alias: {unknown}; "
              f"asked again for their births: {len(self.asked)}", flush=True)
        return is_well and len(self.online) == len(self.names()) and not unknown, dict(self.host.whole_at)

    def missing_events(self):
        """Raised by the gateways, and not received by the host."""
        sockets = [(f"site-{n:04}", self.directory / f"site-{n:04}.socket") for n in range(self.options.processes)]
        raised = {(name, boot, id) for name, socket in sockets for boot, id in events_of(socket)}
        time.sleep(3)
        missing = raised - self.events.keys()
        print(f"  events: {len(raised)} raised, {len(missing)} not received, "
              f"{sum(count > 1 for count in self.events.values())} twice", flush=True)
        return len(missing)

    def lost(self):
        """Messages that gateways and sessions gave up."""
        self.sessions.stdin.close()
        self.sessions.wait(60)
        said = (self.directory / "sessions.log").read_text()
        count = int(said.rpartition("lost: ")[2].split()[0])
        for number in range(self.options.processes):
            lines = ask(self.directory / f"site-{number:04}.socket", "/metrics")[1].splitlines()
            count += sum(int(line.rsplit(" ", 1)[1]) for line in lines if line.startswith("drivegate_mqtt_lost_total"))
        return count


def likeness(first, second):
    """How much alike two orders are: 1 the same, 0 not at all."""
    names = first.keys() & second.keys()
    one, other = ({name: rank for rank, name in enumerate(sorted(names, key=times.get))} for times in (first, second))
    count = max(len(names), 2)
    return 1 - 6 * sum((one[name] - other[name]) ** 2 for name in names) / (count * (count**2 - 1))


def tried(fleet):
    options = fleet.options
    fleet.start_broker()
    fleet.watch()
    is_well = fleet.births("start, all at once", fleet.run())
    time.sleep(5)
    fleet.costs("quiet", options.seconds)

    used = processor_seconds(fleet.broker.pid)
    fleet.host.forget()
    began = time.monotonic()
    for name in fleet.names():
        fleet.client.publish(f"spBv1.0/{GROUP}/NCMD/{name}", rebirth(), 0)
    is_well &= fleet.births("rebirths of all, asked for at once", began)
    print(f"  the broker took {processor_seconds(fleet.broker.pid) - used:.1f} s of a core", flush=True)

    ok, first = fleet.outage("restarted", subprocess.Popen.terminate)
    is_well &= ok and not fleet.missing_events()
    ok, second = fleet.outage("killed", subprocess.Popen.kill)
    alike = likeness(first, second)
    print(f"order of the nodes in the two storms: {alike:.2f} alike", flush=True)
    is_well &= ok and alike < 0.3
    ended = [process.poll() for process in fleet.gateways if process.poll() is not None]
    lost = fleet.lost()
    print(f"lost: {lost}; gateways that ended: {len(ended)}", flush=True)
    return is_well and not lost and not ended


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--processes", type=int, default=100)
    parser.add_argument("--sessions", type=int, default=900)
    parser.add_argument("--drives", type=int, default=10)
    parser.add_argument("--cycle", default="10s", help="each drive has new values so often")
    parser.add_argument("--min-interval", type=float, default=0.05, help="`publish.min_interval`, s: how often each looks for what is new")
    parser.add_argument("--seconds", type=float, default=30)
    parser.add_argument("--outage", type=float, default=10)
    parser.add_argument("--binary", type=pathlib.Path, default=ROOT / "target/release/drivegate")
    parser.add_argument("--sessions-binary", type=pathlib.Path, required=True, help="benches/sessions.rs, built")
    options = parser.parse_args()
    attempt("thousand", options, Fleet, tried)


if __name__ == "__main__":
    main()
