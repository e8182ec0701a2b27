"""What the simulated drives of the families share: Modbus RTU over TCP, a motor with a ramp, and a log on stdout.

Address 1. Every write is printed as `wrote TABLE ADDRESS VALUE` (hexadecimal), every change of the motor as `motor forward`,
`motor reverse` or `motor stopped`. SIGUSR1 trips the drive, SIGUSR2 stops it at its panel, SIGHUP switches it off and on. An
unprepared drive never becomes ready.

Where a drive has a timeout of its own, a signal acts at the next read: nobody who writes can know what happened at the panel since
the read that the write rests on.
"""

import signal
import socket
import struct
import threading
import time

RAMP = 100.0  # percent per second
TURNAROUND = 0.01  # s; longer than a request takes on the line
TIMEOUT = 0.0  # s without a write after which a running drive trips; 0: never


def crc(data):
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ 0xA001 if value & 1 else value >> 1
    return struct.pack("<H", value)


def signed(word):
    return word - 0x10000 if word & 0x8000 else word


def unsigned(number):
    return round(number) & 0xFFFF


class Refused(Exception):
    def __init__(self, code):
        super().__init__(code)
        self.code = code


class Drive:
    """A drive with registers `holding` and `coils`; a family says what its words do in `wrote` and shows its state in `show`."""

    FUNCTIONS = {3, 6, 16}
    MOST_READ = 125
    MOST_WRITE = 123

    def __init__(self, unprepared=False):
        self.unprepared = unprepared
        self.holding = {}
        self.coils = {}
        self.inputs = {}
        self.read_only = set()
        self.write_only = set()
        self.faulted = False
        self.timed_out = False  # the fault is that of its own timeout
        self.direction = 0  # -1, 0, 1: as commanded
        self.speed = 0.0  # percent, signed
        self.target = 0.0  # percent, without the direction's sign
        self.turning = 0
        self.fed = time.monotonic()
        self.happening = []
        self.lock = threading.RLock()

    # What a family defines.
    def wrote(self, table, address, value):
        """A register or coil got a new value."""

    def show(self):
        """Puts the state into the registers."""

    # What it uses.
    def log(self, text):
        print(text, flush=True)

    def start(self, direction):
        if self.faulted or self.unprepared:
            return
        self.direction = direction

    def stop(self):
        self.direction = 0

    def coast(self):
        self.direction = 0
        self.speed = 0.0

    def trip(self):
        with self.lock:
            self.faulted = True
            self.coast()
            self.log("tripped")
            self.tripped()
            self.moved()
            self.show()

    def panel(self):
        with self.lock:
            self.coast()
            self.log("stopped at the panel")
            self.stopped()
            self.moved()
            self.show()

    def stopped(self):
        """The drive was stopped at its panel."""

    def restart(self):
        with self.lock:
            lock, turning, happening = self.lock, self.turning, self.happening
            self.__init__(self.unprepared)
            self.lock, self.turning, self.happening = lock, turning, happening
            self.log("restarted")
            self.moved()
            self.show()

    def tripped(self):
        """The drive tripped; a family may lock itself until its start sequence begins anew."""

    def reset(self):
        if self.faulted:
            self.faulted = self.timed_out = False
            self.log("reset")

    @property
    def running(self):
        return self.direction != 0 or self.speed != 0.0

    @property
    def at_reference(self):
        return self.direction != 0 and self.speed == self.target * self.direction

    def moved(self):
        turning = (self.direction > 0) - (self.direction < 0) or (self.speed > 0) - (self.speed < 0)
        if turning != self.turning:
            self.turning = turning
            self.log({0: "motor stopped", 1: "motor forward", -1: "motor reverse"}[turning])

    def tick(self, seconds):
        with self.lock:
            if TIMEOUT and self.running and time.monotonic() - self.fed > TIMEOUT:
                self.log("own timeout")
                self.timed_out = True
                self.trip()
            aim = self.target * self.direction
            step = RAMP * seconds
            self.speed = aim if abs(aim - self.speed) <= step else self.speed + (step if aim > self.speed else -step)
            self.moved()
            self.show()

    # Modbus.
    def get(self, table, address):
        items = self.coils if table == "coil" else self.holding
        if address not in items:
            raise Refused(2)
        return items[address]

    def put(self, table, address, value):
        if address in self.read_only:
            raise Refused(2)
        self.get(table, address)
        (self.coils if table == "coil" else self.holding)[address] = value
        self.fed = time.monotonic()
        self.log(f"wrote {table} {address:04X} {value:04X}")
        self.wrote(table, address, value)
        self.moved()
        self.show()

    def answer(self, pdu):
        function = pdu[0]
        if function not in self.FUNCTIONS:
            raise Refused(1)
        first, second = struct.unpack(">HH", pdu[1:5])
        if function == 3:
            if not 1 <= second <= self.MOST_READ:
                raise Refused(3)
            if self.write_only.intersection(range(first, first + second)):
                raise Refused(2)
            words = [self.get("holding", first + place) for place in range(second)]
            return struct.pack(f">BB{second}H", 3, 2 * second, *words)
        if function == 4:
            words = [self.inputs.get(first + place) for place in range(second)]
            if None in words:
                raise Refused(2)
            return struct.pack(f">BB{second}H", 4, 2 * second, *words)
        if function == 1:
            bits = [self.get("coil", first + place) for place in range(second)]
            packed = sum(bool(bit) << place for place, bit in enumerate(bits))
            return bytes([1, (second + 7) // 8]) + packed.to_bytes((second + 7) // 8, "little")
        if function == 5:
            self.put("coil", first, int(second == 0xFF00))
        elif function == 6:
            self.put("holding", first, second)
        elif function == 15:
            packed = int.from_bytes(pdu[6:], "little")
            for place in range(second):
                self.put("coil", first + place, packed >> place & 1)
        elif function == 16:
            if not 1 <= second <= self.MOST_WRITE:
                raise Refused(3)
            values = struct.unpack(f">{second}H", pdu[6:])
            for place in range(second):
                self.get("holding", first + place)
            for place, value in enumerate(values):
                self.put("holding", first + place, value)
        return pdu[:5]

    def exchange(self, frame):
        # 0 is a broadcast, which nobody answers.
        if frame[0] not in (0, 1):
            return b""
        with self.lock:
            while self.happening and frame[1] in (1, 3, 4):
                self.happening.pop(0)()
            self.show()
            try:
                pdu = self.answer(frame[1:-2])
            except Refused as refused:
                pdu = bytes([frame[1] | 0x80, refused.code])
        if frame[0] == 0:
            return b""
        reply = bytes([1]) + pdu
        return reply + crc(reply)


def frames(data):
    """Whole requests at the beginning of `data`, and what is left."""
    found = []
    while len(data) >= 8:
        length = 9 + data[6] if data[1] in (15, 16) else 8
        if len(data) < length:
            break
        frame, data = data[:length], data[length:]
        if crc(frame[:-2]) == frame[-2:]:
            found.append(frame)
    return found, data


def happen(drive, happens):
    if TIMEOUT:
        drive.happening.append(happens)
    else:
        threading.Thread(target=happens).start()


def serve(drive, port):
    for number, happens in (
        (signal.SIGUSR1, drive.trip),
        (signal.SIGUSR2, drive.panel),
        (signal.SIGHUP, drive.restart),
    ):
        signal.signal(number, lambda *_, happens=happens: happen(drive, happens))

    def turn():
        last = time.monotonic()
        while True:
            time.sleep(0.01)
            now = time.monotonic()
            drive.tick(now - last)
            last = now

    threading.Thread(target=turn, daemon=True).start()
    server = socket.create_server(("127.0.0.1", port))
    drive.log("ready")
    while True:
        client, _ = server.accept()
        threading.Thread(target=talk, args=(drive, client), daemon=True).start()


def talk(drive, client):
    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    data = b""
    while True:
        try:
            more = client.recv(512)
        except OSError:
            return
        if not more:
            return
        whole, data = frames(data + more)
        for frame in whole:
            # An answer that is there before the request can be through would be an echo.
            time.sleep(TURNAROUND)
            client.sendall(drive.exchange(frame))

