#!/usr/bin/env python3
"""Prints the licences of every crate that the program is linked with, and their texts.

    deploy/package/licences.py TARGET... > third-party-licences.txt

The crates are those that cargo builds in for the targets, without build and development dependencies; `make deny` holds
the list against the policy of deny.toml.
"""

import json
import pathlib
import subprocess
import sys

NAMES = ("licen", "copying", "notice", "copyright", "unlicense")
RULE = "=" * 100


def linked(target):
    """The crates in the program for one target, as (name, version)."""
    lines = subprocess.run(
        ["cargo", "tree", "--locked", "--edges", "normal,no-proc-macro", "--prefix", "none", "--format", "{p}", "--target", target],
        check=True, capture_output=True, text=True,
    ).stdout.splitlines()
    # "name v1.2.3 (proc-macro) (*)"
    return {(words[0], words[1].removeprefix("v")) for words in map(str.split, lines) if len(words) > 1}


def metadata():
    output = subprocess.run(
        ["cargo", "metadata", "--locked", "--format-version", "1"], check=True, capture_output=True, text=True
    ).stdout
    return {(package["name"], package["version"]): package for package in json.loads(output)["packages"]}


def texts(folder):
    """The licence files of a crate, by name."""
    files = [file for file in folder.iterdir() if file.is_file() and file.name.lower().startswith(NAMES)]
    return [(file.name, file.read_text(encoding="utf-8", errors="replace").strip()) for file in sorted(files)]


def main():
    if len(sys.argv) < 2:
        sys.exit("error: no target; on the command line; name at least one, such as x86_64-unknown-linux-gnu")
    crates = sorted(set().union(*map(linked, sys.argv[1:])))
    packages = metadata()
    crates = [crate for crate in crates if packages[crate]["source"] is not None]

    # Most texts are the same word for word: each stands once, below the crates that carry it.
    bearers, originals = {}, {}
    print("drivegate is linked with these crates, each under the licence given here. Texts and notices follow.\n")
    for crate in crates:
        package = packages[crate]
        licence = package["license"] or "see its file"
        print(f"{crate[0]} {crate[1]}: {licence}" + (f", {package['repository']}" if package["repository"] else ""))
        found = texts(pathlib.Path(package["manifest_path"]).parent)
        for name, text in found:
            words = " ".join(text.split())
            originals.setdefault(words, text)
            bearers.setdefault(words, []).append(f"{crate[0]} {crate[1]}: {name}")
        if not found:
            print(f"    (the crate contains no text; by {', '.join(package['authors']) or 'its authors'})")
    for words, users in bearers.items():
        print(f"\n{RULE}\n" + "\n".join(users) + f"\n{RULE}\n\n{originals[words]}")


if __name__ == "__main__":
    main()
