#!/usr/bin/env python3
"""Shows that the seeded world finds faults: puts those of mutants.toml into a copy of the tree and runs the fixed seeds,
then, where none of them found it, the other scenarios in virtual time.

All faults are built into one program, each behind a switch (the variable MUTANT names the one that is on), so that there
is one build for all of them, in target/mutants. With none switched on the same program must pass all seeds. Prints one
row of a table for each fault; ends with 1 if one survived that the world should see, with 2 if the build fails.
"""

import argparse
import concurrent.futures
import json
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tomllib

ROOT = pathlib.Path(__file__).resolve().parents[2]
COPY = ROOT / "target/mutants"
# Below `[workspace.package]`, and of the own packages in the lock file.
VERSION = re.compile(rb'((?:\[workspace\.package\]|name = "drivegate[a-z-]*")\nversion = "[0-9.]+)')
# Where the switch stands; every other crate that has faults takes it from there.
LOWEST = "crates/proto/src/lib.rs"
SWITCH = """
/// Whether that fault is switched on.
pub fn mutant(name: &str) -> bool {
    static ON: std::sync::LazyLock<String> = std::sync::LazyLock::new(|| std::env::var("MUTANT").unwrap_or_default());
    *ON == name
}
"""


def copy_tree():
    """The files under version control as they are now; unchanged ones keep their time, so that the build is short."""
    listed = subprocess.run(["git", "ls-files", "-z", "--cached"], cwd=ROOT, check=True, capture_output=True, text=True)
    files = {name for name in listed.stdout.split("\0") if name and (ROOT / name).is_file()}
    for old in [path for path in COPY.rglob("*") if path.is_file()]:
        if str(old.relative_to(COPY)) not in files:
            old.unlink()
    return {name: (ROOT / name).read_bytes() for name in files}


def write_tree(tree):
    for name, content in tree.items():
        path = COPY / name
        if not path.is_file() or path.read_bytes() != content:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
            shutil.copymode(ROOT / name, path)


def switched(mutant, old, new):
    """The text that is `new` while the fault is switched on, else `old`."""
    on = f'crate::mutant("{mutant["name"]}")'
    if re.search(r"\bON\b", new):
        return re.sub(r"\bON\b", on, new)
    text = f"if {on} {{ {new} }} else {{ {old} }}"
    return text if old.rstrip()[-1] in ";}" else f"({text})"


def put_in(tree, mutants):
    edits = {}
    for mutant in mutants:
        for edit in mutant["edit"]:
            text = tree.get(edit["file"], b"").decode()
            if text.count(edit["old"]) != 1:
                sys.exit(f'{mutant["name"]}: stands {text.count(edit["old"])} times in {edit["file"]}: {edit["old"]}')
            begin = text.index(edit["old"])
            place = (begin, begin + len(edit["old"]), switched(mutant, edit["old"], edit["new"]), mutant["name"])
            edits.setdefault(edit["file"], []).append(place)
    for name, places in edits.items():
        text, places = tree[name].decode(), sorted(places)
        for (_, end, _, one), (begin, _, _, other) in zip(places, places[1:]):
            if begin < end:
                sys.exit(f"{one} and {other} change the same text in {name}")
        for begin, end, new, _ in reversed(places):
            text = text[:begin] + new + text[end:]
        tree[name] = text.encode()
    tree[LOWEST] += SWITCH.encode()
    crates = {"/".join(name.split("/")[:2]) for name in edits}
    for crate in crates:
        if crate != "crates/proto":
            tree[f"{crate}/src/lib.rs"] += b"\npub(crate) use drivegate_proto::mutant;\n"
    # A version of its own: cargo, which shares the built dependencies, must not take one tree's program for the other's.
    for name in ("Cargo.toml", "Cargo.lock"):
        tree[name] = VERSION.sub(rb'\1-mutants', tree[name])


def build():
    command = ["cargo", "test", "--locked", "--profile", "world", "-p", "drivegate-world", "--test", "world", "--no-run", "--message-format=json"]
    env = os.environ | {"CARGO_TARGET_DIR": str(ROOT / "target")}
    built = subprocess.run(command, cwd=COPY, env=env, stdout=subprocess.PIPE, text=True)
    messages = [json.loads(line) for line in built.stdout.splitlines() if line.startswith("{")]
    if built.returncode != 0:
        print("BUILD ERROR")
        for message in messages:
            if message.get("message", {}).get("level") == "error":
                print(message["message"]["rendered"])
        sys.exit(2)
    programs = [m["executable"] for m in messages if m.get("target", {}).get("name") == "world" and m.get("executable")]
    return programs[-1]


def run(program, name, options):
    """What found the fault, a seed or else a scenario, and what was seen; None where none did."""
    for tests in (["fixed_seeds"], ["--skip", "fixed_seeds", "--test-threads", "1"]):
        env = os.environ | {"MUTANT": name, "WORLD_SEEDS": str(options.seeds), "WORLD_FROM": "0"}
        command = [program, *tests]
        try:
            ended = subprocess.run(command, cwd=COPY, env=env, capture_output=True, text=True, timeout=options.time)
        except subprocess.TimeoutExpired:
            return ("nothing", f"did not end within {options.time} s")
        if ended.returncode == 0:
            continue
        output = ended.stdout + ended.stderr
        if ended.returncode < 0:
            return ("nothing", f"ended by signal {-ended.returncode}")
        seed = re.search(r"FAILED: seed (\d+)", output)
        scenario = re.search(r"^test (\S+) \.\.\. FAILED", output, re.MULTILINE)
        seen = re.search(r"panicked at [^\n]*:\n([^\n]*)", output)
        words = re.sub(r":? ?(Record )?\{.*", "", seen.group(1)) if seen else output[-200:]
        by = f"seed {seed.group(1)}" if seed else f"scenario `{scenario.group(1)}`" if scenario else "nothing"
        return (by, words)
    return None


def main():
    options = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    options.add_argument("only", nargs="*", help="names of faults; all without any")
    options.add_argument("--seeds", type=int, default=400, help="seeds tried on each (400)")
    options.add_argument("--time", type=int, default=600, help="seconds for one fault (600)")
    options.add_argument("--jobs", type=int, default=os.cpu_count(), help="faults run side by side")
    options = options.parse_args()
    mutants = tomllib.loads((ROOT / "tests/world/mutants.toml").read_text())["mutant"]
    if unknown := set(options.only) - {mutant["name"] for mutant in mutants}:
        sys.exit(f"no such fault: {', '.join(sorted(unknown))}")
    tree = copy_tree()
    put_in(tree, mutants)
    write_tree(tree)
    program = build()
    chosen = [mutant for mutant in mutants if not options.only or mutant["name"] in options.only]
    sound = {"name": "none", "promise": "no fault is switched on: all seeds pass"}
    survived = []
    print("| fault | promise | found by |\n|---|---|---|")
    with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
        work = [(mutant, pool.submit(run, program, mutant["name"], options)) for mutant in [sound, *chosen]]
        for mutant, ended in work:
            found = ended.result()
            name, promise = mutant["name"], mutant["promise"]
            if mutant is sound:
                found, text = None, f"FAILED with {found[0]}: {found[1]}" if found else "passed"
                survived += ["no fault"] * text.startswith("FAILED")
            elif found:
                text = f"killed by {found[0]}: {found[1]}"
                survived += [name] * (found[0] == "nothing")
            elif "unseen" in mutant:
                text = f"survived, as expected: {mutant['unseen']}"
            else:
                text = "SURVIVED"
                survived.append(name)
            print(f"| `{name}` | {promise} | {text} |", flush=True)
    print(f"{len(chosen)} faults; survived or failed: {', '.join(survived) or 'none'}")
    sys.exit(1 if survived else 0)


if __name__ == "__main__":
    main()
