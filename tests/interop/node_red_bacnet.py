"""Node-RED from npm with @bitpoolos/edge-bacnet: it finds the drives by broadcast, reads them, runs and stops one; both layouts."""

from bench import Bench, expect, say, until
from red import NodeRed, function, inject, installed, node
from subnet import HERE, NEIGHBOUR, enter, lay, start_at_neighbour

TAB = "drives"
DEVICE = 100
PORT = 47808
BACNET = """[bacnet]
listen = "{here}:{port}"
device = {device}
layout = "{layout}"
commands = true
allow = ["{neighbour}/32"]
write = ["{neighbour}/32"]
"""
ANALOG_INPUT, ANALOG_VALUE, BINARY_INPUT, BINARY_VALUE = 0, 2, 3, 5
READ = [("actual_speed", ANALOG_INPUT, 1), ("running", BINARY_INPUT, 2), ("speed_reference", ANALOG_VALUE, 1)]
AUTOMATIC, NULL = -1, 0
# Button, type, number, application tag, value, its kind.
WRITES = [
    ("reference", ANALOG_VALUE, 1, AUTOMATIC, "30", "num"),
    ("run", BINARY_VALUE, 1, AUTOMATIC, "true", "bool"),
    ("limit", ANALOG_VALUE, 1, AUTOMATIC, "90", "num"),
    ("stop", BINARY_VALUE, 1, AUTOMATIC, "false", "bool"),
    ("relinquish", BINARY_VALUE, 1, NULL, "null", "str"),
]


class Layout:
    """Where the objects of drive `unit` are."""

    def __init__(self, name, unit=1):
        self.name, self.unit = name, unit
        self.device = DEVICE + unit if name == "routed" else DEVICE

    def object(self, kind, number):
        return {"type": kind, "instance": number if self.name == "routed" else self.unit * 1000 + number}

    def object_name(self, point):
        return point if self.name == "routed" else f"p{self.unit}.{point}"


def flow(layout):
    """Reads p1 each second, and writes a value per button at priority 8."""
    devices = {
        "id": "client", "type": "Bacnet-Gateway", "z": TAB, "x": 100, "y": 100, "name": "", "local_device_address": "0.0.0.0",
        "local_interface_name": "", "apduTimeout": 6000, "maxConcurrentRequests": 250, "roundDecimal": 2, "local_device_port": PORT,
        "apduSize": "5", "maxSegments": "0x50", "retries": "5", "broadCastAddr": "255.255.255.255", "toLogIam": True,
        "discover_polling_schedule": "900", "deviceId": 817001, "logErrorToConsole": True, "serverEnabled": False,
        "device_read_schedule": "5", "deviceRangeRegisters": [], "portRangeRegisters": [{"enabled": True, "start": PORT, "end": PORT}],
        "cacheFileEnabled": False, "sanitise_device_schedule": "3600", "enable_device_discovery": True, "wires": [["keep"]],
    }
    point = lambda name, kind, number: {"meta": {"objectId": layout.object(kind, number)}, "displayName": layout.object_name(name)}
    points = {layout.object_name(name): point(name, kind, number) for name, kind, number in READ}
    shape = {"object_property_simplePayload": True, "object_property_simpleWithStatus": False, "object_property_fullObject": False}
    read = node(
        "read", TAB, "Bacnet-Discovery", ["client"], json=True, mqtt=False, pointJson=False, roundDecimal=2, readDevices=[],
        pointsToRead={f"{HERE}-{layout.device}": points}, useDeviceName=True, name="", **shape,
    )
    keep = "flow.set('count', (flow.get('count') || 0) + 1); flow.set('points', msg.payload); return msg;"
    nodes = [
        {"id": TAB, "type": "tab", "label": "Drives"}, devices, read, function("keep", TAB, keep), inject("each", TAB, ["read"], "1", "num", "1"),
    ]
    for name, kind, number, tag, value, value_kind in WRITES:
        target = [{"deviceId": layout.device, "meta": {"objectId": layout.object(kind, number), "arrayIndex": 0xFFFFFFFF}}]
        nodes.append(inject(name, TAB, [f"write-{name}"], value, value_kind))
        nodes.append(node(
            f"write-{name}", TAB, "Bacnet-Write", ["client"], applicationTag=str(tag), priority="8", pointsToWrite=target, writeDevices=[],
        ))
    return nodes


def check(layout):
    lay()
    with Bench() as bench:
        bench.line(2)
        bacnet = BACNET.format(here=HERE, neighbour=NEIGHBOUR, port=PORT, device=DEVICE, layout=layout.name)
        configuration = bench.configuration(["p1", "p2"], bacnet)
        gateway = bench.gateway(configuration)
        red = NodeRed(bench, flow(layout), NEIGHBOUR, start_at_neighbour(bench))
        value = lambda name: red.kept(TAB, "points")[layout.object_name(name)]["presentValue"]
        running, reference = lambda: bench.point("p1", "running"), lambda: bench.point("p1", "speed_reference")

        wanted = {DEVICE, DEVICE + 1, DEVICE + 2} if layout.name == "routed" else {DEVICE}
        devices = lambda: {device["deviceId"] for device in red.get("/bitpool-bacnet-data/getDeviceList")["deviceList"]}
        # The nodes add a device without a number where they find a drive before its router.
        until("the devices", lambda: devices() >= wanted)
        say(f"   ok: {layout.name}: Who-Is to 255.255.255.255 finds {sorted(wanted)}")
        until("the points", lambda: set(red.kept(TAB, "points") or ()) == {layout.object_name(name) for name, *_ in READ})
        expect("Node-RED reads p1 standing", value("running") == 0 and value("actual_speed") == 0)

        red.press("reference")
        until("the reference", lambda: reference() == 30.0)
        red.press("run")
        until("the motor", running)
        until("the values", lambda: value("running") == 1 and 29 < value("actual_speed") < 31 and value("speed_reference") == 30)
        say("   ok: priority 8 runs the motor at 30 %, and Node-RED reads it")
        red.press("limit")
        until("the refusal in Node-RED's log", lambda: "writeProperty error for AV" in red.log.read_text())
        expect("90 % is outside the limits: refused", reference() == 30.0)

        gateway.kill()
        gateway.wait()
        bench.gateway(configuration)
        before = red.kept(TAB, "count")
        _, took = until("values again", lambda: red.kept(TAB, "count") > before and value("running") == 1)
        expect(f"gateway killed and restarted, read again after {took:.1f} s, the motor ran on", running())
        red.press("stop")
        _, took = until("the stop", lambda: not running())
        say(f"   ok: inactive at priority 8, the motor stands {took:.1f} s later, by its ramp")
        until("the values", lambda: value("running") == 0)
        red.press("run")
        until("the motor", running)
        red.press("relinquish")
        until("the stop", lambda: not running())
        say("   ok: started again, NULL at priority 8 stops it")


# The namespaces reach no registry.
installed()
enter()
for layout in ("routed", "flat"):
    check(Layout(layout))
