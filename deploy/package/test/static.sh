#!/usr/bin/env bash
# Starts the static binary of each architecture: the demo, all drives online, one command. Foreign ones run under qemu.
#   deploy/package/test/static.sh [ARCHITECTURE...]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../../.."
source deploy/package/common.sh

[ $# -gt 0 ] || set -- "${ARCHITECTURES[@]}"
for architecture; do
    program=$(deploy/package/build.sh "$architecture" static)
    ! readelf --dynamic "$program" | grep -q '(NEEDED)' || fail "not static" "$program" "see build.sh"
    emulator=()
    if [ "$architecture" != "$(dpkg --print-architecture)" ]; then
        case $architecture in
            amd64) emulator=(qemu-x86_64) ;;
            arm64) emulator=(qemu-aarch64) ;;
            armhf) emulator=(qemu-arm) ;;
        esac
    fi
    deploy/package/test/demo.py "$program" "${emulator[@]}"
done
