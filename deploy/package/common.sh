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

# Has the kernel run programs of that architecture by qemu; `end_emulation` takes that back. Needs root.
HANDLER=
emulate() {
    local cpu class machine folder=/proc/sys/fs/binfmt_misc
    case $1 in
        "$(dpkg --print-architecture)") return ;;
        arm64) cpu=aarch64 class='\x02' machine='\xb7' ;;
        armhf) cpu=arm class='\x01' machine='\x28' ;;
        *) fail "no emulator for \"$1\"" "$0" "test it on such a machine" ;;
    esac
    [ -e $folder/register ] || mount -t binfmt_misc binfmt_misc $folder ||
        fail "the kernel cannot run foreign programs" "$folder" "load binfmt_misc, or test $1 on such a machine"
    # One of Debian's packages is as good.
    [ ! -e "$folder/qemu-$cpu" ] || return 0
    printf ':qemu-%s:M::%s:%s:%s:F' "$cpu" \
        "\\x7fELF$class\\x01\\x01\\x00\\x00\\x00\\x00\\x00\\x00\\x00\\x00\\x00\\x02\\x00$machine\\x00" \
        '\xff\xff\xff\xff\xff\xff\xff\x00\xff\xff\xff\xff\xff\xff\xff\xff\xfe\xff\xff\xff' \
        "$(command -v "qemu-$cpu")" >$folder/register
    HANDLER=$folder/qemu-$cpu
}

end_emulation() {
    [ -z "$HANDLER" ] || echo -1 >"$HANDLER"
    HANDLER=
}

# A pre-release sorts before its release: 1.0.0-rc.1 is 1.0.0~rc.1.
debian_version() {
    version | sed 's/-/~/'
}
