#!/usr/bin/env python3
"""A session of Sparkplug B with pysparkplug as the host: births, a motor started and stopped, a refusal, a kill.

pysparkplug needs paho-mqtt 1.6, the other tests need 2.2, so it has an environment of its own. Prints one line for each step.
"""

import os
import queue
import signal
import socket
import subprocess
import sys
import tempfile
import time

from bench import DRIVEGATE
from programs import venv

PYSPARKPLUG = "pysparkplug==0.6.1"
try:
    import paho.mqtt.client as paho
    import pysparkplug as sparkplug
except ImportError:
    python = venv("sparkplug", [PYSPARKPLUG])
    os.execv(python, [python, *sys.argv])

PATIENCE = 60.0
GROUP, NODE = "plant", "pump-house"
KINDS = {
    "NBIRTH": sparkplug.NBirth,
    "DBIRTH": sparkplug.DBirth,
    "NDATA": sparkplug.NData,
    "DDATA": sparkplug.DData,
    "NDEATH": sparkplug.NDeath,
    "DDEATH": sparkplug.DDeath,
}

CONFIGURATION = """
[gateway]
name = "pump-house"
state_dir = "{dir}/state"
socket = "{dir}/drivegate.sock"

[[bus]]
name = "line1"
port = "{dir}/line1"
protocol = "modbus-rtu"
baud = 38400

[[bus.drive]]
name = "pump-1"
address = 1
profile = "vacon-nx"
access = "control"
limits = {{ speed_reference = [0.0, 60.0] }}

[[bus.drive]]
name = "pump-2"
address = 2
profile = "vacon-nx"

[mqtt]
url = "mqtt://127.0.0.1:{port}"
commands = true

[mqtt.sparkplug]
group = "plant"
"""


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Line:
    """The simulated line, which can be unplugged."""

    def __init__(self, child):
        self.child = child
        self.start()

    def start(self):
        self.process = self.child()

    def kill(self):
        self.process.kill()
        self.process.wait()


class Host:
    """Follows the node: the last values of each device, and the messages that were not looked at."""

    def __init__(self, port):
        self.messages = queue.Queue()
        self.births = {}
        self.values = {}
        self.seq = None
        self.client = paho.Client(client_id="host", protocol=paho.MQTTv5)
        self.client.on_message = lambda client, data, message: self.messages.put(message)
        self.client.connect("127.0.0.1", port)
        self.client.subscribe(f"spBv1.0/{GROUP}/#", qos=1)
        self.client.loop_start()

    def next(self, left):
        message = self.messages.get(timeout=left)
        levels = message.topic.split("/")
        kind, device = levels[2], levels[4] if len(levels) > 4 else ""
        if kind not in KINDS:
            return kind, device, None
        known = self.births.get(device) if kind.endswith("DATA") else None
        assert not kind.endswith("DATA") or known, f"{message.topic} without a birth"
        payload = KINDS[kind].decode(message.payload, **({"birth": known} if known else {}))
        if kind == "NBIRTH":
            assert payload.seq == 0, payload
            self.births.clear()
        elif kind != "NDEATH":
            assert payload.seq == (self.seq + 1) % 256, f"{message.topic}: {payload.seq} after {self.seq}"
        if kind != "NDEATH":
            self.seq = payload.seq
        if kind.endswith("BIRTH"):
            self.births[device] = payload
        for metric in getattr(payload, "metrics", ()):
            if not metric.is_historical:
                self.values[device, metric.name] = None if metric.is_null else metric.value
        return kind, device, payload

    def wait(self, what, holds):
        deadline = time.monotonic() + PATIENCE
        while True:
            left = deadline - time.monotonic()
            assert left > 0, f"waited in vain for {what}; known: {self.values}"
            try:
                seen = self.next(left)
            except queue.Empty:
                continue
            if holds(*seen):
                print(f"ok: {what}", flush=True)
                return seen[2]

    def wait_value(self, device, name, value):
        self.wait(f"{device} {name} = {value}", lambda *_: self.values.get((device, name)) == value)

    def command(self, device, *metrics):
        now = sparkplug.get_current_timestamp()
        metrics = [
            sparkplug.Metric(timestamp=now, name=name, datatype=datatype, value=value)
            for name, datatype, value in metrics
        ]
        payload = sparkplug.DCmd(timestamp=now, metrics=tuple(metrics)).encode(include_dtypes=True)
        self.client.publish(f"spBv1.0/{GROUP}/DCMD/{NODE}/{device}", payload, qos=0)

    def rebirth(self):
        now = sparkplug.get_current_timestamp()
        metric = sparkplug.Metric(
            timestamp=now, name="Node Control/Rebirth", datatype=sparkplug.DataType.BOOLEAN, value=True
        )
        payload = sparkplug.NCmd(timestamp=now, metrics=(metric,)).encode(include_dtypes=True)
        self.client.publish(f"spBv1.0/{GROUP}/NCMD/{NODE}", payload, qos=0)


def bd_seq(payload):
    if isinstance(payload, sparkplug.NDeath):
        return payload.bd_seq_metric.value
    return next(metric.value for metric in payload.metrics if metric.name == "bdSeq")


def session(host, start, line):
    boolean, double = sparkplug.DataType.BOOLEAN, sparkplug.DataType.DOUBLE
    gateway = start()
    born = host.wait("NBIRTH", lambda kind, *_: kind == "NBIRTH")
    for drive in ["pump-1", "pump-2"]:
        host.wait(f"DBIRTH {drive}", lambda kind, device, _, drive=drive: (kind, device) == ("DBIRTH", drive))
    host.wait_value("pump-1", "state", "ready")
    host.command("pump-1", ("run", boolean, True), ("speed_reference", double, 50.0))
    host.wait_value("pump-1", "running", True)
    host.wait_value("pump-1", "command_result", "confirmed")
    host.command("pump-1", ("speed_reference", double, 90.0))
    host.wait_value("pump-1", "command_result", "bad_value")
    print(f"    {host.values['pump-1', 'command_error']}")
    host.wait_value("pump-1", "speed_reference", 50.0)
    host.command("pump-2", ("run", boolean, True))
    host.wait_value("pump-2", "command_result", "not_allowed")
    host.command("pump-1", ("run", boolean, False))
    host.wait_value("pump-1", "running", False)
    line.kill()
    dead = set()
    host.wait(
        "DDEATH of both drives",
        lambda kind, device, _: kind == "DDEATH" and (dead.add(device) or dead == {"pump-1", "pump-2"}),
    )
    host.wait_value("", "Bus/line1/state", "down")
    line.start()
    host.wait("DBIRTH pump-1 again", lambda kind, device, _: (kind, device) == ("DBIRTH", "pump-1"))
    host.wait_value("pump-1", "state", "ready")
    asked = time.monotonic()
    host.rebirth()
    host.wait("NBIRTH on request", lambda kind, *_: kind == "NBIRTH")
    host.wait("DBIRTH on request", lambda kind, device, _: (kind, device) == ("DBIRTH", "pump-2"))
    print(f"    {(time.monotonic() - asked) * 1000:.0f} ms after the request")
    gateway.kill()
    gateway.wait()
    died = host.wait("NDEATH after kill -9", lambda kind, *_: kind == "NDEATH")
    assert bd_seq(died) == bd_seq(born)
    gateway = start()
    again = host.wait("NBIRTH of the next session", lambda kind, *_: kind == "NBIRTH")
    assert bd_seq(again) == bd_seq(born) + 1, "the session number goes on"
    gateway.send_signal(signal.SIGTERM)
    host.wait("NDEATH at the end", lambda kind, *_: kind == "NDEATH")
    assert gateway.wait(PATIENCE) == 0


def main():
    program = str(DRIVEGATE)
    os.environ["PATH"] += ":/usr/sbin"
    with tempfile.TemporaryDirectory() as place:
        port = free_port()
        with open(f"{place}/mosquitto.conf", "w") as file:
            file.write(f"allow_anonymous true\nlistener {port} 127.0.0.1\n")
        with open(f"{place}/drivegate.toml", "w") as file:
            file.write(CONFIGURATION.format(dir=place, port=port))
        children = []

        def child(*arguments):
            with open(f"{place}/log-{len(children)}", "wb") as log:
                children.append(subprocess.Popen(arguments, stdout=log, stderr=log))
            return children[-1]

        def start():
            return child(program, "run", "--config", f"{place}/drivegate.toml")

        try:
            child("mosquitto", "-c", f"{place}/mosquitto.conf")
            simulate = [program, "simulate", "--addresses", "1-2", "--link", f"{place}/line1", "--baud", "38400"]
            line = Line(lambda: child(*simulate))
            deadline = time.monotonic() + PATIENCE
            while True:
                assert time.monotonic() < deadline, "mosquitto or the simulated line does not start"
                try:
                    socket.create_connection(("127.0.0.1", port)).close()
                    os.stat(f"{place}/line1")
                    break
                except OSError:
                    time.sleep(0.05)
            session(Host(port), start, line)
        except BaseException:
            for number in range(len(children)):
                with open(f"{place}/log-{number}", errors="replace") as log:
                    print(log.read()[-2000:], file=sys.stderr)
            raise
        finally:
            for each in children:
                each.kill()
                each.wait()
    print("ok")


if __name__ == "__main__":
    main()
