"""pymodbus as the master of a simulated line: simulated_line.py PORT rtu|ascii prints one line a step, checked by
sim_peers.rs."""

import sys
import time

from pymodbus import FramerType
from pymodbus.client import ModbusSerialClient

framer = FramerType(sys.argv[2])
client = ModbusSerialClient(
    sys.argv[1], framer=framer, baudrate=38400, parity="N", stopbits=1, timeout=30, retries=0
)
if not client.connect():
    sys.exit(f"cannot open {sys.argv[1]}")


def show(reply):
    """Registers of a reply, or the exception code."""
    print(f"exception {reply.exception_code}" if reply.isError() else " ".join(map(str, reply.registers)), flush=True)
    time.sleep(0.005)


def settled():
    """The status registers, once the drive is at its reference."""
    for _ in range(100):
        reply = client.read_holding_registers(2100, count=11, device_id=2)
        time.sleep(0.1)
        if reply.registers[0] & 0x20:
            # The first reading may still show the torque that the ramp took.
            return client.read_holding_registers(2100, count=11, device_id=2)
    sys.exit("the drive does not reach its reference")


show(client.read_input_registers(2100, count=2, device_id=2))
show(client.write_registers(2000, [3, 0, 5000], device_id=2))
show(settled())
show(client.read_holding_registers(0, count=9, device_id=2))
show(client.read_holding_registers(6000, count=5, device_id=2))
show(client.read_holding_registers(0, count=31, device_id=2))
show(client.write_register(2100, 1, device_id=2))
show(client.write_register(732, 4, device_id=2))
show(client.read_coils(0, count=1, device_id=2))
client.write_register(2000, 0, device_id=0, no_response_expected=True)
time.sleep(0.05)
show(client.read_holding_registers(2000, count=3, device_id=2))
show(client.write_register(732, 2, device_id=2))
show(client.read_holding_registers(732, count=1, device_id=2))
