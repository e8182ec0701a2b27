"""A broker, a simulated line and a gateway on free ports of 127.0.0.1."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
DRIVEGATE = Path(os.environ.get("DRIVEGATE", ROOT / "target" / "debug" / "drivegate"))
# Longest wait for something that has to happen, s.
PATIENCE = 60


def say(text):
    print(text, flush=True)


def fail(text):
    raise SystemExit(f"error: {text}")


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def until(what, condition, patience=PATIENCE):
    """Waits until `condition` returns something true; returns that and the seconds that it took."""
    begin = time.monotonic()
    while time.monotonic() - begin < patience:
        if result := condition():
            return result, time.monotonic() - begin
        time.sleep(0.01)
    fail(f"waited {patience} s in vain for {what}")


def expect(what, truth):
    if not truth:
        fail(f"not so: {what}")
    say(f"   ok: {what}")


class Bench:
    """What runs, in a directory of its own; everything ends with the `with` block."""

    def __enter__(self):
        signal.signal(signal.SIGTERM, lambda *_: fail("terminated"))
        self.stack = contextlib.ExitStack()
        self.dir = Path(self.stack.enter_context(tempfile.TemporaryDirectory(prefix="interop-")))
        self.mqtt, self.http = free_port(), free_port()
        self.has_broker = False
        return self

    def __exit__(self, error, *_):
        if error is not None:
            for log in sorted(self.dir.glob("*.log")):
                say(f"-- {log.name}\n{log.read_text()[-3000:]}")
        self.stack.close()

    def start(self, command, **more):
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True, **more)
        self.stack.callback(end, process)
        return process

    def broker(self):
        configuration = self.dir / "mosquitto.conf"
        configuration.write_text(f"persistence false\nallow_anonymous true\nlistener {self.mqtt} 127.0.0.1\n")
        log = (self.dir / "mosquitto.log").open("w")
        self.start(["mosquitto", "-c", configuration], stdout=log, stderr=log)
        until("mosquitto", lambda: reachable(self.mqtt))
        self.has_broker = True

    def line(self, drives):
        """Simulated drives of the NX family at the addresses from 1 on."""
        link = self.dir / "line"
        log = (self.dir / "simulate.log").open("w")
        command = [DRIVEGATE, "simulate", "--profile", "vacon-nx", "--addresses", f"1-{drives}", "--link", link]
        process = self.start([*command, "--baud", "115200"], stdout=log, stderr=log)
        until("the simulated line", link.exists)
        return process

    def configuration(self, drives, north="", monitored=()):
        """A configuration of these drives, for the broker if there is one; they may be commanded, except those `monitored`."""
        text = f'[gateway]\nname = "hall"\nsocket = ""\nstate_dir = "{self.dir}/state"\n'
        text += f'[[bus]]\nname = "line1"\nport = "{self.dir}/line"\nbaud = 115200\n'
        for address, name in enumerate(drives, 1):
            access = "monitor" if name in monitored else "control"
            text += f'[[bus.drive]]\nname = "{name}"\naddress = {address}\nprofile = "vacon-nx"\naccess = "{access}"\n'
            text += "limits = { speed_reference = [0.0, 80.0] }\n"
        text += f'[http]\nlisten = "127.0.0.1:{self.http}"\n'
        if self.has_broker:
            text += f'[mqtt]\nurl = "mqtt://127.0.0.1:{self.mqtt}"\ncommands = true\n'
        text += north
        path = self.dir / "drivegate.toml"
        path.write_text(text)
        return path

    def gateway(self, configuration):
        log = (self.dir / "drivegate.log").open("a")
        process = self.start([DRIVEGATE, "run", "--config", configuration], stdout=log, stderr=log)
        online = lambda: self.retained("drivegate/hall/status") == "online"
        until("the gateway", online if self.has_broker else lambda: self.get("/readyz"))
        return process

    def get(self, path):
        """What the gateway's HTTP server answers with 200, or None."""
        with contextlib.suppress(OSError), urllib.request.urlopen(f"http://127.0.0.1:{self.http}{path}", timeout=5) as answer:
            return answer.read()
        return None

    def point(self, drive, name):
        """The value of a point as the gateway has read it from the drive last."""
        return json.loads(self.get(f"/api/v1/drives/{drive}"))["points"][name]["value"]

    def retained(self, topic):
        """The retained message of a topic, or None."""
        answer = self.subscribe("-t", topic, "-C", "1", "-W", "2", "--retained-only", "-N")
        return answer or None

    def subscribe(self, *arguments):
        to = ["mosquitto_sub", "-V", "5", "-h", "127.0.0.1", "-p", str(self.mqtt)]
        return subprocess.run([*to, *arguments], capture_output=True, text=True).stdout

    def publish(self, topic, payload):
        to = ["mosquitto_pub", "-V", "5", "-h", "127.0.0.1", "-p", str(self.mqtt), "-q", "1"]
        subprocess.run([*to, "-t", topic, "-m", payload], check=True)


def reachable(port):
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
        return True
    return False


def end(process):
    """Ends a process that was started here, with its children."""
    for how in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, how)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(10)
            return
