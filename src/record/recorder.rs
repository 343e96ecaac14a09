//! Writes all samples of a run to a file, and compares its counters with those of the roles. Must not judge a sample.

use super::changes::ChangeTap;
use super::error::RecordError;
use super::taps::{SignalCounters, Taps};
use super::writer::Writer;
use crate::bus::AnyBus;
use crate::changes::ReceivedChanges;
use crate::clock::monotonic_ns;
use crate::late::LateReport;
use crate::runtime::{RoleId, ports};
use crate::sample::Layout;
use crate::scenario::Scenario;
use crate::system::utc;
use crate::telemetry::{MachineInfo, RoleReport};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::time::SystemTime;
use xxhash_rust::xxh3::xxh3_64;

/// The recorder's name in links and reports.
pub(crate) const RECORDER: &str = "recorder";
/// The tick in the heartbeat of a recorder that joined late and still lacks a sample of some signal.
pub(crate) const JOINING: u64 = u64::MAX;
/// Layout version of the metadata.
pub const SCHEMA: &str = "corotate/recording/v2";
/// Name of the metadata record at the beginning.
pub const RUN: &str = "corotate.run";
/// Name of the metadata record at the end.
pub const END: &str = "corotate.end";
/// Beginning of the names of the metadata records with changes of inputs that the run received; the number of the first one
/// follows.
pub const INPUTS: &str = "corotate.inputs.";
/// The key of their JSON: a list of changes as words.
pub const CHANGES: &str = "changes";
/// Name of the metadata record with the late ticks, before the one at the end.
pub const LATE: &str = "corotate.late";
/// The key of its JSON.
pub const LATE_REPORT: &str = "report";
/// The largest number of late ticks in a recording, and of their timelines.
const LATE_TICKS: usize = 1000;
const TIMELINES: usize = 10;

/// The result of a recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RecordingReport {
    /// The file.
    pub file: String,
    /// True if the recording has every published sample.
    pub complete: bool,
    /// True if the recording began before the first tick.
    pub whole: bool,
    /// The reason that the recording ended early or is incomplete.
    pub problem: Option<String>,
    /// The error code of the problem.
    #[serde(default)]
    pub code: Option<String>,
    /// Number of samples and no-sample markers in the file.
    pub messages: u64,
    /// Length of the file.
    pub bytes: u64,
    /// The recorded signals.
    pub signals: Vec<SignalReport>,
}

/// The counters of one recorded signal and of its writer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SignalReport {
    /// The service.
    pub service: String,
    /// Number of ticks with a sample.
    pub recorded: u64,
    /// Number of ticks with a no-sample marker.
    pub void: u64,
    /// Number of further samples: duplicates, late ones, ones with an impossible tick.
    pub extra: u64,
    /// Number of published samples by the writer's counters; `None` if unknown.
    pub published: Option<u64>,
    /// Number of samples that were published, reached this host, and are not recorded; `None` if unknown.
    pub lost: Option<u64>,
    /// Number of samples that were published on another host and did not reach this one.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub lost_between_hosts: u64,
    /// The last tick with a sample or marker.
    pub last_tick: Option<u64>,
    /// First and last ticks of stretches without sample or marker: not published, or lost.
    pub gaps: Vec<[u64; 2]>,
    /// Number of gaps that are not listed.
    pub more_gaps: u64,
}

fn is_zero(count: &u64) -> bool {
    *count == 0
}

impl SignalReport {
    fn new((service, counters): (String, SignalCounters)) -> Self {
        Self {
            service,
            recorded: counters.recorded,
            void: counters.void,
            extra: counters.extra,
            published: None,
            lost: None,
            lost_between_hosts: 0,
            last_tick: counters.order.next().checked_sub(1),
            gaps: counters.gaps,
            more_gaps: counters.more_gaps,
        }
    }

    /// Compares this signal with the roles' counters. May be repeated if the loop went on after the recording.
    fn reconcile(&mut self, roles: &[RoleReport], between_hosts: &dyn Fn(&str) -> u64) {
        let Some(link) = roles.iter().flat_map(|role| &role.written).find(|link| link.service == self.service) else {
            return;
        };
        self.published = Some(link.published);
        let missing = link.published.saturating_sub(self.recorded);
        self.lost_between_hosts = between_hosts(&self.service).min(missing);
        self.lost = Some(missing - self.lost_between_hosts);
        let from = self.last_tick.map_or(0, |tick| tick + 1);
        if let Some(to) = link.last_tick.filter(|to| *to >= from) {
            self.gaps.retain(|gap| gap[0] != from);
            self.gaps.push([from, to]);
        }
    }
}

impl RecordingReport {
    /// Compares the recording with the roles' final counters. `between_hosts` returns the number of a signal's samples that
    /// were lost on the way to this host.
    pub fn reconcile(&mut self, roles: &[RoleReport], between_hosts: &dyn Fn(&str) -> u64) {
        self.signals.iter_mut().for_each(|signal| signal.reconcile(roles, between_hosts));
        let lost: u64 = self.signals.iter().filter_map(|signal| signal.lost).sum();
        // A recording that began during the run is incomplete anyway.
        if let (true, None, 1..) = (self.whole, &self.problem, lost) {
            self.code = Some("samples-lost".to_owned());
            self.problem = Some(format!(
                "{lost} published samples are not in the recording: it may not have kept up; record again with fewer other \
                 programs, or at a lower tick_hz"
            ));
        }
        self.complete = self.whole && self.problem.is_none();
    }
}

/// A recording in progress.
pub struct Recorder {
    taps: Taps,
    changes: ChangeTap,
    signals: Vec<SignalReport>,
    writer: Writer,
    file: String,
    run: BTreeMap<String, String>,
    late: Option<LateReport>,
    /// The changes of inputs that the run receives, and the number of recorded ones.
    received: Arc<ReceivedChanges>,
    recorded_changes: usize,
    begun: bool,
}

impl Recorder {
    /// Opens every signal of a scenario on its bus, and the file.
    ///
    /// # Errors
    /// [`RecordError::Bus`], [`RecordError::Write`].
    pub fn open<'a>(scenario: &Scenario, bus: impl Into<AnyBus<'a>>, path: &Path) -> Result<Self, RecordError> {
        Ok(Self {
            taps: Taps::open(scenario, bus)?,
            changes: ChangeTap::new(scenario),
            signals: Vec::new(),
            writer: Writer::create(path)?,
            file: path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            run: run_metadata(scenario),
            late: None,
            received: scenario.inputs.received(),
            recorded_changes: 0,
            begun: false,
        })
    }

    /// Connects to all current writers, so that their samples arrive even if they end before the next poll.
    pub fn connect(&mut self) {
        self.taps.connect();
    }

    /// Begins the file. `epoch_ns` is the time of tick 0, or 0 unless the clock is real time. In a run that has begun, `joined`
    /// is the first tick to record.
    ///
    /// # Errors
    /// [`RecordError::Write`].
    pub fn start(&mut self, epoch_ns: u64, joined: Option<u64>) -> Result<(), RecordError> {
        self.taps.start(epoch_ns, joined);
        self.changes.start(epoch_ns);
        self.begun = true;
        self.run.insert("whole".to_owned(), joined.is_none().to_string());
        self.run.insert("epoch_ns".to_owned(), epoch_ns.to_string());
        let run = self.run.clone();
        self.taps.announce(&mut self.writer)?;
        self.writer.metadata(RUN, run)?;
        self.changes.drain(&mut self.writer)
    }

    /// Writes the samples that have arrived, and returns their number.
    ///
    /// # Errors
    /// [`RecordError`]; the file can still be [finished](Self::finish).
    pub fn poll(&mut self) -> Result<u64, RecordError> {
        self.record_changes()?;
        let taken = self.taps.drain(&mut self.writer)?;
        self.writer.close_due_chunk(monotonic_ns())?;
        Ok(taken)
    }

    /// Writes the changes of inputs that the run has received since the last call.
    fn record_changes(&mut self) -> Result<(), RecordError> {
        let count = self.received.count();
        if count == self.recorded_changes || !self.begun {
            return Ok(());
        }
        let new = (self.recorded_changes..count).filter_map(|number| Some(self.received.get(number)?.words()));
        let entries = [(CHANGES.to_owned(), json(&new.collect::<Vec<_>>()))].into();
        let name = format!("{INPUTS}{}", self.recorded_changes);
        self.recorded_changes = count;
        self.writer.metadata(&name, entries)?;
        self.changes.drain(&mut self.writer)
    }

    /// Returns the first tick that some signal still lacks.
    pub fn next_tick(&mut self) -> u64 {
        self.taps.next_tick()
    }

    /// Closes all links and keeps their counters. [`Self::finish`] does so too.
    pub fn close_links(&mut self) {
        self.signals.extend(self.taps.close().into_iter().map(SignalReport::new));
    }

    /// Adds the late ticks of the run to the end of the file: the worst thousand, and the timelines of the worst ten.
    pub fn add_late_ticks(&mut self, report: &LateReport) {
        self.late = Some(report.limited(LATE_TICKS, TIMELINES));
    }

    /// Ends the file with the counters of the recording and of the roles. `problem` is the reason of an early end.
    pub fn finish(mut self, roles: &[RoleReport], problem: Option<&RecordError>) -> RecordingReport {
        self.close_links();
        let mut report = RecordingReport {
            file: std::mem::take(&mut self.file),
            complete: true,
            whole: self.run.get("whole").is_some_and(|whole| whole == "true"),
            problem: problem.map(ToString::to_string),
            code: problem.map(code),
            messages: 0,
            bytes: 0,
            signals: std::mem::take(&mut self.signals),
        };
        report.messages = report.signals.iter().map(|signal| signal.recorded + signal.void + signal.extra).sum();
        report.reconcile(roles, &|_| 0);
        match self.end(&report, roles) {
            Ok(bytes) => report.bytes = bytes,
            Err(error) => {
                report.code.get_or_insert_with(|| code(&error));
                report.problem.get_or_insert_with(|| error.to_string());
                report.complete = false;
            }
        }
        report
    }

    fn end(&mut self, report: &RecordingReport, roles: &[RoleReport]) -> Result<u64, RecordError> {
        if !self.begun {
            self.start(0, Some(0))?;
        }
        self.record_changes()?;
        if let Some(late) = self.late.take() {
            // Without room for them the file has no late ticks, but is whole.
            self.writer.metadata_if_room(LATE, [(LATE_REPORT.to_owned(), json(&late))].into())?;
        }
        let grants: BTreeMap<&str, _> = roles.iter().map(|role| (role.role.as_str(), &role.grants)).collect();
        let ticks: BTreeMap<&str, _> = roles.iter().map(|role| (role.role.as_str(), role.ticks)).collect();
        let entries = [
            ("complete", report.complete.to_string()),
            ("problem", report.problem.clone().unwrap_or_default()),
            ("code", report.code.clone().unwrap_or_default()),
            ("signals", json(&report.signals)),
            ("ticks", json(&ticks)),
            ("privileges", json(&grants)),
        ];
        self.writer.metadata(END, entries.map(|(key, value)| (key.to_owned(), value)).into())?;
        self.writer.finish()
    }
}

fn code(error: &RecordError) -> String {
    <&str>::from(error).to_owned()
}

fn json(value: &impl Serialize) -> String {
    serde_json::to_string(value).expect("plain values serialize to JSON")
}

/// Returns the metadata of a run.
fn run_metadata(scenario: &Scenario) -> BTreeMap<String, String> {
    let (host, text) = (MachineInfo::local(), scenario.to_toml());
    let entries = [
        ("schema", SCHEMA.to_owned()),
        ("version", env!("CARGO_PKG_VERSION").to_owned()),
        ("revision", env!("COROTATE_BUILT_REVISION").to_owned()),
        ("scenario_name", scenario.name.clone()),
        ("scenario_hash", format!("{:016x}", xxh3_64(text.as_bytes()))),
        ("scenario", text),
        ("seed", scenario.seed.to_string()),
        ("clock", scenario.clock.name().to_owned()),
        ("period_ns", scenario.period_ns.to_string()),
        ("last_tick", scenario.last_tick.to_string()),
        ("started_utc", utc(SystemTime::now())),
        ("host", json(&host)),
    ];
    let run = scenario.run.map(|run| ("run", run.to_string()));
    entries.into_iter().chain(run).map(|(key, value)| (key.to_owned(), value)).collect()
}

/// Returns the service and layout of every signal of a scenario, in the order of a tick.
pub(super) fn layouts(scenario: &Scenario) -> Vec<(String, Layout)> {
    let outputs = RoleId::all(scenario).into_iter().flat_map(|role| ports(scenario, role).writes);
    outputs.map(|port| (port.topic.to_string(), Layout::from_fields(port.type_name, &port.fields))).collect()
}
