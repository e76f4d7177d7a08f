#!/usr/bin/env bash
# Fuzzes every parser, the decoding of requests and the headers of array files: fuzz/run.sh [SECONDS] [TARGET...]; 0 builds only.
#
# libFuzzer, on the stable compiler: only flags of -C are needed. An input that crashes, takes more than 5 s or more than
# 512 MB ends the run and is left in target/fuzz/found; what was learnt is kept in target/fuzz/corpus.
# Put what was mended into fuzz/kept/TARGET: the ordinary tests try these for ever.
set -euo pipefail
cd "$(dirname "$0")/.."
seconds=${1:-60}
shift || true
targets=("$@")
[ "${#targets[@]}" -gt 0 ] || targets=(obj off ply stl gltf request arrays)
seed=${COSEG_TEST_SEED:-1}
echo "COSEG_TEST_SEED=$seed, $seconds s each: ${targets[*]}"
out=$PWD/target/fuzz
mkdir -p "$out/found"
if [ ! -e "$out/build/release" ] && [ -e target/release ]; then
    # The dependencies that are built already: hard links.
    mkdir -p "$out/build/release"
    for part in deps build .fingerprint; do cp -al "target/release/$part" "$out/build/release/$part"; done
fi
# The versions that are built already.
cp Cargo.lock fuzz/Cargo.lock
RUSTC_WRAPPER=$PWD/fuzz/rustc.sh CARGO_TARGET_DIR=$out/build ${CARGO:-cargo} build --release --manifest-path fuzz/Cargo.toml
[ "$seconds" != 0 ] || exit 0
# What the tests know is where to begin.
COSEG_TEST_SEEDS=$out/seeds ${COSEG_TEST_BINARY:-cargo test --release --test it --} --exact fuzzing::write_seeds --ignored
for target in "${targets[@]}"; do
    program=$target
    case $target in obj | off | ply | stl | gltf) program=mesh ;; esac
    mkdir -p "$out/corpus/$target" "$out/seeds/$target" "fuzz/kept/$target"
    echo "== $target"
    COSEG_FUZZ_FORMAT=$target "$out/build/release/$program" \
        "$out/corpus/$target" "$out/seeds/$target" "fuzz/kept/$target" \
        -seed="$seed" -max_total_time="$seconds" -timeout=5 -rss_limit_mb=512 -max_len=16384 \
        -artifact_prefix="$out/found/$target-" -print_final_stats=1 2>&1 |
        grep -E "^(stat::|SUMMARY|==.*ERROR|artifact)|panicked" || true
    if compgen -G "$out/found/$target-*" >/dev/null; then
        echo "found: $(echo "$out/found/$target-"*)"
        failed=1
    fi
done
exit "${failed:-0}"
