#!/bin/bash
# Runs inside the booted container; see package.sh.
set -euo pipefail
export DEBIAN_FRONTEND=noninteractive PATH=/usr/sbin:/usr/bin:/sbin:/bin LC_ALL=C.UTF-8
cd /packages
pin=/etc/systemd/system/drivegate.service.d/previous-version.conf
previous=/usr/lib/drivegate/previous
package=$(ls drivegate_*.deb)

ended() {
    [ "$1" != 0 ] || return 0
    echo "FAILED with $1: $2"
    systemctl status --no-pager --lines=0 drivegate || true
    journalctl --no-pager --unit drivegate | tail -n 20
}
trap 'ended $? "$BASH_COMMAND"' EXIT

step() { echo "--- $*"; }
pid() { systemctl show --property=MainPID --value drivegate; }
# On an emulated processor the kernel runs the emulator, whose first argument is the program.
program() {
    local exe arguments
    exe=$(readlink "/proc/$(pid)/exe")
    mapfile -d '' -t arguments <"/proc/$(pid)/cmdline"
    case $exe in
    */qemu-*) echo "${arguments[1]}" ;;
    *) echo "$exe" ;;
    esac
}
installed() { dpkg-query --showformat='${db:Status-Abbrev}${Version}' --show drivegate; }
contains() { grep --quiet --fixed-strings -- "$2" <<<"$1" || { echo "no \"$2\" in: $1"; return 1; }; }
until_true() {
    local i
    for i in {1..120}; do
        if "$@"; then return 0; fi
        sleep 0.5
    done
    echo "not within a minute: $*"
    return 1
}
online() { drivegate read pump-1 ready >/dev/null 2>&1; }
online_previous() { $previous read pump-1 ready >/dev/null 2>&1; }
# `!` would not end the script.
not() { if "$@" >/dev/null 2>&1; then echo "unexpected success: $*"; return 1; fi; }
other_pid() { local now; now=$(pid); [ "$now" != 0 ] && [ "$now" != "$1" ]; }
# A simulated drive, on a copy of the program that no package touches.
simulate() {
    cp /usr/bin/drivegate /run/simulator
    systemd-run --quiet --unit=simulator /run/simulator simulate --profile vacon-nx --addresses 1 --link /run/line1
    until_true test -e /run/line1
    chmod 666 "$(readlink --canonicalize /run/line1)"
}

step "a new installation is not started and says what to do"
printed=$(apt-get install --quiet --yes "./$package" 2>&1)
contains "$printed" "installed and not started"
contains "$printed" "systemctl enable --now drivegate"
not systemctl --quiet is-active drivegate
not systemctl --quiet is-enabled drivegate
[ -z "$(dpkg --verify drivegate)" ]
for file in /usr/share/man/man1/drivegate.1.gz /usr/share/man/man1/drivegate-run.1.gz \
    /usr/share/bash-completion/completions/drivegate /usr/lib/udev/rules.d/99-drivegate.rules; do
    [ -e "$file" ]
done
bash -n /usr/share/bash-completion/completions/drivegate

step "configured, enabled, started: the drive is online"
simulate
cp drivegate.toml /etc/drivegate/drivegate.toml
drivegate check | tail -n 1
systemctl enable --quiet --now drivegate
until_true online
edited=$(md5sum /etc/drivegate/drivegate.toml)

step "the journal has version, commit, fields and priorities"
first=$(journalctl --no-pager --unit drivegate --identifier drivegate --output cat | head -n 1)
contains "$first" "drivegate is starting version=\"$(drivegate --version | sed 's/^drivegate //')\""
contains "$(journalctl --no-pager --unit drivegate DRIVE=pump-1)" "pump-1"
sed -i 's/^cycle = .*/&\nresponse_timeout = "20s"/' /etc/drivegate/drivegate.toml
systemctl restart drivegate
until_true online
contains "$(journalctl --no-pager --unit drivegate --priority warning)" "5s is used"

step "a key that only the group of the service reads, word for word as the pages say; renewed by a reload"
recipe=$(sed -n '/^### Certificates and keys/,/^### /p' /usr/share/doc/drivegate/installation.md | sed -n '/^```sh$/,/^```$/p' | sed '1d;$d')
contains "$recipe" "groupadd --system drivegate-keys"
cp gateway.crt gateway.key /etc/drivegate/
chmod 600 /etc/drivegate/gateway.key
printf 'certificate = "gateway.crt"\nkey = "gateway.key"\n' >>/etc/drivegate/drivegate.toml
printed=$(drivegate check --as-service 2>&1) && false
contains "$printed" "the service could not read /etc/drivegate/gateway.key"
bash -euxc "$recipe"
until_true online
drivegate health --url https://127.0.0.1:9488 --ca /etc/drivegate/gateway.crt
cp renewed.crt /etc/drivegate/gateway.crt
cat renewed.key >/etc/drivegate/gateway.key
drivegate reload
drivegate health --url https://127.0.0.1:9488 --ca /etc/drivegate/gateway.crt
cp drivegate.toml /etc/drivegate/drivegate.toml
rm -r /etc/drivegate/gateway.* /etc/systemd/system/drivegate.service.d/keys.conf
groupdel drivegate-keys
systemctl daemon-reload
systemctl restart drivegate
until_true online

step "a newer version takes over"
before=$(pid)
dpkg --install newer.deb
[ "$(installed)" = "ii 99.0.1" ]
[ "$(pid)" != "$before" ]
[ "$(program)" = /usr/bin/drivegate ]
[ ! -e $pin ]
[ ! -e $previous ]
until_true online

step "a version that refuses the configuration is not started; the former goes on"
before=$(pid)
printed=$(dpkg --force-confold --install choosy.deb 2>&1)
echo "$printed" | grep -v '^(Reading'
contains "$printed" "error: unknown key"
contains "$printed" "was NOT started"
contains "$printed" "dpkg-reconfigure drivegate"
[ "$(installed)" = "ii 99.0.2" ]
[ "$(pid)" = "$before" ]
online_previous

step "also when it crashes, and when the service is restarted"
kill -KILL "$before"
until_true other_pid "$before"
until_true systemctl --quiet is-active drivegate
[ "$(program)" = $previous ]
systemctl restart drivegate
[ "$(program)" = $previous ]
until_true online_previous

step "an upgrade to the same refusal keeps the version that works"
dpkg --install choosy.deb
[ "$(program)" = $previous ]
$previous check | tail -n 1

step "the configuration is corrected: dpkg-reconfigure starts the new version"
touch /etc/drivegate/corrected
dpkg-reconfigure drivegate
[ "$(program)" = /usr/lib/drivegate-choosy/drivegate ]
[ ! -e $pin ]
[ ! -e $previous ]
until_true online

step "a downgrade is an upgrade"
dpkg --install newer.deb
[ "$(installed)" = "ii 99.0.1" ]
[ "$(program)" = /usr/bin/drivegate ]

step "a version that cannot start gives way to the former"
before=$(pid)
printed=$(dpkg --install broken.deb 2>&1)
echo "$printed" | grep '^drivegate:'
contains "$printed" "does NOT start"
[ "$(program)" = $previous ]
[ "$(pid)" != "$before" ]
until_true online_previous

step "a downgrade from there"
dpkg --install older.deb
[ "$(installed)" = "ii 0.0.1" ]
[ "$(program)" = /usr/bin/drivegate ]
[ ! -e $pin ]
[ ! -e $previous ]
until_true online
[ "$(md5sum /etc/drivegate/drivegate.toml)" = "$edited" ]

step "a stopped gateway stays stopped in an upgrade"
systemctl stop drivegate
dpkg --install "$package"
not systemctl --quiet is-active drivegate
systemctl start drivegate
until_true online

step "a removal leaves configuration, state and whether it is enabled"
mkdir -p /var/lib/private/drivegate
touch /var/lib/private/drivegate/kept
dpkg --remove drivegate
not systemctl --quiet is-active drivegate
[ ! -e /usr/bin/drivegate ]
[ ! -e /usr/lib/drivegate ]
[ "$(md5sum /etc/drivegate/drivegate.toml)" = "$edited" ]
[ -e /var/lib/private/drivegate/kept ]
dpkg --install "$package"
[ "$(systemctl is-enabled drivegate)" = enabled ]
systemctl start drivegate
until_true online

step "a purge leaves nothing"
dpkg --purge drivegate
systemctl stop simulator
left=$(find / -xdev -path /packages -prune -o -name '*drivegate*' -print | grep -v '^/var/log/' || true)
[ -z "$left" ] || { echo "left: $left"; false; }
not dpkg-query --show drivegate

step "done"
