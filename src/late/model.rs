//! Late ticks of a run and their causes, as `late.json` has them.
//!
//! Must not name a cause that was not observed.

use crate::config::RunId;
use corotate_trace::{Cause, CauseKind};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashSet};

/// Layout version of `late.json`.
pub const SCHEMA: &str = "corotate/late/v1";
/// The largest number of ticks in a chain of causes.
const CHAIN: usize = 64;

/// The source of the causes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::IntoStaticStr, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum Source {
    /// Counters of the roles' threads: they tell the kind of a cause.
    Counters,
    /// The kernel's trace: it also tells the name.
    Kernel,
}

/// The late ticks of a run.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct LateReport {
    /// The layout version.
    pub schema: String,
    /// The run.
    pub run: Option<RunId>,
    /// The scenario's name.
    pub scenario: String,
    /// The due time of the first tick on the monotonic clock of the launching host, ns; 0 if it is unknown.
    #[serde(default)]
    pub epoch_ns: u64,
    /// The period, µs.
    pub period_us: f64,
    /// The limit beyond which an executed tick is late, µs.
    pub late_us: f64,
    /// The source of the causes.
    pub source: Source,
    /// The reason why there is no better source, with the remedy.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
    /// The number of late, missed and starved ticks that the roles counted.
    pub counted: u64,
    /// The number of examined ones. Fewer than counted if there were more than the roles keep.
    pub examined: u64,
    /// The number of those whose causes are from the kernel's trace; where it lacks events or time was short, they are from counters.
    /// `None` in files of 0.1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub traced: Option<u64>,
    /// The examined ones, in the order of time; in `summary.json` the worst ten, in a recording the worst thousand.
    pub ticks: Vec<LateTick>,
    /// Totals by cause, the largest sum first.
    pub causes: Vec<CauseTotal>,
    /// Periods with which late ticks repeat.
    pub patterns: Vec<Pattern>,
    /// Per core the time for which the hypervisor had it although it was needed, by the kernel's counters, ms; 0 is left out.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub steal_ms: BTreeMap<usize, f64>,
    /// The costs of the tracing process, if one ran.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tracer: Option<TracerCost>,
}

/// The kind of a late tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::IntoStaticStr, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum LateKind {
    /// Executed with all inputs, beyond the limit.
    Late,
    /// Not executed.
    Missed,
    /// Executed without a due input.
    Starved,
}

/// A late tick, or several missed ones in a row, of one role.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LateTick {
    /// The role.
    pub role: String,
    /// The tick; the first one of several.
    pub tick: u64,
    /// The number of ticks.
    pub ticks: u64,
    /// The kind.
    pub kind: LateKind,
    /// The due time of the tick, s after the first tick.
    pub time_s: f64,
    /// The delay from the due time to the sample, or of a missed tick to the next look at the clock, µs.
    pub late_us: f64,
    /// The causes, the largest part first.
    pub causes: Vec<Cause>,
    /// The tick of another role that made this one late, if its late tick was examined too.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub caused_by: Option<TickOfRole>,
    /// The cores around the tick, for the worst ticks of a run with the kernel's trace.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub slices: Vec<Slice>,
}

/// A tick of a role.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TickOfRole {
    /// The role.
    pub role: String,
    /// The tick.
    pub tick: u64,
}

/// The kind of a slice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::IntoStaticStr, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum SliceKind {
    /// A role of the run.
    Role,
    /// Another task.
    Task,
    /// The handler of an interrupt.
    Interrupt,
    /// A softirq.
    Softirq,
    /// The idle task.
    Idle,
}

/// An interval in which one task or handler ran on a core.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Slice {
    /// The core.
    pub core: usize,
    /// The kind.
    pub kind: SliceKind,
    /// The name of the role, task, interrupt or softirq.
    pub name: String,
    /// Begin, relative to the due time of the tick, µs.
    pub from_us: f64,
    /// End, relative to the due time of the tick, µs.
    pub to_us: f64,
}

/// All late ticks with the same main cause.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CauseTotal {
    /// The cause in words.
    pub cause: String,
    /// The kind.
    pub kind: CauseKind,
    /// The name of the task, interrupt, softirq or role.
    pub name: String,
    /// The number of late ticks to which it contributed.
    pub ticks: u64,
    /// Its largest part in one of them, µs.
    pub worst_us: f64,
    /// The sum of its parts, µs.
    pub sum_us: f64,
}

/// Late ticks of one cause that repeat with a period.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Pattern {
    /// The cause in words.
    pub cause: String,
    /// The period, ms.
    pub period_ms: f64,
    /// The number of late ticks at the same phase.
    pub ticks: u64,
    /// The number of late ticks that were compared.
    pub compared: u64,
    /// A frequent reason for this period, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hint: Option<String>,
}

/// The costs of the tracing process.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TracerCost {
    /// Its processor time, s.
    pub cpu_s: f64,
    /// The number of decoded events.
    pub events: u64,
    /// The number of times at which the kernel's ring was full, so that events are missing.
    pub overruns: u64,
}

/// The ticks that follow from each other, and the point at which they end.
#[derive(Debug, Clone, PartialEq)]
pub struct Chain<'a> {
    /// The late tick, then the late tick that caused it, down to the first one.
    pub ticks: Vec<&'a LateTick>,
    /// The next tick, if it cannot be followed: it was not examined, or it is in the chain already.
    pub open: Option<&'a TickOfRole>,
}

impl LateReport {
    /// Reads a report.
    ///
    /// # Errors
    /// The reason, if the bytes are not a report of this version.
    pub fn parse(bytes: &[u8]) -> Result<Self, String> {
        #[derive(Deserialize)]
        struct Head {
            schema: String,
        }
        let head: Head = serde_json::from_slice(bytes).map_err(|error| error.to_string())?;
        if head.schema != SCHEMA {
            return Err(format!("its layout is {}, and this version reads {SCHEMA}", head.schema));
        }
        serde_json::from_slice(bytes).map_err(|error| error.to_string())
    }

    /// Returns the report with the worst ticks only, without their timelines.
    #[must_use]
    pub fn worst(&self, count: usize) -> Self {
        let short = |late: &&LateTick| LateTick { slices: Vec::new(), ..(*late).clone() };
        Self { ticks: self.worst_first().iter().take(count).map(short).collect(), ..self.clone() }
    }

    /// Returns the report with at most `count` ticks, the worst ones, in the order of time; the worst `timelines` keep theirs.
    #[must_use]
    pub fn limited(&self, count: usize, timelines: usize) -> Self {
        let mut indices: Vec<usize> = (0..self.ticks.len()).collect();
        indices.sort_by(|a, b| self.ticks[*b].late_us.total_cmp(&self.ticks[*a].late_us));
        let mut worst: Vec<(usize, LateTick)> =
            indices.into_iter().take(count).map(|index| (index, self.ticks[index].clone())).collect();
        worst.iter_mut().skip(timelines).for_each(|(_, late)| late.slices.clear());
        worst.sort_by_key(|(index, _)| *index);
        Self { ticks: worst.into_iter().map(|(_, late)| late).collect(), ..self.clone() }
    }

    /// Returns the number of examined ticks that are not in `ticks`.
    pub fn left_out(&self) -> u64 {
        self.examined.saturating_sub(self.ticks.iter().fold(0, |sum, late| sum.saturating_add(late.ticks)))
    }

    /// Returns the examined ticks, the longest delay first.
    pub fn worst_first(&self) -> Vec<&LateTick> {
        self.select(None, None)
    }

    /// Returns the examined ticks of a role that cover `tick`, the longest delay first. `None` selects all.
    pub fn select(&self, tick: Option<u64>, role: Option<&str>) -> Vec<&LateTick> {
        let wanted =
            |late: &&LateTick| tick.is_none_or(|tick| late.covers(tick)) && role.is_none_or(|role| late.role == role);
        let mut ticks: Vec<&LateTick> = self.ticks.iter().filter(wanted).collect();
        ticks.sort_by(|a, b| b.late_us.total_cmp(&a.late_us));
        ticks
    }

    /// Returns the late tick of a role that covers `tick`, if it was examined.
    pub fn find(&self, role: &str, tick: u64) -> Option<&LateTick> {
        self.ticks.iter().find(|late| late.role == role && late.covers(tick))
    }

    /// Returns at most `count` of the given ticks, without those in the chain of an earlier one, and the number of ticks left out for
    /// `count` alone.
    pub fn heads<'a>(&'a self, ticks: &[&'a LateTick], count: usize) -> (Vec<&'a LateTick>, usize) {
        let (mut heads, mut seen) = (Vec::new(), HashSet::new());
        for late in ticks {
            if heads.len() < count && !seen.contains(&std::ptr::from_ref(*late)) {
                heads.push(*late);
                seen.extend(self.chain(late).ticks.into_iter().map(std::ptr::from_ref));
            }
        }
        let left = ticks.iter().filter(|late| !seen.contains(&std::ptr::from_ref(**late))).count();
        (heads, left)
    }

    /// Returns the cause that explains most of the first late tick of a chain; `None` if most of it is unknown.
    pub fn first_cause<'a>(&'a self, late: &'a LateTick) -> Option<&'a Cause> {
        self.chain(late).ticks.last()?.main_cause()
    }

    /// Follows a late tick to the late ticks of other roles that caused it.
    pub fn chain<'a>(&'a self, late: &'a LateTick) -> Chain<'a> {
        let mut chain = Chain { ticks: vec![late], open: late.caused_by.as_ref() };
        while let Some(next) = chain.open.filter(|_| chain.ticks.len() < CHAIN) {
            match self.find(&next.role, next.tick) {
                Some(cause) if !chain.ticks.iter().any(|known| std::ptr::eq(*known, cause)) => {
                    chain.ticks.push(cause);
                    chain.open = cause.caused_by.as_ref();
                }
                _ => break,
            }
        }
        chain
    }
}

impl LateTick {
    /// Returns true if `tick` is one of these ticks.
    pub fn covers(&self, tick: u64) -> bool {
        tick.checked_sub(self.tick).is_some_and(|after| after < self.ticks)
    }

    /// Returns the part of the delay that no cause explains, µs.
    pub fn unexplained_us(&self) -> f64 {
        (self.late_us - self.causes.iter().map(|cause| cause.us).sum::<f64>()).max(0.0)
    }

    /// Returns the part of the delay whose cause is unknown, µs: causes of that kind and what no cause explains.
    pub fn unknown_us(&self) -> f64 {
        (self.late_us - self.known_causes().map(|cause| cause.us).sum::<f64>()).max(0.0)
    }

    /// Returns the causes that have a name, the largest part first.
    pub fn known_causes(&self) -> impl Iterator<Item = &Cause> {
        self.causes.iter().filter(|cause| cause.kind != CauseKind::Unknown)
    }

    /// Returns the cause that explains most of the delay; `None` if most of it is unknown.
    pub fn main_cause(&self) -> Option<&Cause> {
        let largest = self.known_causes().max_by(|a, b| a.us.total_cmp(&b.us))?;
        (largest.us >= self.unknown_us()).then_some(largest)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::late::fixture;

    #[test]
    fn a_written_report_is_read_back_and_others_are_refused() {
        let report = fixture::report();
        let text = serde_json::to_string(&report).unwrap();
        let read = LateReport::parse(text.as_bytes()).unwrap();
        assert_eq!((&read.ticks, &read.causes, &read.patterns), (&report.ticks, &report.causes, &report.patterns));
        assert!(LateReport::parse(text.replacen("late/v1", "late/v9", 1).as_bytes()).unwrap_err().contains("late/v9"));
        for end in (0..text.len()).step_by(997) {
            assert!(LateReport::parse(&text.as_bytes()[..end]).is_err(), "{end}");
        }
        for bytes in [&b"\xff\xfe"[..], b"[]", b"{\"schema\": 1}", b"{\"schema\": \"corotate/late/v1\"}"] {
            assert!(LateReport::parse(bytes).is_err());
        }
    }

    #[test]
    fn a_limited_report_has_the_worst_ticks_and_the_same_totals() {
        let report = fixture::report();
        let worst = report.limited(20, 3);
        let least_us = worst.ticks.iter().map(|late| late.late_us).fold(f64::INFINITY, f64::min);
        assert_eq!(worst.ticks.len(), 20);
        assert_eq!(report.ticks.iter().filter(|late| late.late_us > least_us).count(), 19);
        assert!(worst.ticks.is_sorted_by_key(|late| late.tick));
        assert_eq!(worst.ticks.iter().filter(|late| !late.slices.is_empty()).count(), 3);
        assert_eq!((worst.counted, worst.examined, &worst.causes), (report.counted, report.examined, &report.causes));
        let kept: u64 = worst.ticks.iter().map(|late| late.ticks).sum();
        assert_eq!((worst.left_out(), report.left_out()), (report.examined - kept, 0));
        assert!(report.limited(1000, 10).ticks == report.ticks, "enough room for all");
    }

    #[test]
    fn a_chain_ends_at_the_first_late_tick() {
        let report = fixture::report();
        let chain = report.chain(report.find("controller", 755).unwrap());
        let roles: Vec<&str> = chain.ticks.iter().map(|late| late.role.as_str()).collect();
        assert_eq!((roles, chain.open), (vec!["controller", "observer", "leader"], None));
    }

    #[test]
    fn a_chain_without_end_is_cut() {
        let mut report = fixture::report();
        let tick_of = |role: &str, tick| Some(TickOfRole { role: role.to_owned(), tick });
        let ticks = &mut report.ticks;
        ticks.iter_mut().find(|late| late.role == "leader" && late.tick == 755).unwrap().caused_by =
            tick_of("controller", 755);
        let chain = report.chain(report.find("observer", 755).unwrap());
        assert_eq!((chain.ticks.len(), chain.open), (3, tick_of("observer", 755).as_ref()));
        let mut long = fixture::report();
        long.ticks = (0..200)
            .map(|tick| LateTick { caused_by: tick_of("a", tick + 1), ..fixture::late("a", tick, 1.0, vec![]) })
            .collect();
        assert_eq!(long.chain(&long.ticks[0]).ticks.len(), CHAIN);
        // The last one was not examined.
        let chain = long.chain(&long.ticks[190]);
        assert_eq!((chain.ticks.len(), chain.open), (10, tick_of("a", 200).as_ref()));
    }

    #[test]
    fn a_tick_in_an_earlier_chain_is_no_head() {
        let report = fixture::report();
        let ticks = report.select(Some(755), None);
        let (heads, left) = report.heads(&ticks, 10);
        assert_eq!((heads.len(), heads[0].role.as_str(), left), (1, "controller", 0));
        assert_eq!(report.first_cause(heads[0]).unwrap().kind, CauseKind::CoreTaken);
        // 12 and 9 chains of three, and ten single ticks.
        let (heads, left) = report.heads(&report.worst_first(), 5);
        assert_eq!((heads.len(), heads[0].late_us, report.ticks.len()), (5, 12_400.0, 73));
        assert_eq!(left, 73 - 3 - 2 * 3);
        assert_eq!(report.heads(&report.worst_first(), usize::MAX).0.len(), 12 + 9 + 10);
    }

    #[test]
    fn the_selected_ticks_cover_the_tick_and_have_the_role() {
        let mut report = fixture::report();
        let all = report.select(None, None);
        assert!(all.len() == report.ticks.len() && all.windows(2).all(|pair| pair[0].late_us >= pair[1].late_us));
        assert_eq!(report.select(Some(755), None).len(), 3);
        assert_eq!(report.select(Some(755), Some("leader")).len(), 1);
        assert!(report.select(Some(1), None).is_empty() && report.select(None, Some("x")).is_empty());
        // Tick numbers at the end of their range.
        report.ticks = vec![LateTick { ticks: u64::MAX, ..fixture::late("a", u64::MAX - 1, 1.0, vec![]) }; 2];
        assert!(report.find("a", u64::MAX).is_some() && report.find("a", 0).is_none());
    }

    #[test]
    fn the_main_cause_explains_more_than_what_is_unknown() {
        let cause = |kind, us: u64| Cause::new(kind, "", us * 1000);
        let late = |causes| fixture::late("a", 1, 100.0, causes);
        let kind = |late: LateTick| (late.main_cause().map(|cause| cause.kind), late.unknown_us());
        assert_eq!(kind(late(vec![])), (None, 100.0));
        assert_eq!(kind(late(vec![cause(CauseKind::Step, 49)])), (None, 51.0));
        assert_eq!(
            kind(late(vec![cause(CauseKind::Step, 51), cause(CauseKind::Unknown, 49)])),
            (Some(CauseKind::Step), 49.0)
        );
        assert_eq!(
            kind(late(vec![cause(CauseKind::Step, 20), cause(CauseKind::Task, 70)])),
            (Some(CauseKind::Task), 10.0)
        );
    }
}
