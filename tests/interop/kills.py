#!/usr/bin/env python3
"""Gateway and broker are killed at random moments: every event arrives, in order, as often as docs/mqtt.md says.

Within one run of the gateway (`boot`) the ids of its events rise without a gap; an event that comes again was sent before a
cut. Only what happened in the last moment before a kill of a gateway that was connected may be missing. MINUTES=10 runs
longer than the usual minute.
"""

import os
import random
import time

from bench import DRIVEGATE, Bench, fail, say, until
from counting_broker import CountingBroker

MINUTES = float(os.environ.get("MINUTES", "1"))
DRIVES = 8


def configuration(directory, port):
    drives = "".join(
        f'[[bus.drive]]\nname = "p{n}"\naddress = {n}\nprofile = "vacon-nx"\n' for n in range(1, DRIVES + 1)
    )
    (directory / "kills.toml").write_text(
        f'[gateway]\nname = "hall"\nstate_dir = "{directory}/state"\nsocket = ""\n'
        f'[[bus]]\nname = "line1"\nport = "{directory}/line"\nprotocol = "modbus-rtu"\nbaud = 115200\ncycle = "20ms"\n{drives}'
        f'[mqtt]\nurl = "mqtt://127.0.0.1:{port}"\nbuffer = {{ dir = "{directory}/buffer" }}\n[recordings]\nmax_count = 0\n'
    )
    return directory / "kills.toml"


def check(events):
    """How many came more than once; ends the program where the order or the number is not what was promised."""
    seen, last, again = set(), {}, 0
    for boot, number, topic in events:
        if (boot, number, topic) in seen:
            again += 1
            continue
        seen.add((boot, number, topic))
        before = last.get(boot)
        if before is not None:
            if number not in (before, before + 1):
                fail(f"event {number} of {boot} follows {before}")
        last[boot] = number
    order = list(dict.fromkeys(boot for boot, *_ in events))
    return len(seen), again, len(order)


def main():
    seed = int(os.environ.get("SEED", "1"))
    dice = random.Random(seed)
    broker = CountingBroker(random.Random(seed + 1))
    with Bench() as bench:
        config = configuration(bench.dir, broker.port)
        simulate = [DRIVEGATE, "simulate", "--addresses", f"1-{DRIVES}", "--link", bench.dir / "line", "--baud", "115200"]
        log = (bench.dir / "lines.log").open("w")
        bench.start([*simulate, "--autopilot", "--seed", str(seed)], stdout=log, stderr=log)
        until("the line", (bench.dir / "line").exists)
        output = (bench.dir / "gateway.log").open("a")
        start = lambda: bench.start([DRIVEGATE, "run", "--config", config], stdout=output, stderr=output)
        broker.start()
        gateway, kills, cuts = start(), 0, 0
        ends = time.monotonic() + 60 * MINUTES
        while time.monotonic() < ends:
            time.sleep(dice.uniform(0.2, 6))
            what = dice.choice(["gateway", "broker", "both"])
            if what != "gateway":
                broker.cut()
                cuts += 1
                time.sleep(dice.uniform(0, 4))
            if what != "broker":
                gateway.kill()
                gateway.wait()
                kills += 1
                time.sleep(dice.uniform(0, 1))
                gateway = start()
            if what != "gateway":
                time.sleep(dice.uniform(0, 4))
                broker.start()
        count = lambda: len(broker.events)
        before = count()
        until("events after the last cut", lambda: count() > before)
        time.sleep(8)
        gateway.terminate()
        gateway.wait()
        events = list(broker.events)
    different, again, boots = check(events)
    say(f"   seed {seed}: {kills} kills of the gateway, {cuts} of the broker, {broker.sessions} sessions: {different} events of {boots} "
        f"runs, {again} of them again")
    say("   ok: the events of each run came in order and without a gap")


if __name__ == "__main__":
    main()
