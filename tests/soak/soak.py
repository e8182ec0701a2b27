#!/usr/bin/env python3
"""Runs a gateway for hours under everything that goes wrong in a plant: see docs/development.md.

soak.py --hours N [--binary PATH] [--dir DIR] [--seed N]: a line a minute, the result at the end; exit code 1 after any violation.
Touches nothing but its directory, and the loopback. As root it works in a mount namespace of its own, for the small disk.
"""

import argparse
import asyncio
import json
import os
import pathlib
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time

import earlier
from clients import Hostile, Modbus, Mqtt, http_get, read_http
from drives import Drive, Line
from gateway import Gateway, Program, broker_program, buses, free_port, libfaketime
from judge import Judge, Orders, Process, slope

ROOT = pathlib.Path(__file__).resolve().parents[2]
CYCLE = 10  # minutes until the incidents begin anew; the last one is calm
WARM_UP = 20  # minutes that do not count for the slope of RSS
SLOPE_BOUND = 0.1  # MiB an hour
JUDGED_FROM = 80  # minutes after the warm-up from which the slope is judged
ANSWER_LIMIT = 40.0  # seconds until an order counts as lost
CPU_LIMIT = 15.0  # percent of a core in any minute; about 5 with the load alone


class Soak:
    def __init__(self, options, directory, small_disk):
        self.options, self.directory, self.small_disk = options, directory, small_disk
        self.random = random.Random(options.seed)
        self.judge = Judge()
        self.orders = Orders(self.judge)
        self.samples, self.calm_samples = [], []
        self.incidents = []
        self.disturbed = True
        self.tasks = []

    async def start(self):
        self.drives = [Drive(f"remote-{n}", n) for n in (1, 2, 3)]
        self.clock_drives = [Drive(f"remote-{n}", n) for n in (4, 5)]
        for drive in self.drives + self.clock_drives:
            drive.unit = drive.address
        self.line, self.clock_line = Line(self.drives, self.options.seed), Line(self.clock_drives, self.options.seed + 1)
        remote, clock_remote, broker = free_port(), free_port(), free_port()
        await self.line.start(remote)
        binary = self.options.binary
        if self.small_disk:
            state = self.directory / "disk"
        else:
            state = self.directory / "state"
            state.mkdir()
            self.judge.skip("full disk: a small disk can be mounted by root only")
        self.broker = broker_program(self.directory, broker)
        lines = self.directory / "lines"
        lines.mkdir()
        text, self.simulated = buses(None, [], lines)
        (self.directory / "lines.toml").write_text('[gateway]\nname = "lines"\n' + text)
        faults = "drop=0.003,corrupt=0.003,truncate=0.001,noise-after=0.001,late:200ms=0.001,stray-address=0.001"
        self.simulator = Program(
            "simulate", self.directory,
            [binary, "simulate", "--config", self.directory / "lines.toml", "--autopilot", "--fault", faults, "--seed", self.options.seed],
        )
        self.gateway = Gateway("gateway", self.directory, binary, remote, self.drives, lines, broker, state)
        self.programs = [self.broker, self.simulator, self.gateway]
        self.clocked = None
        library = libfaketime()
        if library:
            await self.clock_line.start(clock_remote)
            own = self.directory / "clock-state"
            own.mkdir()
            self.clock = self.directory / "clock"
            self.clock.write_text("+0\n")
            env = {
                "LD_PRELOAD": str(library), "FAKETIME_TIMESTAMP_FILE": str(self.clock), "FAKETIME_CACHE_DURATION": "1",
                "FAKETIME_DONT_FAKE_MONOTONIC": "1", "DONT_FAKE_MONOTONIC": "1",
            }
            self.clocked = Gateway("clocked", self.directory, binary, clock_remote, self.clock_drives, None, None, own, env)
            self.programs.append(self.clocked)
        else:
            self.judge.skip("clock steps: libfaketime is not installed (package faketime)")
        drives = [(drive.name, "remote") for drive in self.drives] + [(name, name.split("-")[0]) for name in self.simulated]
        earlier.write_events(state / "events.jsonl", drives)
        self.broker.start()
        self.simulator.start()
        await asyncio.sleep(2)
        self.gateway.start()
        if self.clocked:
            self.clocked.start()
        self.mqtt = Mqtt(broker, "drivegate/soak", self.drives, self.orders, self.judge)
        await self.ready(60)
        self.modbus = Modbus(self.gateway.modbus, self.drives, self.orders, self.judge, "modbus")
        await self.modbus.connect()
        self.clock_modbus = None
        if self.clocked:
            self.clock_modbus = Modbus(self.clocked.modbus, self.clock_drives, self.orders, self.judge, "clocked")
            await self.clock_modbus.connect()
        self.hostile = Hostile(self.gateway.modbus, self.gateway.http, self.options.seed)
        self.process = Process(self.gateway.child.pid)
        for work in (self.behave, self.read, self.intrude):
            self.tasks.append(asyncio.create_task(self.forever(work)))

    async def ready(self, seconds):
        """Waits until every drive was polled."""
        for gateway in [self.gateway] + ([self.clocked] if self.clocked else []):
            for _ in range(seconds):
                try:
                    if (await http_get(gateway.http, "/readyz"))[0] == 200:
                        break
                except OSError:
                    pass
                await asyncio.sleep(1)
            else:
                sys.exit(f"error: {gateway.name} is not ready after {seconds} s; see {gateway.log}")

    async def forever(self, work):
        """An exception of the soak itself is a violation, too: nobody may take its silence for a good result."""
        while True:
            try:
                await work()
            except (OSError, TimeoutError, ValueError, KeyError, IndexError) as error:
                self.judge.violation(f"{work.__name__}: {type(error).__name__}: {error}")
            await asyncio.sleep(0.5)

    async def behave(self):
        """The orders of clients that behave: about two a second."""
        self.mqtt.order(self.random.choice(self.drives).name)
        names = self.simulated[:3] + self.simulated[5:]
        if self.random.random() < 0.4:
            name = self.random.choice(names)
            points = self.random.choice([{"run": False}, {"fault_reset": True}, None, None])
            self.mqtt.order(name, points)
        if self.random.random() < 0.5:
            self.modbus.order(self.random.choice(self.drives))
        if self.clock_modbus and self.random.random() < 0.3:
            self.clock_modbus.order(self.random.choice(self.clock_drives))
        for drive in self.drives:
            if drive.fault and self.random.random() < 0.1:
                self.mqtt.order(drive.name, {"fault_reset": True})

    async def read(self):
        for drive in self.drives:
            self.modbus.read(drive)
        for drive in self.clock_drives if self.clock_modbus else ():
            self.clock_modbus.read(drive)
        if self.random.random() < 0.3:
            await read_http(self.gateway.http, self.drives, self.judge)
            if self.clocked:
                await read_http(self.clocked.http, self.clock_drives, self.judge)

    async def intrude(self):
        if not self.disturbed:
            self.hostile.leave()
        elif self.random.random() < 0.5:
            await self.hostile.act()
        if self.disturbed and self.random.random() < 0.05:
            self.mqtt.nonsense(self.random.choice(self.drives).name)

    # Incidents, one list for each minute of a cycle; each lasts less than the minute.

    async def flood(self):
        """Orders to all drives and reads, as fast as they can be sent."""
        for _ in range(8):
            for name in [drive.name for drive in self.drives] + self.simulated[:3] + self.simulated[5:]:
                for _ in range(4):
                    self.mqtt.order(name)
            for drive in self.drives:
                for _ in range(100):
                    self.modbus.read(drive)
            await asyncio.sleep(1)

    async def trip(self):
        for drive in self.drives[:2]:
            drive.trip(self.random.choice([1, 9, 14]))
            await asyncio.sleep(5)

    async def silence(self):
        self.drives[1].silent_until = time.monotonic() + 15

    async def noise(self):
        for drive in self.drives:
            drive.noisy_until = time.monotonic() + 30

    async def hang_up(self):
        self.line.hang_up()

    async def broker_restart(self):
        """No order is under way when the broker goes: what it loses then is not the gateway's loss."""
        self.mqtt.quiet = True
        for _ in range(100):
            if not any(order.startswith("soak-") for order in self.orders.open):
                break
            await asyncio.sleep(0.1)
        await asyncio.sleep(1)
        await self.broker.end(signal.SIGKILL)
        await asyncio.sleep(self.random.randrange(5, 25))
        self.broker.start()
        for _ in range(15):
            await asyncio.sleep(1)
            _, body = await http_get(self.gateway.http, "/metrics")
            if self.mqtt.subscribed and "drivegate_mqtt_connected 1" in body:
                break
        else:
            self.judge.violation("no connection to the broker 15 s after its return")
        await asyncio.sleep(2)
        self.mqtt.quiet = False

    async def reload(self):
        self.gateway.reload(level=self.random.choice(["info", "info,drivegate::bus=warn"]))
        await asyncio.sleep(10)
        self.gateway.reload(fewer=True)
        await asyncio.sleep(10)
        self.gateway.reload()

    async def refused_reload(self):
        self.gateway.reload(broken=True)
        await asyncio.sleep(5)
        self.gateway.write()

    async def full_disk(self):
        if not self.small_disk:
            return
        filler = self.directory / "disk/filler"
        try:
            with open(filler, "wb", buffering=0) as file:
                while True:
                    file.write(b"\0" * 4096)
        except OSError:
            pass
        await self.trip()
        await asyncio.sleep(25)
        filler.unlink()

    async def lost_port(self):
        await self.simulator.end(signal.SIGKILL)
        await asyncio.sleep(10)
        self.simulator.start()

    async def frozen_line(self):
        self.simulator.send(signal.SIGSTOP)
        await asyncio.sleep(8)
        self.simulator.send(signal.SIGCONT)

    async def clock_steps(self):
        if not self.clocked:
            return
        for step in ("+3600", "-86400", "+7", "+0"):
            self.clock.write_text(step + "\n")
            await asyncio.sleep(8)

    PLAN = {
        0: ("flood", "trip"), 1: ("broker_restart",), 2: ("reload", "silence"), 3: ("full_disk",),
        4: ("refused_reload", "noise", "hang_up"), 5: ("lost_port",), 6: ("flood", "noise"),
        7: ("frozen_line", "broker_restart"), 8: ("clock_steps", "silence", "trip"), 9: (),
    }

    async def minute(self, number):
        """One minute: its incidents, then the checks and the line."""
        begin = time.monotonic()
        names = self.PLAN[number % CYCLE]
        self.disturbed = bool(names)
        results = await asyncio.gather(*(getattr(self, name)() for name in names), return_exceptions=True)
        for name, error in zip(names, results):
            if error:
                self.judge.violation(f"{name}: {type(error).__name__}: {error}")
        await asyncio.sleep(max(0.0, begin + 60 - time.monotonic()))
        await self.check(number, " ".join(names) or "calm")

    async def check(self, number, what):
        self.orders.inspect(ANSWER_LIMIT)
        for program in self.programs:
            if program.gone():
                self.judge.violation(f"{program.name} ended with {program.child.returncode}; see {program.log}")
        if self.gateway.gone():
            return
        rss, own, fds, threads, cpu = self.process.sample()
        self.samples.append((number + 1, rss, own))
        if cpu > CPU_LIMIT:
            self.judge.violation(f"{cpu:.1f} % of a core in a minute with {what}")
        try:
            status, _ = await http_get(self.gateway.http, "/healthz")
            if status != 200:
                self.judge.violation(f"/healthz is {status}")
        except (OSError, TimeoutError) as error:
            self.judge.violation(f"/healthz: {error}")
        if what == "calm":
            await self.calm(fds, threads)
        print(
            f"minute {number + 1:4}  rss {rss:6.2f} MiB  own {own:5.2f}  fds {fds:3}  threads {threads:2}  cpu {cpu:4.1f} %  "
            f"orders {self.orders.placed} open {len(self.orders.open)}  values {self.judge.values}  "
            f"violations {self.judge.violations}  ({what})",
            flush=True,
        )

    async def calm(self, fds, threads):
        """After a minute without incidents everything is as it was: all drives there, descriptors and threads back."""
        self.calm_samples.append((fds, threads))
        first = self.calm_samples[0]
        if fds > first[0] + 3 or threads > first[1] + 2:
            self.judge.violation(f"fds {fds}, threads {threads}; after the first cycle: {first[0]}, {first[1]}")
        for gateway in [self.gateway] + ([self.clocked] if self.clocked else []):
            status, body = await http_get(gateway.http, "/readyz")
            if status != 200:
                self.judge.violation(f"{gateway.name}: not ready in a calm minute: {' '.join(body.split())}")
            _, body = await http_get(gateway.http, "/metrics")
            up = [line for line in body.splitlines() if line.startswith("drivegate_drive_up{")]
            down = [line for line in up if not line.endswith(" 1")]
            if down or not up:
                self.judge.violation(f"{gateway.name}: drives that are down in a calm minute: {down or 'all'}")

    async def end(self):
        """The order of stopping, the audit file, the result."""
        self.mqtt.quiet = True
        for task in self.tasks:
            task.cancel()
        await asyncio.sleep(15)
        self.orders.inspect(15)
        _, metrics = await http_get(self.gateway.http, "/metrics")
        self.modbus.ending = True
        if self.clock_modbus:
            self.clock_modbus.ending = True
        for gateway in [self.clocked, self.gateway]:
            if gateway and not gateway.gone():
                code = await gateway.end()
                if code != 0:
                    self.judge.violation(f"{gateway.name} ended with {code} after SIGTERM")
        state = pathlib.Path(self.gateway.state)
        files = sorted(state.glob("audit.jsonl*"))
        verified = subprocess.run([self.options.binary, "audit", "verify", *files], capture_output=True, text=True)
        print("audit:", (verified.stdout + verified.stderr).strip())
        if verified.returncode:
            self.judge.violation("the audit file is not whole")
        for gateway in [self.clocked, self.gateway]:
            if gateway and b"panicked" in gateway.log.read_bytes():
                self.judge.violation(f"a panic; see {gateway.log}")
        self.mqtt.stop()
        lost = [line for line in metrics.splitlines() if "lost_total" in line and not line.startswith("#") and not line.endswith(" 0")]
        print(f"answers: {dict(sorted(self.orders.results.items()))}")
        print(f"events: {dict(sorted(self.mqtt.events.items()))}; lost: {lost or 'none'}")
        return self.result()

    def result(self):
        late = [sample for sample in self.samples if sample[0] > WARM_UP]
        if len(late) > 1:
            rise, of_own = (slope([(sample[0] / 60, sample[place]) for sample in late]) for place in (1, 2))
            text = f"slope of RSS after {WARM_UP} minutes: {rise:+.3f} MiB an hour over {len(late)} minutes"
            print(f"of it pages of the process's own: {of_own:+.3f} MiB an hour; the rest are pages of program and libraries")
            if len(late) < JUDGED_FROM:
                print(f"{text}; not judged below {JUDGED_FROM} minutes")
            else:
                print(f"{text}; bound {SLOPE_BOUND}")
                if rise > SLOPE_BOUND:
                    self.judge.violation(text)
        else:
            print(f"slope of RSS: not judged, the run is not longer than the warm-up of {WARM_UP} minutes")
        for text in self.judge.skipped:
            print(f"skipped: {text}")
        print(
            f"result: {'FAILED' if self.judge.violations else 'ok'}, {len(self.samples)} minutes, {self.orders.placed} orders, "
            f"{self.judge.values} readings compared, {self.judge.violations} violations; logs in {self.directory}"
        )
        return 1 if self.judge.violations else 0


async def run(options, directory, small_disk):
    soak = Soak(options, directory, small_disk)
    # Whoever ends the soak ends its processes.
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, asyncio.current_task().cancel)
    try:
        await soak.start()
        for number in range(max(1, round(options.hours * 60))):
            await soak.minute(number)
            if soak.gateway.gone():
                break
        return await soak.end()
    finally:
        for program in reversed(getattr(soak, "programs", [])):
            if program.child and not program.gone():
                program.send(signal.SIGCONT)
                await program.end(seconds=10)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, required=True)
    parser.add_argument("--binary", type=pathlib.Path, default=ROOT / "target/release/drivegate")
    parser.add_argument("--dir", type=pathlib.Path, help="default: a new one below the system's temporary directory")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    if not options.binary.is_file():
        sys.exit(f"error: {options.binary} is not built; run `make build`")
    if os.geteuid() == 0 and "SOAK_NAMESPACE" not in os.environ and shutil.which("unshare"):
        # The small disk is seen, and lives, in this process only.
        os.environ["SOAK_NAMESPACE"] = "1"
        os.execvp("unshare", ["unshare", "--mount", "--propagation", "private", sys.executable, *sys.argv])
    directory = options.dir or pathlib.Path(tempfile.mkdtemp(prefix="drivegate-soak-"))
    directory.mkdir(parents=True, exist_ok=True)
    small_disk = False
    if os.environ.pop("SOAK_NAMESPACE", None):
        disk = directory / "disk"
        disk.mkdir(exist_ok=True)
        mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", disk], capture_output=True, text=True)
        small_disk = mounted.returncode == 0
        # Numbers of pseudo-terminals are given out again: a gateway whose line was killed must not open one of somebody else.
        own = ["mount", "-t", "devpts", "-o", "newinstance,ptmxmode=0666", "devpts", "/dev/pts"]
        if subprocess.run(own, capture_output=True, check=False).returncode == 0:
            subprocess.run(["mount", "--bind", "/dev/pts/ptmx", "/dev/ptmx"], capture_output=True, check=False)
    sys.exit(asyncio.run(run(options, directory, small_disk)))


if __name__ == "__main__":
    main()
