"""Lines between gateways and simulated drives: line.py BAUD WRITES GATEWAY=DRIVES...

Serves a pseudo-terminal under each path GATEWAY and passes bytes on to that at DRIVES, if the gateway has set BAUD: at any other rate
nothing arrives, as on a real line. Appends every request that writes to the file WRITES. Prints `ready`.
"""

import fcntl
import os
import selectors
import struct
import sys
import tty

# Coil, register, coils, registers, mask, read and write.
WRITES = (5, 6, 15, 16, 22, 23)
# Linux: `struct termios2` ends with the rates of both directions, in bits a second.
TCGETS2, TERMIOS2 = 0x802C542A, 44


def baud(port):
    return struct.unpack("=I", fcntl.ioctl(port, TCGETS2, bytes(TERMIOS2))[-4:])[0]


def gateway_end(path):
    own, other = os.openpty()
    tty.setraw(own)
    tty.setraw(other)
    os.symlink(os.ttyname(other), path)
    os.set_blocking(own, False)
    # The other end stays open, so that gateways may come and go.
    return own


def drives_end(path):
    drives = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(drives)
    return drives


def give(port, data):
    try:
        os.write(port, data)
    except BlockingIOError:
        pass


def main():
    speed = int(sys.argv[1])
    writes = open(sys.argv[2], "a", buffering=1, encoding="ascii")
    ends = selectors.DefaultSelector()
    for pair in sys.argv[3:]:
        gateway, drives = pair.split("=")
        own, far = gateway_end(gateway), drives_end(drives)
        ends.register(own, selectors.EVENT_READ, (own, far, gateway))
        ends.register(far, selectors.EVENT_READ, (own, own, None))
    print("ready", flush=True)
    while True:
        for key, _ in ends.select():
            own, to, gateway = key.data
            try:
                data = os.read(key.fd, 4096)
            except BlockingIOError:
                continue
            # Both ends of a pseudo-terminal have the settings that the gateway made.
            if baud(own) != speed:
                continue
            if gateway and len(data) > 1 and data[1] in WRITES:
                writes.write(f"{os.path.basename(gateway)} {data.hex()}\n")
            give(to, data)


main()
