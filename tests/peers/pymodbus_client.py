"""Works off tests/peers/script.json with pymodbus: pymodbus_client.py PORT [CA CERTIFICATE KEY]. With three files by TLS."""

import json
import pathlib
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


def ask(client, step):
    where = {"address": step["address"], "device_id": step["unit"]}
    values, count = step.get("values"), len(step.get("expect", []))
    bits = [bool(value) for value in values or []]
    return {
        1: lambda: client.read_coils(**where, count=count),
        2: lambda: client.read_discrete_inputs(**where, count=count),
        3: lambda: client.read_holding_registers(**where, count=count),
        4: lambda: client.read_input_registers(**where, count=count),
        5: lambda: client.write_coil(**where, value=bits[0]),
        6: lambda: client.write_register(**where, value=values[0]),
        15: lambda: client.write_coils(**where, values=bits),
        16: lambda: client.write_registers(**where, values=values),
    }[step["function"]]()


def main():
    client = connect(int(sys.argv[1]), sys.argv[2:])
    if not client.connect():
        sys.exit("no connection")
    for step in json.loads(pathlib.Path(__file__).with_name("script.json").read_text()):
        reply = ask(client, step)
        check(step["what"], reply.exception_code if reply.isError() else None, step.get("exception"))
        if "expect" in step and not reply.isError():
            wanted = step["expect"]
            got = [int(bit) for bit in reply.bits[: len(wanted)]] if step["function"] < 3 else reply.registers
            check(step["what"], got, wanted)
    reply = client.read_device_information(device_id=1)
    check("vendor", reply.information[0], b"drivegate")
    check("product", reply.information[1], b"vacon-nx")
    reply = client.read_device_information(read_code=2, device_id=255)
    check("gateway", reply.information[5], b"pump-house")
    client.close()
    print("ok")


main()
