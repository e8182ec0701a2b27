#!/usr/bin/env bash
# Installs what the tests need and this machine lacks: Debian packages, Python and Node packages and cargo-deny in
# .tools, parts of the Rust toolchain. Takes a moment when nothing is missing. Starts no service.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."

# What must be on the PATH (or, with a slash, on disk), and the Debian package that brings it.
needed=(
    "gcc gcc"
    "node nodejs"
    "npm npm"
    "openssl openssl"
    "curl curl"
    "mosquitto mosquitto"
    "mosquitto_pub mosquitto-clients"
    "promtool prometheus"
    "amtool prometheus-alertmanager"
    "mbpoll mbpoll"
    "socat socat"
    "tshark tshark"
    "chromium chromium"
    "systemd-analyze systemd"
    "prlimit util-linux"
    "/usr/include/modbus/modbus.h libmodbus-dev"
)
cargo_deny=0.20.2
export PATH="$PWD/.tools/bin:$PATH:/usr/sbin:/sbin"

say() { echo "tools: $*" >&2; }
fail() { echo "error: $*" >&2; exit 1; }

. tests/tools/packages.sh

# Debian starts a daemon when its package is installed. The tests run their own broker and Prometheus on free
# ports; nothing may be left on 1883 and 9090.
install_packages() {
    command -v apt-get >/dev/null || fail "missing test tools; this is no Debian; install by hand: ${packages[*]}"
    say "installing ${packages[*]}"
    local policy=/usr/sbin/policy-rc.d
    if [ ! -e $policy ]; then
        trap "as_root rm -f $policy" EXIT
        printf '#!/bin/sh\nexit 101\n' | as_root tee $policy >/dev/null
        as_root chmod 755 $policy
    fi
    apt_install || fail "apt-get could not install ${packages[*]}; its own messages stand above; check the network and run again"
    if [ -d /run/systemd/system ]; then
        local package
        for package in "${packages[@]}"; do
            case $package in
                mosquitto | prometheus | prometheus-alertmanager) as_root systemctl disable --now --quiet "$package" ;;
            esac
        done
    fi
}

apt_install() {
    local options=(-o DPkg::Lock::Timeout=600 -o Acquire::Retries=3)
    as_root env DEBIAN_FRONTEND=noninteractive apt-get "${options[@]}" -qq update </dev/null >&2 &&
        as_root env DEBIAN_FRONTEND=noninteractive \
            apt-get "${options[@]}" -qq install --yes --no-install-recommends "${packages[@]}" </dev/null >&2
}

install_rust_parts() {
    local part
    for part in fmt clippy; do
        if ! cargo "$part" --version >/dev/null 2>&1; then
            command -v rustup >/dev/null || fail "cargo $part is missing; in this Rust toolchain; install rustfmt and clippy"
            say "adding rustfmt and clippy to the toolchain"
            rustup component add rustfmt clippy >&2
        fi
    done
}

# A virtual environment holds absolute paths: a checkout that was moved gets a new one.
install_python_packages() {
    local list=tests/tools/requirements.txt stamp=.tools/venv/installed
    local wanted
    wanted=$(echo "$PWD"; cat $list)
    if [ "$(cat $stamp 2>/dev/null)" != "$wanted" ]; then
        say "installing the Python packages of $list into .tools/venv"
        rm -rf .tools/venv
        python3 -m venv .tools/venv
        .tools/venv/bin/pip install --quiet --disable-pip-version-check --requirement $list </dev/null >&2
        echo "$wanted" >$stamp
    fi
}

# No lock file and no scripts: all are pure JavaScript, and what they depend on is as old as they are.
install_node_packages() {
    local list=tests/tools/node/package.json stamp=.tools/node/package.json
    if ! cmp --quiet $list $stamp; then
        say "installing the Node packages of $list into .tools/node"
        rm -rf .tools/node .tools/node.new
        mkdir .tools/node.new
        cp $list .tools/node.new/
        (cd .tools/node.new && npm install --silent --no-package-lock --omit=optional --ignore-scripts --no-audit --no-fund) \
            </dev/null >&2
        mv .tools/node.new .tools/node
    fi
}

# Unoptimised, cargo-deny builds in a minute on two cores instead of many; its work takes seconds either way.
install_cargo_deny() {
    if [ "$(cargo-deny --version 2>/dev/null)" != "cargo-deny $cargo_deny" ]; then
        say "building cargo-deny $cargo_deny, about a minute"
        CARGO_TARGET_DIR=.tools/build CARGO_PROFILE_DEV_DEBUG=0 \
            cargo install cargo-deny --version "=$cargo_deny" --locked --debug --force --quiet --root .tools >&2
        rm -rf .tools/build
    fi
}

mkdir -p .tools
exec 9>.tools/lock
flock 9

mapfile -t packages < <(missing_packages)
if [ ${#packages[@]} -gt 0 ]; then
    install_packages
    mapfile -t packages < <(missing_packages)
    [ ${#packages[@]} = 0 ] || fail "still missing after the installation: ${packages[*]}"
fi
install_rust_parts
install_python_packages
install_node_packages
install_cargo_deny
