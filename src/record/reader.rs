//! Reads recordings: the run's metadata, its signals, and their samples as bytes, stamps and columns of numbers.
//!
//! Reads from the beginning, so a file without an end is read up to its last whole chunk. A checksum covers every byte: a
//! chunk's is checked before its samples are used, metadata has its own, and that of the whole file is checked last.
//! [`Recording::damage`] reports changes, [`Recording::incomplete`] missing parts.

use super::error::RecordError;
use super::recorder::{CHANGES, END, INPUTS, LATE, LATE_REPORT, RUN, SCHEMA, SignalReport, layouts};
use super::scan::{Content, Flaw, scan};
use super::track::{SignalInfo, Track};
use crate::config::{RunId, ScriptedFault};
use crate::input::{CHANGE_WORDS, Change};
use crate::late::LateReport;
use crate::sample::Stamp;
use crate::scenario::Scenario;
use crate::telemetry::{Grant, Ticks};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use xxhash_rust::xxh3::xxh3_64;

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
