//! A recording as data: what is known of the run, its signals, and their samples as bytes, stamps and columns of numbers.
//!
//! Reads the file from its beginning, so that one without an end is read as far as it goes. Every byte is under a checksum: a
//! chunk's is looked at before its samples are used, metadata has its own, and the whole file's is looked at last. What was
//! changed is told by [`Recording::damage`], what is missing by [`Recording::incomplete`]. Must not ask for memory that the
//! file is too short for, nor use a sample whose checksum is wrong.

use super::RecordError;
use super::recorder::{END, RUN, SCHEMA, SignalReport, layouts};
use super::writer::{CHECKSUM, checksum};
use crate::config::{RunId, ScriptedFault};
use crate::files;
use crate::sample::{CDR_HEADER, FieldKind, Layout, NO_SAMPLE, Stamp};
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

/// No sample of ours is longer, bytes.
const SAMPLE_BYTES: usize = 64 << 20;
/// No record of ours is longer, packed or not: a chunk may hold one sample beyond its size.
const RECORD_BYTES: usize = 2 * SAMPLE_BYTES;
/// How much is read at once, if nothing larger is asked for, bytes.
const READ_BYTES: usize = 64 << 10;
/// An opcode and a length, before every record; bytes.
const RECORD_HEAD: usize = 9;

/// A recording that was opened.
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
    /// The last tick of which there is a sample.
    last_tick: Option<u64>,
}

/// Why a file is not read to its end.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Flaw {
    /// It was cut off: what there is of it is as it was written.
    Cut(&'static str),
    /// It was changed.
    Damaged(String),
}

/// What a recording says of its run.
#[derive(Debug, Clone, Default)]
pub struct RunInfo {
    /// The run's identifier, if it has one.
    pub run: Option<RunId>,
    /// The program's version and source revision.
    pub version: String,
    /// The source revision.
    pub revision: String,
    /// The scenario as resolved, a TOML text; its name and its hash.
    pub scenario: String,
    /// The scenario's name.
    pub scenario_name: String,
    /// The hash of its text.
    pub scenario_hash: String,
    /// The seed of all randomness.
    pub seed: u64,
    /// The clock's name.
    pub clock: String,
    /// The period h, ns.
    pub period_ns: u64,
    /// The last tick of the scenario.
    pub last_tick: u64,
    /// T_0 on the run's monotonic clock, ns; 0 where there was no time.
    pub epoch_ns: u64,
    /// Whether it was begun before the first tick.
    pub whole: bool,
    /// When the recording was begun.
    pub started_utc: String,
    /// The machine, as JSON.
    pub host: String,
    /// What was written at the end; none if there is no end.
    pub end: Option<EndInfo>,
}

/// What a recording says at its end.
#[derive(Debug, Clone, Default)]
pub struct EndInfo {
    /// Whether every published sample is in it.
    pub complete: bool,
    /// Why not.
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
    /// The service's name; the body's and the signal's own, and the role that wrote it.
    pub service: String,
    /// The body.
    pub body: String,
    /// The signal's own name.
    pub signal: String,
    /// The role that wrote it.
    pub role: String,
    /// The layout of its samples.
    pub layout: Layout,
    /// How many samples there are, of any kind.
    pub samples: u64,
    channel: u16,
}

/// The samples of one signal, in the order in which they came.
#[derive(Debug)]
pub struct Track {
    /// The signal.
    pub info: SignalInfo,
    /// When each came, ns on the recorder's monotonic clock.
    pub received_ns: Vec<u64>,
    bytes: Vec<u8>,
}

impl Recording {
    /// Opens a recording: reads all of it once.
    ///
    /// # Errors
    /// [`RecordError::Read`], [`RecordError::NotOurs`], [`RecordError::Damaged`] if nothing of it can be believed.
    pub fn open(path: &Path) -> Result<Self, RecordError> {
        let mut content = Content::default();
        let (mut counts, mut ticks) = (BTreeMap::<u16, u64>::new(), BTreeMap::<u16, u64>::new());
        let flaw = scan(path, &mut content, |channel, _, sample| {
            let stamp: Stamp = bytemuck::pod_read_unaligned(&sample[..size_of::<Stamp>()]);
            *counts.entry(channel).or_default() += 1;
            ticks.insert(channel, stamp.tick);
        })?;
        let not_ours = |reason: String| RecordError::NotOurs { path: path.to_owned(), reason };
        let run = content.metadata.remove(RUN).ok_or_else(|| match flaw.clone() {
            Some(Flaw::Damaged(reason)) if content.begun => RecordError::Damaged { path: path.to_owned(), reason },
            Some(Flaw::Damaged(reason)) => not_ours(reason),
            Some(Flaw::Cut(reason)) => not_ours(format!("{reason}, before anything was written about a run")),
            None => not_ours("it says nothing of a run".to_owned()),
        })?;
        let info = RunInfo::read(&run, content.metadata.get(END)).map_err(not_ours)?;
        if info.scenario_hash != format!("{:016x}", xxh3_64(info.scenario.as_bytes())) {
            let reason = "the scenario is not the one of which it has the hash".to_owned();
            return Err(RecordError::Damaged { path: path.to_owned(), reason });
        }
        let mut signals = content.signals;
        for signal in &mut signals {
            signal.samples = counts.get(&signal.channel).copied().unwrap_or(0);
        }
        let last_tick = ticks.into_values().filter(|tick| *tick <= info.last_tick).max();
        Ok(Self { path: path.to_owned(), info, signals, flaw, last_tick })
    }

    /// Where it lies.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What it says of its run.
    pub fn info(&self) -> &RunInfo {
        &self.info
    }

    /// Its signals, in the order of a tick.
    pub fn signals(&self) -> &[SignalInfo] {
        &self.signals
    }

    /// What was changed in the file, if anything was. What comes before that, and has a checksum that is right, is read.
    pub fn damage(&self) -> Option<&str> {
        match &self.flaw {
            Some(Flaw::Damaged(reason)) => Some(reason),
            Some(Flaw::Cut(_)) | None => None,
        }
    }

    /// What the recording lacks of its run, if it lacks anything. What it has is as it was recorded.
    pub fn incomplete(&self) -> Option<String> {
        let mut missing = Vec::new();
        if !self.info.whole {
            missing.push("it was begun in the midst of the run".to_owned());
        }
        match (&self.flaw, &self.info.end) {
            (Some(Flaw::Cut(reason)), _) => missing.push((*reason).to_owned()),
            (None, None) => missing.push("it does not say how it ended".to_owned()),
            (None, Some(end)) if !end.problem.is_empty() => missing.push(end.problem.clone()),
            // Begun late is all that is wrong.
            (None, Some(end)) if !end.complete && self.info.whole => missing.push("it says so itself".to_owned()),
            _ => {}
        }
        let last_tick = self.last_tick.map_or("it has no sample".to_owned(), |tick| format!("its last tick is {tick}"));
        let text = missing.join("; ");
        (!text.is_empty()).then(|| format!("{text}; {last_tick} of {}", self.info.last_tick))
    }

    /// Refuses a recording that is not what was recorded, or not all of it.
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

    /// Its scenario, to be run again.
    ///
    /// # Errors
    /// [`RecordError::Scenario`].
    pub fn scenario(&self) -> Result<Scenario, RecordError> {
        self.parse(&[])
    }

    /// The same under the clock by which every recording is replayed, lockstep.
    ///
    /// # Errors
    /// [`RecordError::Scenario`].
    pub fn scenario_for_replay(&self) -> Result<Scenario, RecordError> {
        self.parse(&["clock=lockstep".to_owned()])
    }

    fn parse(&self, overrides: &[String]) -> Result<Scenario, RecordError> {
        let origin = format!("{}:scenario", self.path.display());
        Scenario::parse(&self.info.scenario, &origin, overrides)
            .map_err(|error| RecordError::Scenario { path: self.path.clone(), source: Box::new(error) })
    }

    /// What the scenario had go wrong.
    ///
    /// # Errors
    /// [`RecordError::Scenario`].
    pub fn faults(&self) -> Result<Vec<ScriptedFault>, RecordError> {
        Ok(self.scenario()?.faults.clone())
    }

    /// The samples of some signals, of all of them if `wanted` says so, in memory.
    ///
    /// # Errors
    /// [`RecordError::Read`], [`RecordError::Damaged`] if the file has changed since it was opened.
    pub fn tracks(&self, wanted: impl Fn(&SignalInfo) -> bool) -> Result<Vec<Track>, RecordError> {
        let chosen = self.signals.iter().filter(|signal| wanted(signal));
        let track = |info: &SignalInfo| Track { info: info.clone(), received_ns: Vec::new(), bytes: Vec::new() };
        let mut tracks: Vec<Track> = chosen.map(track).collect();
        self.again(|channel, received_ns, sample| {
            if let Some(track) = tracks.iter_mut().find(|track| track.info.channel == channel) {
                track.received_ns.push(received_ns);
                track.bytes.extend_from_slice(sample);
            }
        })?;
        Ok(tracks)
    }

    /// Shows every sample in the order in which they came, and keeps none: the index of its signal, when it came in ns on the
    /// recorder's monotonic clock, its bytes.
    ///
    /// # Errors
    /// [`RecordError::Read`], [`RecordError::Damaged`] if the file has changed since it was opened.
    pub fn visit(&self, mut each: impl FnMut(usize, u64, &[u8])) -> Result<(), RecordError> {
        self.again(|channel, received_ns, sample| {
            if let Some(index) = self.signals.iter().position(|signal| signal.channel == channel) {
                each(index, received_ns, sample);
            }
        })
    }

    /// Reads the file once more, which must be what it was.
    fn again(&self, sample: impl FnMut(u16, u64, &[u8])) -> Result<(), RecordError> {
        let mut content = Content::default();
        let flaw = scan(&self.path, &mut content, sample)?;
        let same = |(now, then): (&SignalInfo, &SignalInfo)| (now.channel, &now.layout) == (then.channel, &then.layout);
        if flaw != self.flaw || !content.signals.iter().zip(&self.signals).all(same) {
            let reason = "it has changed since it was opened".to_owned();
            return Err(RecordError::Damaged { path: self.path.clone(), reason });
        }
        Ok(())
    }

    /// Checks that every signal has the layout that this version gives it.
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
    /// How many samples there are.
    pub fn len(&self) -> usize {
        self.received_ns.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.received_ns.is_empty()
    }

    /// The bytes of a sample, stamp and content.
    pub fn sample(&self, index: usize) -> &[u8] {
        let size = self.info.layout.size();
        &self.bytes[index * size..][..size]
    }

    /// The stamp of a sample.
    pub fn stamp(&self, index: usize) -> Stamp {
        bytemuck::pod_read_unaligned(&self.sample(index)[..size_of::<Stamp>()])
    }

    /// One element of a field of unsigned numbers in a sample; none if there is no such field.
    pub(super) fn unsigned(&self, index: usize, name: &str) -> Option<u64> {
        let column = self.info.layout.columns.iter().find(|column| column.name == name)?;
        (column.kind == FieldKind::U64).then(|| u64::from_le_bytes(self.word(index, column.offset)))
    }

    /// One element of a field as it is in a sample: 8 bytes.
    fn word(&self, index: usize, offset: usize) -> [u8; 8] {
        let mut word = [0; 8];
        word.copy_from_slice(&self.sample(index)[offset..offset + 8]);
        word
    }

    /// One element of a field in a sample, as a number.
    pub fn value(&self, index: usize, column: usize, element: usize) -> f64 {
        let column = &self.info.layout.columns[column];
        let word = self.word(index, column.offset + 8 * element);
        match column.kind {
            FieldKind::F64 => f64::from_le_bytes(word),
            FieldKind::U64 => u64::from_le_bytes(word) as f64,
        }
    }

    /// The samples that the loop was given: every one that is the first of its tick and no void, by their indexes.
    pub fn regular(&self) -> impl Iterator<Item = usize> + '_ {
        let mut next = 0;
        (0..self.len()).filter(move |index| {
            let stamp = self.stamp(*index);
            let first = stamp.tick >= next && stamp.generation & NO_SAMPLE == 0;
            if first {
                next = stamp.tick.saturating_add(1);
            }
            first
        })
    }

    /// One element of a field over all [regular](Self::regular) samples; none if there is no such field.
    pub fn column(&self, name: &str, element: usize) -> Option<Vec<f64>> {
        let columns = &self.info.layout.columns;
        let column = columns.iter().position(|column| column.name == name && element < column.count)?;
        Some(self.regular().map(|index| self.value(index, column, element)).collect())
    }

    /// The ticks of all [regular](Self::regular) samples.
    pub fn ticks(&self) -> Vec<u64> {
        self.regular().map(|index| self.stamp(index).tick).collect()
    }
}

impl RunInfo {
    fn read(run: &BTreeMap<String, String>, end: Option<&BTreeMap<String, String>>) -> Result<Self, String> {
        let text = |key: &str| run.get(key).cloned().ok_or_else(|| format!("it does not say `{key}`"));
        let number = |key: &str| text(key)?.parse().map_err(|_| format!("`{key}` is no number"));
        if text("schema")? != SCHEMA {
            return Err(format!("it is laid out as {}, and this version reads {SCHEMA}", text("schema")?));
        }
        let run = run.get("run").map(|id| id.parse()).transpose().map_err(|_| "`run` is no identifier".to_owned())?;
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

impl EndInfo {
    /// What cannot be read is left out: the end only adds to what the samples say.
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

/// What a file has besides samples.
#[derive(Default)]
struct Content {
    /// Whether it begins as a file of this kind.
    begun: bool,
    schemas: BTreeMap<u16, (String, String)>,
    signals: Vec<SignalInfo>,
    /// The length of a sample by channel.
    sizes: BTreeMap<u16, usize>,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    data_ended: bool,
    ended: bool,
}

impl Content {
    /// Takes in a record that is in no chunk. Samples and what describes them are not: outside, nothing vouches for them.
    fn record(&mut self, record: Record<'_>) -> Result<(), String> {
        match record {
            Record::Header(_) => self.begun = true,
            Record::Metadata(mut metadata) => {
                let name = metadata.name;
                let kept = metadata.metadata.remove(CHECKSUM);
                // Another version's may have none, and is refused as such.
                let other = metadata.metadata.get("schema").is_some_and(|schema| schema != SCHEMA);
                let without = kept.is_none() && name == RUN && other;
                if !without && kept.as_ref() != Some(&checksum(&name, &metadata.metadata)) {
                    return Err(format!("the checksum of its metadata `{name}` is wrong"));
                }
                if self.metadata.contains_key(&name) {
                    return Err(format!("it has its metadata `{name}` twice"));
                }
                self.metadata.insert(name, metadata.metadata);
            }
            Record::DataEnd(_) if std::mem::replace(&mut self.data_ended, true) => {
                return Err("its data end twice".to_owned());
            }
            Record::Footer(_) if !self.data_ended => return Err("it ends before its data do".to_owned()),
            Record::Footer(_) => self.ended = true,
            Record::Message { .. } => return Err("it has a sample outside of a chunk".to_owned()),
            _ => {}
        }
        Ok(())
    }

    /// Takes in a chunk: nothing of it before its checksum is known to be right.
    fn chunk(
        &mut self,
        reader: &mut LinearReader,
        record: &[u8],
        sample: &mut impl FnMut(u16, u64, &[u8]),
    ) -> Result<(), String> {
        let words = |error: McapError| error.to_string();
        let Record::Chunk { header, .. } = mcap::parse_record(op::CHUNK, record).map_err(words)? else {
            return Err("a chunk is none".to_owned());
        };
        if header.compression != "lz4" || header.uncompressed_crc == 0 || self.data_ended {
            return Err("it has a chunk that this program does not write".to_owned());
        }
        let room = reader.insert(RECORD_HEAD + record.len());
        room[0] = op::CHUNK;
        room[1..RECORD_HEAD].copy_from_slice(&(record.len() as u64).to_le_bytes());
        room[RECORD_HEAD..].copy_from_slice(record);
        reader.notify_read(RECORD_HEAD + record.len());
        while let Some(event) = reader.next_event() {
            match event.map_err(words)? {
                LinearReadEvent::ReadRequest(_) => break,
                LinearReadEvent::Record { data, opcode } => {
                    self.content(mcap::parse_record(opcode, data).map_err(words)?, sample)?;
                }
            }
        }
        Ok(())
    }

    /// Takes in a record of a chunk.
    fn content(&mut self, record: Record<'_>, sample: &mut impl FnMut(u16, u64, &[u8])) -> Result<(), String> {
        match record {
            Record::Schema { header, data } => {
                let text = String::from_utf8_lossy(&data).into_owned();
                self.schemas.insert(header.id, (header.encoding, text));
            }
            Record::Channel(channel) if !self.sizes.contains_key(&channel.id) => {
                let (encoding, text) = self.schemas.get(&channel.schema_id).ok_or("a channel lacks its schema")?;
                let ours = encoding == "ros2msg" && channel.message_encoding == "cdr";
                let layout = Layout::parse(text).filter(|layout| ours && layout.size() < SAMPLE_BYTES);
                let layout = layout.ok_or_else(|| format!("{} has no samples of ours", channel.topic))?;
                let about = |key: &str| channel.metadata.get(key).cloned().unwrap_or_default();
                let (body, signal) = (about("body"), about("signal"));
                if self.signals.iter().any(|other| (&other.body, &other.signal) == (&body, &signal)) {
                    return Err(format!("{} is of the same signal as another channel", channel.topic));
                }
                self.sizes.insert(channel.id, layout.size());
                let (service, role) = (about("service"), about("role"));
                let channel = channel.id;
                self.signals.push(SignalInfo { service, body, signal, role, layout, samples: 0, channel });
            }
            Record::Message { header, data } => {
                let size = self.sizes.get(&header.channel_id).ok_or("a sample is of no channel")?;
                if data.len() != CDR_HEADER.len() + size || data[..CDR_HEADER.len()] != CDR_HEADER {
                    return Err(format!(
                        "sample {} of channel {} has another length",
                        header.sequence, header.channel_id
                    ));
                }
                sample(header.channel_id, header.log_time, &data[CDR_HEADER.len()..]);
            }
            _ => {}
        }
        Ok(())
    }
}

/// Reads a file from its beginning as far as it goes, and tells why not further.
fn scan(
    path: &Path,
    content: &mut Content,
    mut sample: impl FnMut(u16, u64, &[u8]),
) -> Result<Option<Flaw>, RecordError> {
    let failed = |source| RecordError::Read { path: path.to_owned(), source };
    let mut file = files::open(path).map_err(failed)?;
    let mut unread = file.metadata().map_err(failed)?.len();
    let mut last = [0; MAGIC.len()];
    // What has its end was not cut off, whatever lengths it tells.
    let whole = match unread.checked_sub(MAGIC.len() as u64) {
        Some(at) => {
            file.read_exact_at(&mut last, at).map(|()| last == *MAGIC).or_else(cut_meanwhile).map_err(failed)?
        }
        None => false,
    };
    let cut = |reason| match whole {
        true => Flaw::Damaged("a record is longer than the rest of the file".to_owned()),
        false => Flaw::Cut(reason),
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
            // Behind the end it asks whether there is anything else.
            Ok(LinearReadEvent::ReadRequest(wanted)) if wanted as u64 <= unread || content.ended => {
                let wanted = wanted.max(READ_BYTES).min(unread.max(1) as usize);
                let read = file.read(reader.insert(wanted)).map_err(failed)?;
                unread = unread.saturating_sub(read as u64);
                reader.notify_read(read);
                Ok(())
            }
            Ok(LinearReadEvent::ReadRequest(_)) => return Ok(Some(cut(CUT))),
            Ok(LinearReadEvent::Record { data, opcode: op::CHUNK }) => content.chunk(&mut chunks, data, &mut sample),
            Ok(LinearReadEvent::Record { data, opcode }) => {
                let record = mcap::parse_record(opcode, data).map_err(|error| error.to_string());
                record.and_then(|record| content.record(record))
            }
            // So a chunk is begun; its length is written when it is closed.
            Err(McapError::RecordTooLarge { opcode: op::CHUNK, len: u64::MAX }) => return Ok(Some(cut(CUT))),
            Err(error) => Err(error.to_string()),
        };
        if let Err(reason) = taken {
            return Ok(Some(Flaw::Damaged(reason)));
        }
    }
    Ok(None)
}

const CUT: &str = "it has no end: its recorder was killed, or the disk was full";

/// A file that becomes shorter while it is read has no end.
fn cut_meanwhile(error: io::Error) -> io::Result<bool> {
    if error.kind() == io::ErrorKind::UnexpectedEof { Ok(false) } else { Err(error) }
}
