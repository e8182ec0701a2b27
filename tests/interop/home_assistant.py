"""Home Assistant from PyPI shows the drives by themselves, commands them, and knows when they are away."""

import json
import shutil
import subprocess
import time
from pathlib import Path

from bench import ROOT, Bench, end, expect, say, until
from hass import HomeAssistant, python_of_home_assistant

DISCOVERY = "[mqtt.home_assistant]\n"
# A profile of each family, the example of a meter, and their protocols.
FAMILIES = {
    "eaton-hvx": "modbus-rtu", "eaton-hvx-n2": "n2", "eaton-svx": "modbus-rtu", "teco-7300pa": "modbus-ascii",
    "teco-7300pa-n2": "n2", "vacon-cx": "modbus-rtu", "vacon-nx": "modbus-rtu", "vacon-nx-n2": "n2", "energy-meter": "modbus-rtu",
}
# Entities of the gateway for each bus.
OF_BUS = 5
# Keys of a state that are no entities.
BESIDES = {"quality", "time", "age_ms", "point_quality", "blocked_by"}


def entered(port):
    """What a user enters to set up the integration."""
    other = {"set_client_cert": False, "set_ca_cert": "off"}
    return {"broker": "127.0.0.1", "port": port, "other_settings": other}


def expected_entities(bench, drives):
    """One for each point of the state and its texts, and the events; those of the bus."""
    count = OF_BUS
    for drive in drives:
        state = json.loads(bench.retained(f"drivegate/hall/drive/{drive}/state"))
        texts = {key for key in state if key.endswith("_text") and key != "fault_text"}
        count += len(set(state) - BESIDES - texts) + 1
    return count


def check_schemas(python):
    """All entities of all families, held against the schemas of Home Assistant."""
    with Bench() as bench:
        bench.broker()
        profiles = bench.dir / "profiles"
        profiles.mkdir()
        shutil.copy(ROOT / "docs" / "energy-meter.toml", profiles)
        text = f'[gateway]\nname = "hall"\nsocket = ""\nstate_dir = "{bench.dir}/state"\nprofile_dirs = ["{profiles}"]\n'
        for number, (profile, protocol) in enumerate(FAMILIES.items()):
            text += f'[[bus]]\nname = "line{number}"\nport = "{bench.dir}/no-line{number}"\nprotocol = "{protocol}"\n'
            text += f'[[bus.drive]]\nname = "{profile}"\naddress = 1\nprofile = "{profile}"\naccess = "control"\n'
        text += f'[mqtt]\nurl = "mqtt://127.0.0.1:{bench.mqtt}"\ncommands = true\n{DISCOVERY}'
        configuration = bench.dir / "drivegate.toml"
        configuration.write_text(text)
        bench.gateway(configuration)
        topics = "homeassistant/device/drivegate_hall/+/config"
        read = lambda: bench.subscribe("-t", topics, "--retained-only", "-W", "1", "-F", "%t %p").splitlines()
        lines, _ = until("all messages", lambda: [lines for lines in [read()] if len(lines) == len(FAMILIES) + 1])
        messages = [dict(zip(("topic", "payload"), line.split(" ", 1))) for line in lines[0]]
        tool = Path(__file__).parent / "lib" / "discovery_schemas.py"
        told = "\n".join(json.dumps(message) for message in messages)
        answer = subprocess.run([python, tool], input=told, capture_output=True, text=True, check=True).stdout.splitlines()
        for fault in answer[:-1]:
            say(f"   {fault}")
        expect(f"{answer[-1]} of all families fit the schemas of Home Assistant", len(answer) == 1)


def main():
    python = python_of_home_assistant()
    check_schemas(python)
    with Bench() as bench:
        bench.broker()
        line = bench.line(3)
        drives = ["p1", "p2", "p3"]
        gateway = bench.gateway(bench.configuration(drives, DISCOVERY, ["p3"]))
        until("the first state", lambda: bench.retained("drivegate/hall/drive/p3/state"))
        hass = HomeAssistant(bench, "mqtt", entered(bench.mqtt))
        wanted = expected_entities(bench, drives)
        until("the entities", lambda: len(hass.entities()) >= wanted)
        time.sleep(1)
        entities = hass.entities()
        expect(f"{len(entities)} entities = {wanted} points", len(entities) == wanted)
        devices = {device["name"]: device for device in hass.ask(do="devices")}
        expect("a device for each drive, by the gateway", all(devices[d]["via"] == devices["hall"]["id"] for d in drives))
        controls = [name for name in entities if name.split(".")[0] in ("switch", "number", "button")]
        expect("controls of p1 and p2 only", len(controls) == 8 and not any("p3" in name for name in controls))
        available = lambda: all(e["state"] not in ("unavailable", None) for e in hass.entities().values())
        _, took = until("all to be available", available)
        say(f"   ok: all are available {took:.2f} s later")

        hass.call("number", "set_value", entity_id="number.p1_speed_reference", value=40)
        begin = time.monotonic()
        hass.call("switch", "turn_on", entity_id="switch.p1_run")
        until("the motor", lambda: hass.state("binary_sensor.p1_running") == "on")
        took = time.monotonic() - begin
        expect(f"switch on, the motor runs after {took:.2f} s", took <= 2)
        until("the speed", lambda: float(hass.state("sensor.p1_actual_speed")) > 39)
        until("the event", lambda: hass.entities()["event.p1_event"]["attributes"].get("event_type") == "started")
        hass.call("switch", "turn_off", entity_id="switch.p1_run")
        until("the stop", lambda: hass.state("binary_sensor.p1_running") == "off")
        hass.call("button", "press", entity_id="button.p1_fault_reset")

        gateway.kill()
        away = lambda: all(e["state"] == "unavailable" for e in hass.entities().values())
        _, took = until("unavailable", away)
        expect(f"gateway killed, all are unavailable after {took:.2f} s", took <= 2)
        gateway = bench.gateway(bench.configuration(drives[:2], DISCOVERY, ["p2"]))
        fewer = expected_entities(bench, drives[:2])
        until("a drive less", lambda: len(hass.entities()) == fewer)
        until("the others", lambda: hass.state("sensor.p1_state") == "ready")
        shown_only = lambda names: "switch.p2_run" not in names and "binary_sensor.p2_run" in names
        until("the switch of p2 to go", lambda: shown_only(hass.entities()))
        say("   ok: p2 lost its switch with `access`")
        end(line)
        until("the drive offline", lambda: hass.state("sensor.p1_state") == "offline")
        until("its values", lambda: hass.state("sensor.p1_motor_current") == "unavailable")
        say("   ok: a drive that is offline says so, and has no values")
        gateway.terminate()
        gateway.wait()
        gateway = bench.gateway(bench.configuration(drives[:2], f'buffer = {{ dir = "{bench.dir}" }}\n' + DISCOVERY))
        until("the buffer's list", lambda: (bench.dir / "mqtt-topics").exists())
        gateway.terminate()
        gateway.wait()
        bench.gateway(bench.configuration(drives[:2], f'buffer = {{ dir = "{bench.dir}" }}\n'))
        until("no entity after switching it off", lambda: not hass.entities())
        say("   ok: a removed drive and discovery switched off take their entities away")
        complaints = hass.ask(do="complaints")
        for complaint in complaints:
            say(f"   {complaint}")
        expect("no warning or error of MQTT in the log", not complaints)
        bench.publish("homeassistant/device/broken/config", "{")
        until("a complaint about a broken message", lambda: hass.ask(do="complaints"))


main()
