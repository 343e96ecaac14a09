//! A device of the serial protocol on a Cortex-M: the board, its possible roles, and the parameters of the loop.
//!
//! This crate does not allocate, and must use only the functions of [`board`].

#![no_std]

pub mod board;
pub mod flight;
pub mod follower;
pub mod halt;
pub mod pair;
