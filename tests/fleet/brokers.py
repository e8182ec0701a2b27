"""Brokers that are clusters: three nodes each, on loopback ports, in a directory."""

import os
import pathlib
import signal
import subprocess
import time

from plant import MOSQUITTO, free_ports, listens, processor_seconds, until

NODES = 3


class Node:
    def __init__(self, broker, number, port):
        self.broker, self.number, self.port = broker, number, port
        self.directory = broker.directory / f"node{number}"
        self.directory.mkdir()
        self.process = None

    def start(self):
        self.spawn()
        until(f"{self.broker.name} {self.number}", self.is_up, 60)

    def spawn(self):
        command, environment = self.broker.command(self)
        with open(self.directory / "log", "ab") as log:
            self.process = subprocess.Popen([str(each) for each in command], stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                                            cwd=self.directory, env=os.environ | environment, start_new_session=True)

    def is_up(self):
        """As systemd does it: a node that ends by itself is started again after a second."""
        if self.process.poll() is not None:
            print(f"    {self.broker.name} {self.number} ended by itself", flush=True)
            time.sleep(1)
            self.spawn()
        return listens(self.port)

    def send(self, number):
        os.killpg(self.process.pid, number)

    def end(self, number=signal.SIGKILL):
        self.send(number)
        try:
            self.process.wait(30)
        except subprocess.TimeoutExpired:
            self.send(signal.SIGKILL)
            self.process.wait()


class Broker:
    def __init__(self, directory):
        self.directory = directory
        directory.mkdir()
        self.nodes = [Node(self, number, port) for number, port in enumerate(free_ports(NODES), start=1)]

    def start(self):
        for node in self.nodes:
            node.start()
        self.join()

    def join(self):
        pass

    def processor_seconds(self):
        return sum(processor_seconds(node.process.pid) for node in self.nodes if node.process.poll() is None)

    def resident(self):
        """MiB of each node."""
        found = []
        for node in self.nodes:
            status = pathlib.Path(f"/proc/{node.process.pid}/status").read_text().split("VmRSS:")
            found.append(int(status[1].split()[0]) / 1024)
        return found

    def end(self):
        for node in self.nodes:
            if node.process and node.process.poll() is None:
                node.send(signal.SIGCONT)
                node.end()


class Mosquitto(Broker):
    """One node, for comparison: what a cluster should do as well."""

    name = "mosquitto"

    def __init__(self, directory, _tools):
        super().__init__(directory)
        self.nodes = self.nodes[:1]

    def command(self, node):
        config = node.directory / "conf"
        config.write_text(f"listener {node.port} 127.0.0.1\nallow_anonymous true\npersistence true\n"
                          f"persistence_location {node.directory}/\nmax_queued_messages 100000\nuser root\n")
        return [MOSQUITTO, "-c", config], {}


class Rmqtt(Broker):
    """rmqttd with its plugins for Raft, retained messages and shared subscriptions. Started one after the other: two that look for a
    leader at the same time both become one, and never meet."""

    name = "rmqttd"

    def __init__(self, directory, tools):
        super().__init__(directory)
        self.program = tools / "bin/rmqttd"
        self.rpc, self.raft = free_ports(NODES), free_ports(NODES)

    def command(self, node):
        at = node.number - 1
        plugins = node.directory / "plugins"
        plugins.mkdir(exist_ok=True)
        peers = [", ".join(f'"{n}@127.0.0.1:{port}"' for n, port in enumerate(ports, start=1)) for ports in (self.rpc, self.raft)]
        (plugins / "rmqtt-cluster-raft.toml").write_text(
            f'node_grpc_addrs = [{peers[0]}]\nraft_peer_addrs = [{peers[1]}]\nladdr = "127.0.0.1:{self.raft[at]}"\n'
            'worker_threads = 2\nnode_grpc_client_timeout = "3s"\nraft.heartbeat = "100ms"\n')
        (plugins / "rmqtt-retainer.toml").write_text('storage.type = "ram"\nmax_retained_messages = 0\n')
        (plugins / "rmqtt-acl.toml").write_text('rules = [["allow", "all"]]\n')
        listener = "listener.tcp.external"
        (node.directory / "rmqtt.toml").write_text(f"""node.id = {node.number}
rpc.server_addr = "127.0.0.1:{self.rpc[at]}"
log.to = "console"
log.level = "warn"
plugins.dir = "{plugins}"
plugins.default_startups = ["rmqtt-cluster-raft", "rmqtt-retainer", "rmqtt-shared-subscription"]
{listener}.addr = "127.0.0.1:{node.port}"
{listener}.workers = 2
{listener}.allow_anonymous = true
{listener}.retain_available = true
{listener}.shared_subscription = true
{listener}.max_inflight = 100
{listener}.max_mqueue_len = 100000
""")
        return [self.program, "-f", node.directory / "rmqtt.toml", "--id", node.number], {}


class Ejabberd(Broker):
    """ejabberd of Debian, joined by Mnesia. It wants a user name, and takes any."""

    name = "ejabberd"

    def __init__(self, directory, tools):
        super().__init__(directory)
        self.root = tools / "ejabberd"
        self.epmd = free_ports(1)[0]

    def erl(self, *arguments):
        erlang = self.root / "usr/lib/erlang"
        libraries = self.root / "usr/lib/x86_64-linux-gnu"
        binaries = next(erlang.glob("erts-*/bin"))
        environment = {
            "ROOTDIR": str(erlang), "BINDIR": str(binaries), "EMU": "beam", "PROGNAME": "erl",
            "ERL_LIBS": f"{libraries}:{erlang}/lib", "LD_LIBRARY_PATH": str(libraries),
            "PATH": f"{binaries}:{os.environ['PATH']}",
            "ERL_EPMD_PORT": str(self.epmd), "ERL_EPMD_ADDRESS": "127.0.0.1", "HOME": str(self.directory),
        }
        return [binaries / "erlexec", "-setcookie", "fleet", "-noinput", *arguments], environment

    def name_of(self, node):
        return f"node{node.number}@127.0.0.1"

    def command(self, node):
        (node.directory / "ejabberd.yml").write_text(f"""hosts: ["localhost"]
loglevel: warning
auth_method: [anonymous]
anonymous_protocol: login_anon
listen:
  - port: {node.port}
    ip: "127.0.0.1"
    module: mod_mqtt
    backlog: 1000
modules:
  mod_mqtt:
    max_queue: 100000
""")
        spool = node.directory / "spool"
        command, environment = self.erl("-name", self.name_of(node), "-kernel", "inet_dist_use_interface", "{127,0,0,1}",
                                        "-mnesia", "dir", f'"{spool}"', "-s", "ejabberd")
        environment |= {"EJABBERD_CONFIG_PATH": str(node.directory / "ejabberd.yml"),
                        "EJABBERD_LOG_PATH": str(node.directory / "ejabberd.log"), "SPOOL_DIR": str(spool)}
        return command, environment

    def join(self):
        for node in self.nodes[1:]:
            call = (f"io:format('~p', [rpc:call('{self.name_of(node)}', ejabberd_cluster, join, "
                    f"['{self.name_of(self.nodes[0])}'])]), halt().")
            command, environment = self.erl("-name", "join@127.0.0.1", "-eval", call)
            done = subprocess.run([str(each) for each in command], env=os.environ | environment, capture_output=True, text=True, timeout=60)
            if "ok" not in done.stdout:
                raise SystemExit(f"ejabberd {node.number} does not join: {done.stdout}{done.stderr}")
            until("its return", lambda: listens(node.port), 60)
        time.sleep(2)

    def end(self):
        super().end()
        command, environment = self.erl()
        subprocess.run([str(command[0].parent / "epmd"), "-kill"], env=os.environ | environment, capture_output=True, check=False)


BROKERS = {each.name: each for each in (Mosquitto, Rmqtt, Ejabberd)}
