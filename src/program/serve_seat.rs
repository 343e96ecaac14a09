//! `corotate serve-seat`: serves a seat to the program that started this one; C, C++ and Python take a role by it.

use super::output::{CommandResult, Exit, Failure, fail};
use super::signals::terminated_by_signals;
use crate::seat::{RoleAddress, serve_seat};
use crate::system::remedy;
use rustix::io::{FdFlags, fcntl_setfd};
use std::io;
use std::mem::size_of_val;
use std::os::fd::{FromRawFd, OwnedFd, RawFd};
use std::path::PathBuf;

/// Options of `corotate serve-seat`.
#[derive(clap::Args)]
pub struct Arguments {
    /// The waiting run's domain or results directory
    domain: PathBuf,
    /// The role: a body's name, observer or controller
    role: String,
    /// The number of the inherited socket (SOCK_SEQPACKET)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(RawFd).range(3..))]
    fd: RawFd,
}

/// Serves the seat to the end of the run.
pub fn serve(arguments: &Arguments) -> CommandResult {
    // First, while no file of this process can have the number.
    let socket = inherited(arguments.fd).map_err(|error| {
        let text =
            format!("--fd {} is not an inherited SOCK_SEQPACKET socket: {error}; {}", arguments.fd, remedy(&error));
        fail(Exit::Usage, Failure::new("no-seat-socket", text))
    })?;
    let terminated = terminated_by_signals()?;
    let address = RoleAddress { domain: arguments.domain.clone(), role: arguments.role.clone() };
    // The program on the other end prints the reason, which it has received.
    serve_seat(&address, socket, &terminated).map(|()| Exit::Ok).map_err(|_| Exit::Failure)
}

/// Takes a socket that the parent process has opened.
#[allow(unsafe_code, reason = "a descriptor is inherited as a number")]
fn inherited(number: RawFd) -> io::Result<OwnedFd> {
    let mut kind: libc::c_int = 0;
    let mut length = size_of_val(&kind) as libc::socklen_t;
    let (value, size) = ((&raw mut kind).cast(), &raw mut length);
    // SAFETY: the kernel writes at most `length` bytes to `kind`, and fails for a number that is not a socket.
    if unsafe { libc::getsockopt(number, libc::SOL_SOCKET, libc::SO_TYPE, value, size) } != 0 {
        return Err(io::Error::last_os_error());
    }
    if kind != libc::SOCK_SEQPACKET {
        return Err(io::Error::from_raw_os_error(libc::EPROTOTYPE));
    }
    // SAFETY: the number is an open socket, which no part of this program has opened: it is still single-threaded here.
    let socket = unsafe { OwnedFd::from_raw_fd(number) };
    fcntl_setfd(&socket, FdFlags::CLOEXEC)?;
    Ok(socket)
}
