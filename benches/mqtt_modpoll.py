#!/usr/bin/env python3
"""How old the values are that a subscriber holds: drivegate with its defaults beside modpoll (PyPI), on the same line.

    python3 -m venv /tmp/modpoll && /tmp/modpoll/bin/pip install modpoll pyserial paho-mqtt==2.2.0
    /tmp/modpoll/bin/python benches/mqtt_modpoll.py --modpoll /tmp/modpoll/bin/modpoll

Ten simulated drives on a pseudo-terminal with the wire times of the baud rate; each reply carries the time at which it
was made, in ms. A subscriber of a mosquitto takes the age of the value that it holds when the next one replaces it. The two
masters alternate; every figure is the median of the runs.
"""

import argparse
import json
import os
import pathlib
import pty
import selectors
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import tty

import paho.mqtt.client as paho

DRIVES = 10
REGISTERS = 11
TURNAROUND = 0.0005

PROFILE = """
name = "clock"
title = "A device whose registers are the time in ms"
source = "benches/mqtt_modpoll.py"
protocols = ["modbus-rtu"]
addresses = [1, 247]

[[range]]
table = "holding"
first = 0
last = 10
read = 11
note = "time"
""" + "".join(
    f'\n[[point]]\nname = "stamp{number}"\nat = "holding {number}"\ntype = "u16"\nclass = "fast"\n'
    for number in range(REGISTERS)
)


def crc(data):
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ 0xA001 if value & 1 else value >> 1
    return value.to_bytes(2, "little")


def now_ms():
    return int(time.monotonic() * 1000) & 0xFFFF


class Line(threading.Thread):
    """The drives: each answers a read of its registers after the wire time of request and reply."""

    def __init__(self, baud):
        super().__init__(daemon=True)
        self.character = 10 / baud
        self.line, self.slave = pty.openpty()
        tty.setraw(self.line)
        tty.setraw(self.slave)
        self.port = os.ttyname(self.slave)
        self.requests = 0
        self.ended = False

    def run(self):
        selector = selectors.DefaultSelector()
        selector.register(self.line, selectors.EVENT_READ)
        held = b""
        while not self.ended:
            if not selector.select(0.05):
                held = b""
                continue
            held += os.read(self.line, 256)
            while len(held) >= 8:
                request, held = held[:8], held[8:]
                if crc(request[:6]) != request[6:] or request[1] != 3:
                    held = b""
                    break
                self.answer(request)

    def answer(self, request):
        count = int.from_bytes(request[4:6], "big")
        self.requests += 1
        time.sleep(8 * self.character + TURNAROUND)
        body = request[:2] + bytes([2 * count]) + now_ms().to_bytes(2, "big") * count
        time.sleep((len(body) + 2) * self.character)
        os.write(self.line, body + crc(body))

    def end(self):
        self.ended = True
        self.join()
        os.close(self.line)
        os.close(self.slave)


class Subscriber:
    """Ages in ms of the values held, when the next ones replace them."""

    def __init__(self, port, topics, stamp):
        self.held = {}
        self.ages = []
        self.stamp = stamp
        self.client = paho.Client(paho.CallbackAPIVersion.VERSION2)
        self.client.on_message = self.received
        self.client.connect("127.0.0.1", port)
        self.client.subscribe(topics)
        self.client.loop_start()

    def received(self, _client, _data, message):
        stamp = self.stamp(json.loads(message.payload))
        if stamp is None:
            return
        held = self.held.get(message.topic)
        self.held[message.topic] = stamp
        if held is not None and held != stamp:
            self.ages.append((now_ms() - int(held)) & 0xFFFF)

    def end(self):
        self.client.disconnect()
        self.client.loop_stop()


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def drivegate(binary, directory, port, baud, broker):
    (directory / "profiles").mkdir(exist_ok=True)
    (directory / "profiles/clock.toml").write_text(PROFILE)
    drives = "".join(
        f'[[bus.drive]]\nname = "d{number}"\naddress = {number}\nprofile = "clock"\n' for number in range(1, DRIVES + 1)
    )
    (directory / "gateway.toml").write_text(
        f'[gateway]\nname = "bench"\nprofile_dirs = ["{directory}/profiles"]\n'
        f'[[bus]]\nname = "line1"\nport = "{port}"\nprotocol = "modbus-rtu"\nbaud = {baud}\nformat = "8N1"\ncycle = "10ms"\n{drives}'
        f'[mqtt]\nurl = "mqtt://127.0.0.1:{broker}"\n[recordings]\nmax_count = 0\n'
    )
    state = directory / "state"
    state.mkdir(exist_ok=True)
    environment = os.environ | {"STATE_DIRECTORY": str(state), "RUNTIME_DIRECTORY": str(state)}
    return [binary, "run", "--config", str(directory / "gateway.toml")], environment


def modpoll(binary, directory, port, baud, broker):
    text = "".join(
        f"device,d{number},{number},,\npoll,holding_register,0,{REGISTERS},BE_BE\n"
        + "".join(f"ref,stamp{register},{register},uint16,r\n" for register in range(REGISTERS))
        for number in range(1, DRIVES + 1)
    )
    (directory / "modpoll.csv").write_text(text)
    command = [binary, "-d", "-f", str(directory / "modpoll.csv"), "--serial", port, "--serial-baud", str(baud)]
    command += ["--rate", "0", "--interval", "0", "--mqtt-host", "127.0.0.1", "--mqtt-port", str(broker)]
    return command + ["--mqtt-version", "5.0", "--loglevel", "WARNING"], os.environ


def run(command, environment, directory, topics, stamp, line, broker, seconds):
    with open(directory / "output.log", "ab") as output:
        master = subprocess.Popen(command, env=environment, stdout=output, stderr=output, stdin=subprocess.DEVNULL)
    subscriber = Subscriber(broker, topics, stamp)
    try:
        deadline = time.monotonic() + 30
        while len(subscriber.ages) < 5 * DRIVES:
            if master.poll() is not None or time.monotonic() > deadline:
                sys.exit(f"no values from {command[0]}:\n{(directory / 'output.log').read_text()[-2000:]}")
            time.sleep(0.05)
        subscriber.ages.clear()
        before = line.requests
        time.sleep(seconds)
        ages, requests = sorted(subscriber.ages), line.requests - before
    finally:
        subscriber.end()
        master.terminate()
        master.wait()
    return ages[len(ages) // 2], ages[len(ages) * 99 // 100], requests / seconds


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--drivegate", default="target/release/drivegate")
    parser.add_argument("--modpoll", default=shutil.which("modpoll"), help="its program")
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    if not options.modpoll:
        sys.exit("no modpoll; the head of this file says how to install it")
    directory = pathlib.Path(tempfile.mkdtemp(prefix="drivegate-modpoll-"))
    broker_port = free_port()
    (directory / "mosquitto.conf").write_text(f"listener {broker_port} 127.0.0.1\nallow_anonymous true\n")
    mosquitto = shutil.which("mosquitto") or "/usr/sbin/mosquitto"
    broker = subprocess.Popen([mosquitto, "-c", str(directory / "mosquitto.conf")], stderr=subprocess.DEVNULL)
    masters = {
        "drivegate": (drivegate, options.drivegate, "drivegate/bench/drive/+/state", lambda state: state.get("stamp0")),
        "modpoll": (modpoll, options.modpoll, "modpoll/+/data", lambda data: data.get("stamp0")),
    }
    print(f"{DRIVES} drives, {REGISTERS} registers; age of a held value when the next one replaces it, ms")
    print("baud | master | p50 | p99 | requests/s | predicted round, ms")
    try:
        time.sleep(0.5)
        for baud in (38400, 115200):
            line = Line(baud)
            line.start()
            figures = {name: [] for name in masters}
            for _ in range(options.runs):
                for name, (prepare, binary, topics, stamp) in masters.items():
                    command, environment = prepare(binary, directory, line.port, baud, broker_port)
                    figures[name].append(
                        run(command, environment, directory, topics, stamp, line, broker_port, options.seconds)
                    )
            line.end()
            silence = max(3.5 * 10 / baud, 0.00175 if baud > 19200 else 0)
            round_ms = DRIVES * 1000 * ((8 + 5 + 2 * REGISTERS) * 10 / baud + TURNAROUND + silence)
            for name, runs in figures.items():
                p50, p99, rate = (statistics.median(column) for column in zip(*runs))
                print(f"{baud} | {name} | {p50:.0f} | {p99:.0f} | {rate:.0f} | {round_ms:.0f}", flush=True)
    finally:
        broker.terminate()
        broker.wait()
    shutil.rmtree(directory)


if __name__ == "__main__":
    main()
