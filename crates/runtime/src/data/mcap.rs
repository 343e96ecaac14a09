//! Reads rows of an MCAP file: ROS 2 `sensor_msgs/msg/Imu` messages in CDR, or a recording of this program.
//!
//! It reads from beginning to end, one record at a time. Must not trust a length in a message beyond the message's bytes.

use super::form::{Cut, DataError, Meaning, Options, Row, Rows};
use super::packed::Zstd;
use super::stamp::Stamp;
use super::unit::{RateUnit, TimeUnit};
use crate::sample::{FieldKind, Layout, NO_SAMPLE};
use mcap::McapError;
use mcap::records::Record;
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

/// The longest record, packed or not, bytes.
const RECORD_BYTES: usize = 128 << 20;
/// The least number of bytes read at once.
const READ_BYTES: usize = 64 << 10;
/// The length of the CDR header before a message's body, bytes.
const CDR_HEADER: usize = 4;
/// The field of recorded samples that holds the angular velocity.
const OMEGA: &str = "omega_rad_s";

/// A reader of an MCAP file.
pub struct Mcap {
    path: PathBuf,
    file: File,
    reader: LinearReader,
    content: Content,
}

/// The schemas, topics and counts read so far.
struct Content {
    topic: Option<String>,
    schemas: BTreeMap<u16, (String, Vec<u8>)>,
    /// The topics with an angular velocity.
    topics: Vec<String>,
    /// The channels of the chosen topic.
    chosen: Vec<(u16, Form)>,
    messages: u64,
    meaning: Meaning,
}

/// The format of a topic's messages.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Form {
    /// `sensor_msgs/msg/Imu`
    Imu,
    /// A recorded sample.
    Own(Offsets),
}

/// The fields of a recorded sample: offsets from the start of the body, bytes.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Offsets {
    omega: usize,
    valid: Option<usize>,
    generation: Option<usize>,
}

impl Mcap {
    /// Returns true if a file begins with the MCAP magic.
    pub fn is_begun(start: &[u8]) -> bool {
        start.starts_with(mcap::MAGIC)
    }

    /// Creates a reader; it reads on the first row.
    ///
    /// # Errors
    /// [`DataError::Option`] for an option of a table.
    pub fn new(file: File, path: &Path, options: &Options) -> Result<Self, DataError> {
        for (name, given) in [
            ("time", options.time.is_some()),
            ("rates", options.rates.is_some()),
            ("time unit", options.time_unit.is_some()),
            ("by", options.by.is_some()),
            ("header", options.unnamed),
            ("skip", options.skip > 0),
        ] {
            if given {
                let reason = "an MCAP file has topics in place of columns, and stamps in ns; leave the option out, or give a topic";
                return Err(DataError::Option { name, reason: reason.to_owned() });
            }
        }
        let mut reader = LinearReader::new_with_options(
            LinearReaderOptions::default().with_record_length_limit(RECORD_BYTES).with_prevalidate_chunk_crcs(true),
        );
        reader.add_decompressor(Zstd::default()).expect("its name is not empty");
        let meaning = Meaning {
            time: ("header.stamp".to_owned(), TimeUnit::Nanoseconds),
            rates: (
                ["x", "y", "z"].map(|axis| format!("angular_velocity.{axis}")),
                options.rate_unit.unwrap_or(RateUnit::RadiansPerSecond),
            ),
            // The message's definition says rad/s, but some drivers write deg/s.
            assumed: if options.rate_unit.is_none() { vec!["rate"] } else { Vec::new() },
            found: String::new(),
            forces: (options.cut == Cut::Free)
                .then(|| ["x", "y", "z"].map(|axis| format!("linear_acceleration.{axis}"))),
        };
        let content = Content {
            topic: options.topic.clone(),
            schemas: BTreeMap::new(),
            topics: Vec::new(),
            chosen: Vec::new(),
            messages: 0,
            meaning,
        };
        Ok(Self { path: path.to_owned(), file, reader, content })
    }

    fn form(&self, reason: String) -> DataError {
        DataError::Form { path: self.path.clone(), line: self.content.messages, reason }
    }
}

impl Rows for Mcap {
    fn read(&mut self, row: &mut Row) -> Result<bool, DataError> {
        loop {
            let taken = match self.reader.next_event() {
                None => break,
                Some(Ok(LinearReadEvent::ReadRequest(wanted))) => {
                    let room = self.reader.insert(wanted.max(READ_BYTES));
                    let failed = |source| DataError::Read { path: self.path.clone(), source };
                    let count = self.file.read(room).map_err(failed)?;
                    self.reader.notify_read(count);
                    Ok(false)
                }
                Some(Ok(LinearReadEvent::Record { data, opcode })) => mcap::parse_record(opcode, data)
                    .map_err(|error| words(&error))
                    .and_then(|record| self.content.take(&record, row)),
                Some(Err(error)) => Err(words(&error)),
            };
            if taken.map_err(|reason| self.form(reason))? {
                return Ok(true);
            }
        }
        if !self.content.chosen.is_empty() {
            return Ok(false);
        }
        let columns = self.content.topics.join(", ");
        let (reason, remedy) = match &self.content.topic {
            Some(topic) => (format!("no topic with an angular velocity is called `{topic}`"), "name an existing one"),
            None => ("no topic has sensor_msgs/msg/Imu, or samples of ours".to_owned(), "log one of these, or CSV"),
        };
        let remedy = remedy.to_owned();
        Err(DataError::Column { path: self.path.clone(), reason, remedy, columns })
    }

    fn meaning(&self) -> &Meaning {
        &self.content.meaning
    }
}

/// Returns the mistake and its remedy.
fn words(error: &McapError) -> String {
    match error {
        McapError::UnsupportedCompression(kind) => {
            format!("its chunks are packed with {kind}; pack them with lz4 or zstd, or not at all")
        }
        McapError::UnexpectedEof | McapError::UnexpectedEoc => {
            "it ends within a record: its recorder was stopped, or the disk was full; recover what there is of it"
                .to_owned()
        }
        other => format!("it is damaged ({other}); recover what there is of it, or log again"),
    }
}

impl Content {
    /// Processes a record. Returns true if it was a message that gave a row.
    fn take(&mut self, record: &Record<'_>, row: &mut Row) -> Result<bool, String> {
        match record {
            Record::Schema { header, data } => {
                self.schemas.insert(header.id, (header.name.clone(), data.to_vec()));
            }
            Record::Channel(channel) => {
                let form = self.schemas.get(&channel.schema_id).and_then(|(name, data)| form(name, data));
                let (Some(form), "cdr") = (form, channel.message_encoding.as_str()) else { return Ok(false) };
                if self.chosen.iter().any(|(id, _)| *id == channel.id) {
                    return Ok(false);
                }
                let known = self.topics.contains(&channel.topic);
                if !known {
                    self.topics.push(channel.topic.clone());
                }
                // The end of a topic's name selects it too.
                let wanted = self.topic.as_ref().is_none_or(|topic| {
                    let rest = channel.topic.strip_suffix(topic.as_str());
                    rest.is_some_and(|rest| rest.is_empty() || rest.ends_with('/') || topic.starts_with('/'))
                });
                if !wanted {
                    return Ok(false);
                }
                match self.chosen.first() {
                    Some(_) if !known => {
                        return Err(format!("more than one topic may be meant: {}; name one", self.topics.join(", ")));
                    }
                    Some((_, first)) if *first != form => {
                        return Err(format!("{} has messages of two types; record it again", channel.topic));
                    }
                    // The first one, or another publisher of the topic.
                    _ => {}
                }
                self.chosen.push((channel.id, form));
                self.meaning.found = format!("topic {}", channel.topic);
                if matches!(form, Form::Own(_)) {
                    if self.meaning.rates.1 != RateUnit::RadiansPerSecond {
                        return Err(
                            "a recording of this program is in rad/s; leave the unit of the rates out".to_owned()
                        );
                    }
                    self.meaning.assumed.clear();
                    self.meaning.time.0 = "publish_time".to_owned();
                    self.meaning.rates.0 = [0, 1, 2].map(|index| format!("{OMEGA}[{index}]"));
                }
            }
            Record::Message { header, data } => {
                let chosen = self.chosen.iter().find(|(channel, _)| *channel == header.channel_id);
                let Some((_, form)) = chosen.copied() else { return Ok(false) };
                self.messages += 1;
                let decoded = match form {
                    Form::Imu => imu(data),
                    Form::Own(offsets) => own(data, header.publish_time, &offsets),
                };
                let (stamp, rates, force) = decoded.ok_or("the message is shorter than its type; log again")?;
                let rad_s = self.meaning.rates.1.rad_s();
                (row.number, row.stamp, row.rate_rad_s) = (self.messages, stamp, rates.map(|rate| rate * rad_s));
                row.force = Some(force);
                row.key.clear();
                return Ok(true);
            }
            _ => {}
        }
        Ok(false)
    }
}

/// Returns the format of a schema's messages, if they hold an angular velocity.
fn form(name: &str, data: &[u8]) -> Option<Form> {
    if matches!(name, "sensor_msgs/msg/Imu" | "sensor_msgs/Imu") {
        return Some(Form::Imu);
    }
    let layout = Layout::parse(std::str::from_utf8(data).ok()?)?;
    let field = |name: &str, kind, count| {
        let found = layout.columns.iter().find(|column| column.name == name)?;
        (found.kind == kind && found.count == count).then_some(found.offset)
    };
    let (valid, generation) = (field("valid", FieldKind::U64, 1), field("generation", FieldKind::U64, 1));
    Some(Form::Own(Offsets { omega: field(OMEGA, FieldKind::F64, 3)?, valid, generation }))
}

/// A stamp, three rates, and the values of an accelerometer.
type Decoded = (Option<Stamp>, [f64; 3], [f64; 3]);

/// Returns the value if it is finite, else NaN.
fn finite(value: f64) -> f64 {
    if value.is_finite() { value } else { f64::NAN }
}

/// Reads `sensor_msgs/msg/Imu`: header (stamp, frame), then orientation, angular velocity and acceleration, each with its covariance.
fn imu(message: &[u8]) -> Option<Decoded> {
    let (header, body) = message.split_at_checked(CDR_HEADER)?;
    let little = header[1] & 1 == 1;
    let word = |at: usize| {
        let bytes: [u8; 4] = body.get(at..at.checked_add(4)?)?.try_into().ok()?;
        Some(if little { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) })
    };
    let number = |at: usize| {
        let bytes: [u8; 8] = body.get(at..at.checked_add(8)?)?.try_into().ok()?;
        Some(if little { f64::from_le_bytes(bytes) } else { f64::from_be_bytes(bytes) })
    };
    let (seconds, nanoseconds, length) = (word(0)?.cast_signed(), word(4)?, word(8)?);
    let stamp = i64::from(seconds) * 1_000_000_000 + i64::from(nanoseconds);
    // 8-byte numbers are aligned to 8 within the body.
    let orientation = 12_usize.checked_add(length as usize)?.checked_next_multiple_of(8)?;
    let first = orientation.checked_add(8 * (4 + 9))?;
    let three = |first: usize| Some([number(first)?, number(first + 8)?, number(first + 16)?].map(finite));
    let force = three(first.checked_add(8 * (3 + 9))?).unwrap_or([f64::NAN; 3]);
    Some((Some(Stamp::whole(stamp, TimeUnit::Nanoseconds)), three(first)?, force))
}

/// Reads a recorded sample. A no-sample marker has no stamp; an invalid component has no value.
fn own(message: &[u8], publish_time: u64, offsets: &Offsets) -> Option<Decoded> {
    let body = message.get(CDR_HEADER..)?;
    let word = |at: usize| Some(u64::from_le_bytes(body.get(at..at.checked_add(8)?)?.try_into().ok()?));
    let valid = offsets.valid.map_or(Some(u64::MAX), word)?;
    let no_sample = offsets.generation.map_or(Some(0), word)? & NO_SAMPLE != 0;
    let mut rates = [f64::NAN; 3];
    for (axis, rate) in rates.iter_mut().enumerate() {
        let value = f64::from_bits(word(offsets.omega.checked_add(8 * axis)?)?);
        if valid & (1 << axis) != 0 {
            *rate = finite(value);
        }
    }
    let stamp = i64::try_from(publish_time).ok().filter(|_| !no_sample);
    Some((stamp.map(|stamp| Stamp::whole(stamp, TimeUnit::Nanoseconds)), rates, [f64::NAN; 3]))
}

#[cfg(test)]
mod tests {
    use super::super::Log;
    use super::*;
    use mcap::records::MessageHeader;

    fn message(little: bool, seconds: i32, nanoseconds: u32, frame: &str, rates: [f64; 3]) -> Vec<u8> {
        let word = |value: u32| if little { value.to_le_bytes() } else { value.to_be_bytes() };
        let number = |value: f64| if little { value.to_le_bytes() } else { value.to_be_bytes() };
        let mut body = [word(seconds.cast_unsigned()), word(nanoseconds), word(frame.len() as u32 + 1)].concat();
        body.extend(frame.bytes().chain([0]));
        body.resize(body.len().next_multiple_of(8), 0);
        body.extend([9.0; 13].into_iter().chain(rates).chain([7.0; 21]).flat_map(number));
        [vec![0, u8::from(little), 0, 0], body].concat()
    }

    fn file(directory: &Path, topics: &[&str], messages: &[(usize, Vec<u8>)]) -> PathBuf {
        packed_file(directory, topics, messages, Some(mcap::Compression::Lz4))
    }

    fn packed_file(
        directory: &Path,
        topics: &[&str],
        messages: &[(usize, Vec<u8>)],
        compression: Option<mcap::Compression>,
    ) -> PathBuf {
        let path = directory.join("imu.mcap");
        let options = mcap::WriteOptions::new().compression(compression);
        let mut writer = options.create(std::io::BufWriter::new(File::create(&path).unwrap())).unwrap();
        let schema = writer.add_schema("sensor_msgs/msg/Imu", "ros2msg", b"").unwrap();
        let ids: Vec<u16> =
            topics.iter().map(|topic| writer.add_channel(schema, topic, "cdr", &BTreeMap::new()).unwrap()).collect();
        for (sequence, (topic, data)) in messages.iter().enumerate() {
            let header =
                MessageHeader { channel_id: ids[*topic], sequence: sequence as u32, log_time: 0, publish_time: 0 };
            writer.write_to_known_channel(&header, data).unwrap();
        }
        writer.finish().unwrap();
        path
    }

    #[test]
    fn imu_messages_of_either_byte_order_and_any_frame_are_read() {
        let directory = tempfile::tempdir().unwrap();
        let messages = [
            (0, message(true, 1_763_800_000, 999_999_990, "imu_link", [1.0, 2.0, 3.0])),
            (1, message(true, 1, 0, "other", [9.0; 3])),
            (0, message(false, 1_763_800_001, 0, "", [1.5, f64::NAN, 3.5])),
            (0, message(true, 1_763_800_001, 10, "a", [4.0, 5.0, 6.0])),
        ];
        let path = file(directory.path(), &["/imu/data", "/imu/raw"], &messages);
        let two = Log::open(&path, &Options::default()).err().unwrap().to_string();
        assert!(two.contains("more than one topic may be meant: /imu/data, /imu/raw; name one"), "{two}");
        let options = Options { topic: Some("data".to_owned()), ..Options::default() };
        let mut log = Log::open(&path, &options).unwrap();
        let entries: Vec<_> = log.by_ref().map(Result::unwrap).collect();
        assert_eq!(entries.iter().map(|entry| entry.row).collect::<Vec<_>>(), [1, 3]);
        assert_eq!(entries[1].rate_rad_s, [4.0, 5.0, 6.0]);
        assert!((entries[1].time_s - 2e-8).abs() < 1e-22, "{}", entries[1].time_s);
        assert_eq!(log.counts().incomplete, 1);
        let none = Log::open(&path, &Options { topic: Some("ata".to_owned()), ..Options::default() }).err().unwrap();
        assert!(none.to_string().contains("is called `ata`; name an existing one"), "{none}");
    }

    #[test]
    fn the_unit_of_the_rates_is_honoured_and_options_of_tables_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        let messages: Vec<_> =
            (0..9).map(|n| (0, message(true, 1, n * 10_000_000, "imu", [450.0, f64::from(n), 3.0]))).collect();
        let path = file(directory.path(), &["/imu"], &messages);
        let refused = Log::open(&path, &Options::default()).unwrap().find_map(Result::err).unwrap().to_string();
        assert!(refused.contains("--rate-unit deg/s"), "{refused}");
        let degrees = Options { rate_unit: Some(RateUnit::DegreesPerSecond), ..Options::default() };
        let first = Log::open(&path, &degrees).unwrap().next().unwrap().unwrap();
        assert!((first.rate_rad_s[0] - 450.0_f64.to_radians()).abs() < 1e-12);
        let named = || Some("a".to_owned());
        for options in [
            Options { time: named(), ..degrees.clone() },
            Options { rates: Some(["a", "b", "c"].map(str::to_owned)), ..degrees.clone() },
            Options { time_unit: Some(TimeUnit::Seconds), ..degrees.clone() },
            Options { by: named(), ..degrees.clone() },
            Options { unnamed: true, ..degrees.clone() },
            Options { skip: 1, ..degrees.clone() },
        ] {
            assert!(matches!(Log::open(&path, &options).err(), Some(DataError::Option { .. })), "{options:?}");
        }
    }

    /// ROS 2 writes unpacked chunks by default, and packs them on request.
    #[test]
    fn chunks_may_be_packed_or_not() {
        let directory = tempfile::tempdir().unwrap();
        let messages: Vec<_> =
            (0..9).map(|n| (0, message(true, 1, n * 1000, "imu", [f64::from(n), 2.0, 3.0]))).collect();
        for compression in [None, Some(mcap::Compression::Zstd)] {
            let path = packed_file(directory.path(), &["/imu"], &messages, compression);
            let log = Log::open(&path, &Options::default()).unwrap();
            assert_eq!(log.map(Result::unwrap).count(), 9);
        }
    }

    #[test]
    fn a_file_cut_anywhere_or_with_any_byte_changed_does_not_panic() {
        let directory = tempfile::tempdir().unwrap();
        let messages: Vec<_> =
            (0..20).map(|n| (0, message(true, 1, n * 1000, "imu", [f64::from(n), 2.0, 3.0]))).collect();
        let path = file(directory.path(), &["/imu"], &messages);
        let whole = std::fs::read(&path).unwrap();
        let damaged = directory.path().join("other.mcap");
        let count = |bytes: &[u8]| {
            std::fs::write(&damaged, bytes).unwrap();
            let log = Log::open(&damaged, &Options::default());
            log.map_or(0, |log| log.filter(Result::is_ok).count())
        };
        assert_eq!(count(&whole), 20);
        for cut in (0..whole.len()).step_by(23) {
            assert!(count(&whole[..cut]) <= 20);
            let mut changed = whole.clone();
            changed[cut] ^= 0x55;
            assert!(count(&changed) <= 20);
        }
        assert!(imu(&messages[0].1[..120]).is_none());
        let mut long = messages[0].1.clone();
        long[12..16].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(imu(&long).is_none());
    }
}
