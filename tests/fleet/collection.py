"""The parts of the collection in deploy/fleet that need neither Ansible nor a gateway: collection.py [INVENTORY CONFIGURATION]

With arguments: the configuration of the one host of the inventory, written as TOML, is that configuration.
"""

import copy
import json
import pathlib
import sys
import tempfile
import tomllib
import unittest

import yaml

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "deploy/fleet/plugins/module_utils"))
sys.dont_write_bytecode = True

import state  # noqa: E402
from lock import Busy, alone  # noqa: E402
from toml_text import to_toml  # noqa: E402

METRICS = """# HELP drivegate_drive_up The drive is online
drivegate_drive_up{bus="a",drive="p1"} 1
drivegate_bus_up{bus="a"} 1
drivegate_drive_fault{bus="a",drive="p1"} 0
drivegate_drive_unsupervised{bus="a",drive="p1"} 0
drivegate_supervision_actions_total{bus="a",drive="p1"} 3
drivegate_supervision_failed_total{bus="a",drive="p1"} 0
drivegate_listener_up{server="modbus_tcp"} 1
drivegate_mqtt_configured 1
drivegate_mqtt_connected 1
process_open_fds 21
"""


def gateway(metrics=METRICS, reasons=(), **drive):
    own = {"access": "control", "state": "running", "quality": "good", "held": None} | drive
    return {"ready": not reasons, "reasons": list(reasons), "drives": {"p1": own}, "metrics": state.metrics(metrics)}


def without(name):
    return "".join(line + "\n" for line in METRICS.splitlines() if not line.startswith(name))


class Worse(unittest.TestCase):
    def expect(self, after, *words, accept=()):
        self.assertEqual(state.worse(gateway(), after, accept), list(words))

    def test_the_same_is_not_worse(self):
        self.expect(gateway())
        self.assertEqual(len(gateway()["metrics"]), 9)

    def test_drives(self):
        self.expect(gateway(state="ready"), "drive p1 no longer runs")
        self.expect(gateway(access="monitor"), "drive p1 takes no commands any more")
        self.expect(gateway(quality="stale"), "drive p1 is not read")
        self.expect(gateway(held="a restore"), "drive p1 is held: a restore")
        gone = gateway()
        gone["drives"] = {}
        self.expect(gone, "drive p1 is gone")

    def test_what_was_bad_before_may_stay_so(self):
        before = gateway(state="fault", quality="stale", reasons=["bus a is down"])
        self.assertEqual(state.worse(before, gateway(state="offline", quality="bad", reasons=["bus a is down"])), [])

    def test_readiness(self):
        self.expect(gateway(reasons=["bus a is down"]), "not ready: bus a is down")
        unready = gateway()
        unready["ready"] = False
        self.expect(unready, "not ready")

    def test_metrics(self):
        def changed(old, new):
            return gateway(METRICS.replace(old, new))

        self.expect(changed('up{bus="a",drive="p1"} 1', 'up{bus="a",drive="p1"} 0'), "drive p1 is offline")
        self.expect(changed("mqtt_connected 1", "mqtt_connected 0"), "no connection to the broker")
        self.expect(changed("mqtt_configured 1", "mqtt_configured 0"), "[mqtt] is gone")
        self.expect(changed('modbus_tcp"} 1', 'modbus_tcp"} 0'), "server modbus_tcp does not listen")
        self.expect(gateway(without("drivegate_listener_up")), "server modbus_tcp is gone")
        self.expect(gateway(without("drivegate_bus_up")), "bus a is gone")
        self.expect(changed('actions_total{bus="a",drive="p1"} 3', 'actions_total{bus="a",drive="p1"} 4'), "the lease of drive p1 ran out")
        self.expect(changed('unsupervised{bus="a",drive="p1"} 0', 'unsupervised{bus="a",drive="p1"} 1'), "drive p1 runs without a lease")
        self.expect(gateway(without("drivegate_drive_unsupervised")), "drive p1 has no lease any more")
        # Counters begin anew with a bus.
        self.expect(changed('actions_total{bus="a",drive="p1"} 3', 'actions_total{bus="a",drive="p1"} 0'))

    def test_what_is_meant_is_accepted(self):
        after = gateway(METRICS.replace("mqtt_connected 1", "mqtt_connected 0"), state="ready")
        self.expect(after, "no connection to the broker", accept=["drive p1 *"])
        self.expect(after, accept=["drive p? no longer runs", "no connection to the broker"])


class Socket(unittest.TestCase):
    def test_the_socket_of_a_configuration(self):
        for source, place in [
            ('[gateway]\nsocket = "s"\n', "/etc/x/s"),
            ('[gateway]\nsocket = "/run/s"\n', "/run/s"),
            ('[gateway]\nname = "a"\n[[bus]]\nsocket = "s"\n', None),
            ('[gateway]\nsocket = ""\n', None),
            ("not TOML", None),
        ]:
            self.assertEqual(state.socket_of(source, "/etc/x/drivegate.toml", {}), place, source)
        named = {"DRIVEGATE__GATEWAY__SOCKET": "/run/other"}
        self.assertEqual(state.socket_of("", "/etc/x/drivegate.toml", named), "/run/other")

    def test_where_nobody_answers(self):
        for place in ("/nonexistent/socket", "http://127.0.0.1:9"):
            with self.assertRaises(state.NoAnswer):
                state.Door(place).get("/metrics")


class Lock(unittest.TestCase):
    def test_gateways_of_one_folder_do_not_wait_for_each_other(self):
        with tempfile.TemporaryDirectory() as folder:
            one, other = (pathlib.Path(folder) / name for name in ("a.toml", "b.toml"))
            with alone(one), alone(other), self.assertRaises(Busy) as refused, alone(one):
                self.fail("two rollouts of one file")
            self.assertIn(f"at work on {one};", str(refused.exception))
            with alone(one):
                # The file is exchanged meanwhile.
                one.write_text("")
                (pathlib.Path(folder) / "new").write_text("")
                (pathlib.Path(folder) / "new").replace(one)
                with self.assertRaises(Busy), alone(one):
                    self.fail("two rollouts of one file")


class Toml(unittest.TestCase):
    def test_what_is_written_is_read_back(self):
        mapping = {
            "a": {"x": 1, "t": {"deep": {"y": 0.5}}, "z": True, "list": [[1, 2], ["q"]], "mixed": [{"k": 1}, 2], "none": []},
            "b": [{"name": 'quote " back \\ slash', "c": [{"d": 1e30}, {"d": "ü\n\t\x7f"}]}, {}],
            "odd key.": {"": 1},
            "top": "last",
        }
        self.assertEqual(tomllib.loads(to_toml(mapping)), mapping)

    def test_shipped_configurations_are_read_back(self):
        for path in [ROOT / "deploy/drivegate.toml", *sorted((ROOT / "deploy/compose").glob("*/*.toml"))]:
            mapping = tomllib.loads(path.read_text())
            self.assertEqual(tomllib.loads(to_toml(copy.deepcopy(mapping))), mapping, path)

    def test_what_toml_lacks_is_refused_with_its_place(self):
        for mapping, place in [({"bus": [{"port": None}]}, "bus.port"), ({"q": [0, {"bus": [{"port": None}]}]}, "q[1].bus[0].port")]:
            with self.assertRaises(ValueError) as refused:
                to_toml(mapping)
            self.assertIn(f"at {place};", str(refused.exception))


class Files(unittest.TestCase):
    def test_every_file_is_yaml(self):
        found = [path for path in (ROOT / "deploy/fleet").rglob("*.yml") if "collections" not in path.parts]
        self.assertGreater(len(found), 10)
        for path in found:
            yaml.safe_load(path.read_text())

    def test_the_playbook_finds_the_collection(self):
        place = ROOT / "deploy/fleet/playbooks/collections/ansible_collections/drivegate/fleet"
        for name in ("plugins", "roles", "meta", "galaxy.yml"):
            self.assertTrue((place / name).samefile(ROOT / "deploy/fleet" / name), name)


def same(inventory, configuration):
    hosts = yaml.safe_load(pathlib.Path(inventory).read_text())["drivegate"]["hosts"]
    (host,) = hosts.values()
    written = tomllib.loads(to_toml(host["drivegate_configuration"]))
    if written != tomllib.loads(pathlib.Path(configuration).read_text()):
        sys.exit(f"not the same: {json.dumps(written)}")


if __name__ == "__main__":
    if len(sys.argv) == 3:
        same(*sys.argv[1:])
    else:
        unittest.main()
