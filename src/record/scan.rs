//! Reads the records of a file from its beginning to its last whole chunk.
//!
//! Must not allocate more than the file can fill, nor use a sample whose checksum is wrong.

use super::error::RecordError;
use super::recorder::{RUN, SCHEMA};
use super::track::SignalInfo;
use super::writer::{CHECKSUM, checksum};
use crate::bus::Signal;
use crate::files;
use crate::sample::{CDR_HEADER, Layout};
use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{MAGIC, McapError};
use std::collections::BTreeMap;
use std::io::{self, Read};
use std::os::unix::fs::FileExt;
use std::path::Path;

/// Largest sample of a recording, bytes.
const SAMPLE_BYTES: usize = 64 << 20;
/// Largest record, compressed or not: a chunk may exceed its size by one sample.
const RECORD_BYTES: usize = 2 * SAMPLE_BYTES;
/// Least number of bytes per read.
const READ_BYTES: usize = 64 << 10;
/// Opcode and length before every record, bytes.
const RECORD_HEAD: usize = 9;

/// The reason that a file cannot be read to its end.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Flaw {
    /// The file was cut off; the rest is unchanged.
    Cut(&'static str),
    /// The file was changed.
    Damaged(String),
}

/// The contents of a file except samples.
#[derive(Default)]
pub(super) struct Content {
    /// True once the header has been read.
    pub begun: bool,
    schemas: BTreeMap<u16, (String, String)>,
    pub signals: Vec<SignalInfo>,
    /// Bytes per sample, by channel.
    sizes: BTreeMap<u16, usize>,
    pub metadata: BTreeMap<String, BTreeMap<String, String>>,
    data_ended: bool,
    ended: bool,
}

impl Content {
    /// Reads a record outside of chunks. Ignores schemas and channels there, because no checksum covers them.
    fn read_record(&mut self, record: Record<'_>) -> Result<(), String> {
        match record {
            Record::Header(_) => self.begun = true,
            Record::Metadata(mut metadata) => {
                let name = metadata.name;
                let recorded = metadata.metadata.remove(CHECKSUM);
                // A file of another version may have no checksum; it is refused later, because of its version.
                let foreign = metadata.metadata.get("schema").is_some_and(|schema| schema != SCHEMA);
                let exempt = recorded.is_none() && name == RUN && foreign;
                if !exempt && recorded.as_ref() != Some(&checksum(&name, &metadata.metadata)) {
                    return Err(format!("the checksum of metadata `{name}` is wrong"));
                }
                if self.metadata.contains_key(&name) {
                    return Err(format!("metadata `{name}` occurs twice"));
                }
                self.metadata.insert(name, metadata.metadata);
            }
            Record::DataEnd(_) if std::mem::replace(&mut self.data_ended, true) => {
                return Err("the data section ends twice".to_owned());
            }
            Record::Footer(_) if !self.data_ended => return Err("the footer is before the end of the data".to_owned()),
            Record::Footer(_) => self.ended = true,
            Record::Message { .. } => return Err("a sample is outside of the chunks".to_owned()),
            _ => {}
        }
        Ok(())
    }

    /// Reads a chunk after checking its checksum.
    fn read_chunk(
        &mut self,
        reader: &mut LinearReader,
        record: &[u8],
        sample: &mut impl FnMut(u16, u64, &[u8]),
    ) -> Result<(), String> {
        let text = |error: McapError| error.to_string();
        let Record::Chunk { header, .. } = mcap::parse_record(op::CHUNK, record).map_err(text)? else {
            return Err("a chunk is malformed".to_owned());
        };
        if header.compression != "lz4" || header.uncompressed_crc == 0 || self.data_ended {
            return Err("a chunk is not LZ4-compressed, has no checksum, or follows the end of the data".to_owned());
        }
        let room = reader.insert(RECORD_HEAD + record.len());
        room[0] = op::CHUNK;
        room[1..RECORD_HEAD].copy_from_slice(&(record.len() as u64).to_le_bytes());
        room[RECORD_HEAD..].copy_from_slice(record);
        reader.notify_read(RECORD_HEAD + record.len());
        while let Some(event) = reader.next_event() {
            match event.map_err(text)? {
                LinearReadEvent::ReadRequest(_) => break,
                LinearReadEvent::Record { data, opcode } => {
                    self.read_chunk_record(mcap::parse_record(opcode, data).map_err(text)?, sample)?;
                }
            }
        }
        Ok(())
    }

    /// Reads a record of a chunk.
    fn read_chunk_record(
        &mut self,
        record: Record<'_>,
        sample: &mut impl FnMut(u16, u64, &[u8]),
    ) -> Result<(), String> {
        match record {
            Record::Schema { header, data } => {
                let text = String::from_utf8_lossy(&data).into_owned();
                self.schemas.insert(header.id, (header.encoding, text));
            }
            Record::Channel(channel) if !self.sizes.contains_key(&channel.id) => {
                let topic = &channel.topic;
                let schema = self.schemas.get(&channel.schema_id);
                let (encoding, text) = schema.ok_or_else(|| format!("the schema of channel {topic} is missing"))?;
                let encoded = encoding == "ros2msg" && channel.message_encoding == "cdr";
                let layout = Layout::parse(text).filter(|layout| encoded && layout.size() < SAMPLE_BYTES);
                let layout = layout.ok_or_else(|| format!("the schema of channel {topic} is unsupported"))?;
                let about = |key: &str| channel.metadata.get(key).cloned().unwrap_or_default();
                let (body, signal) = (about("body"), about("signal"));
                if self.signals.iter().any(|known| (&known.body, &known.signal) == (&body, &signal)) {
                    return Err(format!("channel {topic} has the signal of another channel"));
                }
                self.sizes.insert(channel.id, layout.size());
                // For foreign readers: the metadata has the changes of inputs too.
                if signal == Signal::Input.name() {
                    return Ok(());
                }
                let (service, role) = (about("service"), about("role"));
                let channel = channel.id;
                self.signals.push(SignalInfo { service, body, signal, role, layout, samples: 0, channel });
            }
            Record::Message { header, data } => {
                let (sequence, channel) = (header.sequence, header.channel_id);
                let size = self.sizes.get(&channel).ok_or_else(|| format!("channel {channel} is not declared"))?;
                if data.len() != CDR_HEADER.len() + size || data[..CDR_HEADER.len()] != CDR_HEADER {
                    return Err(format!("sample {sequence} of channel {channel} does not match its schema"));
                }
                sample(header.channel_id, header.log_time, &data[CDR_HEADER.len()..]);
            }
            _ => {}
        }
        Ok(())
    }
}

/// Reads a file from its beginning. Returns the reason if it cannot be read to its end.
pub(super) fn scan(
    path: &Path,
    content: &mut Content,
    mut sample: impl FnMut(u16, u64, &[u8]),
) -> Result<Option<Flaw>, RecordError> {
    let failed = |source| RecordError::Read { path: path.to_owned(), source };
    let mut file = files::open(path).map_err(failed)?;
    let mut unread = file.metadata().map_err(failed)?.len();
    let mut last = [0; MAGIC.len()];
    // A file with its end magic was not cut off: a record that is too long for it has a damaged length.
    let has_end = match unread.checked_sub(MAGIC.len() as u64) {
        Some(at) => {
            file.read_exact_at(&mut last, at).map(|()| last == *MAGIC).or_else(false_if_truncated).map_err(failed)?
        }
        None => false,
    };
    let cut = || match has_end {
        true => Flaw::Damaged("a record is longer than the rest of the file".to_owned()),
        false => Flaw::Cut("the file has no end: the recorder was killed, or the disk was full"),
    };
    let limited = LinearReaderOptions::default().with_record_length_limit(RECORD_BYTES);
    let mut reader = LinearReader::new_with_options(
        limited
            .clone()
            .with_emit_chunks(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            .with_check_finishes_after_end_magic(true),
    );
    let mut chunks = LinearReader::new_with_options(
        limited.with_skip_start_magic(true).with_skip_end_magic(true).with_prevalidate_chunk_crcs(true),
    );
    while let Some(event) = reader.next_event() {
        let taken = match event {
            // After the footer the reader requests more, to check that nothing follows.
            Ok(LinearReadEvent::ReadRequest(wanted)) if wanted as u64 <= unread || content.ended => {
                let wanted = wanted.max(READ_BYTES).min(unread.max(1) as usize);
                let read = file.read(reader.insert(wanted)).map_err(failed)?;
                unread = unread.saturating_sub(read as u64);
                reader.notify_read(read);
                Ok(())
            }
            Ok(LinearReadEvent::ReadRequest(_)) => return Ok(Some(cut())),
            Ok(LinearReadEvent::Record { data, opcode: op::CHUNK }) => {
                content.read_chunk(&mut chunks, data, &mut sample)
            }
            Ok(LinearReadEvent::Record { data, opcode }) => {
                let record = mcap::parse_record(opcode, data).map_err(|error| error.to_string());
                record.and_then(|record| content.read_record(record))
            }
            // An open chunk has this length until it is closed.
            Err(McapError::RecordTooLarge { opcode: op::CHUNK, len: u64::MAX }) => return Ok(Some(cut())),
            Err(error) => Err(error.to_string()),
        };
        if let Err(reason) = taken {
            return Ok(Some(Flaw::Damaged(reason)));
        }
    }
    Ok(None)
}

/// Returns false if the file was truncated while being read; passes other errors on.
fn false_if_truncated(error: io::Error) -> io::Result<bool> {
    if error.kind() == io::ErrorKind::UnexpectedEof { Ok(false) } else { Err(error) }
}
