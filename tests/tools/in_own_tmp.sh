#!/usr/bin/env bash
# Runs a command with a directory for temporary files of its own, which is removed however the command ends; what an earlier run left
# that was itself killed goes, too.
#   tests/tools/in_own_tmp.sh COMMAND...
set -euo pipefail

base=${TMPDIR:-/tmp}
for left in "$base"/drivegate-test-*; do
    owner=${left##*-}
    if [ -O "$left" ] && [[ $owner =~ ^[0-9]+$ ]] && ! kill -0 "$owner" 2>/dev/null; then
        # What a child of it is just writing makes the first try fail.
        rm -rf "$left" 2>/dev/null || { sleep 0.5 && rm -rf "$left"; }
    fi
done
own=$base/drivegate-test-$$
mkdir "$own"
trap 'rm -rf "$own"' EXIT
trap 'exit 130' INT
trap 'exit 143' TERM HUP
status=0
TMPDIR=$own "$@" || status=$?
left=$(ls -A "$own")
[ -z "$left" ] || echo "left in the directory for temporary files, and removed: $(echo $left | head -c 500)" >&2
exit $status
