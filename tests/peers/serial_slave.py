"""A pymodbus slave on a pseudo-terminal: serial_slave.py PORT rtu|ascii.

Address 1, every table from 0 to 19: register n of the holding table holds 100 + n, of the input table 200 + n; every
third coil and every second discrete input is on. A pseudo-terminal knows no format, so none is named.
"""

import sys

from pymodbus import FramerType
from pymodbus.server import StartSerialServer
from pymodbus.simulator import DataType, SimData, SimDevice


def bits(step):
    return [SimData(0, values=[n % step == 0 for n in range(20)], datatype=DataType.BITS)]


def registers(first):
    return [SimData(0, values=[first + n for n in range(20)], datatype=DataType.REGISTERS)]


device = SimDevice(1, simdata=(bits(3), bits(2), registers(100), registers(200)))
StartSerialServer(
    device,
    framer=FramerType(sys.argv[2]),
    port=sys.argv[1],
    baudrate=19200,
    trace_connect=lambda connected: print("connected" if connected else "gone", flush=True),
)
