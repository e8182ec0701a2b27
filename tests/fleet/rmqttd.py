"""Makes the sources of rmqttd smaller: rmqttd.py FROM TO

What a cluster of brokers needs stays, Raft, retained messages, shared subscriptions and access rules; the bridges to other systems, which
need C libraries and take most of the time to build, go.
"""

import pathlib
import re
import shutil
import sys

KEEP = ["rmqtt-acl", "rmqtt-cluster-raft", "rmqtt-retainer", "rmqtt-shared-subscription"]
NO_PLUGINS = ["rmqtt-conf", "rmqtt-net"]
RAM_ONLY = ["rmqtt-retainer"]

source, target = map(pathlib.Path, sys.argv[1:])
shutil.rmtree(target, ignore_errors=True)
shutil.copytree(source, target)
kept = []
for part in re.split(r"^(?=\[)", (source / "Cargo.toml").read_text(), flags=re.MULTILINE):
    named = re.match(r"\[(?:package\.metadata\.plugins|dependencies)\.(rmqtt-[\w-]+)\]", part)
    if not named or named.group(1) in KEEP + NO_PLUGINS:
        if named and named.group(1) in RAM_ONLY and "features" in part:
            part = re.sub(r"features = \[.*?\]", 'features = ["ram"]', part, flags=re.DOTALL)
        kept.append(part)
(target / "Cargo.toml").write_text("".join(kept) + "\n[workspace]\n")
