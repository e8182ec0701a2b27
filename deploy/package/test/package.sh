#!/usr/bin/env bash
# Installs, upgrades, downgrades, removes and purges the package in a booted Debian of its architecture, a foreign one under
# qemu. Needs root; the container has no network.
#   deploy/package/test/package.sh PACKAGE
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../../.."
source deploy/package/common.sh

package=$(realpath "${1:?package: a .deb}")
[ "$(id -u)" = 0 ] || fail "not root" "$0" "booting a container needs root"
work=$PWD/target/package
architecture=$(dpkg-deb --field "$package" Architecture)
base=$work/root-base-$architecture
root=$work/root

trap end_emulation EXIT
emulate "$architecture"
lintian --fail-on error,warning --allow-root "$package"

# Boots in a minute; unpacked once.
if [ ! -e "$base/complete" ]; then
    rm -rf "$base"
    debootstrap --arch="$architecture" --variant=minbase --include=systemd,systemd-sysv,dbus,udev,procps bookworm "$base" >"$work/debootstrap.log" ||
        fail "debootstrap failed" "$work/debootstrap.log" "check the network"
    touch "$base/complete"
fi
rm -rf "$root"
cp -a --reflink=auto "$base" "$root"
mkdir "$root/packages"

# A package like the one under test, with another version and, if named, another program in front of the real one.
variant() {
    local name=$1 version=$2 program=${3:-} tree
    tree=$(mktemp -d "$work/variant.XXXXXX")
    dpkg-deb --raw-extract "$package" "$tree"
    sed -i "s/^Version: .*/Version: $version/" "$tree/DEBIAN/control"
    if [ -n "$program" ]; then
        install -D "$tree/usr/bin/drivegate" "$tree/usr/lib/drivegate-$name/drivegate"
        sed "s,REAL,/usr/lib/drivegate-$name/drivegate," "$program" >"$tree/usr/bin/drivegate"
        (cd "$tree" && find usr etc -type f -exec md5sum {} + >DEBIAN/md5sums)
    fi
    dpkg-deb --root-owner-group -Zgzip -z1 --build "$tree" "$root/packages/$name.deb" >/dev/null
    rm -rf "$tree"
}
variant older "0.0.1"
variant newer "99.0.1"
variant choosy "99.0.2" deploy/package/test/choosy.sh
variant broken "99.0.3" deploy/package/test/broken.sh
cp "$package" "$root/packages/$(basename "$package")"
cp deploy/package/test/inside.sh deploy/package/test/drivegate.toml "$root/packages/"
for name in gateway renewed; do
    openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 30 -subj "/CN=$name" \
        -config <(printf "[req]\ndistinguished_name=dn\n[dn]\n") -addext basicConstraints=critical,CA:FALSE \
        -addext subjectAltName=IP:127.0.0.1 -keyout "$root/packages/$name.key" -out "$root/packages/$name.crt" 2>/dev/null
done
cat >"$root/etc/systemd/system/package-test.service" <<'END'
[Unit]
Description=The test of the package
SuccessAction=exit
FailureAction=exit
FailureActionExitStatus=1
[Service]
Type=oneshot
ExecStart=/bin/bash /packages/inside.sh
StandardOutput=file:/packages/log
StandardError=file:/packages/log
[Install]
WantedBy=multi-user.target
END
# What qemu cannot do of the unit: namespaces of their own for a process with threads.
if [ "$architecture" != "$(dpkg --print-architecture)" ]; then
    mkdir "$root/etc/systemd/system/service.d"
    printf '[Service]\nPrivateIPC=no\nPrivateUsers=no\n' >"$root/etc/systemd/system/service.d/emulation.conf"
fi
systemctl --root="$root" --quiet enable package-test.service

status=0
timeout 900 systemd-nspawn --quiet --directory="$root" --boot --register=no --keep-unit --private-network \
    --console=pipe </dev/null >"$work/boot.log" 2>&1 || status=$?
cat "$root/packages/log" 2>/dev/null || true
[ "$status" = 0 ] || fail "the test of the package ended with $status" "$work/boot.log and the lines above" "repair what they name"
