#!/usr/bin/env bash
# Installs what the tests of a fleet need into .tools: install.sh WHAT..., of ansible (PyPI), ejabberd and victoria-metrics (Debian packages,
# unpacked: nothing is started), rmqttd (built from its crate without the bridges to other systems, which takes many minutes), mosquitto (there already).
# Quick when nothing is missing.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."

rmqttd=0.24.0
say() { echo "tools: $*" >&2; }
fail() { echo "error: $*" >&2; exit 1; }

install_ansible() {
    local list=tests/fleet/requirements.txt stamp=.tools/ansible/installed
    if [ "$(cat $stamp 2>/dev/null)" != "$(echo "$PWD"; cat $list)" ]; then
        say "installing the Python packages of $list into .tools/ansible"
        rm -rf .tools/ansible
        python3 -m venv .tools/ansible
        .tools/ansible/bin/pip install --quiet --disable-pip-version-check --requirement $list </dev/null >&2
        (echo "$PWD"; cat $list) >$stamp
    fi
}

# unpack DIRECTORY PACKAGE...: the packages and all that they need beyond what is installed.
unpack() {
    local to=$PWD/$1 packages
    shift
    command -v apt-get >/dev/null || fail "no apt-get; this is no Debian; install $* by hand"
    mapfile -t packages < <(apt-get --simulate install --no-install-recommends "$@" | awk '/^Inst/ { print $2 }')
    mkdir -p "$to.new/packages"
    (cd "$to.new/packages" && apt-get -qq download "${packages[@]}")
    for each in "$to.new/packages"/*.deb; do dpkg-deb --extract "$each" "$to.new"; done
    rm -rf "$to.new/packages" "$to"
    mv "$to.new" "$to"
}

install_ejabberd() {
    if [ ! -d .tools/brokers/ejabberd ]; then
        say "unpacking ejabberd into .tools/brokers"
        unpack .tools/brokers/ejabberd ejabberd
    fi
}

install_victoria_metrics() {
    if ! command -v victoria-metrics >/dev/null && [ ! -d .tools/victoria-metrics ]; then
        say "unpacking victoria-metrics into .tools"
        unpack .tools/victoria-metrics victoria-metrics
    fi
}

install_rmqttd() {
    [ ! -x .tools/brokers/bin/rmqttd ] || return 0
    say "building rmqttd $rmqttd"
    local protoc=$PWD/.tools/protoc
    if ! command -v protoc >/dev/null; then
        unpack .tools/protoc protobuf-compiler
        printf '#!/bin/sh\nLD_LIBRARY_PATH=$(echo %s/usr/lib/*/) exec %s/usr/bin/protoc "$@"\n' "$protoc" "$protoc" >"$protoc/protoc"
        chmod +x "$protoc/protoc"
        export PROTOC=$protoc/protoc
    fi
    # Brings the sources of the crate into cargo's registry.
    cargo info --quiet "rmqttd@$rmqttd" >/dev/null
    python3 tests/fleet/rmqttd.py "$(echo "${CARGO_HOME:-$HOME/.cargo}"/registry/src/*/rmqttd-$rmqttd)" .tools/build/rmqttd
    CARGO_TARGET_DIR=.tools/build/target CARGO_PROFILE_RELEASE_LTO=off CARGO_PROFILE_RELEASE_DEBUG=0 CARGO_PROFILE_RELEASE_STRIP=true \
        CARGO_PROFILE_RELEASE_CODEGEN_UNITS=16 cargo install --quiet --locked --path .tools/build/rmqttd --root .tools/brokers >&2
    rm -rf .tools/build .tools/protoc
}

mkdir -p .tools/brokers
for what in "$@"; do
    case $what in
        ansible | ejabberd | rmqttd | victoria-metrics) "install_${what//-/_}" ;;
        mosquitto) ;;
        *) fail "$what is unknown; write ansible, ejabberd, rmqttd, victoria-metrics or mosquitto" ;;
    esac
done
