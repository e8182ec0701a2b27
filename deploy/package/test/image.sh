#!/usr/bin/env bash
# Runs the image of this machine's architecture by runc, as the compose file does: no capabilities, read-only root, user
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
for label in version revision source title licenses; do
    check ".config.Labels[\"org.opencontainers.image.$label\"] | length > 0"
done
check ".config.Labels[\"org.opencontainers.image.version\"] == \"$(version)\""

jq -r '.[0].Layers[]' "$work/archive/manifest.json" | while read -r layer; do
    tar --extract --file "$work/archive/$layer" --directory "$work/bundle/rootfs"
done
shells=$(find "$work/bundle/rootfs" -type f -perm /111 ! -path "$work/bundle/rootfs/drivegate")
[ -z "$shells" ] || fail "the image contains other programs" "$shells" "it must contain only /drivegate"
[ "$(stat -c %u "$work/bundle/rootfs/var/lib/drivegate")" = 65532 ] || fail "the state directory is not the user's" "$archive" "see deploy/Dockerfile"

# A gateway whose port does not exist (yet): it runs, and it is not ready.
sed 's,^port = .*,port = "/host/dev/serial/absent",' deploy/package/test/drivegate.toml >"$work/configuration/drivegate.toml"
jq --null-input --arg configuration "$work/configuration" --argjson settings "$(jq .config "$settings")" '{
    ociVersion: "1.0.2",
    process: {
        user: {uid: 65532, gid: 65532}, cwd: "/", noNewPrivileges: true, env: ["PATH=/"],
        args: ($settings.Entrypoint + $settings.Cmd),
        capabilities: {bounding: [], effective: [], permitted: []},
        rlimits: [{type: "RLIMIT_RTPRIO", hard: 10, soft: 10}]
    },
    root: {path: "rootfs", readonly: true},
    mounts: [
        {destination: "/proc", type: "proc", source: "proc"},
        {destination: "/etc/drivegate", type: "bind", source: $configuration, options: ["bind", "ro"]},
        {destination: "/run/drivegate", type: "tmpfs", source: "tmpfs", options: ["uid=65532", "gid=65532", "mode=0755"]},
        {destination: "/var/lib/drivegate", type: "tmpfs", source: "tmpfs", options: ["uid=65532", "gid=65532", "mode=0700"]}
    ],
    linux: {namespaces: [{type: "pid"}, {type: "mount"}, {type: "ipc"}, {type: "uts"}, {type: "network"}]}
}' >"$work/bundle/config.json"

runc="runc --root $work/state"
trap '$runc delete --force $container 2>/dev/null || true' EXIT
$runc run --detach --bundle "$work/bundle" $container </dev/null >"$work/log" 2>&1 ||
    fail "runc does not start it: $(cat "$work/log")" "$archive" "repair what it names"
inside() { $runc exec --user 65532:65532 $container /drivegate "$@"; }
for _ in {1..120}; do
    status=0
    inside health --config /etc/drivegate/drivegate.toml >"$work/health" 2>&1 || status=$?
    # 1: it answers and is not ready, because the port is absent.
    if [ $status = 1 ] && grep -q 'line1' "$work/health"; then break; fi
    sleep 0.5
done
[ $status = 1 ] || fail "health ended with $status: $(cat "$work/health")" "$archive; $work/log" "a gateway without its port must not be ready"
inside profiles | grep -q vacon-nx || fail "no profiles" "$archive" "see $work/log"
$runc kill $container TERM
for _ in {1..120}; do
    [ "$($runc state $container | jq -r .status)" != stopped ] || break
    sleep 0.5
done
[ "$($runc state $container | jq -r .status)" = stopped ] || fail "it does not stop on SIGTERM" "$archive" "see $work/log"
echo "$(basename "$archive"): runs by runc without capabilities as 65532 on a read-only root; health, profiles and SIGTERM work"
