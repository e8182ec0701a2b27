#!/usr/bin/env python3
"""How old values are after a drive was silent, and how long it takes until all is as before.

`benches/healing.py BINARY [--rounds N]`: the gateway in real time with two drives each on a Modbus RTU, a Modbus ASCII and an N2 line
(raw serial over TCP, drives of this file alone). The first drive of each line is silent for a while; the age of its process data
is read over Modbus TCP (0x8002) all the time. Prints for each silence and cycle the time until the age is as before and stays so,
and the oldest value seen from 8 s on. Then N random silences: the median and the longest time until good again.
"""

import argparse
import asyncio
import random
import re
import struct
import subprocess
import sys
import tempfile
import time

SILENCES = (0.05, 0.15, 0.5, 0.8, 1.0, 1.5, 4.0)
CYCLES = (10, 20, 50, 200)
TIMEOUTS = {"rtu": 0.1, "ascii": 0.2, "n2": 0.25}


def crc(data):
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ (0xA001 if value & 1 else 0)
    return struct.pack("<H", value)


def modbus_reply(pdu):
    function, first, count = struct.unpack(">BHH", pdu[:5])
    if function in (3, 4):
        return bytes([function, 2 * count]) + struct.pack(f">{count}H", *(range(first % 1000, first % 1000 + count)))
    if function in (1, 2):
        return bytes([function, (count + 7) // 8]) + bytes((count + 7) // 8)
    return pdu[:5]


def n2_reply(body):
    def data(text):
        return "A" + text + "%02X" % (sum(map(ord, text)) % 256)

    if body == "F":
        return data("10")
    if body in ("04", "05"):
        return "A"
    if body[0] == "1":
        region, attribute = body[1], body[4:6]
        if region in "13" and attribute == "03":
            return data(struct.pack(">f", 25.0).hex().upper())
        if region in "24" and attribute == "02":
            return data("40")
        if region == "6":
            return data("0000")
    return "A" if body[0] == "7" else "N11"


class Line:
    """A device server with two drives, of which each can be silent."""

    def __init__(self, protocol, wire):
        self.protocol, self.wire = protocol, wire
        self.silent = {}

    async def start(self):
        server = await asyncio.start_server(self.serve, "127.0.0.1", 0)
        self.port = server.sockets[0].getsockname()[1]
        return self

    async def frame(self, reader):
        if self.protocol == "rtu":
            return await reader.readexactly(8)
        return await reader.readuntil(b"\n" if self.protocol == "ascii" else b"\r")

    def answer(self, frame):
        if self.protocol == "rtu":
            body = frame[:1] + modbus_reply(frame[1:-2])
            return frame[0], body + crc(body)
        if self.protocol == "ascii":
            raw = bytes.fromhex(frame.strip()[1:].decode())
            body = raw[:1] + modbus_reply(raw[1:-1])
            return raw[0], b":" + (body + bytes([-sum(body) & 0xFF])).hex().upper().encode() + b"\r\n"
        text = frame.strip().decode().lstrip(">")
        return int(text[:2], 16), (n2_reply(text[2:-2]) + "\r").encode()

    async def serve(self, reader, writer):
        try:
            while True:
                frame = await self.frame(reader)
                address, reply = self.answer(frame)
                if time.monotonic() < self.silent.get(address, 0):
                    continue
                await asyncio.sleep((len(frame) + len(reply)) * self.wire)
                writer.write(reply)
                await writer.drain()
        except (asyncio.IncompleteReadError, ConnectionError, asyncio.CancelledError):
            writer.close()


def configuration(lines, cycle):
    text = '[gateway]\nname = "healing"\n'
    for name, line in lines.items():
        protocol, profile, baud, form = {
            "rtu": ("modbus-rtu", "vacon-nx", 38400, "8N1"),
            "ascii": ("modbus-ascii", "teco-7300pa", 9600, "7E1"),
            "n2": ("n2", "vacon-nx-n2", 9600, "8N1"),
        }[name]
        text += f"""
[[bus]]
name = "{name}"
port = "tcp://127.0.0.1:{line.port}"
protocol = "{protocol}"
baud = {baud}
format = "{form}"
cycle = "{cycle}ms"
response_timeout = "{int(1000 * TIMEOUTS[name])}ms"
"""
        for address in (1, 2):
            unit = {"rtu": 0, "ascii": 10, "n2": 20}[name] + address
            text += f'[[bus.drive]]\nname = "{name}-{address}"\naddress = {address}\nprofile = "{profile}"\nunit = {unit}\n'
    return text + '[modbus_tcp]\nlisten = ["127.0.0.1:0"]\n[log]\nformat = "json"\n'


class Gateway:
    def __init__(self, binary, lines, cycle):
        self.directory = tempfile.TemporaryDirectory()
        text = configuration(lines, cycle).replace(
            'name = "healing"\n',
            f'name = "healing"\nsocket = "{self.directory.name}/s"\nstate_dir = "{self.directory.name}"\n', 1)
        path = f"{self.directory.name}/drivegate.toml"
        open(path, "w").write(text)
        self.process = subprocess.Popen([binary, "run", "--config", path], stdout=subprocess.PIPE, stderr=subprocess.STDOUT)

    async def connect(self):
        def port():
            for line in self.process.stdout:
                found = re.search(rb"127\.0\.0\.1:(\d+)", line) if b"odbus" in line and b"tcp://" not in line else None
                if found:
                    return int(found[1])
            raise SystemExit("the gateway did not start")

        number = await asyncio.to_thread(port)
        asyncio.get_running_loop().run_in_executor(None, lambda: [None for _ in self.process.stdout])
        self.reader, self.writer = await asyncio.open_connection("127.0.0.1", number)

    async def read(self, unit):
        self.writer.write(struct.pack(">HHHBBHH", 1, 0, 6, unit, 4, 0x8001, 2))
        head = await self.reader.readexactly(8)
        if head[7] & 0x80:
            await self.reader.readexactly(1)
            return 0, 65535
        return struct.unpack(">xHH", await self.reader.readexactly(5))

    def stop(self):
        self.process.kill()
        self.process.wait()
        self.directory.cleanup()


async def watch(gateway, units, ages, until):
    """Appends the age of the process data of each unit, with its time."""
    while time.monotonic() < until:
        for unit in units:
            state, age = await gateway.read(unit)
            ages[unit].append((time.monotonic(), age / 1000 if state else 99.0))
        await asyncio.sleep(0.01)


def healed(ages, end, usual):
    """Time from `end` on until no age is above the usual one any more; and the oldest from 8 s on."""
    bad = [at for at, age in ages if at >= end and age > usual]
    late = [age for at, age in ages if at >= end + 8]
    return max(bad, default=end) - end, max(late, default=0)


async def table(binary):
    print("silence     " + "".join(f"{s:>16} s" for s in SILENCES) + "   (until as before, s / oldest from 8 s on, ms)")
    for cycle in CYCLES:
        lines = {name: await Line(name, 0.0003 if name == "rtu" else 0.001).start() for name in TIMEOUTS}
        gateway = Gateway(binary, lines, cycle)
        await gateway.connect()
        units = {"rtu": 1, "ascii": 11, "n2": 21}
        ages = {unit: [] for unit in units.values()}
        await watch(gateway, units.values(), ages, time.monotonic() + 12)
        usual = {u: max(age for at, age in ages[u] if at > ages[u][-1][0] - 5) for u in ages}
        rows = {name: [] for name in units}
        for silence in SILENCES:
            for log in ages.values():
                log.clear()
            end = time.monotonic() + silence
            for line in lines.values():
                line.silent[1] = end
            await watch(gateway, units.values(), ages, end + 14)
            for name, unit in units.items():
                rows[name].append(healed(ages[unit], end, 1.5 * usual[unit] + 0.02))
        gateway.stop()
        for name, row in rows.items():
            print(f"{name:>5} {cycle:>4} ms " + "".join(f"{t:>10.2f} /{1000 * age:>5.0f}" for t, age in row)
                  + f"   usual {1000 * usual[units[name]]:.0f} ms", flush=True)


async def rounds(binary, count):
    lines = {name: await Line(name, 0.0003 if name == "rtu" else 0.001).start() for name in TIMEOUTS}
    gateway = Gateway(binary, lines, 20)
    await gateway.connect()
    units = {("rtu", 1): 1, ("rtu", 2): 2, ("ascii", 1): 11, ("ascii", 2): 12, ("n2", 1): 21, ("n2", 2): 22}
    ages = {unit: [] for unit in units.values()}
    await watch(gateway, units.values(), ages, time.monotonic() + 12)
    usual = {u: max(age for at, age in ages[u] if at > ages[u][-1][0] - 5) for u in ages}
    times = {name: [] for name in TIMEOUTS}
    dice = random.Random(1)
    while sum(map(len, times.values())) < count:
        for log in ages.values():
            log.clear()
        now, ends = time.monotonic(), {}
        for name in TIMEOUTS:
            address = dice.choice((1, 2))
            ends[name, address] = lines[name].silent[address] = now + dice.uniform(0.02, 1.5)
        await watch(gateway, units.values(), ages, now + 6)
        for (name, address), end in ends.items():
            unit = units[name, address]
            times[name].append(healed(ages[unit], end, 1.5 * usual[unit] + 0.02)[0])
    gateway.stop()
    for name, row in times.items():
        row.sort()
        print(f"{name}: {len(row)} random silences of 0.02 to 1.5 s: good again after {row[len(row) // 2]:.2f} s (median), {row[-1]:.2f} s (longest)")


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("binary")
parser.add_argument("--rounds", type=int, default=200)
parser.add_argument("--only-rounds", action="store_true")
options = parser.parse_args()
if not options.only_rounds:
    asyncio.run(table(options.binary))
asyncio.run(rounds(options.binary, options.rounds))
sys.exit(0)
