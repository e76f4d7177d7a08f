#!/usr/bin/env bash
# What a stranger does: the README's "Five lines to first labels", word for word, in an empty home with nothing
# else in the environment; then ten GLB files must be there, in colours, within five minutes.
#
#     tests/stranger/run.sh              the first line, which builds, is taken as done: target/release/coseg
#     tests/stranger/run.sh --install    all of it; the build, from nothing, is timed apart
set -euo pipefail
cd "$(dirname "$0")/../.."
root=$PWD
limit=300
coseg=${COSEG_BIN:-$root/target/release/coseg}

home=$(mktemp -d)
trap 'rm -rf "$home"' EXIT

# The fenced block under that heading, a command a line.
sed -n '/^## Five lines to first labels$/,/^## [^F]/p' README.md | sed -n '/^```sh$/,/^```$/p' | grep -v '^```' >"$home/lines"
n=$(wc -l <"$home/lines")
[ "$n" -ge 4 ] && [ "$n" -le 6 ] || { echo "the README has $n lines to first labels; 4 to 6 are allowed" >&2; exit 1; }
head -n 1 "$home/lines" | grep -q '^cargo install ' || { echo "the first line does not install" >&2; exit 1; }

as_stranger() {
    env -i HOME="$home" PATH="$home/.cargo/bin:$(dirname "$(command -v cargo || echo /usr/bin/cargo)"):/usr/local/bin:/usr/bin:/bin" \
        RUSTUP_HOME="${RUSTUP_HOME:-$HOME/.rustup}" XDG_RUNTIME_DIR="$home/run" NO_COLOR=1 TERM=dumb bash -e
}
mkdir -p "$home/.cargo/bin" "$home/run" "$home/work"
if [ "${1:-}" = --install ]; then
    begin=$SECONDS
    (cd "$root" && echo "$(head -n 1 "$home/lines") --target-dir $home/target" | as_stranger)
    echo "installed in $((SECONDS - begin)) s"
else
    [ -x "$coseg" ] || { echo "$coseg is missing: cargo build --release" >&2; exit 2; }
    cp "$coseg" "$home/.cargo/bin/coseg"
fi

begin=$SECONDS
{
    # Not a stranger's: the daemon is ended, whatever happens.
    echo "trap 'kill \$(jobs -p) 2>/dev/null; wait' EXIT; cd '$home/work'"
    tail -n +2 "$home/lines"
} | as_stranger
seconds=$((SECONDS - begin))

glb=("$home"/work/coloured/*.glb)
[ "${#glb[@]}" = 10 ] || { echo "${#glb[@]} GLB files and not 10" >&2; exit 1; }
if command -v node >/dev/null; then
    # The validator where the npm registry can be had; the checks of our own in any case.
    if command -v npm >/dev/null; then
        npm install --silent --no-audit --no-fund --prefix "$home" gltf-validator@2.0.0-dev.3.10 >/dev/null 2>&1 || true
    fi
    cp tests/stranger/check.mjs "$home/"
    node "$home/check.mjs" "${glb[@]}"
else
    echo "node is missing: the files are there, and were not looked into" >&2
    exit 2
fi
[ "$seconds" -le "$limit" ] || { echo "it took $seconds s; $limit are allowed" >&2; exit 1; }
echo "$n commands; from an installed coseg to ten coloured GLB files in $seconds s"
