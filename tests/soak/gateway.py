"""The processes of the soak: gateways, the simulated lines, the broker; their files."""

import asyncio
import os
import pathlib
import signal
import socket
import subprocess


def free_port():
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


BUS = """
[[bus]]
name = "{name}"
port = "{port}"
protocol = "{protocol}"
cycle = "{cycle}"
response_timeout = "150ms"
{more}
"""

DRIVE = """
[[bus.drive]]
name = "{name}"
address = {address}
unit = {unit}
profile = "{profile}"
access = "control"
"""

# Name, protocol, cycle, profile, drives, further keys: lines on pseudo-terminals with the drives of `drivegate simulate`.
SIMULATED = (
    ("rtu", "modbus-rtu", "50ms", "vacon-nx", 3, 'baud = 38400\nformat = "8N1"'),
    ("ascii", "modbus-ascii", "500ms", "teco-7300pa", 2, 'baud = 19200\nformat = "7N2"'),
    ("n2", "n2", "500ms", "vacon-nx-n2", 2, "baud = 9600"),
)


def buses(remote, drives, directory, fewer=False):
    """The text of all buses, and the names of the drives on the simulated ones."""
    text = ""
    if remote:
        text += BUS.format(name="remote", port=f"tcp://127.0.0.1:{remote}", protocol="modbus-rtu", cycle="100ms", more="")
        for drive in drives:
            text += DRIVE.format(name=drive.name, address=drive.address, unit=drive.unit, profile="vacon-nx")
    names = []
    for index, (name, protocol, cycle, profile, count, more) in enumerate(SIMULATED if directory else ()):
        text += BUS.format(name=name, port=directory / name, protocol=protocol, cycle=cycle, more=more)
        for address in range(1, count + (0 if fewer and name == "ascii" else 1)):
            names.append(f"{name}-{address}")
            text += DRIVE.format(name=names[-1], address=address, unit=20 + 10 * index + address, profile=profile)
    return text, names


def unit_environment():
    """The environment that the systemd unit gives the service."""
    unit = pathlib.Path(__file__).resolve().parents[2] / "systemd/drivegate.service"
    lines = [line.split("=", 1)[1] for line in unit.read_text().splitlines() if line.startswith("Environment=")]
    return dict(part.split("=", 1) for line in lines for part in line.split())


class Program:
    """A child process with its log; it ends with the soak."""

    def __init__(self, name, directory, command, env=None):
        self.name, self.command = name, [str(part) for part in command]
        self.log = directory / f"{name}.log"
        self.env = {**os.environ, **(env or {})}
        self.child = None

    def start(self):
        with open(self.log, "ab") as log:
            self.child = subprocess.Popen(self.command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=self.env)

    def send(self, number):
        self.child.send_signal(number)

    def gone(self):
        return self.child.poll() is not None

    async def end(self, number=signal.SIGTERM, seconds=60):
        """The exit code; None if it did not end in time and was killed."""
        if self.child is None:
            return None
        if not self.gone():
            self.send(number)
        for _ in range(seconds * 10):
            if self.gone():
                return self.child.returncode
            await asyncio.sleep(0.1)
        self.child.kill()
        self.child.wait()
        return None


class Gateway(Program):
    """`drivegate run` with its configuration."""

    def __init__(self, name, directory, binary, remote, drives, simulated, broker, state, env=None):
        self.config = directory / f"{name}.toml"
        self.modbus, self.http = free_port(), free_port()
        self.parts = (remote, drives, simulated)
        self.broker, self.state, self.directory = broker, state, directory
        self.write()
        super().__init__(name, directory, [binary, "run", "--config", self.config], {**unit_environment(), **(env or {})})

    def text(self, fewer=False, level="info"):
        lines, self.names = buses(*self.parts, fewer)
        text = f"""
[gateway]
name = "soak"
state_dir = "{self.state}"
socket = "{self.config.with_suffix(".sock")}"
{lines}
[modbus_tcp]
listen = ["127.0.0.1:{self.modbus}"]
allow = ["127.0.0.0/8"]
write = ["127.0.0.1/32"]
max_connections = 64
[http]
listen = "127.0.0.1:{self.http}"
[audit]
max_bytes = "1MiB"
[recordings]
max_bytes = "2MiB"
max_count = 20
before = "10s"
after = "5s"
[log]
level = "{level}"
format = "json"
"""
        if self.broker:
            text += f"""
[mqtt]
url = "mqtt://127.0.0.1:{self.broker}"
base = "drivegate"
commands = true
history = "changes"
publish = {{ min_interval = "250ms", max_interval = "60s" }}
buffer = {{ dir = "{self.state}/mqtt", max_bytes = "1MiB" }}
"""
        return text

    def write(self, **changes):
        self.config.write_text(self.text(**changes))

    def reload(self, broken=False, **changes):
        """Asks for a reload with a file that is sound or is refused; a refused one is replaced by the sound one afterwards."""
        sound = self.text(**changes)
        self.config.write_text(sound.replace("[audit]", '[audit]\nfil = "x"') if broken else sound)
        self.send(signal.SIGHUP)


def broker_program(directory, port):
    config = directory / "mosquitto.conf"
    config.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\nmax_queued_messages 100000\n")
    return Program("mosquitto", directory, ["mosquitto", "-c", config])


def libfaketime():
    """The library that lets a process see another clock, if it is there."""
    named = os.environ.get("LIBFAKETIME")
    found = [pathlib.Path(named)] if named else sorted(pathlib.Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1"))
    return found[0] if found and found[0].is_file() else None
