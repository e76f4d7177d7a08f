#!/usr/bin/env bash
# Builds the container image of the daemon from a Debian package, with buildah, podman or docker:
#
#     packaging/container.sh DEB [TAG [BASE]]
#
# TAG is `coseg`. BASE is the image of a Debian that is at least as new as the one on which the package
# was built: debian:stable-slim. COSEG_BUILDER names another builder, with its options.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
deb=$1
tag=${2:-coseg}
builder=${COSEG_BUILDER:-}
for found in buildah podman docker; do
    [ -n "$builder" ] || ! command -v "$found" >/dev/null || builder=$found
done
[ -n "$builder" ] || { echo "needs buildah, podman or docker" >&2; exit 1; }
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cp "$deb" "$folder/coseg.deb"
# Only this form of an image has a health check; docker has no other.
case "$builder" in docker*) format= ;; *) format="--format docker" ;; esac
# shellcheck disable=SC2086 # words of their own
$builder build $format ${3:+--build-arg "BASE=$3"} -t "$tag" -f "$here/Containerfile" "$folder"
