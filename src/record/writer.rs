//! Writes an MCAP file whose chunks are closed at a bounded age and size.
//!
//! Space for a chunk and for the final summary is reserved before the chunk begins, so a full disk is noticed while the file
//! can still be completed. On file systems without reservation, a failed write is cut off, and the file ends with its last
//! whole chunk. Every metadata record has its own checksum: it is outside of the chunks, and a truncated file has no
//! checksum over its whole. Must not interpret samples.

use super::error::RecordError;
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

/// Returns the checksum of a metadata record, over its name and all other entries, each preceded by its length.
pub fn checksum(name: &str, entries: &BTreeMap<String, String>) -> String {
    let mut hasher = Xxh3::new();
    let texts = entries.iter().flat_map(|(key, value)| [key.as_str(), value.as_str()]);
    for text in [name].into_iter().chain(texts) {
        hasher.update(&(text.len() as u64).to_le_bytes());
        hasher.update(text.as_bytes());
    }
    format!("{:016x}", hasher.digest())
}

/// Size at which a chunk is closed.
const CHUNK_BYTES: usize = 256 << 10;
/// Age at which a chunk is closed, ns. A crash loses at most this much time.
const CHUNK_NS: u64 = 500_000_000;
/// Largest overhead of a message: its header in the chunk and its entry in the index, bytes.
const MESSAGE_OVERHEAD: usize = 31 + 16;
/// Least space reserved for the end of the file: indexes, statistics, counters; bytes.
const END_BYTES: u64 = 64 << 10;
/// Bytes in the summary per chunk.
const CHUNK_INDEX_BYTES: u64 = 128;
/// Bytes in the summary per chunk and channel.
const CHANNEL_INDEX_BYTES: u64 = 32;

/// A writer of a recording.
pub struct Writer {
    mcap: Option<mcap::Writer<BufWriter<Sink>>>,
    /// The same file, to reserve space and to truncate.
    file: files::Created,
    path: PathBuf,
    channels: u64,
    chunks: u64,
    /// Length of the file up to its last whole chunk.
    whole_bytes: u64,
    pending: usize,
    /// Time at which the current chunk began, ns; `None` between chunks.
    chunk_began_ns: Option<u64>,
    frame: Vec<u8>,
}

impl Writer {
    /// Creates the file, or empties it.
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
        let mcap =
            options.create(BufWriter::with_capacity(64 << 10, sink)).map_err(|error| write_error(path, error))?;
        Ok(Self {
            mcap: Some(mcap),
            file,
            path: path.to_owned(),
            channels: 0,
            chunks: 0,
            whole_bytes: 0,
            pending: 0,
            chunk_began_ns: None,
            frame: Vec::new(),
        })
    }

    /// Writes a metadata record with its checksum, and closes the current chunk.
    ///
    /// # Errors
    /// [`RecordError::Write`].
    pub fn metadata(&mut self, name: &str, mut entries: BTreeMap<String, String>) -> Result<(), RecordError> {
        entries.insert(CHECKSUM.to_owned(), checksum(name, &entries));
        let metadata = Metadata { name: name.to_owned(), metadata: entries };
        self.attempt(|mcap| mcap.write_metadata(&metadata))?;
        self.close_chunk()
    }

    /// Writes a metadata record like [`metadata`](Self::metadata), unless the disk has no room for it beside the end of the file.
    ///
    /// # Errors
    /// [`RecordError::Write`].
    pub fn metadata_if_room(&mut self, name: &str, entries: BTreeMap<String, String>) -> Result<(), RecordError> {
        let bytes: usize = entries.iter().map(|(key, value)| key.len() + value.len()).sum();
        match self.reserve(bytes) {
            Err(RecordError::Full { .. }) => Ok(()),
            Err(error) => Err(error),
            Ok(()) => self.metadata(name, entries),
        }
    }

    /// Closes the current chunk if it is large or old enough.
    ///
    /// # Errors
    /// [`RecordError::Write`].
    pub fn close_due_chunk(&mut self, now_ns: u64) -> Result<(), RecordError> {
        let old = self.chunk_began_ns.is_some_and(|began_ns| now_ns.saturating_sub(began_ns) >= CHUNK_NS);
        if old || self.pending >= CHUNK_BYTES { self.close_chunk() } else { Ok(()) }
    }

    fn close_chunk(&mut self) -> Result<(), RecordError> {
        self.attempt(mcap::Writer::flush)?;
        (self.pending, self.chunk_began_ns) = (0, None);
        self.chunks += 1;
        self.whole_bytes = (&*self.file).stream_position().map_err(|source| self.failed(source))?;
        Ok(())
    }

    /// Reserves space for one more chunk, further bytes, and the end of the file.
    fn reserve(&mut self, bytes: usize) -> Result<(), RecordError> {
        let end = END_BYTES + self.chunks * (CHUNK_INDEX_BYTES + CHANNEL_INDEX_BYTES * self.channels);
        // Incompressible data grows slightly.
        let chunk = (CHUNK_BYTES + CHUNK_BYTES / 4 + bytes) as u64;
        match fallocate(self.file.as_fd(), FallocateFlags::KEEP_SIZE, self.whole_bytes, chunk + end) {
            Err(error @ (Errno::NOSPC | Errno::DQUOT | Errno::FBIG)) => {
                Err(RecordError::Full { path: self.path.clone(), source: error.into() })
            }
            // Not every file system supports reservation.
            _ => Ok(()),
        }
    }

    /// Closes the last chunk and writes the summary with all indexes. Returns the length of the file, bytes.
    ///
    /// # Errors
    /// [`RecordError::Write`].
    pub fn finish(&mut self) -> Result<u64, RecordError> {
        self.attempt(|mcap| mcap.finish().map(drop))?;
        if let Some(mcap) = self.mcap.take() {
            mcap.into_inner().into_inner().map_err(|error| self.failed(error.into_error()))?;
        }
        let length = (&*self.file).stream_position().map_err(|source| self.failed(source))?;
        // Releases the reserved space that is left.
        self.file.set_len(length).and_then(|()| self.file.sync_data()).map_err(|source| self.failed(source))?;
        Ok(length)
    }

    /// Performs a write; if that fails, truncates the file to its last whole chunk.
    fn attempt<T>(
        &mut self,
        write: impl FnOnce(&mut mcap::Writer<BufWriter<Sink>>) -> Result<T, McapError>,
    ) -> Result<T, RecordError> {
        let Some(mcap) = &mut self.mcap else {
            return Err(self.failed(io::Error::other("the file is already closed")));
        };
        match write(mcap) {
            Ok(written) => Ok(written),
            Err(error) => {
                // Dropping the writer must not append a footer: the sink refuses all writes once one has failed.
                self.mcap = None;
                let _ = self.file.set_len(self.whole_bytes);
                Err(write_error(&self.path, error))
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

    /// Writes a message. After [`RecordError::Full`] the file can still be finished.
    fn message(
        &mut self,
        channel_id: Channel,
        sequence: u32,
        due_ns: u64,
        logged_ns: u64,
        body: &[u8],
    ) -> Result<(), RecordError> {
        if self.chunk_began_ns.is_none() {
            // The last sample may exceed the chunk size.
            self.reserve(2 * body.len())?;
            self.chunk_began_ns = Some(monotonic_ns());
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

fn write_error(path: &Path, error: McapError) -> RecordError {
    let source = match error {
        McapError::Io(source) => source,
        error => io::Error::other(error),
    };
    RecordError::Write { path: path.to_owned(), source }
}

/// The file behind the writer. Refuses all writes after a failed one.
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
