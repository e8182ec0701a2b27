"""What is tried on a fleet: processes and what they cost, gateways with simulated drives that run under leases, a broker with TLS.

Everything listens on loopback and lives in one directory.
"""

import http.client
import json
import os
import pathlib
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.parse
import urllib.request

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parent.parent
sys.path.insert(0, str(ROOT / "deploy/fleet/plugins/module_utils"))
from toml_text import to_toml  # noqa: E402

MOSQUITTO = shutil.which("mosquitto") or "/usr/sbin/mosquitto"
PROMETHEUS = shutil.which("prometheus") or "/usr/bin/prometheus"
TICKS = os.sysconf("SC_CLK_TCK")
BAUD = 38400
CYCLE = 0.2
LEASE = 20


class Local(http.client.HTTPConnection):
    """A gateway at its local socket."""

    def __init__(self, path):
        super().__init__("gateway", timeout=10)
        self.path = str(path)

    def connect(self):
        self.sock = socket.socket(socket.AF_UNIX)
        self.sock.settimeout(10)
        self.sock.connect(self.path)


def ask(path, target, body=None):
    """Status and text of an answer."""
    connection = Local(path)
    try:
        connection.request("GET" if body is None else "POST", target, body)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()
    finally:
        connection.close()


def events_of(path):
    """Boot and number of the events of drives that a gateway raised: those that go to MQTT carry them."""
    found = json.loads(ask(path, "/api/v1/events/log?limit=10000")[1])
    found = found["events"] if isinstance(found, dict) else found
    return {(each["boot"], each["id"]) for each in found if each.get("drive")}


TAKEN = set()


def free_ports(count):
    """Below those that the system gives to connections: nobody takes one before its listener is there."""
    ports = []
    while len(ports) < count:
        port = random.randrange(20000, 32000)
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if port not in TAKEN and probe.connect_ex(("127.0.0.1", port)) != 0:
                TAKEN.add(port)
                ports.append(port)
    return ports


def slowness():
    """How many times longer things take than on an idle machine, about."""
    return min(max(1.0, os.getloadavg()[0] / os.cpu_count()), 8.0)


def until(what, ready, seconds=30):
    """Waits for so long; longer on a busy machine."""
    began = time.monotonic()
    while time.monotonic() < began + seconds * slowness():
        result = ready()
        if result:
            return result
        time.sleep(0.05)
    raise SystemExit(f"{what} did not happen within {time.monotonic() - began:.0f} s")


def listens(port):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def processor_seconds(pid):
    fields = pathlib.Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def memory(pid):
    """Resident and proportional memory in MiB."""
    text = pathlib.Path(f"/proc/{pid}/smaps_rollup").read_text()
    values = {line.split(":")[0]: int(line.split()[1]) for line in text.splitlines()[1:] if line.endswith("kB")}
    return values["Rss"] / 1024, values["Pss"] / 1024


def query_api(port, what, **parameters):
    """The data that Prometheus, or what is asked like it, answers with."""
    address = f"http://127.0.0.1:{port}/api/v1/{what}?" + urllib.parse.urlencode(parameters)
    with urllib.request.urlopen(address, timeout=60) as answer:
        return json.load(answer)["data"]


class Processes:
    """What was started, each with its log in the directory; ended with the program."""

    def __init__(self, directory):
        self.directory = directory
        self.processes = []

    def start(self, name, command, stdin=subprocess.DEVNULL, **environment):
        with open(self.directory / f"{name}.log", "ab") as log:
            process = subprocess.Popen([str(each) for each in command], stdin=stdin, stdout=log, stderr=log, env=os.environ | environment)
        self.processes.append(process)
        return process

    def end(self):
        for process in self.processes:
            if process.poll() is None:
                process.terminate()
        for process in self.processes:
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def attempt(name, options, make, tried):
    """Runs in a directory of its own, which stays for its logs if it was not well; ends the program."""
    directory = pathlib.Path(tempfile.mkdtemp(prefix=f"drivegate-{name}-"))
    print(f"{name}: {json.dumps(vars(options), default=str)}; logs in {directory}", flush=True)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    processes, is_well = make(directory, options), False
    try:
        is_well = tried(processes)
    finally:
        processes.end()
    if is_well:
        shutil.rmtree(directory)
    sys.exit(0 if is_well else 1)


def openssl(*arguments, **options):
    return subprocess.run(["openssl", *arguments], check=True, capture_output=True, **options).stdout


class Certificates:
    """An authority of the test with certificates that are good, and some that are not."""

    def __init__(self, directory):
        self.directory = directory
        directory.mkdir()
        self.authority("authority")
        self.authority("strange")
        self.issue("broker", 30)
        self.issue("client", 30)
        self.issue("expired", -1)

    def path(self, name):
        return str(self.directory / name)

    def authority(self, name):
        openssl("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "60",
                "-subj", f"/CN={name}", "-keyout", self.path(f"{name}.key"), "-out", self.path(f"{name}.crt"))

    def issue(self, name, days):
        request = openssl("req", "-new", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes",
                          "-subj", f"/CN={name}", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1",
                          "-keyout", self.path(f"{name}.key"))
        openssl("x509", "-req", "-CA", self.path("authority.crt"), "-CAkey", self.path("authority.key"),
                "-days", str(days), "-copy_extensions", "copy", "-out", self.path(f"{name}.crt"), input=request)


class Gateway:
    def __init__(self, plant, number):
        self.plant, self.number = plant, number
        self.name = f"g{number:02}"
        self.directory = plant.directory / self.name
        self.directory.mkdir()
        self.config = self.directory / "drivegate.toml"
        self.socket = self.directory / "socket"
        self.http, self.modbus = free_ports(2)
        self.drives = ["a1", "a2", "b1"]
        self.process = None

    def configuration(self):
        """Bus `a` is behind a line that knows its baud rate, bus `b` is not touched by any change."""
        def drive(name, address):
            return {"name": name, "address": address, "profile": "vacon-nx", "access": "control",
                    "supervision": {"timeout": f"{LEASE}s", "action": "stop"}}

        def bus(name, drives):
            return {"name": name, "port": str(self.directory / f"line-{name}"), "baud": BAUD, "cycle": "200ms",
                    "slow_cycle": "2s", "response_timeout": "300ms", "retries": 3, "drive": drives}

        certificates = self.plant.certificates
        return {
            "gateway": {"name": self.name, "socket": "socket", "state_dir": "state", "stale_after": "5s"},
            "bus": [bus("a", [drive("a1", 1), drive("a2", 2)]), bus("b", [drive("b1", 1) | {"unit": 11}])],
            "modbus_tcp": {"listen": [f"127.0.0.1:{self.modbus}"], "write": ["127.0.0.1/32"]},
            "mqtt": {"url": f"mqtts://localhost:{self.plant.broker_tls}", "ca": certificates.path("authority.crt"),
                     "certificate": certificates.path("client.crt"), "key": certificates.path("client.key"),
                     "topics": ["state"]},
            "http": {"listen": f"127.0.0.1:{self.http}", "certificate": "gateway.crt", "key": "gateway.key"},
            "recordings": {"max_count": 0},
        }

    def variables(self, configuration):
        """Of its host in the inventory."""
        return {
            "ansible_connection": "local",
            "ansible_python_interpreter": sys.executable,
            "drivegate_binary": str(self.plant.binary),
            "drivegate_config": str(self.config),
            "drivegate_url": f"https://localhost:{self.http}",
            "drivegate_ca": str(self.directory / "authority.crt"),
            "drivegate_install": False,
            "drivegate_patience": round(5 * slowness()),
            "drivegate_settle": 2,
            "drivegate_configuration": configuration,
        }

    def start(self):
        self.process = self.plant.start(self.name, [self.plant.binary, "run", "--config", self.config],
                                        RUNTIME_DIRECTORY=str(self.directory))

    def drive_states(self):
        return {each["name"]: each for each in json.loads(ask(self.socket, "/api/v1/drives")[1])}

    def buses(self):
        return {each["name"]: each for each in json.loads(ask(self.socket, "/api/v1/buses")[1])}

    def metric(self, name):
        """Its value, of all labels together."""
        lines = ask(self.socket, "/metrics")[1].splitlines()
        return sum(float(line.rsplit(" ", 1)[1]) for line in lines if line.startswith((name + "{", name + " ")))


class Plant(Processes):
    def __init__(self, directory, binary, gateways):
        super().__init__(directory)
        self.binary = binary
        self.certificates = Certificates(directory / "certificates")
        self.broker_tls, self.broker_plain = free_ports(2)
        self.broker()
        self.gateways = [Gateway(self, number) for number in range(gateways)]
        self.writes = directory / "writes"
        self.writes.touch()
        self.renewing = threading.Event()

    def broker(self):
        """Two listeners: TLS with certificates of clients, and one with a password."""
        passwords, config = self.directory / "passwords", self.directory / "mosquitto.conf"
        subprocess.run(["mosquitto_passwd", "-b", "-c", passwords, "fleet", "secret"], check=True, capture_output=True)
        certificates = self.certificates
        config.write_text(f"""per_listener_settings true
user {os.environ.get("USER", "root")}
listener {self.broker_tls} 127.0.0.1
cafile {certificates.path("authority.crt")}
certfile {certificates.path("broker.crt")}
keyfile {certificates.path("broker.key")}
require_certificate true
allow_anonymous true
listener {self.broker_plain} 127.0.0.1
password_file {passwords}
""")
        self.start("mosquitto", [MOSQUITTO, "-c", config])

    def simulate(self):
        """All drives, and the lines of the buses `a`."""
        buses, pairs = [], []
        for gateway in self.gateways:
            a, b = gateway.configuration()["bus"]
            pairs.append(f"{a['port']}={a['port']}-drives")
            buses += [a | {"name": f"{gateway.name}-a", "port": f"{a['port']}-drives"}, b | {"name": f"{gateway.name}-b"}]
        for bus in buses:
            bus["drive"] = [
                {"name": f"{bus['name']}-{each['address']}", "address": each["address"], "profile": "vacon-nx"}
                for each in bus["drive"]
            ]
        # A unit is unique in a configuration.
        for unit, each in enumerate((each for bus in buses for each in bus["drive"]), start=1):
            each["unit"] = unit
        lines = self.directory / "lines.toml"
        lines.write_text(to_toml({"gateway": {"name": "lines"}, "bus": buses}))
        self.start("lines", [self.binary, "simulate", "--config", lines, "--speed", "max"])
        until("the simulated lines", lambda: all(os.path.exists(bus["port"]) for bus in buses), 60)
        self.start("line", [sys.executable, HERE / "line.py", BAUD, self.writes, *pairs])
        until("the lines", lambda: all(os.path.exists(pair.split("=")[0]) for pair in pairs), 60)

    def run_gateways(self):
        for gateway in self.gateways:
            gateway.config.write_text(to_toml(gateway.configuration()))
            (gateway.directory / "state").mkdir()
            gateway.start()
        for gateway in self.gateways:
            until(f"the start of {gateway.name}", lambda: self.is_whole(gateway) and gateway.socket.exists(), 120)

    def is_whole(self, gateway):
        if gateway.process.poll() is not None:
            raise SystemExit(f"{gateway.name} ended; {gateway.directory}.log says why")
        try:
            drives = gateway.drive_states()
            return all(each["online"] for each in drives.values()) and gateway.metric("drivegate_mqtt_connected") == 1
        except OSError:
            return False

    def run_motors(self):
        """Each drive runs, and its lease is renewed from now on."""
        for gateway in self.gateways:
            threading.Thread(target=self.renew, args=[gateway], daemon=True).start()
        for gateway in self.gateways:
            for drive in gateway.drives:
                until(f"the start of {gateway.name} {drive}", lambda: self.command(gateway, drive), 10)
        until("the motors", lambda: all(self.running(gateway) for gateway in self.gateways))
        until("the count of starts", lambda: all(self.has_counted(gateway) for gateway in self.gateways))

    @staticmethod
    def command(gateway, drive):
        path = f"/api/v1/drives/{drive}/commands"
        return ask(gateway.socket, path, '{"run": true, "speed_reference": 50}')[0] == 200

    @staticmethod
    def has_counted(gateway):
        return gateway.metric("drivegate_drive_starts_total") == len(gateway.drives)

    def renew(self, gateway):
        while not self.renewing.wait(2):
            for drive in gateway.drives:
                try:
                    ask(gateway.socket, f"/api/v1/drives/{drive}/heartbeat", "")
                except (OSError, http.client.HTTPException):
                    pass

    def running(self, gateway):
        return all(each["state"] == "running" for each in gateway.drive_states().values())

    def end(self):
        self.renewing.set()
        super().end()
