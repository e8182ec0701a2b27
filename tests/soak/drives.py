"""Simulated Vacon NX drives on a raw serial-over-TCP line, independent of the gateway's own code.

Every value a drive says is known here: registers 2102 to 2109 have a band for each drive and register, and within it the
same step, which changes five times a second. A reply with a fault (wrong check code, wrong address, cut off) carries values of no
band: if one is ever read from the gateway, a frame was believed that must not be.
"""

import asyncio
import random
import struct
import time

STEPS = 100
STEP_SECONDS = 0.2
FIRST, LAST = 2102, 2109  # actual_speed to dc_link_voltage
REFERENCE = 2002
POISON = 0x7ABC

# Point of the common model: register and units for each count.
POINTS = {
    "actual_speed": (2102, 0.01),
    "output_frequency": (2103, 0.01),
    "motor_speed": (2104, 1.0),
    "motor_current": (2105, 0.1),
    "motor_torque": (2106, 0.1),
    "motor_power": (2107, 0.1),
    "motor_voltage": (2108, 0.1),
    "dc_link_voltage": (2109, 1.0),
}


def crc(data):
    """The check code of Modbus RTU, low byte first."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ (0xA001 if value & 1 else 0)
    return struct.pack("<H", value)


def band(address, register):
    """The count of `register` of the drive at `address` at step 0."""
    return address * 2000 + (register - FIRST) * 200


class Drive:
    """One drive: what it says, and when it said it."""

    def __init__(self, name, address):
        self.name, self.address = name, address
        self.said = {}  # step -> time of the last reply that carried it
        self.received = {}  # reference, in counts -> time of the last write
        self.control, self.reference, self.fault = 0, 0, 0
        self.warning = False
        self.silent_until = self.noisy_until = 0.0
        self.trips = 0

    def trip(self, code):
        if not self.fault:
            self.fault, self.trips = code, self.trips + 1

    def running(self):
        return bool(self.control & 1) and not self.fault

    def words(self, first, count, now):
        """What the drive says for these registers, and the step if there is one among them."""
        step = int(now / STEP_SECONDS) % STEPS
        running = self.running()
        status = 0b1 | running << 1 | bool(self.fault) << 3 | self.warning << 4 | running << 5 | (not running) << 6
        fixed = {
            2100: status, 2101: 1 << 13, 2110: self.fault, 98: self.fault, 2000: self.control, 2001: 0,
            REFERENCE: self.reference, 100: 0, 101: 5000,
        }
        words = []
        for register in range(first, first + count):
            if FIRST <= register <= LAST:
                words.append(band(self.address, register) + step)
            else:
                words.append(fixed.get(register, (self.address * 1000 + register) % 30000))
        return words, step if first <= LAST and first + count > FIRST else None

    def write(self, register, value, now):
        if register == 2000:
            if value & 4 and not self.control & 4:
                self.fault = 0
            self.control = value
        elif register == REFERENCE:
            self.reference = value
            self.received[value] = now

    def check(self, values, now, window):
        """What is wrong with `values` (point -> value) read from the gateway as good, or None.

        All of them come from one reply, so they carry one step, and the drive said it within `window` seconds.
        """
        steps = {}
        for point, value in values.items():
            register, unit = POINTS[point]
            count = round(value / unit)
            steps[point] = count - band(self.address, register)
        if len(set(steps.values())) != 1:
            return f"{self.name}: values of different replies: {values}"
        step = next(iter(steps.values()))
        if now - self.said.get(step, 0.0) > window:
            return f"{self.name}: not said within {window} s: {values}"
        return None


class Line:
    """A device server with drives behind it."""

    def __init__(self, drives, seed):
        self.drives = {drive.address: drive for drive in drives}
        self.random = random.Random(seed)
        self.writers = set()
        self.requests = 0

    async def start(self, port):
        await asyncio.start_server(self.serve, "127.0.0.1", port)

    def hang_up(self):
        """The device server drops its connections, as after a power failure."""
        for writer in list(self.writers):
            writer.close()

    async def serve(self, reader, writer):
        self.writers.add(writer)
        try:
            while True:
                head = await reader.readexactly(7)
                rest = head[6] + 2 if head[1] == 16 else 1
                frame = head + await reader.readexactly(rest)
                self.requests += 1
                if crc(frame[:-2]) != frame[-2:]:
                    # The gateway writes to a lossless connection: what does not fit is read away.
                    await reader.read(1024)
                    continue
                await self.reply(frame, writer)
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            self.writers.discard(writer)
            writer.close()

    async def reply(self, frame, writer):
        drive = self.drives.get(frame[0])
        now = time.monotonic()
        if drive is None or now < drive.silent_until:
            return
        # What wire and turnaround take.
        await asyncio.sleep(0.004)
        function, first, count = frame[1], *struct.unpack(">HH", frame[2:6])
        noisy = now < drive.noisy_until and self.random.random() < 0.3
        step = None
        if function in (3, 4):
            words, step = drive.words(first, count, now)
            if noisy:
                words, step = [POISON] * count, None
            body = bytes([drive.address, function, 2 * count]) + struct.pack(f">{count}H", *words)
        elif function == 6:
            drive.write(first, count, now)
            body = frame[:6]
        elif function == 16:
            for offset, value in enumerate(struct.unpack(f">{count}H", frame[7:-2])):
                drive.write(first + offset, value, now)
            body = frame[:6]
        else:
            body = bytes([drive.address, function | 0x80, 1])
        whole = body + crc(body)
        if noisy:
            whole = self.spoil(whole)
        if step is not None:
            drive.said[step] = time.monotonic()
        writer.write(whole)
        await writer.drain()

    def spoil(self, frame):
        """`frame` as a bad line delivers it; never a sound reply of this drive."""
        kind = self.random.randrange(4)
        if kind == 0:
            return frame[:-1] + bytes([frame[-1] ^ (1 << self.random.randrange(8))])
        if kind == 1:
            return frame[: self.random.randrange(1, len(frame) - 1)]
        if kind == 2:
            foreign = bytes([frame[0] + 40]) + frame[1:-2]
            return foreign + crc(foreign)
        return self.random.randbytes(self.random.randrange(1, 40))
