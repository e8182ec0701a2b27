"""Another master of N2, written for itself: n2_master.py PORT COUNT identifies drive 1, polls it for changes and reads AI 1 to 4 and BI 1
to 4; prints what it read last, one line an object: AI 1 FLOAT, BI 1 STATUS."""

import os
import struct
import sys
import time
import tty

port = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
tty.setraw(port)


def ask(command):
    """The digits of the answer, without its checksum."""
    body = "01" + command
    os.write(port, f">{body}{sum(body.encode()) & 255:02X}\r".encode())
    line = b""
    while not line.endswith(b"\r"):
        line += os.read(port, 64)
    line = line.decode().strip("\r")
    if line[0] != "A":
        sys.exit(f"{command}: {line}")
    digits, check = line[1:-2], line[-2:]
    if line[1:] and f"{sum(digits.encode()) & 255:02X}" != check.upper():
        sys.exit(f"{command}: the checksum of {line} is wrong")
    time.sleep(0.005)
    return digits


ask("F")
read, done = {}, 1
while done < int(sys.argv[2]):
    if done % 100 == 1:
        ask("04")
    for number in range(1, 5):
        read["AI", number] = struct.unpack(">f", bytes.fromhex(ask(f"11{number:02X}03")[-8:]))[0]
        read["BI", number] = int(ask(f"12{number:02X}02"), 16)
        done += 2
for (kind, number), value in sorted(read.items()):
    print(kind, number, value, flush=True)
