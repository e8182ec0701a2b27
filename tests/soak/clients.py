"""Clients of the soak: those that behave, and check what they get, and those that do not."""

import asyncio
import json
import math
import random
import socket
import struct

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion

from drives import POINTS

# How old a value may be that the gateway calls good: `stale_after`, and what a busy machine adds until it is looked at here.
WINDOW = 6.0

# Exceptions of Modbus TCP writes that say that nothing was sent; all others leave it open.
REFUSED = {1: "not_allowed", 2: "not_writable", 3: "bad_value", 6: "queue_full"}

METRICS = {
    "drivegate_drive_actual_speed_percent": "actual_speed",
    "drivegate_drive_output_frequency_hertz": "output_frequency",
    "drivegate_drive_motor_speed_rpm": "motor_speed",
    "drivegate_drive_motor_current_amperes": "motor_current",
    "drivegate_drive_motor_torque_percent": "motor_torque",
    "drivegate_drive_motor_power_percent": "motor_power",
    "drivegate_drive_motor_voltage_volts": "motor_voltage",
    "drivegate_drive_dc_link_voltage_volts": "dc_link_voltage",
}


class Mqtt:
    """Places orders on set topics; takes results and states."""

    def __init__(self, port, base, drives, orders, judge):
        self.port, self.base, self.drives = port, base, {drive.name: drive for drive in drives}
        self.orders, self.judge = orders, judge
        self.quiet = False
        self.subscribed = False
        self.sequence = 0
        self.events = {}
        self.loop = asyncio.get_running_loop()
        self.client = mqtt.Client(CallbackAPIVersion.VERSION2, client_id="soak-client", protocol=mqtt.MQTTv5)
        self.client.reconnect_delay_set(1, 2)
        self.client.on_connect = self.connected
        self.client.on_disconnect = self.disconnected
        self.client.on_message = lambda _c, _u, message: self.loop.call_soon_threadsafe(self.message, message)
        self.client.connect_async("127.0.0.1", port)
        self.client.loop_start()

    def connected(self, client, *_):
        client.subscribe([(f"{self.base}/drive/+/{kind}", 1) for kind in ("result", "state", "event")])
        self.subscribed = True

    def disconnected(self, *_):
        self.subscribed = False

    def message(self, message):
        kind, drive = message.topic.rsplit("/", 1)[1], self.drives.get(message.topic.split("/")[-2])
        if kind == "state" and not message.payload:
            return  # cleared: a reload removed the drive
        try:
            payload = json.loads(message.payload)
        except ValueError:
            self.judge.violation(f"not JSON on {message.topic}: {message.payload[:80]}")
            return
        if kind == "result" and isinstance(payload["id"], str) and payload["id"].startswith("soak-"):
            self.orders.answer(payload["id"], payload["result"])
        elif kind == "event":
            self.events[payload["event"]] = self.events.get(payload["event"], 0) + 1
        elif kind == "state" and drive and not message.retain and payload["quality"] == "good":
            values = {point: payload[point] for point in POINTS if payload.get(point) is not None}
            if values:
                self.judge.reading(drive, values, WINDOW)

    def order(self, drive_name, points=None):
        """A reference that no other order has, together with run."""
        if self.quiet or not self.subscribed:
            return
        self.sequence += 1
        order, reference = f"soak-{self.sequence}", None
        if points is None:
            reference = self.orders.reference()
            points = {"run": True, "speed_reference": reference / 100}
        self.orders.place(order, self.drives.get(drive_name), reference)
        payload = json.dumps({"id": order, **points})
        self.client.publish(f"{self.base}/drive/{drive_name}/set", payload, qos=1)

    def nonsense(self, drive_name):
        """Messages that must all be refused, one of them retained."""
        if self.quiet or not self.subscribed:
            return
        topic = f"{self.base}/drive/{drive_name}/set"
        for payload in ("", "{", "[]", '{"run": "yes"}', '{"speed_reference": 1e999}', '{"run": true, "run": false}', b"\xff" * 300):
            self.client.publish(topic, payload, qos=1)
        self.client.publish(f"{topic}/speed_reference", "77", qos=1, retain=True)
        self.client.publish(f"{topic}/speed_reference", "", qos=1, retain=True)
        self.client.publish(f"{self.base}/drive/nobody/set", "{}", qos=1)

    def stop(self):
        self.client.disconnect()
        self.client.loop_stop()


class Modbus:
    """A pipelining Modbus TCP client; each transaction has exactly one reply."""

    def __init__(self, port, drives, orders, judge, name):
        self.port, self.drives, self.orders, self.judge, self.name = port, drives, orders, judge, name
        self.transaction, self.waiting, self.writer = 0, {}, None
        self.ending = False

    async def connect(self):
        reader, self.writer = await asyncio.open_connection("127.0.0.1", self.port)
        self.task = asyncio.create_task(self.receive(reader))

    async def receive(self, reader):
        try:
            while True:
                head = await reader.readexactly(7)
                transaction, protocol, length, unit = struct.unpack(">HHHB", head)
                pdu = await reader.readexactly(length - 1)
                entry = self.waiting.pop(transaction, None)
                if entry is None or protocol or entry[0] != unit or pdu[0] & 0x7F != entry[1]:
                    self.judge.violation(f"Modbus TCP: a reply that belongs to no request: {head.hex()} {pdu.hex()}")
                else:
                    entry[2](pdu)
        except (asyncio.IncompleteReadError, ConnectionError) as error:
            if not self.ending:
                self.judge.violation(f"Modbus TCP: the gateway closed the connection of a client that behaves: {error}")

    def send(self, unit, pdu, done):
        self.transaction = (self.transaction + 1) % 0x10000
        if self.transaction in self.waiting:
            self.judge.violation(f"Modbus TCP: no reply within 65536 requests: {self.waiting[self.transaction]}")
        self.waiting[self.transaction] = (unit, pdu[0], done)
        self.writer.write(struct.pack(">HHHB", self.transaction, 0, len(pdu) + 1, unit) + pdu)

    def read(self, drive):
        """The floats of the common model, and the drive's own registers."""
        self.send(drive.unit, struct.pack(">BHH", 3, 0x8200, 16), lambda pdu: self.floats(drive, pdu))
        self.send(drive.unit, struct.pack(">BHH", 3, 2102, 8), lambda pdu: self.raw(drive, pdu))

    def floats(self, drive, pdu):
        if pdu[0] & 0x80:
            return
        numbers = struct.unpack(">8f", pdu[2:])
        values = {point: value for point, value in zip(POINTS, numbers) if not math.isnan(value)}
        if values:
            self.judge.reading(drive, values, WINDOW)

    def raw(self, drive, pdu):
        if not pdu[0] & 0x80:
            words = struct.unpack(">8H", pdu[2:])
            self.judge.reading(drive, {point: word * unit for (point, (_, unit)), word in zip(POINTS.items(), words)}, WINDOW)

    def order(self, drive):
        reference = self.orders.reference()
        order = f"{self.name}-{self.orders.placed}"

        def done(pdu):
            if pdu[0] & 0x80:
                self.orders.answer(order, REFUSED.get(pdu[1], f"exception_{pdu[1]}"))
            elif pdu[1:] != struct.pack(">HH", 0x8101, reference):
                self.judge.violation(f"Modbus TCP: the reply to {order} is {pdu.hex()}")
            else:
                self.orders.answer(order, "acknowledged")

        self.orders.place(order, drive, reference)
        self.send(drive.unit, struct.pack(">BHH", 6, 0x8101, reference), done)

    def stop(self):
        self.ending = True
        self.writer.close()


async def http_get(port, path, timeout=15):
    """Status and body."""
    async with asyncio.timeout(timeout):
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
        whole = await reader.read(-1)
        writer.close()
    head, _, body = whole.partition(b"\r\n\r\n")
    if b"transfer-encoding: chunked" in head.lower():
        plain = b""
        while body:
            size, _, body = body.partition(b"\r\n")
            plain, body = plain + body[: int(size, 16)], body[int(size, 16) + 2 :]
        body = plain
    return int(head.split()[1]), body.decode()


async def read_http(port, drives, judge):
    """The JSON of all drives and the metrics, compared with what the drives said."""
    by_name = {drive.name: drive for drive in drives}
    _, body = await http_get(port, "/api/v1/drives")
    listed = json.loads(body)
    for entry in listed if isinstance(listed, list) else listed["drives"]:
        drive, points = by_name.get(entry["name"]), entry["points"]
        values = {p: points[p]["value"] for p in POINTS if p in points and points[p].get("quality") == "good"}
        if drive and values:
            judge.reading(drive, values, WINDOW)
    _, body = await http_get(port, "/metrics")
    found = {}
    for line in body.splitlines():
        name, _, rest = line.partition("{")
        if name in METRICS:
            labels, _, value = rest.rpartition("} ")
            drive = next((part[7:-1] for part in labels.split(",") if part.startswith('drive="')), None)
            found.setdefault(drive, {})[METRICS[name]] = float(value)
    for name, values in found.items():
        if name in by_name:
            judge.reading(by_name[name], values, WINDOW)


class Hostile:
    """Strangers at 127.0.0.2: they may read, and do everything else wrong."""

    def __init__(self, modbus_port, http_port, seed):
        self.ports, self.random, self.open = (modbus_port, http_port), random.Random(seed), []

    async def connect(self, port):
        # A small receive buffer, so that one who reads nothing is soon noticed.
        sock = socket.socket()
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        sock.bind(("127.0.0.2", 0))
        sock.setblocking(False)
        await asyncio.get_running_loop().sock_connect(sock, ("127.0.0.1", port))
        return sock

    async def act(self):
        """One deed; the connection stays open for a while or is cut at once."""
        modbus, http = self.ports
        deed = self.random.randrange(8)
        port = http if deed >= 5 else modbus
        try:
            sock = await self.connect(port)
        except OSError:
            return
        read = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 0x8000, 100)
        data = {
            0: self.random.randbytes(200),
            1: read[:7],
            2: read * 200,
            3: struct.pack(">HHHBBHH", 1, 0, 6, 1, 6, 0x8100, 1) * 20,
            4: b"",
            5: b"GET / HTTP/1.1\r\nHost: loc",
            6: b"GET /" + b"x" * 20000 + b" HTTP/1.1\r\n\r\n",
            7: b"GET /api/v1/events HTTP/1.1\r\nHost: localhost\r\n\r\n",
        }[deed]
        try:
            await asyncio.wait_for(asyncio.get_running_loop().sock_sendall(sock, data), 2)
        except (OSError, TimeoutError):
            pass
        self.open.append(sock)
        while len(self.open) > 24:
            self.open.pop(self.random.randrange(len(self.open))).close()

    def leave(self):
        for sock in self.open:
            sock.close()
        self.open.clear()
