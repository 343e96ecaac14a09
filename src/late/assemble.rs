//! The report of a run's late ticks, from the roles' records and the findings of the tracing process.

use super::counters;
use super::delay::Delay;
use super::findings::{Finding, Findings};
use super::model::{CauseTotal, LateKind, LateReport, LateTick, Pattern, SCHEMA, Source, TickOfRole};
use crate::runtime::RoleId;
use crate::scenario::Scenario;
use crate::telemetry::RoleReport;
use corotate_trace::{Cause, CauseKind, periods};
use std::collections::{BTreeMap, HashMap};

/// The least part of a delay that is reported as a cause, and the least unexplained part.
const LEAST_PART: f64 = 0.02;
const LEAST_UNKNOWN: f64 = 0.05;
/// The least part of a delay with which a cause counts as one of the tick's.
const COUNTED_PART: f64 = 0.1;
/// The longest chain of roles that is followed.
const CHAIN: usize = 16;

/// Returns the report of a run's late ticks; `None` if its roles kept no records. `note` is the reason for which there is no kernel trace.
pub fn report(
    scenario: &Scenario,
    reports: &[RoleReport],
    findings: Option<Findings>,
    note: Option<String>,
) -> Option<LateReport> {
    if !scenario.keeps_late_ticks() {
        return None;
    }
    let findings = findings.unwrap_or_default();
    let (cost, note) = (findings.cost, findings.note.or(note));
    let mut found: HashMap<(u64, usize), Finding> =
        findings.ticks.into_iter().map(|finding| ((finding.role, finding.index), finding)).collect();
    let mut ticks: Vec<(LateTick, Vec<Cause>)> = Vec::new();
    let mut traced: u64 = 0;
    for report in reports {
        let Some(role) = RoleId::named(scenario, &report.role) else { continue };
        for (index, record) in report.late_ticks.iter().enumerate() {
            let delay = Delay { role, record: *record, period_ns: scenario.period_ns };
            let finding = found.remove(&(role.number(), index));
            traced = traced.saturating_add(finding.as_ref().map_or(0, |_| record.missed.max(1)));
            ticks.push((
                late_tick(scenario, &delay, finding.as_ref()),
                finding.map_or_else(Vec::new, |finding| finding.input_causes),
            ));
        }
    }
    ticks.sort_by_key(|(late, _)| (late.tick, RoleId::named(scenario, &late.role).map(RoleId::number)));
    let ticks = link(ticks, scenario.actuation_delay_ticks);
    let first = reports.iter().flat_map(|report| &report.late_ticks).next();
    let epoch_ns = first.map_or(0, |late| late.due_ns.saturating_sub(late.tick * scenario.period_ns));
    let counted = reports.iter().map(|report| &report.ticks);
    let mut report = LateReport {
        schema: SCHEMA.to_owned(),
        run: scenario.run,
        scenario: scenario.name.clone(),
        epoch_ns,
        period_us: scenario.period_ns as f64 / 1e3,
        late_us: scenario.realtime.late_ns(scenario.period_ns) as f64 / 1e3,
        source: if cost.is_some() { Source::Kernel } else { Source::Counters },
        note,
        counted: counted
            .map(|ticks| ticks.missed - ticks.scripted.min(ticks.missed) + ticks.starved + ticks.late.unwrap_or(0))
            .sum(),
        examined: ticks.iter().fold(0, |sum, late| sum.saturating_add(late.ticks)),
        traced: Some(traced),
        ticks,
        causes: Vec::new(),
        patterns: Vec::new(),
        steal_ms: BTreeMap::new(),
        tracer: cost,
    };
    report.summarize();
    Some(report)
}

/// Returns a late tick with the causes of its own, and its late input as one of them.
pub(super) fn late_tick(scenario: &Scenario, delay: &Delay, found: Option<&Finding>) -> LateTick {
    let record = &delay.record;
    let (mut causes, slices) = match found {
        Some(finding) => (finding.causes.clone(), finding.slices.clone()),
        None => (counters::causes(delay), Vec::new()),
    };
    if let (Some(sender), input_ns @ 1..) = (delay.sender(), delay.input_ns()) {
        causes.push(Cause::new(CauseKind::Input, sender.name(scenario), input_ns));
    }
    LateTick {
        role: delay.role.name(scenario).to_owned(),
        tick: record.tick,
        ticks: record.missed.max(1),
        kind: delay.kind(),
        time_s: scenario.time_s(record.tick),
        late_us: delay.ns() as f64 / 1e3,
        causes,
        caused_by: delay.sender().map(|role| TickOfRole { role: role.name(scenario).to_owned(), tick: record.tick }),
        slices,
    }
}

/// Finds the late ticks that made others late, and completes the causes: what no cause explains is unknown. Each late tick comes with what
/// kept the sender of its input from sending, which counts if the sender has no late tick of its own.
fn link(mut ticks: Vec<(LateTick, Vec<Cause>)>, delay_ticks: u64) -> Vec<LateTick> {
    let mut known: HashMap<String, Vec<(u64, u64)>> = HashMap::new();
    for (late, _) in &ticks {
        known.entry(late.role.clone()).or_default().push((late.tick, late.tick + late.ticks));
    }
    let first_tick = |role: &str, tick: u64| {
        known.get(role)?.iter().find(|(from, to)| (*from..*to).contains(&tick)).map(|(from, _)| *from)
    };
    for (late, input_causes) in &mut ticks {
        let by = late.caused_by.take().and_then(|TickOfRole { role, tick }| {
            // A command acts some ticks after its own.
            let acts_later = late.kind == LateKind::Starved && role == "controller";
            let tick = first_tick(&role, tick.checked_sub(if acts_later { delay_ticks } else { 0 })?)?;
            Some(TickOfRole { role, tick })
        });
        if let (Some(TickOfRole { role, .. }), LateKind::Missed) = (&by, late.kind) {
            // The input of a missed tick never came, or too late.
            let rest_us = late.unexplained_us();
            late.causes.push(Cause { us: rest_us, ..Cause::new(CauseKind::Input, role, 0) });
        }
        if by.is_none() {
            replace_input(&mut late.causes, std::mem::take(input_causes));
        }
        late.complete_causes();
        late.caused_by = by.filter(|_| late.causes.iter().any(|cause| cause.kind == CauseKind::Input));
    }
    ticks.into_iter().map(|(late, _)| late).collect()
}

/// Replaces a late input, as far as they explain it, by what kept its sender.
pub(super) fn replace_input(causes: &mut Vec<Cause>, kept: Vec<Cause>) {
    let Some(input) = causes.iter_mut().find(|cause| cause.kind == CauseKind::Input) else { return };
    input.us -= kept.iter().map(|cause| cause.us).sum::<f64>().min(input.us);
    for cause in kept {
        match causes.iter_mut().find(|known| known.same(&cause)) {
            Some(known) => known.us += cause.us,
            None => causes.push(cause),
        }
    }
}

impl LateTick {
    /// Drops small causes, adds what no cause explains as unknown, and sorts the causes by their parts.
    pub(crate) fn complete_causes(&mut self) {
        self.causes.retain(|cause| cause.us >= LEAST_PART * self.late_us);
        let unknown_us = self.unexplained_us();
        if unknown_us > LEAST_UNKNOWN * self.late_us {
            self.causes.push(Cause { us: unknown_us, ..Cause::new(CauseKind::Unknown, "", 0) });
        }
        self.causes.sort_by(|a, b| b.us.total_cmp(&a.us));
    }
}

impl LateReport {
    /// Computes the totals by cause and the periods with which late ticks repeat.
    pub(crate) fn summarize(&mut self) {
        (self.causes, self.patterns) = (totals(self), patterns(self));
    }

    /// Returns the causes of a late tick, with late inputs replaced by the causes of their senders' late ticks.
    pub fn root_causes(&self, late: &LateTick) -> Vec<Cause> {
        self.roots(late, CHAIN)
    }

    fn roots(&self, late: &LateTick, chain: usize) -> Vec<Cause> {
        let mut roots = Vec::new();
        for cause in &late.causes {
            let by = late.caused_by.as_ref().filter(|_| cause.kind == CauseKind::Input && chain > 0);
            match by.and_then(|by| self.find(&by.role, by.tick)).filter(|sender| sender.late_us > 0.0) {
                Some(sender) => {
                    let part = (cause.us / sender.late_us).min(1.0);
                    roots.extend(
                        self.roots(sender, chain - 1).into_iter().map(|root| Cause { us: root.us * part, ..root }),
                    );
                }
                None => roots.push(cause.clone()),
            }
        }
        roots
    }
}

/// Returns the totals by cause, the largest sum first.
fn totals(report: &LateReport) -> Vec<CauseTotal> {
    let mut totals: Vec<CauseTotal> = Vec::new();
    for late in &report.ticks {
        let mut of_tick: Vec<Cause> = Vec::new();
        for root in report.root_causes(late) {
            match of_tick.iter_mut().find(|known| known.same(&root)) {
                Some(known) => known.us += root.us,
                None => of_tick.push(root),
            }
        }
        for cause in of_tick {
            let counts = cause.us >= COUNTED_PART * late.late_us;
            let index = totals.iter().position(|total| (total.kind, &total.name) == (cause.kind, &cause.name));
            let index = index.unwrap_or_else(|| {
                let (kind, name, words) = (cause.kind, cause.name.clone(), cause.to_string());
                totals.push(CauseTotal { cause: words, kind, name, ticks: 0, worst_us: 0.0, sum_us: 0.0 });
                totals.len() - 1
            });
            let total = &mut totals[index];
            total.ticks += u64::from(counts);
            total.worst_us = total.worst_us.max(cause.us);
            total.sum_us += cause.us;
        }
    }
    totals.retain(|total| total.ticks > 0);
    totals.sort_by(|a, b| b.sum_us.total_cmp(&a.sum_us));
    totals
}

/// Returns the periods of the late ticks that no other late tick caused, for each main cause. A core that was taken and a timer that came
/// late are one cause: both are seen if the hypervisor takes the core.
fn patterns(report: &LateReport) -> Vec<Pattern> {
    let mut due_ns: Vec<(String, Vec<u64>)> = Vec::new();
    for late in report.ticks.iter().filter(|late| late.caused_by.is_none()) {
        let Some(main) = late.causes.first() else { continue };
        let words = match main.kind {
            CauseKind::CoreTaken | CauseKind::LateTimer => "core taken, or timer late".to_owned(),
            _ => Cause { tid: None, priority: None, ..main.clone() }.to_string(),
        };
        let ns = (late.time_s * 1e9) as u64;
        match due_ns.iter_mut().find(|(known, _)| *known == words) {
            Some((_, times)) => times.push(ns),
            None => due_ns.push((words, vec![ns])),
        }
    }
    let period_ns = (report.period_us * 1e3) as u64;
    let found = due_ns.into_iter().flat_map(|(cause, due_ns)| {
        periods(&due_ns, period_ns).into_iter().map(move |period| Pattern {
            cause: cause.clone(),
            period_ms: period.period_ms,
            ticks: period.same_phase,
            compared: period.events,
            hint: (!period.hint.is_empty()).then(|| period.hint.to_owned()),
        })
    });
    found.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;
    use crate::telemetry::LateRecord;

    const MS: u64 = 1_000_000;

    fn scenario() -> Scenario {
        let (name, text) = SHIPPED[0];
        Scenario::parse(text, name, &["clock=realtime", "tick_hz=1000", "accept={}"].map(str::to_owned)).unwrap()
    }

    /// A record of a tick that ended `us` late.
    fn record(tick: u64, us: u64, sender: u64, input_us: u64) -> LateRecord {
        let due_ns = 7 * MS + tick * MS;
        let (input_ns, done_ns) = (due_ns + input_us * 1000, due_ns + us * 1000);
        LateRecord { tick, sender, due_ns, input_ns, began_ns: done_ns, done_ns, slept: true, ..LateRecord::default() }
    }

    fn of_roles(late: [(&str, Vec<LateRecord>); 3]) -> LateReport {
        let reports = late.map(|(role, late_ticks)| {
            let report: serde_json::Value = serde_json::json!({
                "role": role, "written": [], "read": [], "line": null, "late_ticks": late_ticks,
                "ticks": { "elapsed": 100, "executed": 100, "missed": 0, "late": late_ticks.len(), "first_disturbed": null },
            });
            serde_json::from_value(report).unwrap()
        });
        report(&scenario(), &reports, None, Some("no trace".to_owned())).unwrap()
    }

    #[test]
    fn a_late_input_leads_to_the_sender_and_its_cause() {
        let (leader, observer) = (RoleId::Plant(0).number(), RoleId::Observer(0).number());
        let report = of_roles([
            ("leader", vec![record(5, 800, 0, 0)]),
            ("observer", vec![record(5, 803, leader, 801)]),
            ("controller", vec![record(5, 810, observer, 804), record(9, 400, observer, 390)]),
        ]);
        assert_eq!((report.counted, report.examined, report.epoch_ns), (4, 4, 7 * MS));
        let late = report.find("controller", 5).unwrap();
        assert_eq!(late.caused_by, Some(TickOfRole { role: "observer".to_owned(), tick: 5 }));
        assert_eq!(
            (late.causes[0].kind, &*late.causes[0].name, late.causes[0].us),
            (CauseKind::Input, "observer", 804.0)
        );
        let roots = report.root_causes(late);
        assert!(roots.iter().all(|root| root.kind != CauseKind::Input), "{roots:?}");
        assert_eq!(roots[0].kind, CauseKind::LateTimer);
        let sum: f64 = roots.iter().map(|root| root.us).sum();
        assert!(sum <= late.late_us, "{roots:?}");
        // The observer was not late itself at tick 9, so the input stays the cause.
        let alone = report.find("controller", 9).unwrap();
        assert_eq!((alone.caused_by.clone(), alone.causes[0].kind), (None, CauseKind::Input));
        let total = report.causes.iter().find(|total| total.kind == CauseKind::LateTimer).unwrap();
        assert_eq!((total.ticks, total.worst_us), (3, 800.0));
    }

    #[test]
    fn a_starved_body_leads_to_the_tick_of_its_command() {
        let missed = LateRecord { missed: 3, ..record(4, 3200, RoleId::Observer(0).number(), 0) };
        let starved = LateRecord { starved: true, sender: RoleId::Controller.number(), ..record(6, 0, 0, 0) };
        let report = of_roles([("leader", vec![]), ("controller", vec![missed]), ("follower", vec![starved])]);
        let late = report.find("follower", 6).unwrap();
        assert_eq!((late.kind, late.late_us), (LateKind::Starved, 1000.0), "the command is at least a period late");
        assert_eq!(late.caused_by, Some(TickOfRole { role: "controller".to_owned(), tick: 4 }));
        assert_eq!(report.find("controller", 6).map(|late| (late.tick, late.ticks)), Some((4, 3)));
    }

    #[test]
    fn senders_that_blame_each_other_end_the_search() {
        let (leader, observer) = (RoleId::Plant(0).number(), RoleId::Observer(0).number());
        let report = of_roles([
            ("leader", vec![record(5, 800, observer, 790)]),
            ("observer", vec![record(5, 800, leader, 790)]),
            ("controller", vec![]),
        ]);
        let roots = report.root_causes(report.find("leader", 5).unwrap());
        assert!(roots.iter().map(|root| root.us).sum::<f64>() <= 800.0 && !roots.is_empty());
    }

    #[test]
    fn a_run_without_records_has_no_report() {
        let (name, text) = SHIPPED[0];
        for overrides in [["clock=lockstep", "accept={}"], ["clock=realtime", "realtime.trace=\"off\""]] {
            let scenario = Scenario::parse(text, name, &overrides.map(str::to_owned)).unwrap();
            assert!(report(&scenario, &[], None, None).is_none(), "{overrides:?}");
        }
    }
}
