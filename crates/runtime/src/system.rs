//! The operating system: errors with their remedies, standard error, time of day and random numbers. The caller decides whether
//! the program ends.

use rustix::io::retry_on_intr;
use rustix::rand::{GetRandomFlags, getrandom};
use rustix::thread::set_name;
use std::ffi::{CString, OsString};
use std::fmt::Display;
use std::io::{self, Write};
use std::path::PathBuf;
use std::process::Command;
use std::sync::OnceLock;
use std::time::SystemTime;

/// The file and the first arguments that start this program.
static PROGRAM: OnceLock<(PathBuf, Vec<OsString>)> = OnceLock::new();

/// Sets the command that starts this program, if it is not the running executable, as for a library in an interpreter. Call it
/// once, before any process is started.
pub fn started_by(file: PathBuf, arguments: Vec<OsString>) {
    let _ = PROGRAM.set((file, arguments));
}

/// Returns a command that starts this program again, as a role or as the janitor. It uses the same file even if that was
/// replaced.
///
/// # Errors
/// Errors of the system, if it does not name the executable.
pub fn this_program() -> io::Result<Command> {
    if PROGRAM.get().is_none() {
        started_by(std::env::current_exe()?, Vec::new());
    }
    let (file, arguments) = PROGRAM.get().expect("it has just been set");
    let mut command = Command::new(file);
    command.args(arguments);
    Ok(command)
}

/// Names the calling thread, for tools such as `ps` and for kernel traces: the first 15 bytes of a name.
pub fn name_thread(name: &str) {
    let end = (0..=name.len().min(15)).rev().find(|end| name.is_char_boundary(*end)).unwrap_or_default();
    if let Ok(name) = CString::new(&name[..end]) {
        let _ = set_name(&name);
    }
}

/// Formats a time as UTC (RFC 3339); times before 1970 become 1970.
pub fn utc(time: SystemTime) -> String {
    humantime::format_rfc3339(time.max(SystemTime::UNIX_EPOCH)).to_string()
}

/// Returns the remedy for an error of the system.
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
        Some(libc::EIO) => "check the device: see `dmesg`",
        Some(libc::ENOLCK | libc::EOPNOTSUPP | libc::ENOSYS) => "the file system cannot do that: choose another place",
        _ => "try again; `corotate doctor` examines the machine",
    }
}

/// Returns 128 unpredictable random bits.
///
/// # Errors
/// The system's reason.
pub fn random_bits() -> io::Result<u128> {
    let mut bytes = [0; size_of::<u128>()];
    // So few bytes are returned by a single call.
    match retry_on_intr(|| getrandom(&mut bytes, GetRandomFlags::empty()))? {
        16 => Ok(u128::from_ne_bytes(bytes)),
        _ => Err(io::ErrorKind::UnexpectedEof.into()),
    }
}

/// Writes a line to stderr. A missing stderr is ignored, where `eprintln!` would panic; the exit code still tells the result.
pub fn tell(line: impl Display) {
    let _ = writeln!(io::stderr(), "{line}");
}
