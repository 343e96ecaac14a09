//! The outcome of a run: the roles' reports, the counters computed from them, state hash, latencies.
//!
//! Must not hide anything: a missing measurement is reported as missing, and counters that do not balance are a failure.

use super::incident::Incident;
use super::remains::Remains;
use crate::config::ClockKind;
use crate::hosts::{HostStatistics, NetworkStatistics};
use crate::late::LateReport;
use crate::record::RecordingReport;
use crate::runtime::{RoleId, ports};
use crate::scenario::Scenario;
use crate::score::Score;
use crate::telemetry::{Checkpoints, Grant, Latency, LinkRead, LinkWritten, Percentiles, RoleReport, Ticks, combine};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// The outcome of a run in memory.
#[derive(Debug)]
pub struct Outcome {
    /// The roles' reports, in the order of a tick.
    pub reports: Vec<RoleReport>,
    /// External roles that keep no counters.
    pub unbooked: Vec<String>,
    /// Defects of the reports.
    pub problems: Vec<String>,
    /// The score.
    pub score: Score,
    /// Roles that failed while the ticks ran.
    pub incidents: Vec<Incident>,
    /// The hosts' reports, if there are several hosts.
    pub hosts: Vec<HostStatistics>,
    /// The launcher's own privileges.
    pub grants: Vec<Grant>,
    /// The recording, if there is one.
    pub recording: Option<RecordingReport>,
    /// The late ticks with their causes, in real time.
    pub late: Option<LateReport>,
    /// The domain that was used, if there was one.
    pub domain: Option<PathBuf>,
    /// The signal that ended the run early, or 0.
    pub signal: usize,
    /// The files that the processes of the run left; dropping this removes them.
    #[expect(dead_code, reason = "held for its destructor")]
    pub(super) remains: Option<Remains>,
}

impl Outcome {
    /// Creates the outcome of a run in one thread without incidents: it has no processes and no files.
    pub(super) fn in_one_thread(reports: Vec<RoleReport>, score: Score) -> Self {
        Self {
            reports,
            unbooked: Vec::new(),
            problems: Vec::new(),
            score,
            incidents: Vec::new(),
            hosts: Vec::new(),
            grants: Vec::new(),
            recording: None,
            late: None,
            domain: None,
            signal: 0,
            remains: None,
        }
    }
}

/// The counters of a run.
#[derive(Debug, Serialize, Deserialize)]
pub struct Accounting {
    /// True if they balance.
    pub balanced: bool,
    /// The imbalances.
    pub problems: Vec<String>,
    /// External roles without counters: their ticks, and the links that they write and read, are unknown.
    pub unbooked: Vec<String>,
    /// Per role.
    pub roles: BTreeMap<String, Ticks>,
    /// Per reading end.
    pub links: Vec<LinkCounters>,
    /// Per external role without counters: ticks for which its readers had no sample.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub absent_ticks: BTreeMap<String, u64>,
    /// Ticks missed or starved, all roles together.
    pub missed_ticks: u64,
    /// Samples received and rejected, all links together.
    pub rejected_samples: u64,
    /// Samples received and rejected, by reason.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub rejected_by: BTreeMap<String, u64>,
    /// Samples that scripted faults changed, and stalls.
    pub injected_faults: u64,
}

/// The counters of a link: its reading end, and its writing end if the writer keeps counters.
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
    /// Ticks for which the writer sent no sample.
    pub skipped: Option<u64>,
    /// Ticks for which the reader received no sample, up to its last one.
    pub gaps: u64,
    /// Sent after the reader's last look.
    pub unread: Option<u64>,
    /// No-sample markers sent, and received.
    pub void: (Option<u64>, u64),
    /// Samples that were not newer than the one before.
    pub stale: u64,
    /// Samples received and rejected.
    pub rejected: u64,
    /// Samples received and rejected, by reason.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub rejected_by: BTreeMap<String, u64>,
    /// Samples that scripted faults changed at the writing end.
    pub injected: Option<u64>,
}

/// The state hash of a run, comparable between clocks.
#[derive(Debug, Serialize, Deserialize)]
pub struct State {
    /// The hash over all published samples.
    pub hash: String,
    /// Number of ticks that every role with counters executed or missed.
    pub elapsed_ticks: u64,
    /// The first tick whose samples may differ from an undisturbed run's, if any.
    pub first_disturbed_tick: Option<u64>,
    /// Number of ticks from the first on that `clean_hash` covers: all undisturbed ones, up to the last checkpoint among them.
    /// Runs of more than 16 384 ticks have a checkpoint at every 2nd, 3rd, … tick.
    pub clean_ticks: u64,
    /// The hash over those ticks.
    pub clean_hash: String,
    #[serde(skip)]
    pub(super) checkpoints: Vec<(u64, u64)>,
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
    pub(super) latency: Latency,
}

impl State {
    /// Describes the part of the run that the hash covers, if no tick is known to be disturbed.
    pub(crate) fn undisturbed_words(elapsed_ticks: u64, all_ticks: u64, unbooked: bool) -> String {
        match (elapsed_ticks < all_ticks, unbooked) {
            (true, _) => format!("the run ended after {elapsed_ticks} of {all_ticks} ticks"),
            (false, true) => "every tick of the roles with counters undisturbed".to_owned(),
            (false, false) => "every tick undisturbed".to_owned(),
        }
    }
}

/// Returns the state hash of a run.
pub(crate) fn state_hash(reports: &[RoleReport]) -> String {
    format!("{:016x}", combine(hashes(reports).iter().map(|(_, hash)| hash.last)))
}

/// Returns the hashes of all signals, in the order of their names.
fn hashes(reports: &[RoleReport]) -> Vec<(&String, &Checkpoints)> {
    let written = reports.iter().flat_map(|report| &report.written);
    let mut links: Vec<_> = written.filter_map(|link| Some((&link.service, link.hash.as_ref()?))).collect();
    links.sort_by_key(|(service, _)| *service);
    links
}

impl Accounting {
    pub(super) fn new(scenario: &Scenario, outcome: &Outcome, interrupted: bool, lost: &[&str]) -> Self {
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
                problems.push(format!("{}: published and skipped samples do not add up", link.service));
            }
        }
        if !interrupted {
            problems.extend(NetworkStatistics::merge(&outcome.hosts).iter().flat_map(NetworkStatistics::problems));
        }
        let mut links = Vec::new();
        for (report, read) in reports.iter().flat_map(|report| report.read.iter().map(move |read| (report, read))) {
            let written = written.iter().find(|(_, written)| written.service == read.service);
            // A role that died may have sent a sample that it did not count: its reader counted it.
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
            // A reader may not have read the last sample, nor commands that act after the end.
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

/// Returns the reading ends of a role's signals.
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
            let writer = written.map_or("its writer has no counters".to_owned(), |written| {
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
    pub(super) fn new(reports: &[RoleReport], books: &Accounting) -> Self {
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
        // The end is seldom a multiple of the stride. The hash covers it only if all signals reached it.
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

/// Returns the outages of failed roles, and the recovery times of the loop, by role.
pub(super) fn incident_figures(incidents: &[Incident]) -> Vec<StageFigures> {
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

/// The figures of every stage of the roles.
pub(super) fn latencies(scenario: &Scenario, reports: &[RoleReport]) -> Vec<StageFigures> {
    let figures = |report: &RoleReport, stage: &crate::telemetry::StageReport| {
        let (latency, role, stage) = (stage.latency(), report.role.clone(), stage.stage.clone());
        let figures = latency.percentiles();
        // An age begins at the first body or at that of an observer, a hop at the sender of the input; other stages use one clock.
        let sender = match RoleId::named(scenario, &role) {
            Some(RoleId::Controller) if stage == "hop" => RoleId::Observer(0),
            Some(RoleId::Observer(index)) => RoleId::Plant(index),
            _ => RoleId::Plant(0),
        };
        let stamps_of = (!figures.are_shown()).then(|| sender.name(scenario).to_owned());
        StageFigures { role, stage, stamps_of, figures, latency }
    };
    reports.iter().flat_map(|report| report.stages.iter().map(move |stage| figures(report, stage))).collect()
}
