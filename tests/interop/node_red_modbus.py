"""Node-RED from npm with its Modbus nodes: they read the common model, run and stop a drive, and find the gateway again."""

import json

from bench import Bench, expect, free_port, say, until
from red import NodeRed, function, inject, node

MODBUS_TCP = '[modbus_tcp]\nlisten = ["127.0.0.1:{port}"]\nwrite = ["127.0.0.1/32"]\n'
TAB = "drives"
RUNNING = 2
STALE, ONLINE = 1 << 14, 1 << 15
# Button, function, unit id, address, quantity, value.
WRITES = [
    ("run", 16, 1, 0x8100, 2, [1, 3000]),
    ("faster", 6, 1, 0x8101, 1, 5000),
    ("limit", 6, 1, 0x8101, 1, 9000),
    ("monitored", 6, 2, 0x8100, 1, 1),
    ("stop", 6, 1, 0x8100, 1, 0),
]
SHOWN = {"showStatusActivities": False, "showErrors": True, "showWarnings": True}


def flow(port):
    """Reads 0x8000 to 0x8012 each 200 ms, and writes what a button says with the node for any function."""
    client = {
        "id": "gateway", "type": "modbus-client", "clienttype": "tcp", "bufferCommands": True, "stateLogEnabled": False,
        "queueLogEnabled": False, "failureLogEnabled": True, "tcpHost": "127.0.0.1", "tcpPort": str(port), "tcpType": "DEFAULT",
        "unit_id": "1", "commandDelay": "1", "clientTimeout": "1000", "reconnectOnTimeout": True, "reconnectTimeout": "1000",
        "parallelUnitIdsAllowed": True, "serialConnectionDelay": "100",
    }
    table = {"unitid": "1", "dataType": "HoldingRegister", "adr": "32768", "quantity": "19", "rate": "200", "rateUnit": "ms"}
    read = node("read", TAB, "modbus-read", ["keep"], server="gateway", **table, **SHOWN)
    write = node("write", TAB, "modbus-flex-write", ["answer"], server="gateway", emptyMsgOnFail=True, **SHOWN)
    # The second output has what the device answered.
    read["wires"].append([])
    write["wires"].append([])
    keep = "flow.set('count', (flow.get('count') || 0) + 1); flow.set('registers', Array.from(msg.payload)); return msg;"
    answer = "flow.set('answer', {topic: msg.topic, error: msg.error ? String(msg.error.message || msg.error) : null}); return msg;"
    buttons = [
        inject(name, TAB, ["write"], json.dumps({"fc": code, "unitid": unit, "address": address, "quantity": quantity, "value": value}))
        for name, code, unit, address, quantity, value in WRITES
    ]
    tab = {"id": TAB, "type": "tab", "label": "Drives"}
    return [tab, client, read, write, function("keep", TAB, keep), function("answer", TAB, answer), *buttons]


def main():
    with Bench() as bench:
        bench.line(2)
        port = free_port()
        configuration = bench.configuration(["p1", "p2"], MODBUS_TCP.format(port=port), ["p2"])
        gateway = bench.gateway(configuration)
        red = NodeRed(bench, flow(port))
        registers = lambda: red.kept(TAB, "registers")

        def press(button):
            """Presses a button and returns the error that Node-RED got, or None."""
            red.press(button)
            answer, _ = until(f"an answer to {button}", lambda: [a for a in [red.kept(TAB, "answer")] if a and a["topic"] == f"pressed {button}"])
            return answer[0]["error"]

        until("the registers", registers)
        bits = registers()[0]
        expect("Node-RED reads p1 online, fresh, standing", bits & ONLINE and not bits & (STALE | RUNNING))
        expect("function 16 to run at 30 % is acknowledged", press("run") is None)
        until("the motor", lambda: bench.point("p1", "running"))
        expect("the drive has the reference 30 %", bench.point("p1", "speed_reference") == 30.0)
        until("the speed", lambda: registers()[0] & RUNNING and 2900 < registers()[4] < 3100)
        say("   ok: Node-RED reads that it runs at 30 %")
        expect("function 6 to 50 % is acknowledged", press("faster") is None)
        until("the reference", lambda: bench.point("p1", "speed_reference") == 50.0)
        error = press("limit")
        expect(f"90 % is outside the limits: {error}", error and bench.point("p1", "speed_reference") == 50.0)
        error = press("monitored")
        expect(f"p2 is monitored: {error}", error and not bench.point("p2", "running"))

        gateway.kill()
        gateway.wait()
        bench.gateway(configuration)
        before = red.kept(TAB, "count")
        _, took = until("new registers", lambda: red.kept(TAB, "count") > before)
        expect(f"gateway killed and restarted, read again after {took:.1f} s, the motor ran on", registers()[0] & RUNNING)
        expect("function 6 to stop is acknowledged", press("stop") is None)
        _, took = until("the stop", lambda: not bench.point("p1", "running"))
        say(f"   ok: the motor stands {took:.1f} s later, by its ramp")
        until("the registers", lambda: not registers()[0] & RUNNING)


main()
