//! The summary of a run: verdict, counters, hash, latencies; and the files that hold it.
//!
//! Must not hide anything: a missing measurement is reported as missing.

use super::criteria::{Criterion, Judge, accepted, verdict};
use super::incident::{Action, Incident};
use super::outcome::{Accounting, Outcome, StageFigures, State, incident_figures, latencies};
use super::results::{HASHES, LATE, LATENCY, LATENCY_LOG, SCENARIO, SUMMARY};
use crate::analysis::Claim;
use crate::config::{ClockKind, RunId};
use crate::files;
use crate::hosts::NetworkStatistics;
use crate::inputs::{AppliedChange, applied};
use crate::late::LateReport;
use crate::record::RecordingReport;
use crate::rig::Figure;
use crate::runtime::RoleId;
use crate::scenario::{Scenario, claims};
use crate::score::Score;
use crate::serial::LineCounters;
use crate::system::utc;
use crate::telemetry::{Grant, MachineInfo, PaceReport, RoleReport, WatchReport, write_hgrm, write_hlog};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Layout version of `summary.json`.
pub const SCHEMA: &str = "corotate/summary/v1";

/// The number of late ticks in a summary.
const WORST: usize = 10;

/// A run's summary, as it is written to `summary.json`.
#[derive(Debug, Serialize, Deserialize)]
pub struct Summary {
    schema: String,
    /// The program's version.
    pub version: String,
    /// The revision of its source code.
    pub revision: String,
    /// The run's identifier, which all of its files carry.
    pub run: Option<RunId>,
    /// The scenario's name.
    pub scenario: String,
    /// The clock's name.
    pub clock: String,
    /// Ticks per second.
    pub tick_hz: f64,
    /// The last tick of the scenario.
    pub last_tick: u64,
    /// In real time, the limit beyond which an executed tick counts as late, µs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub late_us: Option<f64>,
    /// The time at which it was started.
    pub started_utc: String,
    /// The machine.
    pub host: MachineInfo,
    /// Roles without a process of their own, with the role whose process they shared.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub hosted: BTreeMap<String, String>,
    domain: Option<PathBuf>,
    /// The signal that ended the run early, or 0.
    pub signal: usize,
    /// True if all judged criteria hold; `None` if none was judged.
    pub accepted: Option<bool>,
    /// The verdict in words, with the reason if nothing was judged.
    pub verdict: String,
    /// One entry per criterion.
    pub criteria: Vec<Criterion>,
    /// The score.
    pub score: Score,
    /// Roles that failed while the ticks ran, with the reactions.
    pub incidents: Vec<Incident>,
    /// The changes of inputs, in the order of their ticks.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub inputs: Vec<AppliedChange>,
    /// Notes on the scenario for readers of the results.
    pub notes: Vec<String>,
    /// The physical bounds against which samples are checked.
    pub limits: Vec<Figure>,
    /// The watchdog's report, if it watches anything.
    pub watchdog: Option<WatchReport>,
    /// The claims about the loop, per driven body.
    pub certificates: Vec<Claim>,
    /// The counters.
    pub books: Accounting,
    /// The state hash.
    pub state: State,
    /// One entry per role and stage, in the order of a tick.
    pub latencies: Vec<StageFigures>,
    /// The late ticks by cause, and the worst ones, in real time; `late.json` has all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub late: Option<LateReport>,
    /// The counters of the serial lines, by the body that a device simulates, since the last start of its bridge.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub lines: BTreeMap<String, LineCounters>,
    /// The relation of the run's clock to the device that sets its pace, by the body that this device is.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub pace: BTreeMap<String, PaceReport>,
    /// The part of each host, if the run had several.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hosts: Option<NetworkStatistics>,
    /// The recording, if there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub recording: Option<RecordingReport>,
    /// The requested privileges.
    pub privileges: Vec<RoleGrant>,
    /// Roles with a process of their own that report no privileges.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub privileges_unknown: Vec<String>,
}

/// A privilege of a role.
#[derive(Debug, Serialize, Deserialize)]
pub struct RoleGrant {
    /// The role, or `launcher`.
    pub role: String,
    /// The request and its result.
    #[serde(flatten)]
    pub grant: Grant,
}

/// The verdict on a run by its scenario's criteria.
pub(crate) struct Judged {
    latencies: Vec<StageFigures>,
    pub books: Accounting,
    pub(super) criteria: Vec<Criterion>,
    /// True if all judged criteria hold; `None` if none was judged.
    pub accepted: Option<bool>,
    /// The verdict in words.
    pub verdict: String,
}

impl Judged {
    pub fn new(scenario: &Scenario, outcome: &Outcome) -> Self {
        let mut latencies = latencies(scenario, &outcome.reports);
        latencies.extend(incident_figures(&outcome.incidents));
        let lost = outcome.incidents.iter().filter(|incident| incident.action == Action::Stopped);
        let lost: Vec<&str> =
            lost.flat_map(|incident| incident.with.iter().chain([&incident.role])).map(String::as_str).collect();
        // A stepped run ends at the tick where its caller stops.
        let ends_early = |report: &RoleReport| report.ticks.elapsed <= scenario.last_tick;
        let left = scenario.clock == ClockKind::InProcess && outcome.reports.iter().any(ends_early);
        let interrupted = outcome.signal != 0 || !lost.is_empty() || left;
        let books = Accounting::new(scenario, outcome, interrupted, &lost);
        let judge = Judge { scenario, outcome, books: &books, latencies: &latencies, interrupted };
        let criteria = judge.criteria();
        // A run that lost a role is not accepted, whether or not its criteria hold.
        let accepted = accepted(&criteria, interrupted).or((!lost.is_empty()).then_some(false));
        let verdict = verdict(accepted, &criteria, interrupted);
        Self { latencies, books, criteria, accepted, verdict }
    }
}

/// Incidents with the times of their ticks.
fn timed(scenario: &Scenario, incidents: &[Incident]) -> Vec<Incident> {
    let timed = |incident: &Incident| Incident { time_s: scenario.time_s(incident.tick), ..incident.clone() };
    incidents.iter().map(timed).collect()
}

impl Summary {
    /// Reads a summary.
    ///
    /// # Errors
    /// The reason, if it has another layout or is incomplete.
    pub fn parse(text: &str) -> Result<Self, String> {
        #[derive(Deserialize)]
        struct Head {
            schema: String,
        }
        let head: Head = serde_json::from_str(text).map_err(|error| error.to_string())?;
        if head.schema != SCHEMA {
            return Err(format!("its layout is {}, and this version reads {SCHEMA}", head.schema));
        }
        serde_json::from_str(text).map_err(|error| error.to_string())
    }

    /// Creates the summary of a run that began at `started`.
    pub fn new(scenario: &Scenario, outcome: &Outcome, started: SystemTime) -> Self {
        let Judged { latencies, books, criteria, accepted, verdict } = Judged::new(scenario, outcome);
        Self {
            schema: SCHEMA.to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            revision: env!("COROTATE_BUILT_REVISION").to_owned(),
            run: scenario.run,
            scenario: scenario.name.clone(),
            clock: scenario.clock.name().to_owned(),
            tick_hz: 1e9 / scenario.period_ns as f64,
            last_tick: scenario.last_tick,
            late_us: (scenario.clock == ClockKind::Realtime)
                .then(|| scenario.realtime.late_ns(scenario.period_ns) as f64 / 1e3),
            started_utc: utc(started),
            host: MachineInfo::local(),
            hosted: hosted(scenario),
            domain: outcome.domain.clone(),
            signal: outcome.signal,
            accepted,
            verdict,
            criteria,
            score: outcome.score.clone(),
            incidents: timed(scenario, &outcome.incidents),
            inputs: applied(scenario),
            notes: scenario.notes().into_iter().chain(scenario.warnings.iter().cloned()).collect(),
            limits: scenario.rig.limits(),
            watchdog: outcome.reports.iter().find_map(|report| report.watchdog.clone()),
            // The analysis runs the same code.
            certificates: if outcome.incidents.iter().any(|incident| incident.panic.is_some()) {
                Vec::new()
            } else {
                claims(scenario)
            },
            state: State::new(&outcome.reports, &books),
            books,
            latencies,
            late: outcome.late.as_ref().map(|late| late.worst(WORST)),
            lines: lines(&outcome.reports),
            pace: paces(&outcome.reports),
            hosts: NetworkStatistics::merge(&outcome.hosts),
            recording: outcome.recording.clone(),
            privileges: privileges(outcome),
            privileges_unknown: privileges_unknown(scenario, outcome),
        }
    }
}

fn hosted(scenario: &Scenario) -> BTreeMap<String, String> {
    let roles = RoleId::all(scenario).into_iter().map(|role| (role, role.process_role(scenario)));
    let hosted = roles.filter(|(role, host)| role != host);
    hosted.map(|(role, host)| (role.name(scenario).to_owned(), host.name(scenario).to_owned())).collect()
}

fn lines(reports: &[RoleReport]) -> BTreeMap<String, LineCounters> {
    reports.iter().filter_map(|report| Some((report.role.clone(), report.line?))).collect()
}

fn paces(reports: &[RoleReport]) -> BTreeMap<String, PaceReport> {
    reports.iter().filter_map(|report| Some((report.role.clone(), report.pace.clone()?))).collect()
}

fn privileges(outcome: &Outcome) -> Vec<RoleGrant> {
    let own = outcome.grants.iter().map(|grant| RoleGrant { role: "launcher".to_owned(), grant: grant.clone() });
    let roles = outcome.reports.iter().flat_map(|report| {
        report.grants.iter().map(|grant| RoleGrant { role: report.role.clone(), grant: grant.clone() })
    });
    own.chain(roles).collect()
}

/// Returns the processes whose privileges are unknown: those without a report while others have one.
fn privileges_unknown(scenario: &Scenario, outcome: &Outcome) -> Vec<String> {
    if scenario.clock != crate::config::ClockKind::Realtime {
        return Vec::new();
    }
    let tells = |name: &str| outcome.reports.iter().any(|report| report.role == name && !report.grants.is_empty());
    let asked = outcome.reports.iter().any(|report| !report.grants.is_empty());
    let hosts = RoleId::all(scenario).into_iter().filter(|role| *role == role.process_role(scenario));
    let names = hosts.map(|role| role.name(scenario).to_owned());
    names.filter(|name| outcome.unbooked.contains(name) || asked && !tells(name)).collect()
}

/// Writes a run's files into `directory`, which exists: `scenario.toml`, `summary.json`, `late.json`, `hashes.txt`,
/// `latency/`.
///
/// # Errors
/// The error of the file system, with the file's name.
pub fn write_run(
    directory: &Path,
    scenario: &Scenario,
    summary: &Summary,
    late: Option<&LateReport>,
) -> io::Result<()> {
    let run = summary.run.map(RunId::comment);
    write(&directory.join(SCENARIO), |out| out.write_all(scenario.to_file().as_bytes()))?;
    write(&directory.join(SUMMARY), |out| {
        serde_json::to_writer_pretty(&mut *out, summary)?;
        writeln!(out)
    })?;
    if let Some(late) = late {
        write(&directory.join(LATE), |out| {
            serde_json::to_writer(&mut *out, late)?;
            writeln!(out)
        })?;
    }
    write(&directory.join(HASHES), |out| {
        let run = run.as_ref().map_or(String::new(), |run| format!("{run}: "));
        writeln!(out, "# {run}number of ticks from the first on, hash over all samples published in them")?;
        summary.state.checkpoints.iter().try_for_each(|(ticks, hash)| writeln!(out, "{ticks} {hash:016x}"))
    })?;
    if summary.latencies.is_empty() {
        return Ok(());
    }
    let latency = directory.join(LATENCY);
    files::create_directories(&latency).map_err(|error| named(&latency, &error))?;
    let shown = || summary.latencies.iter().filter(|stage| stage.figures.are_shown());
    for stage in shown() {
        let path = latency.join(format!("{}.{}.hgrm", stage.role, stage.stage));
        write(&path, |out| write_hgrm(&stage.latency, run.as_deref(), out))?;
    }
    let names: Vec<String> = shown().map(|stage| format!("{}.{}", stage.role, stage.stage)).collect();
    let run_s = summary.last_tick as f64 / summary.tick_hz;
    write(&latency.join(LATENCY_LOG), |out| {
        write_hlog(
            names.iter().map(String::as_str).zip(shown().map(|stage| &stage.latency)),
            run_s,
            run.as_deref(),
            out,
        )
    })
}

fn write(path: &Path, content: impl FnOnce(&mut BufWriter<files::Created>) -> io::Result<()>) -> io::Result<()> {
    let attempt = || {
        let mut out = BufWriter::new(files::create(path)?);
        content(&mut out)?;
        out.flush()
    };
    attempt().map_err(|error: io::Error| named(path, &error))
}

fn named(path: &Path, error: &io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("{}: {error}", path.display()))
}
