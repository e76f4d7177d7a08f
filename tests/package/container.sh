#!/usr/bin/env bash
# Builds the container image of a package on a Debian that is given as an archive, and runs it as its
# configuration says: command, user, volume, health check. Pulls nothing.
#
#     tests/package/container.sh DEB BASE.tar
set -euo pipefail
cd "$(dirname "$0")/../.."
work=$(mktemp -d)
# Needs no mounts and no network of its own, so that it also works within a container.
COSEG_BUILDER="buildah --storage-driver vfs --root $work/root --runroot $work/runroot"
export COSEG_BUILDER BUILDAH_ISOLATION=chroot
# shellcheck disable=SC2086 # words of their own
buildah_() { ${builder:-} $COSEG_BUILDER "$@"; }
daemon=
clean() {
    status=$?
    [ "$status" = 0 ] || ! [ -s "$work/log" ] || { echo "the daemon said:" >&2; cat "$work/log" >&2; }
    [ -z "$daemon" ] || kill "$daemon" 2>/dev/null || true
    [ -z "$daemon" ] || wait "$daemon" 2>/dev/null || true
    buildah_ rm --all >/dev/null 2>&1 || true
    rm -rf --one-file-system "$work"
}
trap clean EXIT

base=$(buildah_ from scratch)
buildah_ add -q "$base" "$2" / >/dev/null
buildah_ commit -q "$base" base >/dev/null
buildah_ rm "$base" >/dev/null
packaging/container.sh "$1" coseg localhost/base >"$work/build.log" 2>&1 || { cat "$work/build.log" >&2; exit 1; }

# What a runtime reads of it.
buildah_ inspect --type image coseg >"$work/image.json"
image() { python3 -c "import json,sys; c=json.load(open('$work/image.json'))['Docker']['config']; print($1)"; }
[ "$(image 'c["User"]')" = coseg ]
[ "$(image '*sorted(c["Volumes"])')" = "/run/coseg /var/lib/coseg" ]
[ "$(image 'c["Healthcheck"]["Test"][0]')" = CMD ]
mapfile -t command < <(image '*c["Cmd"], sep="\n"')
mapfile -t health < <(image '*c["Healthcheck"]["Test"][1:], sep="\n"')

# Clients have a container of their own, and share the volumes.
mkdir "$work/library" "$work/run"
container() {
    local name
    name=$(buildah_ from --pull-never coseg)
    # Its own volumes would cover those that are given to it.
    buildah_ config --volume /var/lib/coseg- --volume /run/coseg- "$name"
    echo "$name"
}
client=$(container)
user=$(buildah_ run "$client" -- id -u)
[ "$user" != 0 ]
chown "$user" "$work/library" "$work/run"
in_container() {
    local container=$1
    shift
    buildah_ run --cap-drop all -v "$work/library:/var/lib/coseg" -v "$work/run:/run/coseg" "$container" -- "$@"
}
serve() {
    server=$(container)
    # The builder is what is signalled, and passes the signal on.
    (builder=exec && in_container "$server" "${command[@]}") >"$work/log" 2>&1 &
    daemon=$!
    for _ in $(seq 200); do
        ! grep -q serving "$work/log" || return 0
        sleep 0.05
    done
    cat "$work/log" >&2
    exit 1
}
stop() {
    in_container "$client" coseg stop >"$work/stop.log" 2>&1 || { cat "$work/stop.log" >&2; exit 1; }
    wait "$daemon" || { cat "$work/log" >&2; exit 1; }
    daemon=
    buildah_ rm "$server" >/dev/null
}

serve
in_container "$client" "${health[@]}" >"$work/health.txt"
head -n 1 "$work/health.txt"
in_container "$client" sh -ec 'coseg synth pliers --count 2 --faces 1000 --out /tmp/meshes 2>/dev/null
    coseg add /tmp/meshes --collection pliers --parts 3' >"$work/add.log" 2>&1 || { cat "$work/add.log" >&2; exit 1; }
in_container "$client" coseg labels pliers-001 --collection pliers >"$work/before.txt"
[ "$(stat -c %u "$work/library/library")" = "$user" ]
stop
# Without a daemon it is not healthy.
if in_container "$client" "${health[@]}" >/dev/null 2>&1; then
    echo "it is healthy without a daemon" >&2
    exit 1
fi
# A new container finds the library in the volume.
serve
in_container "$client" coseg labels pliers-001 --collection pliers | cmp - "$work/before.txt"
stop
echo "the container serves as user $user and keeps its library: $(wc -l <"$work/before.txt") labels"
