#!/usr/bin/env python3
"""Shows that the seeded world finds faults: puts those of mutants.toml into a copy of the tree and runs the seeds in which
threads stand still, the fixed seeds and then, where none of them found it, the other scenarios in virtual time. What only
the unit tests of a crate can see (`by`) they have to find. With --check it builds nothing and says only which of them name
no function, or more than one.

All faults are built into one program, each behind a switch (the variable MUTANT names the one that is on), so that there
is one build for all of them, in target/mutants. With none switched on the same program must pass all seeds. Prints one
row of a table for each fault; ends with 1 if one survived that the world should see, with 2 if the build fails.
"""

import argparse
import concurrent.futures
import difflib
import json
import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import tomllib

from rust_functions import index, matching

ROOT = pathlib.Path(__file__).resolve().parents[2]
COPY = ROOT / "target/mutants"
# What a fault does to a function; each edit has one of them, see mutants.toml.
FORMS = ("given", "before", "returns", "result")
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


def listed_tree():
    """The files under version control as they are now."""
    listed = subprocess.run(["git", "ls-files", "-z", "--cached"], cwd=ROOT, check=True, capture_output=True, text=True)
    files = {name for name in listed.stdout.split("\0") if name and (ROOT / name).is_file()}
    return {name: (ROOT / name).read_bytes() for name in files}


def write_tree(tree):
    """Copies it; unchanged files keep their time, so that the build is short."""
    for old in [path for path in COPY.rglob("*") if path.is_file()]:
        if str(old.relative_to(COPY)) not in tree:
            old.unlink()
    for name, content in tree.items():
        path = COPY / name
        if not path.is_file() or path.read_bytes() != content:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
            shutil.copymode(ROOT / name, path)


def anchored(tree, mutants):
    """The edits, each as the name of its fault, itself and the function that it changes; and what is wrong with others."""
    found, edits, wrong = index(tree), [], []
    names = [mutant["name"] for mutant in mutants]
    wrong += [f"{name}: two faults have this name" for name in sorted({name for name in names if names.count(name) > 1})]
    for mutant in mutants:
        if unknown := (set(mutant) - {"unseen", "by"}) ^ {"name", "promise", "edit"}:
            wrong.append(f"{mutant['name']}: missing or unknown: {', '.join(sorted(unknown))}")
        for edit in mutant.get("edit", []):
            name, forms = edit.get("fn", ""), [form for form in FORMS if form in edit]
            here = matching(found, name, edit.get("crate"))
            why = None
            if unknown := set(edit) - {"fn", "crate", *FORMS}:
                why = f"unknown: {', '.join(sorted(unknown))}"
            elif len(forms) != 1:
                why = f"one of {', '.join(FORMS)} is needed"
            elif len(here) != 1:
                why = f"{len(here)} functions have this name; {candidates(found, name, here)}"
            elif strange := [of for of in edit.get("given", {}) if not parameter(tree, here[0], of)]:
                why = f"it has no parameter {', '.join(strange)}"
            if why:
                wrong.append(f"{mutant['name']}: `{name}`: {why}")
            else:
                edits.append((mutant["name"], edit, here[0]))
    return edits, wrong


def candidates(found, name, here):
    """The functions that may be meant."""
    last = name.split("::")[-1]
    others = here or [function for function in found if function.path[-1] == last]
    if not others:
        close = difflib.get_close_matches(last, {function.path[-1] for function in found}, 3)
        others = [function for function in found if function.path[-1] in close]
    return "candidates: " + (", ".join(f"{function} in {function.file}" for function in others[:8]) or "none")


def parameter(tree, function, name):
    """How the function declares it: `name: ` or `mut name: `."""
    signature = tree[function.file].decode()[slice(*function.signature)]
    return re.search(rf"[(,]\s*((?:mut\s+)?{re.escape(name)})\s*:", signature)


def begun(tree, name, edit, function):
    """What comes first in the body."""
    on = f'crate::mutant("{name}")'
    if "given" in edit:
        lets = [(parameter(tree, function, of).group(1), of, new) for of, new in edit["given"].items()]
        return "".join(f"let {declared} = if {on} {{ {new} }} else {{ {of} }};\n" for declared, of, new in lets)
    if "before" in edit:
        return f"if {on} {{ {edit['before']} }}\n"
    return f"if {on} {{ return {edit['returns']}; }}\n"


def changed(tree, edits, function):
    """What the edits of one function insert into its file, and where: all of them go together, each with its own switch."""
    text = tree[function.file].decode()
    begin, end = function.body[0] + 1, function.body[1] - 1
    first = "".join(begun(tree, name, edit, function) for name, edit in edits if "result" not in edit)
    results = "".join(
        f'let result = if crate::mutant("{name}") {{ {edit["result"]} }} else {{ result }};\n'
        for name, edit in edits
        if "result" in edit
    )
    if results:
        # The body may return early: a closure keeps that in it.
        begun_by, ended_by = ("async ", "().await") if " async " in f" {text[slice(*function.signature)]}" else ("", "()")
        result = function.result or "()"
        arrow, typed = ("", "") if "impl " in result else (f" -> {result}", f": {result}")
        first += f"let result{typed} = ({begun_by}||{arrow} {{"
        yield end, f"\n}}){ended_by};\n{results}result\n"
    yield begin, f"\n{first}"


def put_in(tree, edits):
    functions, inserted = {}, {}
    for name, edit, function in edits:
        functions.setdefault(function, []).append((name, edit))
    for function, of in functions.items():
        inserted.setdefault(function.file, []).extend(changed(tree, of, function))
    for file, places in inserted.items():
        text = tree[file].decode()
        for at, new in sorted(places, reverse=True):
            text = text[:at] + new + text[at:]
        tree[file] = text.encode()
    tree[LOWEST] += SWITCH.encode()
    for crate in {function.path[0] for function in functions} - {"proto"}:
        tree[f"crates/{crate}/src/lib.rs"] += b"\npub(crate) use drivegate_proto::mutant;\n"
    # A version of its own: cargo, which shares the built dependencies, must not take one tree's program for the other's.
    for name in ("Cargo.toml", "Cargo.lock"):
        tree[name] = VERSION.sub(rb'\1-mutants', tree[name])


def build(crates):
    """The program of the world, and those of the unit tests of these crates, by name."""
    profile = ["--locked", "--profile", "world", "--no-run", "--message-format=json"]
    programs = {"world": built(["cargo", "test", *profile, "-p", "drivegate-world", "--test", "world"], "world")}
    for crate in sorted(crates):
        programs[crate] = built(["cargo", "test", *profile, "-p", f"drivegate-{crate}", "--lib"], f"drivegate_{crate}")
    return programs


def built(command, target):
    env = os.environ | {"CARGO_TARGET_DIR": str(ROOT / "target")}
    ended = subprocess.run(command, cwd=COPY, env=env, stdout=subprocess.PIPE, text=True)
    messages = [json.loads(line) for line in ended.stdout.splitlines() if line.startswith("{")]
    if ended.returncode != 0:
        print("BUILD ERROR")
        for message in messages:
            if message.get("message", {}).get("level") == "error":
                print(message["message"]["rendered"])
        sys.exit(2)
    programs = [m["executable"] for m in messages if m.get("target", {}).get("name") == target and m.get("executable")]
    return programs[-1]


STALLS = "no_motor_starts_that_nobody_wants_to_run"


def finished(command, env, seconds):
    """The exit code, None where the time is over, and what was printed. Programs that a test starts end with it."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with subprocess.Popen(command, cwd=COPY, env=env, text=True, start_new_session=True, **pipes) as program:
        try:
            output = program.communicate(timeout=seconds)[0]
            return program.returncode, output
        except subprocess.TimeoutExpired:
            os.killpg(program.pid, signal.SIGKILL)
            return None, program.communicate()[0]


def run(programs, mutant, options):
    """What found the fault, a seed or else a scenario or a test, and what was seen; None where none did."""
    name, by = mutant["name"], mutant.get("by")
    seeds = ([STALLS], ["fixed_seeds"], ["--skip", "fixed_seeds", "--skip", STALLS, "--test-threads", "1"])
    for tests in seeds if by is None else ([],):
        env = os.environ | {"MUTANT": name, "WORLD_SEEDS": str(options.seeds), "WORLD_FROM": "0"}
        command = [programs[by or "world"], *tests]
        returned, output = finished(command, env, options.time)
        if returned is None:
            # A test that failed has found the fault, though another one goes on for ever because of it.
            failed = re.search(r"^test (\S+) \.\.\. FAILED", output, re.MULTILINE)
            found = f"{'scenario' if by is None else 'unit test'} `{failed.group(1)}`" if failed else "nothing"
            return (found, f"not all tests ended within {options.time} s")
        if returned == 0:
            continue
        if returned < 0:
            return ("nothing", f"ended by signal {-returned}")
        seed = re.search(r"FAILED: seed (\d+)", output)
        scenario = re.search(r"^test (\S+) \.\.\. FAILED", output, re.MULTILINE)
        seen = re.search(r"panicked at [^\n]*:\n([^\n]*)", output)
        words = re.sub(r":? ?(Record )?\{.*", "", seen.group(1)) if seen else output[-200:]
        kind = "scenario" if by is None else "unit test"
        found = f"seed {seed.group(1)}" if seed else f"{kind} `{scenario.group(1)}`" if scenario else "nothing"
        return (found, words)
    return None


def main():
    options = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    options.add_argument("only", nargs="*", help="names of faults; all without any")
    options.add_argument("--seeds", type=int, default=400, help="seeds tried on each (400)")
    options.add_argument("--time", type=int, default=600, help="seconds for one fault (600)")
    options.add_argument("--check", action="store_true", help="only find the functions that they change; builds nothing")
    options.add_argument("--faults", type=pathlib.Path, default=ROOT / "tests/world/mutants.toml", help="another mutants.toml")
    options.add_argument("--jobs", type=int, default=os.cpu_count(), help="faults run side by side")
    options = options.parse_args()
    mutants = tomllib.loads(options.faults.read_text())["mutant"]
    if unknown := set(options.only) - {mutant["name"] for mutant in mutants}:
        sys.exit(f"no such fault: {', '.join(sorted(unknown))}")
    tree = listed_tree()
    edits, wrong = anchored(tree, mutants)
    if wrong:
        sys.exit("\n".join(wrong))
    if options.check:
        return print(f"{len(mutants)} faults with {len(edits)} edits: each names one function")
    put_in(tree, edits)
    write_tree(tree)
    chosen = [mutant for mutant in mutants if not options.only or mutant["name"] in options.only]
    programs = build({mutant["by"] for mutant in chosen if "by" in mutant})
    sound = {"name": "none", "promise": "no fault is switched on: all seeds pass"}
    survived = []
    print("| fault | promise | found by |\n|---|---|---|")
    with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
        work = [(mutant, pool.submit(run, programs, mutant, options)) for mutant in [sound, *chosen]]
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
