//! Builds libzmq with CURVE over the libsodium that `libsodium-sys-stable` has built.

use std::env;

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    // Warnings of somebody else's code are no news to whoever builds this.
    let flags = env::var("CXXFLAGS").unwrap_or_default();
    env::set_var("CXXFLAGS", format!("{} -w", flags));
    let built = |what: &str| {
        env::var(format!("DEP_SODIUM_{}", what))
            .unwrap_or_else(|_| panic!("libsodium-sys-stable does not say where its {} is", what))
    };
    let libsodium = zeromq_src::LibLocation::new(built("LIB"), built("INCLUDE"));
    zeromq_src::Build::new()
        .with_libsodium(Some(libsodium))
        .build();
}
