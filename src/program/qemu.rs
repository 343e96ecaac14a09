//! QEMU as a board: started with a program for it, its UART a pty, ended with this process.
//!
//! Must not know the protocol; `bridge` opens the pty like any other line.

use super::output::{Exit, fail};
use super::signals::die_with;
use crate::system::this_program;
use std::io::{self, BufRead, BufReader, Read};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};

/// The emulator, as Debian and others name it.
const EMULATOR: &str = "qemu-system-arm";
/// What it says before the path of the pty.
const REDIRECTED: &str = "char device redirected to ";

/// Why there is no emulated board.
#[derive(Debug, thiserror::Error)]
pub enum QemuError {
    /// It cannot be started.
    #[error("cannot start {EMULATOR}: {0}; install it (Debian: apt install qemu-system-arm)")]
    Start(io::Error),
    /// There is no program for the board.
    #[error("cannot read {}: {source}; give the ELF file that the firmware's build has made", path.display())]
    Elf {
        /// As given.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// It ended at once.
    #[error(
        "{EMULATOR} does not run this program on the machine `{machine}`: {words}; `{EMULATOR} -machine help` lists them"
    )]
    Refused {
        /// The machine.
        machine: String,
        /// What it said.
        words: String,
    },
}

/// A running emulator.
pub struct Board {
    child: Child,
    /// Held open: it may have more to say.
    _stdout: BufReader<ChildStdout>,
    line: PathBuf,
}

impl Board {
    /// Starts a machine with a program.
    ///
    /// # Errors
    /// [`QemuError`].
    pub fn start(elf: &Path, machine: &str) -> Result<Self, QemuError> {
        std::fs::File::open(elf).map_err(|source| QemuError::Elf { path: elf.to_owned(), source })?;
        // By way of this program, which has the emulator die with it before it becomes the emulator.
        let mut command = this_program().map_err(QemuError::Start)?;
        command.arg("emulate").arg("--parent").arg(std::process::id().to_string()).arg(machine).arg(elf);
        command.process_group(0).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().map_err(QemuError::Start)?;
        let stdout = child.stdout.take().ok_or_else(|| QemuError::Start(io::ErrorKind::BrokenPipe.into()))?;
        let mut stdout = BufReader::new(stdout);
        let mut words = String::new();
        // The end of its output is an answer too.
        let _ = stdout.read_line(&mut words);
        let path = words.strip_prefix(REDIRECTED).and_then(|rest| rest.split_whitespace().next()).map(PathBuf::from);
        let mut board = Self { child, _stdout: stdout, line: path.clone().unwrap_or_default() };
        if path.is_some() {
            return Ok(board);
        }
        if let Some(mut stderr) = board.child.stderr.take() {
            let _ = stderr.read_to_string(&mut words);
        }
        let words = words.trim().replace('\n', "; ");
        Err(QemuError::Refused { machine: machine.to_owned(), words })
    }

    /// The pty that is the board's UART.
    pub fn line(&self) -> &Path {
        &self.line
    }

    /// How it ended, if it has.
    pub fn ended(&mut self) -> Option<String> {
        self.child.try_wait().ok().flatten().map(|status| format!("{EMULATOR} has ended ({status})"))
    }
}

impl Drop for Board {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What becomes the emulator.
#[derive(clap::Args)]
pub struct Arguments {
    /// Die with this process
    #[arg(long)]
    parent: i32,
    /// The machine
    machine: String,
    /// Its program
    elf: PathBuf,
}

/// Becomes the emulator.
pub fn emulate(arguments: &Arguments) -> Exit {
    if let Err(exit) = die_with(arguments.parent) {
        return exit;
    }
    let mut command = Command::new(EMULATOR);
    command.args(["-display", "none", "-monitor", "none", "-serial", "pty", "-machine", &arguments.machine, "-kernel"]);
    // It returns only if it fails.
    fail(Exit::Usage, &QemuError::Start(command.arg(&arguments.elf).exec()))
}
