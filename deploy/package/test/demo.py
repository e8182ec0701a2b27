#!/usr/bin/env python3
"""Starts a built program, on this processor or under qemu: the demo, all drives online, one command.

    deploy/package/test/demo.py PROGRAM [EMULATOR]
"""

import json
import re
import signal
import socket
import struct
import subprocess
import sys
import time
import urllib.error
import urllib.request

# An emulator on a busy machine is slow; what is sound ends long before.
LIMIT = 600
DRIVES = 10
COMMAND = 0x8100
# Exception 11: under emulation a simulated drive may take longer than its timeout.
NO_ANSWER = b"\x90\x0b"


def fail(what, why):
    sys.exit(f"error: {what}; in the demo of {sys.argv[1]}; {why}")


def until(what, condition):
    end = time.monotonic() + LIMIT
    while not (found := condition()):
        if time.monotonic() > end:
            fail(f"no {what} within {LIMIT} s", "run the program by hand")
        time.sleep(0.2)
    return found


def get(port, path):
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=30) as reply:
            return json.load(reply)
    except (OSError, ValueError, urllib.error.URLError):
        return None


def write(port, unit, address, values):
    """Writes registers of a drive by Modbus TCP (function 16), again while the drive is too slow to acknowledge."""
    pdu = struct.pack(">BHHB", 16, address, len(values), 2 * len(values)) + struct.pack(f">{len(values)}H", *values)

    def accepted():
        with socket.create_connection(("127.0.0.1", port), timeout=60) as line:
            line.sendall(struct.pack(">HHHB", 1, 0, len(pdu) + 1, unit) + pdu)
            reply = line.recv(260)[7:]
        if reply[:1] != b"\x10" and reply != NO_ANSWER:
            fail(f"the command was answered with {reply.hex()}", "0x90 is an exception")
        return reply[:1] == b"\x10"

    until("acknowledged command", accepted)


def main():
    if len(sys.argv) not in (2, 3):
        sys.exit("error: wrong arguments; on the command line; name a program, and an emulator if it needs one")
    demo = subprocess.Popen(sys.argv[:0:-1] + ["demo"], stdout=subprocess.PIPE, text=True)
    try:
        printed = ""
        for line in demo.stdout:
            printed += line
            if "Ctrl-C ends the demo." in line:
                break
        else:
            fail("it ended", f"it printed: {printed}")
        http = int(re.search(r"http://127\.0\.0\.1:(\d+)", printed)[1])
        modbus = int(re.search(r"tcp -p (\d+)", printed)[1])

        def online():
            drives = get(http, "/api/v1/drives") or []
            return len(drives) == DRIVES and all(drive["state"] != "offline" for drive in drives)

        until("drives online", online)
        write(modbus, 1, COMMAND + 1, [5000])
        write(modbus, 1, COMMAND, [1])
        until("running pump-1", lambda: (get(http, "/api/v1/drives/pump-1") or {}).get("state") == "running")
        write(modbus, 1, COMMAND, [0])
        until("stopped pump-1", lambda: (get(http, "/api/v1/drives/pump-1") or {}).get("state") == "ready")
        demo.send_signal(signal.SIGINT)
        if demo.wait(timeout=LIMIT) != 0:
            fail(f"exit code {demo.returncode}", "it must be 0 after SIGINT")
        print(f"{sys.argv[1]}: {DRIVES} drives online, pump-1 started and stopped")
    finally:
        if demo.poll() is None:
            demo.kill()


if __name__ == "__main__":
    main()
