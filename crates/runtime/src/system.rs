//! The system: its errors in words, with what a user can do about them, its stderr, its time of day, and its randomness. Must not
//! decide what becomes of the program.

use rustix::io::retry_on_intr;
use rustix::rand::{GetRandomFlags, getrandom};
use std::ffi::OsString;
use std::fmt::Display;
use std::io::{self, Write};
use std::path::PathBuf;
use std::process::Command;
use std::sync::OnceLock;
use std::time::SystemTime;

/// The file that this program is started from, and what it is given before all else.
static PROGRAM: OnceLock<(PathBuf, Vec<OsString>)> = OnceLock::new();

/// Says how this program is started, where that is not by the file that runs: as a library in an interpreter. Once, before
/// anything is started.
pub fn started_by(file: PathBuf, arguments: Vec<OsString>) {
    let _ = PROGRAM.set((file, arguments));
}

/// This program, to be started again: as a role, as the janitor. The same file whatever has taken its place since.
///
/// # Errors
/// Those of the system, where it does not tell the file.
pub fn this_program() -> io::Result<Command> {
    if PROGRAM.get().is_none() {
        started_by(std::env::current_exe()?, Vec::new());
    }
    let (file, arguments) = PROGRAM.get().expect("it has just been set");
    let mut command = Command::new(file);
    command.args(arguments);
    Ok(command)
}

/// A time in UTC as text (RFC 3339), from 1970 on.
pub fn utc(time: SystemTime) -> String {
    humantime::format_rfc3339(time.max(SystemTime::UNIX_EPOCH)).to_string()
}

/// What to do about an error of the system.
pub fn remedy(error: &io::Error) -> &'static str {
    match error.raw_os_error() {
        Some(libc::ENOSPC | libc::EDQUOT) => "free some room there",
        Some(libc::EFBIG) => "raise the limit on the size of files with `ulimit -f`",
        Some(libc::EMFILE) => "raise the limit on open files with `ulimit -n`",
        Some(libc::ENFILE) => "the machine has too many open files: end some programs",
        Some(libc::EAGAIN) => "raise the limit on processes and threads with `ulimit -u`, or end some",
        Some(libc::ENOMEM) => "free some memory, or raise the limits on it (`ulimit -v`, `ulimit -l`)",
        Some(libc::EACCES | libc::EPERM) => "check owner and permissions",
        Some(libc::EROFS) => "it is mounted read-only: choose another place",
        Some(libc::ENOENT) => "check that it exists",
        Some(libc::EISDIR) => "name a file in it",
        Some(libc::ENOTDIR) => "check its path: a part of it is a file",
        Some(libc::EIO) => "check the device: `dmesg` tells more",
        Some(libc::ENOLCK | libc::EOPNOTSUPP | libc::ENOSYS) => "the file system cannot do that: choose another place",
        _ => "try again; `corotate doctor` examines the machine",
    }
}

/// 128 bits that nobody can guess.
///
/// # Errors
/// The system's reason.
pub fn random_bits() -> io::Result<u128> {
    let mut bytes = [0; size_of::<u128>()];
    // As few as these are given at once.
    match retry_on_intr(|| getrandom(&mut bytes, GetRandomFlags::empty()))? {
        16 => Ok(u128::from_ne_bytes(bytes)),
        _ => Err(io::ErrorKind::UnexpectedEof.into()),
    }
}

/// Writes a line to stderr. Without a stderr the exit code is all there is to say, where `eprintln!` would panic.
pub fn tell(line: impl Display) {
    let _ = writeln!(io::stderr(), "{line}");
}
