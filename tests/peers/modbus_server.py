"""A server of pymodbus with registers of 0: modbus_server.py PORT socket|rtu: Modbus TCP, or frames of RTU over TCP."""

import asyncio
import sys

from pymodbus import FramerType
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice


async def main():
    device = SimDevice(1, simdata=[SimData(0, count=5000, values=0, datatype=DataType.REGISTERS)])
    framer = FramerType(sys.argv[2])
    server = ModbusTcpServer(device, address=("127.0.0.1", int(sys.argv[1])), framer=framer)
    await server.serve_forever(background=True)
    print("listening", flush=True)
    await asyncio.Event().wait()


asyncio.run(main())
