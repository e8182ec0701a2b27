#!/usr/bin/env bash
# Makes the files of the image: FOLDER/image, which belongs to root, and FOLDER/owned, which belongs to user 65532.
#   deploy/package/image-tree.sh ARCHITECTURE FOLDER
# ARCHITECTURE: amd64, arm64, armhf; Docker's arm is armhf.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
source deploy/package/common.sh

architecture=${1:?architecture: amd64, arm64 or armhf}
[ "$architecture" != arm ] || architecture=armhf
folder=${2:?folder}
# The certificates of Debian's package; not those that this machine trusts besides.
certificates=/usr/share/ca-certificates/mozilla
[ -d $certificates ] || fail "no CA certificates" "$certificates" "install ca-certificates"

program=$(deploy/package/build.sh "$architecture" static)
rm -rf "$folder"
mkdir -p "$folder"/image/etc/{drivegate,ssl/certs} "$folder"/owned/{var/lib,run}/drivegate
install -d -m 1777 "$folder/image/tmp"
install -m 755 "$program" "$folder/image/drivegate"
install -m 644 LICENSE-MIT LICENSE-APACHE "$folder/image/"
deploy/package/licences.py "$(rust_target "$architecture")" >"$folder/image/third-party-licences.txt"
cat $certificates/*.crt >"$folder/image/etc/ssl/certs/ca-certificates.crt"
echo 'drivegate:x:65532:65532::/:/drivegate' >"$folder/image/etc/passwd"
echo 'drivegate:x:65532:' >"$folder/image/etc/group"
echo 'hosts: files dns' >"$folder/image/etc/nsswitch.conf"
find "$folder" -exec touch --no-dereference --date="@$SOURCE_DATE_EPOCH" {} +
