"""The energy meter of docs/profiles.md on a raw serial-over-TCP port, Modbus RTU: energy_meter.py PORT."""

import sys

from pymodbus import FramerType
from pymodbus.datastore import ModbusDeviceContext, ModbusSequentialDataBlock, ModbusServerContext
from pymodbus.server import StartTcpServer

INPUTS = [
    0x4366, 0x8000,  # 230.5 V, float, high word first
    0x40A6, 0x6666,  # 5.2 A
    0xC4FA, 0x0000,  # -2000.0 W
    0xE240, 0x0001,  # 123456 = 1234.56 kWh, low word first
    0xFF38, 0xFFFF,  # -200 = -2.00 kvarh, low word first
    0xFC7C,          # -900 = -0.9
    4998,            # 49.98 Hz
    81,              # 31 °C
    0, 0, 0,
    0x0051,          # warning, wrong order of phases (bit 3 is 0), tariff 5
    2,               # 3 phases, 3 wires
    0x7FC0, 0x0000,  # no number
    0x534E, 0x2D34, 0x3200, 0x5858,  # "SN-42", ended by a NUL
    0x0001, 0x0000, 0x0000, 0x0020,  # 2 to the 53rd and 1, low word first
    0x1234,          # 1234 in decimals
    0x7FFF,          # not available
    1234, 0xFFFE,    # 12.34: 1234 x 10 to the -2
    0x00A5,          # bits 7 to 4: 10, bits 3 to 0: 5
]  # fmt: skip


def main():
    # A block counts its addresses from 1.
    device = ModbusDeviceContext(
        ir=ModbusSequentialDataBlock(1, INPUTS),
        hr=ModbusSequentialDataBlock(257, [40, 15]),
        co=ModbusSequentialDataBlock(1, [True]),
    )
    context = ModbusServerContext(devices={7: device}, single=False)
    StartTcpServer(context, framer=FramerType.RTU, address=("127.0.0.1", int(sys.argv[1])))


main()
