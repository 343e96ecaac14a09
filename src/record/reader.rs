//! Reads recordings: the run's metadata, its signals, and their samples as bytes, stamps and columns of numbers.
//!
//! Reads from the beginning, so a file without an end is read up to its last whole chunk. A checksum covers every byte: a
//! chunk's is checked before its samples are used, metadata has its own, and that of the whole file is checked last.
//! [`Recording::damage`] reports changes, [`Recording::incomplete`] missing parts. Must not allocate more than the file
//! can fill, nor use a sample whose checksum is wrong.

use super::error::RecordError;
use super::recorder::{CHANGES, END, INPUTS, LATE, LATE_REPORT, RUN, SCHEMA, SignalReport, layouts};
use super::writer::{CHECKSUM, checksum};
use crate::bus::Signal;
use crate::config::{RunId, ScriptedFault};
use crate::files;
use crate::input::{CHANGE_WORDS, Change};
use crate::late::LateReport;
use crate::sample::{CDR_HEADER, FieldKind, Layout, Order, Place, Stamp};
use crate::scenario::Scenario;
use crate::telemetry::{Grant, Ticks};
use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{MAGIC, McapError};
use std::collections::BTreeMap;
use std::io::{self, Read};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use xxhash_rust::xxh3::xxh3_64;

/// Largest sample of a recording, bytes.
const SAMPLE_BYTES: usize = 64 << 20;
/// Largest record, compressed or not: a chunk may exceed its size by one sample.
const RECORD_BYTES: usize = 2 * SAMPLE_BYTES;
/// Least number of bytes per read.
const READ_BYTES: usize = 64 << 10;
/// Opcode and length before every record, bytes.
const RECORD_HEAD: usize = 9;

/// An open recording.
///
/// ```
/// use corotate::config::SHIPPED;
/// use corotate::launch::{Launch, run};
/// use corotate::record::Recording;
/// use corotate::scenario::Scenario;
/// use std::sync::atomic::AtomicUsize;
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// # let directory = tempfile::tempdir()?;
/// # let file = directory.path().join("run.mcap");
/// let overrides = ["clock=in-process", "duration_s=1", "accept={}"].map(str::to_owned);
/// let scenario = Scenario::parse(SHIPPED[0].1, "rigid-pair.toml", &overrides)?;
/// let signal = AtomicUsize::new(0);
/// let mut progress = |_: &corotate::launch::Progress<'_>| {};
/// run(&scenario, &mut Launch { record: Some(file.clone()), ..Launch::new(&signal, &mut progress) })?;
///
/// let recording = Recording::open(&file)?;
/// recording.require_whole()?;
/// let estimate = recording.tracks(|signal| signal.body == "leader" && signal.signal == "estimate")?.remove(0);
/// let hidden = estimate.column("omega_rad_s", 2).expect("an estimate of this rig has it");
/// assert_eq!((estimate.ticks().len(), hidden.len()), (1001, 1001));
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct Recording {
    path: PathBuf,
    info: RunInfo,
    signals: Vec<SignalInfo>,
    flaw: Option<Flaw>,
    /// The last recorded tick.
    last_tick: Option<u64>,
    /// The late ticks, as JSON.
    late: Option<String>,
    /// The changes of inputs that the run received.
    changes: Vec<Change>,
}

/// The reason that a file cannot be read to its end.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Flaw {
    /// The file was cut off; the rest is unchanged.
    Cut(&'static str),
    /// The file was changed.
    Damaged(String),
}

/// Metadata of the recorded run.
#[derive(Debug, Clone, Default)]
pub struct RunInfo {
    /// The run's identifier, if it has one.
    pub run: Option<RunId>,
    /// The program's version.
    pub version: String,
    /// The source revision.
    pub revision: String,
    /// The resolved scenario, as TOML.
    pub scenario: String,
    /// The scenario's name.
    pub scenario_name: String,
    /// The hash of the scenario text.
    pub scenario_hash: String,
    /// The seed of all randomness.
    pub seed: u64,
    /// The clock's name.
    pub clock: String,
    /// The period h, ns.
    pub period_ns: u64,
    /// The last tick of the scenario.
    pub last_tick: u64,
    /// T_0 on the run's monotonic clock, ns; 0 unless the clock is real time.
    pub epoch_ns: u64,
    /// True if the recording began before the first tick.
    pub whole: bool,
    /// Time at which the recording began.
    pub started_utc: String,
    /// The machine, as JSON.
    pub host: String,
    /// Metadata from the end of the file; `None` if the file was cut off.
    pub end: Option<EndInfo>,
}

/// Metadata written when a recording ends.
#[derive(Debug, Clone, Default)]
pub struct EndInfo {
    /// True if the recording has every published sample.
    pub complete: bool,
    /// The reason that the recording is incomplete; empty if it is complete or only began late.
    pub problem: String,
    /// The counters of every signal.
    pub signals: Vec<SignalReport>,
    /// The roles' counters.
    pub ticks: BTreeMap<String, Ticks>,
    /// The roles' privileges.
    pub privileges: BTreeMap<String, Vec<Grant>>,
}

/// A recorded signal.
#[derive(Debug, Clone)]
pub struct SignalInfo {
    /// The service.
    pub service: String,
    /// The body.
    pub body: String,
    /// The signal's name.
    pub signal: String,
    /// The role that published it.
    pub role: String,
    /// The layout of its samples.
    pub layout: Layout,
    /// Number of samples and no-sample markers.
    pub samples: u64,
    channel: u16,
}

/// The samples of one signal, in the order of receipt.
#[derive(Debug)]
pub struct Track {
    /// The signal.
    pub info: SignalInfo,
    /// Time of receipt of each sample, ns on the recorder's monotonic clock.
    pub received_ns: Vec<u64>,
    bytes: Vec<u8>,
}

impl Recording {
    /// Opens a recording and reads it once, from beginning to end.
    ///
    /// # Errors
    /// [`RecordError::Read`], [`RecordError::NotARecording`]; [`RecordError::Damaged`] if the run's metadata is damaged.
    pub fn open(path: &Path) -> Result<Self, RecordError> {
        let mut content = Content::default();
        let (mut counts, mut ticks) = (BTreeMap::<u16, u64>::new(), BTreeMap::<u16, u64>::new());
        let flaw = scan(path, &mut content, |channel, _, sample| {
            let stamp: Stamp = bytemuck::pod_read_unaligned(&sample[..size_of::<Stamp>()]);
            *counts.entry(channel).or_default() += 1;
            ticks.insert(channel, stamp.tick);
        })?;
        let not_a_recording = |reason: String| RecordError::NotARecording { path: path.to_owned(), reason };
        let run = content.metadata.remove(RUN).ok_or_else(|| match flaw.clone() {
            Some(Flaw::Damaged(reason)) if content.begun => RecordError::Damaged { path: path.to_owned(), reason },
            Some(Flaw::Damaged(reason)) => not_a_recording(reason),
            Some(Flaw::Cut(reason)) => not_a_recording(format!("{reason}; metadata `{RUN}` is missing")),
            None => not_a_recording(format!("metadata `{RUN}` is missing")),
        })?;
        let info = RunInfo::read(&run, content.metadata.get(END)).map_err(not_a_recording)?;
        if info.scenario_hash != format!("{:016x}", xxh3_64(info.scenario.as_bytes())) {
            let reason = "the scenario does not match its hash".to_owned();
            return Err(RecordError::Damaged { path: path.to_owned(), reason });
        }
        let mut signals = content.signals;
        for signal in &mut signals {
            signal.samples = counts.get(&signal.channel).copied().unwrap_or(0);
        }
        let last_ticks = signals.iter().filter_map(|signal| ticks.get(&signal.channel).copied());
        let last_tick = last_ticks.filter(|tick| *tick <= info.last_tick).max();
        let late = content.metadata.get_mut(LATE).and_then(|entries| entries.remove(LATE_REPORT));
        let changes = read_changes(&content.metadata);
        Ok(Self { path: path.to_owned(), info, signals, flaw, last_tick, late, changes })
    }

    /// Returns the file's path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the metadata of the run.
    pub fn info(&self) -> &RunInfo {
        &self.info
    }

    /// Returns the signals in the order of a tick.
    pub fn signals(&self) -> &[SignalInfo] {
        &self.signals
    }

    /// Returns the late ticks of a run in real time: the worst ones, if there were many. `None` if the file has no end, or the recorder
    /// left the run before its end.
    ///
    /// # Errors
    /// The reason, if they have another layout.
    pub fn late_ticks(&self) -> Result<Option<LateReport>, String> {
        self.late.as_ref().map(|text| LateReport::parse(text.as_bytes())).transpose()
    }

    /// Returns the first damage to the file, if any. The part before it is readable.
    pub fn damage(&self) -> Option<&str> {
        match &self.flaw {
            Some(Flaw::Damaged(reason)) => Some(reason),
            Some(Flaw::Cut(_)) | None => None,
        }
    }

    /// Describes the part of the run that the recording lacks, if any.
    pub fn incomplete(&self) -> Option<String> {
        let mut missing = Vec::new();
        if !self.info.whole {
            missing.push("recording began during the run".to_owned());
        }
        match (&self.flaw, &self.info.end) {
            (Some(Flaw::Cut(reason)), _) => missing.push((*reason).to_owned()),
            (None, None) => missing.push(format!("metadata `{END}` is missing")),
            (None, Some(end)) if !end.problem.is_empty() => missing.push(end.problem.clone()),
            // A recording that began late is never complete; that is already reported.
            (None, Some(end)) if !end.complete && self.info.whole => {
                missing.push("the recorder marked it incomplete".to_owned());
            }
            _ => {}
        }
        let last_tick = self.last_tick.map_or("no samples".to_owned(), |tick| format!("last recorded tick {tick}"));
        let text = missing.join("; ");
        (!text.is_empty()).then(|| format!("{text}; {last_tick} of {}", self.info.last_tick))
    }

    /// Returns an error if the recording is damaged or incomplete.
    ///
    /// # Errors
    /// [`RecordError::Damaged`], [`RecordError::Incomplete`].
    pub fn require_whole(&self) -> Result<(), RecordError> {
        let path = || self.path.clone();
        if let Some(reason) = self.damage() {
            return Err(RecordError::Damaged { path: path(), reason: reason.to_owned() });
        }
        self.incomplete().map_or(Ok(()), |missing| Err(RecordError::Incomplete { path: path(), missing }))
    }

    /// Parses the recorded scenario.
    ///
    /// # Errors
    /// [`RecordError::Scenario`].
    pub fn scenario(&self) -> Result<Scenario, RecordError> {
        self.parse(&[])
    }

    /// Parses the recorded scenario with the clock `lockstep`, in which every recording is replayed.
    ///
    /// # Errors
    /// [`RecordError::Scenario`].
    pub fn scenario_for_replay(&self) -> Result<Scenario, RecordError> {
        self.parse(&["clock=lockstep".to_owned()])
    }

    fn parse(&self, overrides: &[String]) -> Result<Scenario, RecordError> {
        let origin = format!("{}:scenario", self.path.display());
        let scenario = Scenario::parse(&self.info.scenario, &origin, overrides)
            .map_err(|error| RecordError::Scenario { path: self.path.clone(), source: Box::new(error) })?;
        scenario.inputs.received().append(&self.changes, || true);
        Ok(scenario)
    }

    /// Returns the changes of inputs that the run received.
    pub fn changes(&self) -> &[Change] {
        &self.changes
    }

    /// Returns the injected faults of the scenario.
    ///
    /// # Errors
    /// [`RecordError::Scenario`].
    pub fn faults(&self) -> Result<Vec<ScriptedFault>, RecordError> {
        Ok(self.scenario()?.faults.clone())
    }

    /// Reads all samples of the wanted signals into memory.
    ///
    /// # Errors
    /// [`RecordError::Read`], [`RecordError::Damaged`] if the file has changed since it was opened.
    pub fn tracks(&self, wanted: impl Fn(&SignalInfo) -> bool) -> Result<Vec<Track>, RecordError> {
        let chosen = self.signals.iter().filter(|signal| wanted(signal));
        let track = |info: &SignalInfo| Track { info: info.clone(), received_ns: Vec::new(), bytes: Vec::new() };
        let mut tracks: Vec<Track> = chosen.map(track).collect();
        self.rescan(|channel, received_ns, sample| {
            if let Some(track) = tracks.iter_mut().find(|track| track.info.channel == channel) {
                track.received_ns.push(received_ns);
                track.bytes.extend_from_slice(sample);
            }
        })?;
        Ok(tracks)
    }

    /// Calls `each` for every sample in the order of receipt, without keeping them in memory.
    ///
    /// Its arguments: the index of the signal, the time of receipt in ns on the recorder's monotonic clock, the bytes.
    ///
    /// # Errors
    /// [`RecordError::Read`], [`RecordError::Damaged`] if the file has changed since it was opened.
    pub fn visit(&self, mut each: impl FnMut(usize, u64, &[u8])) -> Result<(), RecordError> {
        self.rescan(|channel, received_ns, sample| {
            if let Some(index) = self.signals.iter().position(|signal| signal.channel == channel) {
                each(index, received_ns, sample);
            }
        })
    }

    /// Reads the file again, and checks that it has not changed.
    fn rescan(&self, sample: impl FnMut(u16, u64, &[u8])) -> Result<(), RecordError> {
        let mut content = Content::default();
        let flaw = scan(&self.path, &mut content, sample)?;
        let same = |(new, old): (&SignalInfo, &SignalInfo)| (new.channel, &new.layout) == (old.channel, &old.layout);
        if flaw != self.flaw || !content.signals.iter().zip(&self.signals).all(same) {
            let reason = "the file has changed since it was opened".to_owned();
            return Err(RecordError::Damaged { path: self.path.clone(), reason });
        }
        Ok(())
    }

    /// Checks that every signal has the layout of this version.
    ///
    /// # Errors
    /// [`RecordError::Layout`], [`RecordError::NotRecorded`].
    pub fn check_layouts(&self, scenario: &Scenario) -> Result<(), RecordError> {
        for (service, ours) in layouts(scenario) {
            let recorded = self
                .signals
                .iter()
                .find(|signal| signal.service == service)
                .ok_or_else(|| RecordError::NotRecorded { path: self.path.clone(), service: service.clone() })?;
            if recorded.layout != ours {
                let (recorded, ours) = (recorded.layout.words(), ours.words());
                return Err(RecordError::Layout { service, recorded, ours });
            }
        }
        Ok(())
    }
}

impl Track {
    /// Returns the number of samples.
    pub fn len(&self) -> usize {
        self.received_ns.len()
    }

    /// Returns true if the signal has no samples.
    pub fn is_empty(&self) -> bool {
        self.received_ns.is_empty()
    }

    /// Returns the bytes of a sample: stamp and content.
    pub fn sample(&self, index: usize) -> &[u8] {
        let size = self.info.layout.size();
        &self.bytes[index * size..][..size]
    }

    /// Returns the stamp of a sample.
    pub fn stamp(&self, index: usize) -> Stamp {
        bytemuck::pod_read_unaligned(&self.sample(index)[..size_of::<Stamp>()])
    }

    /// Returns the first element of an unsigned field in a sample; `None` if there is no such field.
    pub(super) fn unsigned(&self, index: usize, name: &str) -> Option<u64> {
        let column = self.info.layout.columns.iter().find(|column| column.name == name)?;
        (column.kind == FieldKind::U64).then(|| u64::from_le_bytes(self.word(index, column.offset)))
    }

    /// Returns the 8 bytes of a field's element in a sample.
    fn word(&self, index: usize, offset: usize) -> [u8; 8] {
        let mut word = [0; 8];
        word.copy_from_slice(&self.sample(index)[offset..offset + 8]);
        word
    }

    /// Returns a field's element in a sample as a number.
    pub fn value(&self, index: usize, column: usize, element: usize) -> f64 {
        let column = &self.info.layout.columns[column];
        let word = self.word(index, column.offset + 8 * element);
        match column.kind {
            FieldKind::F64 => f64::from_le_bytes(word),
            FieldKind::U64 => u64::from_le_bytes(word) as f64,
        }
    }

    /// Returns the indexes of the regular samples: the first of each tick, in ascending order, without no-sample markers.
    pub fn regular(&self) -> impl Iterator<Item = usize> + '_ {
        let mut order = Order::default();
        (0..self.len())
            .filter(move |index| matches!(order.place(&self.stamp(*index), u64::MAX), Place::Sample | Place::Unused))
    }

    /// Returns a field's element over all [regular](Self::regular) samples; `None` if there is no such field.
    pub fn column(&self, name: &str, element: usize) -> Option<Vec<f64>> {
        let columns = &self.info.layout.columns;
        let column = columns.iter().position(|column| column.name == name && element < column.count)?;
        Some(self.regular().map(|index| self.value(index, column, element)).collect())
    }

    /// Returns the ticks of all [regular](Self::regular) samples.
    pub fn ticks(&self) -> Vec<u64> {
        self.regular().map(|index| self.stamp(index).tick).collect()
    }
}

impl RunInfo {
    fn read(run: &BTreeMap<String, String>, end: Option<&BTreeMap<String, String>>) -> Result<Self, String> {
        let text = |key: &str| run.get(key).cloned().ok_or_else(|| format!("metadata `{key}` is missing"));
        let number = |key: &str| text(key)?.parse().map_err(|_| format!("metadata `{key}` is not a number"));
        if text("schema")? != SCHEMA {
            return Err(format!("its format is {}, but this version reads {SCHEMA}", text("schema")?));
        }
        let run = run.get("run").map(|id| id.parse()).transpose();
        let run = run.map_err(|_| "metadata `run` is not a run identifier".to_owned())?;
        Ok(Self {
            run,
            version: text("version")?,
            revision: text("revision")?,
            scenario: text("scenario")?,
            scenario_name: text("scenario_name")?,
            scenario_hash: text("scenario_hash")?,
            seed: number("seed")?,
            clock: text("clock")?,
            period_ns: number("period_ns")?,
            last_tick: number("last_tick")?,
            epoch_ns: number("epoch_ns")?,
            whole: text("whole")? == "true",
            started_utc: text("started_utc")?,
            host: text("host")?,
            end: end.map(EndInfo::read),
        })
    }
}

/// Reads the changes of inputs that the run received.
fn read_changes(metadata: &BTreeMap<String, BTreeMap<String, String>>) -> Vec<Change> {
    let numbered = |(name, entries): (&String, &BTreeMap<String, String>)| {
        let number: usize = name.strip_prefix(INPUTS)?.parse().ok()?;
        let words: Vec<[u64; CHANGE_WORDS]> = serde_json::from_str(entries.get(CHANGES)?).ok()?;
        Some((number, words))
    };
    let mut numbered: Vec<_> = metadata.iter().filter_map(numbered).collect();
    numbered.sort_by_key(|(number, _)| *number);
    numbered.iter().flat_map(|(_, words)| words).filter_map(Change::from_words).collect()
}

impl EndInfo {
    /// Reads the end metadata. An unreadable entry is left empty, because samples can be read without it.
    fn read(end: &BTreeMap<String, String>) -> Self {
        let text = |key: &str| end.get(key).map_or("", String::as_str);
        Self {
            complete: text("complete") == "true",
            problem: text("problem").to_owned(),
            signals: serde_json::from_str(text("signals")).unwrap_or_default(),
            ticks: serde_json::from_str(text("ticks")).unwrap_or_default(),
            privileges: serde_json::from_str(text("privileges")).unwrap_or_default(),
        }
    }
}

/// The contents of a file except samples.
#[derive(Default)]
struct Content {
    /// True once the header has been read.
    begun: bool,
    schemas: BTreeMap<u16, (String, String)>,
    signals: Vec<SignalInfo>,
    /// Bytes per sample, by channel.
    sizes: BTreeMap<u16, usize>,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
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
fn scan(
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
