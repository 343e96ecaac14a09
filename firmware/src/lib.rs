//! A device of the serial protocol on a Cortex-M: the board, the roles that it may have, and the loop's numbers.
//!
//! Nothing here allocates. Must not need more of a board than [`board`] gives.

#![no_std]

pub mod board;
pub mod flight;
pub mod follower;
pub mod halt;
pub mod pair;
