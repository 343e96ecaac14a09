//! The whole-program tests, compiled and linked as one program.
//! `cargo test --release --test all hil::` runs those of `runs/hil.rs`.
//! Tests run in parallel threads: none may change the state of the process, such as its environment.

mod common;
#[path = "../benches/contest/main.rs"]
#[allow(dead_code, reason = "its command line is not used")]
mod contestants;
mod failures;
mod files;
mod pure;
mod runs;
mod tools;
