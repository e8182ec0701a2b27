#!/usr/bin/env bash
# Writes the parts list (SBOM, CycloneDX) of each architecture's program into dist/.
#   deploy/package/sbom.sh [ARCHITECTURE...]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
source deploy/package/common.sh

[ $# -gt 0 ] || set -- "${ARCHITECTURES[@]}"
mkdir -p "$DIST"
for architecture; do
    # Written beside the manifest, which the command allows nowhere else.
    cargo cyclonedx --quiet --format json --spec-version 1.5 --target "$(rust_target "$architecture")" --override-filename sbom
    sed "s,path+file://$PWD,path+file:///drivegate,g" sbom.json >"$DIST/drivegate_$(version)_sbom_$architecture.cdx.json"
    rm sbom.json
done
