#!/usr/bin/env bash
# Builds the Debian package of each architecture into dist/.
#   deploy/package/deb.sh [ARCHITECTURE...]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
source deploy/package/common.sh

[ $# -gt 0 ] || set -- "${ARCHITECTURES[@]}"
stage=target/package/stage

# What every architecture has in common: manual pages, completions, licences, changelog.
stage_common() {
    rm -rf "$stage"
    mkdir -p "$stage" "$DIST"
    cargo run --quiet --locked --example manual -- "$stage"
    local targets=() architecture
    for architecture in "${ARCHITECTURES[@]}"; do targets+=("$(rust_target "$architecture")"); done
    deploy/package/licences.py "${targets[@]}" >"$stage/third-party-licences.txt"
    gzip --best --no-name >"$stage/changelog.gz" <<END
drivegate ($(debian_version)) stable; urgency=medium

  * What has changed is in CHANGELOG.md.

 -- $(sed -n 's/^maintainer = "\(.*\)"$/\1/p' Cargo.toml)  $(date --utc --rfc-email --date="@$SOURCE_DATE_EPOCH")
END
}

# The newest version of glibc that the program asks for must be one that the package asks for.
check_libc() {
    local program=$1 architecture=$2 asked
    asked=$(readelf --version-info --wide "$program" | grep -o 'GLIBC_[0-9.]*' | sort -uV | tail -1) ||
        fail "the program names no version of glibc" "$program" "the package is for a dynamic one; build it with build.sh"
    [ "$(printf '%s\n' "GLIBC_$(libc_version "$architecture")" "$asked" | sort -V | tail -1)" = "GLIBC_$(libc_version "$architecture")" ] ||
        fail "the program needs $asked" "$program" "it must run with glibc $(libc_version "$architecture"); build it with build.sh"
    local libraries
    libraries=$(readelf --dynamic "$program" | sed -n 's/.*(NEEDED).*\[\(.*\)\]/\1/p' | grep -Ev '^(libc|libm|libpthread|libdl|librt|libutil|ld-linux.*)\.so' || true)
    [ -z "$libraries" ] || fail "the program needs $libraries" "$program" "the package depends on libc6 only"
}

pack() {
    local architecture=$1 program variant=()
    program=$(deploy/package/build.sh "$architecture" dynamic)
    check_libc "$program" "$architecture"
    install -m 755 "$program" "$stage/drivegate"
    rm -f "$DIST"/drivegate_*_"$architecture".deb
    [ "$architecture" != amd64 ] || variant=(--variant amd64)
    cargo deb --quiet --locked --no-build --no-strip --target "$(rust_target "$architecture")" "${variant[@]}" \
        --deb-version "$(debian_version)" --output "$DIST/drivegate_$(debian_version)_$architecture.deb"
}

stage_common
for architecture; do pack "$architecture"; done
