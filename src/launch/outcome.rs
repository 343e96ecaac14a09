//! What a run came to: verdict, counters, hash, latencies; and the files that say so.
//!
//! Must not soften anything: what was not measured is said to be so, and counters that do not balance are a failure.

use super::criteria::{Criterion, Judge, accepted, verdict};
use super::processes::Remains;
use super::results::{HASHES, LATENCY, LATENCY_LOG, SCENARIO, SUMMARY};
use super::{Action, Incident, Score};
use crate::analysis::Claim;
use crate::config::{ClockKind, RunId};
use crate::files;
use crate::hosts::{HostReport, HostsSummary};
use crate::record::RecordingReport;
use crate::rig::Figure;
use crate::runtime::{RoleId, ports};
use crate::scenario::Scenario;
use crate::scenario::claims;
use crate::serial::LineCounters;
use crate::system::utc;
use crate::telemetry::{
    Checkpoints, Grant, Host, Latency, LinkRead, LinkWritten, Percentiles, RoleReport, Ticks, WatchReport, combine,
    write_hgrm, write_hlog,
};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Layout version of `summary.json`.
pub const SCHEMA: &str = "corotate/summary/v1";

/// Everything that a run left in memory.
#[derive(Debug)]
pub struct Outcome {
    /// The roles' own accounts, in the order of a tick.
    pub reports: Vec<RoleReport>,
    /// External roles that keep no counters.
    pub unbooked: Vec<String>,
    /// What is wrong with accounts that were left.
    pub problems: Vec<String>,
    /// The score.
    pub score: Score,
    /// Roles that failed while the ticks ran.
    pub incidents: Vec<Incident>,
    /// What hosts tell of their part, if there are several.
    pub hosts: Vec<HostReport>,
    /// The launcher's own privileges.
    pub grants: Vec<Grant>,
    /// What was recorded, if that was asked for.
    pub recording: Option<RecordingReport>,
    /// The domain that was used, if there was one.
    pub domain: Option<PathBuf>,
    /// The signal that ended the run before its time, or 0.
    pub signal: usize,
    /// What is still to be removed of the run, if it had processes: that goes when this is dropped.
    #[expect(dead_code, reason = "held for what its end does")]
    pub(super) remains: Option<Remains>,
}

/// A run's summary, as it is written to `summary.json`.
#[derive(Debug, Serialize, Deserialize)]
pub struct Summary {
    schema: String,
    /// The program's version.
    pub version: String,
    /// The revision of its sources.
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
    /// The time at which it was started.
    pub started_utc: String,
    /// The machine.
    pub host: Host,
    /// Roles that had no process of their own, with the role in whose process they were.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub hosted: BTreeMap<String, String>,
    domain: Option<PathBuf>,
    /// The signal that ended the run before its time, or 0.
    pub signal: usize,
    /// Whether every criterion that could be judged holds; none if none could be.
    pub accepted: Option<bool>,
    /// The same in words, with the reason where nothing was judged.
    pub verdict: String,
    /// One entry per criterion.
    pub criteria: Vec<Criterion>,
    /// The score.
    pub score: Score,
    /// Roles that failed while the ticks ran, and what became of them.
    pub incidents: Vec<Incident>,
    /// What a reader of the results must know of the scenario.
    pub notes: Vec<String>,
    /// The physical bounds that samples are held against.
    pub limits: Vec<Figure>,
    /// What the watchdog saw, if anything is watched.
    pub watchdog: Option<WatchReport>,
    /// What may be claimed of the loop, per driven body.
    pub certificates: Vec<Claim>,
    /// The counters.
    pub books: Accounting,
    /// The state hash.
    pub state: State,
    /// One entry per role and stage, in the order of a tick.
    pub latencies: Vec<StageFigures>,
    /// The counters of the serial lines, by the body whose seat a device has; as far back as its bridge was started.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub lines: BTreeMap<String, LineCounters>,
    /// The part of each host, if the run had several.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hosts: Option<HostsSummary>,
    /// What was recorded, if that was asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub recording: Option<RecordingReport>,
    /// Everything that was asked of the machine.
    pub privileges: Vec<RoleGrant>,
    /// Roles with a process of their own that report no privileges.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub privileges_unknown: Vec<String>,
}

/// The counters of a run.
#[derive(Debug, Serialize, Deserialize)]
pub struct Accounting {
    /// Whether they balance.
    pub balanced: bool,
    /// Where they do not.
    pub problems: Vec<String>,
    /// External roles that keep no counters: nothing is known of their ticks, nor of the links that they write and read.
    pub unbooked: Vec<String>,
    /// Per role.
    pub roles: BTreeMap<String, Ticks>,
    /// Per reading end.
    pub links: Vec<LinkCounters>,
    /// Per external role that keeps no counters: ticks of which its readers had no sample.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub absent_ticks: BTreeMap<String, u64>,
    /// Ticks missed or starved, all roles together.
    pub missed_ticks: u64,
    /// Samples received and not believed, all links together.
    pub rejected_samples: u64,
    /// Samples received and rejected, by reason.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub rejected_by: BTreeMap<String, u64>,
    /// Samples that scripted faults touched, and stalls.
    pub injected_faults: u64,
}

/// One reading end beside its writing end. Of a writer that keeps no counters nothing is known but what its reader met.
#[derive(Debug, Serialize, Deserialize)]
pub struct LinkCounters {
    /// The service.
    pub service: String,
    /// The reading role.
    pub reader: String,
    /// Samples sent.
    pub published: Option<u64>,
    /// Samples received.
    pub received: u64,
    /// Ticks for which the writer sent none.
    pub skipped: Option<u64>,
    /// Ticks for which the reader received none, up to its last.
    pub gaps: u64,
    /// Sent after the reader's last look.
    pub unread: Option<u64>,
    /// Ticks for which the writer sent a void, and voids received.
    pub void: (Option<u64>, u64),
    /// Samples that were not newer than the one before.
    pub stale: u64,
    /// Samples received and not believed.
    pub rejected: u64,
    /// Samples received and rejected, by reason.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub rejected_by: BTreeMap<String, u64>,
    /// Samples that scripted faults touched on the writing end.
    pub injected: Option<u64>,
}

/// The state hash of a run, comparable between clocks.
#[derive(Debug, Serialize, Deserialize)]
pub struct State {
    /// The hash over everything that was published.
    pub hash: String,
    /// How many ticks the run came to: those that every role with counters executed or missed.
    pub elapsed_ticks: u64,
    /// The first tick whose samples may differ from an undisturbed run's, if any.
    pub first_disturbed_tick: Option<u64>,
    /// How many ticks from the first on are covered by `clean_hash`: all that are undisturbed, or up to the last checkpoint
    /// among them. Runs of more than 16 384 ticks have one every 2nd, 3rd, … tick.
    pub clean_ticks: u64,
    /// The hash over those ticks.
    pub clean_hash: String,
    #[serde(skip)]
    checkpoints: Vec<(u64, u64)>,
}

/// One stage's figures.
#[derive(Debug, Serialize, Deserialize)]
pub struct StageFigures {
    /// The role.
    pub role: String,
    /// The stage.
    pub stage: String,
    /// The role whose stamps lie ahead of this role's clock, so that there are no figures.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stamps_of: Option<String>,
    /// The figures.
    #[serde(flatten)]
    pub figures: Percentiles,
    #[serde(skip)]
    latency: Latency,
}

/// A privilege of a role.
#[derive(Debug, Serialize, Deserialize)]
pub struct RoleGrant {
    /// The role, or `launcher`.
    pub role: String,
    /// What it asked for and got.
    #[serde(flatten)]
    pub grant: Grant,
}

impl State {
    /// How far the hash covers the run, in words, where no tick is known to be disturbed.
    pub(crate) fn undisturbed_words(elapsed_ticks: u64, all_ticks: u64, unbooked: bool) -> String {
        match (elapsed_ticks < all_ticks, unbooked) {
            (true, _) => format!("the run ended after {elapsed_ticks} of {all_ticks} ticks"),
            (false, true) => "every tick of the roles that keep books undisturbed".to_owned(),
            (false, false) => "every tick undisturbed".to_owned(),
        }
    }
}

/// What a run came to, held against its scenario.
pub(crate) struct Judged {
    latencies: Vec<StageFigures>,
    pub books: Accounting,
    pub(super) criteria: Vec<Criterion>,
    /// Whether every criterion that could be judged holds; none if none could be.
    pub accepted: Option<bool>,
    /// The same in words.
    pub verdict: String,
}

impl Judged {
    pub fn new(scenario: &Scenario, outcome: &Outcome) -> Self {
        let mut latencies = latencies(scenario, &outcome.reports);
        latencies.extend(incident_figures(&outcome.incidents));
        let lost = outcome.incidents.iter().filter(|incident| incident.action == Action::Stopped);
        let lost: Vec<&str> =
            lost.flat_map(|incident| incident.with.iter().chain([&incident.role])).map(String::as_str).collect();
        // A run that is stepped ends where its caller leaves it.
        let ends_early = |report: &RoleReport| report.ticks.elapsed <= scenario.last_tick;
        let left = scenario.clock == ClockKind::InProcess && outcome.reports.iter().any(ends_early);
        let interrupted = outcome.signal != 0 || !lost.is_empty() || left;
        let books = Accounting::new(scenario, outcome, interrupted, &lost);
        let judge = Judge { scenario, outcome, books: &books, latencies: &latencies, interrupted };
        let criteria = judge.criteria();
        // A run that lost a role is not accepted, whatever its criteria say.
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

/// The hash over everything that was published, as a summary has it.
pub(crate) fn state_hash(reports: &[RoleReport]) -> String {
    format!("{:016x}", combine(hashes(reports).iter().map(|(_, hash)| hash.last)))
}

/// The hashes of all signals, in the order of their names.
fn hashes(reports: &[RoleReport]) -> Vec<(&String, &Checkpoints)> {
    let written = reports.iter().flat_map(|report| &report.written);
    let mut links: Vec<_> = written.filter_map(|link| Some((&link.service, link.hash.as_ref()?))).collect();
    links.sort_by_key(|(service, _)| *service);
    links
}

impl Summary {
    /// Reads a summary.
    ///
    /// # Errors
    /// The reason, if it has another layout or lacks something.
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

    /// Draws up the summary of a run that began at `started`.
    pub fn new(scenario: &Scenario, outcome: &Outcome, started: SystemTime) -> Self {
        let Judged { latencies, books, criteria, accepted, verdict } = Judged::new(scenario, outcome);
        Self {
            schema: SCHEMA.to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            revision: env!("COROTATE_REVISION").to_owned(),
            run: scenario.run,
            scenario: scenario.name.clone(),
            clock: scenario.clock.name().to_owned(),
            tick_hz: 1e9 / scenario.period_ns as f64,
            last_tick: scenario.last_tick,
            started_utc: utc(started),
            host: Host::this(),
            hosted: hosted(scenario),
            domain: outcome.domain.clone(),
            signal: outcome.signal,
            accepted,
            verdict,
            criteria,
            score: outcome.score.clone(),
            incidents: timed(scenario, &outcome.incidents),
            notes: scenario.notes().into_iter().chain(scenario.warnings.iter().cloned()).collect(),
            limits: scenario.rig.limits(),
            watchdog: outcome.reports.iter().find_map(|report| report.watchdog.clone()),
            certificates: claims(scenario),
            state: State::new(&outcome.reports, &books),
            books,
            latencies,
            lines: lines(&outcome.reports),
            hosts: HostsSummary::of(&outcome.hosts),
            recording: outcome.recording.clone(),
            privileges: privileges(outcome),
            privileges_unknown: privileges_unknown(scenario, outcome),
        }
    }
}

impl Accounting {
    fn new(scenario: &Scenario, outcome: &Outcome, interrupted: bool, lost: &[&str]) -> Self {
        let (reports, mut problems) = (&outcome.reports, outcome.problems.clone());
        let written = reports.iter().flat_map(|report| report.written.iter().map(move |link| (&*report.role, link)));
        let written: Vec<(&str, &LinkWritten)> = written.collect();
        for report in reports {
            let Ticks { elapsed, executed, missed, .. } = report.ticks;
            if executed + missed != elapsed || (!interrupted && elapsed != scenario.last_tick + 1) {
                problems.push(format!("{}: {executed} executed + {missed} missed of {elapsed} ticks", report.role));
            }
        }
        for (_, link) in &written {
            if !link.balances() {
                problems.push(format!("{}: published and skipped do not add up", link.service));
            }
        }
        if !interrupted {
            problems.extend(HostsSummary::of(&outcome.hosts).iter().flat_map(HostsSummary::problems));
        }
        let mut links = Vec::new();
        for (report, read) in reports.iter().flat_map(|report| report.read.iter().map(move |read| (report, read))) {
            let written = written.iter().find(|(_, written)| written.service == read.service);
            // A role that died may have sent a sample that it had no time to count: whoever received it knows.
            let in_flight =
                written.is_some_and(|(writer, written)| lost.contains(writer) && read.last_tick > written.last_tick);
            let written = written.map(|(_, written)| *written);
            links.push(LinkCounters::new(&report.role, written, in_flight, read, scenario, &mut problems));
        }
        let mut rejected_by = BTreeMap::new();
        for (reason, count) in links.iter().flat_map(|link| &link.rejected_by) {
            *rejected_by.entry(reason.clone()).or_default() += count;
        }
        let elapsed = reports.iter().map(|report| report.ticks.elapsed).max().unwrap_or(0);
        let absent_ticks = outcome.unbooked.iter().filter_map(|role| {
            let came = links_of(scenario, role, &links).map(|link| link.received + link.void.1).min()?;
            // A reader need not have looked for the last sample, nor for commands that act after the end.
            Some((role.clone(), elapsed.saturating_sub(came + scenario.actuation_delay_ticks)))
        });
        Self {
            absent_ticks: absent_ticks.collect(),
            balanced: problems.is_empty(),
            problems,
            unbooked: outcome.unbooked.clone(),
            missed_ticks: reports.iter().map(|report| report.ticks.missed + report.ticks.starved).sum(),
            rejected_samples: links.iter().map(|link| link.rejected).sum(),
            rejected_by,
            injected_faults: written.iter().map(|(_, link)| link.injected).sum::<u64>()
                + reports.iter().map(|report| report.ticks.stalled + report.ticks.scripted).sum::<u64>(),
            roles: reports.iter().map(|report| (report.role.clone(), report.ticks)).collect(),
            links,
        }
    }
}

/// The reading ends of what a role sends.
pub(super) fn links_of<'a>(
    scenario: &Scenario,
    role: &str,
    links: &'a [LinkCounters],
) -> impl Iterator<Item = &'a LinkCounters> {
    let id = RoleId::all(scenario).into_iter().find(|id| id.name(scenario) == role);
    let writes = id.map_or(Vec::new(), |id| ports(scenario, id).writes);
    let services: Vec<String> = writes.iter().map(|port| port.topic.to_string()).collect();
    links.iter().filter(move |link| services.contains(&link.service))
}

impl LinkCounters {
    fn new(
        reader: &str,
        written: Option<&LinkWritten>,
        in_flight: bool,
        read: &LinkRead,
        scenario: &Scenario,
        problems: &mut Vec<String>,
    ) -> Self {
        let in_flight = u64::from(in_flight);
        let unread = |written: &LinkWritten| (written.covered() + in_flight).saturating_sub(read.covered());
        let counters = Self {
            service: read.service.clone(),
            reader: reader.to_owned(),
            published: written.map(|written| written.published + in_flight),
            received: read.received,
            skipped: written.map(|written| written.skipped),
            gaps: read.gaps,
            unread: written.map(unread),
            void: (written.map(|written| written.void), read.void),
            stale: read.stale,
            rejected: read.rejected,
            rejected_by: read.rejected_by.clone(),
            injected: written.map(|written| written.injected),
        };
        let lossless = scenario.clock != ClockKind::Realtime;
        let balanced = read.balances(lossless) && written.is_none_or(|written| read.agrees(written, in_flight));
        if !balanced {
            let writer = written.map_or("its writer keeps no books".to_owned(), |written| {
                format!("{} published, {} extra, {} void", written.published, written.extra, written.void)
            });
            problems.push(format!(
                "{} at {reader}: {} received, {} gaps, {} stale, {} void; {writer}",
                counters.service, counters.received, counters.gaps, read.stale, read.void
            ));
        }
        counters
    }
}

impl State {
    fn new(reports: &[RoleReport], books: &Accounting) -> Self {
        let links = hashes(reports);
        let stride = links.iter().map(|(_, hash)| hash.stride).max().unwrap_or(1);
        let count = links.iter().map(|(_, hash)| hash.hashes.len()).min().unwrap_or(0);
        let mut checkpoints: Vec<(u64, u64)> = (0..count)
            .map(|index| ((index as u64 + 1) * stride, combine(links.iter().map(|(_, hash)| hash.hashes[index]))))
            .collect();
        let first_disturbed_tick = books.roles.values().filter_map(|ticks| ticks.first_disturbed).min();
        let hash = combine(links.iter().map(|(_, hash)| hash.last));
        let mut elapsed = books.roles.values().map(|ticks| ticks.elapsed);
        let elapsed_ticks = elapsed.clone().min().unwrap_or(0);
        // The end is seldom a multiple of the stride. It is one moment only if all came as far.
        let covered = checkpoints.last().map_or(0, |(ticks, _)| *ticks);
        if first_disturbed_tick.is_none() && covered < elapsed_ticks && elapsed.all(|ticks| ticks == elapsed_ticks) {
            checkpoints.push((elapsed_ticks, hash));
        }
        let clean =
            checkpoints.iter().rev().find(|(ticks, _)| first_disturbed_tick.is_none_or(|first| *ticks <= first));
        let (clean_ticks, clean_hash) = clean.copied().unwrap_or((0, 0));
        Self {
            hash: format!("{hash:016x}"),
            elapsed_ticks,
            first_disturbed_tick,
            clean_ticks,
            clean_hash: format!("{clean_hash:016x}"),
            checkpoints,
        }
    }
}

/// How long roles that failed were out, and how long the loop took to recover from it, by role.
fn incident_figures(incidents: &[Incident]) -> Vec<StageFigures> {
    let mut stages: BTreeMap<(&str, &str), Latency> = BTreeMap::new();
    for incident in incidents {
        for (stage, seconds) in [("outage", incident.outage_s), ("recovery", incident.recovery_s)] {
            if let Some(seconds) = seconds {
                stages.entry((&incident.role, stage)).or_default().record(0, (seconds * 1e9) as u64);
            }
        }
    }
    let figures = |((role, stage), latency): ((&str, &str), Latency)| StageFigures {
        role: role.to_owned(),
        stage: stage.to_owned(),
        stamps_of: None,
        figures: latency.percentiles(),
        latency,
    };
    stages.into_iter().map(figures).collect()
}

fn latencies(scenario: &Scenario, reports: &[RoleReport]) -> Vec<StageFigures> {
    let figures = |report: &RoleReport, stage: &crate::telemetry::StageReport| {
        let (latency, role, stage) = (stage.latency(), report.role.clone(), stage.stage.clone());
        let figures = latency.percentiles();
        // An age begins at the leader, a hop at who sent the input; all else is measured by one clock.
        let sender = if stage == "hop" && role == "controller" { RoleId::Observer } else { RoleId::Plant(0) };
        let stamps_of = (!figures.are_shown()).then(|| sender.name(scenario).to_owned());
        StageFigures { role, stage, stamps_of, figures, latency }
    };
    reports.iter().flat_map(|report| report.stages.iter().map(move |stage| figures(report, stage))).collect()
}

fn hosted(scenario: &Scenario) -> BTreeMap<String, String> {
    let roles = RoleId::all(scenario).into_iter().map(|role| (role, role.host(scenario)));
    let hosted = roles.filter(|(role, host)| role != host);
    hosted.map(|(role, host)| (role.name(scenario).to_owned(), host.name(scenario).to_owned())).collect()
}

fn lines(reports: &[RoleReport]) -> BTreeMap<String, LineCounters> {
    reports.iter().filter_map(|report| Some((report.role.clone(), report.line?))).collect()
}

fn privileges(outcome: &Outcome) -> Vec<RoleGrant> {
    let own = outcome.grants.iter().map(|grant| RoleGrant { role: "launcher".to_owned(), grant: grant.clone() });
    let roles = outcome.reports.iter().flat_map(|report| {
        report.grants.iter().map(|grant| RoleGrant { role: report.role.clone(), grant: grant.clone() })
    });
    own.chain(roles).collect()
}

/// The processes of which it is not known what they were granted: where others tell, those that tell nothing.
fn privileges_unknown(scenario: &Scenario, outcome: &Outcome) -> Vec<String> {
    if scenario.clock != crate::config::ClockKind::Realtime {
        return Vec::new();
    }
    let tells = |name: &str| outcome.reports.iter().any(|report| report.role == name && !report.grants.is_empty());
    let asked = outcome.reports.iter().any(|report| !report.grants.is_empty());
    let hosts = RoleId::all(scenario).into_iter().filter(|role| *role == role.host(scenario));
    let names = hosts.map(|role| role.name(scenario).to_owned());
    names.filter(|name| outcome.unbooked.contains(name) || asked && !tells(name)).collect()
}

/// Writes a run's files into `directory`, which exists: `scenario.toml`, `summary.json`, `hashes.txt`, `latency/`.
///
/// # Errors
/// Those of the file system, with the file's name.
pub fn write_run(directory: &Path, scenario: &Scenario, summary: &Summary) -> io::Result<()> {
    let run = summary.run.map(RunId::comment);
    write(&directory.join(SCENARIO), |out| out.write_all(scenario.to_file().as_bytes()))?;
    write(&directory.join(SUMMARY), |out| {
        serde_json::to_writer_pretty(&mut *out, summary)?;
        writeln!(out)
    })?;
    write(&directory.join(HASHES), |out| {
        let run = run.as_ref().map_or(String::new(), |run| format!("{run}: "));
        writeln!(out, "# {run}ticks from the first on, hash over everything published in them")?;
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
