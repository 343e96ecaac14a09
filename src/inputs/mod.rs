//! Changes of inputs while a run lasts: the launcher receives them from other programs of the same user.
//!
//! A request is a line of JSON on a Unix socket in the run's domain, which is private to the user. The launcher decides from
//! which tick a change acts, so that every role applies it at the same tick. Must not decide whether a change is wise: the
//! client checks the loop's stability.

mod applied;
mod client;
mod protocol;
mod server;

pub use applied::{AppliedChange, applied};
pub use client::{InputError, Tuned, change, current, request};
pub use protocol::{Answer, Request, WantedChange};
pub(crate) use server::{InputServer, Timing, resolve};
