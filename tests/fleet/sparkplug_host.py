"""A Sparkplug host that keeps only what is needed to see whether births are whole: which device of which node was born, and which
aliases it has."""

import collections
import threading
import time


def fields(data):
    """Number and value of each field of a protobuf message; bytes for what has a length."""
    at = 0

    def varint():
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    while at < len(data):
        key = varint()
        number, kind = key >> 3, key & 7
        if kind == 0:
            yield number, varint()
        elif kind == 2:
            length = varint()
            yield number, data[at : at + length]
            at += length
        else:
            length = {1: 8, 5: 4}[kind]
            yield number, data[at : at + length]
            at += length


def metrics(payload):
    """Name (or None) and alias (or None) of each metric."""
    for number, value in fields(payload):
        if number == 2:
            own = dict(pair for pair in fields(value) if pair[0] in (1, 2))
            yield own.get(1), own.get(2)


def varint(value):
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def part(number, value):
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def rebirth():
    """The payload of an NCMD that asks for all births again."""
    metric = part(1, b"Node Control/Rebirth") + part(4, 11) + part(14, 1)
    return part(1, int(time.time() * 1000)) + part(2, metric)


class Host:
    def __init__(self, devices):
        self.devices, self.lock = devices, threading.Lock()
        self.aliases = {}
        self.born = {}
        self.whole_at = {}
        self.unknown = collections.Counter()
        self.data = 0

    def forget(self):
        """Births count from now on."""
        with self.lock:
            self.born, self.whole_at = {}, {}
            self.unknown.clear()

    def received(self, topic, payload):
        _, _, kind, node, *device = topic.split("/")
        device = device[0] if device else ""
        with self.lock:
            if kind == "NBIRTH":
                self.aliases[node] = {}
                self.born[node] = set()
            if kind in ("NBIRTH", "DBIRTH"):
                self.aliases.setdefault(node, {})[device] = {alias for _, alias in metrics(payload)}
                self.born.setdefault(node, set()).add(device)
                if len(self.born[node]) == self.devices + 1:
                    self.whole_at[node] = time.monotonic()
            elif kind == "DDATA":
                self.data += 1
                # Between the births of its node and its own there is no data of a device.
                known = self.aliases.get(node, {}).get(device)
                if known is None or any(alias is not None and alias not in known for name, alias in metrics(payload) if name is None):
                    self.unknown[node] += 1
            elif kind == "NDEATH":
                self.aliases.pop(node, None)
