#!/usr/bin/env python3
"""Gateways at brokers that are clusters of three nodes: what works, what a fault of a node costs.

GATEWAYS processes of `drivegate run`, a third at each node, with events, commands and Sparkplug. A node is killed and comes back, is
stopped for a while (as if the network were cut), and is restarted. Prints what a host at another node saw. Ends with 1 if a gateway did not
come back, or if a status or alias was wrong at the end.
"""

import argparse
import collections
import json
import os
import pathlib
import random
import shutil
import signal
import sys
import tempfile
import threading
import time

import paho.mqtt.client as paho
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from brokers import BROKERS
from plant import ROOT, Processes, ask, events_of, to_toml, until

CYCLE = "200ms"
# Seconds that a fault is watched after its end.
AFTER = 12


class Client:
    """A client of a node, with all that it received."""

    def __init__(self, node, name, topics=(), v5=True):
        self.messages, self.lock = [], threading.Lock()
        self.connected = threading.Event()
        self.subscribed = threading.Event()
        self.client = paho.Client(paho.CallbackAPIVersion.VERSION2, client_id=name, protocol=paho.MQTTv5)
        self.client.username_pw_set(name, "any")
        self.client.max_inflight_messages_set(1000)
        self.topics = [(topic, 1) for topic in topics]
        self.client.on_connect = self.on_connect
        self.client.on_message = self.on_message
        self.client.on_subscribe = self.on_subscribe
        self.codes = []
        self.client.connect("127.0.0.1", node.port, keepalive=20)
        self.client.loop_start()

    def on_connect(self, client, _data, _flags, reason, properties):
        self.properties = properties
        if self.topics:
            client.subscribe(self.topics)
        self.connected.set()

    def on_subscribe(self, _client, _data, _mid, codes, _properties):
        self.codes = codes
        self.subscribed.set()

    def on_message(self, _client, _data, message):
        with self.lock:
            self.messages.append((time.monotonic(), message))

    def ready(self):
        until("a connection", self.connected.is_set, 10)
        if self.topics:
            until("the subscription", self.subscribed.is_set, 10)
        return self

    def seen(self, accepts):
        with self.lock:
            return [(at, message) for at, message in self.messages if accepts(message.topic)]

    def publish(self, topic, payload, retain=False, qos=1, **properties):
        own = Properties(PacketTypes.PUBLISH)
        for name, value in properties.items():
            setattr(own, name, value)
        return self.client.publish(topic, payload, qos, retain, own)

    def end(self):
        self.client.disconnect()
        self.client.loop_stop()


def drop(client):
    """Closes the connection without a word, so that the last will is published."""
    client.client.loop_stop()
    client.client.socket().close()


class Features:
    """Whether a broker does what a gateway relies on, across nodes."""

    def __init__(self, broker):
        self.broker = broker
        self.first, self.last = broker.nodes[0], broker.nodes[-1]

    def all(self):
        names = ["plain topics", "order at QoS 1", "retained", "retained cleared", "retained expires", "last will", "response topic",
                 "user properties", "shared subscription", "wildcard in the middle"]
        found = {}
        for name in names:
            try:
                found[name] = bool(getattr(self, name.replace(" ", "_").lower())())
            except (OSError, SystemExit, ValueError):
                found[name] = False
        return found

    def pair(self, *topics):
        number = random.randrange(10**9)
        return Client(self.first, f"from{number}").ready(), Client(self.last, f"to{number}", topics).ready()

    def arrives(self, topic, count=1, seconds=5, **properties):
        sender, receiver = self.pair(topic)
        time.sleep(0.5)
        for number in range(count):
            sender.publish(topic, str(number), **properties)
        end = time.monotonic() + seconds
        while time.monotonic() < end and len(receiver.messages) < count:
            time.sleep(0.05)
        for each in (sender, receiver):
            each.end()
        return [message for _, message in receiver.messages]

    def plain_topics(self):
        return len(self.arrives("f/plain")) == 1

    def order_at_qos_1(self):
        return [int(each.payload) for each in self.arrives("f/order", 500, 20)] == list(range(500))

    def user_properties(self):
        found = self.arrives("f/user", UserProperty=[("who", "alice")])
        return dict(found[0].properties.UserProperty) == {"who": "alice"} if found else False

    def response_topic(self):
        found = self.arrives("f/response", ResponseTopic="f/answer", CorrelationData=b"7")
        return bool(found) and (found[0].properties.ResponseTopic, found[0].properties.CorrelationData) == ("f/answer", b"7")

    def wildcard_in_the_middle(self):
        sender, receiver = self.pair("f/w/+/set/#")
        time.sleep(0.5)
        sender.publish("f/w/a/set/run", "1")
        time.sleep(2)
        sender.end()
        receiver.end()
        return len(receiver.messages) == 1

    def late(self, topic):
        """What a client that comes later receives at the last node."""
        late = Client(self.last, f"late{random.randrange(10**9)}", [topic]).ready()
        time.sleep(2)
        late.end()
        return [message for _, message in late.messages]

    def keep(self, topic, payload, **properties):
        sender = Client(self.first, f"keep{random.randrange(10**9)}").ready()
        sender.publish(topic, payload, True, **properties).wait_for_publish(5)
        time.sleep(1)
        sender.end()

    def retained(self):
        self.keep("f/kept", "1")
        found = self.late("f/kept")
        return len(found) == 1 and found[0].retain

    def retained_cleared(self):
        self.keep("f/cleared", "1")
        self.keep("f/cleared", "")
        return not self.late("f/cleared")

    def retained_expires(self):
        self.keep("f/expires", "1", MessageExpiryInterval=4)
        before = len(self.late("f/expires"))
        time.sleep(4)
        return before == 1 and not self.late("f/expires")

    def last_will(self):
        receiver = Client(self.last, f"heir{random.randrange(10**9)}", ["f/will"]).ready()
        dying = Client.__new__(Client)
        dying.client = paho.Client(paho.CallbackAPIVersion.VERSION2, client_id=f"dying{random.randrange(10**9)}", protocol=paho.MQTTv5)
        dying.client.username_pw_set("dying", "any")
        dying.client.will_set("f/will", "gone", 1, True)
        dying.client.connect("127.0.0.1", self.first.port)
        dying.client.loop_start()
        time.sleep(1)
        drop(dying)
        time.sleep(4)
        receiver.end()
        return len(receiver.messages) == 1 and len(self.late("f/will")) == 1

    def shared_subscription(self):
        receivers = [Client(node, f"share{random.randrange(10**9)}", ["$share/g/f/shared"]).ready() for node in (self.first, self.last)]
        sender = Client(self.first, f"sharing{random.randrange(10**9)}").ready()
        time.sleep(1)
        for number in range(200):
            sender.publish("f/shared", str(number))
        time.sleep(4)
        for each in [sender, *receivers]:
            each.end()
        counts = [len(each.messages) for each in receivers]
        return sum(counts) == 200 and min(counts) > 0


class Gateway:
    """One with two drives: the first starts, stops and trips by itself, the second is commanded."""

    def __init__(self, site, number):
        self.site, self.name = site, f"c{number:02}"
        self.directory = site.directory / self.name
        self.directory.mkdir()
        nodes = site.broker.nodes
        self.order = [nodes[(number + turn) % len(nodes)] for turn in range(len(nodes))]
        self.socket = self.directory / "socket"

    def configuration(self):
        urls = [f"mqtt://127.0.0.1:{node.port}" for node in self.order]
        drives = [{"name": name, "address": at, "profile": "vacon-nx", "access": "control"} for at, name in enumerate(["auto", "set"], 1)]
        return {
            "gateway": {"name": self.name, "socket": "socket", "state_dir": "state"},
            "bus": [{"name": "a", "port": str(self.directory / "line"), "baud": 115200, "cycle": CYCLE, "slow_cycle": "2s",
                     "response_timeout": "300ms", "retries": 3, "drive": drives}],
            "mqtt": {"url": urls[0], "urls": urls[1:], "username": self.name, "password": "any", "commands": True, "topics": ["state"],
                     "sparkplug": {"group": "fleet"}},
            "recordings": {"max_count": 0},
        }

    def start(self):
        config = self.directory / "drivegate.toml"
        config.write_text(to_toml(self.configuration()))
        (self.directory / "state").mkdir()
        self.process = self.site.start(self.name, [self.site.binary, "run", "--config", config],
                                       RUNTIME_DIRECTORY=str(self.directory))

    def is_connected(self):
        try:
            return "drivegate_mqtt_connected 1" in ask(self.socket, "/metrics")[1]
        except OSError:
            return False

    def events(self):
        return events_of(self.socket)


class Site(Processes):
    def __init__(self, directory, binary, broker, gateways):
        super().__init__(directory)
        self.binary, self.broker = binary, broker
        self.gateways = [Gateway(self, number) for number in range(gateways)]

    def run(self):
        buses = []
        for gateway in self.gateways:
            bus = gateway.configuration()["bus"][0]
            for drive in bus["drive"]:
                drive |= {"name": f"{gateway.name}-{drive['name']}", "unit": len(buses) * 2 + drive["address"]}
            buses.append(bus | {"name": gateway.name})
        lines = self.directory / "lines.toml"
        lines.write_text(to_toml({"gateway": {"name": "lines"}, "bus": buses}))
        self.start("lines", [self.binary, "simulate", "--config", lines, "--speed", "max", "--autopilot"])
        until("the lines", lambda: all(os.path.exists(bus["port"]) for bus in buses), 60)
        for gateway in self.gateways:
            gateway.start()
        until("all gateways at the broker", self.all_connected, 60)

    def all_connected(self):
        return all(gateway.is_connected() for gateway in self.gateways)


class Host:
    """Watches all gateways at the last node, and commands them."""

    TOPICS = ["drivegate/+/status", "drivegate/+/drive/+/event", "drivegate/+/drive/+/result", "drivegate/+/drive/+/state", "spBv1.0/#"]

    def __init__(self, site):
        self.site, self.node = site, site.broker.nodes[-1]
        self.client = Client(self.node, "host", self.TOPICS).ready()
        self.sent, self.stop = {}, threading.Event()
        self.commander = threading.Thread(target=self.command, daemon=True)
        self.commander.start()

    def command(self):
        """One command after the other, ten a second, in turn to all gateways."""
        number = 0
        while not self.stop.wait(0.1):
            gateway = self.site.gateways[number % len(self.site.gateways)]
            number += 1
            payload = json.dumps({"id": number, "speed_reference": number % 100})
            self.client.publish(f"drivegate/{gateway.name}/drive/set/set", payload)
            self.sent[number] = (time.monotonic(), gateway.name)

    def results(self):
        found = {}
        for at, message in self.client.seen(lambda topic: topic.endswith("/result")):
            result = json.loads(message.payload)
            found.setdefault(result["id"], (at, result["result"]))
        return found

    def events(self):
        """How often each event came."""
        found = collections.Counter()
        for _, message in self.client.seen(lambda topic: topic.endswith("/event")):
            event = json.loads(message.payload)
            found[(message.topic.split("/")[1], event["boot"], event["id"])] += 1
        return found

    def births(self, since):
        seen = self.client.seen(lambda topic: "/NBIRTH/" in topic)
        return {message.topic.split("/")[-1] for at, message in seen if at >= since}


def statuses(node):
    """The retained status of each gateway, as a client sees it that comes now."""
    late = Client(node, f"late{random.randrange(10**9)}", ["drivegate/+/status"]).ready()
    time.sleep(2)
    late.end()
    return {message.topic.split("/")[1]: message.payload.decode() for _, message in late.messages}


def lost_events(site, host):
    """Raised by the gateways, and not received by the host."""
    received = {(name, boot, id) for name, boot, id in host.events()}
    raised = {(g.name, boot, id) for g in site.gateways for boot, id in g.events()}
    return len(raised), len(raised - received), sum(count - 1 for count in host.events().values())


def fault(site, host, name, harm, heal, wait):
    """Harms the first node and heals it after `wait`; what that costs, and what its return costs."""
    node, mended = site.broker.nodes[0], []
    began, before = time.monotonic(), len(host.client.seen(lambda topic: topic.endswith("/state")))
    worker = threading.Thread(target=lambda: (harm(node), time.sleep(wait), mended.append(time.monotonic()), heal(node)), daemon=True)
    worker.start()
    phases, now = [Phase(began), Phase(began + wait)], set()
    while time.monotonic() < began + wait + AFTER:
        phase = phases[bool(mended)]
        now = {gateway.name for gateway in site.gateways if not gateway.is_connected()}
        phase.see(now, time.monotonic())
        time.sleep(0.05)
    worker.join()
    took = time.monotonic() - began
    states = len(host.client.seen(lambda topic: topic.endswith("/state"))) - before
    commands = [number for number, (at, _) in list(host.sent.items()) if began <= at < began + took - 3]
    results = host.results()
    silent = [number for number in commands if number not in results]
    print(f"  {name}: {phases[0]}; at its return {phases[1]}; "
          f"commands {len(commands)}, without a result {len(silent)}; states {states / took:.0f}/s", flush=True)
    return not now


class Phase:
    """Who was away in a part of the trial, and until when."""

    def __init__(self, began):
        self.began, self.until, self.away = began, began, set()

    def see(self, away, at):
        self.away |= away
        self.until = at if away else self.until

    def __str__(self):
        return f"{len(self.away)} gateways away, until {self.until - self.began:.1f} s"


def wrong_statuses(site):
    """At each node, gateways that are not shown as online; asked again for a while."""
    end = time.monotonic() + 15
    while True:
        wrong = {node.number: sorted({g.name for g in site.gateways} - {n for n, s in statuses(node).items() if s == "online"})
                 for node in site.broker.nodes}
        if not any(wrong.values()) or time.monotonic() >= end:
            return wrong


def one(kind, tools, options, directory):
    broker = BROKERS[kind](directory / kind, tools)
    site, is_well = None, True
    try:
        broker.start()
        print(f"{kind}: {len(broker.nodes)} nodes", flush=True)
        if not options.only_faults:
            for name, works in Features(broker).all().items():
                print(f"  {name}: {'yes' if works else 'NO'}", flush=True)
        (directory / f"{kind}-site").mkdir()
        site = Site(directory / f"{kind}-site", options.binary.resolve(), broker, options.gateways)
        site.run()
        host = Host(site)
        used, began = broker.processor_seconds(), time.monotonic()
        time.sleep(15)
        used = (broker.processor_seconds() - used) / (time.monotonic() - began)
        print(f"  quiet: {len(site.gateways)} gateways, {len(host.client.messages) / 15:.0f} messages/s at the host, "
              f"all nodes {100 * used:.0f} % of a core, {', '.join(f'{each:.0f}' for each in broker.resident())} MiB", flush=True)
        faults = {
            "killed": (lambda node: node.end(), lambda node: node.start(), 12),
            "stopped": (lambda node: node.send(signal.SIGSTOP), lambda node: node.send(signal.SIGCONT), 45),
            "restarted": (lambda node: node.end(signal.SIGTERM), lambda node: node.start(), 0),
        }
        for name, (harm, heal, wait) in faults.items():
            if options.fault and name not in options.fault:
                continue
            mark = time.monotonic()
            raised, lost, twice = lost_events(site, host)
            is_well &= fault(site, host, name, harm, heal, wait)
            after = lost_events(site, host)
            wrong = wrong_statuses(site)
            births = host.births(mark)
            print(f"    events {after[0] - raised}, lost {after[1] - lost}, twice {after[2] - twice}; NBIRTH of {len(births)}; "
                  f"status not online: {wrong}", flush=True)
            is_well &= not any(wrong.values())
        host.stop.set()
        host.client.end()
    finally:
        if site:
            site.end()
        broker.end()
    return is_well


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--gateways", type=int, default=15)
    parser.add_argument("--broker", action="append", choices=BROKERS, default=[])
    parser.add_argument("--binary", type=pathlib.Path, default=ROOT / "target/release/drivegate")
    parser.add_argument("--tools", type=pathlib.Path, default=ROOT / ".tools/brokers")
    parser.add_argument("--only-faults", action="store_true")
    parser.add_argument("--fault", action="append", default=[], help="killed, stopped or restarted; without it all")
    parser.add_argument("--keep", action="store_true", help="keep the logs")
    options = parser.parse_args()
    directory = pathlib.Path(tempfile.mkdtemp(prefix="drivegate-cluster-"))
    print(f"cluster: logs in {directory}", flush=True)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    is_well = True
    for kind in options.broker or BROKERS:
        is_well &= one(kind, options.tools.resolve(), options, directory)
    if is_well and not options.keep:
        shutil.rmtree(directory)
    sys.exit(0 if is_well else 1)


if __name__ == "__main__":
    main()
