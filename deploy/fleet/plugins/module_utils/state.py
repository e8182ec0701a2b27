"""What a running gateway says of itself, and what of it got worse."""

import fnmatch
import http.client
import json
import os
import re
import socket
import ssl
import urllib.parse

# Seconds for one answer.
PATIENCE = 10
DEFAULT_SOCKET = "/run/drivegate/drivegate.sock"

CONFIGURED, CONNECTED = "drivegate_mqtt_configured", "drivegate_mqtt_connected"
# Metrics of which 1 is good (or absent: what has it is gone), and what to say otherwise.
ONES = {
    "drivegate_drive_up": "drive {drive} is offline",
    "drivegate_bus_up": "bus {bus} is down",
    "drivegate_listener_up": "server {server} does not listen",
    CONFIGURED: "[mqtt] is gone",
    CONNECTED: "no connection to the broker",
    "drivegate_bacnet_bbmd_registered": "no registration at the BBMD",
}
# Metrics of which 0 is good, or as few as before. What is gone is worse for a lease: its drive has none any more.
COUNTS = {
    "drivegate_drive_fault": "drive {drive} has a fault",
    "drivegate_drive_unsupervised": "drive {drive} runs without a lease",
    "drivegate_supervision_actions_total": "the lease of drive {drive} ran out",
    "drivegate_supervision_failed_total": "the lease action of drive {drive} failed",
}
LEASE = "drivegate_drive_unsupervised"
LEASE_GONE = "drive {drive} has no lease any more"
SAMPLE = re.compile(r"(\w+)(?:\{(.*)\})? (\S+)\Z")
LABEL = re.compile(r'(\w+)="((?:[^"\\]|\\.)*)"')


class NoAnswer(Exception):
    """In words, with the place."""


class ByPath(http.client.HTTPConnection):
    """HTTP at a local socket."""

    def __init__(self, path):
        super().__init__("gateway", timeout=PATIENCE)
        self.path = path

    def connect(self):
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(PATIENCE)
        self.sock.connect(self.path)


class Door:
    """Where a gateway is asked: the path of a socket, or a URL."""

    def __init__(self, place, ca=None, token=None):
        self.place, self.ca, self.token = place, ca, token

    def connection(self):
        if self.place.startswith("/"):
            return ByPath(self.place), ""
        url = urllib.parse.urlsplit(self.place)
        if url.scheme == "https":
            context = ssl.create_default_context(cafile=self.ca)
            return http.client.HTTPSConnection(url.hostname, url.port, timeout=PATIENCE, context=context), url.path
        return http.client.HTTPConnection(url.hostname, url.port, timeout=PATIENCE), url.path

    def get(self, path):
        headers = {"Connection": "close"}
        if self.token:
            headers["Authorization"] = "Bearer " + self.token
        try:
            connection, base = self.connection()
            try:
                connection.request("GET", base.rstrip("/") + path, headers=headers)
                answer = connection.getresponse()
                body = answer.read().decode()
            finally:
                connection.close()
        except (OSError, ValueError, http.client.HTTPException) as error:
            raise NoAnswer(f"no gateway answers at {self.place}: {error}") from error
        if answer.status != 200:
            raise NoAnswer(f"{path} is answered with {answer.status} at {self.place}")
        return body


def socket_of(source, config, environment=None):
    """The local socket that a configuration names, or None: then its place depends on how the gateway was started."""
    environment = os.environ if environment is None else environment
    try:
        import tomllib

        named = tomllib.loads(source).get("gateway", {}).get("socket")
    except ImportError:
        # Python before 3.11.
        section = re.search(r"^\s*\[gateway\]\s*$(.*?)(?=^\s*\[|\Z)", source, re.MULTILINE | re.DOTALL)
        found = section and re.search(r"""^\s*socket\s*=\s*["']([^"']*)["']""", section.group(1), re.MULTILINE)
        named = found.group(1) if found else None
    except ValueError:
        named = None
    named = environment.get("DRIVEGATE__GATEWAY__SOCKET", named)
    if not isinstance(named, str) or not named:
        return None
    return os.path.join(os.path.dirname(os.path.abspath(config)), named)


def metrics(text):
    """Name and labels as one key, with the value, of the metrics that are compared."""
    found = {}
    for line in text.splitlines():
        sample = SAMPLE.match(line)
        if sample and (sample.group(1) in ONES or sample.group(1) in COUNTS):
            name, labels, value = sample.groups()
            labels = dict(LABEL.findall(labels or ""))
            found[json.dumps([name, labels], sort_keys=True)] = float(value)
    return found


def state(door, health):
    """The state of a gateway. `health` is whether it is ready, and the reasons why not."""
    drives = {
        drive["name"]: {name: drive.get(name) for name in ("access", "state", "quality", "held")}
        for drive in json.loads(door.get("/api/v1/drives"))
    }
    ready, reasons = health
    return {"ready": ready, "reasons": reasons, "drives": drives, "metrics": metrics(door.get("/metrics"))}


def of_drives(before, after):
    for name, was in before.items():
        now = after.get(name)
        if now is None:
            yield f"drive {name} is gone"
            continue
        if was["access"] == "control" != now["access"]:
            yield f"drive {name} takes no commands any more"
        if was["state"] == "running" != now["state"]:
            yield f"drive {name} no longer runs"
        if was["quality"] == "good" != now["quality"]:
            yield f"drive {name} is not read"
        if now["held"] and not was["held"]:
            yield f"drive {name} is held: {now['held']}"


def of_metrics(before, after, drives):
    for key, was in before.items():
        name, labels = json.loads(key)
        now = after.get(key)
        if "drive" in labels and labels["drive"] not in drives:
            continue
        if name == CONNECTED and after.get(key.replace(CONNECTED, CONFIGURED)) != 1:
            continue
        if name in ONES and was == 1 and now != 1:
            kind = next(iter(labels), "")
            is_gone = now is None and kind in ("server", "bus")
            yield f"{kind} {labels[kind]} is gone" if is_gone else ONES[name].format(**labels)
        elif name == LEASE and now is None:
            yield LEASE_GONE.format(**labels)
        elif name in COUNTS and now is not None and now > was:
            yield COUNTS[name].format(**labels)


def worse(before, after, accept=()):
    """What got worse, in words; what matches one of `accept` (with * and ?) is meant to be so."""
    found = [f"not ready: {reason}" for reason in after["reasons"] if reason not in before["reasons"]]
    if before["ready"] and not after["ready"] and not found:
        found.append("not ready")
    found += of_drives(before["drives"], after["drives"])
    found += of_metrics(before["metrics"], after["metrics"], after["drives"])
    return [each for each in dict.fromkeys(found) if not any(fnmatch.fnmatchcase(each, pattern) for pattern in accept)]
