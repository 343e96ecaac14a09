//! Writes what the taps take to a file, and holds what came against the counters of the roles. Must not judge a sample.

use super::RecordError;
use super::taps::{SignalCounters, Taps};
use super::writer::Writer;
use crate::bus::AnyBus;
use crate::clock::monotonic_ns;
use crate::runtime::{RoleId, ports};
use crate::sample::Layout;
use crate::scenario::Scenario;
use crate::system::utc;
use crate::telemetry::{MachineInfo, RoleReport};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;
use std::time::SystemTime;
use xxhash_rust::xxh3::xxh3_64;

/// The recorder's name where a role would have its own.
pub(crate) const RECORDER: &str = "recorder";
/// The tick told to the launcher by a recorder that joined late and lacks a sample of some signal.
pub(crate) const JOINING: u64 = u64::MAX;
/// Layout version of the metadata.
pub const SCHEMA: &str = "corotate/recording/v2";
/// The metadata record that is written first, and the one that is written last.
pub const RUN: &str = "corotate.run";
pub const END: &str = "corotate.end";

/// How a recording went: what is in it, and what is not.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RecordingReport {
    /// The file.
    pub file: String,
    /// Whether every sample that was published is in it.
    pub complete: bool,
    /// Whether it was begun before the first tick.
    pub whole: bool,
    /// What ended it before its time, or kept it from being complete.
    pub problem: Option<String>,
    /// The stable name of the problem.
    #[serde(default)]
    pub code: Option<String>,
    /// Samples written, of all signals.
    pub messages: u64,
    /// The file's length.
    pub bytes: u64,
    /// Per signal.
    pub signals: Vec<SignalReport>,
}

/// The counters of one recorded signal, beside those of its writer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SignalReport {
    /// The service.
    pub service: String,
    /// Ticks of which there is a sample.
    pub recorded: u64,
    /// Ticks of which there is a void.
    pub void: u64,
    /// Samples beside the one of their tick: second, late, broken ones.
    pub extra: u64,
    /// Samples that its writer published by its own counters; none if it keeps none.
    pub published: Option<u64>,
    /// Published and not recorded, though it came to this host; none if that is not known.
    pub lost: Option<u64>,
    /// Published on another host, and lost on the way here.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub lost_between_hosts: u64,
    /// The last tick of which there is something.
    pub last_tick: Option<u64>,
    /// Ticks, first and last, of which there is nothing: never published, or lost.
    pub gaps: Vec<[u64; 2]>,
    /// Gaps beyond those told.
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
            last_tick: counters.next.checked_sub(1),
            gaps: counters.gaps,
            more_gaps: counters.more_gaps,
        }
    }

    /// Holds what was recorded against the counters of the roles. Again, if the loop went on after the recording.
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
    /// Holds the recording against the roles' final counters. `between_hosts` tells how much of a signal was lost on the way to this
    /// host.
    pub fn reconcile(&mut self, roles: &[RoleReport], between_hosts: &dyn Fn(&str) -> u64) {
        self.signals.iter_mut().for_each(|signal| signal.reconcile(roles, between_hosts));
        let lost: u64 = self.signals.iter().filter_map(|signal| signal.lost).sum();
        // Whoever began in the midst of a run knew that.
        if let (true, None, 1..) = (self.whole, &self.problem, lost) {
            self.code = Some("samples-lost".to_owned());
            self.problem = Some(format!(
                "{lost} samples were published and are not in the recording; if it did not keep up, record again with \
                 fewer other programs, or at a lower tick_hz"
            ));
        }
        self.complete = self.whole && self.problem.is_none();
    }
}

/// A recording in the making.
pub struct Recorder {
    taps: Taps,
    signals: Vec<SignalReport>,
    writer: Writer,
    file: String,
    run: BTreeMap<String, String>,
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
            signals: Vec::new(),
            writer: Writer::create(path)?,
            file: path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            run: about(scenario),
            begun: false,
        })
    }

    /// Connects to every writer that there is now: what these send is taken even if they are gone by then.
    pub fn connect(&mut self) {
        self.taps.connect();
    }

    /// Begins the file, once the epoch of the ticks is known: 0 where there is no time. If ticks have run, `joined` is
    /// the first that is taken.
    ///
    /// # Errors
    /// [`RecordError::Write`].
    pub fn start(&mut self, epoch_ns: u64, joined: Option<u64>) -> Result<(), RecordError> {
        self.taps.start(epoch_ns, joined);
        self.begun = true;
        self.run.insert("whole".to_owned(), joined.is_none().to_string());
        self.run.insert("epoch_ns".to_owned(), epoch_ns.to_string());
        let run = self.run.clone();
        self.taps.announce(&mut self.writer)?;
        self.writer.metadata(RUN, run)
    }

    /// Writes whatever has come; returns how many samples.
    ///
    /// # Errors
    /// [`RecordError`]; the file can be [finished](Self::finish) then.
    pub fn poll(&mut self) -> Result<u64, RecordError> {
        let taken = self.taps.drain(&mut self.writer)?;
        self.writer.turn(monotonic_ns())?;
        Ok(taken)
    }

    /// The tick of which not every signal is here yet.
    pub fn next_tick(&mut self) -> u64 {
        self.taps.next_tick()
    }

    /// Closes every signal, before [the end](Self::finish).
    pub fn leave(&mut self) {
        self.signals.extend(self.taps.close().into_iter().map(SignalReport::new));
    }

    /// Ends the file, with the counters of the recording beside those of the roles. `problem` is what ended it before its time.
    pub fn finish(mut self, roles: &[RoleReport], problem: Option<&RecordError>) -> RecordingReport {
        self.leave();
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
    serde_json::to_string(value).expect("books of plain values are JSON")
}

/// What the file says of its run.
fn about(scenario: &Scenario) -> BTreeMap<String, String> {
    let (host, text) = (MachineInfo::local(), scenario.to_toml());
    let entries = [
        ("schema", SCHEMA.to_owned()),
        ("version", env!("CARGO_PKG_VERSION").to_owned()),
        ("revision", env!("COROTATE_REVISION").to_owned()),
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

/// The layout of every signal of a scenario in this version, by service, in the order of a tick.
pub(super) fn layouts(scenario: &Scenario) -> Vec<(String, Layout)> {
    let of = |role| ports(scenario, role).writes;
    let written = RoleId::all(scenario).into_iter().flat_map(of);
    written.map(|port| (port.topic.to_string(), Layout::from_fields(port.type_name, &port.fields))).collect()
}
