"""Reads and commands a gateway of the Modbus TCP tests with pymodbus: pymodbus_client.py PORT [CA CERTIFICATE KEY].

With three files it speaks TLS.
"""

import ssl
import sys

from pymodbus.client import ModbusTcpClient, ModbusTlsClient


def check(what, got, wanted):
    if got != wanted:
        sys.exit(f"{what}: got {got}, wanted {wanted}")


def connect(port, files):
    if not files:
        return ModbusTcpClient("127.0.0.1", port=port)
    ca, certificate, key = files
    context = ssl.create_default_context(cafile=ca)
    # pymodbus does not tell the context which host it connects to.
    context.check_hostname = False
    context.load_cert_chain(certificate, key)
    return ModbusTlsClient("127.0.0.1", port=port, sslctx=context)


def main():
    client = connect(int(sys.argv[1]), sys.argv[2:])
    if not client.connect():
        sys.exit("no connection")
    reply = client.read_holding_registers(0x8000, count=2, device_id=1)
    check("status and state", reply.registers, [0x80A3, 3])
    reply = client.read_input_registers(2100, count=11, device_id=1)
    check("process data", reply.registers[2:5], [5000, 2500, 1440])
    reply = client.read_holding_registers(0x8202, count=2, device_id=1)
    data_type = client.DATATYPE.FLOAT32
    check("float", client.convert_from_registers(reply.registers, data_type), 25.0)
    reply = client.write_registers(0x8100, [1, 5000, 0xFFFF], device_id=1)
    check("command", reply.isError(), False)
    reply = client.write_register(0x8100, 8, device_id=1)
    check("command bits", reply.exception_code, 3)
    reply = client.write_register(0x8100, 1, device_id=2)
    check("monitored drive", reply.exception_code, 1)
    reply = client.read_coils(7, count=1, device_id=4)
    check("coil", reply.bits[:1], [True])
    reply = client.read_device_information(device_id=1)
    check("vendor", reply.information[0], b"drivegate")
    check("product", reply.information[1], b"vacon-nx")
    reply = client.read_device_information(read_code=2, device_id=255)
    check("gateway", reply.information[5], b"pump-house")
    client.close()
    print("ok")


main()
