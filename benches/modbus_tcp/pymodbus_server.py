"""A Modbus TCP server on pymodbus: eleven holding registers from 2100. Prints its port; ends with standard input."""

import asyncio
import socket
import sys

from pymodbus.datastore import ModbusDeviceContext, ModbusSequentialDataBlock, ModbusServerContext
from pymodbus.server import ModbusTcpServer


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


async def main():
    # A data block counts from 1, so PDU address 2100 is its register 2101.
    block = ModbusSequentialDataBlock(2101, [1000 + i for i in range(12)])
    context = ModbusServerContext(devices=ModbusDeviceContext(hr=block), single=True)
    port = free_port()
    server = ModbusTcpServer(context, address=("127.0.0.1", port))
    task = asyncio.create_task(server.serve_forever())
    await asyncio.sleep(0.5)
    print(port, flush=True)
    await asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)
    await server.shutdown()
    task.cancel()


asyncio.run(main())
