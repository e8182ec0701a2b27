#!/usr/bin/env python3
"""Metrics of TARGETS gateways: one Prometheus reads them all, with the shipped rules, and passes what the rules record to VictoriaMetrics.

Four gateways with ten simulated drives run; their pages, as they are at that moment, are served as those of TARGETS gateways, each with its
own name. One of the four lacks six drives and its broker: ten of the targets show its page, and three more do not answer. Prints series,
memory, processor time, bytes on disk and the time of each query of the dashboards. Ends with 1 if a page was not read, a round of the rules
was missed, or the overview does not show those ten first.
"""

import argparse
import asyncio
import collections
import json
import os
import pathlib
import resource
import shutil
import threading
import time
import urllib.request

from plant import MOSQUITTO, PROMETHEUS, ROOT, Processes, ask, attempt, free_ports, listens, memory, processor_seconds, query_api, to_toml, until

REAL, BAD, ABSENT = 4, 10, 3
LACKING = 6
RULES = ROOT / "deploy/compose/prometheus"
DASHBOARDS = ROOT / "deploy/compose/grafana/dashboards"
VICTORIA = shutil.which("victoria-metrics") or ROOT / ".tools/victoria-metrics/usr/bin/victoria-metrics"
# What one row of a table or graph may have: nobody reads a thousand.
MOST_SERIES = 100


def name_of(number):
    return f"site-{number:04}"


class Pages:
    """Serves the page of target n at /n."""

    def __init__(self, sockets, targets):
        self.sockets, self.targets = sockets, targets
        self.port = free_ports(1)[0]
        self.pages, self.end = [], threading.Event()
        self.fetch()
        threading.Thread(target=self.refresh, daemon=True).start()
        threading.Thread(target=lambda: asyncio.run(self.serve()), daemon=True).start()
        until("the pages", lambda: listens(self.port))

    def fetch(self):
        self.pages = [ask(each, "/metrics")[1].encode() for each in self.sockets]

    def refresh(self):
        while not self.end.wait(3):
            self.fetch()

    def page(self, number):
        """The last gateway is the bad one: the first BAD targets have its page; those at the end have none."""
        if number >= self.targets - ABSENT:
            return None
        of = REAL - 1 if number < BAD else number % (REAL - 1)
        return self.pages[of].replace(f'"{name_of(of)}"'.encode(), f'"{name_of(number)}"'.encode())

    async def answer(self, reader, writer):
        try:
            while True:
                head = await reader.readuntil(b"\r\n\r\n")
                page = self.page(int(head.split()[1].strip(b"/")))
                if page is None:
                    break
                kind = b"text/plain; version=0.0.4"
                writer.write(b"HTTP/1.1 200 OK\r\nContent-Type: %b\r\nContent-Length: %d\r\n\r\n" % (kind, len(page)))
                writer.write(page)
                await writer.drain()
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        writer.close()

    async def serve(self):
        server = await asyncio.start_server(self.answer, "127.0.0.1", self.port, backlog=2000)
        async with server:
            await server.serve_forever()


class Site(Processes):
    def __init__(self, directory, options):
        super().__init__(directory)
        self.options = options
        self.broker, self.nobody, self.port, self.victoria_port = free_ports(4)

    def configuration(self, number):
        is_bad = number == REAL - 1
        drives = [{"name": f"pump-{n}", "address": n, "profile": "vacon-nx"} for n in range(1, 11)]
        bus = {"name": "line1", "port": str(self.directory / f"line{number}"), "baud": 115200, "cycle": "1s", "slow_cycle": "10s",
               "response_timeout": "200ms", "retries": 3, "drive": drives}
        name = name_of(number)
        return {
            "gateway": {"name": name, "socket": str(self.directory / f"{name}.socket"), "state_dir": str(self.directory / name)},
            "bus": [bus],
            "mqtt": {"url": f"mqtt://127.0.0.1:{self.nobody if is_bad else self.broker}", "topics": ["state"]},
            "recordings": {"max_count": 0},
        }

    def gateways(self):
        """The sockets of the real ones."""
        config = self.directory / "mosquitto.conf"
        config.write_text(f"listener {self.broker} 127.0.0.1\nallow_anonymous true\n")
        self.start("mosquitto", [MOSQUITTO, "-c", config])
        until("the broker", lambda: listens(self.broker))
        configurations = [self.configuration(number) for number in range(REAL)]
        lines = [each["bus"][0] for each in json.loads(json.dumps(configurations))]
        lines[-1]["drive"] = lines[-1]["drive"][LACKING:]
        for number, bus in enumerate(lines):
            bus["name"] = f"line{number}"
            for drive in bus["drive"]:
                drive["name"] = f"drive{number}-{drive['address']}"
        config = self.directory / "lines.toml"
        config.write_text(to_toml({"gateway": {"name": "lines"}, "bus": lines}))
        self.start("lines", [self.options.binary, "simulate", "--config", config, "--speed", "max", "--autopilot"])
        until("the lines", lambda: all(os.path.exists(bus["port"]) for bus in lines), 60)
        for number, configuration in enumerate(configurations):
            (self.directory / name_of(number)).mkdir()
            config = self.directory / f"{name_of(number)}.toml"
            config.write_text(to_toml(configuration))
            self.start(name_of(number), [self.options.binary, "run", "--config", config])
        sockets = [pathlib.Path(each["gateway"]["socket"]) for each in configurations]
        until("the gateways", lambda: all(each.exists() for each in sockets))
        time.sleep(15)
        return sockets

    def prometheus(self, pages):
        targets = [
            {"targets": [f"127.0.0.1:{pages.port}"],
             "labels": {"__metrics_path__": f"/{n}", "instance": f"{name_of(n)}:9488", "site": f"plant{n // 50}"}}
            for n in range(self.options.targets)
        ]
        (self.directory / "targets.json").write_text(json.dumps(targets))
        keep = "instance:.*|up|ALERTS" if self.options.remote == "recorded" else ".*"
        config = {
            "global": {"scrape_interval": "15s", "evaluation_interval": "15s"},
            "rule_files": [str(RULES / "alerts.yml"), str(RULES / "recording.yml")],
            "scrape_configs": [
                {"job_name": "drivegate", "file_sd_configs": [{"files": [str(self.directory / "targets.json")]}]},
                {"job_name": "prometheus", "static_configs": [{"targets": [f"127.0.0.1:{self.port}"]}]},
            ],
            "remote_write": [{"url": f"http://127.0.0.1:{self.victoria_port}/api/v1/write",
                              "write_relabel_configs": [{"source_labels": ["__name__"], "regex": keep, "action": "keep"}]}],
        }
        # JSON is YAML.
        (self.directory / "prometheus.yml").write_text(json.dumps(config))
        self.victoria = self.start("victoria", [VICTORIA, f"-storageDataPath={self.directory}/victoria", "-search.latencyOffset=0s",
                                                f"-httpListenAddr=127.0.0.1:{self.victoria_port}"])
        until("VictoriaMetrics", lambda: listens(self.victoria_port))
        self.server = self.start("prometheus", [PROMETHEUS, f"--config.file={self.directory}/prometheus.yml", "--web.enable-admin-api",
                                                f"--storage.tsdb.path={self.directory}/data", f"--web.listen-address=127.0.0.1:{self.port}"])
        until("Prometheus", lambda: listens(self.port), 60)

    def find(self, expression, port=None):
        return query_api(port or self.port, "query", query=expression)["result"]

    def value(self, expression, port=None):
        found = self.find(expression, port)
        return float(found[0]["value"][1]) if found else float("nan")


def costs(site, seconds):
    """Waits, and prints what it cost meanwhile."""
    watched = {"prometheus": site.server.pid, "victoria": site.victoria.pid}
    before = {name: processor_seconds(pid) for name, pid in watched.items()}
    began = time.monotonic()
    time.sleep(seconds)
    took = time.monotonic() - began
    used = {name: (processor_seconds(pid) - before[name]) / took for name, pid in watched.items()}
    resident = {name: memory(pid)[0] for name, pid in watched.items()}
    window, count = f"{int(seconds)}s", site.options.targets - ABSENT
    value = site.value
    series = value("prometheus_tsdb_head_series")
    samples = value(f"rate(prometheus_tsdb_head_samples_appended_total[{window}])")
    print(f"prometheus: {value('sum(up{job=%r})' % 'drivegate'):.0f} gateways, {series:.0f} series, {samples:.0f} samples/s, "
          f"{100 * used['prometheus']:.1f} % of a core, {resident['prometheus']:.0f} MiB resident", flush=True)
    print(f"  a gateway: {value('avg(scrape_samples_scraped{job=%r} > 0)' % 'drivegate'):.0f} series of its page, "
          f"{1000 * used['prometheus'] / count:.2f} thousandths of a core, {1024 * resident['prometheus'] / count:.0f} KiB", flush=True)
    for name, how in [("mean", "avg(avg_over_time({}))"), ("95 %", "quantile(0.95, avg_over_time({}))"), ("slowest", "max(max_over_time({}))")]:
        scrape = how.format(f'scrape_duration_seconds{{job="drivegate"}}[{window}]')
        print(f"  scrape, {name}: {1000 * value(scrape):.1f} ms", flush=True)
    for group in site.find(f"max_over_time(prometheus_rule_group_last_duration_seconds[{window}])"):
        rules = group["metric"]["rule_group"].rpartition(";")[2]
        mean = value(f'avg_over_time(prometheus_rule_group_last_duration_seconds{{rule_group=~".*;{rules}"}}[{window}])')
        print(f"  rules of {rules}: {1000 * mean:.0f} ms a round, the slowest {1000 * float(group['value'][1]):.0f} ms", flush=True)
    rules = [rule for group in query_api(site.port, "rules")["groups"] for rule in group["rules"]]
    slow = sorted(rules, key=lambda rule: rule["evaluationTime"])[-3:]
    slow = [f"{each['name']} {1000 * each['evaluationTime']:.0f} ms" for each in reversed(slow)]
    print(f"  the slowest rules: {', '.join(slow)}", flush=True)
    missed = value("sum(prometheus_rule_group_iterations_missed_total)")
    failed = value("sum(prometheus_rule_evaluation_failures_total)")
    recorded = value('count({__name__=~"instance:.*"})')
    written = value(f"sum(rate(prometheus_remote_storage_samples_total[{window}]))")
    dropped = value("sum(prometheus_remote_storage_samples_failed_total)")
    print(f"  recorded: {recorded:.0f} series; rounds missed {missed:.0f}, rules failed {failed:.0f}", flush=True)
    print(f"victoria-metrics ({site.options.remote}): {written:.0f} samples/s, {dropped:.0f} refused, "
          f"{100 * used['victoria']:.1f} % of a core, {resident['victoria']:.0f} MiB resident", flush=True)
    return missed == failed == dropped == 0


def disk(site):
    """Bytes of a sample: of Prometheus in a block of all that it has, of VictoriaMetrics in its files."""
    request = urllib.request.Request(f"http://127.0.0.1:{site.port}/api/v1/admin/tsdb/snapshot", method="POST")
    with urllib.request.urlopen(request, timeout=300) as answer:
        folder = site.directory / "data/snapshots" / json.load(answer)["data"]["name"]
    samples = series = chunks = index = 0
    for block in folder.iterdir():
        stats = json.loads((block / "meta.json").read_text())["stats"]
        samples, series = samples + stats["numSamples"], max(series, stats["numSeries"])
        chunks += sum(each.stat().st_size for each in (block / "chunks").iterdir())
        index += (block / "index").stat().st_size
    log = sum(each.stat().st_size for each in (site.directory / "data/wal").rglob("*") if each.is_file())
    print(f"prometheus, disk: {samples / 1e6:.1f} million samples; {chunks / samples:.2f} B a sample, index {index / series:.0f} B a series; "
          f"log {log / samples:.1f} B a sample", flush=True)
    with urllib.request.urlopen(f"http://127.0.0.1:{site.victoria_port}/internal/force_flush", timeout=60):
        pass
    with urllib.request.urlopen(f"http://127.0.0.1:{site.victoria_port}/metrics", timeout=60) as answer:
        lines = [line.rsplit(" ", 1) for line in answer.read().decode().splitlines() if line.startswith("vm_")]

    def total(metric, kind):
        return sum(float(value) for name, value in lines if name.startswith(metric + "{") and kind in name)

    rows = total("vm_rows", 'type="storage/')
    print(f"victoria-metrics, disk: {rows / 1e6:.2f} million samples; {total('vm_data_size_bytes', 'storage/') / max(rows, 1):.2f} B a sample, "
          f"index {total('vm_data_size_bytes', 'indexdb') / 1e6:.2f} MB", flush=True)


def queries(name):
    """Of a dashboard: title, expression, and whether it is asked for one moment."""
    board = json.loads((DASHBOARDS / f"{name}.json").read_text())
    for panel in board["panels"]:
        for target in panel.get("targets", []):
            yield panel["title"], target["expr"], target.get("instant", False)
    for annotation in board["annotations"]["list"]:
        yield annotation["name"], annotation["expr"], False


def dashboards(site):
    """Asks what a browser asks: the overview of all gateways, the other dashboards of one."""
    is_well = True
    for name in ("fleet", "gateway", "line", "drive"):
        chosen = {"$instance": ".*" if name == "fleet" else f"{name_of(BAD)}:9488", "$bus": ".*", "$drive": ".*"}
        times, most = [], (0, "")
        for title, expression, is_instant in queries(name):
            for variable, value in (chosen | {"$__rate_interval": "1m"}).items():
                expression = expression.replace(variable, value)
            now, began = time.time(), time.monotonic()
            if is_instant:
                found = query_api(site.port, "query", query=expression)["result"]
            else:
                found = query_api(site.port, "query_range", query=expression, start=now - 1800, end=now, step=15)["result"]
            times.append((time.monotonic() - began, title))
            # At any one moment.
            moments = collections.Counter(at for each in found for at, _ in each.get("values", [each.get("value")]))
            most = max(most, (max(moments.values(), default=0), title))
        slowest = max(times)
        print(f"dashboard {name}: {len(times)} queries, {sum(t for t, _ in times):.2f} s together, the slowest {slowest[0]:.2f} s "
              f"({slowest[1]}); at most {most[0]} series ({most[1]})", flush=True)
        is_well &= name != "fleet" or (most[0] <= MOST_SERIES and slowest[0] < 5)
    return is_well


def worst_first(site):
    """Whether the overview shows those that are bad before all others; from both stores."""
    bad = {f"{name_of(n)}:9488" for n in range(BAD)}
    absent = {f"{name_of(n)}:9488" for n in range(site.options.targets - ABSENT, site.options.targets)}
    is_well = True
    for store, port in [("prometheus", site.port), ("victoria-metrics", site.victoria_port)]:
        for expression, wanted in [(f"topk({BAD}, instance:drivegate_problems:sum)", bad), ('bottomk(50, up{job="drivegate"}) == 0', absent)]:
            found = {each["metric"]["instance"] for each in site.find(expression, port)}
            if found != wanted:
                print(f"{store}: {expression}: {sorted(found)[:20]}", flush=True)
                is_well = False
        problems = sorted(float(each["value"][1]) for each in site.find("instance:drivegate_problems:sum > 0", port))
        print(f"{store}: {len(problems)} gateways with problems; the first {BAD} have {problems[-BAD:][0]:.0f} to {problems[-1]:.0f}, "
              f"the next {problems[:-BAD][-1:]}", flush=True)
    return is_well


def tried(site):
    pages = Pages(site.gateways(), site.options.targets)
    site.prometheus(pages)
    time.sleep(site.options.warm)
    is_well = costs(site, site.options.seconds)
    answering = site.value('sum(up{job="drivegate"})')
    is_well &= answering == site.options.targets - ABSENT
    is_well &= dashboards(site)
    is_well &= worst_first(site)
    disk(site)
    pages.end.set()
    return is_well


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--targets", type=int, default=1000)
    parser.add_argument("--warm", type=float, default=120, help="how long is waited before it is measured, s")
    parser.add_argument("--seconds", type=float, default=600, help="how long is measured")
    parser.add_argument("--remote", choices=["recorded", "all"], default="recorded", help="what VictoriaMetrics gets")
    parser.add_argument("--binary", type=pathlib.Path, default=ROOT / "target/release/drivegate")
    options = parser.parse_args()
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(most, 65536), most))
    attempt("metrics", options, Site, tried)


if __name__ == "__main__":
    main()
