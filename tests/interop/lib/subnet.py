"""A subnet with two hosts on one machine, for programs that share a port and talk by broadcast: namespaces of the network, which
need root or user namespaces, and go with the processes in them."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from bench import fail, until

HERE, NEIGHBOUR = "198.51.100.1", "198.51.100.2"
ENTERED = "INTEROP_SUBNET"
JOIN = f"ip link set lo up && ip address add {NEIGHBOUR}/24 dev second && ip link set second up && ip route add default dev second"


def enter():
    """Runs this program again in a namespace of its own, as the host HERE."""
    if ENTERED not in os.environ:
        for program in ("unshare", "ip"):
            if not shutil.which(program):
                fail(f"there is no `{program}`; run: apt-get install util-linux iproute2")
        user = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
        os.execvpe("unshare", ["unshare", *user, "--net", sys.executable, *sys.argv], {**os.environ, ENTERED: "1"})
    ip("link", "set", "lo", "up")


def lay():
    """Lays the line between the two hosts. One of an earlier check goes with its neighbour, but not at once."""
    subprocess.run(["ip", "link", "delete", "first"], stderr=subprocess.DEVNULL)
    ip("link", "add", "first", "type", "veth", "peer", "name", "second")
    ip("address", "add", f"{HERE}/24", "dev", "first")
    ip("link", "set", "first", "up")


def ip(*arguments):
    subprocess.run(["ip", *arguments], check=True)


def start_at_neighbour(bench):
    """What starts a program at the host NEIGHBOUR, at the other end of the line."""

    def start(command, **more):
        wait = f'until ip link show second >/dev/null 2>&1; do sleep 0.05; done; {JOIN} && exec "$@"'
        process = bench.start(["unshare", "--net", "sh", "-c", wait, "sh", *command], **more)
        network = lambda pid: Path(f"/proc/{pid}/ns/net").readlink()
        until("the namespace", lambda: network(process.pid) != network("self"))
        ip("link", "set", "second", "netns", str(process.pid))
        return process

    return start
