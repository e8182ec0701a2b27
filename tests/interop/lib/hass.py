"""Home Assistant from PyPI, run and commanded by a check."""

import json
import subprocess
from pathlib import Path

from bench import end
from programs import python_of, venv

VERSION = "2026.11.0"
# Of the MQTT and Modbus integrations, as their manifests have them; Home Assistant would install them by itself.
REQUIREMENTS = [
    f"homeassistant=={VERSION}", "paho-mqtt==2.1.0", "pymodbus==3.13.1", "modbus-connection[tmodbus]==4.12.7", "tmodbus==1.1.0",
]


def python_of_home_assistant():
    """The Python that has Home Assistant."""
    return venv("home-assistant", REQUIREMENTS, python_of("3.14"), "homeassistant/package_constraints.txt")


class HomeAssistant:
    def __init__(self, bench, integration, entered=None, configuration=""):
        directory = bench.dir / "home-assistant"
        directory.mkdir()
        (directory / "configuration.yaml").write_text("homeassistant:\n  name: interop\n" + configuration)
        inside = Path(__file__).parent / "inside_home_assistant.py"
        log = (bench.dir / "home-assistant.log").open("w")
        self.process = subprocess.Popen(
            [python_of_home_assistant(), inside, directory, integration, json.dumps(entered)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True, start_new_session=True,
        )
        bench.stack.callback(end, self.process)
        self.log = Path(log.name)
        if self.read() != "ready":
            raise SystemExit(f"error: Home Assistant did not start:\n{self.log.read_text()[-4000:]}")

    def read(self):
        line = self.process.stdout.readline()
        return json.loads(line) if line else None

    def ask(self, **command):
        self.process.stdin.write(json.dumps(command) + "\n")
        self.process.stdin.flush()
        return self.read()

    def entities(self):
        return self.ask(do="entities")

    def state(self, name):
        return self.entities().get(name, {}).get("state")

    def call(self, domain, service, **data):
        self.ask(do="call", domain=domain, service=service, data=data)
