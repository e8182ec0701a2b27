"""Home Assistant from PyPI with its Modbus integration: it reads the common model and raw registers, and runs a drive."""

import time

from bench import Bench, end, expect, free_port, say, until
from hass import HomeAssistant

RUNNING, READY = 3, 2
MODBUS_TCP = '[modbus_tcp]\nlisten = ["127.0.0.1:{port}"]\nwrite = ["127.0.0.1/32"]\n'
HUB = """
modbus:
  - name: hall
    type: tcp
    host: 127.0.0.1
    port: {port}
    sensors:
{sensors}
    switches:
{switches}
"""
# Home Assistant warns of shorter ones.
SCAN = "scan_interval: 5"
SENSORS = [
    "name: p1 state, unique_id: p1_state, slave: 1, address: 0x8001, input_type: input, data_type: uint16",
    "name: p1 speed, unique_id: p1_speed, slave: 1, address: 0x8004, scale: 0.01, precision: 2, nan_value: 0x8000",
    "name: p1 float, unique_id: p1_float, slave: 1, address: 0x8200, data_type: float32, precision: 2",
    "name: p1 word, unique_id: p1_word, slave: 1, address: 2100, data_type: uint16",
    "name: p1 energy, unique_id: p1_energy, slave: 1, address: 0x800D, data_type: uint32, nan_value: 0xFFFFFFFF",
    "name: online, unique_id: online, slave: 255, address: 2, input_type: input, data_type: uint16",
]
# The switch of docs/home-assistant.md. State 0, offline, is neither on nor off: such a motor may run.
SWITCH = (
    "name: p{n} run, unique_id: p{n}_run, slave: {n}, address: 0x8100, "
    "verify: {{address: 0x8001, input_type: input, state_on: [3], state_off: [1, 2, 4]}}"
)


def hub(port):
    entities = lambda texts: "\n".join(f"      - {{{text}, {SCAN}}}" for text in texts)
    return HUB.format(port=port, sensors=entities(SENSORS), switches=entities(SWITCH.format(n=n) for n in (1, 2)))


def main():
    with Bench() as bench:
        line = bench.line(2)
        port = free_port()
        configuration = bench.configuration(["p1", "p2"], MODBUS_TCP.format(port=port), ["p2"])
        gateway = bench.gateway(configuration)
        hass = HomeAssistant(bench, "modbus", configuration=hub(port))
        running = lambda drive: bench.point(drive, "running")
        number = lambda name: float(hass.state(f"sensor.{name}"))
        write = lambda address, value: hass.call("modbus", "write_register", hub="hall", unit=1, address=address, value=value)

        until("the state", lambda: hass.state("sensor.p1_state") == str(READY))
        expect("Home Assistant reads 2 drives online", until("the gateway's unit", lambda: hass.state("sensor.online") == "2")[0])
        until("the switches", lambda: hass.state("switch.p1_run") == hass.state("switch.p2_run") == "off")
        expect("energy, which the family lacks, has no value", hass.state("sensor.p1_energy") in ("unknown", "unavailable"))
        expect("no warning or error of Modbus in the log", not hass.ask(do="complaints"))

        write(0x8101, 4000)
        expect("the drive has the reference 40 %", until("the reference", lambda: bench.point("p1", "speed_reference") == 40.0)[0])
        hass.call("switch", "turn_on", entity_id="switch.p1_run")
        _, took = until("the motor", lambda: running("p1"))
        say(f"   ok: switch on, the motor runs {took:.2f} s after the service")
        until("the switch", lambda: hass.state("switch.p1_run") == "on")
        until("the speed", lambda: number("p1_speed") > 39 and number("p1_float") > 39)
        expect("raw status word, state and speed fit the drive", int(number("p1_word")) & 2 and number("p1_state") == RUNNING)

        write(0x8101, 9000)
        time.sleep(0.5)
        expect("90 % is outside the limits: refused", bench.point("p1", "speed_reference") == 40.0)
        expect("Home Assistant logs it", any("hall" in text for text in hass.ask(do="complaints")))
        hass.call("switch", "turn_on", entity_id="switch.p2_run")
        time.sleep(0.5)
        expect("p2 is monitored: refused", not running("p2") and hass.state("switch.p2_run") in ("off", "unavailable"))

        gateway.kill()
        gateway.wait()
        _, took = until("unavailable", lambda: hass.state("sensor.p1_speed") == hass.state("switch.p1_run") == "unavailable")
        say(f"   ok: gateway killed, unavailable after {took:.1f} s")
        gateway = bench.gateway(configuration)
        expect("the motor ran on", running("p1"))
        _, took = until("the values", lambda: hass.state("switch.p1_run") == "on" and number("p1_speed") > 39)
        say(f"   ok: gateway restarted, values and switch are back after {took:.1f} s")
        hass.call("switch", "turn_off", entity_id="switch.p1_run")
        _, took = until("the stop", lambda: not running("p1"))
        say(f"   ok: switch off, the motor stands {took:.1f} s after the service, by its ramp")
        until("the switch", lambda: hass.state("switch.p1_run") == "off")
        write(0x8100, [1, 2500])
        until("the motor", lambda: running("p1") and bench.point("p1", "speed_reference") == 25.0)
        say("   ok: one write of two registers: the motor runs at 25 %")
        until("the switch", lambda: hass.state("switch.p1_run") == "on")
        end(line)
        until("the drive offline", lambda: hass.state("sensor.p1_state") == "0" and hass.state("sensor.p1_speed") == "unknown")
        until("the switch's reading", lambda: any("Unexpected response" in text for text in hass.ask(do="complaints")))
        expect("a drive that is offline has no speed, and its switch does not say off", hass.state("switch.p1_run") != "off")


main()
