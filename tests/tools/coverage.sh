#!/usr/bin/env bash
# Lines and regions of src that the tests run: coverage.sh [cargo test arguments, such as --lib; default: --lib --tests].
# Needs llvm-profdata and llvm-cov that read what this rustc writes: those of the same LLVM version, or 19 and later.
# (rustup's component llvm-tools, or Debian's package llvm-22 or llvm-19). Ends with the table of files; target/coverage/html shows each line.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."

major=$(rustc -vV | sed -n 's/^LLVM version: \([0-9]*\).*/\1/p')
find_tool() {
    local own
    own=$(rustc --print target-libdir)/../bin/$1
    for tool in "$own" "$1-$major" "$1-22" "$1-21" "$1-20" "$1-19" "/usr/lib/llvm-19/bin/$1"; do
        if command -v "$tool" >/dev/null; then
            echo "$tool"
            return
        fi
    done
    echo "error: no $1 of LLVM $major or 19 and later; apt install llvm-$major, or rustup component add llvm-tools" >&2
    exit 1
}
profdata=${LLVM_PROFDATA:-$(find_tool llvm-profdata)}
cov=${LLVM_COV:-$(find_tool llvm-cov)}

out=$PWD/target/coverage
mkdir -p "$out"
rm -rf "$out/profiles"
cat >"$out/rustc" <<'WRAPPER'
#!/bin/sh
# Only the crate itself is instrumented, not its dependencies.
rustc=$1
shift
exec "$rustc" "$@" -C instrument-coverage
WRAPPER
chmod +x "$out/rustc"

export RUSTC_WORKSPACE_WRAPPER=$out/rustc CARGO_TARGET_DIR=$out/target LLVM_PROFILE_FILE=$out/profiles/%p-%m.profraw
[ $# -gt 0 ] || set -- --lib --tests
objects=()
while read -r program; do
    objects+=(--object "$program")
done < <(cargo test --locked "$@" --no-run --message-format json | sed -n 's/.*"executable":"\([^"]*\)".*/\1/p')
cargo test --locked "$@" --no-fail-fast || echo "coverage: tests failed; what follows is what was run" >&2

"$profdata" merge --sparse --failure-mode=all "$out"/profiles/*.profraw --output "$out/all.profdata"
report=("${objects[@]}" "--instr-profile=$out/all.profdata" "--ignore-filename-regex=/(registry|rustc|tests)/|tests\.rs$")
"$cov" show --format=html "--output-dir=$out/html" "${report[@]}" >/dev/null
"$cov" report "${report[@]}" | sed "s|$PWD/||"
