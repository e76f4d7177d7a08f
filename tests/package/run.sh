#!/usr/bin/env bash
# Installs the package in a Debian of its own, starts the daemon as its unit would, upgrades, removes and purges
# it. Needs root; makes the Debian with debootstrap in a folder, which has no service manager: what the unit
# says is done by hand here, with its user, folders and umask. COSEG_DEBIAN names a folder that keeps the Debian.
set -euo pipefail
cd "$(dirname "$0")/../.."
[ "$(id -u)" = 0 ] || { echo "needs root" >&2; exit 1; }
command -v cargo-deb >/dev/null || cargo install cargo-deb --locked --quiet
if ! command -v debootstrap >/dev/null; then
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends debootstrap >/dev/null
fi
step() { printf '\n== %s (%ss)\n' "$1" "$SECONDS"; }
if ! command -v buildah >/dev/null; then
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends buildah >/dev/null || true
fi

work=$(mktemp -d)
root="$work/root"
daemon=
clean() {
    [ -z "$daemon" ] || kill "$daemon" 2>/dev/null || true
    if mountpoint -q "$root/proc"; then umount "$root/proc"; fi
    rm -rf --one-file-system "$work"
}
trap clean EXIT

step "two packages"
packaging/build.sh --fast --output "$work/old.deb"
packaging/build.sh --fast --deb-version 9.9.9-1 --output "$work/new.deb"
dpkg-deb --field "$work/new.deb" Version

step "a Debian"
release=$(. /etc/os-release && echo "$VERSION_CODENAME")
if [ -n "${COSEG_DEBIAN:-}" ] && [ -d "$COSEG_DEBIAN" ]; then
    cp -a "$COSEG_DEBIAN" "$root"
else
    debootstrap --variant=minbase --include=init-system-helpers,libstdc++6,procps,systemd "$release" "$root" \
        >"$work/debootstrap.log" 2>&1 || { tail "$work/debootstrap.log" >&2; exit 1; }
    [ -z "${COSEG_DEBIAN:-}" ] || cp -a "$root" "$COSEG_DEBIAN"
fi
# The base of the container, before anything is installed.
! command -v buildah >/dev/null || tar -C "$root" --one-file-system -cf "$work/base.tar" .
mount -t proc proc "$root/proc"
in_root() { env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin DEBIAN_FRONTEND=noninteractive chroot "$root" "$@"; }
cp "$work"/{old,new}.deb "$root/"

as_service() {
    # What the unit says: User, RuntimeDirectory, StateDirectory, UMask, ExecStart.
    # `exec`, so that the daemon itself is what is signalled.
    (exec env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin chroot "$root" sh -ec '
        install -d -o coseg -g coseg -m 0750 /run/coseg
        install -d -o coseg -g coseg -m 0700 /var/lib/coseg
        umask 0077
        exec setpriv --reuid coseg --regid coseg --clear-groups --no-new-privs --inh-caps=-all \
            env RUNTIME_DIRECTORY=/run/coseg STATE_DIRECTORY=/var/lib/coseg NO_COLOR=1 \
            $(sed -n "s/^ExecStart=//p" /usr/lib/systemd/system/coseg.service)') >"$work/log" 2>&1 &
    daemon=$!
    for _ in $(seq 200); do
        grep -q serving "$work/log" && return
        sleep 0.05
    done
    cat "$work/log" >&2
    exit 1
}
stop_service() {
    kill -TERM "$daemon"
    wait "$daemon" || { cat "$work/log" >&2; exit 1; }
    daemon=
}
# A member of the group is let in; nobody else is.
as_member() {
    in_root setpriv --reuid nobody --regid coseg --clear-groups \
        env COSEG_ENDPOINT=ipc:///run/coseg/coseg.sock coseg --timeout 60 "$@"
}

step "install"
in_root dpkg -i /old.deb >"$work/install.log" 2>&1 || { cat "$work/install.log" >&2; exit 1; }
in_root getent passwd coseg
[ "$(stat -c '%U %a' "$root/usr/bin/coseg")" = "root 755" ]
[ -L "$root/etc/systemd/system/multi-user.target.wants/coseg.service" ]
[ "$(in_root stat -c '%U:%G %a' /var/lib/coseg)" = "coseg:coseg 700" ]
in_root coseg --version
in_root env STATE_DIRECTORY=/var/lib/coseg coseg config check --config /etc/coseg/coseg.toml
in_root systemd-analyze verify /usr/lib/systemd/system/coseg.service
# Manual pages and completions are there if the binary can make them.
if in_root coseg man --help >/dev/null 2>&1; then
    ls "$root"/usr/share/man/man1/coseg*.gz | head -n 1
    ls "$root/usr/share/bash-completion/completions/coseg"
fi

step "serve, as the unit would"
as_service
in_root coseg synth pliers --count 2 --faces 1000 --out /meshes >/dev/null 2>&1
in_root chmod -R a+rX /meshes
as_member add /meshes --collection pliers --parts 3
as_member labels pliers-001 --collection pliers >"$work/before.txt"
wc -l <"$work/before.txt"
if in_root setpriv --reuid nobody --regid nogroup --clear-groups \
    env COSEG_ENDPOINT=ipc:///run/coseg/coseg.sock coseg --timeout 1 stats 2>/dev/null; then
    echo "a stranger got in" >&2
    exit 1
fi
stop_service

step "a stranger: the README's five lines, with the package in place of the first"
sed -n '/^## Five lines to first labels$/,/^## [^F]/p' README.md | sed -n '/^```sh$/,/^```$/p' |
    grep -v -e '^```' -e '^cargo install ' >"$root/lines"
begin=$SECONDS
in_root install -d -o nobody -g nogroup /stranger
in_root setpriv --reuid nobody --regid nogroup --clear-groups env HOME=/stranger XDG_RUNTIME_DIR=/stranger NO_COLOR=1 \
    bash -ec "trap 'kill \$(jobs -p); wait' EXIT; cd /stranger; $(cat "$root/lines")" >"$work/stranger.log" 2>&1 ||
    { cat "$work/stranger.log" >&2; exit 1; }
[ "$(find "$root/stranger/coloured" -name '*.glb' -size +50k | wc -l)" = 10 ]
echo "ten GLB files in $((SECONDS - begin)) s"

step "upgrade: data and an edited configuration are kept"
echo '# edited' >>"$root/etc/coseg/coseg.toml"
in_root dpkg -i --force-confold /new.deb >"$work/upgrade.log" 2>&1 || { cat "$work/upgrade.log" >&2; exit 1; }
in_root dpkg-query -W -f '${Version}\n' coseg | grep -x 9.9.9-1
grep -q '# edited' "$root/etc/coseg/coseg.toml"
as_service
as_member labels pliers-001 --collection pliers | cmp - "$work/before.txt"
stop_service

step "remove: the library and the configuration stay"
in_root dpkg --remove coseg >/dev/null
[ ! -e "$root/usr/bin/coseg" ]
[ -d "$root/var/lib/coseg/library" ]
[ -e "$root/etc/coseg/coseg.toml" ]
in_root dpkg -i /new.deb >/dev/null 2>&1
as_service
as_member labels pliers-001 --collection pliers | cmp - "$work/before.txt"
stop_service

step "purge: nothing stays but the user"
in_root dpkg --purge coseg >/dev/null 2>&1
left=$(find "$root/usr" "$root/etc" "$root/var/lib" -path "$root/var/lib/dpkg" -prune -o -name '*coseg*' -print)
[ -z "$left" ] || { echo "left: $left" >&2; exit 1; }
if command -v buildah >/dev/null; then
    step "a container of the package, on that Debian"
    tests/package/container.sh "$work/new.deb" "$work/base.tar"
else
    echo "skipped: the container needs buildah"
fi
step "the package is well"
