#!/usr/bin/python
"""Gives a running gateway another configuration, and takes it back if the gateway got worse by it."""

DOCUMENTATION = """
module: gateway
short_description: Gives a running drivegate another configuration, and takes it back if that made it worse
description:
  - Checks the new file with C(drivegate check), exchanges the files, runs C(drivegate reload) and waits for
    C(drivegate health).
  - Compares drives, leases, buses, servers and the broker with what they were before. If something is worse after
    O(patience), or again within O(settle), the former file is put back, and the module fails with what got worse.
  - All this happens on the gateway's machine, so that a controller that loses it leaves no bad file behind. A run that was
    itself cut off is taken back by the next one.
  - Only reads and reloads; it never commands a drive.
options:
  content:
    description: The new configuration. Without it nothing is changed, and the state is returned.
    type: str
  config:
    description: The configuration file of the gateway.
    type: path
    default: /etc/drivegate/drivegate.toml
  binary:
    description: The program.
    type: str
    default: drivegate
  url:
    description:
      - Where the gateway's HTTP server is reached from its own machine. If it is ready there before, it must be so afterwards.
      - The state is read at the local socket that the file names, else here, else at C(/run/drivegate/drivegate.sock).
    type: str
    default: ""
  ca:
    description: PEM file, on the gateway's machine, of the CA of O(url)'s certificate.
    type: path
  token_file:
    description: File with a token for O(url), scopes read and metrics.
    type: path
  before:
    description: The RV(state) to compare with, instead of that before the change.
    type: dict
  accept:
    description: What may get worse, as the module words it; C(*) and C(?) match anything.
    type: list
    elements: str
    default: []
  patience:
    description: Seconds until nothing may be worse.
    type: float
    default: 20
  settle:
    description: Seconds for which nothing may be worse then.
    type: float
    default: 10
  service:
    description: Name of a systemd unit to enable and start if no gateway runs. By default that is an error.
    type: str
    default: ""
  mode:
    description: Permissions of a configuration file that was not there before.
    type: str
    default: "0644"
author: The drivegate contributors
"""

EXAMPLES = """
- name: Another configuration
  drivegate.fleet.gateway:
    content: "{{ drivegate_configuration | drivegate.fleet.to_toml }}"
    url: http://127.0.0.1:9488
    accept: ["drive pump-7 is gone"]
"""

RETURN = """
state:
  description: The state of the gateway at the end.
  type: dict
  returned: if it answers
changes:
  description: What C(drivegate reload) printed.
  type: list
  elements: str
  returned: after a reload
warnings_of_check:
  description: What C(drivegate check) warns of and did not of the former file.
  type: list
  elements: str
  returned: if the file changes
worse:
  description: What got worse.
  type: list
  elements: str
  returned: on failure
is_as_before:
  description: Whether the former state is back.
  type: bool
  returned: if the former file was put back
"""

import contextlib
import json
import os
import signal
import subprocess
import time

from ansible.module_utils.basic import AnsibleModule
from ansible_collections.drivegate.fleet.plugins.module_utils import state as states
from ansible_collections.drivegate.fleet.plugins.module_utils.lock import Busy, alone

# Seconds between two looks, and for one command; a reload waits up to 40 s for its answer.
PACE = 0.5
COMMAND = 60
NOT_RUN = 127


class Bad(Exception):
    """The new configuration is not kept, for these reasons."""

    def __init__(self, reasons):
        super().__init__("; ".join(reasons))
        self.reasons = list(reasons)


def lines(text):
    """The errors that drivegate prints to standard error; all of it if there are none."""
    errors = [line[len("error: ") :] for line in text.splitlines() if line.startswith("error: ")]
    return errors or [line for line in text.splitlines() if line]


class Gateway:
    """The gateway of a configuration file."""

    def __init__(self, parameters):
        self.config = os.path.realpath(parameters["config"])
        self.binary, self.url, self.ca = parameters["binary"], parameters["url"], parameters["ca"]
        self.service = parameters["service"]
        token = None
        if parameters["token_file"]:
            with open(parameters["token_file"], encoding="utf-8") as file:
                token = file.read().strip()
        self.token = token
        self.door = None

    def find(self, source):
        """Where the state is read."""
        named = states.socket_of(source, self.config)
        places = [named if named and os.path.exists(named) else "", self.url, named or states.DEFAULT_SOCKET]
        place = next(place for place in places if place)
        self.door = states.Door(place, self.ca, self.token)

    def command(self, *arguments, program=None):
        command = [program or self.binary, *arguments]
        try:
            done = subprocess.run(
                command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=COMMAND, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return NOT_RUN, "", f"cannot run {command[0]}: {error}"
        return done.returncode, done.stdout, done.stderr

    def check(self, path):
        """What is wrong with a file, and what is doubtful."""
        _, out, err = self.command("check", "--json", "--config", path)
        try:
            report = json.loads(out)
        except ValueError:
            return lines(err) or [f"`{self.binary} check` printed nothing"], {}

        def words(each):
            file = self.config if os.path.basename(each["file"] or "") == os.path.basename(path) else each["file"]
            line = f":{each['line']}" if each.get("line") else ""
            return f"{each['message']}; {file}{line}, {each['key']}"

        # Keys and lines may move without anything being new.
        doubts = {each["message"]: words(each) for each in report["warnings"]}
        return [words(each) for each in report["errors"]], doubts

    def health(self):
        code, _, err = self.command("health", "--config", self.config)
        reasons = lines(err)
        if self.url:
            ca = ["--ca", self.ca] if self.ca else []
            there, _, why = self.command("health", "--url", self.url, *ca)
            reasons += [] if there == 0 else [each for each in lines(why) if each not in reasons]
            code = code or there
        return code == 0, reasons

    def state(self):
        return states.state(self.door, self.health())

    def reload(self):
        code, out, err = self.command("reload", "--config", self.config)
        if code != 0:
            raise Bad(lines(err) or [f"`{self.binary} reload` ended with {code}"])
        return out.splitlines()

    def systemctl(self, *arguments):
        code, _, err = self.command(*arguments, program="systemctl")
        if code != 0:
            raise Bad([f"systemctl {' '.join(arguments)}: {err.strip() or code}"])

    def wait(self, before, accept, patience, settle):
        """The state once nothing is worse, and stays so.

        Raises Bad with what is worse."""
        end, good_since = time.monotonic() + patience, None
        while True:
            try:
                now = self.state()
                worse = states.worse(before or nothing(), now, accept)
            except states.NoAnswer as error:
                worse = [str(error)]
            at = time.monotonic()
            if not worse:
                good_since = at if good_since is None else good_since
                if at - good_since >= settle:
                    return now
            elif at >= end:
                raise Bad(worse)
            else:
                good_since = None
            time.sleep(PACE)


def nothing():
    return {"ready": True, "reasons": [], "drives": {}, "metrics": {}}


def read(path):
    try:
        with open(path, encoding="utf-8") as file:
            return file.read()
    except FileNotFoundError:
        return None


class Files:
    """The configuration file, the new one and the former one beside it. Each exchange is one rename."""

    def __init__(self, config, mode):
        self.config, self.mode = config, mode
        self.new, self.former = config + ".new", config + ".former"

    def write_new(self, content):
        handle = os.open(self.new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(content)
            try:
                like = os.stat(self.config)
                os.fchmod(handle, like.st_mode & 0o7777)
                os.fchown(handle, like.st_uid, like.st_gid)
            except FileNotFoundError:
                os.fchmod(handle, int(self.mode, 8))
            file.flush()
            os.fsync(handle)

    def exchange(self):
        with contextlib.suppress(FileNotFoundError):
            os.link(self.config, self.former)
        os.replace(self.new, self.config)
        self.sync()

    def put_back(self):
        """False if there was none before."""
        if not os.path.exists(self.former):
            os.unlink(self.config)
            return False
        if os.path.samefile(self.former, self.config):
            # Cut off before the exchange; of two names of one file a rename removes none.
            os.unlink(self.former)
        else:
            os.replace(self.former, self.config)
        self.sync()
        return True

    def keep(self):
        with contextlib.suppress(FileNotFoundError):
            os.unlink(self.former)

    def sync(self):
        folder = os.open(os.path.dirname(self.config), os.O_RDONLY | os.O_DIRECTORY)
        os.fsync(folder)
        os.close(folder)


def new_doubts(gateway, files, before):
    """Errors of the new file end it; what it warns of and the former file did not is returned."""
    errors, doubts = gateway.check(files.new)
    if errors:
        raise Bad(errors)
    known = gateway.check(files.config)[1] if before is not None else {}
    fresh = [words for message, words in doubts.items() if message not in known]
    expired = [words for words in fresh if " expired on " in words]
    if expired:
        raise Bad(expired)
    return fresh


def take_back(gateway, files, before, parameters):
    """The former file, and whether the former state is back with it."""
    if not files.put_back():
        if gateway.service:
            gateway.systemctl("stop", gateway.service)
        return False, []
    try:
        gateway.reload()
        gateway.wait(before, parameters["accept"], max(parameters["patience"], 10), 2 * PACE)
    except Bad as still:
        return False, still.reasons
    return True, []


def change(module, gateway, files, result):
    parameters = module.params
    content, source = parameters["content"], read(files.config)
    gateway.find(source or "")
    if os.path.exists(files.former) and not module.check_mode:
        # An earlier run was cut off between exchange and judgement.
        files.put_back()
        result.update(changed=True, changes=["an unfinished rollout was taken back"])
        source = read(files.config)
        gateway.find(source)
        with contextlib.suppress(Bad):
            result["changes"] += gateway.reload()
    if content == source:
        unchanged(gateway, parameters, result)
        return
    files.write_new(content)
    try:
        result["warnings_of_check"] = new_doubts(gateway, files, source)
        result["diff"] = {"before": source or "", "after": content, "before_header": files.config}
        if module.check_mode:
            result["changed"] = True
            return
        exchange(gateway, files, parameters, result)
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(files.new)


def unchanged(gateway, parameters, result):
    try:
        result["state"] = gateway.state()
    except states.NoAnswer as error:
        if not gateway.service:
            raise Bad([f"{error}; start the gateway, or let the role install it"]) from error
        gateway.systemctl("enable", "--now", gateway.service)
        result["changed"] = True
        result["state"] = gateway.wait(None, [], parameters["patience"], 0)
    if parameters["before"]:
        now = (parameters["patience"], parameters["settle"])
        result["state"] = gateway.wait(parameters["before"], parameters["accept"], *now)


def exchange(gateway, files, parameters, result):
    before = parameters["before"]
    try:
        before = before or gateway.state()
    except states.NoAnswer as error:
        if not gateway.service:
            raise Bad([f"{error}; start the gateway, or let the role install it"]) from error
    files.exchange()
    result["changed"] = True
    try:
        if before is None:
            gateway.find(read(files.config))
            gateway.systemctl("enable", "--now", gateway.service)
        else:
            result["changes"] = result.get("changes", []) + gateway.reload()
        result["state"] = gateway.wait(before, parameters["accept"], parameters["patience"], parameters["settle"])
    except Bad as bad:
        is_back, still = take_back(gateway, files, before, parameters)
        result.update(is_as_before=is_back, still_worse=still)
        raise bad
    files.keep()


def sentence(bad, result):
    """The failure in words."""
    words = bad.reasons[0] if len(bad.reasons) == 1 else f"{len(bad.reasons)} reasons: " + "; ".join(bad.reasons)
    if "is_as_before" not in result:
        return f"nothing was changed: {words}"
    if result["is_as_before"]:
        return f"the former configuration is back, and the gateway is as before: {words}"
    still = "; ".join(result["still_worse"]) or "there was no former configuration"
    return f"the former configuration was put back, but the gateway is NOT as before ({still}): {words}"


def main():
    module = AnsibleModule(
        argument_spec={
            "content": {"type": "str"},
            "config": {"type": "path", "default": "/etc/drivegate/drivegate.toml"},
            "binary": {"type": "str", "default": "drivegate"},
            "url": {"type": "str", "default": ""},
            "ca": {"type": "path"},
            "token_file": {"type": "path", "no_log": False},
            "before": {"type": "dict"},
            "accept": {"type": "list", "elements": "str", "default": []},
            "patience": {"type": "float", "default": 20},
            "settle": {"type": "float", "default": 10},
            "service": {"type": "str", "default": ""},
            "mode": {"type": "str", "default": "0644"},
        },
        supports_check_mode=True,
    )
    # The connection of the controller may go; the judgement of the new configuration goes on.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    result = {"changed": False}
    gateway = Gateway(module.params)
    files = Files(gateway.config, module.params["mode"])
    try:
        with alone(gateway.config):
            if module.params["content"] is None:
                gateway.find(read(files.config) or "")
                result["state"] = gateway.state()
            else:
                change(module, gateway, files, result)
    except Busy as busy:
        module.fail_json(msg=str(busy), worse=[str(busy)], **result)
    except Bad as bad:
        module.fail_json(msg=sentence(bad, result), worse=bad.reasons, **result)
    except (states.NoAnswer, OSError) as error:
        module.fail_json(msg=str(error), **result)
    for words in result.get("warnings_of_check", []):
        module.warn(words)
    module.exit_json(**result)


if __name__ == "__main__":
    main()
