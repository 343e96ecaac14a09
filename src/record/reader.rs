//! A recording as data: what is known of the run, its signals, and their samples as bytes, stamps and columns of numbers.
//!
//! Reads the file from its beginning, so that one without an end is read as far as it goes; what is wrong with it is told in
//! [`Recording::damage`]. Must not believe anything that the file says of its own size.

use super::RecordError;
use super::layout::{CDR_HEADER, Layout};
use super::recorder::{END, RUN, SCHEMA, SignalReport, layouts};
use crate::config::{RunId, Scenario, ScriptedFault};
use crate::sample::{FieldKind, Stamp, VOID};
use crate::telemetry::{Grant, Ticks};
use mcap::records::Record;
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

/// No record of ours, chunks apart, is longer, bytes.
const RECORD_BYTES: usize = 64 << 20;

/// A recording that was opened.
#[derive(Debug)]
pub struct Recording {
    path: PathBuf,
    info: RunInfo,
    signals: Vec<SignalInfo>,
    damage: Option<String>,
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
    /// The books of every signal.
    pub signals: Vec<SignalReport>,
    /// The roles' books.
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
    /// [`RecordError::Read`], [`RecordError::NotOurs`].
    pub fn open(path: &Path) -> Result<Self, RecordError> {
        let mut content = Content::default();
        let mut counts = BTreeMap::<u16, u64>::new();
        let damage = scan(path, &mut content, |channel, _, _| *counts.entry(channel).or_default() += 1)?;
        let not_ours = |reason: String| RecordError::NotOurs { path: path.to_owned(), reason };
        let run = content.metadata.remove(RUN).ok_or_else(|| {
            let why = damage.clone().unwrap_or_else(|| "it says nothing of a run".to_owned());
            not_ours(why)
        })?;
        let info = RunInfo::read(&run, content.metadata.get(END)).map_err(not_ours)?;
        let mut signals = content.signals;
        for signal in &mut signals {
            signal.samples = counts.get(&signal.channel).copied().unwrap_or(0);
        }
        Ok(Self { path: path.to_owned(), info, signals, damage })
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

    /// What is wrong with the file, if anything is: it was cut off, or changed. What comes before that is read.
    pub fn damage(&self) -> Option<&str> {
        self.damage.as_deref()
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
        Ok(self.scenario()?.faults)
    }

    /// The samples of some signals, of all of them if `wanted` says so, in memory.
    ///
    /// # Errors
    /// [`RecordError::Read`], [`RecordError::NotOurs`].
    pub fn tracks(&self, wanted: impl Fn(&SignalInfo) -> bool) -> Result<Vec<Track>, RecordError> {
        let chosen = self.signals.iter().filter(|signal| wanted(signal));
        let track = |info: &SignalInfo| Track { info: info.clone(), received_ns: Vec::new(), bytes: Vec::new() };
        let mut tracks: Vec<Track> = chosen.map(track).collect();
        scan(&self.path, &mut Content::default(), |channel, received_ns, sample| {
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
    /// [`RecordError::Read`], [`RecordError::NotOurs`].
    pub fn visit(&self, mut each: impl FnMut(usize, u64, &[u8])) -> Result<(), RecordError> {
        scan(&self.path, &mut Content::default(), |channel, received_ns, sample| {
            if let Some(index) = self.signals.iter().position(|signal| signal.channel == channel) {
                each(index, received_ns, sample);
            }
        })?;
        Ok(())
    }

    /// Checks that every signal has the layout that this version gives it.
    ///
    /// # Errors
    /// [`RecordError::Layout`], [`RecordError::Missing`].
    pub fn check_layouts(&self, scenario: &Scenario) -> Result<(), RecordError> {
        for (service, ours) in layouts(scenario) {
            let recorded = self.signals.iter().find(|signal| signal.service == service).ok_or_else(|| {
                let reason =
                    format!("{} has no signal {service}; record the run with this version", self.path.display());
                RecordError::Missing { reason }
            })?;
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

    /// Whether it stands for a sample that does not exist.
    pub fn is_void(&self, index: usize) -> bool {
        self.stamp(index).generation & VOID != 0
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
            let first = stamp.tick >= next && stamp.generation & VOID == 0;
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

/// A sample as it lies in the file: channel, time of receipt in ns, CDR header and body.
type Message<'a> = (u16, u64, Cow<'a, [u8]>);

/// What a file has besides samples.
#[derive(Default)]
struct Content {
    schemas: BTreeMap<u16, (String, String)>,
    signals: Vec<SignalInfo>,
    /// The length of a sample by channel.
    sizes: BTreeMap<u16, usize>,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    ended: bool,
}

impl Content {
    /// Takes a record in; gives back what it is if it is a sample: channel, time, bytes.
    fn take<'a>(&mut self, record: Record<'a>) -> Result<Option<Message<'a>>, String> {
        match record {
            Record::Schema { header, data } => {
                let text = String::from_utf8_lossy(&data).into_owned();
                self.schemas.insert(header.id, (header.encoding, text));
            }
            Record::Channel(channel) if !self.sizes.contains_key(&channel.id) => {
                let (encoding, text) = self.schemas.get(&channel.schema_id).ok_or("a channel lacks its schema")?;
                let ours = encoding == "ros2msg" && channel.message_encoding == "cdr";
                let layout = Layout::parse(text).filter(|layout| ours && layout.size() < RECORD_BYTES);
                let layout = layout.ok_or_else(|| format!("{} has no samples of ours", channel.topic))?;
                let about = |key: &str| channel.metadata.get(key).cloned().unwrap_or_default();
                self.sizes.insert(channel.id, layout.size());
                self.signals.push(SignalInfo {
                    service: about("service"),
                    body: about("body"),
                    signal: about("signal"),
                    role: about("role"),
                    layout,
                    samples: 0,
                    channel: channel.id,
                });
            }
            Record::Message { header, data } => {
                let size = self.sizes.get(&header.channel_id).ok_or("a sample is of no channel")?;
                if data.len() != CDR_HEADER.len() + size || data[..CDR_HEADER.len()] != CDR_HEADER {
                    return Err(format!(
                        "sample {} of channel {} has another length",
                        header.sequence, header.channel_id
                    ));
                }
                return Ok(Some((header.channel_id, header.log_time, data)));
            }
            Record::Metadata(metadata) => drop(self.metadata.insert(metadata.name, metadata.metadata)),
            Record::Footer(_) => self.ended = true,
            _ => {}
        }
        Ok(None)
    }
}

/// Reads a file from its beginning as far as it goes, and tells why not further.
fn scan(
    path: &Path,
    content: &mut Content,
    mut sample: impl FnMut(u16, u64, &[u8]),
) -> Result<Option<String>, RecordError> {
    let failed = |source| RecordError::Read { path: path.to_owned(), source };
    let mut file = File::open(path).map_err(failed)?;
    let options = LinearReaderOptions::default()
        .with_skip_end_magic(true)
        .with_validate_chunk_crcs(true)
        .with_record_length_limit(RECORD_BYTES);
    let mut reader = LinearReader::new_with_options(options);
    while let Some(event) = reader.next_event() {
        match event {
            Ok(LinearReadEvent::ReadRequest(wanted)) => {
                let read = file.read(reader.insert(wanted.min(RECORD_BYTES))).map_err(failed)?;
                reader.notify_read(read);
            }
            Ok(LinearReadEvent::Record { data, opcode }) => {
                let record = mcap::parse_record(opcode, data).map_err(|error| error.to_string());
                match record.and_then(|record| content.take(record)) {
                    Ok(Some((channel, received_ns, data))) => sample(channel, received_ns, &data[CDR_HEADER.len()..]),
                    Ok(None) => {}
                    Err(reason) => return Ok(Some(reason)),
                }
                if content.ended {
                    return Ok(None);
                }
            }
            Err(error) => return Ok(Some(error.to_string())),
        }
    }
    Ok((!content.ended).then(|| "it has no end: its recorder was killed, or there was no room".to_owned()))
}
