#!/usr/bin/env bash
# Runs the gateway with the real programs of its users: each tests/interop/*.py, or those named (`run.sh node_red`).
# Installs what they need into .tools/interop, starts everything on free ports of 127.0.0.1 and ends it again.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
export PATH="$PATH:/usr/sbin:/sbin"

cargo build --locked
if [ $# -gt 0 ]; then
    checks=("${@/#/tests/interop/}")
    checks=("${checks[@]/%/.py}")
else
    checks=(tests/interop/*.py)
fi
failed=()
for check in "${checks[@]}"; do
    echo "== $check"
    PYTHONPATH=tests/interop/lib PYTHONDONTWRITEBYTECODE=1 python3 "$check" || failed+=("$check")
done
if [ ${#failed[@]} -gt 0 ]; then
    echo "error: failed: ${failed[*]}" >&2
    exit 1
fi
echo "all ${#checks[@]} passed"
