//! `corotate step`: steps runs for the parent process, over the socket that is its standard input.

use super::output::{CommandResult, Exit, Failure, fail};
use super::scenario::{Change, changed, text};
use super::shipped::scenarios;
use crate::config::{ConfigError, Document};
use crate::launch::{ScenarioKind, StepSession};
use crate::scenario::Scenario;
use crate::system::remedy;
use std::borrow::Cow;
use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::path::Path;

/// Length limit of a message, bytes.
const MESSAGE_BYTES: u32 = 64 << 20;

/// Steps runs until the parent closes the socket. Each message follows its length in bytes, a word of four bytes.
pub fn step() -> CommandResult {
    let mut session = StepSession::new(load);
    let served = io::stdin().as_fd().try_clone_to_owned().map(UnixStream::from);
    let served = served.and_then(|mut socket| serve(&mut socket, |request| session.answer(request)));
    served.map(|()| Exit::Ok).map_err(|error| {
        let text = format!("cannot serve the parent process: {error}; {}", remedy(&error));
        fail(Exit::Failure, Failure::new("peer-failed", text))
    })
}

fn serve(socket: &mut UnixStream, mut answer: impl FnMut(&[u8]) -> Vec<u8>) -> io::Result<()> {
    let mut request = Vec::new();
    loop {
        let mut length = [0; 4];
        match socket.read_exact(&mut length) {
            Err(error) if error.kind() == ErrorKind::UnexpectedEof => return Ok(()),
            read => read?,
        }
        let length = u32::from_ne_bytes(length);
        if length > MESSAGE_BYTES {
            return Err(io::Error::new(ErrorKind::InvalidData, format!("a message of {length} bytes")));
        }
        request.resize(length as usize, 0);
        socket.read_exact(&mut request)?;
        let answer = answer(&request);
        socket.write_all(&[&(answer.len() as u32).to_ne_bytes(), &answer[..]].concat())?;
    }
}

fn load(given: &str, kind: ScenarioKind, set: &[String]) -> Result<Scenario, ConfigError> {
    let shipped = |name: &str| {
        let known = scenarios().iter().find(|(known, _)| *known == name);
        known.map(|(_, text)| Cow::Borrowed(*text)).ok_or_else(|| super::scenario::unknown(name))
    };
    let changes = || set.iter().map(|argument| Change::Set(argument));
    match kind {
        ScenarioKind::Text => changed(Document::parse(given, "the scenario given")?, changes()),
        ScenarioKind::Path => Scenario::load(Path::new(given), set),
        ScenarioKind::Name => {
            let (text, origin) = text(Path::new(given), &shipped)?;
            changed(Document::parse(&text, &origin)?, changes())
        }
    }
}
