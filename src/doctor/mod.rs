//! Checks whether this machine is fit for real time: kernel settings and limits, and the ticks of the scenario that it misses.
//!
//! | file | duty |
//! |---|---|
//! | `machine` | reads /proc, /sys and /dev below a root, and judges each value |
//! | `cores` | the same for the cores of the roles |
//! | `check` | one line of the report |
//! | `trial` | judges the roles' reports of a few seconds in real time |
//! | `hunt` | measures the lateness of wakes on each core, and finds the causes of late ones |
//! | `probe` | the thread on a core that wakes |
//! | `hunt_report` | options and result of a hunt |
//!
//! Must not change the machine, apart from the trace instance of a hunt, nor start the run, and must not fail: a value that the
//! system does not provide is unknown.

mod check;
mod cores;
mod hunt;
mod hunt_report;
mod machine;
mod probe;
mod trial;

pub use check::{Check, Verdict};
pub use hunt::hunt;
pub use hunt_report::{CoreLateness, HuntOptions, HuntReport};
pub use machine::{Demand, Machine};
pub use trial::Trial;

use crate::bus::domain::{AbandonedFiles, DomainError, FoundDomain};
use crate::runtime::{priority_remedy, refused_priority};
use crate::telemetry::MachineInfo;
use corotate_trace::{TraceError, require_tracefs};
use serde::Serialize;
use std::fmt;
use std::path::Path;

/// Layout version of the report.
const SCHEMA: &str = "corotate/doctor/v1";
/// The width of the column of names.
const NAME_WIDTH: usize = 20;

/// The whole report.
#[derive(Debug, Clone, Serialize)]
pub struct Diagnosis {
    schema: &'static str,
    host: MachineInfo,
    /// The scenario whose demands the machine must meet.
    pub scenario: String,
    /// True if the scenario was run and no line is bad; `None` if no line is bad and it was not run.
    pub fit: Option<bool>,
    /// The lines.
    pub checks: Vec<Check>,
    /// The result of the run, if there was one.
    pub trial: Option<Trial>,
}

impl Diagnosis {
    /// Creates a report.
    pub fn new(scenario: &str, mut checks: Vec<Check>, trial: Option<Trial>) -> Self {
        checks.extend(trial.iter().map(Trial::check));
        let bad = checks.iter().any(|check| check.verdict == Verdict::Bad);
        let fit = if bad { Some(false) } else { trial.as_ref().map(|_| true) };
        Self { schema: SCHEMA, host: MachineInfo::local(), scenario: scenario.to_owned(), fit, checks, trial }
    }

    /// Returns the report as one line of JSON.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("a report of plain values is JSON") + "\n"
    }
}

/// Writes one line per check, with its remedy below it.
impl fmt::Display for Diagnosis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}, {}", self.host.cpu, self.host.kernel)?;
        for Check { name, found, verdict, remedy } in &self.checks {
            writeln!(f, "{:<5} {name:<NAME_WIDTH$} {found}", verdict.name())?;
            if let Some(remedy) = remedy {
                writeln!(f, "{:<5} {:<NAME_WIDTH$}   {remedy}", "", "")?;
            }
        }
        let count = |verdict| self.checks.iter().filter(|check| check.verdict == verdict).count();
        let (bad, warn) = (count(Verdict::Bad), count(Verdict::Warn));
        let measured = self.trial.as_ref().map_or("not measured".to_owned(), Trial::words);
        let scenario = &self.scenario;
        match self.fit {
            Some(true) => writeln!(f, "fit for {scenario} in real time: {measured}; {warn} to improve"),
            Some(false) => {
                writeln!(f, "not fit for {scenario} in real time: {measured}; {bad} bad, {warn} to improve")
            }
            None => writeln!(f, "not measured for {scenario} in real time; {warn} to improve"),
        }
    }
}

/// Returns the line on domains whose launcher was killed, or on a run directory in which other users can write.
pub fn leftovers(domains: Result<Vec<FoundDomain>, DomainError>) -> Check {
    let name = "leftover domains";
    let domains = match domains {
        Ok(domains) => domains,
        Err(error) => {
            let text = error.to_string();
            let (problem, remedy) = text.split_once("; ").unwrap_or((&text, "remove it"));
            return Check::bad("run directory", problem, remedy);
        }
    };
    let dead: Vec<&FoundDomain> = domains.iter().filter(|found| !found.alive).collect();
    let running = domains.len() - dead.len();
    match dead.first() {
        None => Check::ok(name, format!("none ({running} running)")),
        Some(first) => Check::warn(
            name,
            format!("{} of dead runs, as {} ({running} running)", dead.len(), first.root.display()),
            "`corotate doctor --clean` removes them; so does the next run",
        ),
    }
}

/// Returns the line on the kernel's trace, from which the causes of late ticks are named.
pub fn kernel_trace() -> Check {
    judge_trace(require_tracefs())
}

fn judge_trace(available: Result<(), TraceError>) -> Check {
    let name = "kernel trace";
    let Err(error) = available else { return Check::ok(name, "available: causes of late ticks get their names") };
    let text = error.to_string();
    let text = text.strip_prefix("no kernel trace: ").unwrap_or(&text);
    let (problem, remedy) = text.split_once("; ").unwrap_or((text, "run as root"));
    Check::warn(name, format!("{problem}: causes of late ticks have no names"), remedy)
}

/// Returns the line on leftovers of dead runs in shared memory; `None` without leftovers.
pub fn left_in_shared_memory(left: AbandonedFiles) -> Option<Check> {
    let AbandonedFiles { runs, files, bytes } = left;
    let found = format!(
        "{files} files ({:.1} MiB) of {runs} dead runs whose directory is gone",
        bytes as f64 / f64::from(1 << 20)
    );
    let remedy = "`corotate doctor --clean` removes them";
    (runs > 0).then(|| Check::warn("leftover memory", found, remedy))
}

/// Returns the line on a real-time priority that the limits allow and the kernel refuses; `None` if it is granted.
pub fn refused(priority: i32) -> Option<Check> {
    let error = (priority > 0).then(|| refused_priority(priority)).flatten()?;
    Some(Check::bad("SCHED_FIFO", format!("{priority} is refused: {error}"), priority_remedy(Path::new("/"))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_bad_line_makes_the_machine_unfit_and_remedies_are_listed() {
        let warned = vec![Check::ok("a", "1"), Check::warn("b", "2", "mend b")];
        let unmeasured = Diagnosis::new("test", warned.clone(), None);
        assert!(unmeasured.fit.is_none(), "what did not run is not fit");
        assert!(unmeasured.to_string().ends_with("not measured for test in real time; 1 to improve\n"), "{unmeasured}");
        let fit = Diagnosis::new("test", warned.clone(), Some(Trial::new(5000.0, 15_001, &[], &[])));
        let last = "fit for test in real time: 0 of 15001 ticks would be missed in 3 s at 5000 Hz; 1 to improve\n";
        assert!(fit.fit == Some(true) && fit.to_string().ends_with(last), "{fit}");
        let checks = [warned, vec![Check::bad("c", "3", "mend c")]].concat();
        let unfit = Diagnosis::new("test", checks, None);
        assert!(unfit.fit == Some(false) && unfit.to_string().contains("mend c"));
        let json: serde_json::Value = serde_json::from_str(&unfit.to_json()).unwrap();
        assert_eq!((json["fit"].as_bool(), json["checks"][2]["verdict"].as_str()), (Some(false), Some("bad")));
        assert_eq!(json["checks"][1]["remedy"], "mend b");
    }

    #[test]
    fn a_missing_trace_is_a_warning_with_the_remedy() {
        assert_eq!(judge_trace(Ok(())).verdict, Verdict::Ok);
        let check = judge_trace(Err(TraceError::NotMounted));
        assert!(check.verdict == Verdict::Warn && check.found.starts_with("tracefs is not mounted"), "{check:?}");
        assert!(check.remedy.unwrap().starts_with("as root, run `mount"));
        let source = std::io::ErrorKind::PermissionDenied.into();
        let check = judge_trace(Err(TraceError::NotPermitted { path: "/sys/kernel/tracing/instances".into(), source }));
        assert!(check.found.contains("/instances") && check.remedy.unwrap().contains("chown"));
    }

    #[test]
    fn leftovers_of_dead_runs_are_a_warning_and_live_runs_are_not() {
        let found = |alive| FoundDomain { root: "/run/corotate/00000000".into(), alive, made: None };
        assert_eq!(leftovers(Ok(vec![found(true)])).verdict, Verdict::Ok);
        let check = leftovers(Ok(vec![found(true), found(false)]));
        assert!(check.verdict == Verdict::Warn && check.found.starts_with("1 of dead runs"), "{check:?}");
    }
}
