#!/usr/bin/env bash
# Makes everything that a release consists of in dist/: packages, static binaries, images, SBOM, licences, checksums.
#   deploy/package/release.sh [ARCHITECTURE...]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
source deploy/package/common.sh

[ $# -gt 0 ] || set -- "${ARCHITECTURES[@]}"
[ -z "$(git status --porcelain)" ] ||
    fail "the tree differs from the commit that the release would name" "$(git status --porcelain | head -3)" "commit or remove the changes"

rm -rf "$DIST"
mkdir -p "$DIST"
deploy/package/deb.sh "$@"
for architecture; do
    install -m 755 "$(deploy/package/build.sh "$architecture" static)" "$DIST/drivegate_$(version)_static_$architecture"
done
deploy/package/image.sh "$@"
deploy/package/sbom.sh "$@"
install -m 644 target/package/stage/third-party-licences.txt "$DIST/drivegate_$(version)_third-party-licences.txt"
(cd "$DIST" && sha256sum drivegate_* >SHA256SUMS)
(cd "$DIST" && ls -l)
