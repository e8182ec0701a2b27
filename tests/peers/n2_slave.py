"""A minimal N2 slave behind a TCP port, as a serial device server has it, written from the description of the frames alone.

Waits for Identify, then serves three objects: AI 2 (a float), BI 2 (a state) and AO 1 (a float that can be overridden).
With "byte" as its argument a status byte stands before floats. Tells its port first, then what it was asked.
"""

import socket
import struct
import sys

LEADING = "00" if "byte" in sys.argv[1:] else ""


def checksum(text):
    return "%02X" % (sum(map(ord, text)) % 256)


def data(text):
    return "A" + text + checksum(text)


def as_float(value):
    return struct.pack(">f", value).hex().upper()


class Drive:
    def __init__(self):
        self.waiting = True
        self.speed = 0.0
        self.first = True

    def answer(self, body):
        if body == "F":
            self.waiting, self.first = False, True
            return data("10")
        if self.waiting:
            return "N00"
        if body in ("04", "05"):
            report, self.first = self.first and body == "04", False
            return data("10200" + as_float(25.0)) if report else "A"
        if body == "1" + "1" + "02" + "03":
            return data(LEADING + as_float(25.0))
        if body == "1" + "2" + "02" + "02":
            return data("40")
        if body == "1" + "3" + "01" + "03":
            return data(LEADING + as_float(self.speed))
        for override in ("72" + "03" + "01", "72" + "3" + "01"):
            if body.startswith(override) and len(body) == len(override) + 8:
                self.speed = struct.unpack(">f", bytes.fromhex(body[len(override):]))[0]
                return "A"
        if body in ("73" + "03" + "01", "73" + "3" + "01"):
            return "A"
        return "N11"


def serve(connection, drive):
    frame = ""
    while True:
        byte = connection.recv(1)
        if not byte:
            return
        char = byte.decode("latin-1")
        if char == ">":
            frame = ""
        elif char != "\r":
            frame += char
        else:
            print(frame, flush=True)
            if not frame.startswith("01"):
                continue
            ok = checksum(frame[:-2]) == frame[-2:].upper()
            reply = drive.answer(frame[2:-2]) if ok else "N02"
            connection.sendall((reply + "\r").encode("ascii"))


listener = socket.create_server(("127.0.0.1", 0))
print(listener.getsockname()[1], flush=True)
serve(listener.accept()[0], Drive())
