"""A user's path over Modbus TCP by pymodbus: values, reference, start, fault, reset, start, stop all.

path_client.py PORT UNIT. Prints `running` when the motor runs; from then on it waits for a fault, which the test causes.
"""

import sys
import time

from pymodbus.client import ModbusTcpClient

BITS, STATE, AGE, SPEED, FREQUENCY, REFERENCE = 0x8000, 0x8001, 0x8002, 0x8004, 0x8005, 0x8101
COMMAND, STOP_ALL, NOT_STANDING = 0x8100, 0x0100, 0x8101
RUNNING, FAULT, ONLINE = 3, 4, 0x8000
RUN, RESET = 1, 4
PATIENCE = 120  # s
GATEWAY = 255


class Client:
    def __init__(self, port, unit):
        self.unit = unit
        self.modbus = ModbusTcpClient("127.0.0.1", port=port, timeout=60)
        if not self.modbus.connect():
            sys.exit("no connection")

    def read(self, address, unit=None):
        """The word; none while the gateway has no value."""
        reply = self.modbus.read_holding_registers(address, count=1, device_id=unit or self.unit)
        return None if reply.isError() else reply.registers[0]

    def write(self, address, word, unit=None):
        """Again where the order took too long: on a busy machine it may expire."""
        self.until(f"a write of {word} to {address:#06x}", lambda: not self.modbus.write_register(address, word, device_id=unit or self.unit).isError())

    def until(self, what, holds):
        end = time.monotonic() + PATIENCE
        while not holds():
            if time.monotonic() > end:
                sys.exit(f"never came: {what}; the state is {self.read(STATE)}")
            time.sleep(0.02)

    def turns(self):
        """Speed or frequency, whichever the family has, is not 0."""
        return self.read(STATE) == RUNNING and any(word not in (None, 0, 0x8000) for word in (self.read(SPEED), self.read(FREQUENCY)))


def main():
    client = Client(int(sys.argv[1]), int(sys.argv[2]))
    client.until("good values", lambda: (client.read(BITS) or 0) & ONLINE and client.read(AGE) not in (None, 0xFFFF))
    if client.read(STATE) == RUNNING:
        sys.exit("the motor runs before it was started")
    client.write(REFERENCE, 4000)
    client.write(COMMAND, RUN)
    client.until("the start", client.turns)
    print("running", flush=True)
    client.until("the fault", lambda: client.read(STATE) == FAULT)
    client.write(COMMAND, RESET)
    client.until("the end of the fault", lambda: client.read(STATE) not in (None, FAULT))
    if client.read(STATE) == RUNNING:
        sys.exit("the reset started the motor")
    client.write(COMMAND, RUN)
    client.until("the second start", client.turns)
    client.write(STOP_ALL, 1, GATEWAY)
    client.until("standstill of all drives", lambda: client.read(NOT_STANDING, GATEWAY) == 0)
    client.until("the end of running", lambda: client.read(STATE) not in (None, RUNNING))
    print("stopped", flush=True)


main()
