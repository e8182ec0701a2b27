#!/usr/bin/env python3
"""Records which functions a gateway executes, and writes the order in which the linker lays them out: docs/development.md, The order of functions.

record.py [--seconds N]: builds a release with symbols, runs it under valgrind, writes deploy/function_order/order.ld. Wants valgrind and mosquitto.
"""

import argparse
import bisect
import contextlib
import http.client
import itertools
import os
import pathlib
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parents[2]
ORDER = ROOT / "deploy/function_order/order.ld"
TARGET = ROOT / "target/function_order"

HEAD = """\
/* Which functions a running gateway executes: first those of the start and of polling, with what stands beside them;
   then those that HTTP adds, then those of MQTT, Modbus TCP, commands, events and the other protocols. The rest follows in the usual order.
   Written by deploy/function_order/record.py; see docs/development.md, The order of functions. */
SECTIONS
{
  .text.executed :
  {
"""
TAIL = """\
  }
}
INSERT BEFORE .text;
"""

# What a pattern may take in besides, bytes and share of what is executed: little in the first part, which each gateway has in memory;
# more in the others, as that makes the file shorter.
TOLERANCES = [(200, 0.1), (1000, 0.3), (1000, 0.3)]

# What stands beside the first part: a change of the code, or of what the compiler inlines, brings something of these along sooner or later.
NEIGHBOURS = [f"9drivegate{len(room)}{room}" for room in ("bus", "codec", "daemon", "diagnosis", "drive", "event", "line", "plant", "process_image")]
NEIGHBOURS += ["5tokio7runtime", "12tracing_core"]

# Name, protocol, baud rate, format, profile, drives.
PLAIN = [(f"line{n}", "modbus-rtu", 115200, "8N1", "vacon-nx", 1) for n in range(1, 5)]
MIXED = [
    ("rtu", "modbus-rtu", 38400, "8N1", "vacon-nx", 2),
    ("cx", "modbus-rtu", 9600, "8N1", "vacon-cx", 1),
    ("svx", "modbus-rtu", 19200, "8N1", "eaton-svx", 1),
    ("ascii", "modbus-ascii", 9600, "7N2", "teco-7300pa", 1),
    ("n2", "n2", 9600, None, "vacon-nx-n2", 1),
]


def free_port():
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


def configuration(directory, lines, cycle, http_port, more):
    text = f'[gateway]\nname = "record"\nstate_dir = "{directory}"\nsocket = "{directory}/socket"\n[http]\nlisten = "127.0.0.1:{http_port}"\n{more}'
    unit = 0
    for name, protocol, baud, form, profile, drives in lines:
        text += f'[[bus]]\nname = "{name}"\nport = "{directory}/{name}"\nprotocol = "{protocol}"\nbaud = {baud}\ncycle = "{cycle}"\n'
        text += 'response_timeout = "1s"\n' + (f'format = "{form}"\n' if form else "")
        for address in range(1, drives + 1):
            unit += 1
            text += f'[[bus.drive]]\nname = "{name}-{address}"\naddress = {address}\nunit = {unit}\nprofile = "{profile}"\n'
            text += 'access = "control"\n' if "modbus_tcp" in more else ""
    path = directory / "drivegate.toml"
    path.write_text(text)
    return path


@contextlib.contextmanager
def program(*command):
    child = subprocess.Popen(list(map(str, command)), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield child
    finally:
        child.terminate()
        child.wait()


def get(port, path):
    """Status and body; 0 where there is none: under valgrind a gateway is slow enough to hit its own time limits."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    try:
        connection.request("GET", path)
        reply = connection.getresponse()
        return reply.status, reply.fp.readline() if path == "/api/v1/events" else reply.read()
    except (OSError, http.client.HTTPException):
        return 0, b""
    finally:
        connection.close()


def wait_until_ready(port):
    for _ in range(120):
        if get(port, "/readyz")[0] == 200:
            return
        time.sleep(1)
    sys.exit("error: the gateway under valgrind is not ready after 2 minutes")


def use_http(port):
    """What a scraper and a bench ask for."""
    for path in ("/readyz", "/healthz", "/metrics", "/api/v1/buses", "/api/v1/drives"):
        get(port, path)


def use_everything(port, modbus, broker, names, gateway):
    """What SCADA clients, MQTT clients and people at the page ask for, and a reload."""
    page = get(port, "/")[1].decode(errors="replace")
    for path in re.findall(r'(?:src|href)="(/?[^":#]+)"', page):
        get(port, path if path.startswith("/") else f"/{path}")
    for path in ("/api/v1/events", "/api/v1/events/log?limit=20", "/api/v1/audit", "/api/v1/recordings", "/api/v1/nothing"):
        get(port, path)
    for name, *_ in MIXED:
        get(port, f"/api/v1/buses/{name}")
        get(port, f"/api/v1/buses/{name}/diagnosis")
    client = socket.create_connection(("127.0.0.1", modbus), timeout=60)
    requests = [struct.pack(">BHH", 3, 0x8000, 40), struct.pack(">BHH", 4, 0x8200, 16), struct.pack(">BHH", 3, 2101, 8)]
    requests += [struct.pack(">BHH", 6, 0x8101, 2500), struct.pack(">BHH", 6, 0x8100, 1), struct.pack(">BHHBHH", 16, 0x8100, 2, 4, 1, 3000)]
    requests += [struct.pack(">BHH", 6, 0x8100, 0), struct.pack(">BHH", 1, 0, 8), b"\x2b\x0e\x01\x00"]
    for turn in range(2):
        for unit, name in enumerate(names, 1):
            for number, pdu in enumerate(requests):
                client.sendall(struct.pack(">HHHB", number, 0, len(pdu) + 1, unit) + pdu)
                client.recv(512)
            get(port, f"/api/v1/drives/{name}")
            get(port, f"/api/v1/drives/{name}/trend?from=-1m")
            for payload in ('{"id": "a%d", "run": true, "speed_reference": 40}' % turn, '{"run": false}', '{"fault_reset": true}', "{"):
                topic = f"drivegate/record/drive/{name}/set"
                subprocess.run(["mosquitto_pub", "-p", str(broker), "-q", "1", "-t", topic, "-m", payload], check=True)
            use_http(port)
        gateway.send_signal(signal.SIGHUP)
        time.sleep(5)
    client.close()


def executed(binary, text):
    """Names of the functions of the binary that were executed."""
    blocks = re.findall(r"^==== SB .* 0x[0-9a-f]+ (\S+?)(?:\+\d+)? (\S+)\+0x[0-9a-f]+$", text, re.MULTILINE)
    return {name for name, path in blocks if path == str(binary)}


def functions(binary):
    """Address, size and name of each function of the binary."""
    for line in subprocess.run(["nm", "-S", "--defined-only", binary], check=True, capture_output=True, text=True).stdout.splitlines():
        address, size, kind, name = (line.split(maxsplit=3) + [""])[:4]
        if kind in ("t", "T"):
            yield address, int(size, 16), name


def anywhere(name):
    """The name in any build: without what the names of crates are made unique with, and what the linker adds."""
    return re.sub(r"\.llvm\.\d+$", "", re.sub(r"Cs[0-9A-Za-z]+_(?=\d)", "Cs*_", name))


def matching(pattern, names):
    """The names that the linker finds by a pattern, in which `*` stands for anything."""
    expression = re.compile(re.escape(pattern).replace(r"\*", ".*"))
    begin = pattern.partition("*")[0]
    low, high = bisect.bisect_left(names, begin), bisect.bisect_right(names, begin + "~")
    return [name for name in names[low:high] if expression.fullmatch(name)]


def patterns(executed, bytes_of, names, most, share):
    """Beginnings of names, as few and as short as possible, by which the linker finds the executed functions and little else:
    for each at most so many bytes of others, or that share of what is executed."""

    def bearable(found):
        useless = sum(bytes_of[name] for name in found if name not in executed)
        return useless <= max(most, share * sum(bytes_of[name] for name in found if name in executed))

    def cover(group, least):
        wanted = [name for name in group if name in executed]
        if not wanted:
            return []
        if bearable(group):
            short = group[0][:least] + "*" if least <= len(group[0]) else group[0]
            return [short] if bearable(matching(short, names)) else wanted
        least = len(os.path.commonprefix([group[0], group[-1]])) + 1
        return [pattern for _, part in itertools.groupby(group, lambda name: name[:least]) for pattern in cover(list(part), least)]

    return cover(names, 0)


def record(binary, seconds, lines, cycle, more, use):
    """Names of the functions that a gateway executes before and while it is used."""
    with tempfile.TemporaryDirectory() as folder:
        directory, port = pathlib.Path(folder), free_port()
        config = configuration(directory, lines, cycle, port, more)
        log = directory / "executed"
        with program(binary, "simulate", "--config", config):
            while not (directory / lines[-1][0]).exists():
                time.sleep(0.2)
            # The tool that checks nothing; a line of its log begins each block of code that is executed for the first time.
            valgrind = ["valgrind", "--tool=none", "--trace-flags=00000001", "--trace-notbelow=0", "--vex-guest-chase=no", "--demangle=no"]
            with program(*valgrind, f"--log-file={log}", binary, "run", "--config", config) as gateway:
                wait_until_ready(port)
                time.sleep(seconds)
                before = log.stat().st_size
                use(port, gateway)
                time.sleep(seconds)
                gateway.terminate()
                gateway.wait(120)
        text = log.read_text(errors="replace")
        found = [executed(binary, part) for part in (text[:before], text[before:])]
        if len(found[0]) < 500:
            sys.exit(f"error: {len(found[0])} functions were executed, which cannot be all; is {binary} stripped?")
        return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30, help="how long each run goes on after it was used")
    seconds = parser.parse_args().seconds
    for needed in ("valgrind", "mosquitto", "mosquitto_pub"):
        if not shutil.which(needed):
            sys.exit(f"error: {needed} is not installed; run `apt install valgrind mosquitto mosquitto-clients`")
    print("building a release with symbols", flush=True)
    subprocess.run(
        ["cargo", "build", "--release", "--locked", "--bin", "drivegate", "--target-dir", TARGET],
        cwd=ROOT, check=True, env={**os.environ, "CARGO_PROFILE_RELEASE_STRIP": "none", "DRIVEGATE_FUNCTION_ORDER": "none"},
    )
    binary = TARGET / "release/drivegate"
    print("a gateway of four lines with HTTP", flush=True)
    polling, http_only = record(binary, seconds, PLAIN, "10ms", "", lambda port, _: use_http(port))
    modbus, broker = free_port(), free_port()
    more = f'[modbus_tcp]\nlisten = ["127.0.0.1:{modbus}"]\nallow = ["127.0.0.0/8"]\nwrite = ["127.0.0.1/32"]\n'
    more += f'[mqtt]\nurl = "mqtt://127.0.0.1:{broker}"\nbase = "drivegate/record"\ncommands = true\nhistory = "changes"\n'
    names = [f"{name}-{address}" for name, *_, drives in MIXED for address in range(1, drives + 1)]
    with program("mosquitto", "-p", str(broker)):
        mixed = set().union(*record(
            binary, seconds, MIXED, "250ms", more,
            lambda port, gateway: use_everything(port, modbus, broker, names, gateway),
        ))
    write(list(functions(binary)), polling, http_only, mixed)


def write(all_functions, *parts):
    """Writes the order: the functions of each part that are in none before it."""
    bytes_of, alike = {}, {}
    for address, size, name in all_functions:
        bytes_of[anywhere(name)] = bytes_of.get(anywhere(name), 0) + size
        alike.setdefault(address, set()).add(name)
    # Functions with the same code are one, which has many names; its section has one of them.
    names_of = {name: names for names in alike.values() for name in names}
    parts = [{anywhere(other) for name in part for other in names_of.get(name, ())} for part in parts]
    rest = sorted(bytes_of)
    with ORDER.open("w") as file:
        file.write(HEAD)
        for number, (part, (most, share)) in enumerate(zip(parts, TOLERANCES)):
            found = patterns(part & set(rest), bytes_of, rest, most, share)
            for pattern in found:
                # In `.text.unlikely.` are the functions that the compiler holds to be rare.
                whole = "" if pattern.endswith("*") else f" .text*.{pattern}.llvm.*"
                file.write(f"    *(.text*.{pattern}{whole})\n")
            taken = {name for pattern in found for name in matching(pattern, rest)}
            size = sum(bytes_of[name] for name in taken) / 1e6
            print(f"{len(part & taken)} functions, {len(taken - part)} others, {len(found)} patterns: {size:.1f} MB", flush=True)
            if number == 0:
                file.writelines(f"    *(.text*._R*{path}*)\n" for path in NEIGHBOURS)
                taken |= {name for name in rest if any(path in name for path in NEIGHBOURS)}
            rest = [name for name in rest if name not in taken]
        file.write(TAIL)
    print(f"{ORDER.relative_to(ROOT)}: {ORDER.stat().st_size} bytes")


if __name__ == "__main__":
    main()
