"""Tools at the slot of a bus, by pymodbus: `slot_tool.py raw|ascii|serial|rfc2217 TARGET REQUESTS`.

Reads registers of two drives in blocks, as QModMaster does (one block over and over) and as a parameter tool does (one
register after the other). Every answer is compared with what the registers held first; they do not change meanwhile.
"""

import random
import sys
import time

import serial
from pymodbus import FramerType
from pymodbus.client import ModbusSerialClient, ModbusTcpClient

# Parameters of a Vacon NX; status and monitoring of a TECO that stands.
FIRST, LAST = (32, 51) if sys.argv[1] == "ascii" else (100, 119)


def client(way, target):
    if way == "raw":
        host, port = target.rsplit(":", 1)
        return ModbusTcpClient(host, port=int(port), framer=FramerType.RTU, timeout=2, retries=0)
    if way == "ascii":
        host, port = target.rsplit(":", 1)
        return ModbusTcpClient(host, port=int(port), framer=FramerType.ASCII, timeout=2, retries=0)
    # A baud rate of its own choice.
    return ModbusSerialClient(target, baudrate=115200, timeout=2, retries=0)


class Rfc2217Port:
    """Just enough of a master over pyserial's RFC 2217 client: pymodbus opens devices by name only."""

    def __init__(self, target):
        self.port = serial.serial_for_url(f"rfc2217://{target}", baudrate=19200, parity="N", timeout=2)

    def connect(self):
        return True

    def read(self, unit, start, count):
        body = bytes([unit, 3]) + start.to_bytes(2, "big") + count.to_bytes(2, "big")
        self.port.reset_input_buffer()
        self.port.write(body + crc(body))
        head = self.port.read(3)
        if len(head) < 3:
            return None
        if head[1] & 0x80:
            self.port.read(2)
            return head[2]
        reply = head + self.port.read(head[2] + 2)
        assert crc(reply[:-2]) == reply[-2:], reply.hex()
        assert reply[0] == unit and reply[2] == 2 * count, reply.hex()
        return [int.from_bytes(reply[3 + 2 * i : 5 + 2 * i], "big") for i in range(count)]

    def close(self):
        self.port.close()


def crc(body):
    value = 0xFFFF
    for byte in body:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return value.to_bytes(2, "little")


def read(tool, unit, start, count):
    """The words, the code of an exception, or None."""
    if isinstance(tool, Rfc2217Port):
        return tool.read(unit, start, count)
    reply = tool.read_holding_registers(start, count=count, device_id=unit)
    if hasattr(reply, "exception_code") and reply.isError():
        return reply.exception_code
    return None if reply.isError() else reply.registers


def main():
    way, target, requests = sys.argv[1], sys.argv[2], int(sys.argv[3])
    dice = random.Random(11)
    tool = Rfc2217Port(target) if way == "rfc2217" else client(way, target)
    assert tool.connect(), target
    known, silent, longest, began = {}, 0, 0.0, time.monotonic()
    for turn in range(requests):
        unit = 1 + turn % 2
        block = (FIRST, 4) if turn % 3 == 0 else (dice.randint(FIRST, LAST - 1), dice.randint(1, 2))
        asked = time.monotonic()
        words = read(tool, unit, *block)
        longest = max(longest, time.monotonic() - asked)
        # The gateway stays silent rather than late; on a busy machine that may happen.
        for _ in range(20):
            if words is not None:
                break
            silent += 1
            words = read(tool, unit, *block)
        assert words is not None, block
        if isinstance(words, list):
            assert len(words) == block[1], (block, words)
            for offset, word in enumerate(words):
                place = (unit, block[0] + offset)
                assert known.setdefault(place, word) == word, (place, word, known[place])
        else:
            assert known.setdefault((unit, block), words) == words, (block, words)
    tool.close()
    took = time.monotonic() - began
    print(f"{way}: {requests} requests, {silent} without answer, {len(known)} values, {took:.1f} s, longest {longest:.3f} s")


if __name__ == "__main__":
    main()
