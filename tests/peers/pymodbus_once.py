"""One request by pymodbus from an address of its own: pymodbus_once.py PORT ADDRESS UNIT REGISTER [VALUE …].

Reads the register, or writes the values from there. Prints the value, `ok`, or `exception CODE`.
"""

import sys

from pymodbus.client import ModbusTcpClient


def main():
    port, source = int(sys.argv[1]), sys.argv[2]
    unit, register, *values = (int(text, 0) for text in sys.argv[3:])
    client = ModbusTcpClient("127.0.0.1", port=port, source_address=(source, 0), timeout=30)
    if not client.connect():
        sys.exit("no connection")
    if values:
        reply = client.write_registers(register, values, device_id=unit)
    else:
        reply = client.read_holding_registers(register, count=1, device_id=unit)
    client.close()
    if reply.isError():
        print(f"exception {reply.exception_code}")
    else:
        print("ok" if values else reply.registers[0])


main()
