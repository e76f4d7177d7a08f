#!/bin/sh
# As rustc, but this project's own crates tell libFuzzer where they have been. Dependencies stay as they are.
rustc=$1
shift
case " $* " in
*" --crate-name coseg "* | *" --crate-name coseg_geometry "* | *" --crate-name mesh "* | *" --crate-name request "* | *" --crate-name arrays "*)
    exec "$rustc" "$@" -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
        -Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table \
        -Cllvm-args=-sanitizer-coverage-trace-compares -Clink-dead-code -Coverflow-checks=on -Ccodegen-units=16
    ;;
*) exec "$rustc" "$@" ;;
esac
