#!/usr/bin/env bash
# Installs what packaging needs and this machine lacks: Debian packages, Python packages and cargo commands in .tools,
# standard libraries of other targets. Takes a moment when nothing is missing.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."

# What must be on the PATH (or, with a slash, on disk), and the Debian package that brings it.
needed=(
    "git git"
    "python3 python3"
    "dpkg-deb dpkg"
    "lintian lintian"
    "readelf binutils"
    "debootstrap debootstrap"
    "systemd-nspawn systemd-container"
    "buildah buildah"
    "runc runc"
    "jq jq"
    "/usr/share/ca-certificates/mozilla ca-certificates"
    "aarch64-linux-gnu-gcc gcc-aarch64-linux-gnu"
    "/usr/aarch64-linux-gnu/lib/libc.a libc6-dev-arm64-cross"
    "arm-linux-gnueabihf-gcc gcc-arm-linux-gnueabihf"
    "/usr/arm-linux-gnueabihf/lib/libc.a libc6-dev-armhf-cross"
)
cargo_deb=3.8.0
cargo_cyclonedx=0.5.9
# Older ones refuse pseudo-terminals, which the demo needs.
qemu_at_least=8
qemu_suite=trixie
export PATH="$PWD/.tools/bin:$PATH:/usr/sbin:/sbin"

say() { echo "packaging tools: $*" >&2; }
fail() { echo "error: $*" >&2; exit 1; }

. tests/tools/packages.sh

install_packages() {
    command -v apt-get >/dev/null || fail "missing packaging tools; this is no Debian; install by hand: ${packages[*]}"
    say "installing ${packages[*]}"
    local options=(-o DPkg::Lock::Timeout=600 -o Acquire::Retries=3)
    { as_root env DEBIAN_FRONTEND=noninteractive apt-get "${options[@]}" -qq update &&
        as_root env DEBIAN_FRONTEND=noninteractive \
            apt-get "${options[@]}" -qq install --yes --no-install-recommends "${packages[@]}"; } </dev/null >&2 ||
        fail "apt-get could not install ${packages[*]}; its own messages stand above; check the network and run again"
}

# A virtual environment holds absolute paths: a checkout that was moved gets a new one.
install_python_packages() {
    local list=deploy/package/requirements.txt folder=.tools/package-venv wanted
    wanted=$(echo "$PWD"; cat $list)
    if [ "$(cat $folder/installed 2>/dev/null)" != "$wanted" ]; then
        say "installing the Python packages of $list into $folder"
        rm -rf $folder
        python3 -m venv $folder
        $folder/bin/pip install --quiet --disable-pip-version-check --requirement $list </dev/null >&2
        echo "$wanted" >$folder/installed
    fi
}

# Unoptimised, they build in minutes instead of many; their work takes seconds either way.
install_cargo_command() {
    local name=$1 version=$2
    if [ ! -e ".tools/$name-$version" ]; then
        say "building $name $version"
        CARGO_TARGET_DIR=.tools/build-package CARGO_PROFILE_DEV_DEBUG=0 \
            cargo install "$name" --version "=$version" --locked --debug --force --quiet --root .tools >&2
        rm -rf .tools/build-package .tools/"$name"-*
        touch ".tools/$name-$version"
    fi
}

# From a newer Debian than this machine's, without installing it; its programs are linked statically.
install_qemu() {
    local have
    have=$( { qemu-aarch64 --version 2>/dev/null || true; } | sed -n 's/.*version \([0-9]*\).*/\1/p')
    [ "${have:-0}" -lt "$qemu_at_least" ] || return 0
    say "fetching qemu-user of Debian $qemu_suite into .tools"
    local apt=$PWD/.tools/apt site
    site=$(apt-get indextargets --format '$(SITE) $(CODENAME) $(COMPONENT)' 'Created-By: Packages' |
        awk '$1 ~ /debian\/?$/ && $3 == "main" { print $1; exit }')
    [ -n "$site" ] || fail "no Debian archive among this machine's apt sources; install qemu-user $qemu_at_least or later by hand"
    rm -rf "$apt" && mkdir -p "$apt/lists/partial" "$apt/cache/archives/partial" "$apt/parts"
    echo "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] $site $qemu_suite main" >"$apt/sources.list"
    local options=(-o Dir::Etc::sourcelist="$apt/sources.list" -o Dir::Etc::sourceparts="$apt/parts"
        -o Dir::State::lists="$apt/lists" -o Dir::Cache="$apt/cache" -o APT::Sandbox::User=root)
    { apt-get "${options[@]}" -qq update && (cd "$apt" && apt-get "${options[@]}" -qq download qemu-user); } >&2 ||
        fail "could not fetch qemu-user of Debian $qemu_suite; apt's messages stand above; install qemu-user $qemu_at_least or later by hand"
    dpkg-deb --fsys-tarfile "$apt"/qemu-user_*.deb |
        tar --extract --directory .tools --strip-components=2 ./usr/bin/qemu-aarch64 ./usr/bin/qemu-arm
    rm -rf "$apt"
}

install_targets() {
    local target
    for target in x86_64-unknown-linux-gnu aarch64-unknown-linux-gnu armv7-unknown-linux-gnueabihf; do
        [ -d "$(rustc --print sysroot)/lib/rustlib/$target/lib" ] && continue
        say "adding the standard library for $target"
        { command -v rustup && rustup target add "$target"; } >&2 ||
            say "no standard library for $target; its packages cannot be built here (docs/development.md#the-standard-library-of-other-targets)"
    done
}

mkdir -p .tools
exec 9>.tools/lock-package
flock 9

mapfile -t packages < <(missing_packages)
if [ ${#packages[@]} -gt 0 ]; then
    install_packages
    mapfile -t packages < <(missing_packages)
    [ ${#packages[@]} = 0 ] || fail "still missing after the installation: ${packages[*]}"
fi
install_targets
install_python_packages
install_qemu
install_cargo_command cargo-deb $cargo_deb
install_cargo_command cargo-cyclonedx $cargo_cyclonedx
