#!/usr/bin/env bash
# Makes target/debian/coseg_VERSION_ARCH.deb from target/release/coseg. Further arguments go to `cargo deb`.
# Needs cargo-deb: cargo install cargo-deb --locked
set -euo pipefail
cd "$(dirname "$0")/.."
bin="$PWD/target/release/coseg"
[ -x "$bin" ] || cargo build --release

# What the binary says of itself, and the documents.
share=target/package/share
rm -rf "$share"
install -Dm644 -t "$share/doc/coseg" README.md CHANGELOG.md LICENSE-MIT LICENSE-APACHE docs/*.md
if "$bin" man --help >/dev/null 2>&1; then
    mkdir -p "$share/man/man1"
    "$bin" man --out "$share/man/man1" 2>/dev/null
    gzip -9n "$share"/man/man1/*
fi
if "$bin" completions --help >/dev/null 2>&1; then
    mkdir -p "$share/bash-completion/completions" "$share/zsh/vendor-completions" "$share/fish/vendor_completions.d"
    "$bin" completions bash >"$share/bash-completion/completions/coseg"
    "$bin" completions zsh >"$share/zsh/vendor-completions/_coseg"
    "$bin" completions fish >"$share/fish/vendor_completions.d/coseg.fish"
fi
find config -mindepth 1 -maxdepth 1 -type d -exec cp -r {} "$share/doc/coseg/" \;
cargo deb --no-build --quiet "$@"
