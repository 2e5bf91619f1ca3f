//! Runs libFuzzer on the target that `MENISCUS_TARGET` names, and keeps inputs that reach new code.

#![no_main]

#[path = "../../bar.rs"]
mod bar;
#[path = "../../targets.rs"]
mod targets;

use std::sync::OnceLock;

use libfuzzer_sys::fuzz_target;

use targets::{TARGETS, Target};

fuzz_target!(|bytes: &[u8]| bar::hold(target(), bytes));

fn target() -> &'static Target {
    static TARGET: OnceLock<&Target> = OnceLock::new();
    TARGET.get_or_init(|| {
        let name = std::env::var("MENISCUS_TARGET").expect("the name of a target in MENISCUS_TARGET");
        TARGETS.iter().find(|target| target.name == name).expect("the name of a target")
    })
}
