#!/usr/bin/env python3
"""Rolls out good and bad configurations to GATEWAYS gateways whose motors run, with the collection of deploy/fleet.

Of each bad change: the rollout fails, only the first gateway was touched, its former state is back, no motor stopped, no drive was
written to, and its other bus lost no cycle. `--part` names what runs; ends with 1 at the first thing that is not so.
"""

import argparse
import collections
import grp
import json
import os
import pathlib
import shutil
import signal
import statistics
import subprocess
import sys
import time

import changes
from plant import CYCLE, ROOT, Plant, attempt, to_toml, until

PLAYBOOKS = ROOT / "deploy/fleet/playbooks"


class Wrong(Exception):
    """What is not as it should be."""


def expect(is_so, words):
    if not is_so:
        raise Wrong(words)


class Controller:
    """Where Ansible runs."""

    def __init__(self, plant, tools):
        self.plant, self.tools = plant, tools
        self.inventory = plant.directory / "inventory.yml"
        self.output = ""

    def environment(self):
        return os.environ | {
            "ANSIBLE_FORKS": "4",
            "ANSIBLE_NOCOLOR": "1",
            "ANSIBLE_LOCAL_TEMP": str(self.plant.directory / "ansible"),
            "ANSIBLE_REMOTE_TEMP": str(self.plant.directory / "ansible"),
            "ANSIBLE_RETRY_FILES_ENABLED": "0",
            "PYTHONDONTWRITEBYTECODE": "1",
        }

    def write(self, configurations):
        hosts = {g.name: g.variables(configurations[g.name]) for g in self.plant.gateways}
        # JSON is YAML.
        self.inventory.write_text(json.dumps({"drivegate": {"hosts": hosts}}))

    def begin(self, playbook, *arguments):
        command = [self.tools / "ansible-playbook", "-i", self.inventory, PLAYBOOKS / playbook, *arguments]
        return subprocess.Popen([str(each) for each in command], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True,
                                stderr=subprocess.STDOUT, env=self.environment(), start_new_session=True)

    def run(self, playbook, *arguments):
        process = self.begin(playbook, *arguments)
        self.output = process.communicate()[0]
        return process.returncode

    def roll_out(self, configurations, *arguments):
        self.write(configurations)
        return self.run("rollout.yml", *arguments)

    def recap(self):
        """Of each host that took part: changed and failed tasks."""
        found = {}
        for line in self.output.partition("PLAY RECAP")[2].splitlines()[1:]:
            host, _, counts = line.partition(":")
            counts = dict(each.split("=") for each in counts.split())
            if counts:
                found[host.strip()] = {name: int(value) for name, value in counts.items()}
        return found


def look(gateway):
    """What must not change by a rollout that fails."""
    buses = gateway.buses()
    return {
        "file": gateway.config.read_text(),
        "files": sorted(each.name for each in gateway.directory.iterdir() if each.name != "wrong-password"),
        "starts": gateway.metric("drivegate_drive_starts_total"),
        "reload": gateway.metric("drivegate_config_last_reload_timestamp_seconds"),
        "opened": buses["b"]["opened"],
        "rounds": buses["b"]["fast"]["rounds"],
        "at": time.monotonic(),
    }


def judge(gateway, before, is_touched):
    """Compares with an earlier look; the share of the cycles of bus `b` that came."""
    until(f"{gateway.name} whole again", lambda: gateway.plant.is_whole(gateway), 15)
    # A value may be late on a busy machine; a motor that stood and was started again is counted.
    until(f"{gateway.name} all motors running", lambda: gateway.plant.running(gateway), 15)
    after = look(gateway)
    for key in ("file", "files", "starts", "opened") + (() if is_touched else ("reload",)):
        expect(before[key] == after[key], f"{gateway.name}: {key} was {before[key]} and is {after[key]}")
    expect(gateway.metric("drivegate_config_last_reload_successful") == 1, f"{gateway.name}: the last reload was refused")
    for name in ("drivegate_supervision_actions_total", "drivegate_supervision_failed_total"):
        expect(gateway.metric(name) == 0, f"{gateway.name}: {name}")
    due = (after["at"] - before["at"]) / CYCLE
    return (after["rounds"] - before["rounds"]) / due


def base(plant):
    return {g.name: g.configuration() for g in plant.gateways}


def good(plant):
    """A change that every gateway keeps: bus `a` is started again by it, bus `b` is not."""
    found = base(plant)
    for configuration in found.values():
        configuration["bus"][0]["slow_cycle"] = "3s"
        configuration["mqtt"]["publish"] = {"min_interval": "100ms"}
    return found


def spoiled(plant, spoil, names=None):
    found = base(plant)
    for gateway in plant.gateways:
        if names is None or gateway.name in names:
            spoil(found[gateway.name], gateway)
    return found


def writes(plant):
    return len(plant.writes.read_text().splitlines())


def bad_changes(plant, controller, cases):
    """Each is given to all gateways at once."""
    canary, *others = plant.gateways
    shares = []
    for number, (name, spoil) in enumerate(cases.items(), start=1):
        began = time.monotonic()
        before, written = {g.name: look(g) for g in plant.gateways}, writes(plant)
        code = controller.roll_out(spoiled(plant, spoil))
        try:
            expect(code != 0, "the rollout did not fail")
            recap = controller.recap()
            expect(list(recap) == [canary.name] and recap[canary.name]["failed"] == 1, f"hosts that took part: {recap}")
            is_tried = name in changes.WORSE
            words = "is as before" if is_tried else "nothing was changed"
            expect(words in controller.output, f"`{words}` is not said")
            found = [judge(g, before[g.name], g is canary and is_tried) for g in plant.gateways]
            found = found[1:] if name in changes.BOTH_BUSES else found
            # What all lack is the machine's.
            usual = min(statistics.median(found or [1.0]), 1.0)
            expect(min(found, default=1) > 0.9 * usual, f"cycles of an untouched bus: {min(found):.3f} of those that were due, usual {usual:.3f}")
            shares += found
            expect(writes(plant) == written, "a drive was written to")
        except (Wrong, SystemExit) as wrong:
            raise Wrong(f"{name}: {wrong}\n{controller.output}") from wrong
        said = [line for line in controller.output.splitlines() if '"msg"' in line]
        reason = json.loads(said[0][said[0].index("{"):])["msg"] if said else ""
        print(f"{number:2} {name}: {time.monotonic() - began:.1f} s; {reason[:150]}", flush=True)
    print(f"{len(cases)} bad changes, {len(plant.gateways)} gateways: cycles of the untouched bus {100 * min(shares):.1f} % at least, "
          f"{100 * sum(shares) / len(shares):.2f} % on average; drives written to: 0; motors stopped: 0", flush=True)


def good_change(plant, controller):
    before, written = {g.name: look(g) for g in plant.gateways}, writes(plant)
    began = time.monotonic()
    code = controller.roll_out(good(plant))
    expect(code == 0, controller.output)
    took = time.monotonic() - began
    recap = controller.recap()
    expect(all(each["changed"] == 1 for each in recap.values()) and len(recap) == len(plant.gateways), recap)
    plays = controller.output.count("PLAY [")
    for gateway in plant.gateways:
        wanted = to_toml(good(plant)[gateway.name])
        expect(gateway.config.read_text() == wanted, f"{gateway.name} has another file")
        judge(gateway, before[gateway.name] | {"file": wanted}, True)
    expect(writes(plant) == written, "a drive was written to")
    print(f"good change: {len(recap)} gateways in {plays} waves, {took:.1f} s", flush=True)
    began = time.monotonic()
    code = controller.roll_out(good(plant))
    expect(code == 0 and all(each["changed"] == 0 for each in controller.recap().values()), controller.output)
    print(f"the same once more: nothing changed, {time.monotonic() - began:.1f} s", flush=True)
    expect(controller.roll_out(base(plant)) == 0, controller.output)


def second_wave(plant, controller):
    """Bad for one gateway of the second wave: the first wave keeps it, the others of the second too, the third is not reached."""
    first, bad, beside, *rest = plant.gateways
    waves = ["-e", json.dumps({"drivegate_waves": [1, 2, "100%"]})]
    before, written = {g.name: look(g) for g in plant.gateways}, writes(plant)
    configurations = good(plant)
    changes.WORSE["baud 9600"](configurations[bad.name], bad)
    code = controller.roll_out(configurations, *waves)
    expect(code != 0, controller.output)
    expect(sorted(controller.recap()) == [first.name, bad.name, beside.name], controller.output)
    for gateway in (first, beside):
        judge(gateway, before[gateway.name] | {"file": to_toml(configurations[gateway.name])}, True)
    judge(bad, before[bad.name], True)
    for gateway in rest:
        judge(gateway, before[gateway.name], False)
    expect(writes(plant) == written, "a drive was written to")
    print("bad in the second wave: taken back there, the third is not reached", flush=True)
    expect(controller.roll_out(base(plant)) == 0, controller.output)


def meant(plant, controller):
    """What is meant to get worse is accepted; check mode changes nothing."""
    canary = plant.gateways[0]
    configurations = spoiled(plant, changes.WORSE["drive renamed"], [canary.name])
    limit = ["--limit", canary.name]
    before = look(canary)
    expect(controller.roll_out(configurations, *limit, "--check", "--diff") == 0, controller.output)
    expect('+name = "pump"' in controller.output, controller.output)
    judge(canary, before, False)
    accept = ["-e", json.dumps({"drivegate_accept": ["drive a1 is gone"]})]
    expect(controller.roll_out(configurations, *limit, *accept) == 0, controller.output)
    expect("pump" in canary.drive_states(), "the drive has no new name")
    back = ["-e", json.dumps({"drivegate_accept": ["drive pump is gone"]})]
    expect(controller.roll_out(base(plant), *limit, *back) == 0, controller.output)
    print("a change that is meant is accepted; check mode changes nothing", flush=True)


def cut_off(plant, controller):
    """The rollout is killed, its module too, while the new file is judged; the next one takes it back."""
    canary = plant.gateways[0]
    before = look(canary)
    controller.write(spoiled(plant, changes.WORSE["baud 9600"], [canary.name]))
    process = controller.begin("rollout.yml", "--limit", canary.name)
    former = pathlib.Path(f"{canary.config}.former")
    until("the exchange", former.exists)
    time.sleep(1)
    session = subprocess.run(["ps", "-eo", "pid=,args="], capture_output=True, text=True, check=True).stdout
    mine = [int(line.split()[0]) for line in session.splitlines() if str(plant.directory / "ansible") in line]
    for pid in mine:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    expect(former.exists(), "the module went on")
    expect(controller.roll_out(base(plant), "--limit", canary.name) == 0, controller.output)
    judge(canary, before, True)
    print("a rollout that was killed is taken back by the next", flush=True)


def secrets(plant, controller):
    """A password from Ansible Vault lets a gateway log in."""
    canary = plant.gateways[0]
    key = plant.directory / "vault-password"
    key.write_text("of the vault")
    hidden = subprocess.run([controller.tools / "ansible-vault", "encrypt_string", "--vault-password-file", key, "secret"],
                            check=True, capture_output=True, text=True, env=controller.environment()).stdout
    folder = canary.directory / "secrets"
    variables = plant.directory / "secrets.yml"
    text = hidden.partition("|")[2].replace("\n          ", "\n      ")
    variables.write_text(f"drivegate_secrets_dir: {folder}\ndrivegate_secrets:\n  mqtt: !vault |{text}\n")
    configurations = base(plant)
    configurations[canary.name]["mqtt"] = {
        "url": f"mqtt://localhost:{plant.broker_plain}", "username": "fleet", "password_file": "secrets/mqtt", "topics": ["state"],
    }
    options = ["--limit", canary.name, "-e", f"@{variables}", "--vault-password-file", key]
    expect(controller.roll_out(configurations, *options) == 0, controller.output)
    expect("secret\"" not in controller.output, "the password is in the output")
    mode = (folder / "mqtt").stat().st_mode & 0o777
    expect(mode == 0o600 and (folder / "mqtt").read_text() == "secret", f"the file has mode {mode:o}")
    expect(plant.is_whole(canary), "the gateway does not log in")
    expect(controller.roll_out(base(plant), "--limit", canary.name) == 0, controller.output)
    shutil.rmtree(folder)
    print("a password of Ansible Vault: used, mode 0600, not shown", flush=True)


def certificates(plant, controller, days=90):
    controller.write(base(plant))
    extra = {"drivegate_authority": str(plant.directory / "authority"), "drivegate_certificate_days": days,
             "drivegate_certificate_names": ["DNS:localhost", "IP:127.0.0.1"],
             "drivegate_certificate_key_group": grp.getgrgid(os.getgid()).gr_name,
             "drivegate_reload_after_certificate": plant.gateways[0].process is not None}
    return controller.run("certificates.yml", "-e", json.dumps(extra))


def renewal(plant, controller):
    """A certificate that ends in less than 30 days is renewed, one that does not is left."""
    canary = plant.gateways[0]
    at = lambda: (canary.directory / "gateway.crt").read_text()
    first = at()
    expect(certificates(plant, controller) == 0 and at() == first, controller.output)
    canary_only = plant.directory / "authority/authority.crt"
    shutil.copy(canary_only, plant.directory / "was.crt")
    before = look(canary)
    os.unlink(canary.directory / "gateway.crt")
    expect(certificates(plant, controller, 20) == 0 and at() != first, controller.output)
    short = at()
    expect(certificates(plant, controller) == 0 and at() != short, controller.output)
    judge(canary, before, True)
    health = [plant.binary, "health", "--url", f"https://localhost:{canary.http}", "--ca", canary.directory / "authority.crt"]
    expect(subprocess.run(health, check=False, capture_output=True).returncode == 0, "the gateway does not use it")
    print("a certificate is renewed before it ends, and used after a reload", flush=True)


def pull(plant, controller):
    """A box that fetches its configuration takes commits that are signed, and no others."""
    canary, tools = plant.gateways[0], controller.tools
    home, origin, copy_of = (plant.directory / name for name in ("home", "origin", "fetched"))
    home.mkdir()
    key = home / "key"
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", key], check=True)
    (home / "signers").write_text("fleet@example.com " + key.with_suffix(".pub").read_text())
    environment = controller.environment() | {
        "HOME": str(home), "PATH": f"{tools}:{os.environ['PATH']}", "ANSIBLE_COLLECTIONS_PATH": str(plant.directory / "collections"),
        "ANSIBLE_HOME": str(home / "ansible"),
    }

    def run(*command, is_well=True):
        done = subprocess.run([str(each) for each in command], env=environment, capture_output=True, text=True, check=False)
        expect((done.returncode == 0) == is_well, f"{command}: {done.stdout}{done.stderr}")
        return done.stdout + done.stderr

    for name, value in {"user.name": "fleet", "user.email": "fleet@example.com", "gpg.format": "ssh", "user.signingkey": key,
                        "gpg.ssh.allowedSignersFile": home / "signers", "init.defaultBranch": "main"}.items():
        run("git", "config", "--global", name, value)
    run(tools / "ansible-galaxy", "collection", "build", ROOT / "deploy/fleet", "--output-path", home)
    archive = next(home.glob("*.tar.gz"))
    run(tools / "ansible-galaxy", "collection", "install", archive, "-p", plant.directory / "collections", "--offline")
    run("git", "init", "-q", origin)
    (origin / "local.yml").write_text("- import_playbook: drivegate.fleet.local\n")

    def commit(configuration, signed):
        hosts = {canary.name: canary.variables(configuration)}
        (origin / "inventory.yml").write_text(json.dumps({"drivegate": {"hosts": hosts}}))
        run("git", "-C", origin, "add", "-A")
        run("git", "-C", origin, "commit", "-q", "-m", "Change", *(["-S"] if signed else ["--no-gpg-sign"]))

    def fetch(is_well):
        return run(tools / "ansible-pull", "--verify-commit", "--url", origin, "--checkout", "main", "--directory", copy_of,
                   "--inventory", "inventory.yml", "--limit", canary.name, "local.yml", is_well=is_well)

    before, wanted = look(canary), good(plant)[canary.name]
    commit(wanted, signed=True)
    fetch(True)
    judge(canary, before | {"file": to_toml(wanted)}, True)
    before = look(canary)
    commit(canary.configuration(), signed=False)
    # The second time the commit is there already.
    expect(all("verify" in fetch(False) for _ in range(2)), "the reason is another")
    judge(canary, before, False)
    commit(spoiled(plant, changes.WORSE["baud 9600"])[canary.name], signed=True)
    expect("is as before" in fetch(False), "the bad change was not taken back")
    judge(canary, before, True)
    commit(canary.configuration(), signed=True)
    fetch(True)
    print("a box that fetches: signed commits are applied, others not, bad ones are taken back", flush=True)


PARTS = {"good": good_change, "second-wave": second_wave, "meant": meant, "cut-off": cut_off, "secrets": secrets, "renewal": renewal,
         "pull": pull}


def tried(plant, options, cases):
    try:
        controller = Controller(plant, pathlib.Path(options.tools).resolve())
        expect(certificates(plant, controller) == 0, controller.output)
        plant.simulate()
        plant.run_gateways()
        plant.run_motors()
        for name, part in PARTS.items():
            if not options.part or name in options.part:
                part(plant, controller)
        if not options.part or "bad" in options.part:
            bad_changes(plant, controller, cases)
        counts = collections.Counter(process.poll() for process in plant.processes)
        expect(list(counts) == [None], f"processes that ended: {counts}")
    except Wrong as wrong:
        print(f"rollout: {wrong}")
        return False
    return True


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--gateways", type=int, default=20)
    parser.add_argument("--binary", default=ROOT / "target/release/drivegate")
    parser.add_argument("--tools", default=ROOT / ".tools/ansible/bin", help="directory of ansible-playbook")
    parser.add_argument("--part", action="append", default=[], help=f"bad, {', '.join(PARTS)}; without it all")
    parser.add_argument("--change", action="append", default=[], help="a bad change by name; without it all")
    options = parser.parse_args()
    binary = pathlib.Path(options.binary).resolve()
    if not binary.is_file():
        sys.exit(f"rollout: no program at {binary}; `make build` builds it")
    cases = {name: spoil for name, spoil in (changes.INVALID | changes.WORSE).items() if not options.change or name in options.change}
    attempt("rollout", options, lambda directory, _: Plant(directory, binary, options.gateways),
            lambda plant: tried(plant, options, cases))


if __name__ == "__main__":
    main()
