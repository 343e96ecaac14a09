//! A recording as it is written: an MCAP file whose chunks are closed at a bounded age and size.
//!
//! Room for a chunk, and for the summary that ends the file, is asked for before the chunk is begun: a full disk is then
//! noticed while the file can still be ended as it should. Where the system cannot promise room, what a failed write left
//! is cut off, and the file ends with its last whole chunk. Every metadata record has a checksum of its own, since it is in no
//! chunk, and a file that was cut off has none of the whole. Must not know samples.

use super::RecordError;
use super::taps::{Channel, MessageSink};
use crate::clock::monotonic_ns;
use crate::files;
use crate::sample::{Layout, MESSAGE_ENCODING, SCHEMA_ENCODING, frame, topic_of};
use mcap::records::{MessageHeader, Metadata};
use mcap::{McapError, WriteOptions};
use rustix::fs::{FallocateFlags, fallocate};
use rustix::io::Errno;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use xxhash_rust::xxh3::Xxh3;

/// The key of a metadata record's checksum.
pub const CHECKSUM: &str = "checksum";

/// The checksum of a metadata record: over its name and all of its other entries, each with its length before it.
pub fn checksum(name: &str, entries: &BTreeMap<String, String>) -> String {
    let mut hasher = Xxh3::new();
    let texts = entries.iter().flat_map(|(key, value)| [key.as_str(), value.as_str()]);
    for text in [name].into_iter().chain(texts) {
        hasher.update(&(text.len() as u64).to_le_bytes());
        hasher.update(text.as_bytes());
    }
    format!("{:016x}", hasher.digest())
}

/// A chunk is closed when it holds so many bytes.
const CHUNK_BYTES: usize = 256 << 10;
/// A chunk is closed when it is so old, ns: so much a crash may lose.
const CHUNK_NS: u64 = 500_000_000;
/// The most that is written around a message's body: its header in the chunk and its entry in the index, bytes.
const MESSAGE_OVERHEAD: usize = 31 + 16;
/// The least room kept for the end of the file: indexes, statistics, counters; bytes.
const END_BYTES: u64 = 64 << 10;
/// What the summary says of a chunk, and of each channel in it; bytes.
const CHUNK_INDEX_BYTES: u64 = 128;
const CHANNEL_INDEX_BYTES: u64 = 32;

/// A file that is being recorded to.
pub struct Writer {
    mcap: Option<mcap::Writer<BufWriter<Sink>>>,
    /// The same file, for what its writer cannot do.
    file: files::Created,
    path: PathBuf,
    channels: u64,
    chunks: u64,
    /// Where the last whole chunk ends.
    whole: u64,
    pending: usize,
    /// When the chunk at hand was begun, ns; none between two.
    began_ns: Option<u64>,
    frame: Vec<u8>,
}

impl Writer {
    /// Makes the file, or empties it.
    ///
    /// # Errors
    /// [`RecordError::Write`].
    pub fn create(path: &Path) -> Result<Self, RecordError> {
        let failed = |source| RecordError::Write { path: path.to_owned(), source };
        let file = files::create(path).map_err(failed)?;
        let sink = Sink { file: file.try_clone().map_err(failed)?, broken: false };
        let options = WriteOptions::new()
            .profile("ros2")
            .library(concat!("corotate ", env!("CARGO_PKG_VERSION")))
            .compression(Some(mcap::Compression::Lz4))
            .chunk_size(None);
        let mcap = options.create(BufWriter::with_capacity(64 << 10, sink)).map_err(|error| wrong(path, error))?;
        Ok(Self {
            mcap: Some(mcap),
            file,
            path: path.to_owned(),
            channels: 0,
            chunks: 0,
            whole: 0,
            pending: 0,
            began_ns: None,
            frame: Vec::new(),
        })
    }

    /// Writes what is known of the run, with its checksum, and closes the chunk at hand.
    ///
    /// # Errors
    /// [`RecordError::Write`].
    pub fn metadata(&mut self, name: &str, mut entries: BTreeMap<String, String>) -> Result<(), RecordError> {
        entries.insert(CHECKSUM.to_owned(), checksum(name, &entries));
        let metadata = Metadata { name: name.to_owned(), metadata: entries };
        self.attempt(|mcap| mcap.write_metadata(&metadata))?;
        self.close_chunk()
    }

    /// Closes the chunk at hand if it is large or old enough.
    ///
    /// # Errors
    /// [`RecordError::Write`].
    pub fn turn(&mut self, now_ns: u64) -> Result<(), RecordError> {
        let old = self.began_ns.is_some_and(|began_ns| now_ns.saturating_sub(began_ns) >= CHUNK_NS);
        if old || self.pending >= CHUNK_BYTES { self.close_chunk() } else { Ok(()) }
    }

    fn close_chunk(&mut self) -> Result<(), RecordError> {
        self.attempt(mcap::Writer::flush)?;
        (self.pending, self.began_ns) = (0, None);
        self.chunks += 1;
        self.whole = (&*self.file).stream_position().map_err(|source| self.failed(source))?;
        Ok(())
    }

    /// Asks for room for one more chunk and the end of the file.
    fn reserve(&mut self, first: usize) -> Result<(), RecordError> {
        let end = END_BYTES + self.chunks * (CHUNK_INDEX_BYTES + CHANNEL_INDEX_BYTES * self.channels);
        // What does not compress grows by a little, and the last sample may be beyond the size.
        let chunk = (CHUNK_BYTES + CHUNK_BYTES / 4 + 2 * first) as u64;
        match fallocate(self.file.as_fd(), FallocateFlags::KEEP_SIZE, self.whole, chunk + end) {
            Err(error @ (Errno::NOSPC | Errno::DQUOT | Errno::FBIG)) => {
                Err(RecordError::Full { path: self.path.clone(), source: error.into() })
            }
            // Not every file system can promise room.
            _ => Ok(()),
        }
    }

    /// Ends the file: closes the last chunk, and writes the summary by which readers find everything. Returns its length,
    /// bytes.
    ///
    /// # Errors
    /// [`RecordError::Write`].
    pub fn finish(&mut self) -> Result<u64, RecordError> {
        self.attempt(|mcap| mcap.finish().map(drop))?;
        if let Some(mcap) = self.mcap.take() {
            mcap.into_inner().into_inner().map_err(|error| self.failed(error.into_error()))?;
        }
        let length = (&*self.file).stream_position().map_err(|source| self.failed(source))?;
        // Gives back the room that was not used.
        self.file.set_len(length).and_then(|()| self.file.sync_data()).map_err(|source| self.failed(source))?;
        Ok(length)
    }

    /// Does something with the file; if that fails, leaves it with its last whole chunk as the end.
    fn attempt<T>(
        &mut self,
        act: impl FnOnce(&mut mcap::Writer<BufWriter<Sink>>) -> Result<T, McapError>,
    ) -> Result<T, RecordError> {
        let Some(mcap) = &mut self.mcap else { return Err(self.failed(io::Error::other("it has ended already"))) };
        match act(mcap) {
            Ok(done) => Ok(done),
            Err(error) => {
                // Its end must not be written behind the cut: the sink takes nothing any more once it has failed.
                self.mcap = None;
                let _ = self.file.set_len(self.whole);
                Err(wrong(&self.path, error))
            }
        }
    }

    fn failed(&self, source: io::Error) -> RecordError {
        RecordError::Write { path: self.path.clone(), source }
    }
}

impl MessageSink for Writer {
    fn channel(
        &mut self,
        service: &str,
        layout: &Layout,
        about: BTreeMap<String, String>,
    ) -> Result<Channel, RecordError> {
        self.channels += 1;
        let (name, text) = (layout.message_name(), layout.definition());
        self.attempt(|mcap| {
            let schema = mcap.add_schema(&name, SCHEMA_ENCODING, text.as_bytes())?;
            mcap.add_channel(schema, &topic_of(service), MESSAGE_ENCODING, &about)
        })
    }

    /// After an error for want of room the file can still be finished.
    fn message(
        &mut self,
        channel_id: Channel,
        sequence: u32,
        due_ns: u64,
        logged_ns: u64,
        body: &[u8],
    ) -> Result<(), RecordError> {
        if self.began_ns.is_none() {
            self.reserve(body.len())?;
            self.began_ns = Some(monotonic_ns());
        }
        frame(body, &mut self.frame);
        self.pending += self.frame.len() + MESSAGE_OVERHEAD;
        let header = MessageHeader { channel_id, sequence, log_time: logged_ns, publish_time: due_ns };
        let frame = std::mem::take(&mut self.frame);
        let written = self.attempt(|mcap| mcap.write_to_known_channel(&header, &frame));
        self.frame = frame;
        written?;
        if self.pending >= CHUNK_BYTES { self.close_chunk() } else { Ok(()) }
    }
}

fn wrong(path: &Path, error: McapError) -> RecordError {
    let source = match error {
        McapError::Io(source) => source,
        other => io::Error::other(other),
    };
    RecordError::Write { path: path.to_owned(), source }
}

/// The file behind the writer. After a failure it takes nothing any more.
struct Sink {
    file: File,
    broken: bool,
}

impl Write for Sink {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.broken {
            return Err(io::Error::other("an earlier write failed"));
        }
        let written = self.file.write(bytes);
        self.broken = written.as_ref().is_err_and(|error| error.kind() != io::ErrorKind::Interrupted);
        written
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Seek for Sink {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.file.seek(to)
    }
}
