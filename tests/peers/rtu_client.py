"""Reads by pymodbus with frames of RTU over TCP: rtu_client.py PORT START COUNT. Prints what came of it."""

import sys

from pymodbus import FramerType
from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException

port, start, count = map(int, sys.argv[1:])
client = ModbusTcpClient("127.0.0.1", port=port, framer=FramerType.RTU, timeout=5, retries=0)
if not client.connect():
    sys.exit("no connection")
try:
    print(client.read_holding_registers(start, count=count, device_id=1))
except ModbusException as error:
    print(error)
