//! A seat served to another program: this process is the role, and a program on the other end of a socket computes its
//! samples. Links, warm-up, clock, guards, heartbeat, counters and report stay here, so the other program needs neither
//! the transport nor the rig.
//!
//! The program makes a pair of Unix sockets of type `SOCK_SEQPACKET`, starts the command of the seat description's key
//! `program` with the words `serve-seat DOMAIN ROLE --fd N`, where N is the child's inherited end, and closes its own
//! copy of that end. Every packet is one frame of 64-bit words in native byte order; its first word is its kind. A
//! text is UTF-8 and ends with its packet.
//!
//! | from | kind | words after the kind | when |
//! |---|---|---|---|
//! | server | 1 hello | protocol version (1), bytes of the seat description | first |
//! | server | 2 description | no words but up to 32 KiB of the description's JSON | until it is complete |
//! | server | 3 tick | tick, presence, inputs, values | a tick is due |
//! | server | 4 end | a text: empty at the regular end, else an error code, a line feed and the reason | last |
//! | program | 1 outputs | tick, outputs | the answer to a tick |
//! | program | 2 failure | tick, a text with the reason | instead of it: the role fails, and the run ends |
//!
//! - *Presence* is one word for each 64 of the description's `reads`, at least one: bit i % 64 of word i / 64 is set if
//!   input i has a sample.
//! - *Inputs* are the samples of `reads` in this order, *outputs* those of `writes`, without their stamps: the first
//!   `stamp_size` bytes of a sample are left out. A missing input is zero.
//! - *Values* are the numbers (`f64`) of the description's `values`.
//! - Outputs start from a blank: zero, except `valid`, whose bits are all set. A truth that a body answers as blank
//!   takes the measured values.
//!
//! If the program closes its end during the ticks, answers another tick, or sends a frame of another length, the role
//! fails with the reason, and the run ends. Before the ticks the seat becomes free. The socket closes without an end if
//! this process died. Must not wait for the program after the run has ended.

use super::description::describe_seat;
use super::error::RoleError;
use super::paths::{failure_path, find_run, panic_path, write_whole};
use super::process::{RoleAddress, run_function_with};
use crate::bus::Port;
use crate::bus::domain::Domain;
use crate::panics;
use crate::runtime::{RoleFunction, RoleId, TickSamples, ports, role_values};
use crate::sample::Stamp;
use crate::scenario::Scenario;
use crate::system::{name_thread, remedy};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};

/// Version of the frames.
pub const SEAT_PROTOCOL: u64 = 1;
/// Longest frame, bytes: less than the usual buffer of a socket.
const FRAME_MAX: usize = 128 << 10;
/// Longest piece of the description in one frame, bytes.
const PIECE: usize = 32 << 10;
/// Longest text of a failure, bytes.
const TEXT_MAX: usize = 64 << 10;
/// Between two looks at the run while the program computes, ns.
const LOOK: Timespec = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };

const HELLO: u64 = 1;
const DESCRIPTION: u64 = 2;
const TICK: u64 = 3;
const END: u64 = 4;
const OUTPUTS: u64 = 1;
const FAILURE: u64 = 2;

const WORD: usize = size_of::<u64>();
const STAMP: usize = size_of::<Stamp>() / WORD;
/// Words of a tick's frame before the presence, and of an answer before the outputs.
const HEAD: usize = 2;

/// Runs a role whose samples the program on the other end of a socket computes, to the end of the run. `address` may name the
/// run by its domain or its results. The program gets the reason of an error too.
///
/// # Errors
/// [`RoleError`]; [`RoleError::SeatProgram`] if the program is gone before the ticks, [`RoleError::FrameTooLong`].
pub fn serve_seat(address: &RoleAddress, socket: OwnedFd, terminated: &Arc<AtomicBool>) -> Result<(), RoleError> {
    let socket = Socket(UnixStream::from(socket));
    let watched = socket.0.try_clone();
    let closed = |source: io::Error| RoleError::SeatProgram { reason: socket_error(&source) };
    let (watched, line) = (watched.map_err(closed)?, socket.0.try_clone().map_err(closed)?);
    let find = |domain| RoleAddress { domain, role: address.role.clone() };
    let run = find_run(Some(&address.domain)).map(find).map_err(RoleError::from);
    let serve = |domain: &Domain, scenario: &Scenario, role| {
        name_thread(&address.role);
        panics::keep_in(panic_path(domain.root(), &address.role));
        let seat = Seat::new(Socket(line), (domain, scenario, role), terminated)?;
        seat.greet(&describe_seat(scenario, role, Some(domain)).to_json())?;
        watch(watched, &seat, terminated).map_err(closed)?;
        Ok(Box::new(seat) as Box<dyn RoleFunction>)
    };
    let served = run.and_then(|run| run_function_with(&run, terminated, serve));
    socket.end(&served);
    // Wakes the watching thread.
    let _ = socket.0.shutdown(std::net::Shutdown::Both);
    served
}

/// Ends the role once the program is gone, also while the role waits for its inputs.
fn watch(socket: UnixStream, seat: &Seat, terminated: &Arc<AtomicBool>) -> io::Result<()> {
    let (state, words) = (Arc::clone(&seat.state), seat.failure.clone());
    let terminated = Arc::clone(terminated);
    let watch = move || {
        while poll(&mut [PollFd::new(&socket, PollFlags::empty())], None).is_err() {}
        // Before the ticks another program may take the seat; while the program computes, the function finds it gone.
        if state.fetch_or(CLOSED, Ordering::AcqRel) == BETWEEN_TICKS {
            let _ = write_whole(&words, GONE.as_bytes());
        }
        terminated.store(true, Ordering::Relaxed);
    };
    std::thread::Builder::new().name("seat".to_owned()).spawn(watch).map(|_| ())
}

/// Bits of a seat's state: the role waits for a tick after its first one; the program has closed its end.
const BETWEEN_TICKS: u8 = 1;
const CLOSED: u8 = 2;

/// The reason if the program has closed its end.
const GONE: &str = "the program that computes it ended, or closed its seat";

fn socket_error(error: &io::Error) -> String {
    match error.kind() {
        ErrorKind::BrokenPipe | ErrorKind::ConnectionReset | ErrorKind::UnexpectedEof => GONE.to_owned(),
        _ => format!("the socket to the program that computes it failed: {error}; {}", remedy(error)),
    }
}

/// The end of a socket that keeps the boundaries of packets.
struct Socket(UnixStream);

impl Socket {
    /// Sends a frame, and calls `look` every 100 ms while the program does not read.
    fn send(&self, frame: &[u8], look: impl FnMut() -> Result<(), String>) -> Result<(), String> {
        self.wait(PollFlags::OUT, look)?;
        match (&self.0).write(frame) {
            Ok(sent) if sent == frame.len() => Ok(()),
            Ok(sent) => {
                Err(format!("the socket took {sent} of {} bytes; it must be of type SOCK_SEQPACKET", frame.len()))
            }
            Err(error) => Err(socket_error(&error)),
        }
    }

    /// Waits until the socket is ready.
    fn wait(&self, event: PollFlags, mut look: impl FnMut() -> Result<(), String>) -> Result<(), String> {
        loop {
            match poll(&mut [PollFd::new(&self.0, event)], Some(&LOOK)) {
                Ok(0) | Err(rustix::io::Errno::INTR) => look()?,
                Ok(_) => return Ok(()),
                Err(error) => return Err(socket_error(&error.into())),
            }
        }
    }

    /// Sends the end with its reason; without the program, nothing is left to do.
    fn end(&self, served: &Result<(), RoleError>) {
        let text = match served {
            Ok(()) => String::new(),
            Err(error) => {
                let code: &'static str = error.into();
                format!("{code}\n{error}")
            }
        };
        let text = &text.as_bytes()[..text.len().min(TEXT_MAX)];
        let _ = self.send(&[&END.to_ne_bytes(), text].concat(), || Err(String::new()));
    }
}

/// The function of a role that asks the program.
struct Seat {
    socket: Socket,
    /// The frame of a tick, and the buffer for an answer, which is longer than the longest one.
    asked: Vec<u64>,
    answer: Vec<u64>,
    /// Words of each input, of the presence, and of all outputs.
    inputs: Vec<usize>,
    presence: usize,
    outputs: usize,
    state: Arc<AtomicU8>,
    last_tick: u64,
    domain: Domain,
    failure: PathBuf,
    terminated: Arc<AtomicBool>,
}

impl Seat {
    fn new(
        socket: Socket,
        (domain, scenario, role): (&Domain, &Scenario, RoleId),
        terminated: &Arc<AtomicBool>,
    ) -> Result<Self, RoleError> {
        let (name, ports) = (role.name(scenario), ports(scenario, role));
        let content = |port: &Port| port.size / WORD - STAMP;
        let values: usize = role_values(&scenario.inputs, role).iter().map(|value| value.info.initial.len()).sum();
        let inputs: Vec<usize> = ports.reads.iter().map(content).collect();
        let outputs: usize = ports.writes.iter().map(content).sum();
        let presence = inputs.len().div_ceil(u64::BITS as usize).max(1);
        let asked = HEAD + presence + inputs.iter().sum::<usize>() + values;
        let bytes = WORD * asked.max(HEAD + outputs);
        if bytes > FRAME_MAX {
            return Err(RoleError::FrameTooLong { role: name.to_owned(), bytes, limit: FRAME_MAX });
        }
        Ok(Self {
            socket,
            asked: vec![0; asked],
            answer: vec![0; (HEAD + outputs).max(HEAD + TEXT_MAX / WORD) + 1],
            inputs,
            presence,
            outputs,
            state: Arc::default(),
            last_tick: scenario.last_tick,
            domain: domain.clone(),
            failure: failure_path(domain.root(), name),
            terminated: Arc::clone(terminated),
        })
    }

    /// Sends the description.
    fn greet(&self, description: &str) -> Result<(), RoleError> {
        let hello = [HELLO, SEAT_PROTOCOL, description.len() as u64];
        let gone = |reason| RoleError::SeatProgram { reason };
        self.socket.send(bytemuck::cast_slice(&hello), || self.look()).map_err(gone)?;
        description.as_bytes().chunks(PIECE).try_for_each(|piece| {
            self.socket.send(&[&DESCRIPTION.to_ne_bytes(), piece].concat(), || self.look()).map_err(gone)
        })
    }

    /// Returns an error if the run no longer waits for the program.
    fn look(&self) -> Result<(), String> {
        match (self.terminated.load(Ordering::Relaxed), self.domain.exists()) {
            (false, true) => Ok(()),
            (true, _) => Err("a signal ended it while its program computed".to_owned()),
            (_, false) => Err("the run ended while its program computed".to_owned()),
        }
    }

    /// Fills the frame of a tick.
    fn fill(&mut self, samples: &TickSamples<'_>) {
        let (head, rest) = self.asked.split_at_mut(HEAD);
        head.copy_from_slice(&[TICK, samples.tick]);
        let (presence, mut rest) = rest.split_at_mut(self.presence);
        presence.fill(0);
        for (index, (input, length)) in samples.inputs.iter().zip(&self.inputs).enumerate() {
            let (content, after) = rest.split_at_mut(*length);
            match input {
                Some(words) => {
                    content.copy_from_slice(&words[STAMP..]);
                    presence[index / u64::BITS as usize] |= 1 << (index % u64::BITS as usize);
                }
                None => content.fill(0),
            }
            rest = after;
        }
        rest.iter_mut().zip(samples.values).for_each(|(word, value)| *word = value.to_bits());
    }

    /// Waits for the answer to a tick; returns its length, bytes.
    fn receive(&mut self) -> Result<usize, String> {
        self.socket.wait(PollFlags::IN, || self.look())?;
        match (&self.socket.0).read(bytemuck::cast_slice_mut(&mut self.answer)) {
            Ok(0) => Err(GONE.to_owned()),
            Ok(length) => Ok(length),
            Err(error) => Err(socket_error(&error)),
        }
    }

    /// Sends a tick to the program and takes its answer.
    fn ask(&mut self, samples: TickSamples<'_>) -> Result<(), String> {
        self.fill(&samples);
        self.socket.send(bytemuck::cast_slice(&self.asked), || self.look())?;
        let length = self.receive()?;
        let expected = WORD * (HEAD + self.outputs);
        let tick = samples.tick;
        match self.answer[..] {
            [FAILURE, failed, ..] if failed == tick && (WORD * HEAD..=TEXT_MAX).contains(&length) => {
                let text = &bytemuck::cast_slice(&self.answer)[WORD * HEAD..length];
                return Err(String::from_utf8_lossy(text).into_owned());
            }
            [OUTPUTS, answered, ..] if answered == tick && length == expected => {}
            [kind, answered, ..] => {
                return Err(format!(
                    "the program that computes it answered tick {tick} with a frame of kind {kind} for tick {answered} and \
                     {length} bytes; outputs have kind {OUTPUTS} and {expected} bytes"
                ));
            }
            _ => return Err(GONE.to_owned()),
        }
        let mut rest = &self.answer[HEAD..];
        for output in samples.outputs {
            let (content, after) = rest.split_at(output.len());
            output.copy_from_slice(content);
            rest = after;
        }
        Ok(())
    }
}

impl RoleFunction for Seat {
    fn compute(&mut self, samples: TickSamples<'_>) -> Result<(), String> {
        let is_last = samples.tick >= self.last_tick;
        self.state.fetch_and(CLOSED, Ordering::AcqRel);
        self.ask(samples)?;
        let closed = !is_last && self.state.fetch_or(BETWEEN_TICKS, Ordering::AcqRel) == CLOSED;
        if closed { Err(GONE.to_owned()) } else { Ok(()) }
    }
}
