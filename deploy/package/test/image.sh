#!/usr/bin/env bash
# Runs the image by runc, one of a foreign architecture under qemu, as the compose file does: no capabilities, read-only root, user
# 65532, only what is mounted is writable. Needs root.
#   deploy/package/test/image.sh ARCHIVE
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../../.."
source deploy/package/common.sh

archive=$(realpath "${1:?archive: the .tar of the image}")
[ "$(id -u)" = 0 ] || fail "not root" "$0" "runc needs root"
work=$PWD/target/package/run
container=drivegate-test-$$
rm -rf "$work"
mkdir -p "$work"/{archive,bundle/rootfs,configuration}
tar --extract --file "$archive" --directory "$work/archive"

# What the image promises.
settings=$work/archive/$(jq -r '.[0].Config' "$work/archive/manifest.json")
check() {
    jq --exit-status "$1" "$settings" >/dev/null || fail "the image does not fulfil $1" "$archive" "repair deploy/Dockerfile"
}
check '.config.User == "65532:65532"'
check '.config.Entrypoint == ["/drivegate"]'
check '.config.Healthcheck.Test == ["CMD", "/drivegate", "health", "--config", "/etc/drivegate/drivegate.toml"]'
check '.config.Env | contains(["MALLOC_ARENA_MAX=1", "GLIBC_TUNABLES=glibc.malloc.tcache_count=0"])'
for label in version revision source title licenses; do
    check ".config.Labels[\"org.opencontainers.image.$label\"] | length > 0"
done
check ".config.Labels[\"org.opencontainers.image.version\"] == \"$(version)\""

jq -r '.[0].Layers[]' "$work/archive/manifest.json" | while read -r layer; do
    tar --extract --file "$work/archive/$layer" --directory "$work/bundle/rootfs"
done
[ -s "$work/bundle/rootfs/third-party-licences.txt" ] || fail "the image has no licences of its crates" "$archive" "see image-tree.sh"
shells=$(find "$work/bundle/rootfs" -type f -perm /111 ! -path "$work/bundle/rootfs/drivegate")
[ -z "$shells" ] || fail "the image contains other programs" "$shells" "it must contain only /drivegate"
[ "$(stat -c %u "$work/bundle/rootfs/var/lib/drivegate")" = 65532 ] || fail "the state directory is not the user's" "$archive" "see deploy/Dockerfile"

# The drive is simulated outside, by the same program; its line is the only device that the container is given.
simulator=
stop() {
    $runc delete --force $container 2>/dev/null || true
    [ -z "$simulator" ] || kill "$simulator" 2>/dev/null || true
    end_emulation
}
runc="runc --root $work/state"
trap stop EXIT
case $(jq -r '.architecture + (.variant // "")' "$settings") in
    armv7) emulate armhf ;;
    *) emulate "$(jq -r .architecture "$settings")" ;;
esac
"$work/bundle/rootfs/drivegate" simulate --profile vacon-nx --addresses 1 --link "$work/line" >"$work/simulator" 2>&1 &
simulator=$!
for _ in {1..120}; do
    [ ! -e "$work/line" ] || break
    sleep 0.5
done
line=$(realpath "$work/line")
chmod 666 "$line"
sed 's,^port = .*,port = "/host/line",' deploy/package/test/drivegate.toml >"$work/configuration/drivegate.toml"
mkdir -p "$work/bundle/rootfs/host"
touch "$work/bundle/rootfs/host/line"
jq --null-input --arg configuration "$work/configuration" --arg line "$line" --argjson settings "$(jq .config "$settings")" '{
    ociVersion: "1.0.2",
    process: {
        user: {uid: 65532, gid: 65532}, cwd: "/", noNewPrivileges: true, env: (["PATH=/"] + ($settings.Env // [])),
        args: ($settings.Entrypoint + $settings.Cmd),
        capabilities: {bounding: [], effective: [], permitted: []}
    },
    root: {path: "rootfs", readonly: true},
    mounts: [
        {destination: "/proc", type: "proc", source: "proc"},
        {destination: "/etc/drivegate", type: "bind", source: $configuration, options: ["bind", "ro"]},
        {destination: "/host/line", type: "bind", source: $line, options: ["bind", "rw"]},
        {destination: "/run/drivegate", type: "tmpfs", source: "tmpfs", options: ["uid=65532", "gid=65532", "mode=0755"]},
        {destination: "/var/lib/drivegate", type: "tmpfs", source: "tmpfs", options: ["uid=65532", "gid=65532", "mode=0700"]}
    ],
    linux: {namespaces: [{type: "pid"}, {type: "mount"}, {type: "ipc"}, {type: "uts"}, {type: "network"}]}
}' >"$work/bundle/config.json"

$runc run --detach --bundle "$work/bundle" $container </dev/null >"$work/log" 2>&1 ||
    fail "runc does not start it: $(cat "$work/log")" "$archive" "repair what it names"
inside() { $runc exec --user 65532:65532 $container /drivegate "$@"; }
# What HEALTHCHECK runs, and the same against a port where nobody listens.
mapfile -t health < <(jq -r '.config.Healthcheck.Test[2:][]' "$settings")
for _ in {1..120}; do
    status=0
    inside "${health[@]}" >"$work/health" 2>&1 || status=$?
    [ $status != 0 ] || break
    sleep 0.5
done
[ $status = 0 ] || fail "health ended with $status: $(cat "$work/health")" "$archive" "see $work/log"
status=0
inside health --url http://127.0.0.1:1 >"$work/health" 2>&1 || status=$?
[ $status = 1 ] || fail "health without a gateway ended with $status: $(cat "$work/health")" "$archive" "it must be 1"
inside profiles | grep -q vacon-nx || fail "no profiles" "$archive" "see $work/log"
$runc kill $container TERM
for _ in {1..120}; do
    [ "$($runc state $container | jq -r .status)" != stopped ] || break
    sleep 0.5
done
[ "$($runc state $container | jq -r .status)" = stopped ] || fail "it does not stop on SIGTERM" "$archive" "see $work/log"
echo "$(basename "$archive"): runs by runc without capabilities as 65532 on a read-only root; health, profiles and SIGTERM work"
