#!/usr/bin/env bash
# Installs mdbook, which `make book` needs and no test, into .tools. Unoptimised: it builds in a minute on two cores, and a
# book takes it seconds either way.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
mdbook=0.4.52

mkdir -p .tools
exec 9>.tools/lock
flock 9
if [ "$(.tools/bin/mdbook --version 2>/dev/null)" != "mdbook v$mdbook" ]; then
    echo "tools: building mdbook $mdbook, about a minute" >&2
    CARGO_TARGET_DIR=.tools/build-mdbook CARGO_PROFILE_DEV_DEBUG=0 \
        cargo install mdbook --version "=$mdbook" --locked --debug --force --quiet \
        --no-default-features --features search --root .tools
    rm -rf .tools/build-mdbook
fi
