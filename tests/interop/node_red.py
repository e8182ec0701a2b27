"""Node-RED from npm with the flow of docs/integrations.md: it keeps states and starts a motor."""

import json
import subprocess
import urllib.request

from bench import ROOT, Bench, expect, free_port, npm, until

PACKAGES = ["node-red@4.1"]


def flow(port):
    """The flow of the page, with the port of this broker."""
    page = (ROOT / "docs" / "integrations.md").read_text()
    nodes = json.loads(page.split("```json\n")[1].split("\n```")[0])
    for node in nodes:
        if node["type"] == "mqtt-broker":
            node["port"] = str(port)
    return json.dumps(nodes)


def main():
    place = npm("node-red", PACKAGES)
    with Bench() as bench:
        bench.broker()
        bench.line(1)
        bench.gateway(bench.configuration(["p1"]))
        user = bench.dir / "node-red"
        user.mkdir()
        (user / "flows.json").write_text(flow(bench.mqtt))
        (user / "settings.js").write_text("module.exports = { flowFile: 'flows.json', uiHost: '127.0.0.1' };")
        port = free_port()
        log = (bench.dir / "node-red.log").open("w")
        red = place / "node_modules" / "node-red" / "red.js"
        bench.start(["node", red, "--userDir", user, "--port", str(port)], stdout=log, stderr=subprocess.STDOUT)

        def context(key):
            """What the flow has kept under `key`."""
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/context/flow/drives/{key}", timeout=5) as answer:
                    kept = json.load(answer).get("msg")
            except OSError:
                return None
            return json.loads(kept) if kept and kept != "(undefined)" else None

        state, _ = until("the state", lambda: context("p1"))
        expect("Node-RED has the state of p1", state["quality"] == "good" and state["running"] is False)
        press = urllib.request.Request(f"http://127.0.0.1:{port}/inject/start", method="POST")
        urllib.request.urlopen(press, timeout=5).close()
        result, _ = until("the result", lambda: context("result"))
        expect(f"the command was {result['result']}", result["ok"])
        _, took = until("the motor", lambda: context("p1")["running"])
        expect(f"the motor runs, {took:.2f} s after the result", True)


main()
