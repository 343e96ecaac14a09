//! Is this machine fit for real time? What the kernel and its limits say, and how many ticks of the scenario it misses.
//!
//! | file | duty |
//! |---|---|
//! | `machine` | reads /proc, /sys and /dev below a root, and judges each line |
//! | `trial` | judges what the roles of the scenario reported of some seconds in real time |
//!
//! Must not change the machine, nor start the run, and must not fail: what the system does not tell is said to be unknown.

mod machine;
mod trial;

pub use machine::{Demand, Machine};
pub use trial::Trial;

use crate::bus::domain::{AbandonedFiles, DomainError, FoundDomain};
use crate::runtime::{priority_remedy, refused_priority};
use crate::telemetry::MachineInfo;
use serde::Serialize;
use std::fmt;
use std::path::Path;

/// Layout version of the report.
const SCHEMA: &str = "corotate/doctor/v1";
/// How wide the column of names is.
const NAME_WIDTH: usize = 20;

/// What a line of the report comes to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// As it should be.
    Ok,
    /// It works, and something is to be gained, or is not known.
    Warn,
    /// Deadlines will be missed for it.
    Bad,
}

impl Verdict {
    /// Its word.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Warn => "warn",
            Self::Bad => "bad",
        }
    }
}

/// One line of the report.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Check {
    /// What was looked at.
    pub name: &'static str,
    /// What was found.
    pub found: String,
    /// What it comes to.
    pub verdict: Verdict,
    /// What to do about it; none where all is well.
    pub remedy: Option<String>,
}

impl Check {
    fn ok(name: &'static str, found: impl Into<String>) -> Self {
        Self { name, found: found.into(), verdict: Verdict::Ok, remedy: None }
    }

    fn warn(name: &'static str, found: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { name, found: found.into(), verdict: Verdict::Warn, remedy: Some(remedy.into()) }
    }

    fn bad(name: &'static str, found: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { name, found: found.into(), verdict: Verdict::Bad, remedy: Some(remedy.into()) }
    }
}

/// The whole report.
#[derive(Debug, Clone, Serialize)]
pub struct Diagnosis {
    schema: &'static str,
    host: MachineInfo,
    /// The scenario whose demands the machine is held to.
    pub scenario: String,
    /// True if the scenario was run and no line is bad; none if no line is bad and it was not run.
    pub fit: Option<bool>,
    /// The lines.
    pub checks: Vec<Check>,
    /// The result of the run, if there was one.
    pub trial: Option<Trial>,
}

impl Diagnosis {
    /// Puts a report together.
    pub fn new(scenario: &str, mut checks: Vec<Check>, trial: Option<Trial>) -> Self {
        checks.extend(trial.iter().map(Trial::check));
        let bad = checks.iter().any(|check| check.verdict == Verdict::Bad);
        let fit = if bad { Some(false) } else { trial.as_ref().map(|_| true) };
        Self { schema: SCHEMA, host: MachineInfo::local(), scenario: scenario.to_owned(), fit, checks, trial }
    }

    /// The report as one line of JSON.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("a report of plain values is JSON") + "\n"
    }
}

/// For people: one line per check, and what to do below it.
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

/// What is left of runs whose launcher was killed. Where others can write, nobody knows whose it is.
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

/// Returns the line on leftovers of dead runs in shared memory; none if there are none.
pub fn left_in_shared_memory(left: AbandonedFiles) -> Option<Check> {
    let AbandonedFiles { runs, files, bytes } = left;
    let found = format!(
        "{files} files ({:.1} MiB) of {runs} dead runs whose directory is gone",
        bytes as f64 / f64::from(1 << 20)
    );
    let remedy = "`corotate doctor --clean` removes them";
    (runs > 0).then(|| Check::warn("leftover memory", found, remedy))
}

/// Returns the line on a real-time priority that the limits allow and the kernel refuses; none if it is granted.
pub fn refused(priority: i32) -> Option<Check> {
    let error = (priority > 0).then(|| refused_priority(priority)).flatten()?;
    Some(Check::bad("SCHED_FIFO", format!("{priority} is refused: {error}"), priority_remedy(Path::new("/"))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_bad_line_is_enough_and_every_other_line_says_what_to_do() {
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
    fn the_dead_are_told_and_the_living_are_not_blamed() {
        let found = |alive| FoundDomain { root: "/run/corotate/00000000".into(), alive, made: None };
        assert_eq!(leftovers(Ok(vec![found(true)])).verdict, Verdict::Ok);
        let check = leftovers(Ok(vec![found(true), found(false)]));
        assert!(check.verdict == Verdict::Warn && check.found.starts_with("1 of dead runs"), "{check:?}");
    }
}
