#!/usr/bin/env bash
# Installs what packaging needs and this machine lacks: Debian packages, Python packages and cargo commands in .tools,
# standard libraries of other targets. Takes a moment when nothing is missing.
#   deploy/package/tools.sh PURPOSE [ARCHITECTURE...]
# PURPOSE: deb, image, release, test-package, test-static, test-image, or all. Only what it needs for these architectures is installed;
# `--print` before it says what that is, and installs nothing.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."

print=
[ "${1:-}" != --print ] || { print=yes; shift; }
purpose=${1:-all}
[ $# = 0 ] || shift
[ $# -gt 0 ] || set -- amd64 arm64 armhf
architectures=("$@")

say() { echo "packaging tools: $*" >&2; }
fail() { echo "error: $*" >&2; exit 1; }

for architecture; do
    case $architecture in
        amd64 | arm64 | armhf) ;;
        *) fail "unknown architecture \"$architecture\"; the command line; amd64, arm64 or armhf" ;;
    esac
done

# What it comes down to: Debian packages, static binaries, images, a release, and their tests.
case $purpose in
    deb) parts="deb" ;;
    image) parts="static image" ;;
    release) parts="deb static image release" ;;
    test-package) parts="deb test-package emulator" ;;
    test-static) parts="static emulator" ;;
    test-image) parts="static image test-image emulator" ;;
    all) parts="deb static image release test-package test-image emulator" ;;
    *) fail "unknown purpose \"$purpose\"; the command line; deb, image, release, test-package, test-static, test-image or all" ;;
esac
is_for() { [[ " $parts " = *" $1 "* ]]; }
has() { [[ " ${architectures[*]} " = *" $1 "* ]]; }
# Whether any of them is not this machine's.
is_foreign() {
    local own architecture
    own=$(dpkg --print-architecture 2>/dev/null || true)
    for architecture in "${architectures[@]}"; do
        [ "$architecture" = "$own" ] || return 0
    done
    return 1
}

# What must be on the PATH (or, with a slash, on disk), and the Debian package that brings it.
needed=(
    "git git"
    "python3 python3"
    "dpkg-deb dpkg"
    "readelf binutils"
)
! is_for image || needed+=("buildah buildah" "/usr/share/ca-certificates/mozilla ca-certificates")
! is_for test-image || needed+=("runc runc" "jq jq")
! is_for test-package || needed+=("lintian lintian" "debootstrap debootstrap" "systemd-nspawn systemd-container")
# Packages are linked by zig, for whatever architecture.
if is_for static && has arm64; then
    needed+=(
        "aarch64-linux-gnu-gcc gcc-aarch64-linux-gnu"
        "/usr/aarch64-linux-gnu/lib/libc.a libc6-dev-arm64-cross"
    )
fi
if is_for static && has armhf; then
    needed+=(
        "arm-linux-gnueabihf-gcc gcc-arm-linux-gnueabihf"
        "/usr/arm-linux-gnueabihf/lib/libc.a libc6-dev-armhf-cross"
    )
fi
cargo_deb=3.8.0
cargo_cyclonedx=0.5.9
# Older ones refuse pseudo-terminals, which the demo needs.
qemu_at_least=8
qemu_suite=trixie
export PATH="$PWD/.tools/bin:$PATH:/usr/sbin:/sbin"

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

targets() {
    ! has amd64 || echo x86_64-unknown-linux-gnu
    ! has arm64 || echo aarch64-unknown-linux-gnu
    ! has armhf || echo armv7-unknown-linux-gnueabihf
}

install_targets() {
    local target
    for target in $(targets); do
        [ -d "$(rustc --print sysroot)/lib/rustlib/$target/lib" ] && continue
        say "adding the standard library for $target"
        { command -v rustup && rustup target add "$target"; } >&2 ||
            say "no standard library for $target; its packages cannot be built here (CONTRIBUTING.md#the-standard-library-of-other-targets)"
    done
}

if [ -n "$print" ]; then
    echo "Debian packages: $(printf '%s\n' "${needed[@]#* }" | sort -u | tr '\n' ' ')"
    echo "Rust targets: $(targets | tr '\n' ' ')"
    ! is_for deb || echo "PyPI: $(tr '\n' ' ' <deploy/package/requirements.txt)"
    ! is_for deb || echo "cargo: cargo-deb $cargo_deb"
    ! is_for release || echo "cargo: cargo-cyclonedx $cargo_cyclonedx"
    if is_for emulator && is_foreign; then echo "Debian $qemu_suite: qemu-user"; fi
    exit 0
fi

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
if is_for deb; then
    install_python_packages
    install_cargo_command cargo-deb $cargo_deb
fi
! is_for release || install_cargo_command cargo-cyclonedx $cargo_cyclonedx
if is_for emulator && is_foreign; then install_qemu; fi
