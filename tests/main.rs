//! The whole-program tests: one program, which is compiled and linked once.
//! `cargo test --release --test all hil::` runs those of `runs/hil.rs`.
//! Tests run beside each other, so none may change what belongs to the whole process.

mod common;
#[path = "../benches/contest/main.rs"]
#[allow(dead_code, reason = "its command line is not used")]
mod contestants;
mod failures;
mod files;
mod pure;
mod runs;
mod tools;
