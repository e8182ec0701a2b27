#!/usr/bin/env bash
# Builds the image of each architecture into dist/, for `docker load`. No daemon, no base image, nothing emulated.
#   deploy/package/image.sh [ARCHITECTURE...]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
source deploy/package/common.sh

[ $# -gt 0 ] || set -- "${ARCHITECTURES[@]}"
export STORAGE_DRIVER=vfs BUILDAH_ISOLATION=chroot BUILDAH_FORMAT=docker
mkdir -p "$DIST"

# A path on this machine is nobody's business.
source=$(git config --get remote.origin.url || true)
case $source in https://*) ;; *) source=unknown ;; esac

for architecture; do
    tree=$PWD/target/package/image/$architecture
    deploy/package/image-tree.sh "$architecture" "$tree/tree"
    platform=linux/$architecture
    [ "$architecture" != armhf ] || platform=linux/arm/v7
    # The last stage of the Dockerfile, over the tree made here in the place of the first one.
    sed -n '/^FROM scratch/,$p' deploy/Dockerfile >"$tree/Dockerfile"
    name=drivegate:$(version)-$architecture
    buildah build --quiet --pull-never --layers=false --timestamp "$SOURCE_DATE_EPOCH" --platform "$platform" \
        --build-context "build=$tree" --build-arg "VERSION=$(version)" --build-arg "DRIVEGATE_COMMIT=$(commit)" \
        --build-arg "SOURCE=$source" --file "$tree/Dockerfile" --tag "$name" "$tree" >/dev/null
    archive=$DIST/drivegate_$(version)_image_$architecture.tar
    rm -f "$DIST"/drivegate_*_image_"$architecture".tar
    buildah push --quiet "$name" "docker-archive:$archive:drivegate:$(version)"
    deploy/package/same_image.py "$archive"
    buildah rmi --force "$name" >/dev/null
done
