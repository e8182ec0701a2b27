"""pymodbus as the master of a simulated Vacon CX (RTU) or TECO 7300PA (ASCII): one line a step, checked by sim_peers.rs."""

import sys
import time

from pymodbus import FramerType
from pymodbus.client import ModbusSerialClient
from pymodbus.pdu.diag_message import ForceListenOnlyModeRequest, RestartCommunicationsOptionRequest

model, port = sys.argv[1:]
# Pause after a request without a reply: on a machine that stalls the line must not take it and the next one for one frame.
UNANSWERED = 0.5
FRAMERS = {"cx": FramerType.RTU, "teco": FramerType.ASCII}
# A pseudo-terminal knows characters of 8 bits without parity only.
client = ModbusSerialClient(port, framer=FRAMERS[model], baudrate=19200, parity="N", stopbits=1, timeout=30, retries=0)
if not client.connect():
    sys.exit(f"cannot open {port}")


def show(name, reply):
    """What came back: an exception, bits or registers."""
    if reply.isError():
        text = f"exception {reply.exception_code}"
    elif getattr(reply, "bits", []):
        text = "".join("1" if bit else "0" for bit in reply.bits)
    else:
        text = " ".join(map(str, getattr(reply, "registers", [])))
    print(f"{name}: {text}", flush=True)
    time.sleep(0.005)


def until(read, wanted):
    """Asks until the answer is there: the drive ramps."""
    for _ in range(200):
        if read() == wanted:
            return
        time.sleep(0.05)
    sys.exit(f"the drive does not come to {wanted}, it has {read()}")


def cx():
    show("idle", client.read_discrete_inputs(0, count=5))
    show("reference", client.write_register(0, 1000))
    show("run", client.write_coil(0, True))
    until(lambda: client.read_input_registers(0, count=1).registers, [1000])
    show("running", client.read_discrete_inputs(0, count=5))
    show("variables", client.read_input_registers(0, count=2))
    show("par 1.2", client.read_holding_registers(101, count=1))
    show("above it", client.write_register(0, 5001))
    show("no coil", client.read_coils(0x042E, count=1))
    show("no function", client.write_registers(0, [1, 2]))
    show("no parameter", client.read_holding_registers(199, count=1))
    client.write_coil(0, False, device_id=0, no_response_expected=True)
    time.sleep(UNANSWERED)
    show("broadcast", client.read_coils(0, count=3))
    show("echo", client.diag_query_data(b"\xa5\x37"))
    client.execute(True, ForceListenOnlyModeRequest())
    time.sleep(UNANSWERED)
    client.write_coil(0, True, no_response_expected=True)
    time.sleep(UNANSWERED)
    client.execute(True, RestartCommunicationsOptionRequest())
    time.sleep(UNANSWERED)
    show("listened only", client.read_coils(0, count=3))


def teco():
    show("idle", client.read_holding_registers(0x20, count=2))
    show("run", client.write_registers(1, [1, 3000]))
    until(lambda: client.read_holding_registers(0x24, count=1).registers, [3000])
    show("running", client.read_holding_registers(0x20, count=2))
    show("frequencies", client.read_holding_registers(0x23, count=2))
    show("17 registers", client.read_holding_registers(0x20, count=17))
    show("Cn-02 in DRIVE", client.write_register(0x201, 600))
    show("Bn-01", client.write_register(0x500, 40))
    show("beyond it", client.write_register(0x500, 60001))
    show("no register", client.read_holding_registers(0x10, count=1))
    show("no function", client.read_input_registers(0x20, count=1))
    show("save while running", client.write_register(0x900, 0))
    client.write_register(1, 0, device_id=0, no_response_expected=True)
    time.sleep(UNANSWERED)
    until(lambda: client.read_holding_registers(0x24, count=1).registers, [0])
    show("save", client.write_register(0x900, 0))


{"cx": cx, "teco": teco}[model]()
