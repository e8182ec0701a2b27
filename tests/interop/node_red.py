"""Node-RED from npm with the flow of docs/integrations.md: it keeps states, starts a motor, and finds the gateway again."""

import json

from bench import ROOT, Bench, expect, say, until
from red import NodeRed


def flow(port):
    """The flow of the page, with the port of this broker."""
    page = (ROOT / "docs" / "integrations.md").read_text()
    nodes = json.loads(page.split("```json\n")[1].split("\n```")[0])
    for node in nodes:
        if node["type"] == "mqtt-broker":
            node["port"] = str(port)
    return nodes


def main():
    with Bench() as bench:
        bench.broker()
        bench.line(1)
        configuration = bench.configuration(["p1"])
        gateway = bench.gateway(configuration)
        red = NodeRed(bench, flow(bench.mqtt))
        state, _ = until("the state", lambda: red.kept("drives", "p1"))
        expect("Node-RED has the state of p1", state["quality"] == "good" and state["running"] is False)

        gateway.kill()
        gateway.wait()
        before = red.kept("drives", "p1")["time"]
        bench.gateway(configuration)
        until("a newer state", lambda: red.kept("drives", "p1")["time"] > before and red.kept("drives", "p1")["quality"] == "good")
        say("   ok: gateway killed and restarted, the state is new and good")

        red.press("start")
        result, _ = until("the result", lambda: red.kept("drives", "result"))
        expect(f"the command was {result['result']}", result["ok"])
        _, took = until("the motor", lambda: red.kept("drives", "p1")["running"])
        expect(f"the motor runs, {took:.2f} s after the result", bench.point("p1", "running"))
        expect("the drive has the reference 30 %", bench.point("p1", "speed_reference") == 30.0)


main()
