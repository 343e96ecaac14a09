//! A seat: the run's own program as a child process, and the socket over which it asks for each tick.
//!
//! The frames are those of `serve-seat`. This file must not know the transport of a run.

use crate::description::{Layout, SeatFile};
use crate::error::SeatError;
use bytemuck::{cast_slice as cast_bytes, cast_slice_mut};
use std::io;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};

const PROTOCOL: u64 = 1;
const HELLO: u64 = 1;
const DESCRIPTION: u64 = 2;
const TICK: u64 = 3;
const END: u64 = 4;
const OUTPUTS: u64 = 1;
const FAILURE: u64 = 2;
const WORD: usize = size_of::<u64>();
/// Longest frame, and longest text of a failure, bytes.
const FRAME_MAX: usize = 160 << 10;
const TEXT_MAX: usize = 32 << 10;
/// Words of a frame before its content.
const HEAD: usize = 2;

/// The progress of a run at its seat.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Progress {
    /// Before the first tick.
    Begun,
    /// A tick is under way.
    Tick(u64),
    /// The run has ended.
    Ended,
}

/// A role of a run that this process computes.
pub struct Seat {
    child: Child,
    socket: OwnedFd,
    layout: Layout,
    progress: Progress,
    frame: Vec<u64>,
    answer: Vec<u64>,
    blank: Vec<u64>,
}

impl Seat {
    /// Takes the seat of a role. `path` is its file or the directory of its run.
    pub fn open(path: &Path, role: &str) -> Result<Self, SeatError> {
        let file = SeatFile::read(path, role)?;
        let (Some([program, words @ ..]), Some(domain)) = (file.program.as_deref(), file.domain()) else {
            return Err(SeatError::NoRun);
        };
        let start = |source| SeatError::Start { program: program.clone(), source };
        let (socket, end) = pair().map_err(start)?;
        let number = end.as_raw_fd();
        let mut command = Command::new(program);
        command
            .args(words)
            .arg("serve-seat")
            .arg(domain)
            .args([role, "--fd", &number.to_string()])
            .stdin(Stdio::null());
        // SAFETY: fcntl is async-signal-safe; it makes the one descriptor survive exec.
        #[allow(unsafe_code, reason = "the standard library passes on no other descriptors than 0 to 2")]
        unsafe {
            command.pre_exec(move || match libc::fcntl(number, libc::F_SETFD, 0) {
                -1 => Err(io::Error::last_os_error()),
                _ => Ok(()),
            });
        }
        let child = command.spawn().map_err(start)?;
        drop(end);
        let mut link = Link { socket: &socket, frame: vec![0; FRAME_MAX / WORD] };
        let layout = match link.describe() {
            Ok(layout) => layout,
            Err(error) => return Err(end_child(child, socket, error)),
        };
        let blank: Vec<u64> = layout.writes.iter().flat_map(|signal| layout.blank(signal)).collect();
        let answer = [&[OUTPUTS, 0][..], &blank].concat();
        Ok(Self { child, layout, progress: Progress::Begun, frame: link.frame, socket, answer, blank })
    }

    /// Sends the outputs of the tick under way and waits for the next. Returns false at the end of the run.
    pub fn wait(&mut self) -> Result<bool, SeatError> {
        match self.progress {
            Progress::Ended => return Err(SeatError::Ended),
            Progress::Tick(tick) => {
                self.answer[1] = tick;
                // A run that has ended takes nothing more; its reason follows.
                let _ = send(&self.socket, cast_bytes(&self.answer));
            }
            Progress::Begun => {}
        }
        let length = match receive(&self.socket, &mut self.frame) {
            Ok(length) => length,
            Err(error) => {
                self.progress = Progress::Ended;
                return Err(error);
            }
        };
        match self.frame[..] {
            [TICK, tick, ..] if length == WORD * self.frame_words() => {
                self.progress = Progress::Tick(tick);
                self.answer[HEAD..].copy_from_slice(&self.blank);
                Ok(true)
            }
            [END, ..] => {
                self.progress = Progress::Ended;
                let text = String::from_utf8_lossy(&cast_bytes(&self.frame)[WORD..length]).into_owned();
                if text.is_empty() { Ok(false) } else { Err(SeatError::Run(text)) }
            }
            _ => {
                self.progress = Progress::Ended;
                Err(SeatError::Gone)
            }
        }
    }

    /// Returns the tick under way.
    pub fn tick(&self) -> Result<u64, SeatError> {
        match self.progress {
            Progress::Tick(tick) => Ok(tick),
            Progress::Begun => Err(SeatError::NoTick),
            Progress::Ended => Err(SeatError::Ended),
        }
    }

    /// Returns the period, s.
    pub fn period_s(&self) -> f64 {
        self.layout.period_ns as f64 / 1e9
    }

    /// Returns the last tick.
    pub fn last_tick(&self) -> u64 {
        self.layout.last_tick
    }

    /// Returns the content of an input at the tick under way, or `None` if its sample is missing or rejected.
    pub fn read(&self, name: &str, size: usize) -> Result<Option<&[u8]>, SeatError> {
        self.tick()?;
        let index = Layout::find(&self.layout.reads, name)?;
        let lengths = self.layout.reads.iter().map(|signal| self.layout.words(signal));
        let first = HEAD + self.presence() + lengths.clone().take(index).sum::<usize>();
        let length = self.layout.words(&self.layout.reads[index]);
        check_size(name, length, size)?;
        let present = self.frame[HEAD + index / 64] >> (index % 64) & 1 == 1;
        Ok(present.then(|| cast_bytes(&self.frame[first..first + length])))
    }

    /// Returns the place of an output of the tick under way.
    pub fn write(&mut self, name: &str, size: usize) -> Result<&mut [u8], SeatError> {
        self.tick()?;
        let index = Layout::find(&self.layout.writes, name)?;
        let lengths = self.layout.writes.iter().map(|signal| self.layout.words(signal));
        let first = HEAD + lengths.take(index).sum::<usize>();
        let length = self.layout.words(&self.layout.writes[index]);
        check_size(name, length, size)?;
        Ok(cast_slice_mut(&mut self.answer[first..first + length]))
    }

    /// Returns the numbers of an input of the loop, such as a gain or a reference, at the tick under way.
    pub fn value(&self, key: &str, count: usize) -> Result<Vec<f64>, SeatError> {
        self.tick()?;
        let known = || self.layout.values.iter().map(|value| &*value.key).collect::<Vec<_>>().join(", ");
        let value = self.layout.values.iter().find(|value| value.key == key);
        let value = value.ok_or_else(|| SeatError::NoValue { key: key.to_owned(), known: known() })?;
        if value.count != count {
            return Err(SeatError::Count { key: key.to_owned(), expected: value.count, given: count });
        }
        let first = self.frame_words() - self.numbers() + value.index;
        Ok(self.frame[first..first + count].iter().map(|word| f64::from_bits(*word)).collect())
    }

    /// Ends the role, and with it the run, at the tick under way with a reason.
    pub fn fail(&mut self, reason: &str) -> Result<(), SeatError> {
        let tick = self.tick()?;
        let end = (0..=reason.len().min(TEXT_MAX)).rev().find(|end| reason.is_char_boundary(*end)).unwrap_or(0);
        let mut frame = cast_bytes(&[FAILURE, tick]).to_vec();
        frame.extend_from_slice(&reason.as_bytes()[..end]);
        self.progress = Progress::Begun;
        send(&self.socket, &frame)
    }

    fn presence(&self) -> usize {
        self.layout.reads.len().div_ceil(64).max(1)
    }

    fn numbers(&self) -> usize {
        self.layout.values.iter().map(|value| value.count).sum()
    }

    fn frame_words(&self) -> usize {
        let inputs: usize = self.layout.reads.iter().map(|signal| self.layout.words(signal)).sum();
        HEAD + self.presence() + inputs + self.numbers()
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        shut(&self.socket);
        let _ = self.child.wait();
    }
}

/// The reading of a description.
struct Link<'a> {
    socket: &'a OwnedFd,
    frame: Vec<u64>,
}

impl Link<'_> {
    fn describe(&mut self) -> Result<Layout, SeatError> {
        let (mut text, mut length) = (Vec::new(), None);
        loop {
            let received = receive(self.socket, &mut self.frame)?;
            match self.frame[..] {
                [HELLO, PROTOCOL, bytes, ..] => length = Some(bytes as usize),
                [HELLO, version, ..] => {
                    return Err(SeatError::Run(format!(
                        "the run's program serves seats by protocol {version}, this library by {PROTOCOL}; use one release"
                    )));
                }
                [DESCRIPTION, ..] => text.extend_from_slice(&cast_bytes(&self.frame)[WORD..received]),
                [END, ..] => {
                    return Err(SeatError::Run(
                        String::from_utf8_lossy(&cast_bytes(&self.frame)[WORD..received]).into_owned(),
                    ));
                }
                _ => return Err(SeatError::Gone),
            }
            if length.is_some_and(|length| text.len() >= length) {
                return serde_json::from_slice(&text)
                    .map_err(|error| SeatError::BadSeat { path: "the description".into(), reason: error.to_string() });
            }
        }
    }
}

fn end_child(mut child: Child, socket: OwnedFd, error: SeatError) -> SeatError {
    drop(socket);
    let _ = child.wait();
    error
}

fn check_size(name: &str, words: usize, given: usize) -> Result<(), SeatError> {
    let expected = WORD * words;
    if expected == given { Ok(()) } else { Err(SeatError::Size { name: name.to_owned(), expected, given }) }
}

/// Returns two connected sockets that keep the boundaries of packets; neither survives exec.
#[allow(unsafe_code, reason = "the standard library makes no such sockets")]
fn pair() -> io::Result<(OwnedFd, OwnedFd)> {
    let mut ends = [0; 2];
    // SAFETY: the kernel writes two descriptors to the array.
    if unsafe { libc::socketpair(libc::AF_UNIX, libc::SOCK_SEQPACKET | libc::SOCK_CLOEXEC, 0, ends.as_mut_ptr()) } != 0
    {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: both descriptors are new, and nothing else owns them.
    Ok(unsafe { (OwnedFd::from_raw_fd(ends[0]), OwnedFd::from_raw_fd(ends[1])) })
}

/// Sends a packet. A closed socket does not raise SIGPIPE.
#[allow(unsafe_code, reason = "the standard library sends without MSG_NOSIGNAL")]
fn send(socket: &OwnedFd, packet: &[u8]) -> Result<(), SeatError> {
    loop {
        // SAFETY: the packet is readable for its length.
        let sent = unsafe { libc::send(socket.as_raw_fd(), packet.as_ptr().cast(), packet.len(), libc::MSG_NOSIGNAL) };
        match (sent, io::Error::last_os_error().kind()) {
            (-1, io::ErrorKind::Interrupted) => {}
            (-1, _) => return Err(SeatError::Gone),
            _ => return Ok(()),
        }
    }
}

/// Waits for a packet and returns its length in bytes. Words after it are those of an earlier one.
#[allow(unsafe_code, reason = "as `send`")]
fn receive(socket: &OwnedFd, frame: &mut [u64]) -> Result<usize, SeatError> {
    let room: &mut [u8] = cast_slice_mut(frame);
    loop {
        // SAFETY: the buffer is writable for its length.
        let received = unsafe { libc::recv(socket.as_raw_fd(), room.as_mut_ptr().cast(), room.len(), 0) };
        match (received, io::Error::last_os_error().kind()) {
            (-1, io::ErrorKind::Interrupted) => {}
            (length, _) if length >= WORD as isize => return Ok(length as usize),
            _ => return Err(SeatError::Gone),
        }
    }
}

#[allow(unsafe_code, reason = "a descriptor is shut down while another thread may read it")]
fn shut(socket: &OwnedFd) {
    // SAFETY: the descriptor is open.
    let _ = unsafe { libc::shutdown(socket.as_raw_fd(), libc::SHUT_RDWR) };
}
