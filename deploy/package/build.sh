#!/usr/bin/env bash
# Builds one release binary that does not depend on where it was built, and prints its path.
#   deploy/package/build.sh ARCHITECTURE LINKAGE
# ARCHITECTURE: amd64, arm64, armhf. LINKAGE: dynamic (for an old glibc) or static.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
source deploy/package/common.sh

architecture=${1:?architecture: amd64, arm64 or armhf}
linkage=${2:?linkage: dynamic or static}
target=$(rust_target "$architecture")

[ -d "$(rustc --print sysroot)/lib/rustlib/$target/lib" ] ||
    fail "no Rust standard library for $target" "$(rustc --version)" \
        "run \`rustup target add $target\`; other ways are in CONTRIBUTING.md#the-standard-library-of-other-targets"

# Panic messages name source files: they are named alike whatever folder the tree, the registry and the target
# directory are in. The last prefix that fits counts.
folder=$TARGET_FOLDER/$linkage
flags="--remap-path-prefix=${CARGO_HOME:-$HOME/.cargo}=/cargo"
flags+=" --remap-path-prefix=$(rustc --print sysroot)=/rust"
flags+=" --remap-path-prefix=$PWD=/drivegate --remap-path-prefix=$folder=/target"
case $linkage in
    dynamic) build=(zigbuild --target "$target.$(libc_version "$architecture")") ;;
    static)
        flags+=" -C target-feature=+crt-static"
        build=(build --target "$target")
        # Debian's cross compilers, which bring a static glibc.
        [ "$(uname -m)" = x86_64 ] || export CARGO_TARGET_X86_64_UNKNOWN_LINUX_GNU_LINKER=x86_64-linux-gnu-gcc
        export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc
        export CARGO_TARGET_ARMV7_UNKNOWN_LINUX_GNUEABIHF_LINKER=arm-linux-gnueabihf-gcc
        ;;
    *) fail "unknown linkage \"$linkage\"" "second argument" "dynamic or static" ;;
esac

export CARGO_INCREMENTAL=0 RUSTFLAGS=$flags
export CFLAGS="-ffile-prefix-map=${CARGO_HOME:-$HOME/.cargo}=/cargo -ffile-prefix-map=$folder=/target"
DRIVEGATE_COMMIT=$(commit) cargo "${build[@]}" --release --locked --bin drivegate --target-dir "$folder" >&2
binary=$folder/$target/release/drivegate
echo "$binary"
