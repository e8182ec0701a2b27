"""Another master: polling_master.py PORT rtu|ascii BAUD COUNT polls drives 1 and 2 by pymodbus, commands drive 1 once, and prints what
it read last, one line a block: ADDRESS FIRST WORD WORD ..."""

import sys

from pymodbus import FramerType
from pymodbus.client import ModbusSerialClient

port, framer, baud, count = sys.argv[1], FramerType(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
client = ModbusSerialClient(port, framer=framer, baudrate=baud, timeout=10, retries=5)
if not client.connect():
    sys.exit(f"cannot open {port}")
client.write_registers(2000, [1, 0, 4000], device_id=1)
read = {}
done = 1
while done < count:
    for address in (1, 2):
        for first, length in ((2100, 11), (2000, 3), (7, 2)):
            reply = client.read_holding_registers(first, count=length, device_id=address)
            if reply.isError():
                sys.exit(f"{address} {first}: {reply}")
            read[address, first] = reply.registers
            done += 1
for (address, first), words in sorted(read.items()):
    print(address, first, *words, flush=True)
