# Sourced by the scripts of this folder, from the root of the repository.

# The tools are in .tools; see tools.sh.
export PATH="$PWD/.tools/package-venv/bin:$PWD/.tools/bin:$PATH:/usr/sbin:/sbin"

# Binaries that ship have a target directory of their own: other flags would rebuild everything in the common one.
TARGET_FOLDER=$PWD/target/package
# What is built carries the time of the commit.
SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct)}
export SOURCE_DATE_EPOCH
export TZ=UTC LC_ALL=C.UTF-8
umask 022

fail() {
    echo "error: $1; $2; $3" >&2
    exit 1
}

version() {
    sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -1
}

# The commit, with "-dirty" if the tree differs from it; a build without the repository is told.
commit() {
    echo "${DRIVEGATE_COMMIT:-$(git describe --always --dirty --abbrev=12 --exclude='*')}"
}

rust_target() {
    case $1 in
        amd64) echo x86_64-unknown-linux-gnu ;;
        arm64) echo aarch64-unknown-linux-gnu ;;
        armhf) echo armv7-unknown-linux-gnueabihf ;;
        *) fail "unknown architecture \"$1\"" "the command line" "amd64, arm64 or armhf" ;;
    esac
}

# The oldest glibc that the dynamic binary runs with.
libc_version() {
    case $1 in
        amd64) echo 2.28 ;;
        *) echo 2.24 ;;
    esac
}

ARCHITECTURES=(amd64 arm64 armhf)
# Where finished files go.
DIST=${DIST:-dist}

# A pre-release sorts before its release: 1.0.0-rc.1 is 1.0.0~rc.1.
debian_version() {
    version | sed 's/-/~/'
}
