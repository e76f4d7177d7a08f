#!/usr/bin/env bash
# Runs the example of each language with one daemon, and compares its output with `coseg labels`.
set -euo pipefail
cd "$(dirname "$0")"
source ../setup.sh
[ -x "$WORK/venv/bin/python" ] || python_tools
[ -d "$WORK/typescript" ] || node_tools
need protoc protobuf-compiler
need g++ g++
[ -f /usr/include/zmq_addon.hpp ] && [ -f /usr/include/google/protobuf/message.h ] || need - cppzmq-dev libprotobuf-dev
need javac default-jdk-headless
jars=/usr/share/java
[ -f $jars/jeromq.jar ] && [ -f $jars/protobuf.jar ] || need - libjeromq-java libprotobuf-java

out="$WORK/raw"
rm -rf "$out"
mkdir -p "$out"/{cpp,java,typescript}
"$COSEG_BIN" synth pliers --count 1 --faces 1000 --out "$out/mesh" >/dev/null 2>&1
mesh=$(echo "$out"/mesh/*.off)
# The system chooses the port; the daemon prints it.
env -u COSEG_ENDPOINT NO_COLOR=1 "$COSEG_BIN" serve --library "$out/library" \
    --endpoint 'tcp://127.0.0.1:*' 2>"$out/log" &
daemon=$!
trap 'kill $daemon; wait $daemon || true; [ -z "${OWN_WORK:-}" ] || rm -rf "$WORK"' EXIT
until grep -q serving "$out/log"; do sleep 0.05; done
endpoint=$(grep -o 'tcp://[^ ]*' "$out/log" | head -n 1)

step "raw: python"
"$WORK/venv/bin/python" python/labels.py "$endpoint" "$mesh" >"$out/python.txt"

step "raw: typescript"
cp typescript/labels.ts "$out/typescript/"
cp -r "$WORK/typescript/src/gen" "$out/typescript/gen"
ln -s "$WORK/typescript/node_modules" "$out/typescript/node_modules"
echo '{ "type": "module" }' >"$out/typescript/package.json"
(
    cd "$out/typescript"
    node_modules/.bin/tsc --strict --target es2023 --module nodenext --skipLibCheck --types node labels.ts
    node labels.js "$endpoint" "$mesh"
) >"$out/typescript.txt"

step "raw: c++"
protoc -I "$ROOT/proto" --cpp_out="$out/cpp" "$ROOT"/proto/coseg/v1/*.proto
printf '%s\n' cpp/labels.cpp "$out"/cpp/coseg/v1/*.cc |
    xargs -P "$(nproc)" -I{} sh -c 'g++ -std=c++17 -O0 -w -I"$1" -c "$2" -o "$1/$(basename "$2").o"' - "$out/cpp" {}
g++ -o "$out/cpp/labels" "$out"/cpp/*.o -lzmq -lprotobuf
"$out/cpp/labels" "$endpoint" "$mesh" >"$out/cpp.txt"

step "raw: java"
protoc -I "$ROOT/proto" --java_out="$out/java" "$ROOT"/proto/coseg/v1/*.proto
find "$out/java" -name '*.java' >"$out/java/sources"
javac -nowarn -cp $jars/jeromq.jar:$jars/protobuf.jar -d "$out/java/classes" java/Labels.java @"$out/java/sources" 2>&1 |
    grep -v '^Note:' || true
java -cp "$jars/jeromq.jar:$jars/protobuf.jar:$out/java/classes" Labels "$endpoint" "$mesh" >"$out/java.txt"

for language in python typescript cpp java; do
    "$COSEG_BIN" labels $language --collection raw --endpoint "$endpoint" >"$out/expected.txt"
    tr ' ' '\n' <"$out/$language.txt" | cmp - "$out/expected.txt"
    echo "$language: $(wc -l <"$out/expected.txt") labels, as the command line says"
done
